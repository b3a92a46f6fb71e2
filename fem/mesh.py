"""From logical to real coordinates: hexahedra that morph smoothly with the geometry.

Sizes, depths, offsets and widths only enter here, so every inclusion shares one topology (`fem.topology`),
and answers vary smoothly with the geometry. Under the contact surface the grid lines follow the inclusion; on
the surface they stay within the probe's edges, and the layers between shear from one to the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator
from skfem import ElementHex2, MeshHex2

from fem.model import STRAIGHT, Inclusion, NotModelled, Pose, Probe, Slab
from fem.topology import Layout, Resolution, probe_topology, slab_topology

Floats = NDArray[np.float64]

# Largest error of tared maximum and total against 145 thousand unknowns, over (size, depth, modulus) =
# (10, 5, 100), (4, 6, 60), (13, 4, 120), (8, 5, 60), 1 mm of small strain: preview 2.3 %, standard 0.4 %,
# reference 0.2 % (`make bench` prints the table). Shells outside the sphere and cells along its arc matter
# most for these; cells towards the probe's edge for the displacement there. Tared *pressure* is 1.5 to 2.0 %
# too high at its maximum at all three (`pytest -m slow -s tests/test_fem_ripples.py -k nearer`).
QUALITIES = {
    "preview": Resolution(
        arc=3, core=1, shell=3, above=2, below=1, edge=2, side=2, layer=1, backing=1, growth=(2.0, 1.6)
    ),
    "standard": Resolution(arc=4, core=1, shell=4, above=3, below=2, edge=2, side=4, layer=3, backing=1),
    "reference": Resolution(arc=5, core=2, shell=5, above=3, below=3, edge=3, side=4, layer=3, backing=2),
}


@dataclass(frozen=True)
class Geometry:
    """One specimen under one probe."""

    probe: Probe
    slab: Slab
    inclusion: Inclusion | None = None
    pose: Pose = STRAIGHT

    def layout(self, res: Resolution) -> Layout:
        """The topology that the symmetry of this geometry allows; no cells beside a probe as wide as the
        slab."""
        if self.probe.width_mm == self.slab.width_mm:
            res = Resolution(**{**res.__dict__, "side": 0})
        offset = (0.0, 0.0) if self.inclusion is None else self.inclusion.offset
        turned = self.pose.tilt_deg[::-1]  # a turn about y breaks the symmetry in x
        broken = [any((o, p, t)) for o, p, t in zip(offset, self.pose.position_mm, turned, strict=True)]
        return Layout(res, len(self.probe.layers), (not broken[0], not broken[1]))


@dataclass(frozen=True)
class Span:
    """Grid lines along one axis, mm: of the box, of the probe's edge and of the slab's side, at each end."""

    middle: float
    low: float
    high: float
    edge_low: float
    edge_high: float
    side_low: float
    side_high: float

    def lines(self, logical: Floats, res: Resolution) -> Floats:
        """Real coordinate of logical ones: even in the box and on to the probe's edge, whose singular
        corners would tear finer cells apart at finite strain and whose resolution the signal does not feel
        (0.1 %); beyond it coarser outwards."""
        knots = np.concatenate([[0.0], res.reach + np.arange(res.edge + res.side + 1.0)])

        def half(box: float, edge: float, side: float) -> Floats:
            inner = box + (edge - box) * graded(res.edge, res.growth[0])
            outer = edge + (side - edge) * graded(res.side, res.growth[1]) if res.side else np.array([edge])
            return np.concatenate([[self.middle], inner, outer[1:]])

        above = np.interp(logical, knots, half(self.high, self.edge_high, self.side_high))
        below = np.interp(-logical, knots, half(self.low, self.edge_low, self.side_low))
        return np.where(logical < 0, below, above)


@dataclass(frozen=True)
class Box:
    """The O-grid in real coordinates, mm: inclusion's centre and radii; top and bottom; lines of x and y at
    the inclusion and on the contact surface."""

    centre: tuple[float, float, float]
    radii: tuple[float, float, float]
    top: float
    bottom: float
    deep: tuple[Span, Span]
    surface: tuple[Span, Span]


def _smooth_min(*values: float) -> float:
    return float(sum(v**-4 for v in values) ** -0.25)


def _softplus(value: float, width: float) -> float:
    """Smooth max(value, 0)."""
    return 0.5 * (value + float(np.hypot(value, width)))


def box_around(geometry: Geometry) -> Box:
    """Place the box; every gap is a smooth function of the geometry and stays in the slab."""
    probe, slab, inclusion, pose = geometry.probe, geometry.slab, geometry.inclusion, geometry.pose
    half = probe.width_mm / 2
    if inclusion is None:  # any sphere will do: its moduli will be the tissue's
        radius = min(0.15 * slab.thickness_mm, 0.3 * half)
        radii, centre = (radius,) * 3, (0.0, 0.0, 0.4 * slab.thickness_mm)
    else:
        radii, centre = inclusion.radii_mm, (*inclusion.offset, inclusion.centre_mm)

    def gap(radius: float, room: float) -> float:
        # a smooth minimum of the wish and 60 % of the room
        return _smooth_min(1.5 + 0.8 * radius, 0.6 * room)

    spans = [_span(centre[k], radii[k], half, slab.width_mm / 2, pose.position_mm[k]) for k in (0, 1)]
    above, below = centre[2] - radii[2], slab.thickness_mm - centre[2] - radii[2]
    return Box(
        centre=centre,
        radii=radii,
        top=above - gap(radii[2], above),
        bottom=centre[2] + radii[2] + gap(radii[2], below),
        deep=(spans[0][0], spans[1][0]),
        surface=(spans[0][1], spans[1][1]),
    )


def _span(centre: float, radius: float, half: float, side: float, position: float) -> tuple[Span, Span]:
    """Lines along one axis at the inclusion and on the contact surface.

    centre, radius: of the inclusion; half: of the probe; side: half the slab; position: probe minus slab
    centre; all mm.
    """
    wish = 1.5 + 0.8 * radius
    margin = 0.12 * half

    def deep(sign: int) -> tuple[float, float, float]:
        """Outward coordinate of box, probe's edge and slab's side."""
        wall = side - sign * position
        rim = sign * centre + radius
        if side == half:
            return rim + _smooth_min(wish, 0.6 * (wall - rim)), half, wall
        gap = _smooth_min(wish, 0.6 * _softplus(half - rim, 0.1 * half))
        gap = _smooth_min((gap**4 + (0.3 * wish) ** 4) ** 0.25, 0.6 * (wall - rim))
        box = rim + gap
        room = _smooth_min(0.5 * margin, 0.3 * (wall - box))
        return box, half + _softplus(box + room - half, 0.25 * room), wall

    def within(line: float, inset_low: float, inset_high: float) -> float:
        """Pull a line smoothly inside of the probe's edges."""
        over = _softplus(line - (half - inset_high), 0.3 * margin)
        return line - over + _softplus(-(half - inset_low) - line, 0.3 * margin)

    high, edge_high, side_high = deep(1)
    low, edge_low, side_low = (-value for value in deep(-1))
    at_depth = Span(centre, low, high, edge_low, edge_high, side_low, side_high)
    low_s, high_s = within(low, margin, 3 * margin), within(high, 3 * margin, margin)
    middle = low_s + (high_s - low_s) * (centre - low) / (high - low)
    return at_depth, Span(middle, low_s, high_s, -half, half, side_low, side_high)


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


