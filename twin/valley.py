"""The posterior along the valley: size, depth and modulus that look nearly the same.

It is followed from modulus to modulus, all else most probable and normal around it at each (Laplace's method
for marginals: Tierney and Kadane 1986, [tierney1986]). On the way out the specimen is rendered again at each
of these moduli: a map's error changes along the valley by more than the noise, and would pass for knowledge
of the modulus. Between them it follows from theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.interpolate import BarycentricInterpolator, CubicHermiteSpline, CubicSpline, interp1d

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import Fitted, Near, Prior, covariance, inside, jacobian, step_inside
from twin.valley_steps import onto

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

STILL = 0.1  # standard deviations that do not matter
NEAR = 1.0  # that a fit may move without another rendering, where it is known how the map's error changes
_STEPS = 6  # of Gauss and Newton at most, with the modulus held
_LOOKS = 3  # renderings at most for one modulus
_REACH = 1.5  # standard deviations to the next modulus, as the fit has them: it may be wrong by a factor
_SMALL = 0.02  # of that way: no side to go to
_ENOUGH, _FAR = 3.0, 4.5  # falls of the log density: that need not be passed, and that is aimed at
_STEEP = 2.0  # a fall from one modulus to the next that asks for one between
_UNSURE = 0.02  # of the probability, that splines differ by between two moduli: asks for one between
_NOTHING = 12.0  # a fall of the log density that more would not make less probable
_NODES = 9  # moduli at most
_LIKELIER = 1.0  # at most, than the most probable modulus that was looked at
_FINE = 800  # moduli in between
_HELD = 2  # the modulus, among `PARAMETERS`


@dataclass(frozen=True)
class Valley:
    """The posterior by modulus.

    Attributes
    ----------
    modulus_kPa : (m,) rising.
    log_density : (m,) of the modulus.
    points : (m, 5 + q) most probable unknowns at each.
    spread : (m, 4, 4) covariance of size, depth and offsets at each.
    """

    modulus_kPa: Floats
    log_density: Floats
    points: Floats
    spread: Floats

    def draw(self, prior: Prior, count: int, seed: int) -> Floats:
        """Return samples (count, 5)."""
        rng = np.random.default_rng([seed, 11])
        modulus = self._quantile(rng.random(count))
        at, nodes = _stiffness(modulus), _stiffness(self.modulus_kPa)
        others = _even(nodes, np.delete(self.points[:, :5], _HELD, axis=1))(at)
        roots = interp1d(nodes, np.linalg.cholesky(self.spread), axis=0)(at)
        others += np.einsum("nij,nj->ni", roots, rng.standard_normal(others.shape))
        drawn = np.insert(others, _HELD, modulus, axis=1)
        return np.clip(drawn, prior.ranges[:, 0], prior.ranges[:, 1])

    def _quantile(self, shares: Floats) -> Floats:
        fine = np.linspace(self.modulus_kPa[0], self.modulus_kPa[-1], _FINE)
        below = np.cumsum(_density(_even, self.modulus_kPa, self.log_density, fine))
        return np.asarray(np.interp(shares, below, fine))


def _stiffness(modulus_kPa: Floats) -> Floats:
    """What the valley is even in: an inclusion shows by how little it gives, which ends at a rigid one's."""
    return -1.0 / modulus_kPa


def _even(x: Floats, y: Floats) -> CubicHermiteSpline:
    """A cubic spline through nodes x (m,) of y (m, ...) whose slopes are at most twice the lesser one to a
    node beside (after Hyman 1983; [hyman1983]). Others sway where nodes are far apart, which would
    pass for a second most probable modulus."""
    chords = (np.diff(y, axis=0).T / np.diff(x)).T
    before, after = np.concatenate([chords[:1], chords]), np.concatenate([chords, chords[-1:]])
    most = 2.0 * np.minimum(np.abs(before), np.abs(after))
    slopes = np.clip(CubicSpline(x, y)(x, 1), -most, most)
    turned = (before * after > 0.0) & (slopes * before < 0.0)
    return CubicHermiteSpline(x, y, np.where(turned, 0.0, slopes))


