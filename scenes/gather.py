"""The camera's picture from the irradiance on the contact surface, through the flat faces of guide and glass.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import housing
from .arrays import floats
from .bsdf import Table
from .build import led_frame, radiance
from .climb import STEP_MM, climb, descend
from .irradiance import look_up
from .lamp import Patterns
from .passage import Seen
from .sensor import Sensor
from .tissue import Coupling
from .view import PixelRays, faces_transmittance

Array = NDArray[np.float64]

_ASIDE_MM = (1.3e-4, 0.7e-4, 0.0)  # along neither the sides nor the diagonals of the mesh
_SIGHTS = 2  # the surface seen directly, and mirrored once in the lower faces; a third sight adds 1e-5


@dataclass(frozen=True)
class Sight:
    """Where the pixels' rays meet the contact surface, and what part of its emission reaches the camera.

    Attributes
    ----------
    position_mm : (rows, columns, 2)
        Point of the deformed surface that each pixel sees directly.
    points : list of (x, y, gain)
        For each sight, on the device: position in units of the guide's width (0..1), and radiance at the
        camera per light that goes up in the tissue, 1/sr.
    lean : (x, y)
        Direction of the pixels' rays in the tissue, up: sines along the surface there.
    off_normal
        1 less the cosine of their angle in the tissue.
    width_mm
        Of the guide's face.
    windows : (sights, rows, columns)
        Radiance at the camera over that in the guide, for each sight.
    lamps : (n_led, rows, columns)
        Radiance at the camera, W mm⁻² sr⁻¹, of LEDs in sight: embedded ones, straight or mirrored.
    mirrors : list of housing.Mirror
        How the pixels see a housing that reflects.
    """

    position_mm: NDArray[np.float32]
    points: list[tuple[mi.Float, mi.Float, mi.Float]]
    lean: tuple[mi.Float, mi.Float]
    off_normal: mi.Float
    width_mm: float
    windows: NDArray[np.float32]
    lamps: NDArray[np.float32]
    mirrors: list[housing.Mirror]


@dataclass(frozen=True)
class Glance:
    """A `Sight` on the device, pixel after pixel; windows are a list of `_SIGHTS`, lamps of LEDs."""

    points: list[tuple[mi.Float, mi.Float, mi.Float]]
    lean: tuple[mi.Float, mi.Float]
    off_normal: mi.Float
    width_mm: float
    windows: list[mi.Float]
    lamps: list[mi.Float]
    mirrors: list[housing.Mirror]


def look(scene: mi.Scene, sensor: Sensor, table: Table, coupling: Coupling, rays: PixelRays) -> Sight:
    """Intersect the pixels' rays with the deformed surface."""
    shape, width = rays.transmittance.shape, sensor.guide.width_mm
    found = glance(scene, sensor, table, coupling, rays)
    dr.eval(found.points, found.windows, found.lamps, found.lean, found.off_normal)
    dr.eval([(mirror.place, mirror.share) for mirror in found.mirrors])
    x, y = (np.asarray(found.points[0][i]).reshape(shape) for i in (0, 1))
    where = ((np.stack([x, y], axis=-1) - 0.5) * width).astype(np.float32)
    layers = np.stack(
        [np.broadcast_to(np.asarray(layer), rays.transmittance.size).reshape(shape) for layer in found.lamps]
    )
    through = np.stack([np.asarray(window).reshape(shape) for window in found.windows])
    seen = found.points, found.lean, found.off_normal, width, through, layers, found.mirrors
    return Sight(where, *seen)


