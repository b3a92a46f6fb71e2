"""The picture without shortcuts: rays from the LEDs, seen by the camera wherever they land.

No light is gathered, no angle tabulated apart, nothing smoothed: slower than `transport`, and what that is
measured against. The camera's view of a point of the surface is the closed form of `view`.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from . import recurrence, trace, transport, wander
from .arrays import numbers, tensor
from .bsdf import Table
from .faces import CONTACT, HOUSING, NOTHING, TO_AIR, TO_GLASS, Faces, Meeting
from .housing import Tally
from .sensor import Sensor
from .view import PixelRays, below_mm
from .windows import by_own_window

Array = NDArray[np.float64]

_MAP = 256  # nodes per side of the maps from surface to film
_WIDER = 1.2  # than the guide's face they are: a rim that is pressed towards the camera looks larger
_FIXED_POINT = float(2**26)
_HAIR_MM = 1e-3
_BELOW_MM = 0.5  # the surface is looked for from here


@dataclass(frozen=True)
class Film:
    """Where on the film the camera sees points of a horizontal plane.

    Attributes
    ----------
    film : (_MAP, _MAP, 2)
        Column and row (x.5 are pixels' middles) of the node [iy, ix] of a grid over the guide's face and
        some more (`_WIDER`).
    lean : (_MAP, _MAP, 2)
        Run in x and y per mm of height of the camera's ray through it.
    area_mm2 : (rows, columns)
        Part of the plane that each pixel sees.
    """

    film: Array
    lean: Array
    area_mm2: Array

    @staticmethod
    @lru_cache(maxsize=4)  # passes over one picture share it
    def at(sensor: Sensor, rays: PixelRays, height_mm: float) -> Film:
        """The plane at a height above the contact surface, mm."""
        lean = rays.direction[..., :2] / rays.direction[..., 2:]
        hits = rays.origin_mm[..., :2] + lean * (height_mm + sensor.guide.top_mm)
        rows, columns = hits.shape[:2]
        by_column, by_row = (np.gradient(hits, axis=axis) for axis in (1, 0))
        area = np.abs(by_column[..., 0] * by_row[..., 1] - by_column[..., 1] * by_row[..., 0])

        line = np.linspace(-0.5, 0.5, _MAP) * _WIDER * sensor.guide.width_mm
        target = np.stack(np.meshgrid(line, line), axis=-1)
        middle = np.array([rows // 2, columns // 2])
        scale = np.array([by_column[*middle, 0], by_row[*middle, 1]])
        film = (target - hits[*middle]) / scale + middle[::-1]
        for _ in range(8):  # the map bends little: each turn leaves a tenth or less
            film = film + (target - _look_up(hits, film)) / scale
        return Film(film + 0.5, _look_up(lean, film), area)


def _look_up(values: Array, film: Array) -> Array:
    """Values (rows, columns, 2) at film coordinates (..., 2) of pixels' middles, straight on beyond."""
    rows, columns = values.shape[:2]
    inside = np.clip(film, 0.0, [columns - 1.0, rows - 1.0])
    index = np.moveaxis(inside[..., ::-1], -1, 0)
    found = np.stack([map_coordinates(values[..., i], index, order=1) for i in (0, 1)], axis=-1)
    by_column, by_row = (
        np.stack([map_coordinates(g[..., i], index, order=1) for i in (0, 1)], axis=-1)
        for g in (np.gradient(values, axis=1), np.gradient(values, axis=0))
    )
    beyond = film - inside
    return np.asarray(found + beyond[..., :1] * by_column + beyond[..., 1:] * by_row)


@dataclass(frozen=True)
class _View:
    """A `Film` on the device, with the layers of radiance that collect on it."""

    maps: mi.Texture2f
    rows: int
    columns: int
    width: float
    many: int
    layers: mi.Int64
    spread_per_mm: float

    @staticmethod
    def of(film: Film, sensor: Sensor, many: int = 1) -> _View:
        """A view that collects so many numbers in each pixel of each LED."""
        rows, columns = film.area_mm2.shape
        stacked = np.concatenate([film.film, film.lean], axis=-1).astype(np.float32)
        maps = mi.Texture2f(tensor(stacked), wrap_mode=dr.WrapMode.Clamp)
        layers = dr.zeros(mi.Int64, len(sensor.leds) * rows * columns * many)
        width, middle = _WIDER * sensor.guide.width_mm, _MAP // 2
        spread = (
            (film.lean[middle, middle + 1, 0] - film.lean[middle, middle - 1, 0]) * (_MAP - 1) / width / 2
        )
        return _View(maps, rows, columns, width, many, layers, float(spread))

    def _look_up(self, x: mi.Float, y: mi.Float) -> list[mi.Float]:
        # nodes sit at the ends of the map, a texture's in the middle of its texels
        u, v = (((at / self.width + 0.5) * (_MAP - 1) + 0.5) / _MAP for at in (x, y))
        return list(self.maps.eval(mi.Point2f(u, v)))

    def towards(self, point: mi.Point3f) -> mi.Vector3f:
        """Direction, down, from a point to the camera, with z = -1."""
        _, _, lean_x, lean_y = self._look_up(point.x, point.y)
        return mi.Vector3f(-lean_x, -lean_y, -1.0)

    def add(self, number: mi.UInt32, point: mi.Point3f, amounts: Sequence[mi.Float], active: mi.Bool) -> None:
        """Count amounts at the pixel that sees a point."""
        lean = self.towards(point)
        column, row, _, _ = self._look_up(point.x + point.z * lean.x, point.y + point.z * lean.y)
        inside = active & (column >= 0.0) & (column < self.columns) & (row >= 0.0) & (row < self.rows)
        pixel = mi.UInt32(dr.maximum(row, 0.0)) * self.columns + mi.UInt32(dr.maximum(column, 0.0))
        place = (number * (self.rows * self.columns) + pixel) * self.many
        nearer = dr.rcp(dr.square(1.0 + self.spread_per_mm * point.z))  # what is nearer fills more of a pixel
        for k, amount in enumerate(amounts):
            fixed = mi.Int64(dr.round(amount * nearer * _FIXED_POINT))
            dr.scatter_add(self.layers, fixed, place + k, inside)

    def collected(self) -> Array:
        """All that was counted, (many, n_led, rows, columns)."""
        found = self.layers.numpy().reshape(-1, self.rows, self.columns, self.many)
        return np.moveaxis(found, -1, 0) / _FIXED_POINT


def exact(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    rays: PixelRays,
    ground: transport.Ground,
    samples: int,
    seed: int,
    *,
    local: bool = False,
    gathered: Array | None = None,
    slopes: Array | None = None,
    place: tuple[Array, Array] | None = None,
    tally: Tally | None = None,
) -> Array:
    """What the camera sees directly, and mirrored once in the lower faces, without the ways between.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    ground
        The deformed surface over the guide's face, from `transport.survey`.
    samples
        Light paths per LED.
    local
        Take tissue for the diffuse lobe of the scene's BSDF, which sends light back where it came in: what
        stock `path` sees.
    gathered
        Radiance (n_led, rows, columns) of `local.straight`: paths that it has are then left out of what is
        seen directly, and it takes their place, without noise. Only with `local`.
    slopes
        Derivatives of `ground.fraction` to q parameters, (q, m, m): what is seen is followed by its
        derivatives, by the paths' scores (`wander.Spots`). Not with `local`.
    place
        Centre (3,) and axes (3, 3), mm, of an ellipsoid of `sensor.inclusion` in the tissue (`wander.Lump`).
    tally
        Counts the light that falls on the housing, in units of that of one path.

    Returns
    -------
    (2, n_led, rows, columns), or with slopes (1 + q, 2, n_led, rows, columns)
        Radiance in the guide that leaves the surface towards each pixel, W mm⁻² sr⁻¹: straight, and by the
        lower faces and the contact surface, whose reflectances are left out.
    """
    if local and slopes is not None:
        raise ValueError("slopes: received some with local; allowed only without")
    if gathered is not None and not local:
        raise ValueError("gathered: received some without local; allowed only with it")
    per = np.ones(0) if slopes is None else np.maximum(np.abs(slopes).max(axis=(1, 2)), 1e-30)
    even = None if slopes is None else slopes / per[:, None, None]  # of like size: digits do not run out
    n_led = len(sensor.leds)
    films = [Film.at(sensor, rays, height) for height in (0.0, mirrored_run_mm(sensor))]
    views = [_View.of(film, sensor, 1 + per.size) for film in films]
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    faces = Faces(scene, sensor)
    spots = wander.Spots.of(sensor, ground.fraction, even)
    relief = wander.Relief.on(ground.height_mm, sensor.guide.width_mm)
    lump = None if place is None else wander.Lump.of(sensor, place)
    least = sensor.guide.under_contact_mm(1.0)
    squeezed = (sensor.guide.refractive_index / wander.behind(sensor)) ** 2

    # nothing is in the glass, and what leaves it is gone: down and up again at one go
    in_one = not sensor.housing.reflects and all(led.side != "below" for led in sensor.leds)

    index = dr.arange(mi.UInt32, n_led * samples)
    number = index // mi.UInt32(dr.opaque(mi.UInt32, samples))
    place = recurrence.side_by_side(samples, n_led)
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=4)
    sequence = dr.arange(mi.UInt64, n_led * samples) + 1
    random = mi.PCG32(size=n_led * samples, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)

    def going(ray, throughput, bounce, leg, alive, random, *scores):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, bounce, leg, alive, random, *scores):  # type: ignore[no-untyped-def]
        met = faces.meet(ray, alive)
        for lost in trace.absorb(sensor, ray, met, throughput).values():
            throughput = throughput - lost
        alive = alive & (met.kind != NOTHING)
        touches = alive & (met.kind == CONTACT) & (met.cosine > 0.0)
        if tally is not None:
            tally.add(number, met.p, throughput, alive & (met.kind == HOUSING))
        u1, u2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        direction, share = trace.bounce_off(sensor, faces, met, alive & ~touches, u1, u2)
        leaves = trace.leaves(sensor, met) & ~touches
        direction = dr.select(leaves, met.mirrored, direction)
        share = dr.select(leaves & alive, faces.reflectance(met), share)
        through, steep = table.steep(met.fraction, met.cosine, touches)
        if local:
            # what leaves towards the camera is known before it is drawn
            glow = throughput * through * dr.inv_pi
            for view, known in zip(views, (gathered is not None, False), strict=True):
                down = view.towards(met.p)
                off = dr.dot(met.normal, down)
                off_unit = off * dr.rcp(dr.norm(down))
                seen = table.transmittance(met.fraction, off_unit, touches)
                seen *= table.diffuse(met.fraction, met.cosine, off_unit, touches)
                counts = touches & (off > 0.0)
                counts &= ~trace.is_gathered(leg) if known else True
                view.add(number, met.p, [glow * seen * dr.dot(met.n, down)], counts)
            scattered, weight = _scattered(table, met, through, u1, u2, touches)
            direction = dr.select(touches, scattered, direction)
            share = dr.select(touches, weight, share)
            following = met.leaving(direction)
        else:
            following = met.leaving(dr.select(touches, met.mirrored, direction))
            share = dr.select(touches, 1.0, share)
            enters = touches & (u1 < through)
            chosen = spots.scores(met.p, through, steep, enters)
            scores = tuple(
                one + dr.select(touches, new, 0.0) for one, new in zip(scores, chosen, strict=True)
            )
            back, left, random, scores = wander.wander(
                sensor, table, spots, relief, views, met, number, throughput, enters, random, scores, lump
            )
            share = dr.select(enters, left, share)
            following = dr.select(enters, _come_back(scene, contact, back, least), following)
        kept = throughput * share
        survive = trace.chance(kept, bounce)
        alive = alive & (kept > 0.0) & (random.next_float32() < survive) & (bounce < trace.MAX_BOUNCES)
        passed = alive & ~touches & (met.cosine * dr.dot(following.d, met.normal) < 0.0)
        leg = trace.next_leg(leg, met.kind, passed, by_own_window(sensor, number, met))
        if in_one:
            dips = passed & (met.kind == TO_GLASS) & (following.d.z < 0.0)
            following, mirrored, dips = _mirrored_below(sensor, following, dips)
            kept = dr.select(dips, kept * mirrored, kept)
            leg = dr.select(dips, trace.next_leg(leg, mi.UInt32(TO_AIR), mi.Bool(False)), leg)
        return following, dr.select(alive, kept / survive, 0.0), bounce + 1, leg, alive, random, *scores

    ray = trace.emit(sensor, number, recurrence.evenly(place, starts))
    begin = (ray, dr.full(mi.Float, 1.0, n_led * samples))
    still = [dr.zeros(mi.Float, n_led * samples) for _ in per]
    legs = numbers([transport.first_leg(led) for led in sensor.leds])
    leg = dr.gather(mi.UInt32, legs, number)
    dr.while_loop((*begin, mi.UInt32(0), leg, mi.Bool(True), random, *still), going, step)
    scale = np.array([led.flux_W for led in sensor.leds])[:, None, None] / samples
    if not local:
        scale = scale * squeezed
    found = np.stack(
        [scale * view.collected() / film.area_mm2 for view, film in zip(views, films, strict=True)], axis=1
    )
    if gathered is not None:
        found[0, 0] += gathered
    if slopes is None:
        return found[0]
    found[1:] *= per[:, None, None, None, None]
    return found


