"""The model-based estimator: the most probable specimen by the chain.

Pictures are features (`estimation.features`) with normal noise; what is not known has a normal prior, the
inclusion's that of a uniform draw from its ranges. Gauss-Newton steps, bent along the valley
(`twin.valley_steps`), lead to the most probable values (Kay 1993, section 11.5; [kay1993]); derivatives are
central differences.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from estimation.alignment import moved
from estimation.features import Features
from fem.sampling import clearance
from twin.block_noise import mean_variance
from twin.chain import BLOCK, Chain
from twin.imagined import Brightness, pictures
from twin.likeness import MISALIGNED_PERCENT
from twin.study import PARAMETERS
from twin.valley_steps import bent

Floats = NDArray[np.float64]

ALIGNMENT = ("camera.shift_x", "camera.shift_y", "camera.larger", "camera.turn")
"""Arguments of `alignment.moved`, as unknowns of a specimen's pictures."""
_STEPS = {"size_mm": 0.02, "depth_mm": 0.02, "modulus_kPa": 0.5, "offset_x_mm": 0.02, "offset_y_mm": 0.02}
_NUISANCE_STEP = 0.1  # standard deviations
_MOST = 12  # Gauss-Newton steps
_DONE = 0.01  # step in standard deviations that ends them
_SHARES = (1.0, 0.5, 0.2, 0.05)  # of a step that are tried
_NOTHING = 1e-9  # of a number's spread: rounding


@dataclass(frozen=True)
class Prior:
    """What is known before: of `PARAMETERS` their ranges (5, 2), of all else that varies a normal law.

    Attributes
    ----------
    names : of the other numbers.
    mean, basis : (m,) and (m, q); they are mean + basis @ t with independent t of variance one.
    pattern : standard deviation of the camera's pixels' response about that of the design's, a share.
    """

    ranges: Floats
    names: tuple[str, ...]
    mean: Floats
    basis: Floats
    pattern: float = 0.0

    @property
    def precision(self) -> Floats:
        """(5 + q, 5 + q) of all unknowns."""
        spans = np.maximum(self.ranges[:, 1] - self.ranges[:, 0], 1e-9)
        return np.diag([*(12.0 / spans**2), *np.ones(self.basis.shape[1])])

    @property
    def middle(self) -> Floats:
        """(5 + q,) the prior's mean."""
        return np.concatenate([self.ranges.mean(axis=1), np.zeros(self.basis.shape[1])])

    def of_another_camera(self, pattern: float, percent: float = MISALIGNED_PERCENT) -> Prior:
        """Return the prior of a camera with another pattern, which stands nobody knows exactly where."""
        more, (m, q) = len(ALIGNMENT), self.basis.shape
        basis = np.zeros((m + more, q + more))
        basis[:m, :q] = self.basis
        basis[m:, q:] = 0.01 * percent * np.eye(more)
        names, mean = (*self.names, *ALIGNMENT), np.concatenate([self.mean, np.zeros(more)])
        return Prior(self.ranges, names, mean, basis, pattern)

    def values(self, x: Floats) -> dict[str, float]:
        """Return the values by name of unknowns (5 + q,)."""
        others = self.mean + self.basis @ x[5:]
        return {
            **{name: float(value) for name, value in zip(PARAMETERS, x[:5], strict=True)},
            **{name: float(value) for name, value in zip(self.names, others, strict=True)},
        }

    def unknowns(self, values: Mapping[str, float]) -> Floats:
        """Return the unknowns (5 + q,) nearest to values by name."""
        others = np.array([values[name] for name in self.names]) - self.mean
        inner = np.linalg.lstsq(self.basis, others, rcond=None)[0]
        return np.concatenate([[values[name] for name in PARAMETERS], inner])


