"""Points that fill the unit 4-cube evenly, and an order in which those that lie together follow each other.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arrays import numbers

# Fractional parts of powers of 1/phi_4, phi_4 the root of x^5 = x + 1, times 2^32: an additive recurrence
# that fills the unit 4-cube evenly (Roberts 2018; key roberts2018)
_RECURRENCE = tuple(int((1.1673039782614187 ** -(k + 1) % 1.0) * 2**32) | 1 for k in range(4))


def side_by_side(each: int, n_led: int) -> mi.UInt32:
    """Indices of points of `evenly`, `each` for every LED, in an order in which neighbours follow each other.

    Lanes that run together then meet the same faces and end together: a third less time for the same paths.
    LEDs go on where the last one's points end. With the same points for all, LEDs that stand alike are off
    alike, and their sum, which the camera sees, has up to twice the variance.
    """
    begins = np.arange(n_led, dtype=np.uint32) * np.uint32(each)
    return numbers((begins[:, None] + _morton(each)).ravel())


@lru_cache(maxsize=16)
def _morton(each: int, bits: int = 5) -> NDArray[np.uint32]:
    """Order of the first points along Morton's curve (1966; key morton1966) through the unit 4-cube."""
    step = np.array(_RECURRENCE, dtype=np.uint64)[:, None]
    cell = (np.arange(each, dtype=np.uint64) * step & np.uint64(2**32 - 1)) >> np.uint64(32 - bits)
    key = np.zeros(each, dtype=np.uint64)
    for bit in range(bits - 1, -1, -1):
        for axis in cell[::-1]:
            key = key << np.uint64(1) | axis >> np.uint64(bit) & np.uint64(1)
    return np.argsort(key, kind="stable").astype(np.uint32)


def evenly(index: mi.UInt32, starts: np.ndarray) -> list[mi.Float]:
    """Points of the unit 4-cube that fill it evenly, by an additive recurrence from a random start."""
    return [
        _fraction(dr.opaque(mi.UInt32, int(start)) + index * step)
        for start, step in zip(starts, _RECURRENCE, strict=True)
    ]


def _fraction(integer: mi.UInt32) -> mi.Float:
    """Upper 24 bits of an integer as a number in [0, 1)."""
    return mi.Float(integer >> 8) * float(2**-24)
