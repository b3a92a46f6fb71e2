"""The symmetries of a square probe: what is learned of one octant of offsets tells of all eight."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_BLEND = 1 / 6  # of the largest offset: how far on both sides of a plane of symmetry its images are blended


class Image(NamedTuple):
    """An image of an offset: its share in the answer, where it lies, and what `unfold` takes to lead back."""

    share: float
    offset: tuple[float, float]
    turn: tuple[int, int]


def images(offset: tuple[float, float], largest: float) -> list[Image]:
    """The images of an offset that lie in the octant x >= y >= 0 or near it, where the samples are.

    Shares fall smoothly from one to nought across a plane of symmetry. So answers have the symmetries of the
    square exactly, and no seams, although what is learned on either side differs a little.
    """
    away, found = _BLEND * largest, []
    for turned, right, up in product((False, True), (1, -1), (1, -1)):
        x, y = offset[0] * right, offset[1] * up
        if turned:
            x, y = y, x
        share = _rising(x / away) * _rising(y / away) * _rising((x - y) / away)
        if share > 0.0:
            found.append(Image(share, (x, y), (right, 2 * up) if turned else (2 * right, up)))
    total = sum(image.share for image in found)
    return [image._replace(share=image.share / total) for image in found]


def _rising(t: float) -> float:
    """From 0 at -1 to 1 at 1 without a jump of its first two derivatives."""
    u = min(max(0.5 * (t + 1.0), 0.0), 1.0)
    return u**3 * (10.0 - 15.0 * u + 6.0 * u**2)


def unfold(rise: Floats, tared: Floats, offset: tuple[float, float]) -> tuple[Floats, Floats]:
    """Fields (..., m, m) and (..., m, m, 3) of an offset x >= y >= 0 as they are at one of its eight
    images."""
    x, y = offset
    if abs(y) > abs(x):
        rise, tared = rise.swapaxes(-1, -2), tared.swapaxes(-2, -3)[..., [1, 0, 2]]
    if x < 0:
        rise, tared = rise[..., ::-1, :], tared[..., ::-1, :, :] * [-1.0, 1.0, 1.0]
    if y < 0:
        rise, tared = rise[..., ::-1], tared[..., ::-1, :] * [1.0, -1.0, 1.0]
    return rise, tared
