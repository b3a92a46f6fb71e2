"""Light traced from the LEDs: how much of it, and at what angles, arrives where on the contact surface.

Two families of paths are left out because `direct` gathers them without noise: straight from the LED to the
surface, and mirrored once in the glass's lower face.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .bsdf import Table
from .build import led_frame
from .irradiance import AngularBasis, land, weigh
from .sensor import Sensor

Array = NDArray[np.float64]

CELLS = 100  # of the irradiance grid, per side
# Deposits are summed as integers: the sum does not depend on the order of threads
_FIXED_POINT = float(2**20)
_MAX_BOUNCES = 256
# Legs of the two families of paths that `direct` gathers, and any other
_IN_AIR, _IN_GUIDE, _DOWN, _IN_GLASS_UP, _BACK_UP, _OTHER = range(6)
_SURE_BOUNCES = 12  # before Russian roulette
# Fractional parts of powers of 1/phi_4, phi_4 the root of x^5 = x + 1, times 2^32: an additive recurrence
# that fills the unit 4-cube evenly (Roberts 2018; key roberts2018)
_RECURRENCE = tuple(int((1.1673039782614187 ** -(k + 1) % 1.0) * 2**32) | 1 for k in range(4))


def trace(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    basis: AngularBasis,
    straight: Array,
    samples: int,
    seed: int,
) -> Array:
    """Weighted irradiance on the contact surface from every LED, but for what `direct` gathers.

    Light comes in two lots. What the gathered light leaves as a mirror reflection is traced from the LEDs;
    what it makes the tissue re-emit is traced from the surface, whose brightness `straight` tells without
    noise.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    table
        Optics of the contact, on the device.
    basis
        Weights of the angle of incidence, from `angular_basis`.
    straight
        From `direct.direct`, (n_led, count, m, m), W/mm².
    samples
        Light paths per LED, half of them in each lot.
    seed
        Seed of every random choice; the result depends on nothing else, not even on the number of threads.

    Returns
    -------
    (n_led, count, CELLS, CELLS)
        ∫ columns[k](cos) L cos dω, W/mm², raw (not smoothed) on cells [iy, ix] of the deformed surface over
        the guide's face.
    """
    each = max(samples // 2, 1)
    index = dr.arange(mi.UInt32, len(sensor.leds) * each)
    number = index // mi.UInt32(dr.opaque(mi.UInt32, each))
    place = index - number * dr.opaque(mi.UInt32, each)
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=8, dtype=np.uint64)

    in_air = mi.Bool(np.array([led.coupling == "air" for led in sensor.leds]))
    leg = dr.select(dr.gather(mi.Bool, in_air, number), mi.UInt32(_IN_AIR), mi.UInt32(_IN_GUIDE))
    lamp = _emit(sensor, number, _evenly(place, starts[:4]))
    landed = _walk(scene, sensor, basis, number, lamp, mi.Float(1.0), leg, 2 * seed)
    glow, brightness = _re_emit(scene, sensor, table, basis, straight, number, _evenly(place, starts[4:]))
    landed += _walk(scene, sensor, basis, number, glow, brightness, mi.UInt32(_OTHER), 2 * seed + 1)

    flux = np.array([led.flux_W for led in sensor.leds])
    area = (sensor.guide.width_mm / CELLS) ** 2
    return np.asarray(landed * (flux / each / area)[:, None, None, None])


def _walk(
    scene: mi.Scene,
    sensor: Sensor,
    basis: AngularBasis,
    number: mi.UInt32,
    ray: mi.Ray3f,
    throughput: mi.Float,
    leg: mi.UInt32,
    seed: int,
) -> Array:
    """Follow light through the scene and sum what lands, (n_led, count, CELLS, CELLS)."""
    n_led, count, width = len(sensor.leds), basis.count, sensor.guide.width_mm
    n_cos = basis.columns.shape[1]
    weights = mi.Float(np.ascontiguousarray(basis.columns.T, dtype=np.float32).ravel())
    landed = dr.zeros(mi.Int64, n_led * count * CELLS * CELLS)
    named = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    contact = named["contact"]
    context = mi.BSDFContext(mi.TransportMode.Importance)
    lanes = dr.width(number)
    sequence = dr.arange(mi.UInt64, lanes) + 1
    random = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)
    bounce, alive = mi.UInt32(0), throughput > 0.0

    def going(ray, throughput, bounce, leg, alive, random):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, bounce, leg, alive, random):  # type: ignore[no-untyped-def]
        si = scene.ray_intersect(ray, alive)
        alive &= si.is_valid()
        cosine = mi.Frame3f.cos_theta(si.wi)
        on_contact = alive & (si.shape == contact) & (cosine > 0.0)
        gathered = on_contact & ((leg == _IN_GUIDE) | (leg == _BACK_UP))  # `direct` has counted these
        # folded against a wall, the rim stands upright: the map, seen from below, has no area there
        lands = on_contact & ~gathered & (si.n.z < -0.5)
        column = mi.UInt32(dr.clip((si.p.x / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        row = mi.UInt32(dr.clip((si.p.y / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        for k, weight in enumerate(weigh(weights, count, n_cos, cosine, lands)):
            amount = mi.Int64(dr.round(throughput * weight * _FIXED_POINT))
            cell = ((number * count + k) * CELLS + row) * CELLS + column
            dr.scatter_add(landed, amount, cell, lands)

        # of gathered light only the mirror reflection goes on here: `_re_emit` starts the rest
        sample1 = dr.select(gathered, 0.0, random.next_float32())
        sample2 = mi.Point2f(random.next_float32(), random.next_float32())
        scattered, weight = si.bsdf(ray).sample(context, si, sample1, sample2, alive)
        mirrored = mi.has_flag(scattered.sampled_type, mi.BSDFFlags.DeltaReflection)
        share = dr.select(gathered, dr.select(mirrored, scattered.pdf, 0.0), 1.0)
        throughput = throughput * dr.select(alive, weight[0] * share, 0.0)
        passed = cosine * mi.Frame3f.cos_theta(scattered.wo) < 0.0
        leg = _next_leg(leg, si.shape, passed, named)
        survive = dr.select(bounce < _SURE_BOUNCES, 1.0, dr.minimum(throughput, 0.95))
        alive &= (throughput > 0.0) & (random.next_float32() < survive) & (bounce < _MAX_BOUNCES)
        throughput = dr.select(alive, throughput / survive, 0.0)
        ray = si.spawn_ray(si.to_world(scattered.wo))
        return ray, throughput, bounce + 1, leg, alive, random

    dr.while_loop((ray, throughput, bounce, leg, alive, random), going, step)
    return landed.numpy().reshape(n_led, count, CELLS, CELLS).astype(np.float64) / _FIXED_POINT


def _emit(sensor: Sensor, number: mi.UInt32, u: list[mi.Float]) -> mi.Ray3f:
    """Rays from the LEDs' discs, even over area, cosine-weighted over angle."""
    half = sensor.guide.width_mm / 2
    frames = np.array([np.concatenate(led_frame(led, half)) for led in sensor.leds])
    radii = np.array([led.diameter_mm / 2 for led in sensor.leds])
    columns = [mi.Float(column.astype(np.float32)) for column in (*frames.T, radii)]
    centre, axis, tangent = (
        mi.Vector3f(*(dr.gather(mi.Float, columns[3 * i + j], number) for j in range(3))) for i in range(3)
    )
    radius = dr.gather(mi.Float, columns[9], number)
    on_disc = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u[0], u[1]))
    direction = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[2], u[3]))
    frame = mi.Frame3f(tangent, dr.cross(axis, tangent), axis)
    origin = centre + radius * (on_disc.x * frame.s + on_disc.y * frame.t)
    away = frame.to_world(direction)
    return mi.Ray3f(mi.Point3f(origin + 1e-4 * away), away)


