"""What one rounded, clipped count tells about the mean and the variance behind it.

A pixel's value before the converter is taken as normal, N(µ, v); the camera gives the nearest whole number
within 0 ... 2^bits - 1. The outcome k has the probability

    p_k = Φ((k + ½ - µ)/√v) - Φ((k - ½ - µ)/√v),   open to -∞ at k = 0 and to +∞ at the largest count,

and Fisher's information about (µ, v) is the 2 x 2 matrix Σ_k ∂p_k ∂p_kᵀ / p_k (Kay 1993, section 3.7;
[kay1993]). For √v well above a count it is that of a normal count with Sheppard's correction,
1/(v + 1/12) (Widrow and Kollár 2008, chapter 4; [widrow2008]); for √v well below one it is
almost nothing, but for counts whose mean is near the threshold between two numbers.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import ndtr

Floats = NDArray[np.float64]

_REACH = 8.0  # standard deviations that are summed over: what lies beyond holds 1e-13 of the information
_SMOOTH = 2.0  # counts; above, rounding is uniform noise but for exp(-2π²v) = 5e-35
_BLOCK = 100_000  # outcomes at a time, which stay in the cache
_LEAST = 1e-300  # chance below which an outcome does not count
_FAR = 40.0  # standard deviations that stand for infinity: the density underflows


@dataclass(frozen=True)
class CountInformation:
    """Information of one count about its mean µ and variance v before rounding; arrays of one shape.

    Attributes
    ----------
    mean, cross, variance : the elements µµ (counts⁻²), µv (counts⁻³) and vv (counts⁻⁴).
    """

    mean: Floats
    cross: Floats
    variance: Floats

    def along(self, slope: ArrayLike) -> Floats:
        """About µ alone (counts⁻²), where the variance follows it with the given slope dv/dµ."""
        slope = np.asarray(slope, np.float64)
        return np.asarray(self.mean + 2.0 * slope * self.cross + slope**2 * self.variance)


def count_information(mean: ArrayLike, variance: ArrayLike, bits: int | None) -> CountInformation:
    """Fisher's information of one count per pixel.

    Outcomes are summed over exactly (within 1e-12), except that a count whose standard deviation is above
    2 and which stays clear of both ends of the range takes the series of `_smooth`, good to 1e-6.

    Parameters
    ----------
    mean, variance : arrays that broadcast, counts and counts²; variance > 0. Means may lie outside the range.
    bits : whole number of 1 to 16, or None for counts that are neither rounded nor clipped.
    """
    mu, v = np.broadcast_arrays(np.asarray(mean, np.float64), np.asarray(variance, np.float64))
    _check(mu, v, bits)
    if bits is None:
        return CountInformation(1.0 / v, np.zeros(v.shape), 0.5 / v**2)  # Kay 1993, equation 3.31
    top = 2**bits - 1
    shape, mu, sd = mu.shape, mu.ravel(), np.sqrt(v.ravel())
    found = np.empty((3, mu.size))
    reach = _REACH * sd + 1.0
    smooth = (sd > _SMOOTH) & (mu - reach > 0.0) & (mu + reach < top)
    found[:, smooth] = _smooth(sd[smooth])
    rest = np.flatnonzero(~smooth)
    for block in _blocks(rest, sd):
        found[:, block] = _summed(mu[block], sd[block], top)
    return CountInformation(*(part.reshape(shape) for part in found))


def count_divergence(
    mean_0: ArrayLike, variance_0: ArrayLike, mean_1: ArrayLike, variance_1: ArrayLike, bits: int | None
) -> Floats:
    """Symmetric Kullback-Leibler (Jeffreys) divergence of one count between two cases, per pixel, no unit.

    J = Σ_k (p_k - q_k) ln(p_k / q_k). It adds over pixels and frames, and is the squared deflection d'² of a
    known signal where the log likelihood ratio is normal, as over many pixels; unrounded normal counts of
    one variance have (µ1 - µ0)²/v (Kay 1998, section 4.3; [kay1998]). Chances below 1e-300 count as that, so
    that one pixel never gives more than 1382.

    Parameters
    ----------
    mean_0, variance_0, mean_1, variance_1 : arrays that broadcast, counts and counts² before rounding.
    bits : whole number of 1 to 16, or None for counts that are neither rounded nor clipped.
    """
    given = np.broadcast_arrays(
        *(np.asarray(x, np.float64) for x in (mean_0, mean_1, variance_0, variance_1))
    )
    mean, variance = np.stack(given[:2]), np.stack(given[2:])
    _check(mean, variance, bits)
    apart = np.abs(mean[1] - mean[0])
    if bits is None:
        ratio = variance[0] / variance[1]
        return np.asarray(0.5 * (ratio + 1.0 / ratio - 2.0 + apart**2 * (1.0 / variance).sum(axis=0)))
    shape, top = apart.shape, 2**bits - 1
    mean, sd = mean.reshape(2, -1), np.sqrt(variance.reshape(2, -1))
    middle, width = mean.mean(axis=0), sd.max(axis=0) + apart.ravel() / (2.0 * _REACH)
    found = np.empty(middle.size)
    for block in _blocks(np.arange(middle.size), width):
        number = _numbers(middle[block], width[block], top)
        p, q = (_outcomes(number, mean[i, block], sd[i, block], top)[2] for i in (0, 1))
        ratio = np.log(np.maximum(p, _LEAST)) - np.log(np.maximum(q, _LEAST))
        found[block] = ((p - q) * ratio).sum(axis=0)
    return found.reshape(shape)


def outcome_probabilities(mean: float, variance: float, bits: int) -> Floats:
    """Probability of every count, (2^bits,), of one pixel with this mean and variance before rounding."""
    _check(np.asarray(mean), np.asarray(variance), bits)
    number = np.arange(2**bits, dtype=np.float64)[:, None]
    at, sd = np.array([mean], np.float64), np.sqrt(np.array([variance], np.float64))
    return _outcomes(number, at, sd, 2**bits - 1)[2][:, 0]


def _blocks(index: NDArray[np.intp], sd: Floats) -> Iterator[NDArray[np.intp]]:
    """Pixels of about one standard deviation, within a factor of 2, few enough for the memory."""
    scale = np.ceil(np.log2(np.maximum(sd[index], 0.125)))
    for power in np.unique(scale):
        alike = index[scale == power]
        step = max(1, int(_BLOCK / (2.0 * _REACH * 2.0**power + 3.0)))
        yield from (alike[i : i + step] for i in range(0, alike.size, step))


def _numbers(mean: Floats, sd: Floats, top: int) -> Floats:
    """Whole numbers about each mean, (m, n), wide enough for the block's largest standard deviation."""
    reach = int(np.ceil(_REACH * sd.max())) + 1
    return np.clip(np.rint(mean), 0, top) + np.arange(-reach, reach + 1.0)[:, None]


