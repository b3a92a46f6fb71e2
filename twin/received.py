"""What a sensor delivered: pictures at each press level, and those of the press without inclusion."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray


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
    """Return what the card of a model says of its pictures."""
    rows, columns = card["shape"]
    least, most = card["frames"]
    levels = tuple(float(depth) for depth in card["indentation_mm"])
    return Wanted((int(rows), int(columns)), int(card["bits"]), card["colour"], levels, (least, most))
