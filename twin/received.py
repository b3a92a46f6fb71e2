"""What a sensor delivered: pictures at each press level, and those of the press without inclusion."""

from __future__ import annotations

from dataclasses import dataclass

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
