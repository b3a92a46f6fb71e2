"""Optics: from a pressed contact surface to the radiance at the camera.

`gap_transmittance` is the law, `Renderer` the transport of light, `expose` the camera. Mitsuba is imported with the first
`Renderer`, not here, so that reading a design or asking for help stays fast.
"""

from .camera import expose, mean_counts, tare
from .ftir import gap_transmittance
from .render import Renderer, Rendering
from .sensor import Camera, Glass, Guide, Led, Sensor, Skin, Tissue

__all__ = [
    "Camera",
    "Glass",
    "Guide",
    "Led",
    "Renderer",
    "Rendering",
    "Sensor",
    "Skin",
    "Tissue",
    "expose",
    "gap_transmittance",
    "mean_counts",
    "tare",
]
