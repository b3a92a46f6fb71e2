"""Memory that is freed is kept for the next array, rather than handed back and asked for again."""

from __future__ import annotations

import ctypes
from functools import cache

_MMAP_THRESHOLD, _TRIM_THRESHOLD = -3, -1  # of glibc's malloc.h
_LARGE = 8 << 20  # bytes of an array that is handed back all the same
_SPARE = 32 << 20  # bytes of all others that are kept


@cache
def keep() -> None:
    """Tell glibc so, once; other C libraries are left as they are.

    By default it hands blocks of some hundred kB back to the system, whose new pages are then cleared and
    mapped one by one: a quarter of a press, whose elements are worked on in chunks of just that size.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_MMAP_THRESHOLD, _LARGE)
        mallopt(_TRIM_THRESHOLD, _SPARE)
