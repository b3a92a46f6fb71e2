"""The camera as a Mitsuba sensor: a pinhole whose pixels need not be square.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .sensor import Sensor
from .view import tangent_scale


class Pinhole(mi.Sensor):
    """A pinhole at `origin` looking up (+z); the film spans the tangents ±`reach` (x, y), columns with +x,
    rows with -y.

    Mitsuba's own `perspective` knows square pixels only. Rays carry weight 1: the film holds radiance.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_origin = mi.ScalarPoint3f(props["origin"])
        reach = mi.ScalarPoint3f(props["reach"])
        self.m_reach_x, self.m_reach_y = reach.x, reach.y

    def sample_ray(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.Ray3f, mi.Color1f]:
        tangent_x = (2.0 * sample2.x - 1.0) * self.m_reach_x
        tangent_y = (1.0 - 2.0 * sample2.y) * self.m_reach_y
        ray = mi.Ray3f(mi.Point3f(self.m_origin), dr.normalize(mi.Vector3f(tangent_x, tangent_y, 1.0)))
        ray.time = time
        return ray, mi.Color1f(1.0)

    def sample_ray_differential(
        self,
        time: mi.Float,
        sample1: mi.Float,
        sample2: mi.Point2f,
        sample3: mi.Point2f,
        active: mi.Bool = True,
    ) -> tuple[mi.RayDifferential3f, mi.Color1f]:
        ray, weight = self.sample_ray(time, sample1=sample1, sample2=sample2, sample3=sample3, active=active)
        return mi.RayDifferential3f(ray), weight

    def bbox(self) -> mi.ScalarBoundingBox3f:
        return mi.ScalarBoundingBox3f(self.m_origin, self.m_origin)

    def to_string(self) -> str:
        return f"Pinhole[origin = {self.m_origin}]"


mi.register_sensor("tsis_pinhole", Pinhole)


def describe(sensor: Sensor) -> dict[str, object]:
    """The scene entry of this sensor's camera."""
    camera, scale = sensor.camera, tangent_scale(sensor)
    reach_x = 0.5e-3 * camera.columns * camera.pixel_um[0] * scale
    reach_y = 0.5e-3 * camera.rows * camera.pixel_um[1] * scale
    height = -(sensor.guide.thickness_mm + sensor.glass.thickness_mm + camera.distance_mm)
    return {
        "type": "tsis_pinhole",
        "origin": mi.ScalarPoint3f(0.0, 0.0, height),
        "reach": mi.ScalarPoint3f(reach_x, reach_y, 0.0),
        "film": {
            "type": "hdrfilm",
            "width": camera.columns,
            "height": camera.rows,
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
        },
    }
