"""The camera's picture from the irradiance on the contact surface, through the flat faces of guide and glass.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .bsdf import Table
from .build import radiance
from .irradiance import AngularBasis, land
from .sensor import Sensor
from .view import PixelRays, faces_reflectance

_SIGHTS = 2  # the surface seen directly, and mirrored once in the lower faces; a third sight adds 1e-5


@dataclass(frozen=True)
class Sight:
    """Where the pixels' rays meet the contact surface, and what part of its emission reaches the camera.

    Attributes
    ----------
    position_mm : (rows, columns, 2)
        Point of the deformed surface that each pixel sees directly.
    points : list of (x, y, fraction, gain)
        For each sight, on the device: position in units of the guide's width (0..1), real contact fraction,
        and radiance at the camera per transmitted irradiance, 1/sr.
    lamps : (n_led, rows, columns)
        Radiance at the camera, W mm⁻² sr⁻¹, of LEDs that stand in the way (embedded ones).
    """

    position_mm: NDArray[np.float32]
    points: list[tuple[mi.Float, mi.Float, mi.Float, mi.Float]]
    lamps: NDArray[np.float32]


def look(scene: mi.Scene, sensor: Sensor, table: Table, rays: PixelRays) -> Sight:
    """Intersect the pixels' rays with the deformed surface."""
    guide = sensor.guide
    shape = rays.transmittance.shape
    origin = [mi.Float(rays.origin_mm[..., i].astype(np.float32).ravel()) for i in range(3)]
    direction = mi.Vector3f(*(mi.Float(rays.direction[..., i].astype(np.float32).ravel()) for i in range(3)))
    gain = mi.Float((rays.transmittance * rays.radiance_scale).astype(np.float32).ravel())
    mirrored = mi.Float(faces_reflectance(sensor, rays.direction[..., 2]).astype(np.float32).ravel())
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")

    points = []
    lamps = _lamps(scene, sensor, mi.Point3f(*origin), direction, gain).reshape(len(sensor.leds), *shape)
    start = mi.Point3f(origin[0], origin[1], origin[2] + 1e-3)
    for _ in range(_SIGHTS):
        si = scene.ray_intersect(mi.Ray3f(start, direction))
        seen = si.is_valid() & (si.shape == mi.ShapePtr(contact))
        cosine = mi.Frame3f.cos_theta(si.wi)
        fraction = dr.select(seen, contact.eval_attribute_1("vertex_contact_fraction", si, seen), 0.0)
        transmitted = table.transmittance(fraction, cosine, seen)
        emitted = transmitted * table.diffuse_gain(fraction, seen) * dr.inv_pi
        points.append(
            (
                si.p.x / guide.width_mm + 0.5,
                si.p.y / guide.width_mm + 0.5,
                fraction,
                dr.select(seen, gain * emitted, 0.0),
            )
        )
        # mirrored in the contact surface, down, mirrored in the lower faces, up again; the deformation's
        # slope left out
        gain = dr.select(seen, gain * (1.0 - transmitted) * mirrored, 0.0)
        run = (si.p.z + guide.thickness_mm) / direction.z
        start = mi.Point3f(si.p.x + run * direction.x, si.p.y + run * direction.y, -guide.thickness_mm + 1e-3)
    dr.eval(points)
    x, y = (np.asarray(points[0][i]).reshape(shape) for i in (0, 1))
    position = (np.stack([x, y], axis=-1) - 0.5) * guide.width_mm
    return Sight(position.astype(np.float32), points, lamps)


def _lamps(
    scene: mi.Scene, sensor: Sensor, origin: mi.Point3f, direction: mi.Vector3f, gain: mi.Float
) -> NDArray[np.float32]:
    """Radiance at the camera of LEDs that the pixels' rays meet from the front."""
    named = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    si = scene.ray_intersect(mi.Ray3f(origin, direction))
    front = si.is_valid() & (mi.Frame3f.cos_theta(si.wi) > 0.0)
    layers = []
    for number, led in enumerate(sensor.leds):
        meets = front & (si.shape == named[f"led_{number}"])
        layers.append(np.asarray(dr.select(meets, gain * radiance(led), 0.0)))
    return np.stack(layers)


def picture(sight: Sight, basis: AngularBasis, irradiance: NDArray[np.float64]) -> NDArray[np.float32]:
    """Radiance in air at the pixels, (n_led, rows, columns), in W m⁻² sr⁻¹.

    `irradiance` (n_led, count, m, m), W/mm², smoothed, on cells [iy, ix] of the guide's face.
    """
    n_led = irradiance.shape[0]
    total = [mi.Float(0.0) for _ in range(n_led)]
    for x, y, fraction, gain in sight.points:
        landed = land(basis, irradiance, x, y, fraction)
        total = [sum_ + gain * part for sum_, part in zip(total, landed, strict=True)]
    dr.eval(total)
    shape = (n_led, *sight.position_mm.shape[:2])
    layers = np.stack([np.asarray(layer) for layer in total]).reshape(shape)
    return np.asarray((layers + sight.lamps) * np.float32(1e6))
