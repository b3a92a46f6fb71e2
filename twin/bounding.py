"""The bound: how well pictures can tell an inclusion at best, by the model that they are estimated with.

The chain knows the light by a map. What that is off by hardly matters across the valley of inclusions that
look nearly the same (`twin.valley`), where pictures tell much. Along it size, depth and modulus change them
against each other, and an error of a hundredth in each is a tenth of the little that is left: there two
rendered specimens tell what pictures change by.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import Prior, covariance, expected, jacobian
from twin.study import PARAMETERS
from twin.valley_steps import onto

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_MODULUS = PARAMETERS.index("modulus_kPa")
_APART_KPA = 2.0  # either way
_SHARES = (1.0, 0.5, 0.25)
_FRAMES = 100.0  # whose valley is followed: that of one exposure goes the same way


def limits(
    chain: Chain,
    features: Features,
    prior: Prior,
    values: Mapping[str, float],
    frames: float,
    off: Callable[[NDArray[np.floating]], Floats | float] = lambda pictures: 0.0,
    more: Floats | float = 0.0,
) -> tuple[Floats, float]:
    """Return the prior-included bound (5 + q, 5 + q) at true values, (J C⁻¹ Jᵀ + P)⁻¹, and the deflection d'
    with which an ideal observer tells the inclusion from none (see `estimation.detection`).

    Parameters
    ----------
    off : the covariance (k, k) of what features of pictures (levels, 2, r, c) are off by, besides noise.
    more : (k,) what `more_along_valley` gave, where pictures are rendered.

    Raises `fem.NotModelled` where the chain cannot go.
    """
    x = prior.unknowns(values)
    seen, slopes = jacobian(chain, features, prior, x)
    slopes[_MODULUS] += more
    noise = _noise(chain, features, prior, x, seen, frames) + off(seen)
    without = np.stack([seen[:, 1], seen[:, 1]], axis=1)
    signal = (features(seen[None])[0] - features(without[None])[0]).astype(np.float64)
    nuisance = slopes[len(PARAMETERS) :]
    least = signal @ np.linalg.solve(noise + nuisance.T @ nuisance, signal)
    return _bound(prior, slopes, noise), float(np.sqrt(max(least, 0.0)))


def more_along_valley(
    chain: Chain,
    features: Features,
    prior: Prior,
    values: Mapping[str, float],
    render: Callable[[Mapping[str, float]], Single],
) -> Floats:
    """Return by how much more than the chain's features (k,) those of rendered pictures rise a kPa, where
    all else follows the valley at true values.

    As a correction of the derivative by modulus alone it makes the one along the valley right; derivatives
    across it, by size and depth, stay the chain's. Zero where the valley leaves the ranges on both sides.

    Parameters
    ----------
    render : expected pictures without their references, (levels, 1, r, c), which do not show the inclusion.

    Raises `fem.NotModelled` where the chain cannot go.
    """
    x = prior.unknowns(values)
    seen, slopes = jacobian(chain, features, prior, x)
    bound = _bound(prior, slopes, _noise(chain, features, prior, x, seen, _FRAMES))
    way = bound[:, _MODULUS] / bound[_MODULUS, _MODULUS]
    tissue_kPa = chain.design.specimen.modulus_kPa
    ends = [_furthest(prior, x, way, sign, tissue_kPa) for sign in (-1.0, 1.0)]
    apart = ends[1][_MODULUS] - ends[0][_MODULUS]
    if apart == 0.0:
        return np.zeros(slopes.shape[1])
    mapped = expected(chain, prior, ends)
    pressed = np.stack([render(prior.values(end)) for end in ends])
    off = features(np.concatenate([pressed, mapped[:, :, 1:]], axis=2)) - features(mapped)
    return np.asarray((off[1] - off[0]) / apart, np.float64)


def _furthest(prior: Prior, x: Floats, way: Floats, sign: float, tissue_kPa: float) -> Floats:
    """Where the valley along a ``way`` (5 + q,) from x leads within the prior's ranges; x at their end."""
    low, high = prior.ranges.T
    for share in _SHARES:
        modulus_kPa = float(x[_MODULUS] + sign * share * _APART_KPA)
        end = onto(x, way, modulus_kPa, prior.ranges[_MODULUS], tissue_kPa)
        if np.all((low <= end[: len(low)]) & (end[: len(low)] <= high)):
            return end
    return x


def _noise(chain: Chain, features: Features, prior: Prior, x: Floats, seen: Single, frames: float) -> Floats:
    return covariance(chain, features, seen, chain.gain(prior.values(x)), frames, rounded=True)


def _bound(prior: Prior, slopes: Floats, noise: Floats) -> Floats:
    told = slopes @ np.linalg.solve(noise, slopes.T)
    return np.asarray(np.linalg.inv(told + prior.precision))
