"""Quadrilaterals of the half section x >= 0: topology fixed per resolution, coordinates that morph.

The plane relative of the hexahedra in `fem.mesh`: the slab is a tensor grid in which a box around the
inclusion is replaced by an O-grid (a small central square, shells out to the inclusion, shells on to the
box). All of it lives first in *logical* coordinates, where each shell is a concentric square, and `morph`
carries logical to real ones, x (or the radius) along the first axis and z along the second, mm.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from skfem import ElementQuad2, MeshQuad, MeshQuad2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Cells:
    """Cells along each part of the mesh."""

    arc: int  # along 45 degrees of the inclusion = along half an edge of the box
    core: int  # shells between the central square and the inclusion
    shell: int  # shells between the inclusion and the box
    above: int  # layers between the contact surface and the box
    below: int  # layers between the box and the chest wall
    edge: int  # between the box and the probe's edge, graded towards the edge
    side: int  # between the probe's edge and the slab's side, graded towards the edge
    layer: int  # through the probe's contact layer
    backing: int  # through each of its other layers

    @property
    def rim(self) -> int:
        """Logical radius of the inclusion."""
        return self.arc + self.core

    @property
    def reach(self) -> int:
        """Logical radius of the box."""
        return self.arc + self.core + self.shell


# Largest error of tared maximum, tared total and force against 32 thousand unknowns, both kinds, flat and
# domed (R = 200 mm), for (size, depth, modulus) = (10, 5, 100), (4, 6, 60), (13, 4, 120), (5, 12, 40),
# (8, 8, 80), (4, 12, 40): preview 0.8, 1.0, 0.2 %; standard 0.13, 0.5, 0.13 %; reference 0.06, 0.25, 0.05 %.
QUALITIES = {
    "preview": Cells(arc=4, core=1, shell=4, above=3, below=3, edge=5, side=5, layer=3, backing=1),
    "standard": Cells(arc=6, core=2, shell=5, above=4, below=4, edge=7, side=6, layer=4, backing=2),
    "reference": Cells(arc=10, core=3, shell=8, above=6, below=6, edge=12, side=10, layer=6, backing=3),
}


_SHRINK = 1.7  # ratio of neighbouring cells towards the singularity at the probe's edge


@dataclass(frozen=True)
class Section:
    """Geometry of a half section, mm: everything that `morph` needs, whatever nouns it came from."""

    half_probe: float
    half_slab: float
    thickness: float
    layers: tuple[float, ...]  # thicknesses from the contact side
    dome: float | None  # radius of the contact surface; None if flat
    ball: tuple[float, float]  # half diameters of the inclusion along x and z
    centre: float  # its depth

    def sag(self, x: Floats) -> Floats:
        """How far the contact surface lies below its apex at x; same shape."""
        if self.dome is None:
            return np.zeros_like(x)
        # x² / (R + sqrt(R² - x²)) = R - sqrt(R² - x²) without cancellation
        return np.asarray(x**2 / (self.dome + np.sqrt(self.dome**2 - x**2)))


def graded(cells: int, ratio: float) -> Floats:
    """Breakpoints of [0, 1] in `cells` cells, each `ratio` times the one before; shape (cells + 1,)."""
    lengths = ratio ** np.arange(cells)
    return np.concatenate([[0.0], np.cumsum(lengths) / lengths.sum()])


def growing(cells: int, first: float, length: float) -> Floats:
    """Breakpoints of [0, length] in cells that grow geometrically from about `first`; shape (cells + 1,).

    The first cell is `first` as long as that leaves ratios within 1 / 2 ... 4; smooth in both lengths.
    """
    low, high = 0.5, 4.0
    for _ in range(60):
        ratio = (low * high) ** 0.5
        if first * (ratio ** np.arange(cells)).sum() < length:
            low = ratio
        else:
            high = ratio
    return length * graded(cells, (low * high) ** 0.5)


# --- topology, in logical coordinates ---------------------------------------------------------------------


def _grid(x: Floats, z: Floats) -> tuple[Floats, Ints]:
    """Tensor grid: points (2, n) and quadrilaterals (4, m)."""
    mesh = MeshQuad.init_tensor(x, z)
    return mesh.p, mesh.t.astype(np.int64)


def _merge(parts: list[tuple[Floats, Ints]]) -> MeshQuad2:
    """Join grids at coincident logical points, corners counter-clockwise, with all Q2 nodes."""
    points = np.hstack([p for p, _ in parts])
    shift = np.cumsum([0] + [p.shape[1] for p, _ in parts])
    cells = np.hstack([t + s for (_, t), s in zip(parts, shift, strict=False)])
    _, first, inverse = np.unique(np.round(points, 9), axis=1, return_index=True, return_inverse=True)
    cells = inverse.reshape(-1)[cells]
    points = points[:, first]
    a, b, d = (points[:, cells[i]] for i in (0, 1, 3))
    clockwise = (b - a)[0] * (d - a)[1] < (b - a)[1] * (d - a)[0]
    cells[:, clockwise] = cells[[0, 3, 2, 1]][:, clockwise]
    return MeshQuad2.from_mesh(MeshQuad(np.ascontiguousarray(points), np.ascontiguousarray(cells)))


@lru_cache(maxsize=8)
def slab_topology(res: Cells) -> MeshQuad2:
    """Slab in logical coordinates; the inclusion is the square |x|, |z| <= rim about the origin."""
    n, reach = res.arc, res.reach
    face = reach * np.arange(n + 1) / n
    lateral = np.concatenate([face, reach + 1.0 + np.arange(res.edge + res.side)])
    vertical = np.concatenate(
        [-reach - np.arange(res.above, 0, -1.0), -face[:0:-1], face, reach + 1.0 + np.arange(res.below)]
    )
    points, cells = _grid(lateral, vertical)
    outside = np.abs(points[:, cells].mean(axis=1)).max(axis=0) > reach
    used, cells = np.unique(cells[:, outside], return_inverse=True)
    half, whole = np.arange(n + 1.0), np.arange(-n, n + 1.0)
    parts = [(points[:, used], cells.reshape(4, -1)), _grid(half, whole)]
    radial = np.arange(n, reach + 1.0)
    p, t = _grid(radial, whole / n)
    parts.append((np.stack([p[0], p[0] * p[1]]), t))
    p, t = _grid(radial, half / n)
    parts += [(np.stack([p[0] * p[1], sign * p[0]]), t) for sign in (1, -1)]
    return _merge(parts)


@lru_cache(maxsize=8)
def probe_topology(res: Cells, layers: int) -> MeshQuad2:
    """Probe in logical coordinates: the slab's footprint lines, and z from -(layers) at the glass to 0."""
    n, reach = res.arc, res.reach
    lateral = np.concatenate([reach * np.arange(n + 1) / n, reach + 1.0 + np.arange(res.edge)])
    counts = [res.layer] + [res.backing] * (layers - 1)
    vertical = np.unique(np.concatenate([-i - np.arange(c + 1) / c for i, c in enumerate(counts)]))
    return _merge([_grid(lateral, vertical)])


