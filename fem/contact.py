"""Frictionless contact by mortar: where the probe's faces stand on the slab's, and how forces reach it.

Both bodies carry the same grid of nine-node faces, the probe's face by face on the slab's. The mesh follows the
slip (`fem.path`), so that what is left of it is small against a face, and each of the 3 x 3 Gauss points q of
a face of the probe stands on the polynomial of its own partner, at local places xi found from
(x, y)_slab(xi) = (x, y)_q. Closed contact ties the z of the probe's node i to the slab's surface,

    z_i = sum_q P_iq z_slab(xi_q),   P_iq = w_q psi_i(q) / w_i,                                         (1)

with the dual functions psi that are biorthogonal to the quadratic ones (Wohlmuth 2000; [wohlmuth2000]), so that
without slip (1) says that pairs of nodes have the same z. With G = dz/d(x, y) the slab's slope and a_qj the
weights of its nodes j at xi_q, the variation of (1) is

    dz_i = sum_q P_iq (sum_j a_qj (dz_j - G . d(x, y)_j) + G . sum_k N_qk d(x, y)_k)                    (2)

whose transpose hands on the forces: along the slab's normal (-G, 1), at the very place of contact. A pair is
closed with a force lambda >= 0, or open with a gap >= 0 (Signorini's conditions: Wriggers 2006, section 2.2;
[wriggers2006]).
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


def _lagrange(t: Floats) -> tuple[Floats, Floats, Floats]:
    """Quadratic functions of the nodes 0, 1/2, 1 at t (m,), with both derivatives; each (m, 3)."""
    one = np.ones_like(t)
    value = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
    return value, np.stack([4 * t - 3, 4 - 8 * t, 4 * t - 1], axis=1), np.stack([4 * one, -8 * one, 4 * one], axis=1)


def _dual() -> Floats:
    """Dual functions at the Gauss points, (3 points, 3 nodes): integral psi_i N_j = delta_ij integral N_j."""
    shape = _lagrange(_GAUSS)[0]
    mass = shape.T @ (_WEIGHT[:, None] * shape)
    return np.asarray(shape @ np.linalg.solve(mass, np.diag(_WEIGHT @ shape)))


@dataclass(frozen=True)
class Line:
    """Quadratic elements along one axis of the grid: nodes (n,), Gauss points (3 n_e,)."""

    nodes: Floats
    element: Ints  # of each Gauss point
    shape: Floats  # N at the Gauss points, (points, n)
    mean: Floats  # P, (n, points)

    def rows(self, at: Floats, element: Ints) -> tuple[Floats, Floats, Floats]:
        """Weights of the nodes for values and derivatives at places (m,) on the polynomials of elements (m,)."""
        first = 2 * element
        step = self.nodes[first + 2] - self.nodes[first]
        local = _lagrange((at - self.nodes[first]) / step)
        found = []
        for order, values in enumerate(local):
            row = np.zeros((len(at), len(self.nodes)))
            for k in range(3):
                row[np.arange(len(at)), first + k] = values[:, k] / step**order
            found.append(row)
        return found[0], found[1], found[2]


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
    return Line(nodes, element, shape, (dual * weight[:, None]).T / (weight @ shape)[:, None])


@dataclass(frozen=True)
class Weights:
    """Of a field's nodes on the grid (nx, ny) at m places: values, first and second derivatives along each axis."""

    x: tuple[Floats, Floats, Floats]  # each (m, nx)
    y: tuple[Floats, Floats, Floats]  # each (m, ny)

    def value(self, field: Floats, i: int = 0, j: int = 0) -> Floats:
        """Field (nx, ny), or its i-th derivative along x and j-th along y, at the places; (m,)."""
        return np.asarray(((self.x[i] @ field) * self.y[j]).sum(axis=1))

    def spread(self, values: Floats, i: int = 0, j: int = 0) -> Floats:
        """Transpose of `value`: (m,) to (nx, ny)."""
        return np.asarray(self.x[i].T @ (self.y[j] * values[:, None]))

    def slopes(self, field: Floats) -> Floats:
        """Both first derivatives, (m, 2)."""
        return np.stack([self.value(field, 1, 0), self.value(field, 0, 1)], axis=1)

    def spread_slopes(self, values: Floats) -> Floats:
        """Transpose of `slopes`."""
        return self.spread(values[:, 0], 1, 0) + self.spread(values[:, 1], 0, 1)

    def curvatures(self, field: Floats) -> Floats:
        """Second derivatives, (m, 2, 2)."""
        xx, xy, yy = (self.value(field, *order) for order in ((2, 0), (1, 1), (0, 2)))
        return np.stack([np.stack([xx, xy], axis=1), np.stack([xy, yy], axis=1)], axis=1)


@dataclass(frozen=True)
class Interface:
    """The contact nodes of both bodies, each on a grid (nx, ny) over the footprint; its faces' Gauss points
    form a grid (px, py)."""

    slab: Ints
    probe: Ints
    x: Line
    y: Line

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

    def weights(self, at: Floats) -> Weights:
        """Weights of the slab's nodes at grid places (px py, 2) on each Gauss point's own face."""
        x, y = (e.ravel() for e in np.meshgrid(self.x.element, self.y.element, indexing="ij"))
        return Weights(self.x.rows(at[:, 0], x), self.y.rows(at[:, 1], y))


