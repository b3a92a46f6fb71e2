"""Freed memory of the C library: kept for the next array, or handed back; glibc alone can be told."""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Callable

_MMAP_THRESHOLD, _TRIM_THRESHOLD, _ARENA_MAX = -3, -1, -8  # of glibc's malloc.h
_MIB = 1 << 20
_kept: list[bool] = []  # holds one once this process was told


def keep(largest_MiB: int = 8, spare_MiB: int = 32, arenas: int | None = None) -> None:
    """Keep freed memory, arrays up to so large and so much in all; the first call of a process counts.

    By default glibc hands blocks of some hundred kB back to the system, whose new pages are then cleared and
    mapped one by one: a quarter of a press, whose elements are worked on in chunks of just that size.
    `largest_MiB` is 32 at most; `arenas`: pools that threads share.
    """
    mallopt = _function("mallopt")
    if _kept or mallopt is None:
        return
    _kept.append(True)
    mallopt(_MMAP_THRESHOLD, largest_MiB * _MIB)
    mallopt(_TRIM_THRESHOLD, spare_MiB * _MIB)
    if arenas is not None:
        mallopt(_ARENA_MAX, arenas)


def trim() -> None:
    """Hand back all that was freed, which glibc does not do by itself."""
    malloc_trim = _function("malloc_trim")
    if malloc_trim is not None:
        malloc_trim(0)


def _function(name: str) -> Callable[..., int] | None:
    """A function of the C library, if this process's has one of that name."""
    return getattr(ctypes.CDLL(None), name, None) if sys.platform == "linux" else None
