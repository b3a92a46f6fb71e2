"""Rays from an LED's disc to points of the contact surface: the two families that `direct` gathers.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import floats
from .build import led_frame
from .lamp import Patterns
from .sensor import Sensor
from .stack import Leg, Way, risen, steepness

_NEWTON_STEPS = 7  # from a guess
_LEAST_MM = 1e-3  # of the height in the entered layer: where a disc's point lies in another, no light enters


@dataclass(frozen=True)
class _Path:
    """A ray from an LED's disc, and how its landing point moves with its two slopes (y, z per unit of axis).

    Snell's law keeps the tangential components p of (index x direction) through every flat face, so one ray
    is two numbers.
    """

    p_y: mi.Float
    p_z: mi.Float
    p_x: mi.Float  # along the LED's axis, inside the guide: no horizontal face changes it
    entry_y: mi.Float  # from the disc's point to where the ray enters the guide
    entry_z: mi.Float
    error: mi.Vector2f  # landing point minus target: along the axis, along the side
    derivative: tuple[mi.Float, mi.Float, mi.Float, mi.Float]  # of the landing point: x_y, x_z, y_y, y_z
    etendue: mi.Float  # dp_y dp_z per area of horizontal target plane
    lengths: tuple[mi.Float, ...]  # mm, in the entered layer and on each leg


@dataclass(frozen=True)
class Source:
    """The LED of each lane, in its own frame: axis into the guide, along its side, up; and one of the guide's
    layers, for the light that enters or is born there."""

    layer: int
    number: mi.UInt32
    patterns: Patterns
    axis_x: mi.Float
    axis_y: mi.Float
    along: mi.Float
    z: mi.Float
    gap: mi.Float  # air between disc and face, 0 if embedded
    inset: mi.Float  # guide between face and disc, 0 if in air
    index: mi.Float
    radius: mi.Float
    window: mi.Float
    density: mi.Float  # F / (pi m²), W: the disc's area cancels against its mean over points

    @staticmethod
    def of(sensor: Sensor, led: mi.UInt32, layer: int = 0) -> Source:
        half, n = sensor.guide.width_mm / 2, sensor.guide.layers[layer][1]
        rows = []
        for lamp in sensor.leds:
            _, axis, _ = led_frame(lamp, half)
            in_air = lamp.coupling == "air"
            medium = 1.0 if in_air else n
            gap, inset = (lamp.gap_mm, 0.0) if in_air else (0.0, lamp.gap_mm)
            density = lamp.flux_W / (np.pi * medium**2)
            rows.append(
                [
                    axis[0],
                    axis[1],
                    lamp.along_mm,
                    lamp.z_mm,
                    gap,
                    inset,
                    medium,
                    lamp.diameter_mm / 2,
                    lamp.window_mm,
                    density,
                ]
            )
        columns = (dr.gather(mi.Float, floats(column), led) for column in np.array(rows).T)
        return Source(layer, led, Patterns(sensor.leds), *columns)


def first_guess(
    sensor: Sensor, source: Source, on_disc: mi.Point2f, here: list[mi.Float], by_glass: bool
) -> mi.Vector2f:
    """Slopes of the ray from a point of the disc, from those that a vanishing air gap would give."""
    way = _way(sensor, source, on_disc, here, by_glass)
    way = replace(way, along_axis=dr.maximum(way.along_axis, 1e-3))
    slope = _without_gap(sensor, source, way)
    for _ in range(_NEWTON_STEPS):
        slope = _stepped(_follow(source, way, slope), slope)
    return slope


def _without_gap(sensor: Sensor, source: Source, way: Way) -> mi.Vector2f:
    """Slopes at the disc of the ray that would come to the target if there were no air gap."""
    way = replace(way, along_axis=dr.maximum(way.along_axis, 1e-3))
    up = steepness(way) if sensor.guide.lower else way.up
    sine_y, sine_z = way.along_side / way.along_axis, up / way.along_axis
    scale = way.index * dr.rsqrt(1.0 + dr.square(sine_y) + dr.square(sine_z))
    tangential = dr.sqrt(dr.square(sine_y) + dr.square(sine_z)) * scale
    allowed = dr.minimum(1.0, 0.98 * source.index / dr.maximum(tangential, 1e-6))
    p_y, p_z = sine_y * scale * allowed, sine_z * scale * allowed
    p_x = dr.sqrt(dr.maximum(dr.square(source.index) - dr.square(p_y) - dr.square(p_z), 1e-6))
    return mi.Vector2f(p_y / p_x, p_z / p_x)


def _way(sensor: Sensor, source: Source, on_disc: mi.Point2f, here: list[mi.Float], by_glass: bool) -> Way:
    """From a point of the disc to the target."""
    x, y, height, _, _ = here
    guide, glass = sensor.guide, sensor.glass
    side_y, disc_z = source.along + source.radius * on_disc.x, source.z + source.radius * on_disc.y
    # the tangent of `led_frame` is (|axis_y|, |axis_x|)
    along_axis = x * source.axis_x + y * source.axis_y + guide.width_mm / 2 - source.inset
    along_side = x * dr.abs(source.axis_y) + y * dr.abs(source.axis_x) - side_y
    layers, floors, own = guide.layers, guide.floors_mm, source.layer
    roof = height if own == 0 else floors[own - 1]
    up = disc_z - floors[own] if by_glass else roof - disc_z
    up = dr.maximum(up, _LEAST_MM) if guide.lower else up
    up = up + (roof - floors[own]) if by_glass else up
    legs = [Leg(layers[k][1], height - floors[0] if k == 0 else layers[k][0]) for k in range(own)]
    if by_glass:
        legs += [Leg(index, 2.0 * thickness) for thickness, index in layers[own + 1 :]]
        legs.append(Leg(glass.refractive_index, 2.0 * glass.thickness_mm))
    return Way(along_axis, along_side, up, layers[own][1], tuple(legs))


def _stepped(path: _Path, slope: mi.Vector2f) -> mi.Vector2f:
    """One step of Newton's method; upwards stays upwards."""
    x_y, x_z, y_y, y_z = path.derivative
    determinant = x_y * y_z - x_z * y_y
    t_y = slope.x - (y_z * path.error.x - x_z * path.error.y) / determinant
    t_z = slope.y - (x_y * path.error.y - y_y * path.error.x) / determinant
    return mi.Vector2f(t_y, dr.maximum(t_z, 0.25 * slope.y))