def glance(scene: mi.Scene, sensor: Sensor, table: Table, coupling: Coupling, rays: PixelRays) -> Glance:
    """The same, not evaluated: Dr.Jit differentiates it to the scene's surface and to the table."""
    guide = sensor.guide
    origin, direction, gain, mirrored = on_device(rays)
    kept = _kept_by_guide(sensor)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")

    named = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    # the run in the glass and back, near the axis, as one in the guide
    in_glass = 2.0 * sensor.glass.thickness_mm * guide.refractive_index / sensor.glass.refractive_index
    in_glass += sum(2.0 * h * guide.refractive_index / n for h, n in guide.layers[1:])
    deeper = _in_layers(sensor, rays)
    lamps, patterns = [mi.Float(0.0) for _ in sensor.leds], Patterns(sensor.leds)
    points: list[tuple[mi.Float, mi.Float, mi.Float]] = []
    windows: list[mi.Float] = []
    mirrors: list[housing.Mirror] = []
    # sine of the angle in the tissue, by Snell's law
    bend = float(np.sqrt(coupling.scale))
    start = origin + STEP_MM / direction.z * direction
    for _ in range(_SIGHTS):
        for rung in climb(scene, sensor, start, direction):
            gain = gain * kept(rung.met.t)  # not in place: the first one is the cache's
            _add_lamps(lamps, rung.met, gain * deeper[rung.layer - 1], sensor, named, patterns)
            gain = dr.select(rung.passes, gain, 0.0)
        si = meet(scene, named["contact"], start, direction)
        gain = gain * kept(si.t)
        seen = si.is_valid() & (si.shape == named["contact"])
        _add_lamps(lamps, si, gain, sensor, named, patterns)
        windows.append(gain)
        cosine = mi.Frame3f.cos_theta(si.wi)
        if not points:
            lean = direction - dr.dot(direction, si.sh_frame.n) * si.sh_frame.n
        fraction = dr.select(seen, contact.eval_attribute_1("vertex_contact_fraction", si, seen), 0.0)
        transmitted = table.transmittance(fraction, cosine, seen)
        # light is told per area of the map, the slope has more
        upright = dr.abs(si.sh_frame.n.z)
        emitted = dr.select(seen, gain * transmitted * upright * (coupling.scale * dr.inv_pi), 0.0)
        points.append((si.p.x / guide.width_mm + 0.5, si.p.y / guide.width_mm + 0.5, emitted))
        # mirrored in the contact surface, down, mirrored in the lower faces, up again; the slope left out
        gain = dr.select(seen, gain * (1.0 - transmitted), 0.0)
        down = mi.Vector3f(direction.x, direction.y, -direction.z)
        below = scene.ray_intersect(mi.Ray3f(si.p + STEP_MM * down, down), seen)
        gain = gain * kept(below.t)
        _add_lamps(lamps, below, gain, sensor, named, patterns)
        through = below.is_valid() & (below.shape == named["layer_1" if guide.lower else "guide_to_glass"])
        for rung in descend(scene, sensor, si.p, down):
            gain = gain * kept(rung.met.t)
            alight = dr.select(through, gain * deeper[rung.layer - 1], 0.0)
            _add_lamps(lamps, rung.met, alight, sensor, named, patterns)
            through &= rung.passes
        _add_lamps_below(lamps, si.p, down, dr.select(through, gain, 0.0), sensor, patterns)
        if sensor.housing.reflects and not mirrors:
            mirrors = _housing(sensor, origin, direction, si.p, dr.select(through, gain, 0.0), rays)
        gain = dr.select(through, gain * mirrored, 0.0)
        run = (si.p.z + guide.top_mm + in_glass) / direction.z
        start = mi.Point3f(si.p.x, si.p.y, -guide.top_mm) + mi.Vector3f(
            run * direction.x, run * direction.y, 0.0
        )
        start += STEP_MM / direction.z * direction
    off_normal = 1.0 - dr.sqrt(dr.maximum(1.0 - coupling.scale * dr.squared_norm(lean), 0.0))
    return Glance(points, (bend * lean.x, bend * lean.y), off_normal, guide.width_mm, windows, lamps, mirrors)


def _housing(
    sensor: Sensor,
    origin: mi.Point3f,
    direction: mi.Vector3f,
    point: mi.Point3f,
    gain: mi.Float,
    rays: PixelRays,
) -> list[housing.Mirror]:
    """How pixels see the housing: straight by the faces below, and from a point of the contact that mirrors
    this share of radiance in the guide. Slopes there are left out, and so are ways with two mirrors."""
    n, passed, mirrored = sensor.guide.refractive_index, floats(rays.passed), floats(rays.mirrored_outside)
    clear = floats(rays.transmittance)
    sine_x, sine_y = n * direction.x, n * direction.y  # in air
    in_air = dr.rsqrt(dr.maximum(1.0 - dr.square(sine_x) - dr.square(sine_y), 1e-6))
    lean_x, lean_y = sine_x * in_air, sine_y * in_air
    run, away = (point.z + sensor.guide.top_mm) / direction.z, sensor.camera.distance_mm
    # below the first layer it is the way up again
    x = point.x + run * direction.x + origin.x - away * lean_x
    y = point.y + run * direction.y + origin.y - away * lean_y
    by_contact = gain * passed * n**2
    return housing.mirrors(
        sensor, (lean_x, lean_y), (x, y), dr.select(clear > 0.0, mirrored, 0.0), by_contact
    )


