"""Frictionless contact of two meshes whose nodes meet in pairs.

Both bodies carry the same grid of nine-node faces, and the slab's mesh is moved within its stress-free
surface (`fem.meshed`) until its nodes lie opposite those of the probe *after* they have slid: closed contact
is then conforming, and no force has to be handed on between nodes. That place counts: above an inclusion the
tissue slides outwards under the probe by some 5 % of the indentation. Pairs that kept their first partners
would take the pressure along with them, which adds a tenth to the signal per mm.

Closed contact ties the probe's node to the tangent plane at its partner,

    z_probe - z_slab = G . ((x, y)_probe - (x, y)_slab),                                                 (1)

with a slope G of the face, so that forces act along its normal (-G, 1). G and the slab's mesh are held fixed
while equilibrium is found, then taken anew until they stay (Wriggers 2006, section 6.3; [wriggers2006]):
each equilibrium is that of two elastic bodies under linear ties, with an energy and a symmetric tangent. A
pair is closed with a force >= 0, or open with a gap >= 0 (Signorini's conditions).

G is that by which the tissue's material gains no energy by sliding on (`fem.material_forces`). A slope
recovered from displacements begins; in the cells at the probe's edge, where the face bends sharply under the
largest pressure, it is that of the cell's middle, too flat: tissue slides too little, on finer cells, too.
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
    """The contact nodes of both bodies, each on a grid (nx, ny) over the footprint."""

    slab: Ints
    probe: Ints
    recovery: tuple[Floats, Floats]  # derivatives along x and y at the probe's nodes, (nx, nx) and (ny, ny)
    symmetric: tuple[bool, bool]  # whether the first line is on a symmetry plane

    def derivatives(self, place: Floats) -> Floats:
        """Derivatives of places (nx, ny, 3) along the undeformed x and y, (nx, ny, 2, 3)."""
        dx = np.tensordot(self.recovery[0], place, 1)
        dy = np.einsum("jk,ikc->ijc", self.recovery[1], place)
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

    @property
    def inner(self) -> Bools:
        """Pairs off the faces along the probe's edge, (nx, ny)."""
        x, y = self._outermost(3)
        return np.asarray(~x[:, None] & ~y)

    @property
    def corners(self) -> Bools:
        """Pairs in the faces at the probe's corners, less the lines that they share, (nx, ny)."""
        x, y = self._outermost(2)
        return np.asarray(x[:, None] & y)

    def _outermost(self, count: int) -> tuple[Bools, Bools]:
        """Lines among so many next to the probe's edge, along x (nx,) and y (ny,)."""
        x, y = (
            (np.arange(n) >= n - count) | ((np.arange(n) < count) & (not half))
            for n, half in zip(self.slab.shape, self.symmetric, strict=True)
        )
        return x, y

    def slip(self, place: Floats) -> Floats:
        """How far the probe's nodes lie beside their partners at places (nodes, 3); (nx, ny, 2) mm."""
        return np.asarray((place[self.probe] - place[self.slab])[..., :2])


@dataclass(frozen=True)
class Tie:
    """Equation (1) with slopes held fixed: linear in the places of all nodes."""

    interface: Interface
    slope: Floats  # G, (nx, ny, 2)

    def height(self, place: Floats) -> Floats:
        """z of the probe's nodes by (1) at places (nodes, 3), or for a change of them; (nx, ny) mm."""
        return np.asarray(
            place[self.interface.slab, 2] + (self.slope * self.interface.slip(place)).sum(axis=-1)
        )

    def gap(self, place: Floats) -> Floats:
        """Distance along z between the surfaces, (nx, ny) mm; negative where they overlap."""
        return np.asarray(self.height(place) - place[self.interface.probe, 2])

    def hand_on(self, forces: Floats, normal: Floats) -> Floats:
        """Forces (nodes, 3) with those `normal` (nx, ny) along z on the probe's nodes handed on through
        (1)."""
        out, face = forces.copy(), self.interface
        along = np.concatenate([self.slope, np.full((*normal.shape, 1), -1.0)], axis=-1) * normal[..., None]
        out[face.probe] += along
        out[face.slab] -= along
        return out

    def slopes(self, nodes: int) -> Floats:
        """G at the pairs' nodes of both bodies, 0 at others; (nodes, 2)."""
        out = np.zeros((nodes, 2))
        out[self.interface.slab] = out[self.interface.probe] = self.slope
        return out


def level(interface: Interface) -> Tie:
    """The tie of small strain: pairs have the same z."""
    return Tie(interface, np.zeros((*interface.slab.shape, 2)))
