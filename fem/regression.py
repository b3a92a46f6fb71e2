"""Smooth functions of a few inputs from scattered samples: principal components, each a Gaussian process.

A field (m values) of the inputs is its mean and a few modes, whose coefficients are Gaussian processes with
a linear trend and Matérn's covariances of order 5/2 (Rasmussen and Williams 2006, sections 2.2, 2.7 and
5.4.1, equation 4.17; [rasmussen2006]). Leading modes have lengths of their own, the others share some; they
maximise the marginal likelihood, the trend and each mode's variance are solved for.

Squared exponentials, which emulators of earlier versions have, take contact pressures for smoother
than they are.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, cholesky, solve_triangular
from scipy.optimize import minimize

Floats = NDArray[np.float64]

_MODES = 160  # at most; with half of them, specimens under the probe's middle are twice as far off
_TINY = 1e-9  # share of the variance that may be left out
_GROUPS = (0, 1, 2, 4, 8, 16)  # first modes of groups that share their lengths
_LEADING = 16  # modes of a group that the lengths are found from
_ENOUGH = 250  # samples that the lengths are found from
SQUARED, MATERN = 0.0, 2.5  # orders of covariances
_BOUNDS = [np.log(0.2), np.log(60.0)], [np.log(1e-9), np.log(1e-1)]  # of lengths and noise


@dataclass(frozen=True)
class Regression:
    """A field as a function of q inputs; all arrays are plain numbers.

    Attributes
    ----------
    inputs
        (n, q) of the samples, scaled by whoever asks to about -1 ... 1.
    lengths, noise
        Of the covariance of each group of modes, which begin at modes `_GROUPS`: (g, q), and variance of the
        noise over that of the signal, (g,).
    mean, modes
        Of the field: (m,), (k, m).
    trend, weights
        Of each mode: (q + 1, k), (n, k).
    order
        `MATERN` or `SQUARED`, ().
    """

    inputs: Floats
    lengths: Floats
    noise: Floats
    mean: Floats
    modes: Floats
    trend: Floats
    weights: Floats
    order: Floats

    def __call__(self, inputs: Floats) -> Floats:
        """Fields (p, m) at inputs (p, q)."""
        found = _trend(inputs) @ self.trend
        near = _covariance(inputs / self.lengths[:, None], *self._nodes, order=float(self.order))
        for group, covariance in zip(groups(len(self.modes)), near, strict=True):
            found[:, group] += covariance @ self.weights[:, group]
        return np.asarray(self.mean + found @ self.modes)

    @cached_property
    def _nodes(self) -> tuple[Floats, Floats]:
        """The samples' inputs over each group's lengths, (g, n, q), and their squares' sums, (g, n)."""
        scaled = self.inputs / self.lengths[:, None]
        return scaled, (scaled**2).sum(axis=-1)


def groups(modes: int) -> list[slice]:
    """The modes of each group that shares its lengths."""
    starts = [start for start in _GROUPS if start < modes]
    return [slice(a, b) for a, b in zip(starts, [*starts[1:], modes], strict=True)]


def _covariance(a: Floats, b: Floats, squares: Floats | None = None, order: float = MATERN) -> Floats:
    """Of scaled inputs (..., p, q) and (..., n, q), whose squares' sums may be known, (..., p, n)."""
    if squares is None:
        squares = (b**2).sum(axis=-1)
    square = a @ (2.0 * np.swapaxes(b, -1, -2))
    square -= (a**2).sum(axis=-1)[..., None]
    square -= squares[..., None, :]
    np.minimum(square, 0.0, out=square)  # minus the distance's
    if order == SQUARED:
        return np.asarray(np.exp(np.multiply(square, 0.5, out=square), out=square))
    far = np.sqrt(-2 * order * square)
    square *= -2 * order / 3
    square += far
    square += 1.0
    return np.asarray(np.multiply(square, np.exp(np.negative(far, out=far), out=far), out=square))