@lru_cache(maxsize=4)
def on_device(rays: PixelRays) -> tuple[mi.Point3f, mi.Vector3f, mi.Float, mi.Float]:
    """Origin, direction, radiance at the camera over that in the guide, and `mirrored`, pixel after pixel."""
    points = np.moveaxis(np.concatenate([rays.origin_mm, rays.direction], axis=-1), -1, 0)
    gain = rays.transmittance * rays.radiance_scale
    x, y, z, *direction, gain, mirrored = (floats(values) for values in (*points, gain, rays.mirrored))
    return mi.Point3f(x, y, z), mi.Vector3f(*direction), gain, mirrored


def _kept_by_guide(sensor: Sensor) -> Callable[[mi.Float], mi.Float]:
    """What the guide leaves of light on a way of so many mm (Beer's law)."""
    absorption = sensor.guide.absorption_per_mm
    if absorption == 0.0:
        return lambda run: mi.Float(1.0)
    return lambda run: dr.exp(-absorption * run)


def _in_layers(sensor: Sensor, rays: PixelRays) -> list[mi.Float]:
    """Radiance at the camera per radiance in each lower layer, over that in the first one, of pixels' rays.

    (On the way to a mirror image the share that faces between layers send back, 1e-3, counts as passed.)
    """
    first = sensor.guide.refractive_index
    cosine, found = rays.direction[..., 2], []
    for k, layer in enumerate(sensor.guide.lower, start=1):
        ratio = faces_transmittance(sensor, cosine, k) / np.maximum(rays.passed, 1e-9)
        ratio *= (first / layer.refractive_index) ** 2
        found.append(floats(ratio))
    return found


def meet(
    scene: mi.Scene, contact: mi.ShapePtr, start: mi.Point3f, direction: mi.Vector3f
) -> mi.SurfaceInteraction3f:
    """Where rays going up meet the scene; one that slips between two triangles tries again a hair aside."""
    si = scene.ray_intersect(mi.Ray3f(start, direction))
    slipped = ~(si.is_valid() & (si.shape == contact))
    aside = mi.Ray3f(start + mi.Vector3f(*_ASIDE_MM), direction)
    again = scene.ray_intersect(aside, slipped)
    return dr.select(slipped & again.is_valid() & (again.shape == contact), again, si)


def _add_lamps(
    lamps: list[mi.Float],
    si: mi.SurfaceInteraction3f,
    gain: mi.Float,
    sensor: Sensor,
    named: dict[str, mi.ShapePtr],
    patterns: Patterns,
) -> None:
    """Add the radiance at the camera of the LEDs whose front these rays meet."""
    front = si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0.0)
    for number, led in enumerate(sensor.leds):
        if led.side == "below":
            continue
        meets = front & (si.shape == named[f"led_{number}"])
        _, axis, tangent = led_frame(led, sensor.guide.width_mm / 2)
        towards = si.to_world(si.wi)
        ahead, along = (dr.dot(towards, mi.Vector3f(*line.tolist())) for line in (axis, tangent))
        leaves = patterns.relative(mi.UInt32(number), ahead, along, towards.z)
        lamps[number] += dr.select(meets, gain * radiance(led) * leaves, 0.0)


def _add_lamps_below(
    lamps: list[mi.Float],
    point: mi.Point3f,
    down: mi.Vector3f,
    gain: mi.Float,
    sensor: Sensor,
    patterns: Patterns,
) -> None:
    """Add what rays that go down from a point in the guide meet of the LEDs below, through flat faces.

    Reflections between the faces and the discs are left out.
    """
    guide, glass = sensor.guide, sensor.glass
    n1, n2 = guide.refractive_index, glass.refractive_index
    indices = [index for _, index in guide.layers]
    px, py = n1 * down.x, n1 * down.y
    square = dr.square(px) + dr.square(py)

    def per_index(index: float) -> mi.Float:
        return dr.rsqrt(dr.maximum(index**2 - square, 1e-6))

    run = (point.z + guide.top_mm) * per_index(n1)
    run += sum(thickness * per_index(index) for thickness, index in guide.layers[1:])
    for number, led in enumerate(sensor.leds):
        if led.side != "below":
            continue
        in_air = led.coupling == "air"
        in_glass = (glass.thickness_mm - (0.0 if in_air else led.gap_mm)) * per_index(n2)
        through = run + in_glass
        medium = 1.0 if in_air else n2
        if in_air:
            through += led.gap_mm * per_index(1.0)
        off_x, off_y = point.x + through * px - led.x_mm, point.y + through * py - led.y_mm
        meets = (dr.square(off_x) + dr.square(off_y) < (led.diameter_mm / 2) ** 2) & (square < medium**2)
        lost = _fresnel(indices[-1], n2, square)
        if in_air:
            lost = _both(lost, _fresnel(n2, 1.0, square))
        for above, below in list(pairwise(indices))[::-1]:
            lost = _both(_fresnel(above, below, square), lost)
        cosine = dr.sqrt(dr.maximum(1.0 - square / medium**2, 0.0))
        leaves = patterns.relative(mi.UInt32(number), cosine, -px, -py)
        seen = gain * (1.0 - lost) * (n1 / medium) ** 2 * radiance(led) * leaves
        if glass.absorption_per_mm > 0.0:
            seen *= dr.exp(-glass.absorption_per_mm * n2 * in_glass)
        lamps[number] += dr.select(meets, seen, 0.0)


