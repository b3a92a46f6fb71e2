"""Light followed through the sensor, which the contact surface mirrors: what it leaves where, and its end.

A walk does not enter the tissue. At the contact surface the transmitted part is counted on a grid and the
mirrored part goes on, as weight; `transport` turns what was counted into light that comes back.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .bsdf import Table
from .build import led_frame
from .irradiance import AngularBasis, look_up
from .lamp import Patterns
from .sensor import Sensor
from .tissue import Coupling

Array = NDArray[np.float64]

CELLS = 100  # of the irradiance grid, per side
SINKS = ("tissue", "guide", "glass", "walls", "frame", "leds", "below", "aside")
"""Where light ends: enters the tissue; absorbed in guide, glass, by painted walls, the glass's black frame,
LEDs' bodies; leaves downwards; leaves through the sides, or never went in."""

# Deposits are summed as integers: the sum does not depend on the order of threads
_FIXED_POINT = float(2**20)
_MAX_BOUNCES = 512
# Legs of the two families of paths that `direct` gathers, and any other
IN_AIR, IN_GUIDE, _DOWN, _IN_GLASS_UP, _BACK_UP, OTHER = range(6)
_SURE_BOUNCES = 12  # before Russian roulette
# Fractional parts of powers of 1/phi_4, phi_4 the root of x^5 = x + 1, times 2^32: an additive recurrence
# that fills the unit 4-cube evenly (Roberts 2018; key roberts2018)
_RECURRENCE = tuple(int((1.1673039782614187 ** -(k + 1) % 1.0) * 2**32) | 1 for k in range(4))


@dataclass(frozen=True)
class Landed:
    """What a walk left.

    Attributes
    ----------
    maps : (n_led, layers, CELLS, CELLS)
        Sum of throughput times the basis' weights on cells [iy, ix] of the deformed surface over the guide's
        face, without what `direct` gathers.
    sinks : (n_led, len(SINKS))
        Sum of throughput that ended there, gathered light included.
    trapped : (n_led,)
        Sum of throughput that came to the contact surface for the first time beyond the critical angle to
        the gaps.
    """

    maps: Array
    sinks: Array
    trapped: Array


