"""Steps of a fit within the ranges end where the quadratic is least there, by what marks that place."""

import numpy as np
import pytest

from twin.fitting import Prior, step_inside

RANGES = np.array([[2.0, 13.0], [4.0, 12.0], [40.0, 120.0], [-2.0, 2.0], [0.0, 0.0]])
PRIOR = Prior(RANGES, ("a", "b"), np.zeros(2), np.eye(2))
SPANS = np.array([11.0, 8.0, 80.0, 4.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("seed", range(40))
def test_a_step_ends_where_all_that_may_move_is_best(seed: int) -> None:
    """Karush, Kuhn and Tucker: no slope where free, none inwards at an end. Unknowns hang together as size,
    depth and modulus do, and one is where rounding leaves it, a hair from its end."""
    rng = np.random.default_rng(seed)
    root = rng.standard_normal((9, 7)) + 3.0 * rng.standard_normal((9, 1))
    information = root.T @ root / np.outer(SPANS, SPANS) + PRIOR.precision * (SPANS < 2.0)
    slope = 3.0 * rng.standard_normal(7) * np.sqrt(np.diag(information))
    x = np.concatenate([RANGES.mean(axis=1), np.zeros(2)])
    x[2] = 40.0 + 4e-7
    free = np.arange(7) != seed % 4 if seed % 2 else np.ones(7, bool)
    step = step_inside(PRIOR, x, information, slope, free)

    low, high = (np.append(end, [sign * np.inf] * 2) - x for end, sign in zip(RANGES.T, (-1, 1), strict=True))
    left = (slope - information @ step) / np.sqrt(np.diag(information))
    tiny = 1e-9 * SPANS
    assert np.all((low - tiny <= step) & (step <= high + tiny))
    assert not step[~free].any() and step[4] == 0.0
    may = free & (low < high)
    assert np.all(left[may & (step > low + tiny)] > -1e-6)
    assert np.all(left[may & (step < high - tiny)] < 1e-6)
