"""LEDs' light straight to each pixel's point, or by the glass, before tissue that gives light back where it
came in: without noise, pixel by pixel, what `exact` would count there of the paths that `direct` gathers.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import direct, gather
from .bsdf import Table
from .climb import STEP_MM
from .sensor import Sensor
from .view import PixelRays

Array = NDArray[np.float64]


@dataclass(frozen=True)
class _Weighed:
    """Light counted as what leaves towards the camera, of each lane's contact fraction and cosine there."""

    table: Table
    fraction: mi.Float
    cosine: mi.Float

    layers = told = 1

    def weights(self) -> _Weighed:
        return self

    def at(self, cosine: mi.Float, x: mi.Float, y: mi.Float, active: mi.Bool) -> list[mi.Float]:
        through = self.table.transmittance(self.fraction, cosine, active)
        return [through * self.table.diffuse(self.fraction, cosine, self.cosine, active)]


def straight(scene: mi.Scene, sensor: Sensor, table: Table, rays: PixelRays) -> Array:
    """Radiance in the guide towards each pixel, (n_led, rows, columns), W mm⁻² sr⁻¹, of a surface that is in
    place; LEDs at the sides of a guide of one index."""
    origin, direction, *_ = gather.on_device(rays)
    contact = mi.ShapePtr(next(shape for shape in scene.shapes() if shape.id() == "contact"))
    si = gather.meet(scene, contact, origin + STEP_MM / direction.z * direction, direction)
    meets = si.is_valid() & (si.shape == contact)
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)
    cosine, n = mi.Frame3f.cos_theta(si.wi), si.sh_frame.n
    pixel = [si.p.x, si.p.y, si.p.z, -n.x / n.z, -n.y / n.z, fraction, cosine]
    pixel.append(dr.select(meets, dr.abs(n.z) * table.transmittance(fraction, cosine, meets) / dr.pi, 0.0))
    dr.eval(pixel)
    shape, n_led = rays.transmittance.shape, len(sensor.leds)
    lanes = dr.arange(mi.UInt32, n_led * dr.width(fraction))
    led, place = lanes // dr.width(fraction), lanes % dr.width(fraction)
    *here, fraction, cosine, leaves = (dr.gather(mi.Float, values, place) for values in pixel)
    found = direct.at(sensor, _Weighed(table, fraction, cosine), led, here)
    return np.asarray(found[0] * leaves, dtype=np.float64).reshape(n_led, *shape)