@dataclass(frozen=True)
class _Node:
    """The most probable unknowns (5 + q,) at a modulus, log density there, covariance of the other four, and
    what is known of the map's error."""

    x: Floats
    log_density: float
    spread: Floats
    near: Near


def valley(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    frames: float,
    fitted: Fitted,
    error: Floats,
    off: Callable[[Floats], Single] | None = None,
    louder: float = 1.0,
) -> tuple[Valley, int]:
    """Follow the posterior from modulus to modulus, away from the most probable specimen.

    Parameters
    ----------
    off : by how much pictures are above the chain's at unknowns (5 + q,), by rendering; None where they are
        taken as the chain has them.
    louder : multiplies the noise's variance.

    Returns
    -------
    The valley, and how many specimens were rendered.
    """
    gain = chain.gain(prior.values(fitted.x))
    rounded = off is not None
    told = covariance(chain, features, fitted.pictures, gain, frames, prior.pattern, rounded=rounded)
    noise = linalg.cho_factor(louder * told + error)
    rest = np.delete(np.arange(len(fitted.x)), _HELD)
    looks = 0
    rendered: list[Near] = []

    def node(x: Floats, near: Near | None) -> _Node:
        """At a modulus, from unknowns x nearby; by rendering where it is not known how far the map is off."""
        nonlocal looks
        if off is None or near is not None:
            near = near or flat(x, np.zeros_like(fitted.pictures))
            return _held(chain, features, prior, observed, noise, x, rest, near)
        if rendered:  # as far as the map is off at its neighbour
            beside = min(rendered, key=lambda one: abs(one.at[_HELD] - x[_HELD]))
            x = _held(chain, features, prior, observed, noise, x, rest, beside).x
        for _ in range(_LOOKS):
            x = inside(prior, x)
            near, looks = flat(x, off(x)), looks + 1
            found = _held(chain, features, prior, observed, noise, x, rest, near)
            moved = np.abs(found.x[rest] - x[rest])[:4] / np.sqrt(np.diag(found.spread))
            x = found.x
            if moved.max() < NEAR:
                break
        rendered.append(found.near)
        return found

    tissue_kPa = chain.design.specimen.modulus_kPa
    way = fitted.covariance[:, _HELD] / fitted.covariance[_HELD, _HELD]
    found: dict[float, _Node] = {}

    def visit(modulus: float) -> _Node:
        """From the nearest that is known, along the valley as the fit has it."""
        begin = found[min(found, key=lambda other: abs(other - modulus))].x if found else fitted.x
        there = onto(begin, way, modulus, prior.ranges[_HELD], tissue_kPa)
        found[modulus] = node(there, _between(rendered, modulus))
        return found[modulus]

    low, high = prior.ranges[_HELD]
    middle, reach = float(fitted.x[_HELD]), _REACH * float(np.sqrt(fitted.covariance[_HELD, _HELD]))
    top = visit(middle).log_density
    for sign, room in ((-1.0, middle - low), (1.0, high - middle)):
        away, fall = min(reach, room), 0.0
        while away > _SMALL * reach and fall < _ENOUGH:
            fall = top - visit(middle + sign * away).log_density
            if away >= room:
                break
            away = min(away * float(np.clip(np.sqrt(_FAR / max(fall, 0.1)), 1.5, 4.0)), room)
    while len(found) < _NODES and (between := _unsure(found)) is not None:
        visit(between)
    moduli = sorted(found)
    return (
        Valley(
            np.array(moduli),
            np.array([found[one].log_density for one in moduli]),
            np.array([found[one].x for one in moduli]),
            np.array([found[one].spread for one in moduli]),
        ),
        looks,
    )


