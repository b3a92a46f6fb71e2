"""Fields as functions of a few inputs: what Gaussian processes find of them."""

from __future__ import annotations

import numpy as np
import pytest

from fem.regression import MATERN, SQUARED, _covariance, regress


def test_gaussian_process_finds_a_smooth_function() -> None:
    """Error falls as the samples' distance to the power 7/2 at least, as it does in the native space of
    Matérn's covariances of order 5/2 in two dimensions."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (200, 2))
    at = np.linspace(0, 1, 30)

    def field(points: np.ndarray) -> np.ndarray:
        return np.cos(points[:, :1] + at) * np.exp(-points[:, 1:] * at)

    test = rng.uniform(-0.9, 0.9, (100, 2))
    errors = [np.abs(regress(x[:n], field(x[:n]))(test) - field(test)).max() for n in (25, 50, 200)]
    assert errors[1] < errors[0] / 2 ** (7 / 4)
    assert errors[2] < errors[1] / 4 ** (7 / 4) and errors[2] < 1e-3


def test_matern_has_its_closed_form() -> None:
    """Order 5/2: (1 + r + r²/3) exp(-r), r = sqrt(5) times the distance in lengths (Rasmussen and Williams
    2006, equation 4.17)."""
    a, b = np.random.default_rng(0).normal(size=(2, 7, 3))
    r = np.sqrt(5.0) * np.linalg.norm(a[:, None] - b, axis=2)
    found = _covariance(a, b, order=MATERN)
    assert found == pytest.approx((1 + r + r**2 / 3) * np.exp(-r), abs=1e-12)
    assert _covariance(a, b, order=SQUARED) == pytest.approx(np.exp(-(r**2) / 10), abs=1e-12)


def test_what_never_changes_is_learned_too() -> None:
    x = np.random.default_rng(1).uniform(-1, 1, (20, 2))
    assert regress(x, np.full((20, 3), 4.0))(x[:5]) == pytest.approx(4.0)


def test_inputs_that_go_together_are_no_obstacle() -> None:
    """Samples of two tissues only, whose thickness and modulus are told from one another by none of them."""
    rng = np.random.default_rng(3)
    x = np.column_stack([rng.uniform(-1, 1, 24), np.repeat([-1.0, 0.5], 12), np.repeat([-1.0, 0.5], 12)])
    field = np.sin(x[:, :1] + np.linspace(0, 1, 5)) + x[:, 1:2]
    known = np.full((6, 3), 2.0), np.full(6, 1e-6)
    found = regress(x, field, known)
    assert found(x) == pytest.approx(field, abs=1e-3)
    aside = found(x * [1.0, -1.0, 1.0])  # of tissues beside the line through both
    assert np.abs(aside).max() < 2 * np.abs(field).max()
