"""Light followed through the sensor, which the contact surface mirrors: what it leaves where, and its end.

A walk does not enter the tissue. At the contact surface the transmitted part is counted on a grid and the
mirrored part goes on, as weight; `transport` turns what was counted into light that comes back.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .answers import Answers
from .arrays import floats
from .bsdf import Table
from .build import led_frame
from .faces import CONTACT, HOUSING, LAYER, LED, NOTHING, TO_AIR, TO_GLASS, WALL, Faces, Meeting
from .housing import Tally
from .irradiance import Layered, look_up
from .lamp import Patterns
from .sensor import Sensor
from .tissue import Coupling
from .windows import by_own_window, painted

Array = NDArray[np.float64]

CELLS = 100  # of the irradiance grid, per side
SINKS = ("tissue", "guide", "glass", "walls", "frame", "leds", "below", "aside", "housing")
"""Where light ends: enters the tissue; absorbed in guide, glass, by painted walls, the glass's black frame,
LEDs' bodies in guide and glass; leaves downwards, for a black housing; leaves through the sides, whatever it
meets there, or never went in; absorbed by a housing that reflects."""

# Deposits are summed as integers: the sum does not depend on the order of threads
_FIXED_POINT = float(2**20)
MAX_BOUNCES = 512
# Legs of the two families of paths that `direct` gathers, and any other
IN_AIR, IN_GUIDE, _DOWN, _IN_GLASS_UP, _BACK_UP, OTHER = range(6)
_SURE_BOUNCES, _GO_ON = 12, 0.99  # before Russian roulette, and the chance to go on after them
_WORTHWHILE, ENOUGH = 0.02, 0.1  # what a path still carries; of those with less some go on, with as much


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
    answers : (q, n_led, told, CELLS, CELLS)
        Derivatives of the first maps (`Layered.told`) to the q parameters of `Answers`.
    """

    maps: Array
    sinks: Array
    trapped: Array
    answers: Array


