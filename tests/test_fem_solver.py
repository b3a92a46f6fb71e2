"""The nested-dissection solver against SciPy's sparse LU, and its reuse for another stiffness."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fem import elasticity, mesh, solver
from fem.mesh import Resolution
from fem.model import Inclusion, Layer, Probe, Slab
from fem.system import System, system

SMALL = Resolution(arc=2, core=1, shell=1, above=1, below=1, edge=1, side=1, layer=1, backing=1)


def build(poisson: float = 0.49, contrast: float = 20.0) -> tuple[System, np.ndarray]:
    probe, slab, ball = Probe(25, (Layer(2, 27),)), Slab(30, 60, 5), Inclusion(10, 5, 5 * contrast)
    sys = system(SMALL, 1)
    box = mesh.box_around(ball, probe, slab)
    modulus = np.array([5.0, 5 * contrast, 27.0])[sys.material]
    ratio = np.full(len(sys.material), poisson)
    cut = sys.slab_elements
    parts = mesh.morph_slab(SMALL, box, probe, slab), mesh.morph_probe(SMALL, box, probe, slab)
    slices = slice(0, cut), slice(cut, None)
    pairs = zip(parts, slices, strict=True)
    return sys, np.concatenate([elasticity.stiffness(m, modulus[s], ratio[s]) for m, s in pairs])


@pytest.fixture(scope="module")
def problem() -> tuple[System, np.ndarray]:
    return build()


def assembled(sys: System, matrices: np.ndarray) -> sp.csc_matrix:
    n, k = sys.dofs.shape
    rows, columns = (
        np.broadcast_to(sys.dofs[:, :, None], (n, k, k)),
        np.broadcast_to(sys.dofs[:, None, :], (n, k, k)),
    )
    free = (rows >= 0) & (columns >= 0)
    size = sys.tree.size
    return sp.csc_matrix((matrices[free], (rows[free], columns[free])), shape=(size, size))


def test_agrees_with_sparse_lu(problem: tuple[System, np.ndarray]) -> None:
    sys, matrices = problem
    load = np.random.default_rng(1).normal(size=sys.tree.size)
    whole = assembled(sys, matrices)
    expected = splu(whole, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(load)
    found = solver.Factor(sys.tree, matrices).solve(load)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(solver.apply(sys.tree, matrices, found), whole @ found, atol=1e-9)


@pytest.mark.parametrize("poisson", [0.49, 0.4999])
@pytest.mark.parametrize("contrast", [20.0, 2000.0])
def test_single_precision_loses_no_digits(poisson: float, contrast: float) -> None:
    sys, matrices = build(poisson, contrast)
    load = np.random.default_rng(1).normal(size=sys.tree.size)
    single, double = (solver.Factor(sys.tree, matrices, precision=p) for p in ("single", "double"))
    assert (single.precision, double.precision) == ("single", "double")
    rough, found, expected = single.precondition(load), single.solve(load), double.solve(load)
    assert rough.dtype == np.float64
    # the error of a solve is rounding times the condition, which the ratio of bulk to shear sets
    np.testing.assert_allclose(found, expected, atol=1e-12 / (1 - 2 * poisson) * np.abs(expected).max())
    residual = np.linalg.norm(load - solver.apply(sys.tree, matrices, found))
    assert residual <= 2 * np.linalg.norm(load - solver.apply(sys.tree, matrices, expected))


def test_where_single_precision_breaks_down_double_takes_over() -> None:
    sys, matrices = build(0.4999999, 20.0)
    factor = solver.Factor(sys.tree, matrices, precision="single")
    assert factor.precision == "double"
    load = np.ones(sys.tree.size)
    np.testing.assert_array_equal(
        factor.solve(load), solver.Factor(sys.tree, matrices, precision="double").solve(load)
    )


def test_preconditioner_is_symmetric_positive_and_scale_free(problem: tuple[System, np.ndarray]) -> None:
    """What conjugate gradients ask of it; loads far outside single precision's range included."""
    sys, matrices = problem
    factor = solver.Factor(sys.tree, matrices)
    a, b = np.random.default_rng(2).normal(size=(2, sys.tree.size))
    pa, pb = factor.precondition(a), factor.precondition(b)
    assert pa @ b == pytest.approx(a @ pb, rel=1e-4, abs=1e-5 * (a @ pa) ** 0.5 * (b @ pb) ** 0.5)
    assert a @ pa > 0
    np.testing.assert_array_equal(factor.precondition(2.0**-500 * a), 2.0**-500 * pa)
    np.testing.assert_array_equal(factor.precondition(0 * a), 0 * a)


def test_another_stiffness_of_the_kept_elements(problem: tuple[System, np.ndarray]) -> None:
    """Sharing what does not change gives the same bytes as factoring anew."""
    sys, matrices = problem
    softer = matrices.copy()
    softer[sys.material == 1] *= 0.05
    load = np.ones(sys.tree.size)
    base = solver.Factor(sys.tree, matrices)
    np.testing.assert_array_equal(
        solver.Factor(sys.tree, softer, base=base).solve(load), solver.Factor(sys.tree, softer).solve(load)
    )


def test_indefinite_is_refused(problem: tuple[System, np.ndarray]) -> None:
    sys, matrices = problem
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        solver.Factor(sys.tree, -matrices)
