"""A model told how far known inclusions are from what it renders."""

import numpy as np

from twin.calibrate import shrunk

K = 40


def likelihood(covariance: np.ndarray, errors: np.ndarray) -> float:
    """Mean log density of errors (n, K), but for a constant."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    return float(-0.5 * (white**2).sum(axis=0).mean() - 0.5 * np.linalg.slogdet(covariance)[1])


def test_few_errors_give_a_covariance_to_be_trusted() -> None:
    """Of 15 errors in 40 dimensions: new ones are likelier by it than by the diagonal alone where errors go
    together; of many, it is the truth."""
    rng = np.random.default_rng(0)
    together = rng.standard_normal((K, 2))
    true = together @ together.T + 0.1 * np.eye(K)
    some, many, new = (rng.standard_normal((n, K)) @ np.linalg.cholesky(true).T for n in (15, 1500, 1500))
    best = likelihood(true, new)
    found = best - likelihood(shrunk(some), new)
    moments = np.diag((some**2).mean(axis=0))
    assert 0.0 < found < best - likelihood(moments, new) - 5.0
    assert 0.0 < best - likelihood(shrunk(many), new) < 0.3


def test_a_bias_counts_as_an_error() -> None:
    """What all pictures are off by in the same way is not taken for sure."""
    bias = np.linspace(-3.0, 3.0, K)
    found = shrunk(bias + 0.1 * np.random.default_rng(2).standard_normal((20, K)))
    way = bias / np.linalg.norm(bias)
    assert way @ found @ way > 0.5 * bias @ bias
