"""LED light that comes to the contact surface straight or by the glass's lower face: gathered, not traced.

These two families of paths carry most of the light and all of its sharp edges (the rims of escape and
acceptance cones), so they are integrated without noise and without smoothing. All other paths are left to
`trace`.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .build import led_frame
from .irradiance import Layered
from .lamp import Patterns
from .sensor import Sensor
from .surface import OpticalSurface, heights

Array = NDArray[np.float64]

CELLS = 200  # of the grid of target points, per side
DISC_POINTS = 96
_NEWTON_STEPS = 7  # from a guess
_NEWTON_AGAIN = 1, 2  # from what the disc's point before foretold, if there are so many points, or fewer
_STRIPES = 9
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


@dataclass(frozen=True)
class _Path:
    """A ray from an LED's disc, and how its landing point moves with its two slopes (y, z per unit of axis).

    Snell's law keeps the tangential components p of (index x direction) through every flat face, so one ray
    is two numbers.
    """

    p_y: mi.Float
    p_z: mi.Float
    p_x: mi.Float  # along the LED's axis, inside the guide
    entry_y: mi.Float  # from the disc's point to where the ray enters the guide
    entry_z: mi.Float
    error: mi.Vector2f  # landing point minus target: along the axis, along the side
    derivative: tuple[mi.Float, mi.Float, mi.Float, mi.Float]  # of the landing point: x_y, x_z, y_y, y_z
    etendue: mi.Float  # dp_y dp_z per area of horizontal target plane
    in_guide: mi.Float  # length, mm
    in_glass: mi.Float


def relief(sensor: Sensor, deformed: OpticalSurface) -> Array:
    """Height (mm) and slopes along x and y of the deformed surface at the targets, (3, CELLS, CELLS)."""
    half = sensor.guide.width_mm / 2
    middles = _middles(half)
    height = heights(deformed, middles)
    slope_y, slope_x = (np.gradient(height, middles, axis=axis) for axis in (0, 1))
    return np.stack([height, slope_x, slope_y])


def direct(sensor: Sensor, basis: Layered, deformed: OpticalSurface) -> Array:
    """Weighted irradiance of the two families, (n_led, layers, CELLS, CELLS), W/mm²; see `on`."""
    return on(sensor, basis, relief(sensor, deformed))


def on(sensor: Sensor, basis: Layered, ground: Array, points: int = DISC_POINTS) -> Array:
    """Weighted irradiance of the two families on a `relief`, (n_led, layers, CELLS, CELLS), W/mm²,
    from so many points of each disc.

    From a disc of flux F and area A in a medium of index m, Lambertian or else with its pattern's factor
    (`lamp.Patterns.relative`), the element dA sends F/(pi A m²) dA
    dp_y dp_z, so the irradiance at a target is that times |d(p_y, p_z)/d(x, y)|, the ray's two unknowns being
    found by Newton's method. Height and slope of the deformed surface at the target are kept; what the other
    LEDs' discs shade is left out.
    """
    n_led = len(sensor.leds)
    here = [number for number, led in enumerate(sensor.leds) if led.side != "below" and led.flux_W > 0.0]
    if len(here) < n_led:  # light from below crosses both faces at once: it is traced
        found = np.zeros((n_led, basis.layers, CELLS, CELLS))
        if here:
            some = replace(sensor, leds=tuple(sensor.leds[number] for number in here))
            found[here] = on(some, basis, ground, points)
        return found
    led, here = _targets(sensor, ground)
    total = _summed(sensor, basis, _Source.of(sensor, led), here, points)
    dr.eval(total)
    return _maps(total, n_led) / points


def answers(
    sensor: Sensor, basis: Layered, ground: Array, change: Change, points: int = DISC_POINTS
) -> Array:
    """Derivative of `on` along a change, (n_led, layers, CELLS, CELLS), W/mm² per unit.

    By Dr.Jit's automatic differentiation, forwards, of the very loop that gathers: discs move as a whole and
    their points with them. The outline of the side face, and of a window in a painted wall, which cut off
    light, stay where they are. LEDs below answer nothing.
    """
    here = [number for number, led in enumerate(sensor.leds) if led.side != "below" and led.flux_W > 0.0]
    found = np.zeros((len(sensor.leds), basis.layers, CELLS, CELLS))
    if not here:
        return found
    some = replace(sensor, leds=tuple(sensor.leds[number] for number in here))
    step = dr.opaque(mi.Float, 0.0)  # a literal would grow in place to the size of what it is multiplied by
    dr.enable_grad(step)
    led, where = _targets(some, ground)
    if change.ground is not None:
        _, moves = _targets(some, change.ground)
        where[2:] = [at + step * move for at, move in zip(where[2:], moves[2:], strict=True)]
    source = _Source.of(some, led)
    moved = {"along": source.along + step * change.along_mm, "z": source.z + step * change.z_mm}
    if change.exponent:
        moved["patterns"] = source.patterns.sharper(step * change.exponent)
    total = _summed(some, basis, replace(source, **moved), where, points)
    dr.forward(step)
    slopes = dr.grad(total)
    dr.eval(slopes)
    found[here] = _maps(slopes, len(here)) / points
    return found


@dataclass(frozen=True)
class Change:
    """What one unit of a parameter changes: the place of every LED along its side and up, mm, and its
    pattern's exponent; `relief` (3, CELLS, CELLS), or None."""

    along_mm: float = 0.0
    z_mm: float = 0.0
    exponent: float = 0.0
    ground: Array | None = None


