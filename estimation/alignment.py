"""Pictures as a camera that stands a little off sees them."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates


def moved(
    pictures: ArrayLike, shift_x: float, shift_y: float, larger: float, turn: float
) -> NDArray[np.float64]:
    """Return pictures (n, rows, columns) shifted by shares of their longer side, magnified and turned, rad.

    Beyond the border they go on as they end. Cubic splines in between.
    """
    given = np.asarray(pictures, np.float64)
    rows, columns = given.shape[1:]
    middle = np.array([rows - 1, columns - 1])[:, None, None] / 2
    grid = np.indices((rows, columns)) - middle
    turned = np.cos(turn) * grid + np.sin(turn) * np.stack([grid[1], -grid[0]])
    at = turned / (1.0 + larger) + middle + max(rows, columns) * np.array([shift_y, shift_x])[:, None, None]
    out = np.empty_like(given)
    for picture, target in zip(given, out, strict=True):
        map_coordinates(picture, at, output=target, order=3, mode="nearest")
    return out
