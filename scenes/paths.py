"""Sample light paths, recorded corner by corner: for pictures, and to see where light goes first.

The laws are those of `trace.walk`, but here a path either goes on or ends: what is a weight there is a chance
here, so that every recorded path is one that a photon may take.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import recurrence, trace
from .arrays import floats, numbers
from .bsdf import Table
from .climb import climb
from .faces import CONTACT, HOUSING, LED, NOTHING, WALL, Faces
from .sensor import Sensor
from .view import PixelRays

FATES = (*trace.SINKS, "missed", "going")
"""How a path ends: a sink of `trace` ("tissue": it enters the tissue); "missed": it went by the guide or was
mirrored off its outside; "going": it was not followed further."""

_AWAY_MM = 8.0  # how far a path that leaves the sensor is drawn


@dataclass(frozen=True)
class Paths:
    """Recorded paths.

    Attributes
    ----------
    vertices_mm : (bounces + 1, n, 3)
        Corners of each path, from the LED on; NaN after its end.
    faces : (bounces, n)
        Index into `names` of the shape at `vertices_mm[k + 1]`; -1 in mid-air, inside a medium, and after the
        end.
    names : tuple of str
        The scene's shapes.
    fate : (n,)
        Index into `FATES`.
    led : (n,)
        LED that the path comes from.
    first_cosine : (n,)
        Cosine of incidence where the path first comes to the contact surface; NaN if it never does.
    entered : (n,)
        Whether the path ever ran through the guide.
    """

    vertices_mm: NDArray[np.float32]
    faces: NDArray[np.int64]
    names: tuple[str, ...]
    fate: NDArray[np.int64]
    led: NDArray[np.int64]
    first_cosine: NDArray[np.float32]
    entered: NDArray[np.bool_]


def from_leds(
    scene: mi.Scene, sensor: Sensor, table: Table, each: int, seed: int, bounces: int = 96
) -> Paths:
    """Record `each` paths from every LED, even over its disc and cosine-weighted over angle."""
    n_led = len(sensor.leds)
    led = np.repeat(np.arange(n_led, dtype=np.uint32), each)
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=4)
    place = numbers(np.tile(np.arange(each, dtype=np.uint32), n_led))
    number = numbers(led)
    ray = trace.emit(sensor, number, recurrence.evenly(place, starts))
    return record(scene, sensor, table, number, ray, seed, bounces)


def record(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    number: mi.UInt32,
    ray: mi.Ray3f,
    seed: int,
    bounces: int = 96,
) -> Paths:
    """Record one path for each ray.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    number
        LED that each path is said to come from.
    seed
        Every random choice depends on it and on the ray's place alone.
    bounces
        Corners after which a path is given up ("going").
    """
    lanes = dr.width(number)
    shapes = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    names, faces_of = tuple(shapes), Faces(scene, sensor)
    sequence = dr.arange(mi.UInt64, lanes) + 1
    random = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)
    alive, inside = dr.full(mi.Bool, True, lanes), dr.full(mi.Bool, False, lanes)
    fate = dr.full(mi.UInt32, FATES.index("going"), lanes)
    first = dr.full(mi.Float, dr.nan, lanes)
    dr.make_opaque(ray, alive, inside, fate, first)
    corners, faces = [_numpy(ray.o)], []
    for _ in range(bounces):
        step = _step(faces_of, sensor, table, shapes, ray, alive, inside, fate, random)
        ray, alive, inside, fate, corner, face, cosine = step
        first = dr.select(dr.isnan(first), cosine, first)
        dr.eval(ray, alive, inside, fate, first, corner, face, random)
        corners.append(_numpy(corner))
        faces.append(np.asarray(face).astype(np.int64) - 1)
        if not dr.any(alive):
            break
    return Paths(
        np.stack(corners),
        np.stack(faces),
        names,
        np.asarray(fate).astype(np.int64),
        np.asarray(number).astype(np.int64),
        np.asarray(first),
        np.asarray(inside).astype(bool),
    )


def in_sight(scene: mi.Scene, sensor: Sensor, rays: PixelRays) -> NDArray[np.float64]:
    """Share of the camera's pixels that look straight into each LED, (n_led,)."""
    origin, direction = (
        [floats(part[..., axis]) for axis in range(3)] for part in (rays.origin_mm, rays.direction)
    )
    aim = mi.Vector3f(*direction)
    shapes = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    leds = [mi.Bool(False) for _ in sensor.leds]
    clear = mi.Bool(True)

    def add(si: mi.SurfaceInteraction3f) -> None:
        front = clear & si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0.0)
        for number in range(len(leds)):
            leds[number] |= front & (si.shape == shapes[f"led_{number}"])

    for rung in climb(scene, sensor, mi.Point3f(*origin), aim):
        add(rung.met)
        clear = clear & rung.passes
    add(scene.ray_intersect(mi.Ray3f(mi.Point3f(*origin) + 1e-3 / aim.z * aim, aim)))
    return np.array([np.mean(np.asarray(meets)) for meets in leds])