def _between(rendered: Sequence[Near], modulus: float) -> Near | None:
    """What is known between two moduli at which specimens were rendered, along a parabola where there is a
    third that is not beside one of them; None beyond them."""
    moduli = np.array([one.at[_HELD] for one in rendered])
    if len(moduli) == 0 or not moduli.min() < modulus < moduli.max():
        return None
    low = int(np.where(moduli <= modulus, moduli, -np.inf).argmax())
    high = int(np.where(moduli > modulus, moduli, np.inf).argmin())
    apart = np.minimum(np.abs(moduli - moduli[low]), np.abs(moduli - moduli[high]))
    third = int(np.where(2.0 * apart > moduli[high] - moduli[low], np.abs(moduli - modulus), np.inf).argmin())
    use = [low, high, third] if 2.0 * apart[third] > moduli[high] - moduli[low] else [low, high]
    shares = BarycentricInterpolator(moduli[use], np.eye(len(use)))(modulus)
    at = sum(share * rendered[one].at for share, one in zip(shares, use, strict=True))
    seen = sum(np.float32(share) * rendered[one].off for share, one in zip(shares, use, strict=True))
    return flat(np.asarray(at), np.asarray(seen))


def _unsure(found: Mapping[float, _Node]) -> float | None:
    """The middle of the two neighbours between which the density falls most, counted less away from the top,
    or else splines differ most on how probable moduli are; None where it falls little and they agree."""
    moduli = np.array(sorted(found))
    logs = np.array([found[one].log_density for one in moduli])
    if len(moduli) < 2:
        return None
    known = np.maximum(logs - logs.max(), -_NOTHING)
    doubt = (np.abs(np.diff(known)) + 2.0 * np.maximum(known[1:], known[:-1])) / _STEEP
    if doubt.max() < 1.0:
        fine = np.linspace(moduli[0], moduli[-1], _FINE)
        density = [_density(spline, moduli, logs, fine) for spline in (_even, CubicSpline)]
        between = np.searchsorted(moduli[1:-1], fine)
        doubt = np.bincount(between, np.abs(density[1] - density[0]), len(moduli) - 1) / _UNSURE
    if doubt.max() < 1.0:
        return None
    place = int(doubt.argmax())
    return float(0.5 * (moduli[place] + moduli[place + 1]))


def _density(spline: Callable[[Floats, Floats], Any], moduli: Floats, logs: Floats, fine: Floats) -> Floats:
    """Probabilities (n,) of moduli, by a spline through the log density at some."""
    known = np.maximum(logs - logs.max(), -_NOTHING)
    found = np.exp(np.minimum(spline(_stiffness(moduli), known)(_stiffness(fine)), _LIKELIER))
    return np.asarray(found / found.sum())


def flat(x: Floats, off: Single) -> Near:
    """What is known from one rendering."""
    return Near(x, off, np.zeros((0, len(x))), np.zeros((0, *off.shape), np.float32))


def _held(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    noise: tuple[Floats, bool],
    start: Floats,
    rest: NDArray[np.intp],
    near: Near,
) -> _Node:
    """Most probable unknowns with the modulus held, within the prior's ranges; steps that lead up are
    halved."""
    precision = prior.precision
    free = np.arange(len(start)) != _HELD
    x, least, best = inside(prior, start), np.inf, None
    for _ in range(_STEPS):
        seen, slopes = jacobian(chain, features, prior, x, near)
        away, off = observed - features(seen[None])[0], x - prior.middle
        pull = precision @ off
        cost = float(away @ linalg.cho_solve(noise, away) + off[rest] @ pull[rest])
        if best is not None and cost > least:
            x = inside(prior, 0.5 * (x + best.x))
            continue
        weighted = linalg.cho_solve(noise, slopes.T)
        information = slopes @ weighted + precision
        inverse = np.linalg.inv(information[np.ix_(rest, rest)])
        # the ranges are flat; their normal stand-in only bounds what the pictures do not tell
        log_density = -0.5 * cost + 0.5 * float(np.linalg.slogdet(inverse)[1])
        least, best = cost, _Node(x, log_density, inverse[:4, :4], near)
        step = step_inside(prior, x, information, weighted.T @ away - pull, free)
        if np.abs(step[rest] / np.sqrt(np.diag(inverse)))[:4].max() < STILL:
            break
        x = inside(prior, x + step)
    assert best is not None
    return best