def slab_materials(res: Cells) -> Ints:
    """Material of each slab element: 1 in the inclusion, else 0; shape (elements,)."""
    logical = slab_topology(res)
    level = np.abs(logical.p[:, logical.t].mean(axis=1)).max(axis=0)
    return np.asarray(level < res.rim, dtype=np.int64)


def probe_materials(res: Cells, layers: int) -> Ints:
    """Material of each probe element: 2 for the contact layer, 3 for the next, ...; shape (elements,)."""
    logical = probe_topology(res, layers)
    return np.asarray(2 + np.floor(-logical.p[1, logical.t].mean(axis=0)), dtype=np.int64)


# --- from logical to real coordinates ---------------------------------------------------------------------


@dataclass(frozen=True)
class _Box:
    """The O-grid's half width, top and bottom, mm."""

    half: float
    top: float
    bottom: float


def _box(section: Section) -> _Box:
    """Every gap is a smooth function of the geometry, and stays in slab and footprint."""

    def gap(radius: float, room: float) -> float:
        # a smooth minimum of the wish and 60 % of the room
        return float(((1.5 + 0.8 * radius) ** -4 + (0.6 * room) ** -4) ** -0.25)

    (a, c), centre = section.ball, section.centre
    return _Box(
        half=a + gap(a, section.half_probe - a),
        top=centre - c - gap(c, centre - c),
        bottom=centre + c + gap(c, section.thickness - centre - c),
    )