def _both(first: mi.Float, second: mi.Float) -> mi.Float:
    """Reflectance of a face and all below it, with the reflections between them."""
    return first + dr.square(1.0 - first) * second / dr.maximum(1.0 - first * second, 1e-6)


def _fresnel(n_in: float, n_out: float, square: mi.Float) -> mi.Float:
    """Unpolarised reflectance at a squared tangential index (Born & Wolf 1999; key born1999)."""
    a = dr.sqrt(dr.maximum(n_in**2 - square, 0.0))
    b = dr.sqrt(dr.maximum(n_out**2 - square, 0.0))
    s = (a - b) / dr.maximum(a + b, 1e-9)
    p = (n_out**2 * a - n_in**2 * b) / dr.maximum(n_out**2 * a + n_in**2 * b, 1e-9)
    return dr.select(square < n_out**2, 0.5 * (dr.square(s) + dr.square(p)), 1.0)


def picture(sight: Sight, seen: Seen, margin: int, *, lamps: bool = True) -> NDArray[np.float32]:
    """Radiance in air at the pixels, (n_led, rows, columns), in W m⁻² sr⁻¹; so many cells of what is seen lie
    beside the guide's face on each side. Without the LEDs in sight if not `lamps`.
    """
    towards = [
        (dr.opaque(mi.Float, float(away)), dr.opaque(mi.Float, float(more)))
        for away, more in zip(seen.behind_mm / sight.width_mm, seen.steeper, strict=True)
    ]
    total = _layers(sight, seen.maps, towards, margin)
    dr.eval(total)
    shape = (len(seen.maps), *sight.position_mm.shape[:2])
    found = np.stack([np.asarray(layer) for layer in total]).reshape(shape)
    return np.asarray((found + sight.lamps if lamps else found) * np.float32(1e6))


def answer(sight: Glance, step: mi.Float, seen: Seen, slopes: Seen, margin: int) -> Array:
    """Derivative of the picture, (n_led, pixels), W m⁻² sr⁻¹ per unit of `step`, on which the glance hangs;
    that of what is seen is in the `slopes`. By Dr.Jit's automatic differentiation, forwards."""
    width = sight.width_mm
    towards = [
        (dr.opaque(mi.Float, float(away)) + step * float(d_away), float(more) + step * float(d_more))
        for away, more, d_away, d_more in zip(
            seen.behind_mm / width, seen.steeper, slopes.behind_mm / width, slopes.steeper, strict=True
        )
    ]
    light = _layers(sight, seen.maps, towards, margin)
    changes = _layers(sight, slopes.maps, towards, margin)
    pixels = dr.width(sight.off_normal)
    total = [
        one + step * change + lamp + dr.zeros(mi.Float, pixels)
        for one, change, lamp in zip(light, changes, sight.lamps, strict=True)
    ]
    dr.forward(step)
    return np.stack([np.asarray(dr.grad(layer)) for layer in total]).astype(np.float64) * 1e6


def _layers(
    sight: Sight | Glance,
    maps: NDArray[np.floating],
    towards: list[tuple[mi.Float, mi.Float]],
    margin: int,
) -> list[mi.Float]:
    """Radiance at the pixels, W mm⁻² sr⁻¹, of each LED's maps (`Seen`); how far behind they are looked up, in
    units of the guide's width per sine, and how much brighter they are off the normal, are `towards`."""
    n_led, cells = len(maps), maps.shape[-1]
    inside = 1.0 - 2.0 * margin / cells
    lean = sight.lean
    total = [mi.Float(0.0) for _ in range(n_led)]
    for x, y, gain in sight.points:
        for led, (away, more) in enumerate(towards):
            place = [
                inside * (at + away * sine) + margin / cells for at, sine in zip((x, y), lean, strict=True)
            ]
            found, *aslant = look_up(maps[led], *place)
            found *= 1.0 + more * sight.off_normal
            for rise, how in zip(aslant, (sight.off_normal, *lean), strict=False):
                found += rise * how
            total[led] += gain * found
    return total
