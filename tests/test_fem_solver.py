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


@pytest.fixture(scope="module")
def problem() -> tuple[System, np.ndarray]:
    probe, slab, ball = Probe(25, (Layer(2, 27),)), Slab(30, 60, 5), Inclusion(10, 5, 100)
    sys = system(SMALL, 1)
    box = mesh.box_around(ball, probe, slab)
    modulus, poisson = np.array([5.0, 100.0, 27.0])[sys.material], np.full(len(sys.material), 0.49)
    cut = sys.slab_elements
    parts = mesh.morph_slab(SMALL, box, probe, slab), mesh.morph_probe(SMALL, box, probe, slab)
    slices = slice(0, cut), slice(cut, None)
    pairs = zip(parts, slices, strict=True)
    return sys, np.concatenate([elasticity.stiffness(m, modulus[s], poisson[s]) for m, s in pairs])


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
