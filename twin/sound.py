"""Whether pictures can be what they are said to be: exposed, of one press, and a pair with their reference.

These checks know no model: what they refuse is wrong for every sensor.
"""

from __future__ import annotations

import hashlib

import numpy as np
from numpy.typing import NDArray

from twin.complaint import DesignError
from twin.frame import grey
from twin.received import Received

CLIPPED_PERCENT = 0.5
"""Most pixels at an end of the converter's range: what they hide is no longer small beside the signal."""
APART = 0.01
"""Most that exposures of one press may differ, rms of blocks of pixels, as a share of the full range."""
SHOWN = 0.4
"""Least share of a reference's fixed pattern that its picture must show."""

BLOCK = 12
"""Pixels along a side of the blocks of a coarse picture."""


def check_exposure(picture: NDArray[np.floating], bits: int, name: str) -> None:
    """Refuse a picture, (rows, columns[, 3]) counts, that is saturated or black in many pixels."""
    top = 2**bits - 1
    planes = () if picture.ndim == 2 else (2,)
    for clipped, what, allowed in (
        ((picture >= top).any(axis=planes), f"at the last count, {top}", "a shorter exposure, or less light"),
        ((picture <= 0).all(axis=planes), "at 0 counts", "more light, or a higher black level"),
    ):
        percent = 100.0 * float(clipped.mean())
        if percent > CLIPPED_PERCENT:
            most = f"at most {CLIPPED_PERCENT:g} % ({allowed})"
            raise DesignError(name, f"a picture with {percent:.3g} % of its pixels {what}", most)


def check_same(
    first: NDArray[np.floating], other: NDArray[np.floating], bits: int, names: tuple[str, str]
) -> None:
    """Refuse two exposures of one press level that show two things."""
    apart = coarse(other) - coarse(first)
    rms, most = float(np.sqrt(np.mean(apart**2))), APART * (2**bits - 1)
    if rms > most:
        received = f"a picture {rms:.3g} counts (rms) from {names[0]}"
        raise DesignError(names[1], received, f"exposures of one press, at most {most:.3g} apart")


def check_apart(picture: NDArray[np.floating], name: str, taken: dict[bytes, str]) -> None:
    """Refuse a picture that was given before: copies of an exposure tell no more than one of them. ``taken``
    holds what was given, and then this one, too."""
    key = hashlib.sha256(np.ascontiguousarray(picture).tobytes()).digest()
    if key in taken:
        allowed = "exposures that were taken one by one (of twin simulate: each with a --seed of its own)"
        raise DesignError(name, f"the same picture as {taken[key]}", allowed)
    taken[key] = name


def check_pair(received: Received) -> None:
    """Refuse a picture that is the same as its reference, or does not show the pattern of its pixels."""
    for level, name in enumerate(received.names):
        if np.array_equal(received.images[level], received.references[level]):
            raise DesignError(name, "a picture equal to its reference", "another press than that")
    share = shared_pattern(received)
    if share < SHOWN:
        what = f"pictures that show {100 * max(share, 0.0):.0f} % of the references' pixel pattern"
        allowed = "picture and reference of one camera, turned alike, not resampled one by one"
        raise DesignError(received.names[0], what, allowed)


def shared_pattern(received: Received) -> float:
    """Return which share of its references' fixed pattern pictures show; 1 where there is no telling.

    A camera's pixels do not all respond alike (PRNU), and picture and reference show the same pattern P.
    Of second differences, which leave noise and pattern of single pixels, over the local mean: with noise of
    variance s² an exposure, references have the variance P + s²/Fr, pictures P + s²/F, and their covariance
    is P. With unlike numbers of exposures both follow from the two variances, whatever the camera:
    P = (Fr V_r - F V_i)/(Fr - F). The share is the covariance over this P. Turned or exchanged pictures,
    those of another camera, and pictures that were never taken have none of it.
    """
    frames, several = received.frames, received.reference_frames
    if several < 2 * frames:
        return 1.0
    sums = np.zeros(3)
    for image, reference in zip(received.images, received.references, strict=True):
        picture, plain = _pixelwise(image), _pixelwise(reference)
        sums += [np.mean(picture**2), np.mean(plain**2), np.mean(picture * plain)]
    of_picture, of_reference, common = sums
    pattern = (several * of_reference - frames * of_picture) / (several - frames)
    if pattern < 0.3 * of_reference:  # mostly noise: a camera of even pixels
        return 1.0
    return float(common / pattern)


def _pixelwise(counts: NDArray[np.floating]) -> NDArray[np.float64]:
    """What neighbouring pixels do not share, over what they do, (rows - 1, columns - 1)."""
    plain = grey(counts)
    a, b, c, d = plain[:-1, :-1], plain[:-1, 1:], plain[1:, :-1], plain[1:, 1:]
    level = np.maximum((a + b + c + d) / 4, 1.0)
    return np.asarray(((a - b) - (c - d)) / 2 / level)


def coarse(picture: NDArray[np.floating], block: int = BLOCK) -> NDArray[np.float64]:
    """Means of square blocks of pixels, without what is left over at the right and lower border."""
    counts = grey(picture)
    block = min(block, *counts.shape)
    rows, columns = counts.shape[0] // block, counts.shape[1] // block
    cut = counts[: rows * block, : columns * block]
    return np.asarray(cut.reshape(rows, block, columns, block).mean(axis=(1, 3)))