def _foretold(path: _Path, slope: mi.Vector2f, move: mi.Vector2f, by_glass: bool) -> mi.Vector2f:
    """Slopes of the ray to the same target from a point of the disc so far along the side and up, to first
    order."""
    rise = (move.y if by_glass else -move.y) / path.p_z
    moved = mi.Vector2f(path.error.x + path.p_x * rise, path.error.y + path.p_y * rise + move.x)
    return _stepped(replace(path, error=moved), slope)


def arrives(
    sensor: Sensor,
    source: Source,
    on_disc: mi.Point2f,
    here: list[mi.Float],
    by_glass: bool,
    begin: mi.Vector2f,
    onwards: mi.Vector2f,
    steps: int,
) -> tuple[mi.Float, tuple[mi.Float, ...], mi.Vector2f]:
    """Irradiance, W/mm², at the targets from one point of each disc; the cosine of incidence there and the
    direction's part along the surface, in x and y; and what the ray's slopes will be from the next point, so
    far ``onwards``. They are found in so many steps of Newton's method from what the point before foretold.
    """
    slope_x, slope_y = here[3:]
    guide, glass = sensor.guide, sensor.glass
    half, layers, floors = guide.width_mm / 2, guide.layers, guide.floors_mm
    way = _way(sensor, source, on_disc, here, by_glass)
    side_y, disc_z = source.along + source.radius * on_disc.x, source.z + source.radius * on_disc.y
    lit = way.along_axis > 1e-3
    slope = begin
    if guide.lower:
        slope = dr.select(dr.isfinite(begin.x), begin, _without_gap(sensor, source, way))
    for _ in range(steps):
        slope = _stepped(_follow(source, way, slope), slope)
    path = _follow(source, way, slope)

    lands = dr.abs(path.error.x) + dr.abs(path.error.y) < 1e-2
    lit &= lands
    entry_z = disc_z - path.entry_z if by_glass else disc_z + path.entry_z
    lit &= (entry_z > floors[source.layer]) & (dr.abs(side_y + path.entry_y) < half)
    if source.layer > 0:
        lit &= entry_z <= floors[source.layer - 1]
    if guide.walls != "polished":
        to_window = mi.Vector2f(source.radius * on_disc.x + path.entry_y, source.radius * on_disc.y)
        to_window.y += -path.entry_z if by_glass else path.entry_z
        lit &= (source.gap == 0.0) | (dr.squared_norm(to_window) <= dr.square(source.window))
    tangential2 = dr.square(path.p_y) + dr.square(path.p_z)
    in_air = source.gap > 0.0
    share = dr.select(in_air, 1.0 - _fresnel(mi.Float(1.0), mi.Float(way.index), tangential2), 1.0)
    level2 = dr.square(path.p_x) + dr.square(path.p_y)
    if by_glass:
        n, n_glass = guide.bottom_index, glass.refractive_index
        through = 1.0 - _fresnel(mi.Float(n), mi.Float(n_glass), level2)
        share *= dr.square(through) * _fresnel(mi.Float(n_glass), mi.Float(1.0), level2)
    for face, ((_, above), (_, below)) in enumerate(pairwise(layers)):
        through = 1.0 - _fresnel(mi.Float(above), mi.Float(below), level2)
        if face < source.layer:
            share *= through
        elif by_glass:
            share *= dr.square(through)
    if guide.absorption_per_mm > 0.0 or glass.absorption_per_mm > 0.0:
        in_glass = path.lengths[-1] if by_glass else mi.Float(0.0)
        in_guide = sum(path.lengths[1 : -1 if by_glass else None], path.lengths[0])
        share *= dr.exp(-guide.absorption_per_mm * in_guide - glass.absorption_per_mm * in_glass)
    p_up = risen(path.p_z, way.index, guide.refractive_index)
    # the surface's slope turns its normal and lengthens its shadow
    d_x = path.p_x * source.axis_x + path.p_y * dr.abs(source.axis_y)
    d_y = path.p_x * source.axis_y + path.p_y * dr.abs(source.axis_x)
    facing = p_up - d_x * slope_x - d_y * slope_y
    steep = dr.rcp(1.0 + dr.square(slope_x) + dr.square(slope_y))
    cosine = facing * dr.sqrt(steep) / guide.refractive_index
    d_x, d_y = d_x + facing * steep * slope_x, d_y + facing * steep * slope_y
    flux = source.density * path.etendue * share * facing / p_up
    if not source.patterns.lambertian:
        leaving = dr.sqrt(dr.maximum(1.0 - tangential2 / dr.square(source.index), 0.0))
        rises = -path.p_z if by_glass else path.p_z
        flux *= source.patterns.relative(source.number, leaving, path.p_y, rises)
    lit &= facing > 0.0
    next_ = _foretold(path, slope, source.radius * onwards, by_glass)
    lost = mi.Vector2f(dr.nan) if guide.lower else begin
    found = dr.select(lands & dr.isfinite(next_.x + next_.y), next_, lost)
    arriving = tuple(dr.select(lit, value, 1.0) for value in (cosine, d_x, d_y))
    return dr.select(lit, flux, 0.0), arriving, found


