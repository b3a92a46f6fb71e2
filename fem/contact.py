"""Frictionless contact by mortar: where the probe's faces stand on the slab's, and how forces reach it.

Both bodies carry the same grid of nine-node faces, the probe's face by face on the slab's. The slab's mesh
follows the expected slip (`fem.path`), so that what is left of it is small against a face, and each of the 3
x 3 Gauss points q of a face of the probe stands on the polynomial of its own partner, at xi where (x,
y)_slab(xi) = (x, y)_q. Closed contact ties the z of the probe's node i to the slab's surface,

    z_i = sum_q P_iq (z_slab(xi_q) + G_q . ((x, y)_q - (x, y)_slab(xi_q))),  P_iq = w_q psi_i(q) / w_i,
    (1)

with the dual functions psi that are biorthogonal to the quadratic ones (Wohlmuth 2000; [wohlmuth2000]), so
that without slip (1) says that pairs of nodes have the same z, and with the slope G of the probe's deformed
face. The transpose of (1) hands on the forces: along the normal (-G, 1), at the very place of contact. That
place counts: above an inclusion the tissue slides outwards under the probe by some 5 % of the indentation and
would take the background's pressure along, which is a tenth of the signal per mm.

xi and G are held fixed while equilibrium is found, then taken anew until they stay (Wriggers 2006, section
6.3; [wriggers2006]): each equilibrium is that of two elastic bodies under linear ties, with an energy and a
symmetric tangent. A pair is closed with a force >= 0, or open with a gap >= 0 (Signorini's conditions).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_GAUSS = np.array([0.5 - np.sqrt(0.15), 0.5, 0.5 + np.sqrt(0.15)])
_WEIGHT = np.array([5.0, 8.0, 5.0]) / 18


def _lagrange(t: Floats) -> tuple[Floats, Floats]:
    """Quadratic functions of the nodes 0, 1/2, 1 at t (m,), and their derivatives; each (m, 3)."""
    value = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
    return value, np.stack([4 * t - 3, 4 - 8 * t, 4 * t - 1], axis=1)


def _dual() -> Floats:
    """Dual functions at the Gauss points, (3 points, 3 nodes): integral psi_i N_j = delta_ij integral N_j."""
    shape = _lagrange(_GAUSS)[0]
    mass = shape.T @ (_WEIGHT[:, None] * shape)
    return np.asarray(shape @ np.linalg.solve(mass, np.diag(_WEIGHT @ shape)))


def recovery(lines: Floats) -> Floats:
    """Matrix (n, n) of the derivative at the nodes of a line of quadratic elements, the mean of both sides
    at shared nodes and of the whole element at the ends, where a singular edge would make it wild; lines (n,)
    are the nodes, n odd."""
    local = np.array([[-3.0, 4.0, -1.0], [-1.0, 0.0, 1.0], [1.0, -4.0, 3.0]])
    matrix, count = np.zeros((len(lines), len(lines))), np.zeros(len(lines))
    for i in range(0, len(lines) - 2, 2):
        matrix[i : i + 3, i : i + 3] += local / (lines[i + 2] - lines[i])
        count[i : i + 3] += 1
    matrix[0], matrix[-1] = matrix[1], matrix[-2]
    count[0] = count[-1] = 1
    return matrix / count[:, None]


@dataclass(frozen=True)
class Line:
    """Quadratic elements along one axis of the grid: nodes (n,), Gauss points (3 n_e,)."""

    nodes: Floats
    element: Ints  # of each Gauss point
    shape: Floats  # N at the Gauss points, (points, n)
    mean: Floats  # P, (n, points)
    recovery: Floats  # derivatives at the nodes, (n, n)

    def rows(self, at: Floats, element: Ints) -> tuple[Floats, Floats]:
        """Weights of the nodes for values and derivatives at places (m,) on the polynomials of elements
        (m,)."""
        first = 2 * element
        step = self.nodes[first + 2] - self.nodes[first]
        local = _lagrange((at - self.nodes[first]) / step)
        found = []
        for order, values in enumerate(local):
            row = np.zeros((len(at), len(self.nodes)))
            for k in range(3):
                row[np.arange(len(at)), first + k] = values[:, k] / step**order
            found.append(row)
        return found[0], found[1]


def line(nodes: Floats) -> Line:
    """Prepare a line of quadratic elements; nodes (n,) mm, n odd."""
    count = (len(nodes) - 1) // 2
    element = np.repeat(np.arange(count), 3)
    dual, shape = np.zeros((3 * count, len(nodes))), np.zeros((3 * count, len(nodes)))
    weight = np.zeros(3 * count)
    for e in range(count):
        rows, columns = slice(3 * e, 3 * e + 3), slice(2 * e, 2 * e + 3)
        shape[rows, columns], dual[rows, columns] = _lagrange(_GAUSS)[0], _dual()
        weight[rows] = _WEIGHT * (nodes[2 * e + 2] - nodes[2 * e])
    mean = (dual * weight[:, None]).T / (weight @ shape)[:, None]
    return Line(nodes, element, shape, mean, recovery(nodes))


@dataclass(frozen=True)
class Weights:
    """Of the slab's nodes on the grid (nx, ny) at m places: of values and first derivatives along each
    axis."""

    x: tuple[Floats, Floats]  # each (m, nx)
    y: tuple[Floats, Floats]  # each (m, ny)

    def value(self, field: Floats, i: int = 0, j: int = 0) -> Floats:
        """Field (nx, ny), or its i-th derivative along x and j-th along y, at the places; (m,)."""
        return np.asarray(((self.x[i] @ field) * self.y[j]).sum(axis=1))

    def spread(self, values: Floats) -> Floats:
        """Transpose of `value`: (m,) to (nx, ny)."""
        return np.asarray(self.x[0].T @ (self.y[0] * values[:, None]))


@dataclass(frozen=True)
class Interface:
    """The contact nodes of both bodies, each on a grid (nx, ny) over the footprint; its faces' Gauss points
    form a grid (px, py)."""

    slab: Ints
    probe: Ints
    x: Line
    y: Line
    symmetric: tuple[bool, bool]  # whether the first line is on a symmetry plane

    def derivatives(self, place: Floats) -> Floats:
        """Derivatives of places (nx, ny, 3) along the undeformed x and y, (nx, ny, 2, 3)."""
        dx = np.tensordot(self.x.recovery, place, 1)
        dy = np.einsum("jk,ikc->ijc", self.y.recovery, place)
        return np.stack([dx, dy], axis=2)

    def slope(self, place: Floats) -> Floats:
        """Slope dz/dx, dz/dy of the probe's face at places (nodes, 3); (nx, ny, 2)."""
        along = self.derivatives(place[self.probe])
        found = np.linalg.solve(along[..., :2], along[..., 2:])[..., 0]
        if self.symmetric[0]:
            found[0, :, 0] = 0.0
        if self.symmetric[1]:
            found[:, 0, 1] = 0.0
        return np.asarray(found)

    def points(self, field: Floats) -> Floats:
        """Field of the probe's nodes (nx, ny) at the Gauss points, (px py,)."""
        return np.asarray(self.x.shape @ field @ self.y.shape.T).ravel()

    def spread(self, values: Floats) -> Floats:
        """Transpose of `points`."""
        return np.asarray(self.x.shape.T @ self._grid(values) @ self.y.shape)

    def mean(self, values: Floats) -> Floats:
        """The dual means P of values at the Gauss points (px py,), (nx, ny)."""
        return np.asarray(self.x.mean @ self._grid(values) @ self.y.mean.T)

    def spread_mean(self, field: Floats) -> Floats:
        """Transpose of `mean`."""
        return np.asarray(self.x.mean.T @ field @ self.y.mean).ravel()

    def _grid(self, values: Floats) -> Floats:
        return values.reshape(len(self.x.element), len(self.y.element))

    @property
    def rim(self) -> Bools:
        """Gauss points in the faces along the probe's edge, (px py,)."""
        ends = []
        for axis, symmetric in zip((self.x, self.y), self.symmetric, strict=True):
            end = axis.element == axis.element.max()
            ends.append(end if symmetric else end | (axis.element == 0))
        return (ends[0][:, None] | ends[1]).ravel()

    def weights(self, at: Floats) -> Weights:
        """Weights of the slab's nodes at grid places (px py, 2) on each Gauss point's own face."""
        x, y = (e.ravel() for e in np.meshgrid(self.x.element, self.y.element, indexing="ij"))
        return Weights(self.x.rows(at[:, 0], x), self.y.rows(at[:, 1], y))


