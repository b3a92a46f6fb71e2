"""Is there an inclusion at all? Evidence for one over evidence for none.

A network that is trained to tell misses faint ones, and is sure of nonsense where references are a little
off. Here both cases are fitted with all that is unknown, and what the chain is off by is in the noise, in
both as much as with the inclusion that is found; where neither fit is explained by that, it is taken for
louder, so that the better one is. Evidences are Laplace's (MacKay 2003, section 28.1; [mackay2003]), odds
before are even.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import expit

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import Fitted, Prior, covariance, differences, expected, inside, jacobian
from twin.study import PARAMETERS

Floats = NDArray[np.float64]

_STEPS = 6  # of Gauss and Newton: references change evenly


def presence(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    frames: float,
    fitted: Fitted,
    off: Floats,
) -> float:
    """Return the probability, 0 to 1, that there is an inclusion, for features (k,) of pictures that are
    means of so many exposures.

    Parameters
    ----------
    fitted : the most probable specimen with one, by the chain.
    off : (k, k) covariance of what features of its pictures are off by, besides noise.
    """
    seen, slopes = jacobian(chain, features, prior, fitted.x)
    gain = chain.gain(prior.values(fitted.x))
    noise = linalg.cho_factor(covariance(chain, features, seen, gain, frames, prior.pattern) + off)
    precision = prior.precision

    def judged(x: Floats, seen: NDArray[np.float32], slopes: Floats) -> tuple[_Case, Floats]:
        """A case around x (5 + q,), and the step of Gauss and Newton from there."""
        rest, away = observed - features(seen[None])[0], x - prior.middle
        information = slopes @ linalg.cho_solve(noise, slopes.T) + precision
        square = float(rest @ linalg.cho_solve(noise, rest))
        slope = slopes @ linalg.cho_solve(noise, rest) - precision @ away
        case = _Case(square, float(away @ precision @ away + np.linalg.slogdet(information)[1]))
        return case, np.linalg.solve(information, slope)

    there, _ = judged(fitted.x, seen, slopes)
    x = np.concatenate([prior.middle[: len(PARAMETERS)], fitted.x[len(PARAMETERS) :]])
    for _ in range(_STEPS):
        absent, step = judged(x, *_without(chain, features, prior, x))
        x = inside(prior, x + step)
    louder = max(1.0, min(there.square, absent.square) / len(observed))
    return float(expit(absent.lost(louder) - there.lost(louder)))


@dataclass(frozen=True)
class _Case:
    """Chi-square of the features, and what the prior and the width of the posterior cost, twice a log."""

    square: float
    cost: float

    def lost(self, louder: float) -> float:
        """Minus the log evidence, but for what both cases share, with so many times the noise's variance."""
        return 0.5 * (self.square / louder + self.cost)


def _without(chain: Chain, features: Features, prior: Prior, x: Floats) -> tuple[NDArray[np.float32], Floats]:
    """Pictures (levels, 2, r, c) without inclusion, and derivatives (5 + q, k) of their features."""
    ends, apart = differences(prior, x)
    plain = expected(chain, prior, [x, *ends])[:, :, 1]
    seen = np.stack([plain, plain], axis=2)
    found = features(seen[1:]).astype(np.float64)
    return seen[0], (found[1::2] - found[::2]) / apart[:, None]
