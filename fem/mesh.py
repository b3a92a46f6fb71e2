"""Hexahedra that fit the sphere: topology fixed per resolution, coordinates that morph with the geometry.

The slab is a tensor grid in which a box around the inclusion is replaced by an O-grid (a cubed sphere: a
small central cube, shells out to the sphere, shells on to the box). All of it lives first in *logical*
coordinates, where each shell is a concentric cube, and `morph` carries logical to real ones. Sizes, depths
and widths only enter `morph`, so every inclusion shares one topology, and answers vary smoothly with the
geometry.

Only the quarter x >= 0, y >= 0 is meshed; logical x and y may be mirrored to get the other quarters.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHex2, MeshHex, MeshHex2

from fem.model import Inclusion, Probe, Slab

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Resolution:
    """Cells along each part of the mesh."""

    arc: int  # along 45 degrees of the sphere = along half an edge of the box
    core: int  # shells between the central cube and the sphere
    shell: int  # shells between the sphere and the box
    above: int  # layers between the contact surface and the box
    below: int  # layers between the box and the chest wall
    edge: int  # between the box and the probe's edge, graded towards the edge
    side: int  # between the probe's edge and the slab's side, graded towards the edge
    layer: int  # through the probe's contact layer
    backing: int  # through each of its other layers


# Largest error of tared maximum and total against 145 thousand unknowns, for (size, depth, modulus) =
# (10, 5, 100), (4, 6, 60), (13, 4, 120): preview 2 %, standard 0.5 %, reference 0.2 %. Shells outside the
# sphere and cells along its arc matter most.
QUALITIES = {
    "preview": Resolution(arc=3, core=1, shell=3, above=2, below=1, edge=2, side=2, layer=1, backing=1),
    "standard": Resolution(arc=4, core=1, shell=4, above=3, below=2, edge=3, side=4, layer=3, backing=1),
    "reference": Resolution(arc=5, core=2, shell=5, above=3, below=3, edge=4, side=4, layer=3, backing=2),
}


@dataclass(frozen=True)
class Box:
    """The O-grid in real coordinates, mm: sphere radius and centre depth, box half side, top and bottom."""

    radius: float
    centre: float
    half: float
    top: float
    bottom: float


def box_around(inclusion: Inclusion | None, probe: Probe, slab: Slab) -> Box:
    """Place the box; every gap is a smooth function of the geometry and stays in slab and footprint."""
    half_probe = probe.width_mm / 2
    if inclusion is None:  # any sphere will do: its moduli will be the tissue's
        radius = min(0.15 * slab.thickness_mm, 0.3 * half_probe)
        centre = 0.4 * slab.thickness_mm
    else:
        radius, centre = inclusion.size / 2, inclusion.centre_mm
    wish = 1.5 + 0.8 * radius

    def gap(room: float) -> float:
        # a smooth minimum of the wish and 60 % of the room
        return float((wish**-4 + (0.6 * room) ** -4) ** -0.25)

    return Box(
        radius,
        centre,
        half=radius + gap(half_probe - radius),
        top=centre - radius - gap(centre - radius),
        bottom=centre + radius + gap(slab.thickness_mm - centre - radius),
    )


def graded(cells: int, ratio: float) -> Floats:
    """Breakpoints of [0, 1] in `cells` cells, each `ratio` times the one before; shape (cells + 1,)."""
    lengths = ratio ** np.arange(cells)
    return np.concatenate([[0.0], np.cumsum(lengths) / lengths.sum()])


def round_cube(q: Floats) -> Floats:
    """Map the cube [-1, 1]^3 smoothly onto the unit ball, faces onto the sphere; q has shape (3, n)."""
    s = q**2
    return np.stack(
        [
            q[i] * np.sqrt(1 - s[j] / 2 - s[k] / 2 + s[j] * s[k] / 3)
            for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1))
        ]
    )


# --- topology, in logical coordinates ---------------------------------------------------------------------


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


@lru_cache(maxsize=8)
def slab_topology(res: Resolution) -> MeshHex2:
    """Slab in logical coordinates; the inclusion is the cube |x|, |y|, |z| <= arc + core about the origin."""
    n, reach = res.arc, res.arc + res.core + res.shell
    face = reach * np.arange(n + 1) / n
    lateral = np.concatenate([face, reach + 1.0 + np.arange(res.edge + res.side)])
    half = face[1:]
    vertical = np.concatenate(
        [-reach - np.arange(res.above, 0, -1.0), -half[::-1], face, reach + 1.0 + np.arange(res.below)]
    )
    points, cells = _grid(lateral, lateral, vertical)
    middle = points[:, cells].mean(axis=1)
    outside = np.abs(middle).max(axis=0) > reach
    used, cells = np.unique(cells[:, outside], return_inverse=True)
    parts = [(points[:, used], cells.reshape(8, -1))]
    quarter, whole = np.arange(n + 1.0), np.arange(-n, n + 1.0)
    parts.append(_grid(quarter, quarter, whole))
    radial = np.arange(n, reach + 1.0)
    for axis, sign, u, v in (
        (0, 1, quarter, whole),
        (1, 1, quarter, whole),
        (2, 1, quarter, quarter),
        (2, -1, quarter, quarter),
    ):
        p, t = _grid(radial, u / n, v / n)
        s, pu, pv = p
        q = np.empty_like(p)
        others = [i for i in range(3) if i != axis]
        q[axis], q[others[0]], q[others[1]] = sign * s, s * pu, s * pv
        parts.append((q, t))
    return MeshHex2.from_mesh(_merge(parts))


@lru_cache(maxsize=8)
def probe_topology(res: Resolution, layers: int) -> MeshHex2:
    """Probe in logical coordinates: the slab's footprint lines, and z from -(layers) at the glass to 0."""
    n, reach = res.arc, res.arc + res.core + res.shell
    lateral = np.concatenate([reach * np.arange(n + 1) / n, reach + 1.0 + np.arange(res.edge)])
    counts = [res.layer] + [res.backing] * (layers - 1)
    vertical = np.unique(np.concatenate([-i - np.arange(c + 1) / c for i, c in enumerate(counts)]))
    return MeshHex2.from_mesh(_merge([_grid(lateral, lateral, vertical)]))


