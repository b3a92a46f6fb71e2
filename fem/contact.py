"""Frictionless contact: where the probe's nodes stand on the slab's surface, and how their forces reach it.

The slab's deformed surface under the probe is a smooth graph: its places (x, y, z) are interpolated from the
nodes of the footprint's grid with cubic Hermite functions whose derivatives are recovered from the quadratic
faces on both sides (order h³, as the elements, but with a normal that does not jump from face to face). A node
of the probe, wherever it has slid to, is on that surface if

    z_probe = z(xi),    (x, y)(xi) = (x, y)_probe.                                                   (1)

With a(xi) the weights of the slab's nodes j there and G = dz/d(x, y) the slope, the variation of (1) is

    dz_probe = sum_j a_j (dz_j - G . d(x, y)_j) + G . d(x, y)_probe                                  (2)

whose transpose hands on the forces: along the normal (-G, 1), at the very place of contact. The pair is closed
with a force lambda >= 0, or open with a gap z(xi) - z_probe >= 0 (Signorini's conditions: Wriggers 2006,
section 2.2; [wriggers2006]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def recovery(lines: Floats) -> Floats:
    """Matrix (n, n) of the derivative at the nodes of a line of quadratic elements, the mean of both sides
    at shared nodes; lines (n,) are the nodes, n odd."""
    local = np.array([[-3.0, 4.0, -1.0], [-1.0, 0.0, 1.0], [1.0, -4.0, 3.0]])
    matrix, count = np.zeros((len(lines), len(lines))), np.zeros(len(lines))
    for i in range(0, len(lines) - 2, 2):
        matrix[i : i + 3, i : i + 3] += local / (lines[i + 2] - lines[i])
        count[i : i + 3] += 1
    return matrix / count[:, None]


@dataclass(frozen=True)
class Line:
    """Hermite interpolation along one axis of the grid; `even` for fields that a symmetry plane at the first
    node mirrors, `odd` for those that it turns round."""

    nodes: Floats  # (n,) undeformed, mm
    even: Floats  # recovery matrices (n, n)
    odd: Floats

    def rows(self, at: Floats, odd: bool) -> tuple[Floats, Floats, Floats]:
        """Weights of the nodes' values, of their first and second derivative at places (m,); each (m, n)."""
        slope = self.odd if odd else self.even
        k = np.clip(np.searchsorted(self.nodes, at, side="right") - 1, 0, len(self.nodes) - 2)
        step = self.nodes[k + 1] - self.nodes[k]
        t = ((at - self.nodes[k]) / step)[:, None]
        h, eye = step[:, None], np.eye(len(self.nodes))
        value = (
            (1 + 2 * t) * (1 - t) ** 2 * eye[k]
            + t**2 * (3 - 2 * t) * eye[k + 1]
            + h * (t * (1 - t) ** 2 * slope[k] + t**2 * (t - 1) * slope[k + 1])
        )
        derivative = (
            6 * t * (1 - t) / h * (eye[k + 1] - eye[k])
            + (1 - t) * (1 - 3 * t) * slope[k]
            + t * (3 * t - 2) * slope[k + 1]
        )
        second = (
            (6 - 12 * t) / h**2 * (eye[k + 1] - eye[k])
            + (6 * t - 4) / h * slope[k]
            + (6 * t - 2) / h * slope[k + 1]
        )
        return value, derivative, second


def line(nodes: Floats, symmetric: bool) -> Line:
    """Prepare a line of nodes (n,); `symmetric` if the first is on a symmetry plane."""
    odd = recovery(nodes)
    even = odd.copy()
    if symmetric:
        even[0] = 0.0
    return Line(nodes, even, odd)


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
    """The contact nodes of both bodies, each on a grid (nx, ny) over the footprint."""

    slab: Ints
    probe: Ints
    x: Line
    y: Line

    def weights(self, at: Floats) -> list[Weights]:
        """Weights of the fields x, y, z at grid places (m, 2)."""
        parities = ((True, False), (False, True), (False, False))
        return [Weights(self.x.rows(at[:, 0], i), self.y.rows(at[:, 1], j)) for i, j in parities]