def walk(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    basis: Layered,
    number: mi.UInt32,
    ray: mi.Ray3f,
    throughput: mi.Float,
    leg: mi.UInt32,
    seed: int,
    answers: Answers | None = None,
    scores: Sequence[mi.Float] = (),
    paired: bool = False,
    tally: Tally | None = None,
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
    answers, scores
        Changes of q parameters to tell the derivatives for; q derivatives of the logarithm of the throughput
        to begin with.
    paired
        Rays 2k and 2k + 1 make the same random choices.
    tally
        Counts the light that falls on the housing.
    """
    n_led, layers, width = len(sensor.leds), basis.layers, sensor.guide.width_mm
    weights = basis.weights()
    many = layers + basis.told * len(scores)
    maps = dr.zeros(mi.Int64, n_led * many * CELLS * CELLS)
    faces = Faces(scene, sensor)
    lanes = dr.width(number)
    sequence = dr.arange(mi.UInt64, lanes) + 1
    if paired:
        sequence = (dr.arange(mi.UInt64, lanes) >> 1) + 1
    random = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)
    critical = float(np.sqrt(max(1.0 - (sensor.skin.gap_index / sensor.guide.refractive_index) ** 2, 0.0)))
    ended = [mi.Float(0.0) for _ in SINKS]
    state = (ray, throughput, mi.UInt32(0), leg, throughput > 0.0, random, mi.Float(-1.0), *ended, *scores)

    def going(ray, throughput, bounce, leg, alive, random, trapped, *ended):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, bounce, leg, alive, random, trapped, *ended):  # type: ignore[no-untyped-def]
        sink, scores = dict(zip(SINKS, ended, strict=False)), list(ended[len(SINKS) :])
        met = faces.meet(ray, alive)
        for medium, lost in absorb(sensor, ray, met, throughput).items():
            sink[medium] += lost
            throughput = throughput - lost
        gone = alive & (met.kind == NOTHING)
        down = ray.o.z < -sensor.guide.thickness_mm
        sink["below"] += dr.select(gone & down, throughput, 0.0)
        sink["aside"] += dr.select(gone & ~down, throughput, 0.0)
        alive = alive & ~gone

        cosine = met.cosine
        on_contact = alive & (met.kind == CONTACT) & (cosine > 0.0)
        gathered = on_contact & is_gathered(leg)
        # folded against a wall, the rim stands upright: the map, seen from below, has no area there
        lands = on_contact & ~gathered & (met.n.z < -0.5)
        column = mi.UInt32(dr.clip((met.p.x / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        row = mi.UInt32(dr.clip((met.p.y / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        cell = ((number * CELLS + row) * CELLS + column) * many  # layers side by side: one place in memory
        weighed = [throughput * weight for weight in weights.at(cosine, met.along.x, met.along.y, lands)]
        for k, amount in enumerate(weighed):
            dr.scatter_add(maps, mi.Int64(dr.round(amount * _FIXED_POINT)), cell + k, lands)
        if scores:
            _add_scored(maps, weighed[: basis.told], scores, cell + layers, lands)
        trapped = dr.select(
            on_contact & (trapped < 0.0), dr.select(cosine < critical, throughput, 0.0), trapped
        )

        through = table.transmittance(met.fraction, cosine, on_contact)
        if answers is not None:
            turned = answers.mirrored(table, met.p, met.fraction, cosine, on_contact)
            scores = [score + more for score, more in zip(scores, turned, strict=True)]
        entering = dr.select(on_contact, throughput * through, 0.0)
        sink["tissue"] += entering
        elsewhere, on_housing = alive & ~on_contact, met.kind == HOUSING
        if tally is not None:
            tally.add(number, met.p, throughput, elsewhere & on_housing)
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        direction, share = bounce_off(sensor, faces, met, elsewhere, sample1, sample2)
        lost = elsewhere & leaves(sensor, met)  # what is mirrored goes on as weight: no chance, no noise
        direction = dr.select(on_contact | lost, met.mirrored, direction)
        share = dr.select(lost, faces.reflectance(met), share)
        kept = dr.select(on_contact, throughput - entering, throughput * share)
        stopped = dr.select(elsewhere & ~lost, throughput - kept, 0.0)
        gone_out, downwards = dr.select(lost, throughput - kept, 0.0), met.kind == TO_AIR
        sink["below"] += dr.select(downwards, gone_out, 0.0)
        sink["aside"] += dr.select(downwards, 0.0, gone_out)
        on_led, on_wall = met.kind == LED, met.kind == WALL
        sink["leds"] += dr.select(on_led, stopped, 0.0)
        sink["walls"] += dr.select(on_wall, stopped, 0.0)
        sink["housing"] += dr.select(on_housing, stopped, 0.0)
        sink["frame"] += dr.select(on_led | on_wall | on_housing, 0.0, stopped)
        passed = elsewhere & (cosine * dr.dot(direction, met.normal) < 0.0)
        leg = next_leg(leg, met.kind, passed, by_own_window(sensor, number, met))

        survive = chance(kept, bounce, ENOUGH)
        alive = alive & (kept > 0.0) & (random.next_float32() < survive) & (bounce < MAX_BOUNCES)
        throughput = dr.select(alive, kept / survive, 0.0)
        rest = (*sink.values(), *scores)
        return met.leaving(direction), throughput, bounce + 1, leg, alive, random, trapped, *rest

    end = dr.while_loop(state, going, step)

    def per_led(values: mi.Float) -> Array:
        return np.asarray(values, dtype=np.float64).reshape(n_led, -1).sum(axis=1)

    dr.eval(maps, end[6:])
    counted = maps.numpy().reshape(n_led, CELLS, CELLS, many)
    landed = np.ascontiguousarray(np.moveaxis(counted, -1, 1)) / _FIXED_POINT
    sinks = end[7 : 7 + len(SINKS)]
    return Landed(
        landed[:, :layers],
        np.stack([per_led(amount + dr.zeros(mi.Float, lanes)) for amount in sinks], axis=1),
        per_led(dr.maximum(end[6], 0.0)),
        np.moveaxis(landed[:, layers:].reshape(n_led, -1, basis.told, CELLS, CELLS), 1, 0),
    )


def _add_scored(
    maps: mi.Int64, weighed: list[mi.Float], scores: list[mi.Float], cell: mi.UInt32, active: mi.Bool
) -> None:
    """Add amounts times each score, one after the other; in a loop, as the code would be long."""

    def more(number: mi.UInt32) -> mi.Bool:
        return active & (number < len(scores))

    def add(number: mi.UInt32) -> tuple[mi.UInt32]:
        score = sum((dr.select(number == q, one, 0.0) for q, one in enumerate(scores)), mi.Float(0.0))
        start = cell + number * len(weighed)
        for k, amount in enumerate(weighed):
            scored = mi.Int64(dr.round(amount * score * _FIXED_POINT))
            dr.scatter_add(maps, scored, start + k, number < len(scores))
        return (number + 1,)

    dr.while_loop((dr.zeros(mi.UInt32, dr.width(cell)),), more, add)


def emit(sensor: Sensor, number: mi.UInt32, u: list[mi.Float], *, rim: bool = False) -> mi.Ray3f:
    """Rays from the LEDs' discs, even over area, or only from their `rim`; over angle as their patterns
    say."""
    half, floor = sensor.guide.width_mm / 2, -sensor.guide.thickness_mm - sensor.glass.thickness_mm
    frames = np.array([np.concatenate(led_frame(led, half, floor)) for led in sensor.leds])
    radii = np.array([led.diameter_mm / 2 for led in sensor.leds])
    columns = [floats(column) for column in (*frames.T, radii)]
    centre, axis, tangent = (
        mi.Vector3f(*(dr.gather(mi.Float, columns[3 * i + j], number) for j in range(3))) for i in range(3)
    )
    radius = dr.gather(mi.Float, columns[9], number)
    on_disc = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u[0], u[1]))
    if rim:
        on_disc = mi.Point2f(*reversed(dr.sincos(dr.two_pi * u[0])))
    patterns = Patterns(sensor.leds)
    direction = patterns.draw(number, mi.Point2f(u[2], u[3]))
    if not patterns.lambertian:  # their y is the LED's upright, this frame's t that or its opposite
        signs = [-1.0 if led.side in ("+x", "-y") else 1.0 for led in sensor.leds]
        direction.y *= dr.gather(mi.Float, floats(signs), number)
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
    answers: Answers | None = None,
    slopes: Sequence[Array] = (),
) -> tuple[mi.Ray3f, mi.Float, list[mi.Float]]:
    """Rays from the contact surface as the tissue re-emits light; what each carries, times their number; and
    its scores to the parameters of `answers`, of which ``slopes`` are the derivatives of `upward`.

    Even over the guide's face, directions as T(cos) cos, weight as L = (n1/n3)² T sum phi_i(cos) V_i / pi;
    `upward` is V (n_led, modes, m, m), W/mm², on cells [iy, ix] of the guide's face.
    """
    left = depart(scene, sensor, table, u)
    n_led, modes = upward.shape[:2]
    lobes = table.lobes(left.cosine, left.meets)

    def bright(upward: Array) -> mi.Float:
        layers = look_up(upward.reshape(n_led * modes, *upward.shape[2:]), u[0], u[1])
        found = mi.Float(0.0)
        for led in range(n_led):
            here = sum(lobe * layers[led * modes + i] for i, lobe in enumerate(lobes))
            found = dr.select(number == led, here, found)
        return found

    brightness = bright(upward)
    scores: list[mi.Float] = []
    if answers is not None:
        passed = answers.passed(table, left.place, left.fraction, left.cosine, left.meets)
        scores = [
            score + dr.select(brightness > 0.0, bright(slope) / brightness, 0.0)
            for score, slope in zip(passed, slopes, strict=True)
        ]
    here = left.fraction, left.cosine, left.meets
    lobe = coupling.scale * sensor.guide.width_mm**2 * table.transmittance(*here)
    brightness *= lobe * left.cosine * dr.inv_pi / table.density(*here)
    return left.ray, dr.select(left.meets, dr.maximum(brightness, 0.0), 0.0), scores


@dataclass(frozen=True)
class Departure:
    """Rays that leave the contact surface: whether it `meets` the place at all, contact fraction, cosine and
    normal there, the ray, and the place."""

    meets: mi.Bool
    fraction: mi.Float
    cosine: mi.Float
    normal: mi.Vector3f
    ray: mi.Ray3f
    place: mi.Point3f


def depart(scene: mi.Scene, sensor: Sensor, table: Table, u: list[mi.Float]) -> Departure:
    """Rays even over the guide's face, in directions as T(cos) cos, of points of the unit 4-cube."""
    width = sensor.guide.width_mm
    x, y = (u[0] - 0.5) * width, (u[1] - 0.5) * width
    below = mi.Ray3f(mi.Point3f(x, y, sensor.guide.under_contact_mm(0.25)), mi.Vector3f(0.0, 0.0, 1.0))
    si = scene.ray_intersect(below)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)

    # which of the table's two rows to draw from needs no even spread: any digits of the place will do
    digits = u[0] * 4096.0
    direction = table.draw(fraction, digits - dr.floor(digits), mi.Point2f(u[2], u[3]), meets)
    cosine = mi.Frame3f.cos_theta(direction)
    return Departure(meets, fraction, cosine, si.sh_frame.n, si.spawn_ray(si.to_world(direction)), si.p)


