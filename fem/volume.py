"""Volume results as one grid of triquadratic hexahedra, that ParaView opens and draws curved.

All functions take plain arrays: nodes (n, 3), cells (m, 27) in scikit-fem's order of nodes, fields on nodes,
and values at any quadrature points of the cells.
"""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike, fspath

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from skfem import ElementHex2
from skfem.quadrature import get_quadrature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# VTK's numbering of cell type 29: corners, then the middles of edges, of faces, and of the cell
_CORNERS = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
_MIDDLES = (
    *((0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)),
    *((0, 3, 7, 4), (1, 2, 6, 5), (0, 1, 5, 4), (3, 2, 6, 7), (0, 1, 2, 3), (4, 5, 6, 7)),
    tuple(range(8)),
)
_SYMMETRIC = ((0, 0), (1, 1), (2, 2), (0, 1), (1, 2), (0, 2))  # VTK's order of a symmetric tensor


def vtk_lattice() -> Floats:
    """Place of VTK's 27 nodes in its unit cube; shape (27, 3)."""
    corners = np.array(_CORNERS, dtype=float)
    return np.vstack([corners, *(corners[list(of)].mean(axis=0) for of in _MIDDLES)])


def _order(lattice: Floats) -> Ints:
    """Which of scikit-fem's nodes is at each place of `lattice`, (27, 3)."""
    distance = np.abs(ElementHex2.doflocs[None] - lattice[:, None]).max(axis=2)
    return np.asarray(distance.argmin(axis=1))


def vtk_cells(place: Floats, cells: Ints) -> Ints:
    """Cells in VTK's order of nodes, each upright in VTK's sense.

    scikit-fem's upright hexahedra have a negative determinant; they are numbered from their opposite corner.

    Parameters
    ----------
    place
        Nodes (n, 3), mm.
    cells
        Nodes of each cell in scikit-fem's order, (m, 27).
    """
    _, jacobian = _jacobian(place, cells, np.full((3, 1), 0.5))
    upright = np.linalg.det(jacobian[:, 0])[:, None] > 0
    return np.where(upright, cells[:, _order(vtk_lattice())], cells[:, _order(1 - vtk_lattice())])


def _jacobian(place: Floats, cells: Ints, points: Floats) -> tuple[Floats, Floats]:
    """Shape functions' slopes (27, 3, q) and the mapping's (m, q, 3, 3) at reference points (3, q)."""
    element = ElementHex2()
    slope = np.stack([np.broadcast_to(element.lbasis(points, i)[1], points.shape) for i in range(27)])
    return slope, np.einsum("mia,ibq->mqab", place[cells], slope, optimize=True)


# --- what the cells hold ----------------------------------------------------------------------------------


def gradients(place: Floats, cells: Ints, displacement: Floats) -> tuple[Floats, Floats, Floats]:
    """Displacement gradient at the 27 quadrature points of each cell.

    Parameters
    ----------
    place, displacement
        Undeformed nodes and their displacement, (n, 3), mm.
    cells
        Nodes of each cell in scikit-fem's order, (m, 27).

    Returns
    -------
    Gradient du_i / dX_j (m, q, 3, 3); undeformed volume of each point (m, q), mm³; its place (m, q, 3), mm.
    """
    points, weight = get_quadrature(ElementHex2().refdom, 4)
    slope, jacobian = _jacobian(place, cells, points)
    local = np.einsum("mia,ibq->mqab", displacement[cells], slope, optimize=True)
    shape = np.stack([ElementHex2().lbasis(points, i)[0] for i in range(27)])
    volume = np.abs(np.linalg.det(jacobian)) * weight
    return local @ np.linalg.inv(jacobian), volume, np.einsum("mia,iq->mqa", place[cells], shape)


def linear_pressure(dilation: Floats, bulk: Floats, volume: Floats, where: Floats) -> Floats:
    """Volumetric stress as the Q2/P1 element has it: bulk modulus times the dilation's linear part.

    Parameters
    ----------
    dilation
        Relative change of volume at each point, (m, q): the divergence, or J - 1 at finite strain.
    bulk
        Bulk modulus of each cell, (m,), kPa.
    volume, where
        Undeformed volume and place of each point, from `gradients`.

    Returns
    -------
    (m, q), kPa, tension positive.
    """
    middle = where - where.mean(axis=1, keepdims=True)
    middle = middle / np.abs(middle).max(axis=1, keepdims=True)
    q = np.concatenate([np.ones((*middle.shape[:2], 1)), middle], axis=2)
    weighted = (q * volume[:, :, None]).transpose(0, 2, 1)
    parts = np.linalg.solve(weighted @ q, weighted @ dilation[:, :, None])
    return np.asarray(bulk[:, None] * (q @ parts)[:, :, 0])