def walk(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    basis: AngularBasis,
    number: mi.UInt32,
    ray: mi.Ray3f,
    throughput: mi.Float,
    leg: mi.UInt32,
    seed: int,
) -> Landed:
    """Follow light through the scene until it has ended.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    number
        LED that each ray's light comes from, rising, as many rays for each.
    ray, throughput, leg
        Where it begins, with what weight, and on which leg of the gathered families.
    seed
        The result depends on nothing else, not even on the number of threads.
    """
    n_led, layers, width = len(sensor.leds), basis.layers, sensor.guide.width_mm
    weights = basis.weights()
    maps = dr.zeros(mi.Int64, n_led * layers * CELLS * CELLS)
    named = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    on = mi.ShapePtr(contact)
    lanes = dr.width(number)
    sequence = dr.arange(mi.UInt64, lanes) + 1
    random = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)
    critical = float(np.sqrt(max(1.0 - (sensor.skin.gap_index / sensor.guide.refractive_index) ** 2, 0.0)))
    ended = [mi.Float(0.0) for _ in SINKS]
    state = (ray, throughput, mi.UInt32(0), leg, throughput > 0.0, random, mi.Float(-1.0), *ended)

    def going(ray, throughput, bounce, leg, alive, random, trapped, *ended):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, bounce, leg, alive, random, trapped, *ended):  # type: ignore[no-untyped-def]
        sink = dict(zip(SINKS, ended, strict=True))
        si = scene.ray_intersect(ray, alive)
        for medium, lost in absorb(sensor, ray, si, throughput, alive).items():
            sink[medium] += lost
            throughput = throughput - lost
        gone = alive & ~si.is_valid()
        down = ray.o.z < -sensor.guide.thickness_mm
        sink["below"] += dr.select(gone & down, throughput, 0.0)
        sink["aside"] += dr.select(gone & ~down, throughput, 0.0)
        alive &= si.is_valid()

        cosine = mi.Frame3f.cos_theta(si.wi)
        on_contact = alive & (si.shape == on) & (cosine > 0.0)
        gathered = on_contact & ((leg == IN_GUIDE) | (leg == _BACK_UP))  # `direct` has counted these
        # folded against a wall, the rim stands upright: the map, seen from below, has no area there
        lands = on_contact & ~gathered & (si.n.z < -0.5)
        column = mi.UInt32(dr.clip((si.p.x / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        row = mi.UInt32(dr.clip((si.p.y / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        for k, weight in enumerate(weights.at(cosine, ray.d.x, ray.d.y, lands)):
            amount = mi.Int64(dr.round(throughput * weight * _FIXED_POINT))
            cell = ((number * layers + k) * CELLS + row) * CELLS + column
            dr.scatter_add(maps, amount, cell, lands)
        trapped = dr.select(
            on_contact & (trapped < 0.0), dr.select(cosine < critical, throughput, 0.0), trapped
        )

        fraction = contact.eval_attribute_1("vertex_contact_fraction", si, on_contact)
        fraction = dr.select(dr.isfinite(fraction), fraction, 0.0)  # slivers at a pressed-back rim
        entering = dr.select(on_contact, throughput * table.transmittance(fraction, cosine, on_contact), 0.0)
        sink["tissue"] += entering
        elsewhere = alive & ~on_contact
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        direction, share, on_wall = bounce_off(sensor, named, ray, si, elsewhere, sample1, sample2)
        direction = dr.select(on_contact, mi.reflect(si.wi), direction)
        kept = dr.select(on_contact, throughput - entering, throughput * share)
        stopped = dr.select(elsewhere, throughput - kept, 0.0)
        on_led = one_of(si.shape, named, "led_")
        sink["leds"] += dr.select(on_led, stopped, 0.0)
        sink["walls"] += dr.select(on_wall, stopped, 0.0)
        sink["frame"] += dr.select(on_led | on_wall, 0.0, stopped)
        passed = elsewhere & (cosine * mi.Frame3f.cos_theta(direction) < 0.0)
        leg = _next_leg(leg, si.shape, on_wall, passed, named)

        survive = dr.select(bounce < _SURE_BOUNCES, 1.0, dr.minimum(kept, 0.95))
        alive &= (kept > 0.0) & (random.next_float32() < survive) & (bounce < _MAX_BOUNCES)
        throughput = dr.select(alive, kept / survive, 0.0)
        ray = si.spawn_ray(si.to_world(direction))
        return ray, throughput, bounce + 1, leg, alive, random, trapped, *sink.values()

    end = dr.while_loop(state, going, step)

    def per_led(values: mi.Float) -> Array:
        return np.asarray(values, dtype=np.float64).reshape(n_led, -1).sum(axis=1)

    dr.eval(maps, end[6:])
    return Landed(
        maps.numpy().reshape(n_led, layers, CELLS, CELLS).astype(np.float64) / _FIXED_POINT,
        np.stack([per_led(amount + dr.zeros(mi.Float, lanes)) for amount in end[7:]], axis=1),
        per_led(dr.maximum(end[6], 0.0)),
    )


def emit(sensor: Sensor, number: mi.UInt32, u: list[mi.Float]) -> mi.Ray3f:
    """Rays from the LEDs' discs, even over area, over angle as their patterns say."""
    half, floor = sensor.guide.width_mm / 2, -sensor.guide.thickness_mm - sensor.glass.thickness_mm
    frames = np.array([np.concatenate(led_frame(led, half, floor)) for led in sensor.leds])
    radii = np.array([led.diameter_mm / 2 for led in sensor.leds])
    columns = [mi.Float(column.astype(np.float32)) for column in (*frames.T, radii)]
    centre, axis, tangent = (
        mi.Vector3f(*(dr.gather(mi.Float, columns[3 * i + j], number) for j in range(3))) for i in range(3)
    )
    radius = dr.gather(mi.Float, columns[9], number)
    on_disc = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u[0], u[1]))
    patterns = Patterns(sensor.leds)
    direction = patterns.draw(number, mi.Point2f(u[2], u[3]))
    if not patterns.lambertian:  # their y is the LED's upright, this frame's t that or its opposite
        signs = [-1.0 if led.side in ("+x", "-y") else 1.0 for led in sensor.leds]
        direction.y *= dr.gather(mi.Float, mi.Float(signs), number)
    frame = mi.Frame3f(tangent, dr.cross(axis, tangent), axis)
    origin = centre + radius * (on_disc.x * frame.s + on_disc.y * frame.t)
    away = frame.to_world(direction)
    return mi.Ray3f(mi.Point3f(origin + 1e-4 * away), away)


def re_emit(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    coupling: Coupling,
    upward: Array,
    number: mi.UInt32,
    u: list[mi.Float],
) -> tuple[mi.Ray3f, mi.Float]:
    """Rays from the contact surface as the tissue re-emits light, and what each carries, times their number.

    Even over the guide's face, directions as T(cos) cos, weight as L = (n1/n3)² T sum phi_i(cos) V_i / pi;
    `upward` is V (n_led, modes, m, m), W/mm², on cells [iy, ix] of the guide's face.
    """
    width = sensor.guide.width_mm
    x, y = (u[0] - 0.5) * width, (u[1] - 0.5) * width
    below = mi.Ray3f(mi.Point3f(x, y, -0.25 * sensor.guide.thickness_mm), mi.Vector3f(0.0, 0.0, 1.0))
    si = scene.ray_intersect(below)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)
    n_led, modes = upward.shape[:2]
    layers = look_up(upward.reshape(n_led * modes, *upward.shape[2:]), u[0], u[1])

    # which of the table's two rows to draw from needs no even spread: any digits of the place will do
    digits = u[0] * 4096.0
    direction = table.draw(fraction, digits - dr.floor(digits), mi.Point2f(u[2], u[3]), meets)
    cosine = mi.Frame3f.cos_theta(direction)
    lobes = table.lobes(cosine, meets)
    brightness = mi.Float(0.0)
    for led in range(n_led):
        here = sum(lobe * layers[led * modes + i] for i, lobe in enumerate(lobes))
        brightness = dr.select(number == led, here, brightness)
    lobe = coupling.scale * width**2 * table.transmittance(fraction, cosine, meets) * cosine * dr.inv_pi
    brightness *= lobe / table.density(fraction, cosine, meets)
    return si.spawn_ray(si.to_world(direction)), dr.select(meets, dr.maximum(brightness, 0.0), 0.0)


def evenly(index: mi.UInt32, starts: np.ndarray) -> list[mi.Float]:
    """Points of the unit 4-cube that fill it evenly, by an additive recurrence from a random start."""
    return [
        _fraction(dr.opaque(mi.UInt32, int(start)) + index * step)
        for start, step in zip(starts, _RECURRENCE, strict=True)
    ]


def absorb(
    sensor: Sensor, ray: mi.Ray3f, si: mi.SurfaceInteraction3f, throughput: mi.Float, alive: mi.Bool
) -> dict[str, mi.Float]:
    """What guide and glass take on the way to the next face; its middle tells through which it leads."""
    guide, glass = sensor.guide, sensor.glass
    if guide.absorption_per_mm == 0.0 and glass.absorption_per_mm == 0.0:
        return {}
    middle = ray.o + 0.5 * si.t * ray.d
    within = alive & si.is_valid() & (dr.maximum(dr.abs(middle.x), dr.abs(middle.y)) < guide.width_mm / 2)
    bottom = -guide.thickness_mm
    media = (
        ("guide", guide.absorption_per_mm, middle.z > bottom),
        ("glass", glass.absorption_per_mm, (middle.z < bottom) & (middle.z > bottom - glass.thickness_mm)),
    )
    return {
        name: dr.select(within & here, throughput * (1.0 - dr.exp(-absorption * si.t)), 0.0)
        for name, absorption, here in media
    }


def bounce_off(
    sensor: Sensor,
    named: dict[str, mi.ShapePtr],
    ray: mi.Ray3f,
    si: mi.SurfaceInteraction3f,
    active: mi.Bool,
    sample1: mi.Float,
    sample2: mi.Point2f,
) -> tuple[mi.Vector3f, mi.Float, mi.Bool]:
    """Direction (local) and share of the light after a face that is not the contact, and whether it is a side
    wall."""
    on_wall = active & one_of(si.shape, named, "wall_")
    painted = _painted(sensor, si, on_wall)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    scattered, weight = si.bsdf(ray).sample(context, si, sample1, sample2, active & ~painted)
    direction, kept = scattered.wo, dr.select(active, weight[0], 0.0)
    if sensor.guide.walls != "polished":
        albedo = sensor.guide.wall_albedo if sensor.guide.walls == "diffuse" else 0.0
        back = mi.warp.square_to_cosine_hemisphere(sample2)
        from_inside = mi.Frame3f.cos_theta(si.wi) < 0.0
        kept = dr.select(painted, dr.select(from_inside, albedo, 0.0), kept)
        direction = dr.select(painted, mi.Vector3f(back.x, back.y, -back.z), direction)
    return direction, kept, on_wall


def _painted(sensor: Sensor, si: mi.SurfaceInteraction3f, on_wall: mi.Bool) -> mi.Bool:
    """Where walls are painted: all over, but for the windows before LEDs in air."""
    if sensor.guide.walls == "polished":
        return mi.Bool(False)
    half, painted = sensor.guide.width_mm / 2, on_wall
    for led in sensor.leds:
        if led.coupling == "air" and led.side != "below":
            centre, axis, _ = led_frame(led, half)
            middle = mi.Point3f(*(centre + led.gap_mm * axis).tolist())
            painted = painted & (dr.squared_norm(si.p - middle) > led.window_mm**2)
    return painted


def one_of(shape: mi.ShapePtr, named: dict[str, mi.ShapePtr], prefix: str) -> mi.Bool:
    """Whether a shape is one of those whose name begins so."""
    found = mi.Bool(False)
    for name, pointer in named.items():
        if name.startswith(prefix):
            found |= shape == pointer
    return found


def _next_leg(
    leg: mi.UInt32, shape: mi.ShapePtr, on_wall: mi.Bool, passed: mi.Bool, named: dict[str, mi.ShapePtr]
) -> mi.UInt32:
    """The leg after an event at `shape`, `passed` if light went through it."""
    upper, lower = shape == named["guide_to_glass"], shape == named["glass_to_air"]
    following = mi.UInt32(OTHER)
    for before, event, after in (
        (IN_AIR, on_wall & passed, IN_GUIDE),
        (IN_GUIDE, upper & passed, _DOWN),
        (_DOWN, lower & ~passed, _IN_GLASS_UP),
        (_IN_GLASS_UP, upper & passed, _BACK_UP),
    ):
        following = dr.select((leg == before) & event, mi.UInt32(after), following)
    return following


def _fraction(integer: mi.UInt32) -> mi.Float:
    """Upper 24 bits of an integer as a number in [0, 1)."""
    return mi.Float(integer >> 8) * float(2**-24)