@dataclass(frozen=True)
class Tie:
    """Equation (1) with places and slopes held fixed: linear in the places of all nodes."""

    interface: Interface
    at: Floats  # places xi of the probe's Gauss points on the slab's grid, (m, 2) mm
    weights: Weights
    nodal: Floats  # G at the nodes, (nx, ny, 2)
    slope: Floats  # G at the Gauss points, (m, 2)

    def height(self, place: Floats) -> Floats:
        """Right side of (1) at places (nodes, 3), or for a change of them; (nx, ny) mm."""
        slab, probe = place[self.interface.slab], place[self.interface.probe]
        level = self.weights.value(slab[..., 2])
        for a in (0, 1):
            level = level + self.slope[:, a] * (
                self.interface.points(probe[..., a]) - self.weights.value(slab[..., a])
            )
        return self.interface.mean(level)

    def gap(self, place: Floats) -> Floats:
        """Distance along z between the surfaces, (nx, ny) mm; negative where they overlap."""
        return self.height(place) - place[self.interface.probe, 2]

    def hand_on(self, forces: Floats, normal: Floats) -> Floats:
        """Forces (nodes, 3) with those `normal` (nx, ny) along z on the probe's nodes handed on through
        (1)."""
        out, face = forces.copy(), self.interface
        out[face.probe, 2] -= normal
        at = face.spread_mean(normal)
        out[face.slab, 2] += self.weights.spread(at)
        for a in (0, 1):
            side = self.slope[:, a] * at
            out[face.probe, a] += face.spread(side)
            out[face.slab, a] -= self.weights.spread(side)
        return out

    def slopes(self, nodes: int) -> Floats:
        """G at the pairs' nodes of both bodies, 0 at others; (nodes, 2)."""
        out = np.zeros((nodes, 2))
        out[self.interface.slab] = out[self.interface.probe] = self.nodal
        return out