@dataclass(frozen=True)
class Slip:
    """Where the probe's nodes (m in all) stand on the slab's surface."""

    interface: Interface
    at: Floats  # on the grid, (m, 2)
    weights: list[Weights]  # of the fields x, y, z
    slope: Floats  # G (m, 2)
    inverse: Floats  # derivative of grid places by (x, y), (m, 2 grid, 2 axes)
    curvature: Floats  # of the surface above its tangent plane, along the grid, (m, 2, 2)
    height: Floats  # z(xi), (nx, ny) mm

    def moved(self, change: Floats) -> Floats:
        """Change of z(xi) at the probe's nodes by a change of displacements (nodes, 3): equation (2); (nx, ny)."""
        slab, probe = change[self.interface.slab], change[self.interface.probe].reshape(-1, 3)
        at = [w.value(slab[..., a]) for a, w in enumerate(self.weights)]
        x, y = (probe[:, a] - at[a] for a in (0, 1))
        return np.asarray(at[2] + self.slope[:, 0] * x + self.slope[:, 1] * y).reshape(self.height.shape)

    def push(self, force: Floats, out: Floats) -> None:
        """Transpose of `moved`: add the forces (nx, ny) that act through it to `out` (nodes, 3)."""
        flat = force.ravel()
        out[self.interface.slab, 2] += self.weights[2].spread(flat)
        for a in (0, 1):
            side = self.slope[:, a] * flat
            out[self.interface.probe, a] += side.reshape(force.shape)
            out[self.interface.slab, a] -= self.weights[a].spread(side)

    def stiffen(self, change: Floats, force: Floats, out: Floats) -> None:
        """Add the change of `push(force)` by a change of displacements."""
        slab, probe = change[self.interface.slab], change[self.interface.probe].reshape(-1, 3)
        flat = force.reshape(-1, 1)
        apart = np.stack([probe[:, a] - self.weights[a].value(slab[..., a]) for a in (0, 1)], axis=1)
        slid = np.einsum("mga,ma->mg", self.inverse, apart)
        along = [w.slopes(slab[..., a]) for a, w in enumerate(self.weights)]
        turned = along[2] - self.slope[:, :1] * along[0] - self.slope[:, 1:] * along[1]
        turned += np.einsum("mgh,mh->mg", self.curvature, slid)
        tilt = np.einsum("mg,mga->ma", turned, self.inverse) * flat
        slid *= flat
        out[self.interface.slab, 2] += self.weights[2].spread_slopes(slid)
        for a in (0, 1):
            out[self.interface.probe, a] += tilt[:, a].reshape(force.shape)
            out[self.interface.slab, a] -= self.weights[a].spread(tilt[:, a])
            out[self.interface.slab, a] -= self.weights[a].spread_slopes(slid * self.slope[:, a, None])


def slip(interface: Interface, place: Floats, guess: Slip | None = None) -> Slip:
    """Find where the probe's nodes stand on the slab's surface, both at places (nodes, 3), mm."""
    slab, probe = place[interface.slab], place[interface.probe].reshape(-1, 3)
    if guess is None:
        grid = np.meshgrid(interface.x.nodes, interface.y.nodes, indexing="ij")
        at = np.stack(grid, axis=-1).reshape(-1, 2)
    else:
        at = guess.at
    for _ in range(30):
        weights = interface.weights(at)
        along = np.stack([w.slopes(slab[..., a]) for a, w in enumerate(weights)], axis=2)  # (m, grid, axis)
        inverse = np.linalg.inv(along[..., :2]).swapaxes(1, 2)  # (m, 2 grid, 2 axes)
        miss = np.stack([weights[a].value(slab[..., a]) - probe[:, a] for a in (0, 1)], axis=1)
        if np.abs(miss).max() < 1e-12:
            break
        at = at - np.einsum("mga,ma->mg", inverse, miss)
    slope = np.einsum("mg,mga->ma", along[..., 2], inverse)
    bent = [w.curvatures(slab[..., a]) for a, w in enumerate(weights)]
    curvature = bent[2] - slope[:, :1, None] * bent[0] - slope[:, 1:, None] * bent[1]
    height = weights[2].value(slab[..., 2]).reshape(interface.slab.shape)
    return Slip(interface, at, weights, slope, inverse, curvature, height)


def settle(interface: Interface, undeformed: Floats, moved: Floats, closed: Bools, guess: Slip | None) -> Slip:
    """Put the probe's closed nodes onto the slab's surface, in place; return where they stand."""
    found = slip(interface, undeformed + moved, guess)
    lift = found.height - (undeformed + moved)[interface.probe, 2]
    moved[interface.probe, 2] += np.where(closed, lift, 0.0)
    return found
