"""What blocks of pixels are off by in exposures and their means: photons, reading, rounding.

Counts are above black and coarse (`chain.BLOCK`), (n, ..., r, c); gain (n,) in electrons per count.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from estimation.posterior import REFERENCE_FRAMES
from twin.chain import BLOCK
from twin.design import Design
from twin.retake import squares

Single = NDArray[np.float32]

_PIXELS = BLOCK[0] * BLOCK[1]


def noise_variance(
    design: Design, counts: NDArray[np.floating], gain: NDArray[np.floating], *, rounded: bool = False
) -> tuple[Single, Single]:
    """Return what a block of pixels is off by, counts²: the variance of one exposure, and what no further
    exposure averages out.

    The first is of photons, dark charge, reading (EMVA 1288 release 4.0 linear, section 2; [emva1288]) and
    rounding. The second is what rounding does every time alike, because the rest of the noise is too small to
    blur the counts' steps: waves sin(2πkµ) exp(-2π²k²s²)/(πk) of a pixel's mean µ and noise s (Widrow and
    Kollár 2008, chapter 4; [widrow2008]). Pixels of one block share their phase, but for what spreads their
    means: the camera's pattern and the picture's slope.

    With ``rounded``, what pixels share is in the expected pictures (`rounding`) and no noise.
    """
    noise, pattern, slopes = _spreads(design, counts, gain)
    spread = pattern if rounded else pattern + (slopes[0] ** 2 + slopes[1] ** 2) / 12.0
    blur, shared = (np.exp(-4.0 * np.pi**2 * one, dtype=np.float32) for one in (noise, spread))
    stays, random = np.zeros_like(blur), (noise + 1.0 / 12.0) / _PIXELS
    for k, (wave, together) in enumerate(zip(squares(blur), squares(shared), strict=True), start=1):
        wave /= np.float32(2.0 * np.pi**2 * k * k)
        stays += wave * ((0.0 if rounded else together) + (1.0 - together) / _PIXELS)
        random -= wave / _PIXELS
    return np.asarray(random, np.float32), np.asarray(stays, np.float32)


def mean_variance(
    design: Design,
    counts: NDArray[np.floating],
    gain: NDArray[np.floating],
    frames: float,
    *,
    rounded: bool = False,
) -> Single:
    """Return the same of means, for counts (n, ..., 2, r, c) of pictures and references: pictures are the
    mean of so many exposures, references of as many, but `REFERENCE_FRAMES` at least."""
    random, stays = noise_variance(design, counts, gain, rounded=rounded)
    count = np.array([frames, max(frames, REFERENCE_FRAMES)], np.float32).reshape(2, 1, 1)
    return random / count + stays


def rounding(design: Design, counts: NDArray[np.floating], gain: NDArray[np.floating]) -> Single:
    """Return how far above the light a block's mean over many exposures is, counts: the waves of
    `noise_variance` that its pixels share.

    They are alike in a picture and its reference, and in blocks as bright, so that they are no noise of each
    block's own; and they are known once a picture is to a tenth of a count.
    """
    camera = design.camera
    noise, pattern, slopes = _spreads(design, counts, gain)
    black = camera.offset_dn + _dark_e(design) / _wide(gain, counts)
    turn, blur = 2.0 * np.pi * (counts + black), np.exp(-2.0 * np.pi**2 * (noise + pattern))
    found = np.zeros_like(blur)
    for k, wave in enumerate(squares(blur), start=1):
        across = np.sinc(k * slopes[0]) * np.sinc(k * slopes[1])  # a plane's mean over the block
        found += (-1) ** k / (np.pi * k) * np.sin(k * turn) * wave * across
    return np.asarray(found, np.float32)


def _spreads(
    design: Design, counts: NDArray[np.floating], gain: NDArray[np.floating]
) -> tuple[Single, Single, list[Single]]:
    """Variances of a pixel's noise before rounding and of the camera's pattern, counts², and by how much
    counts rise from block to block along rows and columns."""
    camera, gain = design.camera, _wide(gain, counts)
    light = np.maximum(counts, 0.0)
    noise = (light * gain + camera.read_noise_e**2 + _dark_e(design)) / gain**2
    pattern = (camera.dsnu_e / gain) ** 2 + (0.01 * camera.prnu_percent * light) ** 2
    return noise, pattern, list(np.gradient(counts, axis=(-2, -1)))


def _dark_e(design: Design) -> float:
    camera = design.camera
    return camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2


def _wide(gain: NDArray[np.floating], counts: NDArray[np.floating]) -> Single:
    return np.asarray(gain, np.float32).reshape(-1, *(1,) * (counts.ndim - 1))
