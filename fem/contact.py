"""Frictionless contact of two surfaces that share a grid of nodes, pair by pair.

The slab's mesh follows the slip (`fem.path`), so that each node of the probe stays close to its partner, and
what is left of the slip, s = (x, y)_probe - (x, y)_slab, is small against a face. With the slope G = dz/d(x, y)
of the common surface, the probe's node is on the slab's surface if

    z_probe = z_slab + G . s                                                                        (1)

whose virtual work hands on the force of a pair along the normal (-G, 1): nothing holds it back along the
surface. G is recovered from the probe's deformed face and held fixed while equilibrium is found; then it is
taken anew until it stays (Wriggers 2006, section 6.3; [wriggers2006]). So each equilibrium is that of two
elastic bodies under linear ties, with an energy and a symmetric tangent. A pair is closed with a force >= 0, or open
with a gap z_slab + G . s - z_probe >= 0 (Signorini's conditions). In small strain G is 0.
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
class Interface:
    """The pairs of nodes on a grid (nx, ny) over the footprint."""

    slab: Ints
    probe: Ints
    along_x: Floats  # recovery matrix (nx, nx)
    along_y: Floats  # (ny, ny)
    symmetric: tuple[bool, bool]  # whether the first line is on a symmetry plane

    def derivatives(self, place: Floats) -> Floats:
        """Derivatives of places (nx, ny, 3) along the undeformed x and y, (nx, ny, 2, 3)."""
        dx, dy = np.tensordot(self.along_x, place, 1), np.einsum("jk,ikc->ijc", self.along_y, place)
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

    def slip(self, place: Floats) -> Floats:
        """s at places (nodes, 3), (nx, ny, 2) mm."""
        return np.asarray((place[self.probe] - place[self.slab])[..., :2])

    def height(self, place: Floats, slope: Floats) -> Floats:
        """Right side of (1) at places (nodes, 3) or for a change of them, (nx, ny) mm."""
        return np.asarray(place[self.slab, 2] + (slope * self.slip(place)).sum(axis=-1))

    def gap(self, place: Floats, slope: Floats) -> Floats:
        """Distance along z between the surfaces, (nx, ny) mm; negative where they overlap."""
        return self.height(place, slope) - place[self.probe, 2]

    def hand_on(self, forces: Floats, normal: Floats, slope: Floats) -> Floats:
        """Forces (nodes, 3) with those `normal` (nx, ny) along z on the probe's nodes handed on through (1)."""
        out = forces.copy()
        out[self.probe, 2] -= normal
        out[self.slab, 2] += normal
        side = slope * normal[..., None]
        out[self.probe, :2] += side
        out[self.slab, :2] -= side
        return out

    def nodal(self, slope: Floats, nodes: int) -> Floats:
        """Slope at the pairs' nodes of both bodies, 0 at others; (nodes, 2)."""
        out = np.zeros((nodes, 2))
        out[self.slab] = out[self.probe] = slope
        return out