def mirrored_run_mm(sensor: Sensor) -> float:
    """How much deeper in the guide the surface seems when it is seen by the glass's lower face, near the
    axis."""
    return 2.0 * (sensor.guide.top_mm + below_mm(sensor))


def _mirrored_below(sensor: Sensor, ray: mi.Ray3f, active: mi.Bool) -> tuple[mi.Ray3f, mi.Float, mi.Bool]:
    """Rays into the glass as they come back from its lower face, the share that does, and which do: those
    that meet no side on the way."""
    glass, floor = sensor.glass, -sensor.guide.thickness_mm - sensor.glass.thickness_mm
    run = (floor - ray.o.z) / dr.select(active, ray.d.z, -1.0)
    at = ray(run)
    active = active & (dr.maximum(dr.abs(at.x), dr.abs(at.y)) < sensor.guide.width_mm / 2)
    share = mi.fresnel(ray.d.z, mi.Float(glass.refractive_index))[0]
    if glass.absorption_per_mm > 0.0:
        share = share * dr.exp(-glass.absorption_per_mm * run)
    back = mi.Ray3f(mi.Point3f(at.x, at.y, floor + _HAIR_MM), mi.Vector3f(ray.d.x, ray.d.y, -ray.d.z))
    return dr.select(active, back, ray), share, active


