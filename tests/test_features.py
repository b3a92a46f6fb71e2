"""Pictures in few numbers: what noise becomes in them, and that little is lost."""

import numpy as np

from estimation.features import compress

NOISE = np.array([[0.5, 0.1], [0.6, 0.2]])


def made_up(n: int, rng: np.random.Generator) -> np.ndarray:
    """Pictures (n, 2, 2, 4, 5) of six hidden numbers."""
    return (rng.standard_normal((n, 6)) @ rng.standard_normal((6, 80))).reshape(n, 2, 2, 4, 5) * 20.0 + 50.0


def test_six_numbers_take_six_components():
    features = compress(made_up(200, np.random.default_rng(0)), NOISE)
    assert features.axes.shape == (6, 80)
    assert np.allclose(features.axes @ features.axes.T, np.eye(6), atol=1e-5)


def test_no_information_is_lost():
    rng = np.random.default_rng(1)
    seen = made_up(300, rng)
    features = compress(seen, NOISE)
    whole = features.stacked(seen) - features.mean
    back = features(seen) @ features.axes
    assert np.abs(back - whole).max() < 1e-3 * np.abs(whole).max()


def test_onto_is_what_counts_add():
    rng = np.random.default_rng(2)
    seen = made_up(100, rng)
    features = compress(seen, NOISE)
    more = rng.standard_normal((2, 2, 4, 5))
    added = features(seen[:1] + more) - features(seen[:1])
    wanted = np.einsum("lpm,lpmk->k", more.reshape(2, 2, 20), features.onto)
    assert np.abs(added[0] - wanted).max() < 1e-3 * np.abs(wanted).max()


def test_what_cannot_be_seen_is_left_out():
    rng = np.random.default_rng(3)
    seen = 1e-4 * made_up(200, rng)
    assert len(compress(seen + 50.0, NOISE).spread) == 0
