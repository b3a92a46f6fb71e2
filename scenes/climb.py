"""Lines of sight through the lower layers of a guide, whose faces refract them.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .sensor import Sensor

STEP_MM = 1e-3  # off a face before looking on


@dataclass(frozen=True)
class Rung:
    """A line of sight in one of the lower layers.

    Attributes
    ----------
    layer
        Its number, from 1 on.
    met
        What it meets there.
    passes
        Whether that is the face to the next layer, or to the glass.
    """

    layer: int
    met: mi.SurfaceInteraction3f
    passes: mi.Bool


def climb(scene: mi.Scene, sensor: Sensor, place: mi.Point3f, direction: mi.Vector3f) -> list[Rung]:
    """From the glass up to `place`, on the first layer's floor, where sight goes on in `direction`."""
    x, y, found = place.x, place.y, []
    for k, floor in enumerate(sensor.guide.floors_mm[1:], start=1):
        way = _bent(sensor, direction, k)
        run = sensor.guide.layers[k][0] / way.z
        x, y = x - run * way.x, y - run * way.y
        start = mi.Point3f(x, y, floor) + STEP_MM / way.z * way
        found.append(_rung(scene, k, start, way, f"layer_{k}"))
    return found[::-1]


def descend(scene: mi.Scene, sensor: Sensor, place: mi.Point3f, direction: mi.Vector3f) -> list[Rung]:
    """From `place`, in the first layer, down to the glass; `direction` is that in the first layer."""
    floors, found = sensor.guide.floors_mm, []
    run = (place.z - floors[0]) / -direction.z
    x, y = place.x + run * direction.x, place.y + run * direction.y
    for k, roof in enumerate(floors[:-1], start=1):
        way = _bent(sensor, direction, k)
        start = mi.Point3f(x, y, roof) - STEP_MM / way.z * way
        after = f"layer_{k + 1}" if k + 1 < len(floors) else "guide_to_glass"
        found.append(_rung(scene, k, start, way, after))
        run = sensor.guide.layers[k][0] / -way.z
        x, y = x + run * way.x, y + run * way.y
    return found


def _bent(sensor: Sensor, direction: mi.Vector3f, layer: int) -> mi.Vector3f:
    """The direction in another layer (Snell's law), as long as the camera's rays: none is mirrored wholly."""
    ratio = sensor.guide.refractive_index / sensor.guide.layers[layer][1]
    x, y = ratio * direction.x, ratio * direction.y
    z = dr.sqrt(dr.maximum(1.0 - dr.square(x) - dr.square(y), 1e-6))
    return mi.Vector3f(x, y, dr.copysign(z, direction.z))


def _rung(scene: mi.Scene, layer: int, start: mi.Point3f, way: mi.Vector3f, after: str) -> Rung:
    shape = next(shape for shape in scene.shapes() if shape.id() == after)
    si = scene.ray_intersect(mi.Ray3f(start, way))
    return Rung(layer, si, si.is_valid() & (si.shape == mi.ShapePtr(shape)))
