"""Pictures in few numbers: principal components of coarse pictures over the camera's noise.

A specimen is seen at several press levels, each with its reference. What is compressed is the tared picture
and the reference, so that absolute brightness is kept; both are divided by the noise of a mean picture, so
that components are ordered by what can be seen.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Single = NDArray[np.float32]

_AT_ONCE = 2048
_SEEN = 0.05
"""Least variance of a component that is kept, over the noise of a single exposure."""


@dataclass(frozen=True)
class Features:
    """Projection of pictures (n, levels, 2, r, c), each with its reference behind it, onto k numbers.

    Attributes
    ----------
    mean : (m,) of the stacked and whitened pictures, m = levels * 2 * r * c.
    axes : (k, m).
    noise : (levels, 2, 1, 1) or (levels, 2, r, c) counts, standard deviation of tared picture and reference
        in a block of pixels.
    spread : (k,) standard deviation of the features over specimens, in those of the noise.
    shape : (levels, 2, r, c).
    """

    mean: Single
    axes: Single
    noise: Single
    spread: Single
    shape: tuple[int, int, int, int]

    def __call__(self, pictures: NDArray[np.floating]) -> Single:
        """Features (n, k) of pictures (n, levels, 2, r, c), counts."""
        return np.asarray((self.stacked(pictures) - self.mean) @ self.axes.T, np.float32)

    def stacked(self, pictures: NDArray[np.floating]) -> Single:
        """Tared pictures and references over the noise, (n, m)."""
        given = np.asarray(pictures, np.float32)
        tared = np.stack([given[:, :, 0] - given[:, :, 1], given[:, :, 1]], axis=2)
        return np.asarray((tared / self.noise).reshape(len(given), -1), np.float32)

    def only(self, blocks: NDArray[np.bool_]) -> Features:
        """Return the features that look at some blocks (r, c) of each picture alone."""
        seen = np.broadcast_to(blocks, self.shape).reshape(-1)
        return replace(self, axes=self.axes * seen.astype(np.float32))

    @property
    def onto(self) -> Single:
        """(levels, 2, r * c, k): what each block's counts of picture and reference add to the features."""
        levels, _, rows, columns = self.shape
        axes = self.axes.reshape(-1, levels, 2, rows, columns) / self.noise
        axes = axes.reshape(-1, levels, 2, rows * columns)
        tared, reference = axes[:, :, 0], axes[:, :, 1]
        return np.ascontiguousarray(
            np.stack([tared, reference - tared], axis=2).transpose(1, 2, 3, 0), np.float32
        )


def compress(pictures: NDArray[np.floating], noise: NDArray[np.floating], *, most: int = 96) -> Features:
    """Find the components of pictures (n, levels, 2, r, c) without noise.

    ``noise`` is (levels, 2) or (levels, 2, r, c), of tared picture and reference, counts. Components of which
    less is seen than `_SEEN` of one exposure's noise are left out, and all beyond ``most``.
    """
    first = Features(
        np.zeros(1, np.float32),
        np.zeros((1, 1), np.float32),
        np.asarray(noise, np.float32).reshape(*noise.shape, *(1,) * (4 - noise.ndim)),
        np.zeros(1, np.float32),
        tuple(pictures.shape[1:]),
    )
    x = first.stacked(pictures)
    mean = x.mean(axis=0)
    x -= mean
    gram = np.zeros((len(x), len(x)))
    for start in range(0, x.shape[1], _AT_ONCE):  # single precision would leave components of its own
        part = x[:, start : start + _AT_ONCE].astype(np.float64)
        gram += part @ part.T
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1][:most]
    spread = np.sqrt(np.maximum(values[order], 0.0) / len(x))
    keep = order[spread**2 > _SEEN]
    axes = (vectors[:, keep].T / np.sqrt(values[keep])[:, None]).astype(np.float32) @ x
    return Features(mean, axes, first.noise, spread[: len(keep)].astype(np.float32), first.shape)