def absorb(sensor: Sensor, ray: mi.Ray3f, met: Meeting, throughput: mi.Float) -> dict[str, mi.Float]:
    """What guide and glass take on the way to the next face; its middle tells through which it leads."""
    guide, glass = sensor.guide, sensor.glass
    if guide.absorption_per_mm == 0.0 and glass.absorption_per_mm == 0.0:
        return {}
    middle = ray.o + 0.5 * met.t * ray.d
    aside = dr.maximum(dr.abs(middle.x), dr.abs(middle.y))
    within = (met.kind != NOTHING) & (aside < guide.width_mm / 2)
    bottom = -guide.thickness_mm
    media = (
        ("guide", guide.absorption_per_mm, middle.z > bottom),
        ("glass", glass.absorption_per_mm, (middle.z < bottom) & (middle.z > bottom - glass.thickness_mm)),
    )
    return {
        name: dr.select(within & here, throughput * (1.0 - dr.exp(-absorption * met.t)), 0.0)
        for name, absorption, here in media
    }


def chance(kept: mi.Float, bounce: mi.UInt32, worthwhile: float = _WORTHWHILE) -> mi.Float:
    """With what chance a path goes on, its weight divided by it, that carries so much.

    Few paths end that carry much: others would carry more than all, and be the picture's noise.
    """
    return dr.minimum(kept / worthwhile, dr.select(bounce < _SURE_BOUNCES, 1.0, _GO_ON))


