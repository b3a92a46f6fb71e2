"""Kriging: refits without a pair, an interpolant without noise, lengths that find what matters."""

import numpy as np

from scenes import kriging
from scenes.kriging import Kernel, Noise

ALL_STATE = Kernel(2, 1.0, 1.0)


def samples(pairs: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Two functions of two of three states; what is added, a fortieth as large, turns with the first."""
    rng = np.random.default_rng(seed)
    x = np.repeat(np.column_stack([rng.normal(size=(pairs, 3)), rng.uniform(-1.0, 1.0, pairs)]), 2, axis=0)
    x[1::2, 3] = 0.0
    return x, np.column_stack([np.sin(x[:, 0]) + 0.3 * x[:, 1], np.exp(-(x[:, 0] ** 2)) * x[:, 1]]) + effect(
        x
    )


def effect(x: np.ndarray) -> np.ndarray:
    return 0.03 * (x[:, 3] * np.cos(3.0 * x[:, 0]))[:, None] * [1.0, -1.0]


def told(kernel: Kernel, x: np.ndarray, nodes: np.ndarray, values: np.ndarray, noise: Noise) -> np.ndarray:
    return kernel.terms(x, nodes) @ kriging.weights(kernel, nodes, values, noise)


def test_left_out_is_what_a_fit_without_the_pair_misses():
    x, y = samples(20, 0)
    kernel, noise = Kernel(3, 0.7, 2.0), Noise(1e-3, 5.0)
    missed = kriging.left_out(kernel, x, y, noise)
    for pair in (0, 7, 19):
        rest = np.arange(40) // 2 != pair
        guess = told(kernel, x[~rest], x[rest], y[rest], noise)
        assert np.allclose(y[~rest] - guess, missed[~rest], atol=1e-9)


def test_without_noise_samples_are_met_and_a_mean_is_kept():
    x, y = samples(20, 0)
    kernel, none = Kernel(3, 0.7, 2.0), Noise(1e-10, 1e-3)
    assert np.allclose(told(kernel, x, x, y, none), y, atol=1e-6)
    x = np.random.default_rng(1).normal(size=(40, 2))
    away = told(ALL_STATE, x + 30.0, x, np.full((40, 1), 5.0), Noise(1e-8, 1e-3))
    inverse = np.linalg.inv(ALL_STATE(x, x) + 1e-8 * np.eye(40))
    sure = kriging._CONSTANT * inverse.sum()
    assert np.allclose(away, 5.0 * sure / (1.0 + sure))  # far from all samples the mean is left, 99.9 % of it
    assert sure > 500.0


def test_covariances_are_materns_and_what_is_added_counts_by_its_size():
    apart = np.array([[0.6, 0.8]])
    matern = (1 + np.sqrt(5) + 5 / 3) * np.exp(-np.sqrt(5))
    assert np.isclose(ALL_STATE(np.zeros((1, 2)), apart)[0, 0], matern)
    kernel = Kernel(1, 2.0, 3.0)
    a, b = np.array([[0.0, 3.0]]), np.array([[2.0, 3.0]])
    expected = kriging.matern(np.array(4.0)) + 9.0 * matern  # two lengths apart, of coefficients one
    assert np.isclose(kernel(a, b)[0, 0], expected)
    assert np.isclose(kernel(a, 0.0 * b)[0, 0], 1.0)  # nothing added: the state's alone


def test_pairs_have_more_noise_in_common_the_nearer_they_are():
    noise = Noise(0.1, 2.0).of(np.array([[0.0], [0.0], [0.0], [2.0]]))
    far = 0.1 * np.exp(-1.0)
    assert np.allclose(noise, [[0.1, 0.1, 0, 0], [0.1, 0.1, 0, 0], [0, 0, 0.1, far], [0, 0, far, 0.1]])


def test_lengths_are_short_where_values_change_and_small_effects_are_told():
    """Noise is as large as the effect, and nearly the same for both of a pair."""
    (x, y), (new, true) = samples(150, 1), samples(200, 2)
    rng = np.random.default_rng(3)
    noisy = y + 0.02 * np.repeat(rng.normal(size=(150, 2)), 2, axis=0) + 1e-3 * rng.normal(size=y.shape)
    lengths, kernel, noise = kriging.fit(x, 3, noisy)
    assert lengths[2] > 10.0 * lengths[0]
    missed = told(kernel, new / lengths, x / lengths, noisy, noise) - true
    inner = np.abs(new).max(axis=1) < 2.0
    assert np.sqrt((missed[inner] ** 2).mean()) < 0.02  # below the samples' own noise
    effects, off = effect(new[::2]), (missed[::2] - missed[1::2])[inner[::2]]
    assert np.sqrt((off**2).mean()) < 0.15 * np.sqrt((effects**2).mean())
