"""Pictures as a camera that stands a little off sees them, and put back in place."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import affine_transform

Floats = NDArray[np.float64]


def placement(shape: tuple[int, int], shift_x: float, shift_y: float, larger: float, turn: float) -> Floats:
    """Return the matrix (3, 3) from a place (row, column, 1) in the picture of a camera that stands off to
    that in the picture where it should stand.

    Shifts are shares of the picture's longer side; it is magnified by 1 + ``larger`` and turned, rad.
    """
    rows, columns = shape
    middle = np.array([rows - 1, columns - 1]) / 2
    turned = np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]]) / (1.0 + larger)
    found = np.eye(3)
    found[:2, :2] = turned
    found[:2, 2] = middle - turned @ middle + max(rows, columns) * np.array([shift_y, shift_x])
    return found


def moved(pictures: ArrayLike, shift_x: float, shift_y: float, larger: float, turn: float) -> Floats:
    """Return pictures (n, rows, columns) as a camera sees them that stands off; see `placement`."""
    given = np.asarray(pictures, np.float64)
    rows, columns = given.shape[1:]
    return taken_from(given, placement((rows, columns), shift_x, shift_y, larger, turn))


def taken_from(pictures: ArrayLike, matrix: Floats) -> Floats:
    """Return pictures (n, rows, columns) whose places are those that a matrix (3, 3) leads to in the given.

    Beyond the border they go on as they end. Cubic splines in between.
    """
    return np.stack(
        [
            affine_transform(one, matrix[:2, :2], matrix[:2, 2], order=3, mode="nearest")
            for one in np.asarray(pictures, np.float64)
        ]
    )


def covered(shape: tuple[int, int], matrix: Floats) -> NDArray[np.bool_]:
    """Return which places (rows, columns) a matrix (3, 3) leads to within a picture of this shape."""
    rows, columns = shape
    here = np.stack([*np.mgrid[:rows, :columns], np.ones(shape)])
    row, column, _ = np.tensordot(matrix, here, 1)
    return np.asarray((row >= 0) & (row <= rows - 1) & (column >= 0) & (column <= columns - 1))
