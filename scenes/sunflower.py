"""Points that fill a disc evenly, in an order in which neighbours follow each other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_STRIPES = 4
_GOLDEN_ANGLE = np.pi * (3.0 - np.sqrt(5.0))


def disc_points(count: int) -> Array:
    """Points (count, 2) of the unit disc, a sunflower of equal areas, those in a row close together."""
    radius = np.sqrt((np.arange(count) + 0.5) / count)
    angle = _GOLDEN_ANGLE * np.arange(count)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    stripe = np.floor((points[:, 0] + 1.0) * 0.5 * _STRIPES)
    back_and_forth = np.where(stripe % 2 == 0, points[:, 1], -points[:, 1])
    return np.asarray(points[np.lexsort((back_and_forth, stripe))])
