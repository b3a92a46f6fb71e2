"""Smooth functions of a few inputs from scattered, noisy samples: ordinary kriging.

The covariance is Matérn's of order 5/2 with a length for each input (Rasmussen and Williams 2006, eq. 4.17;
[rasmussen2006]). Lengths and noise are those under which samples that are left out are told best, for which
no fit is repeated (eq. 5.12).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

_CONSTANT = 100.0  # variance of the unknown mean, in that of the signal
_ENOUGH = 320  # samples that lengths are found from
_BEGIN, _NOISE = 3.0, 3e-3  # lengths in standard deviations of the inputs, noise over signal
_EVALUATIONS = 100  # for each unknown


def covariance(a: Array, b: Array) -> Array:
    """Of inputs (p, q) and (n, q) in units of the lengths, (p, n)."""
    square = ((a[:, None] - b[None]) ** 2).sum(axis=-1)
    root = np.sqrt(5.0 * square)
    return np.asarray((1.0 + root + 5.0 / 3.0 * square) * np.exp(-root))


def terms(inputs: Array, nodes: Array) -> Array:
    """What weights are of, (p, 1 + n): a constant, and covariances with the samples' inputs (n, q)."""
    return np.column_stack([np.ones(len(inputs)), covariance(inputs, nodes)])


def weights(nodes: Array, values: Array, noise: float) -> Array:
    """Return weights (1 + n, m) of `terms` for values (n, m)."""
    answer = _inverse(nodes, noise) @ values
    return np.concatenate([_CONSTANT * answer.sum(axis=0, keepdims=True), answer])


def left_out(nodes: Array, values: Array, noise: float) -> Array:
    """Return by how much each sample's values (n, m) are above what all others tell of it."""
    inverse = _inverse(nodes, noise)
    return np.asarray(inverse @ values / np.diag(inverse)[:, None])


def lengths(inputs: Array, values: Array) -> tuple[Array, float]:
    """Return lengths (q,) and the noise's share of the variance for values (n, m) at inputs (n, q)."""
    x, y = inputs[:_ENOUGH], values[:_ENOUGH]
    spread = np.maximum(x.std(axis=0), 1e-300)
    begin = np.log(np.append(_BEGIN * spread, _NOISE))

    def missed(logs: Array) -> float:
        return float(np.log((left_out(x / np.exp(logs[:-1]), y, np.exp(logs[-1])) ** 2).sum()))

    span = np.append(np.full(len(spread), np.log(1e3)), np.log(1e3))
    found = minimize(
        missed,
        begin,
        method="Powell",
        bounds=list(zip(begin - span, begin + span, strict=True)),
        options={"maxfev": _EVALUATIONS * len(begin), "xtol": 0.03, "ftol": 1e-4},
    )
    return np.exp(found.x[:-1]), float(np.exp(found.x[-1]))


def _inverse(nodes: Array, noise: float) -> Array:
    n = len(nodes)
    return np.asarray(np.linalg.inv(covariance(nodes, nodes) + _CONSTANT + noise * np.eye(n)))