def level(interface: Interface) -> Tie:
    """The tie of small strain: pairs have the same z."""
    grid = np.meshgrid(*(e.shape @ e.nodes for e in (interface.x, interface.y)), indexing="ij")
    at = np.stack(grid, axis=-1).reshape(-1, 2)
    flat = np.zeros((*interface.slab.shape, 2))
    return Tie(interface, at, interface.weights(at), flat, np.zeros((len(at), 2)))


def tie(interface: Interface, place: Floats, before: Tie, share: float = 1.0) -> Tie:
    """The tie that places (nodes, 3) mm, ask for; `share` of the way from `before` in its slopes."""
    slab, probe = place[interface.slab], place[interface.probe]
    target = np.stack([interface.points(probe[..., a]) for a in (0, 1)], axis=1)
    at = before.at
    for _ in range(30):
        weights = interface.weights(at)
        now = np.stack([weights.value(slab[..., a]) for a in (0, 1)], axis=1)
        if np.abs(now - target).max() < 1e-12:
            break
        along = [[weights.value(slab[..., a], *order) for order in ((1, 0), (0, 1))] for a in (0, 1)]
        at = at - np.linalg.solve(np.array(along).transpose(2, 0, 1), (now - target)[..., None])[..., 0]
    # in the faces along the probe's edge, where slip and slope run away with each other, pairs stay together
    at = np.where(interface.rim[:, None], level(interface).at, at)
    weights = interface.weights(at)
    nodal = share * interface.slope(place) + (1 - share) * before.nodal
    slope = np.stack([interface.points(nodal[..., a]) for a in (0, 1)], axis=1)
    return Tie(interface, at, weights, nodal, slope)
