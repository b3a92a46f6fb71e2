"""Arrays of numpy on the device, at addresses that leave compiled kernels as they are.

On the CPU Dr.Jit does not copy an array of numpy but reads it where it lies, and writes into the kernel how
well that address is aligned. numpy aligns to 16 bytes, so an array of the same shape would be aligned now
better, now worse, and each time a kernel be compiled anew, in hundreds of milliseconds. All arrays go through
this file.
"""

from __future__ import annotations

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

_ALIGNED = 64  # bytes: the widest vector of any processor here, and Dr.Jit's own memory


def floats(values: ArrayLike) -> mi.Float:
    """On the device, in single precision, flat."""
    return mi.Float(_aligned(values, np.dtype(np.float32)))


def doubles(values: ArrayLike) -> mi.Float64:
    """On the device, in double precision, flat."""
    return mi.Float64(_aligned(values, np.dtype(np.float64)))


def numbers(values: ArrayLike) -> mi.UInt32:
    """On the device, whole numbers, flat."""
    return mi.UInt32(_aligned(values, np.dtype(np.uint32)))


def tensor(values: ArrayLike) -> mi.TensorXf:
    """On the device, in single precision, in the same shape."""
    found = np.asarray(values)
    return mi.TensorXf(floats(found), found.shape)


def _aligned(values: ArrayLike, dtype: np.dtype) -> NDArray:
    flat = np.asarray(values).ravel()
    raw = np.empty(flat.size * dtype.itemsize + _ALIGNED, np.uint8)
    start = -raw.ctypes.data % _ALIGNED
    copied = raw[start : start + flat.size * dtype.itemsize].view(dtype)
    copied[:] = flat
    return copied
