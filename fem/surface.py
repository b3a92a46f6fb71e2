"""Meshes to hand on: the whole contact surface and the cut y = 0, mirrored from the solved quarter."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from skfem import ElementHex2, MeshHex2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

# corners of the four small quads of a nine-node face, as positions in its 3 x 3 grid of nodes,
# counter-clockwise
_SMALL = np.array([[0, 3, 4, 1], [3, 6, 7, 4], [1, 4, 5, 2], [4, 7, 8, 5]])


def mirror_grid(field: Floats, sign_x: float = 1.0, sign_y: float = 1.0) -> Floats:
    """Extend a field on a grid of the quarter (n, n) to the whole (2 n - 1, 2 n - 1), by its parities."""
    whole = np.concatenate([sign_x * field[:0:-1], field])
    return np.concatenate([sign_y * whole[:, :0:-1], whole], axis=1)


def mirror_line(x: Floats) -> Floats:
    """Extend grid lines from x >= 0, shape (n,), to both sides, shape (2 n - 1,)."""
    return np.concatenate([-x[:0:-1], x])


def line_weights(x: Floats) -> Floats:
    """Simpson's weights of the nodes of a line of quadratic elements, shape (n,), n odd."""
    weights = np.zeros(len(x))
    lengths = x[2::2] - x[:-2:2]
    weights[:-2:2] += lengths / 6
    weights[1:-1:2] += lengths * 4 / 6
    weights[2::2] += lengths / 6
    return weights


def _line_mass(x: Floats, lumped: int) -> Floats:
    """Mass matrix of a line of quadratic elements (n, n), its last `lumped` elements by Simpson's rule."""
    full = np.array([[4.0, 2.0, -1.0], [2.0, 16.0, 2.0], [-1.0, 2.0, 4.0]]) / 30
    simpson = np.diag([1.0, 4.0, 1.0]) / 6
    mass = np.zeros((len(x), len(x)))
    last = len(x) - 1 - 2 * lumped
    for i in range(0, len(x) - 2, 2):
        mass[i : i + 3, i : i + 3] += (full if i < last else simpson) * (x[i + 2] - x[i])
    return mass


def pressure(reaction: Floats, x: Floats, y: Floats, edge: int) -> Floats:
    """Contact pressure from the nodal reactions on the grid of the quarter.

    The consistent load of a pressure p is M p, with M the mass matrix of the contact faces. Dividing by the
    lumped area instead leaves an alternating error of -0.2 p'' H² at an element's corners and +0.1 p'' H² at
    its middle, H its half length: 3 % of the tared peak at standard quality. Solving with M removes it, but
    rings next to the singularity at the probe's edge. So M is consistent inside and lumped in the
    `edge` cells next to the probe's edge. Its row sums are the lumped areas either way, so
    `pressure * area` still sums to the force.

    Parameters
    ----------
    reaction
        Nodal forces, mN, shape (n, n).
    x, y
        Grid lines, mm, each (n,), from the symmetry plane to the probe's edge.

    Returns
    -------
    (n, n) array, kPa.
    """
    along_x = np.linalg.solve(_line_mass(x, edge), reaction)
    return np.asarray(np.linalg.solve(_line_mass(y, edge), along_x.T).T)


def contact_surface(x: Floats, y: Floats) -> pv.PolyData:
    """Flat surface z = 0 of quads on all Q2 nodes, four to a nine-node face, with each node's lumped `area`.

    Parameters
    ----------
    x, y
        Coordinates of the grid lines, mm, shape (n,), n odd. Points are ordered x-major: point i * n + j is
        (x_i, y_j).
    """
    n = len(y)
    points = np.stack([*np.meshgrid(x, y, indexing="ij"), np.zeros((len(x), n))], axis=-1).reshape(-1, 3)
    number = np.arange(len(points)).reshape(len(x), n)
    nine = np.stack(
        [number[i : len(x) - 2 + i : 2, j : n - 2 + j : 2] for i in range(3) for j in range(3)], axis=-1
    )
    surface = pv.PolyData(points, _quads(nine.reshape(-1, 9)))
    surface.point_data["area"] = np.outer(line_weights(x), line_weights(y)).ravel()
    return surface


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


def cut_plane(place: Floats, nine: Ints, material: Ints, fields: dict[str, Floats]) -> pv.PolyData:
    """The cut y = 0, mirrored in x, of quads on all Q2 nodes.

    Parameters
    ----------
    place
        Undeformed nodes, mm, (nodes, 3).
    nine, material
        Faces (m, 9) and their material (m,).
    fields
        Vectors on all nodes (nodes, 3); x is odd under the mirror.
    """
    used, inverse = np.unique(nine, return_inverse=True)
    nine = inverse.reshape(nine.shape)
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