def _outcomes(number: Floats, mean: Floats, sd: Floats, top: int) -> tuple[Floats, Floats, Floats]:
    """Lower and upper edge in standard deviations, and probability, of each number (m, n) of pixels (n,)."""
    lower = np.where(number <= 0, -_FAR, np.clip((number - 0.5 - mean) / sd, -_FAR, _FAR))
    upper = np.where(number >= top, _FAR, np.clip((number + 0.5 - mean) / sd, -_FAR, _FAR))
    flip = lower > 0  # in the upper tail 1 - Φ keeps its digits
    chance = ndtr(np.where(flip, -lower, upper)) - ndtr(np.where(flip, -upper, lower))
    return lower, upper, np.where((number < 0) | (number > top), 0.0, chance)


def _summed(mean: Floats, sd: Floats, top: int) -> Floats:
    """Elements (3, n) of the information, summed over the outcomes."""
    lower, upper, chance = _outcomes(_numbers(mean, sd, top), mean, sd, top)
    below, above = _density(lower), _density(upper)
    to_mean = below - above  # times 1/sd: the derivative of the chance by µ
    to_variance = 0.5 * (lower * below - upper * above)  # times 1/v: by v
    weight = np.where(chance > _LEAST, 1.0 / np.maximum(chance, _LEAST), 0.0)
    return np.stack(
        [
            (to_mean**2 * weight).sum(axis=0) / sd**2,
            (to_mean * to_variance * weight).sum(axis=0) / sd**3,
            (to_variance**2 * weight).sum(axis=0) / sd**4,
        ]
    )


def _density(u: Floats) -> Floats:
    return np.asarray(np.exp(-0.5 * u * u) / np.sqrt(2.0 * np.pi))


def _smooth(sd: Floats) -> Floats:
    """The same for a normal value plus uniform rounding noise, which has the fourth cumulant -1/120.

    It takes nothing from µµ, and adds half of it, over the squared variance, to vv.
    """
    total = sd**2 + 1.0 / 12.0  # Sheppard's correction
    return np.stack([1.0 / total, np.zeros(sd.shape), 0.5 / total**2 * (1.0 + 1.0 / (240.0 * total**2))])


def _check(mean: Floats, variance: Floats, bits: int | None) -> None:
    if not np.isfinite(mean).all():
        raise ValueError("mean: received NaN or infinity; allowed finite counts")
    if variance.size and not (variance.min() > 0 and np.isfinite(variance).all()):
        raise ValueError(f"variance: received {variance.min():g} counts²; allowed finite numbers > 0")
    if bits is not None and not 1 <= bits <= 16:
        raise ValueError(f"bits: received {bits!r}; allowed 1 to 16, or None for counts that are not rounded")