def _lateral(logical: Floats, res: Cells, section: Section, box: _Box) -> Floats:
    """x of grid lines: even in the box, shrinking to the probe's edge, then growing to the side."""
    w, s = section.half_probe, section.half_slab
    inner = w - (w - box.half) * graded(res.edge, _SHRINK)[::-1]
    outer = w + growing(res.side, inner[-1] - inner[-2], s - w) if res.side else np.array([w])
    real = np.concatenate([[0.0], inner, outer[1:]])
    knots = np.concatenate([[0.0], res.reach + np.arange(res.edge + res.side + 1.0)])
    return np.asarray(np.interp(logical, knots, real))


def morph_slab(res: Cells, section: Section) -> MeshQuad2:
    """The slab's mesh in real coordinates (mm), its curved elements following the inclusion.

    Raises
    ------
    ValueError
        If an element turns inside out.
    """
    logical, box = slab_topology(res), _box(section)
    p, reach = logical.doflocs, res.reach
    knots = np.concatenate(
        [-reach - np.arange(res.above, 0, -1.0), [-reach, 0, reach], reach + 1.0 + np.arange(res.below)]
    )
    cell = (box.bottom - box.top) / (2 * res.arc)
    heights = np.concatenate(
        [
            box.top * np.arange(res.above) / res.above,
            [box.top, section.centre],
            box.bottom + growing(res.below, cell, section.thickness - box.bottom),
        ]
    )
    real = np.stack([_lateral(p[0], res, section, box), np.interp(p[1], knots, heights)])

    inside = np.abs(p).max(axis=0) < reach - 1e-9
    q = p[:, inside]
    level = np.abs(q).max(axis=0)
    q = q / np.maximum(level, res.arc)
    disc = q * np.sqrt(1 - q[::-1] ** 2 / 2)  # the square [-1, 1]² onto the unit disc, sides onto the circle
    radii = np.array(section.ball)[:, None]
    square = 0.55 * radii * (0.5 * q + 0.5 * disc)
    ball = radii * disc
    below = np.where(q[1] < 0, section.centre - box.top, box.bottom - section.centre)
    wall = np.stack([box.half * q[0], below * q[1]])
    core = np.clip((level - res.arc) / res.core, 0, 1)
    shell = np.interp(level, res.rim + np.arange(res.shell + 1.0), graded(res.shell, 1.4))
    local = np.where(
        level <= res.rim + 1e-9, (1 - core) * square + core * ball, (1 - shell) * ball + shell * wall
    )
    local[1] += section.centre
    real[:, inside] = local
    return _checked(MeshQuad2(real, logical.t), "slab")


def morph_probe(res: Cells, section: Section) -> MeshQuad2:
    """The probe's mesh in real coordinates (mm): glass at z = -thickness, contact surface at z = -sag(x)."""
    logical = probe_topology(res, len(section.layers))
    p = logical.doflocs
    depths = -np.cumsum([0.0, *section.layers])
    z = np.interp(p[1], -np.arange(len(depths))[::-1], depths[::-1])
    x = _lateral(p[0], res, section, _box(section))
    z = z - section.sag(x) * np.clip(1 + p[1], 0, 1)  # the dome is cut from the contact layer alone
    return _checked(MeshQuad2(np.stack([x, z]), logical.t), "probe")


def _checked(mesh: MeshQuad2, name: str) -> MeshQuad2:
    """Refuse a mesh with an element whose Jacobian is not positive at every node of its Q2 lattice."""
    det = mesh.mapping().detDF(ElementQuad2.doflocs.T)
    if det.min() <= 0:
        x, z = mesh.p[:, mesh.t[:, int(det.min(axis=1).argmin())]].mean(axis=1)
        raise ValueError(
            f"mesh: received a geometry that turns an element of the {name} inside out "
            f"near x = {x:.2f}, z = {z:.2f} mm; allowed are inclusions with more room around them"
        )
    return mesh