def _scattered(
    table: Table, met: Meeting, through: mi.Float, sample1: mi.Float, sample2: mi.Point2f, active: mi.Bool
) -> tuple[mi.Vector3f, mi.Float]:
    """Where light goes on from the contact surface, and its weight: drawn as `FrustratedTIR.sample` does, at
    the place that is known already."""
    mirrors = 1.0 - through
    albedo = mirrors + through * table.typical(met.fraction, met.cosine, active)
    share = dr.select(albedo > 0.0, mirrors / albedo, 0.0)
    rest = (sample1 - share) / dr.maximum(1.0 - share, 1e-6)
    spread = table.draw(met.fraction, rest, sample2, active)
    density = (1.0 - share) * table.density(met.fraction, spread.z, active)
    value = through * table.leaving(met.fraction, met.cosine, spread.z, active)
    is_mirrored = sample1 < share
    weight = dr.select(is_mirrored, albedo, dr.select(density > 0.0, value / density, 0.0))
    return dr.select(is_mirrored, met.mirrored, mi.Frame3f(met.normal).to_world(spread)), weight


def _come_back(scene: mi.Scene, contact: mi.Shape, ray: mi.Ray3f, least: float) -> mi.Ray3f:
    """A ray that leaves the tissue, from the mesh itself. It is looked for from a height that is at least
    this."""
    start = dr.maximum(ray.o.z - _BELOW_MM, least)
    below = mi.Ray3f(mi.Point3f(ray.o.x, ray.o.y, start), mi.Vector3f(0.0, 0.0, 1.0))
    si = scene.ray_intersect(below)
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    start = si.spawn_ray(ray.d)
    return mi.Ray3f(dr.select(meets, start.o, mi.Point3f(0.0, 0.0, 1e3)), ray.d)
