"""A model told how far known inclusions are from what it renders."""

import numpy as np

from twin.discrepancy import shown, shrunk, told_by

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


class Tared:
    """Features that are tared pictures and references themselves."""

    def __call__(self, pictures: np.ndarray) -> np.ndarray:
        tared = pictures[:, :, 0] - pictures[:, :, 1]
        return np.concatenate(
            [tared.reshape(len(tared), -1), pictures[:, :, 1].reshape(len(tared), -1)], axis=1
        )


def test_what_tared_pictures_are_off_by_grows_with_what_they_show() -> None:
    """References off by 0.2 counts, tared pictures by 0.1 times the root of the counts that they show: from
    inclusions of all kinds it is told of faint ones and of bright ones."""
    rng = np.random.default_rng(4)
    bright = rng.uniform(0.1, 20.0, 400)
    own = np.zeros((400, 2, 2, 2, 2))
    own[:, :, 0] = bright[:, None, None, None]
    seen = own + 0.2 * rng.standard_normal((400, 2, 1, 2, 2))
    seen[:, :, 0] += 0.1 * np.sqrt(bright)[:, None, None, None] * rng.standard_normal((400, 2, 2, 2))
    found = told_by(Tared(), seen, own)  # type: ignore[arg-type]
    for one in own[[bright.argmin(), bright.argmax()]]:
        sd = np.sqrt(np.diag(found.at(one)))
        assert np.allclose(sd[:8], 0.1 * np.sqrt(shown(one)), rtol=0.15, atol=0.01)
        assert np.allclose(sd[8:], 0.2, rtol=0.15)
