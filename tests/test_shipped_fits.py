"""Fits of the model that ships, by its own chain: where they end."""

import numpy as np
import pytest
from numpy.typing import NDArray

from twin.estimator_file import load_estimator
from twin.fitting import covariance, expected, fit, inside, jacobian, reachable

Floats = NDArray[np.float64]


@pytest.mark.parametrize("frames", [1.0, 100.0])
def test_no_fit_ends_less_likely_than_the_truth(frames: float) -> None:
    """From a standard deviation of one exposure beside it, along the valley of inclusions that look alike."""
    estimator, rng = load_estimator("tsis"), np.random.default_rng(3)
    chain, prior, features = estimator.chain, estimator.prior, estimator.features
    low, high = prior.ranges.T
    lost = []
    for _ in range(12):
        x = rng.standard_normal(len(prior.middle))
        x[:5] = low + (high - low) * rng.random(5)
        x = prior.unknowns(reachable(chain, prior.values(inside(prior, x))))
        seen, slopes = jacobian(chain, features, prior, x)
        gain = chain.gain(prior.values(x))
        once, noise = (covariance(chain, features, seen, gain, n) for n in (1.0, frames))
        told = np.linalg.inv(slopes @ np.linalg.solve(once, slopes.T) + prior.precision)
        beside = x + rng.choice([-1.0, 1.0]) * told[:, 2] / np.sqrt(told[2, 2])
        observed = features(seen[None])[0] + np.linalg.cholesky(noise) @ rng.standard_normal(len(noise))
        found = fit(chain, features, prior, observed, frames, beside)

        rest = observed - features(expected(chain, prior, [found.x, x]))
        away = np.stack([found.x, x]) - prior.middle
        cost = np.einsum("nk,nk->n", rest, np.linalg.solve(noise, rest.T).T)
        cost += np.einsum("ni,ij,nj->n", away, prior.precision, away)
        lost.append(cost[0] - cost[1])
    print(frames, np.round(lost, 2))
    assert max(lost) < 0.1
