"""What a field that balances within the slab leaves to be made up for at its faces, as loads on the unknowns.

Such a field knows nothing of the faces: where displacement is given (along z at the probe, whole at the chest
wall) its own is to be taken back, on free faces its traction.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from skfem import ElementHex2

from fem.meshed import Model
from fem.operators import AtRest
from fem.quadrature import DOFS
from fem.system import System

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_ON = 1e-9  # mm from a plane, on it
_LATTICE = np.round(2 * ElementHex2.doflocs.T).astype(int)


@dataclass(frozen=True)
class Given:
    """Nodes whose displacement is given: contact along z, the chest wall, symmetric sides across."""

    place: Floats  # (n, 3) mm
    stiffness: csr_matrix  # forces on the unknowns of displacements (3 n,) there, mN / mm


@dataclass(frozen=True)
class Free:
    """Gauss points of the slab's other faces; contact, too: along z its unknowns are the probe's."""

    place: Floats  # (n, 3) mm
    normal: Floats  # (n, 3), outward
    weights: csr_matrix  # loads on the unknowns of tractions (3 n,), mm²


def given_of(model: Model, sys: System, matrices: AtRest) -> Given:
    """Stiffness between the unknowns and the displacements that are given."""
    nodes = model.nodes
    known = np.zeros((len(model.place), 3), dtype=bool)
    known[nodes.contact, 2] = True  # the slab slides along the probe
    known[nodes.chest] = True
    if model.geometry.slab.sides == "symmetric":
        for axis, value, _ in _sides(model):
            known[: nodes.slab, axis] |= np.abs(model.place[: nodes.slab, axis] - value) < _ON
    at = np.flatnonzero(known.any(axis=1))
    column = np.full((len(model.place), 3), -1)
    column[at] = np.arange(3 * len(at)).reshape(-1, 3)
    column[~known] = -1
    slab = np.arange(len(nodes.cells)) < nodes.slab_cells
    shape = (sys.tree.size, 3 * len(at))
    return Given(model.place[at], _entries(matrices, nodes.cells, slab, sys.unknown, column.ravel(), shape))


def _sides(model: Model) -> list[tuple[int, float, float]]:
    """The slab's sides that are meshed: axis, place, and direction outwards."""
    half = model.geometry.slab.width_mm / 2
    return [
        (axis, sign * half, sign)
        for axis, mirrored in enumerate(model.layout.symmetric)
        for sign in ((1.0,) if mirrored else (-1.0, 1.0))
    ]


def reaction_of(model: Model, sys: System, matrices: AtRest) -> csr_matrix:
    """Forces along z of the probe's cells on its contact nodes, of the unknowns, mN / mm."""
    nodes, row = model.nodes, np.full((len(model.place), 3), -1)
    row[nodes.tip.ravel(), 2] = np.arange(nodes.tip.size)
    probe = np.arange(len(nodes.cells)) >= nodes.slab_cells
    return _entries(matrices, nodes.cells, probe, row.ravel(), sys.unknown, (nodes.tip.size, sys.tree.size))


def _entries(
    matrices: AtRest, nodes: Ints, among: NDArray[np.bool_], rows: Ints, columns: Ints, shape: tuple[int, int]
) -> csr_matrix:
    """Sum of element matrices; rows and columns by the number of each dof (3 nodes,), negative for none."""
    touched = among.copy()
    for number in (rows, columns):
        touched &= (number.reshape(-1, 3)[nodes] >= 0).any(axis=(1, 2))
    some = np.flatnonzero(touched)
    dofs = (3 * nodes[some][:, :, None] + np.arange(3)).reshape(-1, DOFS)
    i, j = np.broadcast_arrays(rows[dofs][:, :, None], columns[dofs][:, None, :])
    kept = (i >= 0) & (j >= 0)
    return csr_matrix((matrices(some)[kept].astype(np.float64), (i[kept], j[kept])), shape=shape)


def free_of(model: Model, sys: System) -> Free:
    """Gauss points of the face towards the probe and of the sides; their tractions work on unknowns only."""
    planes = [(2, 0.0, -1.0), *_sides(model)]
    found = [_faces(model, axis, value) for axis, value, _ in planes]
    normals = [
        np.tile(sign * np.eye(3)[axis], (9 * len(part), 1))
        for (axis, _, sign), part in zip(planes, found, strict=True)
    ]
    nine = np.concatenate(found)
    shape, slopes, weight = _nine_nodes()
    place = model.place[nine]
    spans = [np.einsum("qi,mic->mqc", slope, place) for slope in slopes]
    area = np.linalg.norm(np.cross(*spans), axis=-1) * weight  # (faces, points)
    values = (shape * area[..., None])[..., None]  # (faces, points, nodes, 1)
    rows = sys.unknown.reshape(-1, 3)[nine][:, None]
    columns = 3 * np.arange(area.size).reshape(*area.shape, 1, 1) + np.arange(3)
    rows, columns, values = np.broadcast_arrays(rows, columns, values)
    kept = rows >= 0
    return Free(
        np.einsum("qi,mic->mqc", shape, place).reshape(-1, 3),
        np.concatenate(normals),
        csr_matrix((values[kept], (rows[kept], columns[kept])), shape=(sys.tree.size, 3 * area.size)),
    )


def _faces(model: Model, axis: int, value: float) -> Ints:
    """Nodes (m, 9) of the slab's nine-node faces on a plane, in the order of `_nine_nodes`."""
    cells = model.nodes.cells[: model.nodes.slab_cells]
    outer = np.abs(model.place[:, axis] - value) < _ON
    found = []
    for across in range(3):
        others = [a for a in range(3) if a != across]
        for side in (0, 2):
            local = np.flatnonzero(_LATTICE[across] == side)
            local = local[np.lexsort((_LATTICE[others[1], local], _LATTICE[others[0], local]))]
            found.append(cells[:, local][outer[cells[:, local]].all(axis=1)])
    return np.concatenate(found)


def _nine_nodes() -> tuple[Floats, tuple[Floats, Floats], Floats]:
    """Shapes (points, nodes) of a nine-node face, their two slopes, and the weights of its Gauss points."""
    t, w = np.polynomial.legendre.leggauss(3)
    t, w = (t + 1) / 2, w / 2
    line = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
    slope = np.stack([4 * t - 3, 4 - 8 * t, 4 * t - 1], axis=1)
    shape, along, across = (np.kron(a, b) for a, b in ((line, line), (slope, line), (line, slope)))
    return np.asarray(shape), (np.asarray(along), np.asarray(across)), np.outer(w, w).ravel()