def bounce_off(
    sensor: Sensor, faces: Faces, met: Meeting, active: mi.Bool, sample1: mi.Float, sample2: mi.Point2f
) -> tuple[mi.Vector3f, mi.Float]:
    """Direction and share of the light after a face that is not the front of the contact surface."""
    direction = faces.polished(met, sample1)
    clear = (met.kind == TO_GLASS) | (met.kind == TO_AIR) | (met.kind == WALL) | (met.kind == LAYER)
    share = dr.select(active & clear, 1.0, 0.0)
    if sensor.guide.walls != "polished":
        coated = painted(sensor, met, active)
        albedo = sensor.guide.wall_albedo if sensor.guide.walls == "diffuse" else 0.0
        back = mi.warp.square_to_cosine_hemisphere(sample2)
        back = mi.Frame3f(met.normal).to_world(mi.Vector3f(back.x, back.y, -back.z))
        share = dr.select(coated, dr.select(met.cosine < 0.0, albedo, 0.0), share)
        direction = dr.select(coated, back, direction)
    if sensor.housing.reflects:
        inside = active & (met.kind == HOUSING)
        back = mi.Frame3f(met.normal).to_world(mi.warp.square_to_cosine_hemisphere(sample2))
        share = dr.select(inside, sensor.housing.reflectance, share)
        direction = dr.select(inside, back, direction)
    return direction, share


def leaves(sensor: Sensor, met: Meeting) -> mi.Bool:
    """Where light that a face lets through never comes back: out of the glass, and out of polished walls."""
    outwards = (met.kind == TO_AIR) & (not sensor.housing.reflects)
    if sensor.guide.walls == "polished":
        outwards |= met.kind == WALL
    return outwards & (met.cosine < 0.0)


def is_gathered(leg: mi.UInt32) -> mi.Bool:
    """Whether `direct` counts light that comes to the contact on this leg."""
    return (leg == IN_GUIDE) | (leg == _BACK_UP)


def next_leg(leg: mi.UInt32, kind: mi.UInt32, passed: mi.Bool, own: mi.Bool | bool = True) -> mi.UInt32:
    """The leg after an event at a face of this kind, `passed` if light went through it, at its `own` window
    (`by_own_window`)."""
    following = mi.UInt32(OTHER)
    for before, event, after in (
        (IN_AIR, (kind == WALL) & passed & own, IN_GUIDE),
        (IN_GUIDE, (kind == TO_GLASS) & passed, _DOWN),
        (IN_GUIDE, (kind == LAYER) & passed, IN_GUIDE),
        (_DOWN, (kind == TO_AIR) & ~passed, _IN_GLASS_UP),
        (_IN_GLASS_UP, (kind == TO_GLASS) & passed, _BACK_UP),
        (_BACK_UP, (kind == LAYER) & passed, _BACK_UP),
    ):
        following = dr.select((leg == before) & event, mi.UInt32(after), following)
    return following
