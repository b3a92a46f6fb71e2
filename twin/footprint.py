"""Where in the picture an inclusion lies: the pixels that look at what is above it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes import view
from scenes.sensor import Sensor


def footprint(
    sensor: Sensor,
    size_mm: float,
    offset_mm: tuple[float, float],
    stretch: tuple[float, float] = (1.0, 1.0),
) -> NDArray[np.bool_]:
    """Return which pixels' lines of sight meet the contact surface under the inclusion, (rows, columns).

    The inclusion's outline, a disc (an ellipse if stretched) of diameter ``size_mm`` times ``stretch``, is
    projected along z onto the undeformed contact surface; ``offset_mm`` is inclusion minus probe centre.
    """
    x, y = sight(sensor)
    across, along = (size_mm * factor / 2 for factor in stretch)
    return np.asarray(((x - offset_mm[0]) / across) ** 2 + ((y - offset_mm[1]) / along) ** 2 <= 1.0)


_KEPT: dict[Any, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}


def sight(sensor: Sensor) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return x and y, mm, where each pixel's line of sight meets the undeformed surface, (rows, columns)."""
    camera, guide, glass = sensor.camera, sensor.guide, sensor.glass
    lens = (camera.shape, camera.pitch_mm, camera.field_of_view_mm, camera.distance_mm, camera.distortion)
    key = (
        lens,
        guide.thickness_mm,
        guide.refractive_index,
        glass.thickness_mm,
        glass.refractive_index,
        guide.lower,
    )
    if key not in _KEPT:
        if len(_KEPT) >= 4:  # a corpus may have a lens of its own for each sample
            _KEPT.pop(next(iter(_KEPT)))
        rays = view.pixel_rays(sensor)
        away = rays.direction[..., :2] / rays.direction[..., 2:] * guide.top_mm
        x, y = np.moveaxis((rays.origin_mm[..., :2] + away).astype(np.float32), -1, 0)
        _KEPT[key] = np.ascontiguousarray(x), np.ascontiguousarray(y)
    return _KEPT[key]
