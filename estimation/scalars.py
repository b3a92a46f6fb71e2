"""The three scalars that the paper reads off a picture: maximum, total and area.

The paper (section III.C) defines them in words: "the pixel value in the centroid of the tactile data", "the
summation of pixel values" and "the number of pixel greater than the specific threshold value k". Here:

- **area** counts the pixels strictly above k;
- the **centroid** is that of those pixels, each weighted with its counts, so that neither a tilted
  background below k nor the number of dark pixels around pulls it;
- **maximum** is the mean of the 3 x 3 pixels around the pixel that holds the centroid: one noisy pixel
  cannot decide it. At the picture's border the window keeps to the pixels that exist. Where no pixel is
  above k there is no centroid, and the maximum is 0, as the area is;
- **total** sums the whole picture, signs included, so that noise averages out instead of adding up.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike


def scalars(counts: ArrayLike, threshold_dn: float) -> dict[str, float | int]:
    """Return the three scalars of a picture, raw or tared.

    Parameters
    ----------
    counts : (rows, columns) array of counts, of any integer or float type; a tared picture holds negative
        ones too.
    threshold_dn : the threshold k in counts, above 0.

    Returns
    -------
    dict with ``max_dn`` (counts), ``total_dn`` (counts) and ``area_px`` (pixels).

    Raises
    ------
    ValueError
        If the picture is not two-dimensional, is empty or holds NaN or infinity, or if k is not above 0.
    """
    picture = np.asarray(counts, dtype=np.float64)
    if picture.ndim != 2 or picture.size == 0:
        raise ValueError(f"counts: received shape {picture.shape}; allowed (rows, columns), at least (1, 1)")
    if not np.isfinite(picture).all():
        raise ValueError("counts: received NaN or infinity; allowed finite numbers")
    if not threshold_dn > 0:
        raise ValueError(f"threshold_dn: received {threshold_dn!r}; allowed a number > 0")
    row, column = np.nonzero(picture > threshold_dn)
    total = float(picture.sum())
    if row.size == 0:
        return {"max_dn": 0.0, "total_dn": total, "area_px": 0}
    weight = picture[row, column]
    return {
        "max_dn": _mean_3x3(picture, _centre(row, weight), _centre(column, weight)),
        "total_dn": total,
        "area_px": int(row.size),
    }


def _centre(index: np.ndarray, weight: np.ndarray) -> int:
    """Return the pixel that holds the weighted mean of the indices, (n,) each; halves go up."""
    return int(np.floor(np.dot(index, weight) / weight.sum() + 0.5))


def _mean_3x3(picture: np.ndarray, row: int, column: int) -> float:
    """Return the mean over the pixels within one of (row, column) that exist."""
    return float(picture[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2].mean())
