"""The nested-dissection solver against SciPy's sparse LU, and its reuse for another stiffness."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import scipy.sparse as sp
from scipy.sparse.linalg import splu

from fem import elasticity, solver
from fem.mesh import Geometry
from fem.meshed import build as build_model
from fem.model import Inclusion, Layer, Probe, Slab
from fem.topology import Resolution, materials

SMALL = Resolution(arc=2, core=1, shell=1, above=1, below=1, edge=1, side=1, layer=1, backing=1)


@dataclass(frozen=True)
class System:
    """The tied press: dofs of each element (m, 81), -1 where held; its material; order of elimination."""

    dofs: np.ndarray
    material: np.ndarray
    tree: solver.Tree


def build(poisson: float = 0.49, contrast: float = 20.0) -> tuple[System, np.ndarray]:
    probe, slab = Probe(25, (Layer(2, 27),)), Slab(30, 60, 5)
    geometry = Geometry(probe, slab, Inclusion(10, 5, 5 * contrast))
    model = build_model(geometry, SMALL, finite=False)
    tied = model.system(np.ones(model.nodes.tip.shape, dtype=bool))
    dofs = tied.unknown[
        (3 * model.nodes.cells[:, :, None] + np.arange(3)).reshape(len(model.nodes.cells), -1)
    ]
    material = materials(model.layout)
    modulus = np.array([5.0, 5 * contrast, 27.0])[material]
    matrices = elasticity.stiffness(model.quad, *elasticity.lame(modulus, np.full(len(material), poisson)))
    return System(dofs, material, tied.tree), matrices


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


@pytest.mark.parametrize("times", [0.05, 1e4])
def test_one_factor_for_other_matrices(problem: tuple[System, np.ndarray], times: float) -> None:
    """Near or far: the answer is that of the matrices asked for."""
    sys, matrices = problem
    other = matrices.copy()
    other[sys.material == 1] *= times
    load = np.random.default_rng(5).normal(size=sys.tree.size)
    factor = solver.Factor(sys.tree, matrices)
    before = factor.precondition(load)
    expected = solver.Factor(sys.tree, other, precision="double").solve(load)
    found = factor.solve(load, matrices=other)
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_array_equal(factor.precondition(load), before)


def test_matrices_in_single_precision_or_made_on_demand(problem: tuple[System, np.ndarray]) -> None:
    """The factor is the same; sums stay double, so that the solution is that of the rounded matrices."""
    sys, matrices = problem
    load = np.ones(sys.tree.size)
    rounded = matrices.astype(np.float32)
    factors = [
        solver.Factor(sys.tree, m)
        for m in (rounded, rounded.astype(np.float64), lambda elements: rounded[elements])
    ]
    for found in factors[1:]:
        np.testing.assert_array_equal(found.precondition(load), factors[0].precondition(load))
        np.testing.assert_array_equal(found.solve(load), factors[0].solve(load))
    whole = assembled(sys, rounded.astype(np.float64))
    np.testing.assert_allclose(whole @ factors[0].solve(load), load, atol=1e-10)


def test_several_loads_at_once(problem: tuple[System, np.ndarray]) -> None:
    sys, matrices = problem
    factor = solver.Factor(sys.tree, matrices)
    loads = np.random.default_rng(4).normal(size=(sys.tree.size, 3)) * [1, 1e-9, 1e9]
    found = factor.precondition(loads)
    assert found.shape == loads.shape
    for one, load in zip(found.T, loads.T, strict=True):
        np.testing.assert_allclose(one, factor.precondition(load), atol=1e-4 * np.abs(one).max())


def random_elements(seed: int) -> tuple[np.ndarray, np.ndarray, int]:
    """Elements of four to six unknowns anywhere, prescribed dofs and unused places marked by -1."""
    rng = np.random.default_rng(seed)
    n, m = 60, 90
    dofs = np.array([rng.permutation(n)[:6] for _ in range(m)])
    dofs[:n, 0] = np.arange(n)  # each unknown in some element
    dofs[:, 4:][rng.random((m, 2)) < 0.5] = -1
    for row in dofs:  # no unknown twice in an element
        row[np.isin(np.arange(6), np.unique(row, return_index=True)[1], invert=True)] = -1
    root = rng.normal(size=(m, 6, 6))
    return dofs, root @ root.transpose(0, 2, 1) + 0.1 * np.eye(6), n


@pytest.mark.parametrize("seed", range(5))
def test_any_topology(seed: int) -> None:
    """Nothing relies on the mesh: random elements against the dense solution, the tree taken over as well."""
    dofs, matrices, n = random_elements(seed)
    whole = np.zeros((n, n))
    for row, matrix in zip(dofs, matrices, strict=True):
        free = row >= 0
        whole[np.ix_(row[free], row[free])] += matrix[np.ix_(free, free)]
    rng = np.random.default_rng(seed)
    centres, load = rng.normal(size=(len(dofs), 3)), rng.normal(size=n)
    factor = solver.Factor(solver.plan(dofs, centres), matrices)
    np.testing.assert_allclose(factor.solve(load), np.linalg.solve(whole, load), rtol=1e-7, atol=1e-9)

    # another unknown is prescribed: the dissection is still good
    fewer = np.where(dofs == n - 1, -1, dofs)
    tree = solver.plan(fewer, centres, like=solver.plan(dofs, centres))
    found = solver.Factor(tree, matrices).solve(load[:-1])
    np.testing.assert_allclose(found, np.linalg.solve(whole[:-1, :-1], load[:-1]), rtol=1e-7, atol=1e-9)


def test_order_of_elimination_is_good() -> None:
    """On a cube of 10³ quadratic elements the factor is smaller than with minimum degree (SuperLU)."""
    cells = 10
    place = np.arange((2 * cells + 1) ** 3).reshape(3 * (2 * cells + 1,))
    corner = np.stack(np.meshgrid(*3 * (2 * np.arange(cells),), indexing="ij"), -1).reshape(-1, 3)
    inner = np.stack(np.meshgrid(*3 * (np.arange(3),), indexing="ij"), -1).reshape(-1, 3)
    dofs = place[tuple((corner[:, None] + inner).transpose(2, 0, 1))]
    tree = solver.plan(dofs, corner.astype(float))
    entries = sum(f.pivots * (f.pivots + 1) // 2 + f.pivots * len(f.border) for f in tree.fronts)
    rows, columns = (np.repeat(dofs, 27, axis=1).ravel(), np.tile(dofs, 27).ravel())
    pattern = sp.csc_matrix((np.where(rows == columns, 1e3, -1.0), (rows, columns)))
    lower = splu(pattern, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).L
    assert entries < 0.85 * lower.nnz


def test_indefinite_is_refused(problem: tuple[System, np.ndarray]) -> None:
    sys, matrices = problem
    with pytest.raises(np.linalg.LinAlgError, match="positive definite"):
        solver.Factor(sys.tree, -matrices)
