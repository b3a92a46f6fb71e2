"""How far a picture is from those that a model has learned: one share, from ranks among valid ones.

    stored = fit(valid, held_out, extra=chi_square)     # arrays, for a file
    likeness = score(stored, features, extra=chi_square)

Features are pictures over the standard deviation of their noise, so that noise alone has variance one. Valid
ones lie near a low plane, spanned by their principal components, and three things can be strange of another:

- outside: what the plane cannot express, over what noise leaves there, dof degrees of freedom, and over a
  share of what it does express, which a sensor's model errs by:  |z_out|² / (dof + (tolerance |z_in|)²);
- inside: Mahalanobis distance (squared, over the number of components) from the valid ones' mean;
- extra: whatever grows with strangeness and the caller knows, such as the chi-square of picture minus
  prediction.

Each is replaced by its tail share among pictures that the plane was not fitted to, the smallest of these
shares is kept, and its own rank among theirs is the likeness: whatever the statistics' laws, a share a of
valid pictures has a likeness below a (conformal prediction, Vovk, Gammerman and Shafer 2005; key
``vovk2005``). Held-out pictures must vary as much as real ones: see `misaligned`.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.linalg import eigh

from estimation.alignment import moved

Float = NDArray[np.float64]


def fit(
    valid: ArrayLike,
    held_out: ArrayLike,
    *,
    extra: ArrayLike | None = None,
    components: int = 40,
    tolerance: float = 0.01,
) -> dict[str, Float]:
    """Return what `score` needs, as plain arrays to be stored.

    Parameters
    ----------
    valid : (n, m) whitened features of pictures that span the plane, n >= 3.
    held_out : (k, m) of others, k >= 20, whose ranks say what is usual.
    extra : (k, j) further statistics of the held-out ones, larger is stranger; (k,) for one.
    components : of the plane, at most; never more than half of n.
    tolerance : share of what the plane expresses that may be missing outside it.

    Raises ValueError, in one line, for arrays of other shapes or with values that are not finite.
    """
    basis = _pictures("valid", valid, 3)
    others = _pictures("held_out", held_out, 20, basis.shape[1])
    if not 0.0 <= tolerance < 1.0:
        raise ValueError(f"tolerance: received {tolerance!r}, allowed: 0 to 1")
    mean = basis.mean(axis=0)
    spread, across = _principal(basis - mean, min(components, len(basis) // 2))
    if len(spread) < 1:
        raise ValueError(f"components: received {components!r}, allowed: >= 1, of pictures that vary")
    stored = {
        "mean": mean,
        "components": across,
        "spread": spread,
        "tolerance": np.array([tolerance]),
    }
    found = np.concatenate([_statistics(stored, others), _extra(extra, len(others))], axis=1)
    stored["ranks"] = np.sort(found, axis=0)
    stored["smallest"] = np.sort(_tails(stored, found).min(axis=1))
    return stored


def _principal(centred: Float, most: int) -> tuple[Float, Float]:
    """Standard deviations along the first principal components, (k,), and these, (k, m).

    By eigenvectors of the smaller of both products, which is many times as fast as singular values are; what
    it loses, components a ten-thousandth as strong as the first, is far below any picture's noise.
    """
    count, length = centred.shape
    wide = length > count
    product = centred @ centred.T if wide else centred.T @ centred
    values, vectors = eigh(product, subset_by_index=[max(len(product) - most, 0), len(product) - 1])
    values, vectors = values[::-1], vectors[:, ::-1]
    kept = values > 1e-10 * max(float(values[0]), 1e-300)
    values, vectors = values[kept], vectors[:, kept]
    across = (centred.T @ vectors / np.sqrt(values)).T if wide else vectors.T
    return np.sqrt(values / (count - 1)), np.ascontiguousarray(across)


def score(
    stored: Mapping[str, NDArray[np.floating]], features: ArrayLike, *, extra: ArrayLike | None = None
) -> Float:
    """Return the share of valid pictures that are less like the learned ones, (n,), 0 to 1.

    ``features`` is (n, m), or (m,) of one picture; ``extra`` (n, j), with the j that `fit` had. A picture
    with a value that is not finite has likeness 0.
    """
    _, tails = _judged(stored, features, extra)
    below = np.searchsorted(np.asarray(stored["smallest"]), tails.min(axis=1), side="left")
    return np.asarray(below / len(stored["smallest"]))


def strangeness(
    stored: Mapping[str, NDArray[np.floating]], features: ArrayLike, *, extra: ArrayLike | None = None
) -> Float:
    """Return the statistics behind `score`, (n, 2 + j): outside, inside, then the extra ones, each over its
    median among held-out pictures: 1 is usual."""
    found, _ = _judged(stored, features, extra)
    return np.asarray(found / np.maximum(np.median(stored["ranks"], axis=0), 1e-300))


def misaligned(pictures: ArrayLike, rng: np.random.Generator, percent: float = 1.0) -> Float:
    """Return pictures (n, levels, rows, columns) as a camera that stands a little off would see them.

    Each is shifted along both axes by normal draws of so many per cent of its longer side, magnified by a
    draw of so many per cent, and turned by a draw of so many hundredths of a radian; all its levels alike.
    Beyond the border it goes on as it ends.
    """
    given = np.asarray(pictures, np.float64)
    if given.ndim != 4:
        raise ValueError(f"pictures: received shape {given.shape}, allowed: (n, levels, rows, columns)")
    draws = 0.01 * percent * rng.standard_normal((len(given), 4))
    return np.stack([moved(one, *draw) for one, draw in zip(given, draws, strict=True)])


def _judged(
    stored: Mapping[str, NDArray[np.floating]], features: ArrayLike, extra: ArrayLike | None
) -> tuple[Float, Float]:
    given = np.atleast_2d(np.asarray(features, np.float64))
    wanted = len(stored["mean"])
    if given.ndim != 2 or given.shape[1] != wanted:
        raise ValueError(f"features: received shape {given.shape}, allowed: (n, {wanted})")
    more = np.zeros((len(given), 0)) if extra is None else np.asarray(extra, np.float64)
    more = more.reshape(len(given), -1)
    columns = stored["ranks"].shape[1] - 2
    if more.shape[1] != columns:
        raise ValueError(f"extra: received {more.shape[1]} statistics, allowed: {columns}, as fitted")
    with np.errstate(all="ignore"):
        found = np.concatenate([_statistics(stored, given), more], axis=1)
    found = np.where(np.isfinite(found), found, np.inf)  # what is no number is as strange as can be
    return found, _tails(stored, found)


def _statistics(stored: Mapping[str, NDArray[np.floating]], features: Float) -> Float:
    centred = features - stored["mean"]
    along = centred @ stored["components"].T
    count, length = stored["components"].shape
    inside = np.sum(along**2, axis=1)
    # By subtraction a picture far inside would leave nothing but rounding.
    outside = np.sum((centred - along @ stored["components"]) ** 2, axis=1)
    allowed = length - count + float(stored["tolerance"][0]) ** 2 * inside
    # Along its weakest components the plane knows the spread no better than the noise, which is one.
    distance = np.sum(along**2 / (np.asarray(stored["spread"]) ** 2 + 1.0), axis=1) / count
    return np.stack([outside / allowed, distance], axis=1)


def _tails(stored: Mapping[str, NDArray[np.floating]], found: Float) -> Float:
    """Share of held-out pictures at least as strange, (n, statistics)."""
    ranks = np.asarray(stored["ranks"])
    below = [np.searchsorted(ranks[:, j], found[:, j], side="left") for j in range(ranks.shape[1])]
    return 1.0 - np.stack(below, axis=1) / len(ranks)


def _pictures(name: str, values: ArrayLike, least: int, length: int | None = None) -> Float:
    array = np.asarray(values, np.float64)
    fits = array.ndim == 2 and len(array) >= least and array.shape[1] >= 1
    if not fits or (length is not None and array.shape[1] != length):
        wanted = "m" if length is None else str(length)
        raise ValueError(f"{name}: received shape {array.shape}, allowed: ({least} or more, {wanted})")
    if not np.isfinite(array).all():
        raise ValueError(f"{name}: received NaN or infinity, allowed: finite numbers")
    return array


def _extra(extra: ArrayLike | None, count: int) -> Float:
    array = np.zeros((count, 0)) if extra is None else np.asarray(extra, np.float64)
    if len(array) != count or array.ndim > 2 or not np.isfinite(array).all():
        raise ValueError(f"extra: received shape {array.shape}, allowed: ({count}, j), finite")
    return array.reshape(count, -1)
