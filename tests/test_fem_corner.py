"""Where deep flat presses end: the probe's sharp, frictionless corner loses its stiffness (minutes)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, lobpcg

import fem
from fem import mesh, solver
from fem.equilibrium import Body, NotConverged, Preconditioner, State
from fem.mesh import Geometry
from fem.meshed import build
from fem.operators import Matrices, Sheared, product
from fem.path import path

Floats = NDArray[np.float64]

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
NEAR_MM = 3.0


def softest(body: Body, state: State) -> tuple[float, float]:
    """Smallest stiffness of a tied equilibrium over that at rest, and the share of its mode that moves within
    NEAR_MM of the probe's corner."""
    model, bond, tip = state.model, state.tie, state.model.nodes.tip
    sys = model.system(state.closed)
    tangent, slopes = body.tangent(model, state.moved), bond.slopes(len(model.place))

    def expand(values: Floats) -> Floats:
        change = sys.expand(np.ravel(values))
        change[tip, 2] = bond.height(change)
        return change

    def operator(matrices: Matrices) -> LinearOperator:
        def apply(values: Floats) -> Floats:
            force = model.nodal(product(matrices, expand(values), model))
            return sys.gather(bond.hand_on(force, force[tip, 2]))

        return LinearOperator((sys.tree.size, sys.tree.size), matvec=apply, dtype=float)

    factor = solver.Factor(sys.tree, Sheared(tangent, sys.nodes.cells, slopes), again=False)
    precondition = Preconditioner(sys, factor, slopes)
    loads = np.random.default_rng(0).normal(size=(2, sys.tree.size))
    values, modes = lobpcg(
        operator(tangent),
        np.stack([precondition(load) for load in loads], axis=1),
        B=operator(body.rest),
        M=LinearOperator((len(loads[0]),) * 2, matvec=lambda x: precondition(np.ravel(x)), dtype=float),
        largest=False,
        maxiter=60,
        tol=1e-4,
    )
    mode = (expand(modes[:, int(values.argmin())]) ** 2).sum(axis=1)
    away = np.linalg.norm(model.place - model.place[tip[-1, -1]], axis=1)
    return float(values.min()), float(mode[away < NEAR_MM].sum() / mode.sum())


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.filterwarnings("ignore:Exited")
@pytest.mark.parametrize("quality, levels", [("preview", (1, 2, 3, 4, 5, 6)), ("standard", (1, 2, 3, 3.5))])
def test_a_sharp_corner_loses_its_stiffness(quality: str, levels: tuple[float, ...]) -> None:
    """The smallest eigenvalue of the tangent over the stiffness at rest falls to nothing, sooner the finer
    the mesh, in a mode that lives at the corner; at standard quality no equilibrium is found at 6 mm."""
    geometry = Geometry(PROBE, SLAB, fem.Inclusion(10, 5, 100))
    with solver.one_thread():
        bare = path(geometry, build(geometry, mesh.QUALITIES[quality], True), False)
        found = [softest(bare.body, bare.to(level)) for level in levels]
        for level, (stiffness, share) in zip(levels, found, strict=True):
            print(f"{quality}, {level:g} mm: smallest stiffness {stiffness:.4f}, {share:.0%} at the corner")
        stiffness = np.array([one for one, _ in found])
        assert (np.diff(stiffness) < 0).all() and stiffness[-1] < 0.1 * stiffness[0]
        assert found[-1][1] > 0.7
        if quality == "standard":
            with pytest.raises(NotConverged):
                bare.to(6.0)
