"""Maps over the guide's face on coarser and on finer square cells."""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray


def coarser(maps: NDArray[Any], cells: int) -> NDArray[Any]:
    """Means over squares of the last two axes (..., m, m), `cells` per side, which m is a multiple of."""
    side = maps.shape[-1] // cells
    squares = maps.reshape(*maps.shape[:-2], cells, side, cells, side)
    return squares.mean(axis=(-3, -1), dtype=maps.dtype)


def finer(maps: NDArray[Any], cells: int, *, means: bool = False) -> NDArray[Any]:
    """Maps (..., m, m) on `cells` per side, linear in between.

    With ``means``, those over the squares that `coarser` takes are the maps again, and ``cells`` must be a
    multiple of m: straight lines between the means themselves would cut off peaks, and what changes across
    the outermost squares.
    """
    step = (_exact if means else _steps)(maps.shape[-1], cells).astype(maps.dtype)
    return np.asarray(np.matmul(np.matmul(step, maps), step.T))


@lru_cache(maxsize=8)
def _steps(cells: int, to: int) -> NDArray[np.float64]:
    """(to, cells): along one axis."""
    middles, at = (np.arange(cells) + 0.5) / cells, (np.arange(to) + 0.5) / to
    return np.stack([np.interp(at, middles, column) for column in np.eye(cells)], axis=1)


@lru_cache(maxsize=8)
def _exact(cells: int, to: int) -> NDArray[np.float64]:
    """(to, cells): along one axis, between values of which the means are those that are given."""
    step = _steps(cells, to)
    return np.asarray(step @ np.linalg.inv(step.reshape(cells, to // cells, cells).mean(axis=1)))
