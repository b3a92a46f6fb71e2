"""What rendered pictures are off by: a normal error of features, more of it the more the inclusion shows.

Light that is noisy or learned moves references by as much whatever is pressed. What it and the emulator move
tared pictures by grows as the square root of what these show (25 solved inclusions: ESTIMATE.md): its
variance is told per count.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from estimation.features import Features

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_SHARES = (1e-3, 3e-3, 0.01, 0.03, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.97)
_COMMON = (0.01, 0.1, 0.25, 0.5, 0.75, 1.0)


@dataclass(frozen=True, eq=False)
class Discrepancy:
    """Second moments (k, k) of what features are off by: of what a picture and its reference are off by
    together, and, per count that tared pictures show (`shown`), of what the inclusion's are."""

    common: Floats
    tared: Floats

    def at(self, pictures: NDArray[np.floating]) -> Floats:
        """Those of pictures (levels, 2, ...)."""
        return self.common + shown(pictures) * self.tared


def shown(pictures: NDArray[np.floating]) -> float:
    """What tared pictures show, of pictures (levels, 2, ...): their root mean square, counts."""
    return float(np.sqrt(np.mean(np.square(pictures[:, 0] - pictures[:, 1], dtype=np.float64))))


def told_by(features: Features, seen: Single, own: Single) -> Discrepancy:
    """Return that of n inclusions' pictures and of what is rendered for them, (n, levels, 2, r, c)."""
    references = own.copy()
    references += (seen[:, :, 1] - own[:, :, 1])[:, :, None]
    rendered, moved, found = (features(one).astype(np.float64) for one in (own, references, seen))
    counts = np.array([[shown(one)] for one in own])
    return Discrepancy(shrunk(moved - rendered), shrunk((found - moved) / np.sqrt(counts)))


def shrunk(errors: Floats) -> Floats:
    """Return the second moments (k, k) of few errors (n, k), shrunk towards their diagonal, and that towards
    its mean.

    Both weights are those under which errors that are left out are likeliest; only the diagonal knows of
    them. (Ledoit and Wolf 2004, [ledoit2004], weigh by the expected square instead, which forgives directions
    that are taken for sure.)
    """
    n = len(errors)
    moments = errors.T @ errors / n
    own = np.diag(moments)
    found: list[tuple[float, Floats]] = []
    for a in _SHARES:
        for b in _COMMON:
            target = np.diag((1.0 - b) * own + b * own.mean())
            # one error left out takes a rank from the moments (Sherman and Morrison 1950; [sherman1950])
            root = linalg.cholesky((1.0 - a) * n / (n - 1) * moments + a * target, lower=True)
            lost = (
                (1.0 - a) / (n - 1) * (linalg.solve_triangular(root, errors.T, lower=True) ** 2).sum(axis=0)
            )
            square = (n - 1) / (1.0 - a) * lost / (1.0 - lost)
            logs = 2.0 * np.log(np.diag(root)).sum() + np.log1p(-lost)
            found.append((float((square + logs).sum()), (1.0 - a) * moments + a * target))
    return np.asarray(min(found, key=lambda one: one[0])[1])
