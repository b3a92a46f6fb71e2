"""How well parameters can be known from pictures: Fisher's information and the bounds that follow from it.

A picture's counts have means µ(θ) with the Jacobian J = ∂µ/∂θ; each pixel tells w about its mean (counts⁻²),
so that pictures tell F = Σ J w Jᵀ about θ. No unbiased estimator has a covariance below F⁻¹ (Rao 1945,
Cramér 1946; Kay 1993, section 3.7; [rao1945], [cramer1946], [kay1993]). Prior knowledge of precision P makes
that (F + P)⁻¹: the posterior covariance of the linearised model with normal priors; averaged over the prior
before it is inverted, the bound of Van Trees for the mean squared error of any estimator (Van Trees 1968,
section 2.4; [vantrees1968]). Parameters that nobody asks for are unknown too: the block of the inverse that
belongs to the wanted ones is what remains (the inverse of Schur's complement).

Pixels are independent given θ. Noise is normal before rounding, which shot noise is from about 20 electrons.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.quantised import count_information

Floats = NDArray[np.float64]

_NULL = 1e-12  # eigenvalues of the scaled matrix, per parameter, that count as zero
_LEAN = 1e-6  # a parameter's component along such a direction that leaves it unbounded


@dataclass(frozen=True)
class Noise:
    """A camera's noise in counts, after EMVA 1288's linear model (release 4.0, section 2; [emva1288]).

    Attributes
    ----------
    shot : counts² of variance per count of light, the system gain K: 1 / (electrons per count).
    read_dn : standard deviation of the noise without light, counts before rounding.
    offset_dn : counts without light.
    bits : of the converter, which rounds and clips to 0 ... 2^bits - 1; None if it does neither.
    frames : exposures of the same scene that are averaged; each is rounded by itself.
    fixed_dn, fixed_share : standard deviation, per pixel, of what no averaging takes away (fixed pattern,
        model error), in counts and as a share of the light; both are independent from pixel to pixel, and
        `fixed_dn` may be an array like the picture. Taring leaves of a camera's fixed pattern its PRNU times
        the tared signal.
    """

    shot: float
    read_dn: float
    offset_dn: float = 0.0
    bits: int | None = 8
    frames: int = 1
    fixed_dn: float | Floats = 0.0
    fixed_share: float = 0.0

    def __post_init__(self) -> None:
        for name in ("shot", "read_dn", "fixed_dn", "fixed_share"):
            value = np.asarray(getattr(self, name))
            if not ((value >= 0) & (value < np.inf)).all():
                raise ValueError(f"{name}: received {value.min():g}; allowed finite numbers >= 0")
        if self.frames < 1:
            raise ValueError(f"frames: received {self.frames!r}; allowed 1 or more")


@dataclass(frozen=True)
class Information:
    """What pictures tell about parameters, and what was known before.

    Attributes
    ----------
    names : of the p parameters.
    fisher : (p, p), from the pictures; unit of element ij: 1 / (unit of i times unit of j).
    prior : (p, p), the precision (inverse covariance) of what was known before.
    """

    names: tuple[str, ...]
    fisher: Floats
    prior: Floats

    def index(self, wanted: Sequence[str]) -> list[int]:
        """Places of these parameters."""
        for name in wanted:
            if name not in self.names:
                raise ValueError(f"wanted: received {name!r}; allowed {', '.join(self.names)}")
        return [self.names.index(name) for name in wanted]


@dataclass(frozen=True)
class Bound:
    """Least covariance (k, k) and standard deviations (k,) of estimates of these parameters.

    A parameter that neither pictures nor prior fix has an infinite sd (its covariances are NaN).
    """

    names: tuple[str, ...]
    covariance: Floats
    sd: Floats


def mean_variance(mean: ArrayLike, noise: Noise) -> Floats:
    """Variance of one frame's counts before rounding, counts², of pixels with these means (counts)."""
    light = np.maximum(np.asarray(mean, np.float64) - noise.offset_dn, 0.0)
    return np.asarray(noise.read_dn**2 + noise.shot * light)


def pixel_information(mean: ArrayLike, noise: Noise) -> Floats:
    """What the frames of each pixel tell about its mean, counts⁻², of the same shape as `mean`.

    The variance follows the mean with the slope `shot`, and tells about it too. Frames add: that is what all
    of them tell, and their average keeps it but for what their spread tells (Kay 1993, section 3.3;
    [kay1993]). With fixed errors of variance t² beside, w becomes 1 / (1/w + t²): one more unknown per
    pixel, with a normal prior.
    """
    mean = np.asarray(mean, np.float64)
    light = np.maximum(mean - noise.offset_dn, 0.0)
    slope = np.where(light > 0, noise.shot, 0.0)
    weight = noise.frames * count_information(mean, mean_variance(mean, noise), noise.bits).along(slope)
    fixed = noise.fixed_dn**2 + (noise.fixed_share * light) ** 2
    return np.asarray(weight / (1.0 + weight * fixed))


def fisher(jacobian: ArrayLike, weight: ArrayLike) -> Floats:
    """Fisher's matrix (p, p) = Σ J w Jᵀ over the pixels (Kay 1993, equation 3.31; [kay1993]).

    Parameters
    ----------
    jacobian : (p, ...) counts per unit of each parameter.
    weight : (...) from `pixel_information`, counts⁻².
    """
    slopes, weights = np.asarray(jacobian, np.float64), np.asarray(weight, np.float64)
    if slopes.ndim < 1 or slopes.shape[1:] != weights.shape:
        raise ValueError(
            f"jacobian: received shape {slopes.shape}; allowed (parameters, *{weights.shape}), as the mean"
        )
    flat = slopes.reshape(len(slopes), weights.size)
    found = (flat * weights.ravel()) @ flat.T
    return np.asarray(0.5 * (found + found.T))