def _step(  # type: ignore[no-untyped-def]
    of: Faces,
    sensor: Sensor,
    table: Table,
    shapes: dict[str, mi.ShapePtr],
    ray: mi.Ray3f,
    alive: mi.Bool,
    inside: mi.Bool,
    fate: mi.UInt32,
    random: mi.PCG32,
):
    """One straight run and what happens at its end; see `trace.walk` for the laws."""
    before = alive
    here = of.meet(ray, alive)
    met = here.kind != NOTHING
    u = [random.next_float32() for _ in range(5)]

    def end(where: mi.Bool, name: str) -> None:
        nonlocal fate, alive
        fate = dr.select(alive & where, mi.UInt32(FATES.index(name)), fate)
        alive = alive & ~where

    down = ray.o.z < -sensor.guide.thickness_mm
    gone = alive & ~met
    end(gone & down, "below")
    end(gone & inside, "aside")
    end(gone, "missed")
    corner = dr.select(gone, ray.o + _AWAY_MM * ray.d, here.p)

    # absorbed on the way, in proportion to what `trace` takes there
    lost = trace.absorb(sensor, ray, here, mi.Float(1.0))
    left = 1.0 - sum(lost.values(), mi.Float(0.0))
    absorbed = met & (u[0] >= left)
    run = here.t * dr.log(dr.maximum(u[0], 1e-30)) / dr.minimum(dr.log(dr.maximum(left, 1e-30)), -1e-12)
    corner = dr.select(absorbed, ray.o + run * ray.d, corner)
    for name, part in lost.items():
        end(absorbed & (part > 0.0), name)

    half = sensor.guide.width_mm / 2
    middle = ray.o + 0.5 * here.t * ray.d
    within = dr.maximum(dr.abs(middle.x), dr.abs(middle.y)) < half
    inside |= met & within & (middle.z > -sensor.guide.thickness_mm)

    on_contact = met & alive & (here.kind == CONTACT) & (here.cosine > 0.0)
    end(on_contact & (u[1] < table.transmittance(here.fraction, here.cosine, on_contact)), "tissue")

    elsewhere = met & ~on_contact
    direction, kept = trace.bounce_off(sensor, of, here, elsewhere, u[2], mi.Point2f(u[3], u[4]))
    direction = dr.select(on_contact, here.mirrored, direction)
    stops = elsewhere & (random.next_float32() >= kept)
    end(stops & (here.kind == LED), "leds")
    end(stops & (here.kind == WALL), "walls")
    end(stops & (here.kind == HOUSING), "housing")
    end(stops, "frame")

    face = mi.UInt32(0)
    for number, shape in enumerate(shapes.values()):
        face = dr.select(met & ~absorbed & (here.shape == shape), mi.UInt32(number + 1), face)
    corner = dr.select(before, corner, mi.Point3f(dr.nan))
    ray = dr.select(alive, here.leaving(direction), ray)
    return ray, alive, inside, fate, corner, face, dr.select(on_contact, here.cosine, dr.nan)


def _numpy(points: mi.Point3f) -> NDArray[np.float32]:
    return np.asarray(points, dtype=np.float32).T.copy()
