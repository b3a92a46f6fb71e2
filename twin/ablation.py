"""What each part of the pictures is worth: prior-included bounds with only that part to look at."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.stats import norm

from twin.block_noise import mean_variance
from twin.chain import BLOCK, Chain
from twin.estimates import NAMES
from twin.fitting import Prior, differences, expected_layers

Floats = NDArray[np.float64]

_PIXELS = BLOCK[0] * BLOCK[1]


def bounds(chain: Chain, prior: Prior, values: Mapping[str, float]) -> dict[str, Floats]:
    """Return standard deviations (3,) of size, depth and modulus at true values, by what is looked at.

    "three scalars" are the paper's: mean of the 3 x 3 pixels at the maximum, sum, and number of pixels above
    the threshold, of tared pictures; their means and covariance are in closed form for normal noise.

    Raises `fem.NotModelled` where the chain cannot go.
    """
    x = prior.unknowns(values)
    ends, apart = differences(prior, x)
    layers = expected_layers(chain, prior, [x, *ends]).astype(np.float64)
    seen = layers[0]
    slopes = (layers[2::2] - layers[1::2]) / apart.reshape(-1, *(1,) * seen.ndim)
    whole, along = seen.sum(axis=2), slopes.sum(axis=3)
    gain = np.array([chain.gain(values)])
    levels, n_led = len(seen), seen.shape[2]

    def variance(frames: float, of: Floats = whole) -> Floats:
        return mean_variance(chain.design, of[None], gain, frames, rounded=True)[0].astype(np.float64)

    def told(slope: Floats, noise: Floats) -> Floats:
        part = (slope / np.sqrt(noise)).reshape(len(slope), -1)
        return np.asarray(part @ part.T)

    once, names = variance(1), [f"{depth:g} mm" for depth in chain.design.press.indentation_mm]
    found = {f"level {name} alone": told(along[:, n], once[n]) for n, name in enumerate(names)}
    tared = along[:, :, 0] - along[:, :, 1]
    threshold = chain.design.signal.counts
    found |= {
        "all levels": told(along, once),
        "three scalars of each level": _scalars(
            whole[:, 0] - whole[:, 1], tared, once.sum(axis=1), threshold
        ),
        "pictures without their references": told(along[:, :, 0], once[:, 0]),
        "tared pictures alone": told(tared, once.sum(axis=1)),
        f"{n_led} exposures": told(along, variance(n_led)),
        f"{n_led} exposures, one LED each": sum(
            (told(slopes[:, :, :, n], variance(1, seen[:, :, n])) for n in range(n_led)), np.zeros(())
        ),
        "100 exposures": told(along, variance(100)),
        "100 exposures of the first level": told(along[:, 0], variance(100)[0]),
        "100 exposures of the last level": told(along[:, -1], variance(100)[levels - 1]),
    }
    covariances = {name: np.linalg.inv(one + prior.precision) for name, one in found.items()}
    return {name: np.sqrt(np.diag(one)[: len(NAMES)]) for name, one in covariances.items()}


def _scalars(tared: Floats, slopes: Floats, variance: Floats, threshold: float) -> Floats:
    """Information (m, m) of the three scalars of tared pictures (levels, r, c), slopes (m, levels, r, c)."""
    total = np.zeros((len(slopes),) * 2)
    for level, picture in enumerate(tared):
        slope, sd = slopes[:, level].reshape(len(slopes), -1), np.sqrt(variance[level].ravel() * _PIXELS)
        away = (picture.ravel() - threshold) / sd
        top = int(np.argmax(picture))
        density, share = norm.pdf(away), norm.cdf(away)
        means = np.stack([slope[:, top], _PIXELS * slope.sum(axis=1), _PIXELS * slope @ (density / sd)])
        noise = np.array(
            [
                [sd[top] ** 2 / 9.0, sd[top] ** 2, sd[top] * density[top]],
                [sd[top] ** 2, _PIXELS * (sd**2).sum(), _PIXELS * (sd * density).sum()],
                [
                    sd[top] * density[top],
                    _PIXELS * (sd * density).sum(),
                    _PIXELS * (share * (1.0 - share)).sum(),
                ],
            ]
        )
        noise += 1e-9 * np.diag(np.diag(noise)) + 1e-12 * np.eye(3)
        total += means.T @ np.linalg.solve(noise, means)
    return total
