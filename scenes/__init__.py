"""Optics: from a pressed contact surface to the radiance at the camera.

`gap_transmittance` is the law, `Renderer` the transport of light, `expose` the camera. What draws in VTK or
Mitsuba is imported with the first `Renderer`, not here, so that reading a design or asking for help stays
fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .camera import expose, mean_counts, tare
from .ftir import gap_transmittance
from .sensor import Camera, Glass, Guide, Led, Sensor
from .skin import Sheet, Skin, Tissue

if TYPE_CHECKING:
    from .render import Renderer, Rendering
    from .spectral import SpectralRenderer

__all__ = [
    "Camera",
    "Glass",
    "Guide",
    "Led",
    "Renderer",
    "Rendering",
    "Sensor",
    "Sheet",
    "Skin",
    "SpectralRenderer",
    "Tissue",
    "expose",
    "gap_transmittance",
    "mean_counts",
    "tare",
]


def __getattr__(name: str) -> Any:
    if name in ("Renderer", "Rendering"):
        from . import render

        return getattr(render, name)
    if name == "SpectralRenderer":
        from .spectral import SpectralRenderer

        return SpectralRenderer
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