def _targets(sensor: Sensor, ground: Array) -> tuple[mi.UInt32, list[mi.Float]]:
    """LED of each lane, and what it shines at: x, y and the relief."""
    middles = _middles(sensor.guide.width_mm / 2)
    x, y = np.meshgrid(middles, middles)
    target = [_float(values) for values in (x, y, *ground)]
    index = dr.arange(mi.UInt32, len(sensor.leds) * CELLS * CELLS)
    led, point = index // (CELLS * CELLS), index % (CELLS * CELLS)
    return led, [dr.gather(mi.Float, values, point) for values in target]


def _maps(total: list[mi.Float], n_led: int) -> Array:
    layers = np.stack([np.asarray(layer).reshape(n_led, CELLS, CELLS) for layer in total], axis=1)
    return layers.astype(np.float64)


def _summed(
    sensor: Sensor, basis: Layered, source: _Source, here: list[mi.Float], points: int
) -> list[mi.Float]:
    """Layers of weighted irradiance of each lane's target, summed over the points of its LED's disc."""
    disc = _float(_disc_points(points))
    end, steps = dr.opaque(mi.UInt32, points), _NEWTON_AGAIN[points < DISC_POINTS]
    weights, lanes = basis.weights(), dr.width(source.number)

    def more(number, straight, mirrored, *total):  # type: ignore[no-untyped-def]
        return number < end

    def add(number, straight, mirrored, *total):  # type: ignore[no-untyped-def]
        on_disc = dr.gather(mi.Point2f, disc, number)
        onwards = dr.gather(mi.Point2f, disc, dr.minimum(number + 1, end - 1)) - on_disc
        slopes = []
        for by_glass, begin in ((False, straight), (True, mirrored)):
            flux, (cosine, d_x, d_y), slope = _arrives(
                sensor, source, on_disc, here, by_glass, begin, onwards, steps
            )
            weight = weights.at(cosine, d_x, d_y, flux > 0.0)
            total = tuple(sum_ + flux * w for sum_, w in zip(total, weight, strict=True))
            slopes.append(slope)
        return number + 1, *slopes, *total

    first = dr.gather(mi.Point2f, disc, dr.zeros(mi.UInt32, lanes))
    begin = [_first_guess(sensor, source, first, here, by_glass) for by_glass in (False, True)]
    state = (mi.UInt32(0), *begin, *(mi.Float(0.0) for _ in range(basis.layers)))
    return list(dr.while_loop(state, more, add))[3:]


def _middles(half: float) -> Array:
    return (np.arange(CELLS) + 0.5) / CELLS * 2 * half - half


