"""The element: exact on linear fields, third order on smooth ones, at any Poisson's ratio (no locking)."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from skfem import Basis, ElementHex2, MeshHex, MeshHex2

from fem import elasticity, solver
from fem.operators import AtRest, Tangent
from fem.quadrature import Quadrature, quadrature

Floats = NDArray[np.float64]


def element_dofs(mesh: MeshHex2) -> NDArray[np.int64]:
    """Dofs 3 * node + axis of each element, (m, 81)."""
    nodes = mesh.dofs.element_dofs.T.astype(np.int64)
    return (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), -1)


def integrals(mesh: MeshHex2) -> Quadrature:
    return quadrature(mesh.dofs.element_dofs.T, mesh.doflocs.T)


def curved_cube(cells: int) -> MeshHex2:
    """Unit cube whose inner elements are smoothly bent, so that the curved mapping is tested too."""
    mesh = MeshHex2.from_mesh(MeshHex.init_tensor(*3 * (np.linspace(0, 1, cells + 1),)))
    x, y, z = mesh.doflocs
    bump = 0.05 * np.sin(np.pi * x) * np.sin(np.pi * y) * np.sin(np.pi * z)
    return MeshHex2(mesh.doflocs + bump * np.array([[1.0], [-1.0], [0.5]]), mesh.t)


def dirichlet(mesh: MeshHex2, modulus: float, poisson: float, exact: Floats, load: Floats) -> Floats:
    """Solve with `exact` (3, nodes) prescribed on the faces and nodal `load` (3 nodes,); gives (3, nodes)."""
    n = mesh.t.shape[1]
    matrices = elasticity.stiffness(
        integrals(mesh), *elasticity.lame(np.full(n, modulus), np.full(n, poisson))
    )
    local = element_dofs(mesh)
    place = mesh.doflocs
    held = np.repeat(((place < 1e-9) | (place > 1 - 1e-9)).any(axis=0), 3)
    number = np.where(held, -1, np.cumsum(~held) - 1)
    full = np.where(held, exact.T.ravel(), 0.0)
    force = (matrices @ full[local][:, :, None])[:, :, 0]
    rest = load - np.bincount(local.ravel(), weights=force.ravel(), minlength=len(full))
    centres = mesh.p[:, mesh.t].mean(axis=1).T
    tree = solver.plan(number[local], centres)
    full[~held] = solver.Factor(tree, matrices).solve(rest[~held])
    return full.reshape(-1, 3).T


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.4999])
def test_patch(poisson: float) -> None:
    """A linear displacement is reproduced to rounding on curved elements."""
    mesh = curved_cube(3)
    gradient = np.array([[0.3, 0.1, -0.2], [0.05, -0.1, 0.4], [0.2, 0.15, -0.2]])
    exact = gradient @ mesh.doflocs
    found = dirichlet(mesh, 5.0, poisson, exact, np.zeros(exact.size))
    assert np.abs(found - exact).max() < 1e-11


@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_manufactured_solution_converges_at_third_order(poisson: float) -> None:
    """u = (sin y sin z, sin z sin x, sin x sin y) (arguments times pi) keeps volume; its load is 2 pi² mu u.

    The L2 error of Q2/P1 falls as h³, and by the same amount, at every Poisson's ratio.
    """

    def field(p: Floats) -> Floats:
        x, y, z = np.sin(np.pi * p)
        return np.stack([y * z, z * x, x * y])

    shear = 1.0 / (2 * (1 + poisson))
    errors = []
    for cells in (3, 6):
        mesh = curved_cube(cells)
        q2 = Basis(mesh, ElementHex2(), intorder=4)
        points = np.asarray(q2.global_coordinates())
        density = 2 * np.pi**2 * shear * field(points)
        nodes = mesh.dofs.element_dofs
        load = np.zeros((mesh.doflocs.shape[1], 3))
        for i in range(27):
            weight = np.asarray(q2.basis[i][0]) * q2.dx
            for a in range(3):
                np.add.at(load[:, a], nodes[i], (density[a] * weight).sum(axis=1))
        found = dirichlet(mesh, 1.0, poisson, field(mesh.doflocs), load.ravel())
        shape = [np.asarray(q2.basis[i][0]) for i in range(27)]
        here = sum(found[:, nodes[i], None] * shape[i] for i in range(27))
        errors.append(float(np.sqrt((((here - field(points)) ** 2).sum(axis=0) * q2.dx).sum())))
    assert np.log2(errors[0] / errors[1]) > 2.7
    assert errors[1] < 1.5e-3  # the same bound at every Poisson's ratio: nothing locks


def test_rigid_motion_costs_nothing() -> None:
    mesh = curved_cube(2)
    n = mesh.t.shape[1]
    matrices = elasticity.stiffness(integrals(mesh), *elasticity.lame(np.full(n, 5.0), np.full(n, 0.49)))
    x, y, z = mesh.doflocs
    for motion in (np.stack([x * 0 + 1, x * 0, x * 0]), np.stack([-y, x, 0 * z]), np.stack([0 * x, -z, y])):
        force = matrices @ motion.T.ravel()[element_dofs(mesh)][:, :, None]
        assert np.abs(force).max() < 1e-11


@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_forces_at_small_strain_are_the_product_of_the_stiffness(poisson: float) -> None:
    """Without its matrices, on curved elements of different moduli; and its largest entry is foretold."""
    mesh = curved_cube(3)
    quad, rng = integrals(mesh), np.random.default_rng(0)
    shear, bulk = elasticity.lame(rng.uniform(1.0, 50.0, quad.size), np.full(quad.size, poisson))
    matrices = elasticity.stiffness(quad, shear, bulk)
    rest = AtRest(quad, shear, bulk, np.float64)
    local = rng.normal(size=(quad.size, 81))
    expected = np.einsum("nij,nj->ni", matrices, local)
    np.testing.assert_allclose(rest.times(local), expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    np.testing.assert_array_equal(rest(np.array([3, 1])), matrices[[3, 1]])
    assert elasticity.largest(quad, shear, bulk) == pytest.approx(np.abs(matrices).max(), rel=1e-12)


def test_tangents_are_the_same_before_and_after_they_are_stored() -> None:
    mesh = curved_cube(3)
    quad, rng = integrals(mesh), np.random.default_rng(1)
    shear, bulk = elasticity.lame(np.full(quad.size, 5.0), np.full(quad.size, 0.49))
    moved = 0.01 * rng.normal(size=(mesh.doflocs.shape[1], 3))
    tangent, some = Tangent(quad, shear, bulk, moved), np.array([2, 5, 11])
    before, local = tangent(some), rng.normal(size=(quad.size, 81))
    product = tangent.times(local)
    scale = np.abs(before).max()
    a, b, _ = tangent.stored
    np.testing.assert_allclose(a[some], before[:, :41, :41], rtol=0, atol=1e-6 * scale)
    np.testing.assert_allclose(b[some], before[:, :41, 41:].transpose(0, 2, 1), rtol=0, atol=1e-6 * scale)
    exact = np.einsum("nij,nj->ni", elasticity.stiffness(quad, shear, bulk, moved), local)
    np.testing.assert_allclose(product, exact, rtol=0, atol=2e-6 * np.abs(exact).max())
    tangent.let_go()
    np.testing.assert_array_equal(tangent(some), before)


def test_a_damped_tangent_is_the_sum_and_lets_go_of_the_plain_one() -> None:
    """Two of them at a time are what a deep press off both axes took most memory for."""
    mesh = curved_cube(3)
    quad, rng = integrals(mesh), np.random.default_rng(2)
    shear, bulk = elasticity.lame(rng.uniform(1.0, 50.0, quad.size), np.full(quad.size, 0.49))
    plain = Tangent(quad, shear, bulk, 0.01 * rng.normal(size=(mesh.doflocs.shape[1], 3)))
    local = rng.normal(size=(quad.size, 81))
    expected = plain.times(local) + 0.2 * AtRest(quad, shear, bulk, np.float64).times(local)
    damped = plain.damped(0.2)
    assert "stored" not in vars(plain)
    np.testing.assert_allclose(damped.times(local), expected, rtol=0, atol=2e-6 * np.abs(expected).max())