def prior_of(ranges: Floats, drawn: Sequence[Mapping[str, float]]) -> Prior:
    """Return the prior of specimens that were drawn: ranges (5, 2), and the spread of all else."""
    names = tuple(name for name in drawn[0] if name not in PARAMETERS)
    if not names:
        return Prior(ranges, (), np.zeros(0), np.zeros((0, 0)))
    table = np.array([[one[name] for name in names] for one in drawn])
    mean = table.mean(axis=0)
    scale = np.maximum(table.std(axis=0), 1e-12)
    values, vectors = np.linalg.eigh(np.cov((table - mean).T / scale[:, None]).reshape(len(names), -1))
    keep = values > 1e-6 * values.max()
    return apart(Prior(ranges, names, mean, scale[:, None] * vectors[:, keep] * np.sqrt(values[keep])))


def apart(prior: Prior) -> Prior:
    """Return the same prior with as few unknowns as can be that bear on the contact.

    Independent normal numbers stay so when they are turned; here so that what follows the contact's numbers
    changes only how bright pictures are, for which no press need be worked out (`_inputs`).
    """
    order = np.argsort([_bright(name) for name in prior.names], kind="stable")
    turn = np.linalg.qr(prior.basis[order].T)[0]
    basis = prior.basis @ turn
    size = np.linalg.norm(basis, axis=1, keepdims=True)
    return replace(prior, basis=np.where(np.abs(basis) > _NOTHING * size, basis, 0.0))


@dataclass(frozen=True)
class Fitted:
    """The most probable unknowns (5 + q,), their covariance, chi-square over features, expected pictures."""

    x: Floats
    covariance: Floats
    chi_square: float
    pictures: NDArray[np.float32]


@dataclass(frozen=True)
class Near:
    """How far rendered pictures are above the chain's around a specimen: off + Σ slope u, with
    u = along · (x - at).

    Attributes
    ----------
    at : (5 + q,) the specimen.
    off : (levels, 2, r, c) counts there.
    along : (m, 5 + q) directions in which it is known how that changes.
    slopes : (m, levels, 2, r, c) how.
    """

    at: Floats
    off: NDArray[np.float32]
    along: Floats
    slopes: NDArray[np.float32]

    def of(self, many: Sequence[Floats]) -> NDArray[np.float32]:
        """Return the difference at unknowns (5 + q,) each, (n, levels, 2, r, c)."""
        u = (np.stack(many) - self.at) @ self.along.T
        return np.asarray(self.off + np.tensordot(u, self.slopes, 1), np.float32)

    def more(self, along: Floats, slope: NDArray[np.float32]) -> Near:
        """Return what is known with one more direction."""
        return replace(
            self,
            along=np.concatenate([self.along, along[None]]),
            slopes=np.concatenate([self.slopes, slope[None]]),
        )


def expected(
    chain: Chain, prior: Prior, many: Sequence[Floats], near: Near | None = None
) -> NDArray[np.float32]:
    """Return expected counts above black (n, levels, 2, r, c) at unknowns (5 + q,) each."""
    inputs, values = _inputs(chain, prior, many)
    seen = placed(pictures(chain, inputs, Brightness.of(chain, values)), values)
    return seen if near is None else seen + near.of(many)


def placed(seen: NDArray[np.float32], many: Sequence[Mapping[str, float]]) -> NDArray[np.float32]:
    """Return pictures (n, levels, 2, r, c) as the camera of each sees them from where it stands."""
    for one, values in zip(seen, many, strict=True):
        if off := [values[name] for name in ALIGNMENT if name in values]:
            one[...] = moved(one.reshape(-1, *one.shape[-2:]), *off).reshape(one.shape)
    return seen


def expected_layers(chain: Chain, prior: Prior, many: Sequence[Floats]) -> NDArray[np.float32]:
    """Return the same with one LED alight at a time, (n, levels, 2, n_led, r, c)."""
    inputs, values = _inputs(chain, prior, many)
    bright = Brightness.of(chain, values)
    charges = chain.light.at(inputs.reshape(-1, inputs.shape[-1]))
    scale = bright.flux_W / bright.gain[:, None]
    charges = charges.reshape(*inputs.shape[:3], *chain.light.shape)
    return np.asarray(charges * scale[:, None, None, :, None, None], np.float32)


