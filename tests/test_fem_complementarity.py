"""Pressed or open, never both: against enumeration, on contact-like and on cycling problems."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest

from fem.complementarity import complementary


@pytest.mark.parametrize("seed", range(20))
def test_against_enumeration(seed: int) -> None:
    """A positive definite problem has one answer; trying all 2^8 sets of pressed points finds it too."""
    rng = np.random.default_rng(seed)
    factor = rng.normal(size=(8, 8))
    matrix, offset = factor @ factor.T + 0.01 * np.eye(8), rng.normal(size=8)
    found = complementary(matrix, offset)
    answers = []
    for bits in product((False, True), repeat=8):
        pressed, p = np.array(bits), np.zeros(8)
        if pressed.any():
            p[pressed] = -np.linalg.solve(matrix[np.ix_(pressed, pressed)], offset[pressed])
        if (p >= 0).all() and (matrix @ p + offset)[~pressed].min(initial=0) >= 0:
            answers.append(p)
    assert len(answers) == 1
    np.testing.assert_allclose(found, answers[0], atol=1e-10)


@pytest.mark.parametrize("n", [30, 200])
def test_complementary(n: int) -> None:
    """Badly conditioned, points of very different areas, where full exchanges alone may cycle."""
    rng = np.random.default_rng(n)
    factor = rng.normal(size=(n, n // 2))
    size = 10.0 ** rng.uniform(-3, 3, n)
    matrix = (factor @ factor.T + 1e-3 * np.eye(n)) * np.outer(size, size)
    offset = rng.normal(size=n) * size
    p = complementary(matrix, offset)
    w = matrix @ p + offset
    assert p.min() >= 0
    assert (w / size).min() > -1e-9
    assert np.abs(p * w).max() < 1e-10 * np.abs(p * size).max() * np.abs(offset / size).max()


def test_nothing_touches() -> None:
    np.testing.assert_array_equal(complementary(np.eye(3), np.ones(3)), 0.0)


def test_an_indefinite_matrix_is_refused() -> None:
    for matrix in (-np.eye(2), np.array([[1.0, 2.0], [2.0, 1.0]])):
        with pytest.raises(np.linalg.LinAlgError):
            complementary(matrix, -np.ones(2))
