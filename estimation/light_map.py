"""Pictures as a smooth function of the contact: kernel ridge regression on its principal components.

Frustrated reflection lights up where there is contact, and light is linear: a picture is nearly a blurred map
of the real contact fraction. What is not linear (light that contact elsewhere has taken away, dents that turn
light) is small and smooth. A squared-exponential covariance over many times the spread of the contacts holds
both (Rasmussen and Williams 2006, section 2.2; [rasmussen2006]); its length and ridge are those with which
samples that are left out, each with all its presses, are foretold best (section 5.4.2).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import eigsh

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_INPUTS = 80  # principal components of the contact
_MODES = 100  # of the pictures
_LENGTHS = (2.0, 4.0)  # over the root mean square distance of the contacts from their mean
_RIDGES = (1e-7, 1e-8, 1e-9, 1e-10, 1e-11)
MOST = 3600
"""Pictures that length and ridge are chosen with, in some seconds."""


@dataclass(frozen=True)
class LightMap:
    """Pictures of `shape` from contacts (d,).

    Attributes
    ----------
    centre, axes : (d,) and (d, k); inputs of a contact are (contact - centre) @ axes.
    nodes : (n, k) inputs of what was learned from.
    length : of the covariance.
    weights : (n, m) of the modes.
    mean, modes : (pixels,) and (m, pixels).
    shape : of a picture.
    """

    centre: Floats
    axes: Floats
    nodes: Floats
    length: float
    weights: Floats
    mean: Single
    modes: Single
    shape: tuple[int, ...]

    def inputs(self, contacts: NDArray[np.floating]) -> Floats:
        """Inputs (n, k) of contacts (n, d)."""
        return np.asarray((np.asarray(contacts, np.float64) - self.centre) @ self.axes)

    def at(self, inputs: Floats) -> Single:
        """Pictures (n, *shape) of inputs (n, k)."""
        # weights are large and cancel: single precision comes after them
        amounts = (_covariance(inputs, self.nodes, self.length) @ self.weights).astype(np.float32)
        return np.asarray((self.mean + amounts @ self.modes).reshape(-1, *self.shape), np.float32)

    def __call__(self, contacts: NDArray[np.floating]) -> Single:
        """Pictures (n, *shape) of contacts (n, d)."""
        return self.at(self.inputs(contacts))


def learn(
    contacts: NDArray[np.floating],
    pictures: NDArray[np.floating],
    groups: NDArray[np.integer] | None = None,
) -> tuple[LightMap, Single]:
    """Fit pictures (n, ...) of contacts (n, d); return also the errors of those left out, (n, ...).

    Time goes with n³, memory with n²: minutes and 5 GB for 12 000. Length and ridge are chosen with the first
    `MOST`.

    Parameters
    ----------
    groups : (n,) which belong together, as the press levels of one specimen: they are left out together.

    Raises
    ------
    ValueError
        For fewer than 20 pictures.
    """
    if len(contacts) < 20 or len(pictures) != len(contacts):
        received = f"{len(pictures)} of {len(contacts)} contacts"
        raise ValueError(f"pictures: received {received}; allowed one each, 20 or more")
    x, shape = np.asarray(contacts, np.float64), np.asarray(pictures).shape
    y = np.asarray(pictures, np.float32).reshape(len(x), -1)
    groups = np.arange(len(x)) if groups is None else np.asarray(groups)
    centre = x.mean(axis=0)
    _, size, axes = np.linalg.svd(x - centre, full_matrices=False)
    axes = axes[:_INPUTS].T * np.sqrt(len(x) / (size**2).sum())
    nodes = (x - centre) @ axes
    mean = y.mean(axis=0)
    amounts, modes = _modes(y - mean)
    tried = {
        (length, ridge): _solved(nodes[:MOST], amounts[:MOST], groups[:MOST], length, ridge)
        for length in _LENGTHS
        for ridge in _RIDGES
    }
    length, ridge = min(tried, key=lambda pair: float((tried[pair][1] ** 2).mean()))
    weights, left = tried[length, ridge]
    if len(x) > MOST:
        weights, left = _solved(nodes, amounts, groups, length, ridge)
    beyond = (y - mean) - amounts.astype(np.float32) @ modes  # of the modes that are not kept
    errors = left.astype(np.float32) @ modes + beyond
    fitted = LightMap(centre, axes, nodes, length, weights, mean, modes, shape[1:])
    return fitted, errors.reshape(len(x), *shape[1:])


def _modes(pictures: Single) -> tuple[Floats, Single]:
    """Amounts (n, m) and modes (m, pixels) that pictures (n, pixels) are made of, the leading ones."""
    products = np.asarray(pictures @ pictures.T, np.float64)
    count = min(_MODES, len(pictures) - 1, pictures.shape[1])
    if len(pictures) > MOST:  # all eigenvalues of many thousands take longer than the fit
        values, vectors = eigsh(products, count, v0=np.ones(len(pictures)))
    else:
        values, vectors = np.linalg.eigh(products)
    lead = np.argsort(values)[::-1][:count]
    lead = lead[values[lead] > 1e-14 * values.max()]
    amounts = vectors[:, lead] * np.sqrt(values[lead])
    return amounts, ((vectors[:, lead] / np.sqrt(values[lead])).T.astype(np.float32) @ pictures)


def _solved(
    nodes: Floats, amounts: Floats, groups: NDArray[np.integer], length: float, ridge: float
) -> tuple[Floats, Floats]:
    """Weights (n, m), and errors (n, m) of each group when it is not learned from."""
    kernel = _covariance(nodes, nodes, length)
    kernel[np.diag_indices(len(kernel))] += ridge * len(kernel)
    inverse = np.asarray(np.linalg.inv(kernel))
    weights = inverse @ amounts
    return weights, _left_out(inverse, weights, groups)


def _left_out(inverse: Floats, weights: Floats, groups: NDArray[np.integer]) -> Floats:
    """Errors (n, m) of each group when it is not learned from."""
    left = np.empty_like(weights)
    for group in np.unique(groups):
        rows = np.flatnonzero(groups == group)
        left[rows] = np.linalg.solve(inverse[np.ix_(rows, rows)], weights[rows])
    return left


def _covariance(a: Floats, b: Floats, length: float) -> Floats:
    square = (a**2).sum(axis=1)[:, None] + (b**2).sum(axis=1) - 2.0 * a @ b.T
    return np.asarray(np.exp(-0.5 * np.maximum(square, 0.0) / length**2))