def _follow(source: Source, way: Way, slope: mi.Vector2f) -> _Path:
    """A ray from its slopes at the disc to the target's height, with derivatives to the slopes."""
    n = way.index
    t_y, t_z = slope.x, slope.y
    one = 1.0 + dr.square(t_y) + dr.square(t_z)
    c = source.index * dr.rsqrt(one)
    p_y, p_z = t_y * c, t_z * c
    py_y, py_z = c * (1.0 + dr.square(t_z)) / one, -c * t_y * t_z / one
    pz_y, pz_z = py_z, c * (1.0 + dr.square(t_y)) / one
    p_x = dr.sqrt(dr.maximum(n**2 - dr.square(p_y) - dr.square(p_z), 1e-9))
    px_y, px_z = -(p_y * py_y + p_z * pz_y) / p_x, -(p_y * py_z + p_z * pz_z) / p_x

    run = (way.up - source.gap * t_z) / p_z  # length over index, inside the guide
    run_y, run_z = -run * pz_y / p_z, -run * pz_z / p_z - source.gap / p_z
    lengths = [n * run]
    for leg in way.legs:
        g2 = dr.maximum(leg.index**2 - n**2 + dr.square(p_z), 1e-9)
        below = leg.height * dr.rsqrt(g2)
        factor = -below * p_z / g2
        lengths.append(leg.index * below)
        run, run_y, run_z = run + below, run_y + factor * pz_y, run_z + factor * pz_z

    x_y, x_z = px_y * run + p_x * run_y, px_z * run + p_x * run_z
    y_y, y_z = source.gap + py_y * run + p_y * run_y, py_z * run + p_y * run_z
    error = mi.Vector2f(p_x * run - way.along_axis, source.gap * t_y + p_y * run - way.along_side)
    etendue = dr.square(source.index / one) / dr.abs(x_y * y_z - x_z * y_y)
    derivative, entry = (x_y, x_z, y_y, y_z), (source.gap * t_y, source.gap * t_z)
    return _Path(p_y, p_z, p_x, *entry, error, derivative, etendue, tuple(lengths))


def _fresnel(n_in: mi.Float, n_out: mi.Float, tangential2: mi.Float) -> mi.Float:
    """Unpolarised Fresnel reflectance at a squared tangential index, total beyond critical (key born1999)."""
    total = tangential2 >= dr.square(n_out)
    a = dr.sqrt(dr.maximum(dr.square(n_in) - tangential2, 0.0))
    b = dr.sqrt(dr.maximum(dr.square(n_out) - tangential2, 0.0))
    s = (a - b) / dr.maximum(a + b, 1e-12)
    p = (dr.square(n_out) * a - dr.square(n_in) * b) / dr.maximum(
        dr.square(n_out) * a + dr.square(n_in) * b, 1e-12
    )
    return dr.select(total, 1.0, 0.5 * (dr.square(s) + dr.square(p)))
