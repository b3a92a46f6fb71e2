"""Meshes to hand on: the whole contact surface and the cut, mirrored where only a part was solved."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from skfem import ElementHex2, MeshHex2

from fem import edge
from fem.contact import recovery

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# corners of the four small quads of a nine-node face, as positions in its 3 x 3 grid of nodes,
# counter-clockwise
_SMALL = np.array([[0, 3, 4, 1], [3, 6, 7, 4], [1, 4, 5, 2], [4, 7, 8, 5]])


def mirror_grid(
    field: Floats, sign_x: float = 1.0, sign_y: float = 1.0, symmetric: tuple[bool, bool] = (True, True)
) -> Floats:
    """Extend a field on a grid (nx, ny) to the whole footprint by its parities about the symmetry planes at
    the first nodes."""
    if symmetric[0]:
        field = np.concatenate([sign_x * field[:0:-1], field])
    if symmetric[1]:
        field = np.concatenate([sign_y * field[:, :0:-1], field], axis=1)
    return field


def mirror_line(x: Floats, symmetric: bool = True) -> Floats:
    """Extend grid lines from x >= 0, shape (n,), to both sides, shape (2 n - 1,)."""
    return np.concatenate([-x[:0:-1], x]) if symmetric else x


def line_weights(x: Floats) -> Floats:
    """Simpson's weights of the nodes of a line of quadratic elements, shape (n,), n odd."""
    weights = np.zeros(len(x))
    lengths = x[2::2] - x[:-2:2]
    weights[:-2:2] += lengths / 6
    weights[1:-1:2] += lengths * 4 / 6
    weights[2::2] += lengths / 6
    return weights


def areas(x: Floats, y: Floats, moved: Floats) -> Floats:
    """Lumped area of each node (nx, ny), mm², on the deformed surface seen along z; moved (nx, ny, 3) mm."""
    dx = np.tensordot(_slopes(x.tobytes()), moved[..., :2], 1)
    dy = _slopes(y.tobytes()) @ moved[..., :2]
    stretch = (1 + dx[..., 0]) * (1 + dy[..., 1]) - dx[..., 1] * dy[..., 0]
    return np.asarray(np.outer(line_weights(x), line_weights(y)) * stretch)


@lru_cache(maxsize=8)  # an emulator answers on the same lines again and again
def _slopes(line: bytes) -> Floats:
    return recovery(np.frombuffer(line))


_CONSISTENT = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30
_SIMPSON = np.diag([1.0, 4.0, 1.0]) / 6


def pressure(reaction: Floats, x: Floats, y: Floats, closed: NDArray[np.bool_] | None = None) -> Floats:
    """Nominal contact pressure from the nodal reactions on the grid of the footprint.

    The consistent load of a pressure p is M p, with M the mass matrix of the contact faces. Dividing by the
    lumped area instead leaves an alternating error of -0.2 p'' H² at an element's corners and +0.1 p'' H² at
    its middle, H its half length: 3 % of the tared peak at standard quality. Solving with M removes it, but
    rings next to the singularity at the probe's edge, and where contact ends. So M is consistent inside,
    lumped (Simpson's rule) in the cell at the probe's edge, after the singular rise there has been taken out
    (`fem.edge`; not where contact has opened anywhere along the edges), and lumped around open pairs and
    wherever it would still give a negative pressure. Its row sums are the lumped areas in any case, so
    `pressure * area` sums to the force.

    Parameters
    ----------
    reaction
        Nodal forces, mN, shape (nx, ny), nowhere negative.
    x, y
        Grid lines, mm, (nx,) and (ny,); the probe's edge is where |x| or |y| is largest.
    closed
        Pairs in contact, (nx, ny); all by default.

    Returns
    -------
    (nx, ny) array, kPa, not negative.
    """
    shape = reaction.shape
    cells = (shape[0] - 1) // 2, (shape[1] - 1) // 2
    ends = [(bool(line[0] < -0.5 * line[-1]), True) for line in (x, y)]  # a symmetric half starts at 0
    rise = np.zeros(shape)
    if closed is None or closed.all():
        rest, along_x = edge.split(reaction, x, ends[0])
        rest, along_y = edge.split(rest.T, y, ends[1])
        along_x, corners = edge.split(along_x.T, y, ends[1])
        reaction = rest.T
        rise = along_x.T / line_weights(y) + along_y.T / line_weights(x)[:, None] + corners.T
    at_edge = [_edge_cells(len(line), end) for line, end in zip((x, y), ends, strict=True)]
    loose = np.zeros(cells, dtype=bool) if closed is None else _around(~closed)
    number = np.arange(reaction.size).reshape(shape)
    nine = np.stack(
        [number[i : i + 2 * cells[0] : 2, j : j + 2 * cells[1] : 2] for i in range(3) for j in range(3)], -1
    )
    size_x, size_y = x[2::2] - x[:-2:2], y[2::2] - y[:-2:2]
    for _ in range(20):
        lump_x, lump_y = at_edge[0][:, None] | loose, at_edge[1][None, :] | loose
        one_x = np.where(lump_x[..., None, None], _SIMPSON, _CONSISTENT) * size_x[:, None, None, None]
        one_y = np.where(lump_y[..., None, None], _SIMPSON, _CONSISTENT) * size_y[None, :, None, None]
        mass = np.einsum("mnik,mnjl->mnijkl", one_x, one_y).reshape(*cells, 9, 9)
        rows = np.broadcast_to(nine[..., :, None], mass.shape)
        whole = coo_matrix((mass.ravel(), (rows.ravel(), rows.swapaxes(-1, -2).ravel())))
        found = spsolve(whole.tocsc(), reaction.ravel()).reshape(shape)
        low = found + rise < 0
        if not low.any() or loose.all():
            break
        loose = loose | _around(low)
    return np.maximum(np.asarray(found + rise), 0.0)


