"""The volume grid: VTK's own cells say the same as the basis, stress balances, files come back."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import pyvista as pv
import vtk
from numpy.typing import NDArray
from skfem import Basis, Element, ElementHex2, ElementVector, MappingIsoparametric, MeshHex, MeshHex2

from fem.elasticity import lame
from fem.volume import (
    cell_stress,
    gradients,
    linear_pressure,
    save_volume,
    volume_grid,
    vtk_cells,
    vtk_lattice,
)

Floats = NDArray[np.float64]


def bent(cells: int = 2, quarter: bool = False) -> MeshHex2:
    """Box of curved hexahedra; the quarter's sides x = 0 and y = 0 stay plane."""
    mesh = MeshHex2.from_mesh(MeshHex.init_tensor(*3 * (np.linspace(0, 1, cells + 1),)))
    x, y, z = mesh.doflocs
    sway = x * y if quarter else np.sin(2 * y) + x**2
    move = np.stack([0.2 * x * np.cos(z), 0.3 * y * z, 0.15 * sway]) + (
        0.0 if quarter else 0.1 * np.stack([z, x, y])
    )
    return MeshHex2(mesh.doflocs + move, mesh.t)


def q2(mesh: MeshHex2, element: Element | None = None) -> Basis:
    """scikit-fem's basis on curved cells with 27 points."""
    return Basis(mesh, element or ElementHex2(), MappingIsoparametric(mesh, ElementHex2()), intorder=4)


def arrays(mesh: MeshHex2) -> tuple[Floats, NDArray[np.int64]]:
    return mesh.doflocs.T.copy(), mesh.dofs.element_dofs.T.astype(np.int64)


def field(place: Floats) -> Floats:
    x, y, z = place.T
    return np.stack([np.sin(x + z), x * y - z**2, np.cos(y) * x], axis=1)


def grid_of(mesh: MeshHex2, **more: object) -> pv.UnstructuredGrid:
    place, cells = arrays(mesh)
    moved = field(place)
    m = len(cells)
    return volume_grid(place, cells, moved, 2 * moved, np.arange(m), np.linspace(1, 2, m), **more)  # type: ignore[arg-type]


def test_lattice_is_vtks() -> None:
    coords = vtk.vtkTriQuadraticHexahedron().GetParametricCoords()
    np.testing.assert_array_equal(vtk_lattice().ravel(), [coords[i] for i in range(81)])


def test_interpolation_agrees_with_the_basis() -> None:
    """Place and field at random points within each curved cell, by VTK's weights and by scikit-fem's."""
    mesh = bent()
    grid = grid_of(mesh)
    place, cells = arrays(mesh)
    points = np.random.default_rng(1).uniform(size=(5, 3))
    reference = 1 - points.T  # scikit-fem's upright hexahedra are point-mirrored
    shape = np.stack([ElementHex2().lbasis(reference, i)[0] for i in range(27)])
    where = MappingIsoparametric(mesh, ElementHex2()).F(reference)  # (3, cells, points)
    for i in range(grid.n_cells):
        cell = grid.GetCell(i)
        assert cell.GetCellType() == 29
        nodes = [cell.GetPointId(k) for k in range(27)]
        for j, point in enumerate(points):
            found, weights = [0.0] * 3, [0.0] * 27
            cell.EvaluateLocation(vtk.reference(0), point, found, weights)
            np.testing.assert_allclose(found, where[:, i, j], atol=1e-13)
            vtks = np.array(weights) @ grid["displacement"][nodes]
            np.testing.assert_allclose(vtks, shape[:, j] @ field(place)[cells[i]], atol=1e-13)


def test_sampling_agrees_with_the_basis() -> None:
    """VTK finds the cell and the point in it by itself, as ParaView's probe does, to its Newton's 1e-3."""
    mesh = bent()
    place, cells = arrays(mesh)
    reference = np.random.default_rng(2).uniform(0.1, 0.9, size=(3, 4))
    where = MappingIsoparametric(mesh, ElementHex2()).F(reference).reshape(3, -1).T
    shape = np.stack([ElementHex2().lbasis(reference, i)[0] for i in range(27)])
    wanted = np.einsum("iq,mia->mqa", shape, field(place)[cells]).reshape(-1, 3)
    sampled = pv.PolyData(where).sample(grid_of(mesh))
    assert sampled["vtkValidPointMask"].all()
    np.testing.assert_allclose(sampled["displacement"], wanted, atol=2e-3)


def jacobian_volumes(grid: pv.UnstructuredGrid) -> Floats:
    """Volume of each cell by VTK's own shape functions, 27 Gauss points; negative where inside out."""
    line, weight = np.polynomial.legendre.leggauss(3)
    points = np.stack(np.meshgrid(*3 * ((1 + line) / 2,), indexing="ij"), axis=-1).reshape(-1, 3)
    weights = np.einsum("i,j,k->ijk", *3 * (weight / 2,)).ravel()
    out = []
    for i in range(grid.n_cells):
        cell, total = grid.GetCell(i), 0.0
        place = grid.points[[cell.GetPointId(k) for k in range(27)]]
        for point, w in zip(points, weights, strict=True):
            slopes = [0.0] * 81
            cell.InterpolateDerivs(point, slopes)
            total += w * np.linalg.det(np.reshape(slopes, (3, 27)) @ place)
        out.append(total)
    return np.array(out)


