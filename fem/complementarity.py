"""Linear complementarity: contact is pressed or open at each point, never both, never neither."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

_EXCHANGES = 50  # contact ends within about ten
_SLACK = 1e-13  # of the largest offset: what counts as rounding


def complementary(matrix: Floats, offset: Floats) -> Floats:
    """Solve w = S p + q, p >= 0, w >= 0, p * w = 0 for p.

    A primal-dual active set (Hintermüller, Ito and Kunisch 2003; [hintermuller2003]): the points that are
    wrong, p < 0 where pressed or w < 0 where open, all change sides at once, and the pressed ones are solved
    for. That usually ends within a few steps but may cycle; then points are pressed one by one, none ever
    pulling, which lowers the energy with each step and so must end (Lawson and Hanson 1974, chapter 23;
    [lawson1974]). Either way w is zero to rounding where pressed, and p exactly zero where open.

    Parameters
    ----------
    matrix
        S, symmetric positive definite, shape (n, n).
    offset
        q, shape (n,).

    Returns
    -------
    p, shape (n,), never negative.

    Raises
    ------
    numpy.linalg.LinAlgError
        If S is not positive definite, or so nearly singular that no answer is found.
    """
    diagonal = np.diag(matrix)
    if not (np.isfinite(matrix).all() and (diagonal > 0).all()):
        raise np.linalg.LinAlgError("matrix is not positive definite")
    size = np.sqrt(diagonal)  # makes the points comparable, whatever their area
    s, q = matrix / np.outer(size, size), offset / size
    slack = _SLACK * np.abs(q).max(initial=0.0)
    pressed = q < 0
    for _ in range(_EXCHANGES):
        p = _balance(s, q, pressed)
        wrong = np.where(pressed, p < 0, s @ p + q < -slack)
        if not wrong.any():
            return np.asarray(p / size)
        pressed = pressed ^ wrong
    return np.asarray(_one_by_one(s, q, slack) / size)


def _balance(s: Floats, q: Floats, pressed: Bools) -> Floats:
    """p with w = 0 where pressed, and p = 0 elsewhere."""
    p = np.zeros(len(q))
    if pressed.any():
        lower = np.linalg.cholesky(s[np.ix_(pressed, pressed)])
        p[pressed] = -np.linalg.solve(lower.T, np.linalg.solve(lower, q[pressed]))
    return p


def _one_by_one(s: Floats, q: Floats, slack: float) -> Floats:
    """Press the deepest open point, and let go on the way of those that would have to pull."""
    p, pressed = np.zeros(len(q)), np.zeros(len(q), dtype=bool)
    for _ in range(30 * len(q)):
        w = np.where(pressed, np.inf, s @ p + q)
        if w.min() >= -slack:
            return p
        pressed[w.argmin()] = True
        while True:
            wish = _balance(s, q, pressed)
            pulling = pressed & (wish <= 0)
            if not pulling.any():
                p = wish
                break
            step = p[pulling] / (p[pulling] - wish[pulling])
            p = p + step.min() * (wish - p)
            pressed[np.flatnonzero(pulling)[step <= step.min()]] = False
            p[~pressed] = 0.0
    raise np.linalg.LinAlgError("no complementary solution found")
