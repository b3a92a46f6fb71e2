"""LED light that comes to the contact surface straight or by the glass's lower face: gathered, not traced.

These two families of paths carry most of the light and all of its sharp edges (the rims of escape and
acceptance cones), so they are integrated without noise and without smoothing. All other paths are left to
`trace`. Through faces between a guide's layers they pass refracted; what those faces mirror is traced.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arrays import floats
from .disc import disc_rule
from .disc_rays import Source, arrives, first_guess
from .irradiance import Layered
from .sensor import Sensor
from .surface import OpticalSurface, heights

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

CELLS = 200  # of the grid of target points, per side, unless another number is asked for
DISC_POINTS = 24
_NEWTON_AGAIN = 2  # steps from what the disc's point before foretold
_FINER = 16  # times the points
_NEWTON_LAYERS = 5  # in a guide of layers, whose faces a disc may cross


def relief(sensor: Sensor, deformed: OpticalSurface, cells: int = CELLS) -> Array:
    """Height (mm) and slopes along x and y of the deformed surface at the targets, (3, cells, cells)."""
    middles = _middles(sensor.guide.width_mm / 2, cells)
    height = heights(deformed, middles)
    slope_y, slope_x = (np.gradient(height, middles, axis=axis, edge_order=2) for axis in (0, 1))
    return np.stack([height, slope_x, slope_y])


def direct(sensor: Sensor, basis: Layered, deformed: OpticalSurface, cells: int = CELLS) -> Singles:
    """Weighted irradiance of the two families, (n_led, layers, cells, cells), W/mm²; see `on`."""
    return on(sensor, basis, relief(sensor, deformed, cells))


def on(sensor: Sensor, basis: Layered, ground: Array, points: int = DISC_POINTS) -> Singles:
    """Weighted irradiance of the two families on a `relief`, (n_led, layers, cells, cells), W/mm²,
    from so many points of each disc, sixteen times as many where one lies across a face between layers.

    From a disc of flux F and area A in a medium of index m, Lambertian or else with its pattern's factor
    (`lamp.Patterns.relative`), the element dA sends F/(pi A m²) dA
    dp_y dp_z, so the irradiance at a target is that times |d(p_y, p_z)/d(x, y)|, the ray's two unknowns being
    found by Newton's method. Height and slope of the deformed surface at the target are kept; what the other
    LEDs' discs shade is left out.
    """
    n_led = len(sensor.leds)
    here = [number for number, led in enumerate(sensor.leds) if led.side != "below" and led.flux_W > 0.0]
    if len(here) < n_led:  # light from below crosses both faces at once: it is traced
        found = np.zeros((n_led, basis.layers, *ground.shape[1:]), np.float32)
        if here:
            some = replace(sensor, leds=tuple(sensor.leds[number] for number in here))
            found[here] = on(some, basis, ground, points)
        return found
    led, where = _targets(sensor, ground)
    return _maps(at(sensor, basis, led, where, points), n_led, ground)


def at(
    sensor: Sensor, basis: Layered, led: mi.UInt32, here: list[mi.Float], points: int = DISC_POINTS
) -> list[mi.Float]:
    """The same on the device, layer by layer; each lane has its LED and target: x, y, height, mm, slopes."""
    found = _summed(sensor, basis, _sources(sensor, led), here, points)
    dr.eval(found)
    return found


def answers(
    sensor: Sensor, basis: Layered, ground: Array, change: Change, points: int = DISC_POINTS
) -> Array:
    """Derivative of `on` along a change, (n_led, layers, cells, cells), W/mm² per unit.

    By Dr.Jit's automatic differentiation, forwards, of the very loops that gather: discs move as a whole and
    their points with them. The outline of the side face, of a window in a painted wall, and the faces between
    layers, which cut off light, stay where they are. LEDs below answer nothing.
    """
    here = [number for number, led in enumerate(sensor.leds) if led.side != "below" and led.flux_W > 0.0]
    found = np.zeros((len(sensor.leds), basis.layers, *ground.shape[1:]))
    if not here:
        return found
    some = replace(sensor, leds=tuple(sensor.leds[number] for number in here))
    step = dr.opaque(mi.Float, 0.0)  # a literal would grow in place to the size of what it is multiplied by
    dr.enable_grad(step)
    led, where = _targets(some, ground)
    if change.ground is not None:
        _, moves = _targets(some, change.ground)
        where[2:] = [at + step * move for at, move in zip(where[2:], moves[2:], strict=True)]
    sources = [_moved(source, change, step) for source in _sources(some, led)]
    total = _summed(some, basis, sources, where, points)
    dr.forward(step)
    slopes = dr.grad(total)
    dr.eval(slopes)
    found[here] = _maps(slopes, len(here), ground)
    return found


@dataclass(frozen=True)
class Change:
    """What one unit of a parameter changes: the place of every LED along its side and up, mm, and its
    pattern's exponent; `relief` (3, cells, cells), or None."""

    along_mm: float = 0.0
    z_mm: float = 0.0
    exponent: float = 0.0
    ground: Array | None = None