def test_volumes_agree_with_the_basis() -> None:
    """By VTK's shape functions to rounding; by its cell-size filter, which cuts flat tetrahedra, nearly."""
    for mesh in (bent(), bent(4)):
        grid = grid_of(mesh)
        wanted = q2(mesh).dx.sum(axis=1)
        np.testing.assert_allclose(jacobian_volumes(grid), wanted, rtol=1e-12)
        sizes = grid.compute_cell_sizes(length=False, area=False)["Volume"]
        np.testing.assert_allclose(sizes, wanted, rtol=0.02 * (2 / mesh.t.shape[1] ** (1 / 3)) ** 2)


def test_cells_of_either_hand_come_out_upright() -> None:
    """A mesh mirrored by negating x has positive determinants in scikit-fem: VTK still gets it upright."""
    place, cells = arrays(bent())
    place[:, 0] *= -1
    grid = volume_grid(place, cells, place, place, np.zeros(8, dtype=int), np.ones(8))
    assert jacobian_volumes(grid).min() > 0
    assert np.sort(vtk_cells(place, cells), axis=1).tolist() == np.sort(cells, axis=1).tolist()


def test_mirrored_to_the_whole() -> None:
    """Four times the volume, upright, one closed body; vectors and tensors odd and even as they must."""
    mesh = bent(quarter=True)
    place, cells = arrays(mesh)
    x, y, z = place.T
    moved = np.stack([np.sin(x), y * z, x**2 + y**2], axis=1)  # odd in x and y as symmetry asks
    gradient, volume, _ = gradients(place, cells, moved)
    pressure = np.trace(gradient, axis1=2, axis2=3)
    stress = cell_stress(gradient, pressure, np.ones(len(cells)), volume, "linear")
    args = (moved, 2 * moved, np.arange(8), np.linspace(1, 2, 8))
    grid = volume_grid(place, cells, *args, stress, mirror=("x", "y"))
    assert grid.n_cells == 32 and grid.n_points == 9 * 9 * 5
    np.testing.assert_allclose(jacobian_volumes(grid), np.tile(volume.sum(axis=1), 4), rtol=1e-12)
    x, y, z = grid.points.T
    np.testing.assert_allclose(
        grid["displacement"], np.stack([np.sin(x), y * z, x**2 + y**2], axis=1), atol=1e-15
    )
    np.testing.assert_array_equal(grid["displacement_0"], 2 * grid["displacement"])
    assert len(np.unique(np.round(grid.points, 9), axis=0)) == grid.n_points  # nothing doubled on the planes
    surface = grid.extract_surface(nonlinear_subdivision=0, algorithm="dataset_surface")
    assert surface.extract_feature_edges(feature_edges=False, manifold_edges=False).n_cells == 0
    # stress of the mirrored half = stress of the mirrored displacement
    half = np.hstack([place[:, :1] * -1, place[:, 1:]]), np.hstack([moved[:, :1] * -1, moved[:, 1:]])
    gradient, volume, _ = gradients(half[0], cells, half[1])
    again = cell_stress(gradient, pressure, np.ones(len(cells)), volume, "linear")
    voigt = np.stack([again[:, a, b] for a, b in ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))], axis=1)
    np.testing.assert_allclose(grid["stress"][8:16], voigt, atol=1e-13)
    np.testing.assert_array_equal(grid["material"], np.tile(np.arange(8), 4))
    np.testing.assert_array_equal(grid["modulus_kPa"], np.tile(np.linspace(1, 2, 8), 4))


@pytest.mark.parametrize("poisson", [0.0, 0.49, 0.4999])
def test_linear_stress_agrees_with_scikit_fem(poisson: float) -> None:
    """Mean of 2 mu e + (kappa - 2/3 mu) div u over each cell: projecting the pressure keeps its mean."""
    mesh = bent()
    place, cells = arrays(mesh)
    moved = np.random.default_rng(3).normal(size=place.shape)
    shear, bulk = lame(np.linspace(1, 20, 8), np.full(8, poisson))
    gradient, volume, where = gradients(place, cells, moved)
    pressure = linear_pressure(np.trace(gradient, axis1=2, axis2=3), bulk, volume, where)
    stress = cell_stress(gradient, pressure, shear, volume, "linear")

    basis = q2(mesh, ElementVector(ElementHex2()))
    full = np.zeros(basis.N)
    for axis in range(3):
        full[basis.element_dofs[axis::3]] = moved[cells.T, axis]
    grad = np.asarray(basis.interpolate(full).grad)  # (3, 3, cells, points)
    div = np.einsum("iimq->mq", grad)
    mu, lam = shear[:, None], (bulk - 2 / 3 * shear)[:, None]
    wanted = mu * (grad + grad.transpose(1, 0, 2, 3)) + lam * div * np.eye(3)[:, :, None, None]
    mean = ((wanted * basis.dx).sum(axis=3) / basis.dx.sum(axis=1)).transpose(2, 0, 1)
    np.testing.assert_allclose(stress, mean, rtol=1e-9, atol=1e-9 * np.abs(mean).max())


