"""Smooth functions of a few inputs from scattered, noisy samples: kriging with coefficients that vary.

A sample is of a state, and of what is added to it. Values are a smooth function of the state, plus what is
added times coefficients, which follow both. Plain kriging takes all inputs alike; where what is added changes
little beside the state it hardly tells it: of the light that inclusions take away, a third.

Covariances are Matérn's of order 5/2 with a length for each input, their sums and products (Rasmussen and
Williams 2006, eq. 4.17 and section 4.2.4; [rasmussen2006]). Samples come in pairs, with and without what is
added, which have much of their noise in common, the more the nearer they are. Lengths and noise are those
under which pairs that are left out are told best, for which no fit is repeated (eq. 5.12): their means, and
what sets both apart.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

_CONSTANT = 100.0  # variance of the unknown mean, in that of the signal
_BEGIN = 4.0  # lengths of the state, in standard deviations
_ADDED = 0.05  # what is added, over the state's signal, for one standard deviation
_SLOWER, _BEND, _NOISE, _REACH = 1.0, 1.0, 3e-3, 20.0
_SPAN = 400.0  # by which all these may be off
_EVALUATIONS = 60  # for each unknown


@dataclass(frozen=True)
class Kernel:
    """What values at inputs (n, q) have in common; inputs are in units of their lengths.

    Attributes
    ----------
    states : so many of the inputs are the state, the rest what is added.
    slower : coefficients follow the state over so many of its lengths,
    bend : and what is added over so much of it.
    """

    states: int
    slower: float
    bend: float

    def __call__(self, a: Array, b: Array) -> Array:
        """Covariance of inputs (p, q) and (n, q), (p, n), without the unknown mean's."""
        k = self.states
        apart, added = _squares(a[:, :k], b[:, :k]), _squares(a[:, k:], b[:, k:])
        product = a[:, k:] @ b[:, k:].T
        return matern(apart) + product * matern(apart / self.slower**2 + added / self.bend**2)

    def terms(self, inputs: Array, nodes: Array) -> Array:
        """What weights are of, (p, 1 + n): a constant, and covariances with the samples' inputs (n, q)."""
        return np.column_stack([np.ones(len(inputs)), self(inputs, nodes)])


@dataclass(frozen=True)
class Noise:
    """What samples are off by.

    Attributes
    ----------
    share : its variance over that of the state's signal.
    reach : a pair has exp(-distance / reach) of it in common.
    """

    share: float
    reach: float

    def of(self, nodes: Array) -> Array:
        """Covariance (n, n) among samples at nodes (n, q), pair after pair."""
        found = np.eye(len(nodes))
        one = np.arange(0, len(nodes), 2)
        found[one, one + 1] = np.exp(-np.linalg.norm(nodes[one] - nodes[one + 1], axis=1) / self.reach)
        found[one + 1, one] = found[one, one + 1]
        return self.share * found


def matern(square: Array) -> Array:
    """Covariance at squared distances in units of the length."""
    root = np.sqrt(5.0 * square)
    return np.asarray((1.0 + root + 5.0 / 3.0 * square) * np.exp(-root))


def weights(kernel: Kernel, nodes: Array, values: Array, noise: Noise) -> Array:
    """Return weights (1 + n, m) of `Kernel.terms` for values (n, m)."""
    answer = _inverse(kernel, nodes, noise) @ values
    return np.concatenate([_CONSTANT * answer.sum(axis=0, keepdims=True), answer])


def left_out(kernel: Kernel, nodes: Array, values: Array, noise: Noise) -> Array:
    """Return by how much each sample's values (n, m) are above what all other pairs tell of it."""
    inverse = _inverse(kernel, nodes, noise)
    pairs = np.arange(len(nodes)).reshape(-1, 2)
    own = inverse[pairs[:, :, None], pairs[:, None]]
    found = np.linalg.solve(own, (inverse @ values).reshape(len(pairs), 2, -1))
    return np.asarray(found.reshape(values.shape))


def fit(inputs: Array, states: int, values: Array) -> tuple[Array, Kernel, Noise]:
    """Return lengths (q,), kernel and noise for values (n, m) at inputs (n, q), pair after pair.

    Inputs / lengths of what is added are then its size beside the state's signal.
    """
    q = inputs.shape[1]
    spread = np.maximum(np.append(inputs[:, :states].std(axis=0), _rms(inputs[::2, states:])), 1e-300)
    sizes = np.append(np.full(states, _BEGIN), np.full(q - states, 1.0 / _ADDED))
    begin = np.log(np.append(sizes * spread, [_SLOWER, _BEND, _NOISE, _REACH]))

    def told(logs: Array) -> tuple[Array, Kernel, Noise]:
        slower, bend, share, reach = (float(x) for x in np.exp(logs[q:]))
        return np.exp(logs[:q]), Kernel(states, slower, bend), Noise(share, reach)

    def missed(logs: Array) -> float:
        lengths, kernel, noise = told(logs)
        found = left_out(kernel, inputs / lengths, values, noise).reshape(-1, 2, values.shape[1])
        return float(np.log((found.sum(axis=1) ** 2).sum()) + np.log((np.diff(found, axis=1) ** 2).sum()))

    span = np.full(len(begin), np.log(_SPAN))
    found = minimize(
        missed,
        begin,
        method="Powell",
        bounds=list(zip(begin - span, begin + span, strict=True)),
        options={"maxfev": _EVALUATIONS * len(begin), "xtol": 0.05, "ftol": 2e-4},
    )
    return told(found.x)


def _rms(values: Array) -> Array:
    return np.asarray(np.sqrt((values**2).mean(axis=0)))


def _squares(a: Array, b: Array) -> Array:
    """Squared distances of (p, k) and (n, k), (p, n)."""
    return np.maximum((a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T, 0.0)


def _inverse(kernel: Kernel, nodes: Array, noise: Noise) -> Array:
    return np.asarray(np.linalg.inv(kernel(nodes, nodes) + _CONSTANT + noise.of(nodes)))