def rotation(tilt_deg: tuple[float, float]) -> Floats:
    """Rotation matrix (3, 3) about x, then y, by angles in degrees."""
    (cx, cy), (sx, sy) = np.cos(np.radians(tilt_deg)), np.sin(np.radians(tilt_deg))
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    return np.asarray(about_y @ about_x)


def morph_slab(layout: Layout, geometry: Geometry, shift: Floats | None = None) -> MeshHex2:
    """The slab's mesh in real coordinates (mm), its curved elements following the inclusion.

    The frame is the probe's: where the probe is tilted, the slab lies turned the other way.

    Parameters
    ----------
    shift
        By how much to move the nodes under the probe's within the slab's surface, (nx, ny, 2) mm. Between the
        surface and the box, and between the probe's edge and the slab's side, it fades out.

    Raises
    ------
    NotModelled
        If an element turns inside out.
    """
    res, box = layout.res, box_around(geometry)
    logical = slab_topology(layout)
    p = logical.doflocs
    knots = np.concatenate(
        [
            -res.reach - np.arange(res.above, 0, -1.0),
            [-res.reach, 0, res.reach],
            res.reach + 1.0 + np.arange(res.below),
        ]
    )
    below = (geometry.slab.thickness_mm - box.bottom) * graded(res.below, 1.3)[1:]
    heights = np.concatenate(
        [box.top * np.arange(res.above) / res.above, [box.top, box.centre[2], box.bottom], box.bottom + below]
    )
    blend = np.clip((p[2] + res.reach + res.above) / res.above, 0, 1)
    real = np.stack(
        [
            *(
                (1 - blend) * box.surface[k].lines(p[k], res) + blend * box.deep[k].lines(p[k], res)
                for k in (0, 1)
            ),
            np.interp(p[2], knots, heights),
        ]
    )
    if shift is not None:
        real[:2] += (1 - blend) * _extended(layout, shift, p)
    if res.core:
        inside = np.abs(p).max(axis=0) < res.reach - 1e-9
        real[:, inside] = _o_grid(p[:, inside], res, box)
    mesh = MeshHex2(rotation(geometry.pose.tilt_deg).T @ real, logical.t)
    return _checked(mesh, "slab")