@dataclass(frozen=True)
class Slip:
    """Where the probe's Gauss points (m in all) stand on the slab's surface."""

    interface: Interface
    at: Floats  # on the grid, (m, 2)
    weights: Weights
    slope: Floats  # G (m, 2)
    inverse: Floats  # derivative of grid places by (x, y), (m, 2 grid, 2 axes)
    curvature: Floats  # of the surface above its tangent plane, along the grid, (m, 2, 2)
    height: Floats  # right side of (1), (nx, ny) mm

    def moved(self, change: Floats) -> Floats:
        """Equation (2): change of (1) by a change of displacements (nodes, 3); (nx, ny) mm."""
        slab = change[self.interface.slab]
        apart = self._apart(change)
        rise = self.weights.value(slab[..., 2])
        return self.interface.mean(rise + self.slope[:, 0] * apart[:, 0] + self.slope[:, 1] * apart[:, 1])

    def _apart(self, change: Floats) -> Floats:
        """Change of the lateral place of the probe's Gauss points over the slab's; (m, 2)."""
        slab, probe = change[self.interface.slab], change[self.interface.probe]
        parts = [self.interface.points(probe[..., a]) - self.weights.value(slab[..., a]) for a in (0, 1)]
        return np.stack(parts, axis=1)

    def nodal_slope(self, nodes: int) -> Floats:
        """G at the pairs' nodes of both bodies, 0 at others; (nodes, 2)."""
        out = np.zeros((nodes, 2))
        for a in (0, 1):
            mean = self.interface.mean(self.slope[:, a])
            out[self.interface.slab, a] = out[self.interface.probe, a] = mean
        return out

    def push(self, force: Floats, out: Floats) -> None:
        """Transpose of `moved`: add the forces (nx, ny) that act through it to `out` (nodes, 3)."""
        at = self.interface.spread_mean(force)
        out[self.interface.slab, 2] += self.weights.spread(at)
        for a in (0, 1):
            self._drag(a, self.slope[:, a] * at, out)

    def _drag(self, axis: int, side: Floats, out: Floats) -> None:
        out[self.interface.probe, axis] += self.interface.spread(side)
        out[self.interface.slab, axis] -= self.weights.spread(side)

    def stiffen(self, change: Floats, force: Floats, out: Floats) -> None:
        """Add the change of `push(force)` by a change of displacements."""
        slab = change[self.interface.slab]
        at = self.interface.spread_mean(force)[:, None]
        slid = np.einsum("mga,ma->mg", self.inverse, self._apart(change))
        along = [self.weights.slopes(slab[..., a]) for a in range(3)]
        turned = along[2] - self.slope[:, :1] * along[0] - self.slope[:, 1:] * along[1]
        turned += np.einsum("mgh,mh->mg", self.curvature, slid)
        tilt = np.einsum("mg,mga->ma", turned, self.inverse) * at
        slid *= at
        out[self.interface.slab, 2] += self.weights.spread_slopes(slid)
        for a in (0, 1):
            self._drag(a, tilt[:, a], out)
            out[self.interface.slab, a] -= self.weights.spread_slopes(slid * self.slope[:, a, None])


def slip(interface: Interface, place: Floats, guess: Slip | None = None) -> Slip:
    """Find where the probe's Gauss points stand on the slab's surface, both at places (nodes, 3), mm."""
    slab, probe = place[interface.slab], place[interface.probe]
    target = np.stack([interface.points(probe[..., a]) for a in (0, 1)], axis=1)
    if guess is None:
        grid = np.meshgrid(interface.x.shape @ interface.x.nodes, interface.y.shape @ interface.y.nodes, indexing="ij")
        at = np.stack(grid, axis=-1).reshape(-1, 2)
    else:
        at = guess.at
    for _ in range(30):
        weights = interface.weights(at)
        along = np.stack([weights.slopes(slab[..., a]) for a in range(3)], axis=2)  # (m, grid, axis)
        inverse = np.linalg.inv(along[..., :2]).swapaxes(1, 2)  # (m, 2 grid, 2 axes)
        miss = np.stack([weights.value(slab[..., a]) for a in (0, 1)], axis=1) - target
        if np.abs(miss).max() < 1e-12:
            break
        at = at - np.einsum("mga,ma->mg", inverse, miss)
    slope = np.einsum("mg,mga->ma", along[..., 2], inverse)
    bent = [weights.curvatures(slab[..., a]) for a in range(3)]
    curvature = bent[2] - slope[:, :1, None] * bent[0] - slope[:, 1:, None] * bent[1]
    height = interface.mean(weights.value(slab[..., 2]))
    return Slip(interface, at, weights, slope, inverse, curvature, height)


def settle(interface: Interface, undeformed: Floats, moved: Floats, closed: Bools, guess: Slip | None) -> Slip:
    """Put the probe's closed nodes onto the slab's surface, in place; return where they stand."""
    found = slip(interface, undeformed + moved, guess)
    lift = found.height - (undeformed + moved)[interface.probe, 2]
    moved[interface.probe, 2] += np.where(closed, lift, 0.0)
    return found