def _inputs(chain: Chain, prior: Prior, many: Sequence[Floats]) -> tuple[Floats, list[dict[str, float]]]:
    """The light map's inputs (n, levels, 2, k) and the values by name; equal contacts are computed once."""
    values = [reachable(chain, prior.values(x)) for x in many]
    contact = [tuple(v for k, v in one.items() if not _bright(k)) for one in values]
    first: dict[tuple[float, ...], int] = {}
    for key in contact:
        first.setdefault(key, len(first))
    chosen = [values[contact.index(key)] for key in first]
    return chain.inputs(chosen)[[first[key] for key in contact]], values


def reachable(chain: Chain, values: dict[str, float]) -> dict[str, float]:
    """Values within the emulator's ranges: strange pictures may ask for a press that it cannot tell."""
    ranges, tissue = chain.emulator.plan.ranges, chain.design.specimen
    spans = {"specimen.thickness_mm": ranges.thickness_mm, "specimen.modulus_kPa": ranges.tissue_kPa}
    found = {
        name: float(
            np.clip(
                value,
                *(ranges.indentation_mm if name.startswith("press.") else spans.get(name, (-np.inf, np.inf))),
            )
        )
        for name, value in values.items()
    }
    thickness = found.get("specimen.thickness_mm", tissue.thickness_mm)
    room = clearance(found["size_mm"], found["depth_mm"], thickness)
    found["depth_mm"] += min(room, 0.0)
    return found


def _bright(name: str) -> bool:
    return name.startswith(("leds.", "camera."))


def jacobian(
    chain: Chain, features: Features, prior: Prior, x: Floats, near: Near | None = None
) -> tuple[NDArray[np.float32], Floats]:
    """Return the pictures (levels, 2, r, c) at unknowns x, and derivatives (5 + q, k) of their features."""
    ends, apart = differences(prior, x)
    seen = expected(chain, prior, [x, *ends], near)
    found = features(seen[1:]).astype(np.float64)
    return seen[0], (found[1::2] - found[::2]) / apart[:, None]


def differences(prior: Prior, x: Floats) -> tuple[list[Floats], Floats]:
    """Return unknowns a step below and above x for each of them in turn, and how far these are apart."""
    steps = np.array([*(_STEPS[name] for name in PARAMETERS), *[_NUISANCE_STEP] * (len(x) - 5)])
    ends = []
    for number, step in enumerate(steps):
        for sign in (-1.0, 1.0):
            end = x.copy()
            end[number] += sign * step
            if number < 5:
                end[number] = np.clip(end[number], *prior.ranges[number])
            ends.append(end)
    return ends, np.array([ends[2 * n + 1][n] - ends[2 * n][n] for n in range(len(x))])


def covariance(
    chain: Chain,
    features: Features,
    seen: NDArray[np.floating],
    gain: float,
    frames: float,
    pattern: float = 0.0,
    rounded: bool = False,
) -> Floats:
    """Return the covariance (k, k) of the features' noise in pictures (levels, 2, r, c) of so many exposures.

    References are the mean of `posterior.REFERENCE_FRAMES` at least. ``pattern`` is that of `Prior`; it is
    the same in all pictures. ``rounded`` tells that expected pictures have what rounding does to blocks.
    """
    variance = mean_variance(chain.design, seen[None], np.array([gain]), frames, rounded=rounded)[0]
    total = np.zeros((len(features.spread),) * 2)
    onto = features.onto
    for place in (0, 1):
        for level in range(len(seen)):
            axes = onto[level, place]
            total += (axes * variance[level, place].reshape(-1, 1)).T @ axes
    if pattern:
        light = np.maximum(seen, 0.0).reshape(*seen.shape[:2], -1)
        both = np.einsum("lpmk,lpm->mk", onto, light) * (pattern / np.sqrt(BLOCK[0] * BLOCK[1]))
        total += both.T @ both
    return total