# --- from logical to real coordinates ---------------------------------------------------------------------


def _lateral(logical: Floats, res: Resolution, box: Box, probe: Probe, slab: Slab) -> Floats:
    """x (or y) of grid lines: even in the box, shrinking to the probe's edge, then growing to the side."""
    reach, w, s = res.arc + res.core + res.shell, probe.width_mm / 2, slab.width_mm / 2
    inner = w - (w - box.half) * graded(res.edge, 1.7)[::-1]
    outer = w + (s - w) * graded(res.side, 2.2)
    real = np.concatenate([[0.0], inner, outer[1:]])
    knots = np.concatenate([[0.0], reach + np.arange(res.edge + res.side + 1.0)])
    return np.asarray(np.interp(logical, knots, real))


def morph_slab(res: Resolution, box: Box, probe: Probe, slab: Slab) -> MeshHex2:
    """The slab's mesh in real coordinates (mm), its curved elements following the sphere.

    Raises
    ------
    ValueError
        If an element turns inside out.
    """
    logical = slab_topology(res)
    p = logical.doflocs
    reach = res.arc + res.core + res.shell
    knots = np.concatenate(
        [-reach - np.arange(res.above, 0, -1.0), [-reach, 0, reach], reach + 1.0 + np.arange(res.below)]
    )
    heights = np.concatenate(
        [
            box.top * np.arange(res.above) / res.above,
            [box.top, box.centre, box.bottom],
            box.bottom + (slab.thickness_mm - box.bottom) * graded(res.below, 1.3)[1:],
        ]
    )
    real = np.stack(
        [*(_lateral(p[i], res, box, probe, slab) for i in (0, 1)), np.interp(p[2], knots, heights)]
    )

    inside = np.abs(p).max(axis=0) < reach - 1e-9
    q = p[:, inside]
    level = np.abs(q).max(axis=0)
    q = q / np.maximum(level, res.arc)
    ball = round_cube(q)
    cube = 0.55 * box.radius * (0.5 * q + 0.5 * ball)
    sphere = box.radius * ball
    wall = np.stack(
        [
            box.half * q[0],
            box.half * q[1],
            np.where(q[2] < 0, box.centre - box.top, box.bottom - box.centre) * q[2],
        ]
    )
    rim = res.arc + res.core
    core = np.clip((level - res.arc) / res.core, 0, 1)
    shell = np.interp(level, rim + np.arange(res.shell + 1.0), graded(res.shell, 1.4))
    local = np.where(
        level <= rim + 1e-9, (1 - core) * cube + core * sphere, (1 - shell) * sphere + shell * wall
    )
    local[2] += box.centre
    real[:, inside] = local
    return _checked(MeshHex2(real, logical.t), "slab")


def morph_probe(res: Resolution, box: Box, probe: Probe, slab: Slab) -> MeshHex2:
    """The probe's mesh in real coordinates (mm), z from -thickness at the glass to 0 in contact."""
    logical = probe_topology(res, len(probe.layers))
    p = logical.doflocs
    depths = -np.cumsum([0.0] + [layer.thickness_mm for layer in probe.layers])
    z = np.interp(p[2], -np.arange(len(depths))[::-1], depths[::-1])
    lateral = [_lateral(p[i], res, box, probe, slab) for i in (0, 1)]
    return _checked(MeshHex2(np.stack([*lateral, z]), logical.t), "probe")


def _checked(mesh: MeshHex2, name: str) -> MeshHex2:
    """Refuse a mesh with an element whose Jacobian is not positive at every node of its Q2 lattice."""
    # scikit-fem's reference hexahedron is point-mirrored: upright ones have a negative determinant
    det = -mesh.mapping().detDF(ElementHex2.doflocs.T)
    if det.min() <= 0:
        cell = int(det.min(axis=1).argmin())
        x, y, z = mesh.p[:, mesh.t[:, cell]].mean(axis=1)
        raise ValueError(
            f"mesh: received a geometry that turns an element of the {name} inside out "
            f"near ({x:.2f}, {y:.2f}, {z:.2f}) mm; allowed are inclusions with more room around them"
        )
    return mesh


def slab_materials(res: Resolution) -> Ints:
    """Material of each slab element: 1 inside the sphere, else 0; shape (elements,)."""
    logical = slab_topology(res)
    level = np.abs(logical.p[:, logical.t].mean(axis=1)).max(axis=0)
    return np.asarray(level < res.arc + res.core, dtype=np.int64)


def probe_materials(res: Resolution, layers: int) -> Ints:
    """Material of each probe element: 2 for the contact layer, 3 for the next, ...; shape (elements,)."""
    logical = probe_topology(res, layers)
    return np.asarray(2 + np.floor(-logical.p[2, logical.t].mean(axis=0)), dtype=np.int64)