def _trend(inputs: Floats) -> Floats:
    return np.hstack([np.ones((len(inputs), 1)), inputs])


def principal(fields: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Mean (m,), modes (k, m), coefficients (n, k) of unit variance and each mode's share of the spread
    (k,)."""
    mean = fields.mean(axis=0)
    left, size, modes = np.linalg.svd(fields - mean, full_matrices=False)
    total = (size**2).sum() or 1.0  # fields that are all the same have none
    left_out = 1 - np.cumsum(size**2) / total
    enough = int(np.searchsorted(-left_out, -_TINY)) + 1 if size.any() else 1
    k = min(_MODES, enough, max(1, len(fields) - 8))
    root = np.sqrt(len(fields))
    return mean, modes[:k] * size[:k, None] / root, left[:, :k] * root, size[:k] / (size[:k].sum() or 1.0)


def lengths(inputs: Floats, values: Floats, share: Floats) -> tuple[Floats, Floats]:
    """Most likely lengths (q,) and noise () for coefficients (n, k) that matter by their share (k,)."""
    inputs, values, share = inputs[:_ENOUGH], values[:_ENOUGH, :_LEADING], share[:_LEADING]
    trend, q = _trend(inputs), inputs.shape[1]
    free = len(inputs) - trend.shape[1]

    def unlikely(logs: Floats) -> float:
        scaled = inputs / np.exp(logs[:q])
        covariance = _covariance(scaled, scaled) + np.exp(logs[q]) * np.eye(len(inputs))
        try:
            root = cholesky(covariance, lower=True)
        except np.linalg.LinAlgError:
            return 1e10
        white = solve_triangular(root, np.hstack([trend, values]), lower=True)
        basis, corner = np.linalg.qr(white[:, : q + 1])
        rest = white[:, q + 1 :]
        rest = rest - basis @ (basis.T @ rest)
        spread = np.log((rest**2).sum(axis=0) / free)
        size = 2 * np.log(np.diag(root)).sum() + 2 * np.log(np.abs(np.diag(corner))).sum()
        return float(free * (share @ spread) / (share.sum() or 1.0) + size)

    start = np.append(np.full(q, np.log(3.0)), np.log(1e-5))
    found = minimize(unlikely, start, method="L-BFGS-B", bounds=[_BOUNDS[0]] * q + [_BOUNDS[1]])
    return np.exp(found.x[:q]), np.exp(found.x[q])


def regress(
    inputs: Floats,
    fields: Floats,
    known: tuple[Floats, Floats] | None = None,
    own: int | None = None,
) -> Regression:
    """Fit fields (n, m) at inputs (n, q).

    Parameters
    ----------
    known
        Lengths and noise; else they are found.
    own
        From how many of the first samples they are found, all by default. Images of samples, which repeat the
        numbers of others, would look like proof of no noise.
    """
    mean, modes, values, share = principal(fields)
    trend, parts = _trend(inputs), groups(len(modes))
    if known is None:
        found = [lengths(inputs[:own], values[:own, part], share[part]) for part in parts]
        scales, noise = np.stack([f[0] for f in found]), np.array([f[1] for f in found])
    else:  # fewer modes may have come out
        scales, noise = (values[: len(parts)] for values in known)
    line, weights = np.empty((trend.shape[1], len(modes))), np.empty(values.shape)
    for part, scale, some in zip(parts, scales, noise, strict=True):
        scaled = inputs / scale
        factor = cho_factor(_covariance(scaled, scaled) + some * np.eye(len(inputs)), lower=True)
        solved = cho_solve(factor, trend)
        # two tissues alone do not tell how values go with thickness, and how with modulus
        line[:, part] = np.linalg.lstsq(trend.T @ solved, solved.T @ values[:, part], rcond=None)[0]
        weights[:, part] = cho_solve(factor, values[:, part] - trend @ line[:, part])
    return Regression(inputs, scales, noise, mean, modes, line, weights, np.array(MATERN))