def fit(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    frames: float,
    start: Floats,
    error: Floats | None = None,
    near: Near | None = None,
    held: int = 0,
) -> Fitted:
    """Return the most probable specimen for features (k,) of pictures that are means of so many exposures.

    Parameters
    ----------
    start : (5 + q,) where to begin.
    error : (k, k) covariance of the chain's own errors.
    near : what is known of these errors around the start.
    held : how many of the unknowns, from the first on, stay at the start.
    """
    x, precision, tissue_kPa = inside(prior, start), prior.precision, chain.design.specimen.modulus_kPa
    found: Fitted | None = None
    for _ in range(_MOST):
        seen, slopes = jacobian(chain, features, prior, x, near)
        gain = chain.gain(prior.values(x))
        noise = covariance(chain, features, seen, gain, frames, prior.pattern, rounded=near is not None)
        noise += 0.0 if error is None else error
        weighted = np.linalg.solve(noise, slopes.T)
        rest = observed - features(seen[None])[0]
        information = slopes @ weighted + precision
        slope = weighted.T @ rest - precision @ (x - prior.middle)
        free = np.arange(len(x)) >= held
        step = step_inside(prior, x, information, slope, free)
        inverse = np.linalg.inv(information)
        inverse = 0.5 * (inverse + inverse.T)  # even but for rounding, which who draws from it would see
        found = Fitted(x, inverse, float(rest @ np.linalg.solve(noise, rest)), seen)
        size = np.abs(step) / np.sqrt(np.diag(inverse))
        if size.max() < _DONE:
            break
        tried = [inside(prior, bent(x, share * step, prior.ranges[2], tissue_kPa)) for share in _SHARES]
        best = _likeliest(chain, features, prior, [x, *tried], observed, noise, near)
        if best == 0:
            break
        x = tried[best - 1]
    assert found is not None
    return found


def step_inside(
    prior: Prior, x: Floats, information: Floats, slope: Floats, free: NDArray[np.bool_]
) -> Floats:
    """Return the step of Gauss and Newton to the best place within the prior's ranges; what is not free
    (5 + q,) stays.

    What comes to the end of its range is left there, and the others go where they are best then (Stark and
    Parker 1995; [stark1995]). Were the step cut short there, all else would stand still, too.
    """
    ends = np.tile([[-np.inf], [np.inf]], len(x))
    ends[:, : len(PARAMETERS)] = prior.ranges.T - x[: len(PARAMETERS)]
    free = free & (ends[0] < ends[1])
    scale = 1.0 / np.sqrt(np.diag(information)[free])
    # by parts, of which rounding may leave the least below nothing where many exposures tell much
    told, parts = np.linalg.eigh(scale[:, None] * information[np.ix_(free, free)] * scale)
    root = np.sqrt(np.maximum(told, np.finfo(float).eps * told[-1]))
    ahead = parts.T @ (scale * slope[free]) / root
    step = np.zeros(len(x))
    step[free] = scale * lsq_linear(root[:, None] * parts.T, ahead, ends[:, free] / scale, method="bvls").x
    return step


def _likeliest(
    chain: Chain,
    features: Features,
    prior: Prior,
    tried: Sequence[Floats],
    observed: NDArray[np.floating],
    noise: Floats,
    near: Near | None,
) -> int:
    """Return which of unknowns (5 + q,) has the least sum of squares."""
    rest = observed - features(expected(chain, prior, tried, near))
    away = np.stack(tried) - prior.middle
    cost = np.einsum("nk,nk->n", rest, np.linalg.solve(noise, rest.T).T)
    cost += np.einsum("ni,ij,nj->n", away, prior.precision, away)
    return int(np.argmin(cost))


def inside(prior: Prior, x: Floats) -> Floats:
    """Return unknowns within the prior's ranges, and within four standard deviations."""
    inner = x.copy()
    inner[:5] = np.clip(x[:5], prior.ranges[:, 0], prior.ranges[:, 1])
    inner[5:] = np.clip(x[5:], -4.0, 4.0)
    return inner
