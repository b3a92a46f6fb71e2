"""Topology of the hexahedra: fixed per resolution and symmetry, in logical coordinates.

The slab is a tensor grid in which a box around the inclusion is replaced by an O-grid (a cubed sphere: a
small central cube, shells out to the inclusion, shells on to the box). In *logical* coordinates each shell is
a concentric cube about the origin; `fem.mesh` carries logical to real ones. A symmetry plane x = 0 or y = 0
halves the body: only the positive side is meshed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from skfem import MeshHex, MeshHex2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Resolution:
    """Cells along each part of the mesh."""

    arc: int  # along 45 degrees of the inclusion = along half an edge of the box
    core: int  # shells between the central cube and the inclusion; 0: plain tissue, a grid without an O-grid
    shell: int  # shells between the inclusion and the box; of plain tissue, layers of half the box
    above: int  # layers between the contact surface and the box
    below: int  # layers between the box and the chest wall
    edge: int  # between the box and the probe's edge
    side: int  # between the probe's edge and the slab's side
    layer: int  # through the probe's contact layer
    backing: int  # through each of its other layers
    growth: tuple[float, float] = (1.0, 1.6)  # of cells from the box to the probe's edge, and beyond it

    @property
    def rim(self) -> int:
        """Logical radius of the inclusion."""
        return self.arc + self.core

    @property
    def reach(self) -> int:
        """Logical radius of the box."""
        return self.arc + self.core + self.shell


@dataclass(frozen=True)
class Layout:
    """What decides the topology: resolution, number of the probe's layers, symmetry about x = 0 and y = 0."""

    res: Resolution
    layers: int
    symmetric: tuple[bool, bool] = (True, True)


def _grid(x: Floats, y: Floats, z: Floats) -> tuple[Floats, Ints]:
    """Tensor grid: points (3, n) and hexahedra (8, m) in scikit-fem's order of corners."""
    mesh = MeshHex.init_tensor(x, y, z)
    return mesh.p, mesh.t.astype(np.int64)


def _merge(parts: list[tuple[Floats, Ints]]) -> MeshHex:
    """Join grids at coincident logical points."""
    points = np.hstack([p for p, _ in parts])
    shift = np.cumsum([0] + [p.shape[1] for p, _ in parts])
    cells = np.hstack([t + s for (_, t), s in zip(parts, shift, strict=False)])
    _, first, inverse = np.unique(np.round(points, 9), axis=1, return_index=True, return_inverse=True)
    cells = inverse.reshape(-1)[cells]
    a, b, c, d = (points[:, first][:, cells[i]] for i in (0, 3, 2, 1))  # corner and its x, y, z neighbours
    volume = np.einsum("ik,ik->k", b - a, np.cross(c - a, d - a, axis=0))
    flipped = volume < 0  # mirror the left-handed ones in their own first axis
    cells[:, flipped] = cells[[3, 5, 6, 0, 7, 1, 2, 4]][:, flipped]
    return MeshHex(np.ascontiguousarray(points[:, first]), np.ascontiguousarray(cells))


def _both_sides(positive: Floats) -> Floats:
    """Lines 0 ... x extended to -x ... x."""
    return np.concatenate([-positive[:0:-1], positive])


def _lateral(layout: Layout, cells: int) -> tuple[Floats, Floats]:
    """Logical grid lines along x and y: the box's, then `cells` beyond it."""
    res = layout.res
    face = res.reach * np.arange(res.arc + 1) / res.arc
    lines = np.concatenate([face, res.reach + 1.0 + np.arange(cells)])
    x, y = (lines if half else _both_sides(lines) for half in layout.symmetric)
    return x, y


@lru_cache(maxsize=16)
def slab_topology(layout: Layout) -> MeshHex2:
    """Slab in logical coordinates; the inclusion is the cube |x|, |y|, |z| <= rim about the origin."""
    res = layout.res
    n, reach = res.arc, res.reach
    layers = n if res.core else res.shell
    half = reach * np.arange(1, layers + 1) / layers
    vertical = np.concatenate(
        [
            -reach - np.arange(res.above, 0, -1.0),
            -half[::-1],
            [0.0],
            half,
            reach + 1.0 + np.arange(res.below),
        ]
    )
    points, cells = _grid(*_lateral(layout, res.edge + res.side), vertical)
    if not res.core:
        return MeshHex2.from_mesh(_merge([(points, cells)]))
    middle = points[:, cells].mean(axis=1)
    outside = np.abs(middle).max(axis=0) > reach
    used, cells = np.unique(cells[:, outside], return_inverse=True)
    parts = [(points[:, used], cells.reshape(8, -1))]

    quarter, whole = np.arange(n + 1.0), np.arange(-n, n + 1.0)
    lines = [quarter if layout.symmetric[0] else whole, quarter if layout.symmetric[1] else whole, whole]
    parts.append(_grid(*lines))
    radial = np.arange(n, reach + 1.0)
    for axis in range(3):
        others = [i for i in range(3) if i != axis]
        for sign in (1, -1) if lines[axis] is whole else (1,):
            p, t = _grid(radial, lines[others[0]] / n, lines[others[1]] / n)
            s, pu, pv = p
            q = np.empty_like(p)
            q[axis], q[others[0]], q[others[1]] = sign * s, s * pu, s * pv
            parts.append((q, t))
    return MeshHex2.from_mesh(_merge(parts))


@lru_cache(maxsize=16)
def probe_topology(layout: Layout) -> MeshHex2:
    """Probe in logical coordinates: the slab's footprint lines, and z from -(layers) at the glass to 0."""
    res = layout.res
    counts = [res.layer] + [res.backing] * (layout.layers - 1)
    vertical = np.unique(np.concatenate([-i - np.arange(c + 1) / c for i, c in enumerate(counts)]))
    return MeshHex2.from_mesh(_merge([_grid(*_lateral(layout, res.edge), vertical)]))


@lru_cache(maxsize=16)
def materials(layout: Layout) -> Ints:
    """Material of each element, the slab's first: 0 tissue, 1 inclusion, 2, 3, ... layers from the contact
    side."""
    slab, probe = slab_topology(layout), probe_topology(layout)
    level = np.abs(slab.p[:, slab.t].mean(axis=1)).max(axis=0)
    tissue = np.asarray(level < layout.res.rim, dtype=np.int64)
    layers = 2 + np.floor(-probe.p[2, probe.t].mean(axis=0)).astype(np.int64)
    return np.concatenate([tissue, layers])