def _edge_cells(nodes: int, ends: tuple[bool, bool]) -> NDArray[np.bool_]:
    """The cells at the probe's edge, of a line of so many nodes."""
    cells = np.zeros((nodes - 1) // 2, dtype=bool)
    cells[0], cells[-1] = ends
    return cells


def _around(nodes: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Cells (m, n) that have one of the nodes (2 m + 1, 2 n + 1), or are next to one that has."""
    m, n = (nodes.shape[0] - 1) // 2, (nodes.shape[1] - 1) // 2
    hit = np.zeros((m, n), dtype=bool)
    for i in range(3):
        for j in range(3):
            hit |= nodes[i : i + 2 * m : 2, j : j + 2 * n : 2]
    return binary_dilation(hit, np.ones((3, 3), dtype=bool))


def contact_surface(x: Floats, y: Floats, z: Floats | None = None) -> pv.PolyData:
    """Surface of quads on all Q2 nodes, four to a nine-node face.

    Parameters
    ----------
    x, y
        Coordinates of the grid lines, mm, shape (nx,) and (ny,), odd. Points are ordered x-major: point
        i * ny + j is (x_i, y_j).
    z
        Heights, mm, (nx, ny); flat at 0 by default.
    """
    n = len(y)
    heights = np.zeros((len(x), n)) if z is None else z
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), heights], axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(len(x), n)
    nine = np.stack(
        [number[i : len(x) - 2 + i : 2, j : n - 2 + j : 2] for i in range(3) for j in range(3)], axis=-1
    )
    return pv.PolyData(points, _quads(nine.reshape(-1, 9)))


def _quads(nine: Ints) -> Ints:
    """VTK's face array of the small quads of nine-node faces (m, 9)."""
    quads = nine[:, _SMALL].reshape(-1, 4)
    return np.hstack([np.full((len(quads), 1), 4), quads]).ravel()


def cut_faces(logical: MeshHex2) -> tuple[Ints, Ints]:
    """Nine-node faces on y = 0: nodes (m, 9) and the element of each (m,)."""
    lattice = np.round(2 * ElementHex2.doflocs.T).astype(int)
    nodes = logical.dofs.element_dofs
    on_cut = np.abs(logical.doflocs[1]) < 1e-9
    found: list[tuple[Ints, Ints]] = []
    for axis in range(3):
        others = [a for a in range(3) if a != axis]
        for side in (0, 2):
            local = np.flatnonzero(lattice[axis] == side)
            local = local[np.lexsort((lattice[others[1], local], lattice[others[0], local]))]
            hit = np.flatnonzero(on_cut[nodes[local]].all(axis=0))
            found.append((nodes[local][:, hit].T.astype(np.int64), hit))
    return np.vstack([f for f, _ in found]), np.concatenate([e for _, e in found])


def cut_plane(
    place: Floats, nine: Ints, material: Ints, fields: dict[str, Floats], mirror: bool = True
) -> pv.PolyData:
    """The cut through the middle of probe and inclusion, mirrored in x by default, of quads on all Q2 nodes.

    Parameters
    ----------
    place
        Undeformed nodes, mm, (nodes, 3).
    nine, material
        Faces (m, 9) and their material (m,).
    fields
        Vectors on all nodes (nodes, 3); x is odd under the mirror.
    """
    _, first = np.unique(np.sort(nine, axis=1), axis=0, return_index=True)
    nine, material = nine[np.sort(first)], material[np.sort(first)]  # inside a body, a face has two elements
    used, inverse = np.unique(nine, return_inverse=True)
    nine = inverse.reshape(nine.shape)
    if not mirror:
        cut = pv.PolyData(place[used], _quads(nine))
        for name, values in fields.items():
            cut.point_data[name] = values[used]
        cut.cell_data["material"] = np.repeat(material, 4)
        return cut
    n = len(used)
    axis = np.abs(place[used, 0]) < 1e-9
    twin = np.where(axis, np.arange(n), n + np.cumsum(~axis) - 1)
    flip = np.array([-1.0, 1.0, 1.0])

    def whole(values: Floats) -> Floats:
        return np.vstack([values[used], values[used][~axis] * flip])

    cut = pv.PolyData(whole(place), np.concatenate([_quads(nine), _quads(twin[nine])]))
    for name, values in fields.items():
        cut.point_data[name] = whole(values)
    cut.cell_data["material"] = np.tile(np.repeat(material, 4), 2)
    return cut