def cell_stress(
    gradient: Floats, pressure: Floats, shear: Floats, volume: Floats, mechanics: str = "finite"
) -> Floats:
    """Cauchy stress averaged over each cell's deformed volume.

    Linear: 2 mu dev(e) + p. Finite: mu J^(-5/3) dev(F F^T) + p, the stress of the neo-Hookean energy
    mu / 2 (J^(-2/3) tr C - 3) + U(J) with p = U'(J).

    Parameters
    ----------
    gradient
        Displacement gradient du_i / dX_j at each cell's points, (m, q, 3, 3).
    pressure
        Volumetric stress there, (m, q), kPa, tension positive.
    shear
        Shear modulus of each cell, (m,), kPa.
    volume
        Undeformed volume of each point, (m, q).
    mechanics
        "finite" or "linear".

    Returns
    -------
    (m, 3, 3), kPa, tension positive.
    """
    if mechanics not in ("finite", "linear"):
        raise ValueError(f"mechanics: received {mechanics!r}; allowed finite, linear")
    one = np.eye(3)
    if mechanics == "linear":
        shape, scale = gradient + np.swapaxes(gradient, 2, 3), np.ones_like(volume)
    else:
        f = one + gradient
        jump = np.linalg.det(f)
        shape, scale = f @ np.swapaxes(f, 2, 3), jump ** (-5 / 3)
        volume = volume * jump
    deviator = shape - np.trace(shape, axis1=2, axis2=3)[..., None, None] / 3 * one
    stress = (shear[:, None] * scale)[..., None, None] * deviator + pressure[..., None, None] * one
    return np.einsum("mqab,mq->mab", stress, volume) / volume.sum(axis=1)[:, None, None]


# --- the grid ---------------------------------------------------------------------------------------------


def volume_grid(
    place: Floats,
    cells: Ints,
    displacement: Floats,
    displacement_0: Floats,
    material: Ints,
    modulus_kPa: Floats,
    stress: Floats | None = None,
    mirror: Sequence[str] = (),
) -> pv.UnstructuredGrid:
    """The whole body as triquadratic hexahedra (VTK's cell type 29).

    Parameters
    ----------
    place
        Undeformed nodes, (n, 3), mm; origin at the centre of the contact surface, +z into the specimen.
    cells
        Nodes of each cell in scikit-fem's order, (m, 27).
    displacement, displacement_0
        With and without inclusion, (n, 3), mm.
    material, modulus_kPa
        Of each cell, (m,).
    stress
        Cauchy stress of each cell, (m, 3, 3), kPa, tension positive, such as `cell_stress` gives.
    mirror
        Symmetry planes to mirror at: "x" for x = 0, "y" for y = 0. Nodes on the plane are shared.

    Returns
    -------
    Grid with point arrays `displacement`, `displacement_0` and cell arrays `material`, `modulus_kPa`, and
    `stress` as xx, yy, zz, xy, yz, xz.

    Raises
    ------
    ValueError
        If shapes do not fit, or nodes lie on both sides of a symmetry plane.
    """
    n, m = len(place), len(cells)
    wanted: list[tuple[str, NDArray[np.generic], tuple[int, ...]]] = [
        ("place", place, (n, 3)),
        ("cells", cells, (m, 27)),
        ("displacement", displacement, (n, 3)),
        ("displacement_0", displacement_0, (n, 3)),
        ("material", material, (m,)),
        ("modulus_kPa", modulus_kPa, (m,)),
    ]
    if stress is not None:
        wanted.append(("stress", stress, (m, 3, 3)))
    for name, array, shape in wanted:
        if np.shape(array) != shape:
            raise ValueError(f"{name}: received shape {np.shape(array)}; allowed {shape}")
    tensors = np.zeros((m, 3, 3)) if stress is None else stress
    nodes = [place, displacement, displacement_0]
    cells = vtk_cells(place, cells)
    for name in mirror:
        if name not in ("x", "y"):
            raise ValueError(f"mirror: received {name!r}; allowed x, y")
        cells, nodes, tensors = _mirrored("xy".index(name), cells, nodes, tensors)
    copies = len(cells) // m
    grid = pv.UnstructuredGrid({pv.CellType.TRIQUADRATIC_HEXAHEDRON: cells}, nodes[0])
    grid.point_data["displacement"] = nodes[1]
    grid.point_data["displacement_0"] = nodes[2]
    grid.cell_data["material"] = np.tile(np.asarray(material, dtype=np.int32), copies)
    grid.cell_data["modulus_kPa"] = np.tile(np.asarray(modulus_kPa, dtype=float), copies)
    if stress is not None:
        grid.cell_data["stress"] = np.stack([tensors[:, a, b] for a, b in _SYMMETRIC], axis=1)
    return grid


def _mirrored(
    axis: int, cells: Ints, nodes: list[Floats], tensors: Floats
) -> tuple[Ints, list[Floats], Floats]:
    """Both halves of a body on one side of a plane; cells and nodes of the given half come first."""
    across = nodes[0][:, axis]
    near = 1e-9 * np.abs(across).max()
    if across.min() < -near and across.max() > near:
        raise ValueError(
            f"mirror: received nodes from {'xyz'[axis]} = {across.min():g} to {across.max():g} mm; "
            "allowed are nodes on one side of the plane"
        )
    away = np.abs(across) > near
    twin = np.where(away, len(across) - 1 + np.cumsum(away), np.arange(len(across)))
    sign = np.ones(3)
    sign[axis] = -1.0
    # a mirror turns hexahedra inside out: they are numbered backwards along their own first axis
    lattice = vtk_lattice()
    backwards = lattice * [-1, 1, 1] + [1, 0, 0]
    order = np.abs(lattice - backwards[:, None]).max(axis=2).argmin(axis=1)
    return (
        np.vstack([cells, twin[cells][:, order]]),
        [np.vstack([v, v[away] * sign]) for v in nodes],
        np.concatenate([tensors, tensors * np.outer(sign, sign)]),
    )


def save_volume(grid: pv.UnstructuredGrid, path: str | PathLike[str]) -> None:
    """Write the grid as VTK's XML file (.vtu), compressed binary."""
    if not fspath(path).endswith(".vtu"):
        raise ValueError(f"path: received {fspath(path)!r}; allowed are names that end in .vtu")
    grid.save(path)