def inform(
    names: Sequence[str],
    pictures: Iterable[tuple[ArrayLike, ArrayLike, Noise]],
    prior: ArrayLike | None = None,
) -> Information:
    """What independent pictures tell together about the same parameters.

    Parameters
    ----------
    names : of the p parameters, wanted ones and nuisances.
    pictures : (jacobian, mean, noise) of each: counts per unit (p, ...), counts (...), and its camera. A
        reference picture without inclusion is one more, whose Jacobian is zero for the inclusion.
    prior : of normal prior knowledge, (p,) standard deviations in each parameter's unit, inf where none, or
        the (p, p) precision matrix. Without, none.
    """
    named = tuple(names)
    total = np.zeros((len(named), len(named)))
    for jacobian, mean, noise in pictures:
        one = fisher(jacobian, pixel_information(mean, noise))
        if one.shape != total.shape:
            raise ValueError(f"jacobian: received {len(one)} parameters; allowed {len(named)}: {named}")
        total += one
    known = precision(np.full(len(named), np.inf) if prior is None else prior)
    if known.shape != total.shape:
        raise ValueError(f"prior: received {len(known)} parameters; allowed {len(named)}: {named}")
    return Information(named, total, known)


def precision(prior: ArrayLike) -> Floats:
    """Precision matrix (p, p) of independent priors with these sd (p,), inf for none; or itself, checked."""
    given = np.asarray(prior, np.float64)
    if given.ndim == 1 and (given > 0).all():
        return np.diag(1.0 / given**2)
    if given.ndim == 2 and np.isfinite(given).all() and given.shape == given.T.shape:
        least = np.linalg.eigvalsh(given).min() if np.allclose(given, given.T, rtol=1e-9) else -np.inf
        if least >= -_NULL * np.abs(given).max():
            return given
    allowed = (
        "standard deviations > 0, inf for none, or a symmetric precision matrix without negative eigenvalues"
    )
    raise ValueError(f"prior: received {given.tolist()}; allowed {allowed}")


def bound(
    information: Information,
    wanted: Sequence[str] | None = None,
    *,
    prior: bool = True,
    known: Sequence[str] = (),
) -> Bound:
    """Bound on estimates of the wanted parameters, all others unknown but for those that are `known`.

    With prior knowledge (F + P)⁻¹; without, `prior=False`, Cramér and Rao's F⁻¹ with the nuisances unknown
    altogether.
    """
    wanted = (
        tuple(name for name in information.names if name not in known) if wanted is None else tuple(wanted)
    )
    gone = set(information.index(known))
    if set(wanted) & set(known):
        raise ValueError(f"known: received {tuple(known)}; allowed parameters that are not wanted")
    total = information.fisher + information.prior if prior else information.fisher
    kept = [i for i in range(len(information.names)) if i not in gone]
    covariance = _inverse(total[np.ix_(kept, kept)])
    at = [kept.index(i) for i in information.index(wanted)]
    found = covariance[np.ix_(at, at)]
    return Bound(wanted, found, np.sqrt(np.diag(found)))


def van_trees(fishers: ArrayLike, prior: ArrayLike) -> Floats:
    """Bound (p, p) on the mean squared error over the prior, (E[F] + P)⁻¹ (Van Trees 1968, section 2.4).

    It never exceeds the mean of (F + P)⁻¹ over the same samples, which estimators come nearer to.

    Parameters
    ----------
    fishers : (m, p, p) at m samples of the prior.
    prior : (p, p), its information E[∇ln π ∇ln πᵀ]; the precision of a normal prior.
    """
    return _inverse(np.asarray(fishers, np.float64).mean(axis=0) + np.asarray(prior, np.float64))


def marginal(matrix: ArrayLike, keep: Sequence[int]) -> Floats:
    """Information (k, k) about the parameters at `keep` with the others unknown: Schur's complement."""
    whole = np.asarray(matrix, np.float64)
    rest = [i for i in range(len(whole)) if i not in set(keep)]
    scale = np.sqrt(np.diag(whole)[rest])
    scale = np.where(scale > 0, scale, 1.0)
    inner = np.linalg.pinv(whole[np.ix_(rest, rest)] / np.outer(scale, scale), _NULL * len(whole), True)
    cross = whole[np.ix_(keep, rest)] / scale
    return np.asarray(whole[np.ix_(keep, keep)] - cross @ inner @ cross.T)


def with_prior(information: Information, name: str, factor: float) -> Information:
    """The same pictures after a calibration that multiplies the prior sd of one parameter by `factor` > 0."""
    if not 0 < factor < np.inf:
        raise ValueError(f"factor: received {factor!r}; allowed a number > 0")
    at = information.index([name])[0]
    scale = np.ones(len(information.names))
    scale[at] = 1.0 / factor
    return replace(information, prior=information.prior * np.outer(scale, scale))


def _inverse(matrix: Floats) -> Floats:
    """Inverse of a symmetric positive semidefinite matrix; inf and NaN for what it leaves open."""
    diagonal = np.diag(matrix)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))  # units must not decide what is zero
    value, vector = np.linalg.eigh(matrix * np.outer(scale, scale))
    null = value <= _NULL * len(matrix)
    inverse = (vector[:, ~null] / value[~null]) @ vector[:, ~null].T * np.outer(scale, scale)
    open_ = (np.abs(vector[:, null]) > _LEAN).any(axis=1)
    inverse[open_, :] = inverse[:, open_] = np.nan
    inverse[open_, open_] = np.inf
    return np.asarray(inverse)
