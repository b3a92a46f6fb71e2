"""Extrapolation of fixed points."""

from __future__ import annotations

import numpy as np

from fem.anderson import Anderson


def steps(turns: Anderson, slope: np.ndarray, answer: np.ndarray) -> int:
    """How many looks at x -> x + slope (x - answer) it takes to find the answer from nothing."""
    turns.begin()
    x = np.zeros(len(answer))
    for count in range(1, 40):
        f = slope @ (x - answer)
        if np.abs(f).max() < 1e-3:
            return count
        x = turns.next(x, f)
    raise AssertionError


def test_as_many_steps_as_the_map_has_slopes_and_fewer_for_its_like() -> None:
    """Of a linear map with three different slopes; plain steps would diverge along the last. A second
    problem, with nearly the same slopes and an answer to the same side, begins with what the first one
    told."""
    rng = np.random.default_rng(0)
    turned, _ = np.linalg.qr(rng.normal(size=(20, 20)))
    slopes = np.repeat([-0.5, -1.3, -2.4], [8, 6, 6])
    slope, like = ((turned * s) @ turned.T for s in (slopes, 1.01 * slopes))
    first = rng.normal(size=20)
    second = 1.5 * first
    turns = Anderson()
    assert 3 <= steps(turns, slope, first) <= 6
    alone = steps(Anderson(), like, second)
    assert steps(turns, like, second) < alone
    turns.forget()
    assert steps(turns, like, second) == alone