def test_linear_pressure_is_the_nearest() -> None:
    """A dilation that is linear in place is kept; of any other, the rest is orthogonal to 1, x, y, z."""
    place, cells = arrays(bent())
    _, volume, where = gradients(place, cells, place)
    bulk = np.linspace(10, 20, 8)
    even = 0.1 + where @ [0.3, -0.2, 0.5]
    np.testing.assert_allclose(linear_pressure(even, bulk, volume, where), bulk[:, None] * even, rtol=1e-12)
    rough = np.random.default_rng(6).normal(size=volume.shape)
    rest = rough - linear_pressure(rough, bulk, volume, where) / bulk[:, None]
    q = np.concatenate([np.ones((*where.shape[:2], 1)), where], axis=2)
    assert np.abs(np.einsum("mq,mq,mqk->mk", rest, volume, q)).max() < 1e-12


def test_neo_hookean_stress() -> None:
    """Even stretches (l1, l1, l3) after a rotation: mu J^(-5/3) (l_i² - mean) + kappa (J - 1), rotated."""
    place, cells = arrays(bent())
    shear, bulk = np.full(8, 1.7), np.full(8, 80.0)
    stretch = np.diag([1.1, 1.1, 0.8])
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.linalg.det(turn)
    moved = place @ (turn @ stretch - np.eye(3)).T
    gradient, volume, where = gradients(place, cells, moved)
    jump = np.linalg.det(np.eye(3) + gradient)
    pressure = linear_pressure(jump - 1, bulk, volume, where)
    j = 1.1**2 * 0.8
    squares = np.array([1.21, 1.21, 0.64])
    principal = 1.7 * j ** (-5 / 3) * (squares - squares.mean()) + 80 * (j - 1)
    wanted = turn @ np.diag(principal) @ turn.T
    stress = cell_stress(gradient, pressure, shear, volume)
    np.testing.assert_allclose(stress, np.tile(wanted, (8, 1, 1)), atol=1e-11)


def test_small_strain_is_both() -> None:
    """At a displacement of a millionth, finite and linear stress agree to a millionth."""
    place, cells = arrays(bent())
    gradient, volume, where = gradients(place, cells, 1e-6 * field(place))
    shear, bulk = np.linspace(1, 3, 8), np.linspace(50, 60, 8)
    div = np.trace(gradient, axis1=2, axis2=3)
    jump = np.linalg.det(np.eye(3) + gradient) - 1
    linear = cell_stress(gradient, linear_pressure(div, bulk, volume, where), shear, volume, "linear")
    finite = cell_stress(gradient, linear_pressure(jump, bulk, volume, where), shear, volume)
    np.testing.assert_allclose(finite, linear, atol=1e-5 * np.abs(linear).max())


def test_file_comes_back(tmp_path: Path) -> None:
    """What is read from the .vtu is what was written, to the bit, with cells that are still curved."""
    mesh = bent(quarter=True)
    place, cells = arrays(mesh)
    stress = np.random.default_rng(5).normal(size=(8, 3, 3))
    grid = volume_grid(
        place,
        cells,
        field(place),
        place,
        np.arange(8),
        np.ones(8),
        stress + np.swapaxes(stress, 1, 2),
        ("x",),
    )
    path = tmp_path / "volume.vtu"
    save_volume(grid, path)
    again = pv.read(path)
    assert set(again.celltypes) == {29}
    np.testing.assert_array_equal(again.points, grid.points)
    np.testing.assert_array_equal(again.cells, grid.cells)
    assert set(again.point_data.keys()) == {"displacement", "displacement_0"}
    assert set(again.cell_data.keys()) == {"material", "modulus_kPa", "stress"}
    for name in (*again.point_data.keys(), *again.cell_data.keys()):
        np.testing.assert_array_equal(again[name], grid[name])
    first = path.read_bytes()
    save_volume(grid, path)
    assert path.read_bytes() == first


def test_refused(tmp_path: Path) -> None:
    place, cells = arrays(bent())
    good = (place, place, np.zeros(8, dtype=int), np.ones(8))
    for args, more, says in (
        ((place, cells[:, :20], *good), {}, "cells"),
        ((place, cells, place[:5], place, *good[2:]), {}, "displacement"),
        ((place, cells, *good[:2], np.zeros(3, dtype=int), np.ones(8)), {}, "material"),
        ((place, cells, *good), {"stress": np.zeros((8, 6))}, "stress"),
        ((place, cells, *good), {"mirror": ("z",)}, "mirror"),
        ((place - 0.5, cells, *good), {"mirror": ("x",)}, "mirror"),
    ):
        with pytest.raises(ValueError, match=f"^{says}: received .*allowed"):
            volume_grid(*args, **more)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="path"):
        save_volume(grid_of(bent()), tmp_path / "volume.vtk")
    with pytest.raises(ValueError, match="mechanics"):
        cell_stress(np.zeros((1, 1, 3, 3)), np.zeros((1, 1)), np.ones(1), np.ones((1, 1)), "large")