def _disc_points(count: int = DISC_POINTS) -> Array:
    """Points (count, 2) of the unit disc, a sunflower of equal areas, each near the one before."""
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    angle = _GOLDEN_ANGLE * np.arange(count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    stripe = np.floor((points[:, 0] + 1.0) * 0.5 * _STRIPES)
    back_and_forth = np.where(stripe % 2 == 0, points[:, 1], -points[:, 1])
    return np.asarray(points[np.lexsort((back_and_forth, stripe))])


@dataclass(frozen=True)
class _Source:
    """The LED of each lane, in its own frame: axis into the guide, along its side, up."""

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
    def of(sensor: Sensor, led: mi.UInt32) -> _Source:
        half, n = sensor.guide.width_mm / 2, sensor.guide.refractive_index
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
        columns = (dr.gather(mi.Float, _float(column), led) for column in np.array(rows).T)
        return _Source(led, Patterns(sensor.leds), *columns)


def _first_guess(
    sensor: Sensor, source: _Source, on_disc: mi.Point2f, here: list[mi.Float], by_glass: bool
) -> mi.Vector2f:
    """Slopes of the ray from a point of the disc, from those that a vanishing air gap would give."""
    reach, aside, up = _way(sensor, source, on_disc, here, by_glass)
    reach = dr.maximum(reach, 1e-3)
    sine_y, sine_z = aside / reach, up / reach
    scale = sensor.guide.refractive_index * dr.rsqrt(1.0 + dr.square(sine_y) + dr.square(sine_z))
    tangential = dr.sqrt(dr.square(sine_y) + dr.square(sine_z)) * scale
    allowed = dr.minimum(1.0, 0.98 * source.index / dr.maximum(tangential, 1e-6))
    p_y, p_z = sine_y * scale * allowed, sine_z * scale * allowed
    p_x = dr.sqrt(dr.maximum(dr.square(source.index) - dr.square(p_y) - dr.square(p_z), 1e-6))
    slope = mi.Vector2f(p_y / p_x, p_z / p_x)
    for _ in range(_NEWTON_STEPS):
        slope = _stepped(_follow(sensor, source, (reach, aside, up), by_glass, slope), slope)
    return slope


def _way(
    sensor: Sensor, source: _Source, on_disc: mi.Point2f, here: list[mi.Float], by_glass: bool
) -> tuple[mi.Float, mi.Float, mi.Float]:
    """From a point of the disc to the target: along the axis inside the guide, along the side, and up."""
    x, y, height, _, _ = here
    guide = sensor.guide
    side_y, disc_z = source.along + source.radius * on_disc.x, source.z + source.radius * on_disc.y
    # the tangent of `led_frame` is (|axis_y|, |axis_x|)
    along_axis = x * source.axis_x + y * source.axis_y + guide.width_mm / 2 - source.inset
    along_side = x * dr.abs(source.axis_y) + y * dr.abs(source.axis_x) - side_y
    up = (disc_z + guide.thickness_mm) + (height + guide.thickness_mm) if by_glass else height - disc_z
    return along_axis, along_side, up


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


def _arrives(
    sensor: Sensor,
    source: _Source,
    on_disc: mi.Point2f,
    here: list[mi.Float],
    by_glass: bool,
    begin: mi.Vector2f,
    onwards: mi.Vector2f,
    steps: int,
) -> tuple[mi.Float, tuple[mi.Float, ...], mi.Vector2f]:
    """Irradiance, W/mm², at the targets from one point of each disc; the cosine of incidence there and the
    direction along x and y; and what the ray's slopes will be from the next point, so far ``onwards``. They
    are found in so many steps of Newton's method from what the point before foretold."""
    slope_x, slope_y = here[3:]
    guide, glass = sensor.guide, sensor.glass
    half, n, n_glass = guide.width_mm / 2, guide.refractive_index, glass.refractive_index
    way = _way(sensor, source, on_disc, here, by_glass)
    side_y, disc_z = source.along + source.radius * on_disc.x, source.z + source.radius * on_disc.y
    lit = way[0] > 1e-3
    slope = begin
    for _ in range(steps):
        slope = _stepped(_follow(sensor, source, way, by_glass, slope), slope)
    path = _follow(sensor, source, way, by_glass, slope)

    lands = dr.abs(path.error.x) + dr.abs(path.error.y) < 1e-2
    lit &= lands
    entry_z = disc_z - path.entry_z if by_glass else disc_z + path.entry_z
    lit &= (entry_z > -guide.thickness_mm) & (dr.abs(side_y + path.entry_y) < half)
    if guide.walls != "polished":
        to_window = mi.Vector2f(source.radius * on_disc.x + path.entry_y, source.radius * on_disc.y)
        to_window.y += -path.entry_z if by_glass else path.entry_z
        lit &= (source.gap == 0.0) | (dr.squared_norm(to_window) <= dr.square(source.window))
    tangential2 = dr.square(path.p_y) + dr.square(path.p_z)
    in_air = source.gap > 0.0
    share = dr.select(in_air, 1.0 - _fresnel(mi.Float(1.0), mi.Float(n), tangential2), 1.0)
    if by_glass:
        level2 = dr.square(path.p_x) + dr.square(path.p_y)
        through = 1.0 - _fresnel(mi.Float(n), mi.Float(n_glass), level2)
        share *= dr.square(through) * _fresnel(mi.Float(n_glass), mi.Float(1.0), level2)
    if guide.absorption_per_mm > 0.0 or glass.absorption_per_mm > 0.0:
        share *= dr.exp(-guide.absorption_per_mm * path.in_guide - glass.absorption_per_mm * path.in_glass)
    # the surface's slope turns its normal and lengthens its shadow
    d_x = path.p_x * source.axis_x + path.p_y * dr.abs(source.axis_y)
    d_y = path.p_x * source.axis_y + path.p_y * dr.abs(source.axis_x)
    facing = path.p_z - d_x * slope_x - d_y * slope_y
    cosine = facing * dr.rsqrt(1.0 + dr.square(slope_x) + dr.square(slope_y)) / n
    flux = source.density * path.etendue * share * facing / path.p_z
    if not source.patterns.lambertian:
        leaving = dr.sqrt(dr.maximum(1.0 - tangential2 / dr.square(source.index), 0.0))
        rises = -path.p_z if by_glass else path.p_z
        flux *= source.patterns.relative(source.number, leaving, path.p_y, rises)
    lit &= facing > 0.0
    next_ = _foretold(path, slope, source.radius * onwards, by_glass)
    found = dr.select(lands & dr.isfinite(next_.x + next_.y), next_, begin)
    arriving = tuple(dr.select(lit, value, 1.0) for value in (cosine, d_x, d_y))
    return dr.select(lit, flux, 0.0), arriving, found


def _follow(
    sensor: Sensor,
    source: _Source,
    way: tuple[mi.Float, mi.Float, mi.Float],
    by_glass: bool,
    slope: mi.Vector2f,
) -> _Path:
    """A ray from its slopes at the disc to the target's height, with derivatives to the slopes."""
    n, n_glass = sensor.guide.refractive_index, sensor.glass.refractive_index
    through_glass = 2.0 * sensor.glass.thickness_mm if by_glass else 0.0
    along_axis, along_side, up = way
    t_y, t_z = slope.x, slope.y
    one = 1.0 + dr.square(t_y) + dr.square(t_z)
    c = source.index * dr.rsqrt(one)
    p_y, p_z = t_y * c, t_z * c
    py_y, py_z = c * (1.0 + dr.square(t_z)) / one, -c * t_y * t_z / one
    pz_y, pz_z = py_z, c * (1.0 + dr.square(t_y)) / one
    p_x = dr.sqrt(dr.maximum(n**2 - dr.square(p_y) - dr.square(p_z), 1e-9))
    px_y, px_z = -(p_y * py_y + p_z * pz_y) / p_x, -(p_y * py_z + p_z * pz_z) / p_x

    run = (up - source.gap * t_z) / p_z  # length over index, inside the guide
    in_guide, in_glass = n * run, mi.Float(0.0)
    run_y, run_z = -run * pz_y / p_z, -run * pz_z / p_z - source.gap / p_z
    if through_glass > 0.0:
        g2 = dr.maximum(n_glass**2 - n**2 + dr.square(p_z), 1e-9)
        below = through_glass * dr.rsqrt(g2)
        factor = -below * p_z / g2
        in_glass = n_glass * below
        run, run_y, run_z = run + below, run_y + factor * pz_y, run_z + factor * pz_z

    x_y, x_z = px_y * run + p_x * run_y, px_z * run + p_x * run_z
    y_y, y_z = source.gap + py_y * run + p_y * run_y, py_z * run + p_y * run_z
    error = mi.Vector2f(p_x * run - along_axis, source.gap * t_y + p_y * run - along_side)
    etendue = dr.square(source.index / one) / dr.abs(x_y * y_z - x_z * y_y)
    derivative, entry = (x_y, x_z, y_y, y_z), (source.gap * t_y, source.gap * t_z)
    return _Path(p_y, p_z, p_x, *entry, error, derivative, etendue, in_guide, in_glass)


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


def _float(values: np.ndarray) -> mi.Float:
    return mi.Float(np.ascontiguousarray(values, dtype=np.float32).ravel())
