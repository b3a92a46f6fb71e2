"""A model told how far known inclusions are from what it renders."""

import numpy as np
import pytest

from estimation.features import Features
from twin.discrepancy import alike, evened, shown, shrunk, smooth, told_by

SHAPE = (2, 2, 6, 8)
K = 2 * 6 * 8 * 2
PLAIN = Features(np.zeros(K), np.eye(K), np.ones((2, 2, 1, 1)), np.ones(K), SHAPE)  # type: ignore[arg-type]
"""Features that are tared pictures and references themselves."""


def likelihood(covariance: np.ndarray, errors: np.ndarray) -> float:
    """Mean log density of errors (n, k), but for a constant."""
    white = np.linalg.solve(np.linalg.cholesky(covariance), errors.T)
    return float(-0.5 * (white**2).sum(axis=0).mean() - 0.5 * np.linalg.slogdet(covariance)[1])


def test_smooth_fields_have_materns_covariance() -> None:
    """In tared pictures by what is added to them alone, in references by what is added to both."""
    found = smooth(PLAIN, np.array([3.0, 4.0]), np.array([1.0, 2.0]), 2.5).reshape(*SHAPE, *SHAPE)

    def covariance(apart: float) -> float:
        r = np.sqrt(5.0) * apart / 2.5
        return float((1 + r + r**2 / 3) * np.exp(-r))

    for level, part, sd in ((0, 0, 1.0), (1, 0, 2.0), (0, 1, 3.0), (1, 1, 4.0)):
        here = found[level, part, 2, 3, level, part]
        assert here[2, 3] == pytest.approx(sd**2)
        assert here[5, 3] == pytest.approx(sd**2 * covariance(3.0))
        assert here[4, 7] == pytest.approx(sd**2 * covariance(2.0) * covariance(4.0))  # a product, as told
    assert np.all(found[0, 0, :, :, 0, 1] == 0.0) and np.all(found[0, 0, :, :, 1, 0] == 0.0)


def test_few_errors_give_a_covariance_to_be_trusted() -> None:
    """Of 15 errors in 192 dimensions: new ones are likelier by it than by the diagonal alone where errors are
    smooth; of many, it is the truth."""
    rng = np.random.default_rng(0)
    sds = np.array([1.0, 2.0]), np.array([0.5, 0.3])
    true = smooth(PLAIN, *sds, 2.2) + 1e-4 * np.eye(K)
    targets = [smooth(PLAIN, *sds, length) for length in (1.0, 2.0, 4.0)]
    some, many, new = (rng.standard_normal((n, K)) @ np.linalg.cholesky(true).T for n in (15, 6000, 1500))
    best = likelihood(true, new)
    found = best - likelihood(shrunk(some, targets), new)
    moments = np.diag((some**2).mean(axis=0))
    assert 0.0 < found < 20.0 < 100.0 < best - likelihood(moments, new)
    assert 0.0 < best - likelihood(shrunk(many, targets), new) < 3.0


def test_a_bias_counts_as_an_error() -> None:
    """What all pictures are off by in the same way is not taken for sure."""
    bias = np.linspace(-3.0, 3.0, K)
    found = shrunk(bias + 0.1 * np.random.default_rng(2).standard_normal((20, K)), [np.eye(K)])
    way = bias / np.linalg.norm(bias)
    assert way @ found @ way > 0.5 * bias @ bias


def test_what_tared_pictures_are_off_by_grows_with_what_they_show() -> None:
    """References off by 0.2 counts, tared pictures by 0.1 times the root of the counts that they show: from
    inclusions of all kinds it is told of faint ones and of bright ones."""
    rng = np.random.default_rng(4)
    bright = rng.uniform(0.1, 20.0, 400)
    own = np.zeros((400, *SHAPE))
    own[:, :, 0] = bright[:, None, None, None]
    seen = own + 0.2 * rng.standard_normal((400, 2, 1, 6, 8))
    seen[:, :, 0] += 0.1 * np.sqrt(bright)[:, None, None, None] * rng.standard_normal((400, 2, 6, 8))
    found = told_by(PLAIN, seen, own, np.ones((2, 6, 8), np.float32), np.ones(2, np.float32))
    for one in own[[bright.argmin(), bright.argmax()]]:
        sd = np.sqrt(np.diag(found.at(one))).reshape(SHAPE)
        assert np.allclose(sd[:, 0], 0.1 * np.sqrt(shown(one)), rtol=0.15, atol=0.01)
        assert np.allclose(sd[:, 1], 0.2, rtol=0.15)


def drawn(many: int, rng: np.random.Generator) -> np.ndarray:
    """Pictures (many, 2, 2, 6, 8) of blobs over references of some 100 counts."""
    y, x = np.meshgrid(np.linspace(-1, 1, 6), np.linspace(-1, 1, 8), indexing="ij")
    references = 100.0 + 10.0 * rng.standard_normal((many, 1, 1, 1)) * x + np.zeros((many, 2, 6, 8))
    blobs = np.exp(-(x**2 + y**2) / rng.uniform(0.1, 0.5, (many, 1, 1, 1)))
    own = np.stack([references + rng.uniform(2, 30, (many, 1, 1, 1)) * blobs, references], axis=2)
    return own.astype(np.float32)


def test_what_is_off_every_time_is_taken_out() -> None:
    """A field of 0.3 % and tared pictures 1 % too weak, under errors that differ from sample to sample."""
    rng = np.random.default_rng(5)
    own, more = drawn(16, rng), drawn(200, rng)
    true = 1.0 + 0.003 * rng.standard_normal((2, 6, 8)), np.array([0.99, 1.0])

    def taken(pictures: np.ndarray) -> np.ndarray:
        tared = true[1][:, None, None] * (pictures[:, :, 0] - pictures[:, :, 1])
        each = 1.0 + 1e-3 * rng.standard_normal((len(pictures), 2, 6, 8))
        return np.stack([pictures[:, :, 1] + tared, pictures[:, :, 1]], axis=2) * (true[0] * each)[:, :, None]

    flat, share = alike(taken(own), own)
    assert np.sqrt(np.mean((flat - true[0]) ** 2)) < 5e-4  # a quarter of 1e-3, and what shrinking takes
    assert share == pytest.approx(true[1], abs=2e-3)
    left = evened(taken(more), flat, share) - more
    assert np.abs(left.mean(axis=0)[:, 1]).max() < 0.2 < np.abs((taken(more) - more).mean(axis=0)).max()


def test_chance_is_not_taken_for_what_is_off_every_time() -> None:
    """Of errors that have nothing in common less is taken out than their mean."""
    rng = np.random.default_rng(6)
    own = drawn(16, rng)
    seen = own * (1.0 + 2e-3 * rng.standard_normal((16, 2, 1, 6, 8)))
    flat, share = alike(seen.astype(np.float32), own)
    chance = (seen[:, :, 1] / own[:, :, 1] - 1.0).mean(axis=0)
    assert np.sqrt(np.mean((flat - 1.0) ** 2)) < 0.5 * np.sqrt(np.mean(chance**2))
    assert np.abs(share - 1.0).max() < 2e-3
