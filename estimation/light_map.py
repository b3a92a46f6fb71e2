"""Pictures as a smooth function of the contact: linear in its principal components, with some products.

Frustrated reflection lights up where there is contact, and light is linear: a picture is nearly a blurred map
of the real contact fraction. What is not linear (light that contact elsewhere has taken away, dents that turn
light) is small and smooth, so a quadratic of the leading components is left for it. Fitted by least squares
with a penalty; each sample left out in turn (Allen 1974; [allen1974]) tells the error.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_SHARE = 4  # samples per term, at least
_RIDGE = 1e-6  # of the mean square of a term


@dataclass(frozen=True)
class LightMap:
    """Pictures of `shape` from contacts (d,).

    Attributes
    ----------
    centre, axes : (d,) and (d, k); inputs of a contact are (contact - centre) @ axes, of unit variance.
    curved : how many leading inputs go in with squares and products.
    weights : (terms, pixels)
    shape : of a picture.
    """

    centre: Single
    axes: Single
    curved: int
    weights: Single
    shape: tuple[int, ...]

    def inputs(self, contacts: NDArray[np.floating]) -> Single:
        """Inputs (n, k) of contacts (n, d)."""
        return np.asarray((np.asarray(contacts, np.float32) - self.centre) @ self.axes)

    def at(self, inputs: Single) -> Single:
        """Pictures (n, *shape) of inputs (n, k)."""
        found = terms(inputs, self.curved) @ self.weights
        return np.asarray(found.reshape(-1, *self.shape), np.float32)

    def __call__(self, contacts: NDArray[np.floating]) -> Single:
        """Pictures (n, *shape) of contacts (n, d)."""
        return self.at(self.inputs(contacts))


def terms(inputs: Single, curved: int) -> Single:
    """One, the inputs, and squares and products of the first `curved` of them, (n, terms)."""
    products = [
        inputs[:, i] * inputs[:, j] - np.float32(i == j) for i in range(curved) for j in range(i, curved)
    ]
    return np.column_stack([np.ones(len(inputs), np.float32), inputs, *products]).astype(np.float32)


def count_terms(k: int, curved: int) -> int:
    """Number of `terms`."""
    return 1 + k + curved * (curved + 1) // 2


def learn(
    contacts: NDArray[np.floating],
    pictures: NDArray[np.floating],
    groups: NDArray[np.integer] | None = None,
    *,
    k: int = 40,
    curved: int = 10,
) -> tuple[LightMap, Single]:
    """Fit pictures (n, ...) of contacts (n, d); return also the errors of those left out, (n, ...).

    Parameters
    ----------
    groups : (n,) which belong together, as the press levels of one specimen: they are left out together.
    k, curved : inputs, and how many of them are curved; fewer are taken where samples are few.

    Raises
    ------
    ValueError
        For fewer than 20 pictures.
    """
    n = len(contacts)
    if n < 20 or len(pictures) != n:
        raise ValueError(f"pictures: received {len(pictures)} of {n} contacts; allowed one each, 20 or more")
    while count_terms(k, curved) * _SHARE > n and k > 4:
        k, curved = max(k * 4 // 5, 4), min(curved, max(k * 4 // 5, 4)) * 4 // 5
    x = np.asarray(contacts, np.float64)
    centre = x.mean(axis=0)
    _, size, axes = np.linalg.svd(x - centre, full_matrices=False)
    axes = axes[:k].T * (np.sqrt(n) / size[:k])
    a = terms(((x - centre) @ axes).astype(np.float32), curved).astype(np.float64)
    y = np.asarray(pictures, np.float64).reshape(n, -1)
    gram = a.T @ a
    gram[np.diag_indices_from(gram)] += _RIDGE * n
    inverse = np.linalg.inv(gram)
    weights = inverse @ (a.T @ y)
    error = y - a @ weights
    left = np.empty_like(error)
    groups = np.arange(n) if groups is None else np.asarray(groups)
    for group in np.unique(groups):
        rows = groups == group
        hat = a[rows] @ inverse @ a[rows].T
        left[rows] = np.linalg.solve(np.eye(rows.sum()) - hat, error[rows])
    shape = np.asarray(pictures).shape
    fitted = LightMap(
        centre.astype(np.float32), axes.astype(np.float32), curved, weights.astype(np.float32), shape[1:]
    )
    return fitted, left.reshape(shape).astype(np.float32)
