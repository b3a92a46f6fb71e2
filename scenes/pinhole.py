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
    rows with -y; its tangents are distorted by `distortion` (k1, k2), as in `view`.

    Mitsuba's own `perspective` knows square pixels only. Rays carry weight 1: the film holds radiance.
    """

    def __init__(self, props: mi.Properties) -> None:
        super().__init__(props)
        self.m_origin = mi.ScalarPoint3f(props["origin"])
        reach = mi.ScalarPoint3f(props["reach"])
        self.m_reach_x, self.m_reach_y = reach.x, reach.y
        bend = mi.ScalarPoint3f(props.get("distortion", mi.ScalarPoint3f(0.0)))
        self.m_k1, self.m_k2 = bend.x, bend.y

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
        if self.m_k1 or self.m_k2:
            shrink = self._undistort(dr.sqrt(dr.square(tangent_x) + dr.square(tangent_y)))
            tangent_x, tangent_y = tangent_x * shrink, tangent_y * shrink
        ray = mi.Ray3f(mi.Point3f(self.m_origin), dr.normalize(mi.Vector3f(tangent_x, tangent_y, 1.0)))
        ray.time = time
        return ray, mi.Color1f(1.0)

    def _undistort(self, distorted: mi.Float) -> mi.Float:
        """r/d(r) for given d, by Newton's method, which converges since d rises beyond the corners."""
        tangent = mi.Float(distorted)
        for _ in range(10):
            square = dr.square(tangent)
            miss = tangent * (1.0 + square * (self.m_k1 + square * self.m_k2)) - distorted
            slope = 1.0 + square * (3.0 * self.m_k1 + 5.0 * square * self.m_k2)
            tangent = tangent - miss / dr.maximum(slope, 0.05)
        return dr.select(distorted > 1e-9, tangent / dr.maximum(distorted, 1e-9), 1.0)

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
        "distortion": mi.ScalarPoint3f(*camera.distortion, 0.0),
        "film": {
            "type": "hdrfilm",
            "width": camera.shape[1],
            "height": camera.shape[0],
            "rfilter": {"type": "box"},
            "pixel_format": "luminance",
        },
    }