def _extended(layout: Layout, shift: Floats, logical: Floats) -> Floats:
    """Field (nx, ny, 2) of the footprint's nodes at logical places (3, n), falling to 0 at the slab's side;
    (2, n)."""
    res = layout.res
    side = res.reach + res.edge + res.side
    lines = []
    padding = []
    for symmetric in layout.symmetric:
        half = np.concatenate(
            [
                res.reach * np.arange(2 * res.arc + 1) / (2 * res.arc),
                res.reach + np.arange(1, 2 * res.edge + 1) / 2,
            ]
        )
        # a symmetry plane is no side: the field goes on beyond it
        lines.append(np.concatenate([half if symmetric else _mirrored(half), [side]]))
        if not symmetric:
            lines[-1] = np.concatenate([[-side], lines[-1]])
        padding.append((0 if symmetric else 1, 1))
    padded = np.pad(shift, (*padding, (0, 0)))
    return np.asarray(RegularGridInterpolator(lines, padded)(logical[:2].T).T)


def _mirrored(half: Floats) -> Floats:
    return np.concatenate([-half[:0:-1], half])


def _o_grid(logical: Floats, res: Resolution, box: Box) -> Floats:
    """Real coordinates (3, n) of logical ones within the box."""
    level = np.abs(logical).max(axis=0)
    q = logical / np.maximum(level, res.arc)
    ball = round_cube(q)
    radii = np.reshape(box.radii, (3, 1))
    cube = 0.55 * radii * (0.5 * q + 0.5 * ball)
    inclusion = radii * ball
    ends = [(span.low - span.middle, span.high - span.middle) for span in box.deep]
    ends.append((box.top - box.centre[2], box.bottom - box.centre[2]))
    wall = np.stack([np.where(q[k] < 0, -low, high) * q[k] for k, (low, high) in enumerate(ends)])
    core = np.clip((level - res.arc) / res.core, 0, 1)
    shell = np.interp(level, res.rim + np.arange(res.shell + 1.0), graded(res.shell, 1.4))
    within = (1 - core) * cube + core * inclusion
    without = (1 - shell) * inclusion + shell * wall
    return np.where(level <= res.rim + 1e-9, within, without) + np.reshape(box.centre, (3, 1))


def morph_probe(layout: Layout, geometry: Geometry) -> MeshHex2:
    """The probe's mesh in real coordinates (mm), from z = -thickness at the glass to the contact surface,
    whose middle is the origin; the contact layer takes up the dome."""
    logical, probe, box = probe_topology(layout), geometry.probe, box_around(geometry)
    p = logical.doflocs
    depths = -np.cumsum([0.0] + [layer.thickness_mm for layer in probe.layers])
    z = np.interp(p[2], -np.arange(len(depths))[::-1], depths[::-1])
    x, y = (box.surface[k].lines(p[k], layout.res) for k in (0, 1))
    if probe.dome_radius_mm is not None:
        sag = probe.dome_radius_mm - np.sqrt(probe.dome_radius_mm**2 - x**2 - y**2)
        z = z - sag * np.clip(1 + p[2], 0, 1)
    return _checked(MeshHex2(np.stack([x, y, z]), logical.t), "probe")


def _checked(mesh: MeshHex2, name: str) -> MeshHex2:
    """Refuse a mesh with an element whose Jacobian is not positive at every node of its Q2 lattice."""
    # scikit-fem's reference hexahedron is point-mirrored: upright ones have a negative determinant
    det = -mesh.mapping().detDF(ElementHex2.doflocs.T)
    if det.min() <= 0:
        cell = int(det.min(axis=1).argmin())
        x, y, z = mesh.p[:, mesh.t[:, cell]].mean(axis=1)
        raise NotModelled(
            f"mesh: received a geometry that turns an element of the {name} inside out "
            f"near ({x:.2f}, {y:.2f}, {z:.2f}) mm; allowed are inclusions with more room around them"
        )
    return mesh