def crossed(sensor: Sensor) -> bool:
    """Whether a face between layers crosses an LED's disc."""
    return any(map(len, _cuts(sensor)))


def _cuts(sensor: Sensor) -> list[list[float]]:
    """Heights on each LED's unit disc at which faces between layers cross it, falling."""
    floors = sensor.guide.floors_mm[:-1]
    heights = [[(floor - led.z_mm) / (led.diameter_mm / 2) for floor in floors] for led in sensor.leds]
    return [[height for height in some if abs(height) < 1.0] for some in heights]


def _rules(sensor: Sensor, points: int) -> tuple[Array, Array]:
    """Points on the discs and their weights, LED after LED, as many for each."""
    cuts = _cuts(sensor)
    most = max(map(len, cuts))
    if most == 0:
        place, share = disc_rule(points)
        return np.tile(place, (len(cuts), 1)), np.tile(share, len(cuts))
    # a disc that is crossed less often is cut where it need not be
    spare = np.linspace(0.9, -0.9, most + 2)[1:-1]
    filled = [sorted([*some, *spare[: most - len(some)]], reverse=True) for some in cuts]
    rules = [disc_rule(points * _FINER, some) for some in filled]
    return np.concatenate([place for place, _ in rules]), np.concatenate([share for _, share in rules])


def _targets(sensor: Sensor, ground: Array) -> tuple[mi.UInt32, list[mi.Float]]:
    """LED of each lane, and what it shines at: x, y and the relief."""
    middles = _middles(sensor.guide.width_mm / 2, ground.shape[-1])
    x, y = np.meshgrid(middles, middles)
    target = [floats(values) for values in (x, y, *ground)]
    index = dr.arange(mi.UInt32, len(sensor.leds) * x.size)
    led, point = index // x.size, index % x.size
    return led, [dr.gather(mi.Float, values, point) for values in target]


def _sources(sensor: Sensor, led: mi.UInt32) -> list[Source]:
    """LED of each lane, for the light of each layer of the guide."""
    return [Source.of(sensor, led, layer) for layer in range(len(sensor.guide.layers))]


def _moved(source: Source, change: Change, step: mi.Float) -> Source:
    moved = {"along": source.along + step * change.along_mm, "z": source.z + step * change.z_mm}
    if change.exponent:
        moved["patterns"] = source.patterns.sharper(step * change.exponent)
    return replace(source, **moved)


def _maps(total: list[mi.Float], n_led: int, ground: Array) -> Singles:
    return np.stack([np.asarray(layer).reshape(n_led, *ground.shape[1:]) for layer in total], axis=1)


def _summed(
    sensor: Sensor, basis: Layered, sources: list[Source], here: list[mi.Float], points: int
) -> list[mi.Float]:
    """Layers of weighted irradiance of each lane's target, over the points of its LED's disc."""
    steps = _NEWTON_LAYERS if sensor.guide.lower else _NEWTON_AGAIN
    places, shares = _rules(sensor, points)
    each = len(shares) // len(sensor.leds)
    disc, share, end = floats(places), floats(shares), dr.opaque(mi.UInt32, each)
    weights, first = basis.weights(), sources[0].number * each
    entered = [layer for layer in range(len(sources)) if _enters(sensor, layer)]
    families = [(layer, by_glass) for layer in entered for by_glass in (False, True)]

    def more(number, *state):  # type: ignore[no-untyped-def]
        return number < end

    def add(number, *state):  # type: ignore[no-untyped-def]
        on_disc = dr.gather(mi.Point2f, disc, first + number)
        onwards = dr.gather(mi.Point2f, disc, first + dr.minimum(number + 1, end - 1)) - on_disc
        counts = dr.gather(mi.Float, share, first + number)
        slopes, total = [], list(state[len(families) :])
        for k, (layer, by_glass) in enumerate(families):
            flux, (cosine, d_x, d_y), slope = arrives(
                sensor, sources[layer], on_disc, here, by_glass, state[k], onwards, steps
            )
            weight = weights.at(cosine, d_x, d_y, flux > 0.0)
            total = [whole + counts * flux * w for whole, w in zip(total, weight, strict=True)]
            slopes.append(slope)
        return number + 1, *slopes, *total

    start = dr.gather(mi.Point2f, disc, first)
    begin = [first_guess(sensor, sources[layer], start, here, by_glass) for layer, by_glass in families]
    state = (mi.UInt32(0), *begin, *(mi.Float(0.0) for _ in range(basis.layers)))
    return list(dr.while_loop(state, more, add))[1 + len(families) :]


def _enters(sensor: Sensor, layer: int) -> bool:
    """Whether light of an LED can come into a layer straight from its disc."""
    floors = (0.0, *sensor.guide.floors_mm)
    ends = [(led.z_mm - led.diameter_mm / 2, led.z_mm + led.diameter_mm / 2) for led in sensor.leds]
    in_air = any(led.coupling == "air" for led in sensor.leds)
    return in_air or any(low < floors[layer] and high > floors[layer + 1] for low, high in ends)


def _middles(half: float, cells: int) -> Array:
    return (np.arange(cells) + 0.5) / cells * 2 * half - half
