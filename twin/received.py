"""What a sensor delivered: pictures at each press level, and those of the press without inclusion."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.complaint import DesignError, shown

MAX_SIDE = 16384  # pixels, as a camera may have
MAX_FRAMES = 10_000  # exposures, as a camera may average


@dataclass(frozen=True, eq=False)
class Received:
    """Pictures of one specimen, one for each press level, as an estimator takes them.

    Attributes
    ----------
    images : (levels, rows, columns[, 3]) float32 counts, seen from the specimen: columns grow with +x, rows
        with -y; the mean of so many exposures.
    references : the same of the press without inclusion.
    frames, reference_frames : exposures that each picture and each reference is the mean of.
    bits : of the camera's converter; counts are 0 to 2^bits - 1.
    names : (levels,) of the files, for messages.
    """

    images: NDArray[np.float32]
    references: NDArray[np.float32]
    frames: int
    reference_frames: int
    bits: int
    names: tuple[str, ...]

    @property
    def tared(self) -> NDArray[np.float32]:
        """(levels, rows, columns[, 3]) counts of the pictures minus those of the references."""
        return self.images - self.references


@dataclass(frozen=True)
class Wanted:
    """The pictures that a model can take."""

    shape: tuple[int, int]
    """Rows and columns."""
    bits: int
    colour: str
    """mono or rgb."""
    indentation_mm: tuple[float, ...]
    """Press levels, in order."""
    frames: tuple[int, int]
    """Fewest and most exposures that a picture may be the mean of."""

    @property
    def levels(self) -> int:
        """How many press levels there are."""
        return len(self.indentation_mm)

    @property
    def planes(self) -> tuple[int, ...]:
        """Shape of one picture: rows, columns, and 3 in colour."""
        return self.shape if self.colour == "mono" else (*self.shape, 3)


def wanted_of(card: Mapping[str, Any]) -> Wanted:
    """Return what the card of a model says of its pictures. Raises `DesignError` for what it cannot say."""

    def refuse(name: str, allowed: str) -> DesignError:
        return DesignError(name, shown(card.get(name)), allowed, source="card of the model")

    shape: Any = card.get("shape")
    frames: Any = card.get("frames")
    depths: Any = card.get("indentation_mm")
    if not _whole(shape, 2, 1, MAX_SIDE):
        raise refuse("shape", "rows and columns")
    if not _whole(frames, 2, 1, MAX_FRAMES) or frames[0] > frames[1]:
        raise refuse("frames", "fewest and most exposures")
    if not _whole([card.get("bits")], 1, 1, 16):
        raise refuse("bits", "1 to 16")
    if card.get("colour") not in ("mono", "rgb"):
        raise refuse("colour", "mono or rgb")
    if not isinstance(depths, list) or not depths or not all(_depth(depth) for depth in depths):
        raise refuse("indentation_mm", "a list of numbers > 0")
    rows, columns = shape
    return Wanted((rows, columns), card["bits"], card["colour"], tuple(map(float, depths)), tuple(frames))


def _whole(values: Any, count: int, low: int, high: int) -> bool:
    """Whether this is a list of so many whole numbers in a range."""
    return (
        isinstance(values, list)
        and len(values) == count
        and all(type(value) is int and low <= value <= high for value in values)
    )


def _depth(value: Any) -> bool:
    return type(value) in (int, float) and 0 < value < math.inf