def _re_emit(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    basis: AngularBasis,
    straight: Array,
    number: mi.UInt32,
    u: list[mi.Float],
) -> tuple[mi.Ray3f, mi.Float]:
    """Rays from the contact surface as the tissue re-emits the gathered light, and their share of the flux.

    Even over the guide's face, directions as in the lobe: one of n rays carries F_landed K T_mean area / n.
    """
    width = sensor.guide.width_mm
    x, y = (u[0] - 0.5) * width, (u[1] - 0.5) * width
    below = mi.Ray3f(mi.Point3f(x, y, -0.25 * sensor.guide.thickness_mm), mi.Vector3f(0.0, 0.0, 1.0))
    si = scene.ray_intersect(below)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)
    landed = land(basis, straight, u[0], u[1], fraction)
    amount = mi.Float(0.0)
    for led, lamp in enumerate(sensor.leds):
        amount = dr.select(number == led, landed[led] * (width**2 / max(lamp.flux_W, 1e-30)), amount)

    # which of the table's two rows to draw from needs no even spread: any digits of the place will do
    digits = u[0] * 4096.0
    direction = table.draw(fraction, digits - dr.floor(digits), mi.Point2f(u[2], u[3]), meets)
    cosine = mi.Frame3f.cos_theta(direction)
    lobe = table.transmittance(fraction, cosine, meets) * cosine * dr.inv_pi
    brightness = amount * table.diffuse_gain(fraction, meets) * lobe / table.density(fraction, cosine, meets)
    return si.spawn_ray(si.to_world(direction)), dr.select(meets, dr.maximum(brightness, 0.0), 0.0)


def _evenly(index: mi.UInt32, starts: np.ndarray) -> list[mi.Float]:
    """Points of the unit 4-cube that fill it evenly, by an additive recurrence from a random start."""
    return [
        _fraction(dr.opaque(mi.UInt32, int(start)) + index * step)
        for start, step in zip(starts, _RECURRENCE, strict=True)
    ]


def _next_leg(
    leg: mi.UInt32, shape: mi.ShapePtr, passed: mi.Bool, named: dict[str, mi.ShapePtr]
) -> mi.UInt32:
    """The leg after an event at `shape`, `passed` if light went through it."""
    on_wall = mi.Bool(False)
    for name, pointer in named.items():
        if name.startswith("wall_"):
            on_wall |= shape == pointer
    upper, lower = shape == named["guide_to_glass"], shape == named["glass_to_air"]
    following = mi.UInt32(_OTHER)
    for before, event, after in (
        (_IN_AIR, on_wall & passed, _IN_GUIDE),
        (_IN_GUIDE, upper & passed, _DOWN),
        (_DOWN, lower & ~passed, _IN_GLASS_UP),
        (_IN_GLASS_UP, upper & passed, _BACK_UP),
    ):
        following = dr.select((leg == before) & event, mi.UInt32(after), following)
    return following


def _fraction(integer: mi.UInt32) -> mi.Float:
    """Upper 24 bits of an integer as a number in [0, 1)."""
    return mi.Float(integer >> 8) * float(2**-24)
