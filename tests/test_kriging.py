"""Kriging: refits without a sample, an interpolant without noise, lengths that find what matters."""

import numpy as np

from scenes import kriging


def samples(n: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two functions of the first two of three inputs."""
    x = np.random.default_rng(seed).normal(size=(n, 3))
    return x, np.column_stack([np.sin(x[:, 0]) + 0.3 * x[:, 1], np.exp(-(x[:, 0] ** 2)) * x[:, 1]])


def told(x: np.ndarray, nodes: np.ndarray, values: np.ndarray, noise: float) -> np.ndarray:
    return kriging.terms(x, nodes) @ kriging.weights(nodes, values, noise)


def test_left_out_is_what_a_fit_without_the_sample_misses():
    x, y = samples(40, 0)
    x /= 2.0
    missed = kriging.left_out(x, y, 1e-3)
    for number in (0, 7, 39):
        rest = np.arange(40) != number
        guess = told(x[number : number + 1], x[rest], y[rest], 1e-3)[0]
        assert np.allclose(y[number] - guess, missed[number], atol=1e-9)


def test_without_noise_samples_are_met_and_a_mean_is_kept():
    x, y = samples(40, 0)
    assert np.allclose(told(x, x, y, 1e-10), y, atol=1e-6)
    away = told(x + 30.0, x, np.full((40, 1), 5.0), 1e-8)
    sure = kriging._CONSTANT * np.linalg.inv(kriging.covariance(x, x) + 1e-8 * np.eye(40)).sum()
    assert np.allclose(away, 5.0 * sure / (1.0 + sure))  # far from all samples the mean is left, 99.9 % of it
    assert sure > 500.0


def test_covariance_of_one_length_is_materns():
    apart = kriging.covariance(np.zeros((1, 2)), np.array([[0.6, 0.8]]))[0, 0]
    assert np.isclose(apart, (1 + np.sqrt(5) + 5 / 3) * np.exp(-np.sqrt(5)))


def test_lengths_are_short_where_values_change_and_long_where_nothing_does():
    (x, y), (new, true) = samples(150, 1), samples(200, 2)
    noisy = y + 0.02 * np.random.default_rng(3).normal(size=y.shape)
    scales, noise = kriging.lengths(x, noisy)
    assert scales[2] > 10.0 * scales[0]
    missed = told(new / scales, x / scales, noisy, noise) - true
    inner = np.abs(new).max(axis=1) < 2.0
    assert np.sqrt((missed[inner] ** 2).mean()) < 0.02  # below the samples' own noise
    same = told(new / 2.0, x / 2.0, noisy, noise) - true
    assert (missed[inner] ** 2).mean() < 0.5 * (same[inner] ** 2).mean()
