"""What rendered pictures are off by: by the same every time, and a normal error of features.

What learned light and the emulator are off by everywhere is taken out of pictures before a fit looks at them:
a field that all pictures of a press level are multiplied by, as a flat field, and a factor of what inclusions
change. What is left moves references by as much whatever is pressed, and tared pictures by more the more the
inclusion shows: as the square root of it (25 solved inclusions: ESTIMATE.md), so that its variance is told
per count.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from estimation.features import Features
from scenes.kriging import matern

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_SHARES = (1e-3, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97)
_LENGTHS = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Over which errors of pictures may change, blocks."""
_NUGGET = 1e-9  # of the mean variance: very smooth fields leave directions out


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """What pictures are off by.

    Attributes
    ----------
    common, tared : (k, k) second moments of what features are off by: of what a picture and its reference are
        off by together, and, per count that tared pictures show (`shown`), of what the inclusion's are.
    flat : (levels, r, c), what pictures and references are of rendered ones, every time.
    share : (levels,), what tared pictures are of rendered ones beyond that.
    """

    common: Floats
    tared: Floats
    flat: Single
    share: Single

    def without(self, pictures: NDArray[np.floating]) -> Single:
        """Return pictures (levels, 2, r, c) without what they are off by every time."""
        return evened(pictures, self.flat, self.share)

    def at(self, pictures: NDArray[np.floating]) -> Floats:
        """Those of pictures (levels, 2, ...)."""
        return self.common + shown(pictures) * self.tared


def shown(pictures: NDArray[np.floating]) -> float:
    """What tared pictures show, of pictures (levels, 2, ...): their root mean square, counts."""
    return float(np.sqrt(np.mean(np.square(pictures[:, 0] - pictures[:, 1], dtype=np.float64))))


def evened(pictures: NDArray[np.floating], flat: Single, share: Single) -> Single:
    """Return pictures (..., levels, 2, r, c) over their flat field, and what they add to references over its
    share."""
    level = np.asarray(pictures, np.float32) / flat[:, None]
    picture, reference = level[..., 0, :, :], level[..., 1, :, :]
    again = reference + (picture - reference) / share[:, None, None]
    return np.stack([again, reference], axis=-3)


def alike(seen: Single, own: Single) -> tuple[Single, Single]:
    """Return flat field (levels, r, c) and shares (levels,) of n inclusions' pictures and of what is rendered
    for them, (n, levels, 2, r, c): no more of them than n samples tell.

    Each is shrunk towards 1 by what it owes to chance (James and Stein 1961; [james1961]).
    """
    n = len(seen)
    over = seen[:, :, 1].astype(np.float64) / own[:, :, 1] - 1.0
    always = over.mean(axis=0)
    sure = _sure(over.var(axis=0, ddof=1).mean(axis=(1, 2)) / n, (always**2).mean(axis=(1, 2)))
    flat = (1.0 + always * sure[:, None, None]).astype(np.float32)
    level = evened(seen, flat, np.ones(len(flat), np.float32))
    tared, expected = (one[:, :, 0].astype(np.float64) - one[:, :, 1] for one in (level, own))
    counts = np.array([shown(one) for one in own])[:, None]  # as which the variance grows
    off, whole = ((one * expected).sum(axis=(2, 3)) / counts for one in (tared - expected, expected))
    off /= whole.mean(axis=0)
    share = 1.0 + off.mean(axis=0) * _sure(off.var(axis=0, ddof=1) / n, off.mean(axis=0) ** 2)
    return flat, share.astype(np.float32)


def _sure(by_chance: Floats, found: Floats) -> Floats:
    return np.maximum(1.0 - by_chance / np.maximum(found, 1e-30), 0.0)


def told_by(features: Features, seen: Single, own: Single, flat: Single, share: Single) -> Discrepancy:
    """Return that of n inclusions' pictures, evened, and of what is rendered for them, (n, levels, 2, r, c).

    What is off every time is told by the same samples: what is left of them is a little small for others.
    """
    n, counts = len(own), np.array([shown(one) for one in own])
    references = own.copy()
    references += (seen[:, :, 1] - own[:, :, 1])[:, :, None]
    common = _told(features, own, references, np.ones(n))
    tared = _told(features, references, seen, counts)
    return Discrepancy(n / (n - 1) * common, n / (n - 1) * tared, flat, share)


def error_of(features: Features, true: Single, found: Single) -> Floats:
    """Return the second moments (k, k) of what features of n pictures (n, levels, 2, r, c) are off by."""
    return _told(features, true, found, np.ones(len(true)))


def _told(features: Features, true: Single, found: Single, counts: Floats) -> Floats:
    """Second moments of features of what pictures are off by, over the root of counts (n,) each."""
    apart = (found - true) / np.sqrt(counts).astype(np.float32)[:, None, None, None, None]
    alone = np.sqrt(np.mean((apart[:, :, 0] - apart[:, :, 1]).astype(np.float64) ** 2, axis=(0, 2, 3)))
    both = np.sqrt(np.mean(apart[:, :, 1].astype(np.float64) ** 2, axis=(0, 2, 3)))
    errors = (features(found).astype(np.float64) - features(true)) / np.sqrt(counts)[:, None]
    return shrunk(errors, [smooth(features, both, alone, length) for length in _LENGTHS])


def smooth(features: Features, both: Floats, alone: Floats, length: float) -> Floats:
    """Return the covariance (k, k) of features of pictures to which smooth fields are added, one to each
    picture and its reference, and one to the picture alone.

    Parameters
    ----------
    both, alone : (levels,) their standard deviations, counts.
    length : of their covariance, a product of Matérn's of order 5/2 down and along, blocks.
    """
    levels, _, rows, columns = features.shape
    down, along = (
        matern(np.subtract.outer(np.arange(side), np.arange(side)) ** 2 / length**2)
        for side in (rows, columns)
    )
    onto = features.onto.astype(np.float64)
    found = np.zeros((onto.shape[-1],) * 2)
    for level in range(levels):
        for one, sd in ((onto[level].sum(axis=0), both[level]), (onto[level, 0], alone[level])):
            field = sd * one.reshape(rows, columns, -1)
            found += np.einsum(
                "rck,rcj->kj", field, np.einsum("rs,cd,sdj->rcj", down, along, field, optimize=True)
            )
    return found


def shrunk(errors: Floats, targets: Sequence[Floats]) -> Floats:
    """Return the second moments (k, k) of few errors (n, k), shrunk towards one of some covariances (k, k).

    Which, and the weight, are those under which errors that are left out are likeliest. (Ledoit and Wolf
    2004, [ledoit2004], weigh by the expected square instead, which forgives directions that are taken for
    sure.) Smooth fields tell of directions that few errors have not shown.
    """
    n = len(errors)
    moments = errors.T @ errors / n
    found: list[tuple[float, Floats]] = []
    for target in targets:
        kept = target + _NUGGET * np.trace(target) / len(target) * np.eye(len(target))
        for a in _SHARES:
            # one error left out takes a rank from the moments (Sherman and Morrison 1950; [sherman1950])
            root = linalg.cholesky((1.0 - a) * n / (n - 1) * moments + a * kept, lower=True)
            lost = (
                (1.0 - a) / (n - 1) * (linalg.solve_triangular(root, errors.T, lower=True) ** 2).sum(axis=0)
            )
            square = (n - 1) / (1.0 - a) * lost / (1.0 - lost)
            logs = 2.0 * np.log(np.diag(root)).sum() + np.log1p(-lost)
            found.append((float((square + logs).sum()), (1.0 - a) * moments + a * kept))
    return np.asarray(min(found, key=lambda one: one[0])[1])
