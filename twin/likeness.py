"""Whether pictures are like those that a model was trained for: tared picture and reference, both coarse.

`learn` takes expected pictures of a sensor and makes of them what cameras like its own deliver: with other
noise and other pixels, a little off in place, scale, turn and brightness. `likeness` is then the share of
these that are less like the learned ones than what a user gives (see `estimation.novelty`). References are
judged too: the tared picture of a brighter sensor is that of a larger inclusion, its reference is not.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from estimation import novelty
from scenes.imager import Camera
from twin.exposure import REFERENCE_FRAMES

Float = NDArray[np.float64]

MISALIGNED_PERCENT = 1.7
"""Standard deviation of shift (of the picture's width), scale and turn of a camera that is still valid: so
that one which is off by 1 % in all of them is not among the strangest."""
_GAIN = 0.01  # standard deviation of the brightness
PATTERN = 1.8
"""PRNU between two cameras, over that of one: of another one that has 1.5 times as much."""
_BLANK = 0.15  # share without an inclusion
_TOLERANCE = 0.005

_WAYS = ("what inclusions do to this sensor's pictures", "the mean of this sensor's pictures")


def learn(
    images: NDArray[np.floating],
    references: NDArray[np.floating],
    camera: Camera,
    block: int,
    seed: int = 0,
    *,
    pictures: int = 1000,
) -> dict[str, Float]:
    """Return arrays that `likeness` needs.

    Parameters
    ----------
    images, references : (n, levels, rows, columns) expected counts of n inclusions (a hundred or more, in
        random order) in coarse pictures, with and without them.
    camera : whose noise they are seen with.
    block : pixels along a side of a coarse picture's block.
    pictures : how many are made of them to learn from, and again to rank; of different inclusions.
    """
    rng = np.random.default_rng(seed)
    lit, plain = np.asarray(images, np.float64), np.asarray(references, np.float64)
    stored = _scales(plain, camera, block)
    split = 2 * len(lit) // 3
    made = [
        _delivered(lit[part], plain[part], camera, block, pictures, rng)
        for part in (slice(split), slice(split, None))
    ]
    features = [_features(stored, *both) for both in made]
    return stored | novelty.fit(features[0], features[1], components=40, tolerance=_TOLERANCE)


def likeness(
    stored: Mapping[str, NDArray[np.floating]],
    images: NDArray[np.floating],
    references: NDArray[np.floating],
) -> tuple[float, str]:
    """Return the likeness of coarse pictures (levels, rows, columns), 0 to 1, and in which way they are the
    strangest, in words, with how many times the usual."""
    features = _features(stored, np.asarray(images)[None], np.asarray(references)[None])
    found = novelty.strangeness(stored, features)[0]
    way = int(np.argmax(found))
    times = "more than 1000" if not found[way] < 1000 else f"{found[way]:.{0 if found[way] > 9.5 else 1}f}"
    return float(novelty.score(stored, features)[0]), f"{times} times as far as usual from {_WAYS[way]}"


def fits(stored: Mapping[str, NDArray[np.floating]], shape: tuple[int, int, int]) -> bool:
    """Return whether arrays from a file are what `learn` gives for pictures (levels, rows, columns)."""
    length, sizes = 2 * int(np.prod(shape)), {name: array.shape for name, array in stored.items()}
    k, ranks = len(stored.get("spread", ())), len(stored.get("smallest", ()))
    wanted = {
        "scale_tared": shape,
        "scale_reference": shape,
        "mean": (length,),
        "components": (k, length),
        "spread": (k,),
        "tolerance": (1,),
        "ranks": (ranks, 2),
        "smallest": (ranks,),
    }
    return sizes == wanted and ranks > 0 and all(stored[name].min() > 0 for name in list(wanted)[:2])


def _scales(plain: Float, camera: Camera, block: int) -> dict[str, Float]:
    """Standard deviations that make features of tared pictures and references, (levels, rows, columns)."""
    mean = plain.mean(axis=0)
    pixel = _pixel_variance(mean, camera) / block**2
    pattern = 0.01 * PATTERN * camera.prnu_percent / block
    tared = np.sqrt(pixel * (1 + 1 / REFERENCE_FRAMES) + (pattern * camera.offset_dn) ** 2)
    reference = np.sqrt(pixel / REFERENCE_FRAMES + (pattern * mean) ** 2)
    return {"scale_tared": tared, "scale_reference": reference}


def _pixel_variance(counts: Float, camera: Camera) -> Float:
    """Of one exposure, counts²: shot noise, read noise and rounding (EMVA 1288; key ``emva1288``)."""
    gain = camera.gain_e_per_dn
    shot = np.maximum(counts - camera.offset_dn, 0.0) / gain
    return np.asarray(shot + (camera.read_noise_e / gain) ** 2 + 1 / 12)


def _features(stored: Mapping[str, NDArray[np.floating]], images: Float, references: Float) -> Float:
    parts = ((images - references) / stored["scale_tared"], references / stored["scale_reference"])
    return np.concatenate([part.reshape(len(part), -1) for part in parts], axis=1)


def _delivered(
    lit: Float, plain: Float, camera: Camera, block: int, count: int, rng: np.random.Generator
) -> tuple[Float, Float]:
    """So many pairs as cameras like this one deliver them, (count, levels, rows, columns) each."""
    chosen = rng.integers(0, len(lit), count)
    levels = lit.shape[1]
    both = np.concatenate([lit[chosen], plain[chosen]], axis=1)
    blank = rng.random(count) < _BLANK
    both[blank, :levels] = both[blank, levels:]
    both = novelty.misaligned(both, rng, MISALIGNED_PERCENT) - camera.offset_dn
    both *= np.exp(_GAIN * rng.standard_normal((count, 1, 1, 1)))
    pattern = 0.01 * PATTERN * camera.prnu_percent / block
    both *= 1.0 + pattern * rng.standard_normal((count, 1, *both.shape[2:]))
    both += camera.offset_dn
    # References of one exposure to many, cameras of half to twice the variance.
    exposures = np.ones((count, 2 * levels, 1, 1))
    exposures[:, levels:] = REFERENCE_FRAMES ** rng.random((count, 1, 1, 1))
    louder = 2.0 ** rng.uniform(-1, 1, (count, 1, 1, 1))
    variance = louder * _pixel_variance(both, camera) / block**2 / exposures
    both += np.sqrt(variance) * rng.standard_normal(both.shape)
    return both[:, :levels], both[:, levels:]
