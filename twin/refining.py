"""The posterior with the light transport in it: what the network finds, corrected by rendering.

The network and the chain know the light only by a light map, whose errors are as large as the noise of one
exposure. So the most probable specimen is rendered, what the map is off there is taken out of the pictures,
and the fit goes on; where it ends, the map's own error no longer matters to first order. Where that error is
so far below the noise that it does not widen the posterior, nothing is rendered. What remains unknown
lies along a narrow, bent valley: a stiffer inclusion that is a little smaller looks nearly the same. It is
followed from modulus to modulus, all else most probable and normal around it at each (Laplace's method for
marginals: Tierney and Kadane 1986, [tierney1986]). On the way out the specimen is rendered again at each of
these moduli: a map's error changes along the valley by more than the noise, and would pass for knowledge of
the modulus. Between them it follows from theirs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats
from scipy.interpolate import BarycentricInterpolator, CubicHermiteSpline, CubicSpline, interp1d

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import (
    ALIGNMENT,
    Fitted,
    Near,
    Prior,
    covariance,
    expected,
    fit,
    inside,
    jacobian,
    placed,
    step_inside,
)
from twin.study import PARAMETERS

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_RENDERS = 5
_STILL = 0.1  # standard deviations that do not matter
_FIRST, _NEAR = 0.3, 1.0
"""Standard deviations that a fit may move after the first rendering, and after one that tells how the map's
error changes, without another."""
_ALIKE = 0.1  # counts rms, that references are apart whose difference from the map's is the same
_SHORT = 1e-3  # of the prior's spread: a way that tells nothing of how the error changes
_REMAINS = 0.01  # of the map's error after its correction nearby (see `tests/test_refining.py`)
_AS_WELL = 1.05  # times wider by the map's error a posterior may be without any rendering
_STRANGE = 1e-4  # chance of a misfit, below which the noise is taken to be louder than told
_LOUDEST = 10.0  # times its variance that are believed
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
class Refined:
    """A posterior of (size, depth, modulus, offset x, offset y), given that there is an inclusion.

    Attributes
    ----------
    samples : (n, 5).
    fitted : the most probable specimen, by the chain.
    near : what to add to the chain's pictures around it.
    explains : whether noise explains the rest, up to `_LOUDEST` times the variance that is known of: a camera
        may be noisier than told. If not, these pictures are not what is rendered.
    renders : how many specimens were rendered.
    off : by how much rendered pictures are above the chain's at unknowns (5 + q,); None where none was.
    """

    samples: Floats
    fitted: Fitted
    near: Near
    explains: bool
    renders: int
    off: Callable[[Floats], Single] | None


def refine(
    chain: Chain,
    features: Features,
    prior: Prior,
    error: Floats,
    observed: NDArray[np.floating],
    frames: float,
    start: Floats,
    render: Callable[[Mapping[str, float]], Single],
    *,
    quick: Callable[[Mapping[str, float]], Single] | None = None,
    samples: int = 4000,
    seed: int = 0,
    begin: Refined | None = None,
    always: Floats | float = 0.0,
) -> Refined:
    """Return the posterior for features (k,) of pictures that are means of so many exposures.

    Parameters
    ----------
    error : (k, k) covariance of the light map's errors in features.
    start : (5 + q,) where the fit begins.
    render : expected pictures (levels, 2, r, c) of a specimen's values, by light transport.
    quick : the same of pictures without their references, (levels, 1, r, c), of which only the change between
        specimens that are alike is right.
    begin : what other pictures of the same specimen told, with rendering: the fit begins there, with what is
        known of the light map's errors around it.
    always : (k, k) covariance of what rendered pictures are off by.
    """
    near = None if begin is None else begin.near
    remains = _REMAINS**2 * error + always
    first = error + always if near is None else remains
    begins = start if near is None else near.at
    found = fit(chain, features, prior, observed, frames, begins, first, near)
    if near is None and not _strange(found, features):
        exact = _without_error(chain, features, prior, frames, found.x, remains)
        if float((found.covariance.diagonal() / exact.diagonal())[:5].max()) < _AS_WELL**2:
            followed, _ = valley(chain, features, prior, observed, frames, found, first)
            still = _flat(found.x, np.zeros_like(found.pictures))
            return Refined(followed.draw(prior, samples, seed), found, still, True, 0, None)
    known = None if begin is None else begin.off
    off = known or _off(chain, prior, found.x, render, quick)
    remains = _REMAINS**2 * _as_here(features, error, found.pictures, off(found.x)) * error + always
    for renders in range(1, _RENDERS + 1):  # noqa: B007
        at = found.x
        near = _corrected(near, at, off(at), prior)
        found = fit(chain, features, prior, observed, frames, at, remains, near)
        moved = float((np.abs(found.x - at) / np.sqrt(np.diag(found.covariance)))[:5].max())
        enough = _NEAR if len(near.slopes) else _FIRST
        if moved < _STILL or (moved < enough and not _strange(found, features)):
            break
    assert near is not None
    louder = found.chi_square / len(features.spread) if _strange(found, features) else 1.0

    remains = remains + (louder - 1.0) * always  # told by few pictures, it may be too small itself
    followed, more = valley(chain, features, prior, observed, frames, found, remains, off, louder)
    drawn, explains = followed.draw(prior, samples, seed), bool(louder < _LOUDEST)
    return Refined(drawn, found, near, explains, renders + more, off)


def _off(
    chain: Chain,
    prior: Prior,
    at: Floats,
    render: Callable[[Mapping[str, float]], Single],
    quick: Callable[[Mapping[str, float]], Single] | None,
) -> Callable[[Floats], Single]:
    """By how much rendered pictures are above the chain's at unknowns (5 + q,).

    Quickly, from what was rendered ``at`` a specimen, as long as the references are about as they are there:
    along the valley only the inclusion changes, which they do not show. What else changes a little is left
    as it was: it moves picture and reference alike, and their difference would pass for an inclusion's.
    """
    aside = any(name in prior.names for name in ALIGNMENT)
    begins: list[Single] = []

    def whole(x: Floats) -> tuple[Floats, Single, Single]:
        """What is rendered at a specimen, from which others are told quickly."""
        values, plain = prior.values(x), expected(chain, prior, [x])[0]
        begins.clear()
        return x, plain, np.asarray(placed(render(values)[None], [values])[0] - plain, np.float32)

    at, plain, first = whole(at)

    def off(x: Floats) -> Single:
        nonlocal at, plain, first
        if np.array_equal(x, at):
            return first
        seen = expected(chain, prior, [x])[0]
        if quick is None or aside or np.sqrt(np.mean((seen - plain)[:, 1] ** 2)) > _ALIKE:
            at, plain, first = whole(x)
            return first
        if not begins:
            begins.append((first + plain)[:, :1] - quick(prior.values(at)))
        alone = np.concatenate([x[: len(PARAMETERS)], at[len(PARAMETERS) :]])
        pressed = begins[0] + quick(prior.values(alone)) - expected(chain, prior, [alone])[0][:, :1]
        return np.concatenate([pressed, first[:, 1:]], axis=1)

    return off


def _without_error(
    chain: Chain, features: Features, prior: Prior, frames: float, x: Floats, error: Floats
) -> Floats:
    """The covariance (5 + q, 5 + q) around x if features were off by ``error`` (k, k) and noise alone."""
    seen, slopes = jacobian(chain, features, prior, x)
    gain = chain.gain(prior.values(x))
    noise = covariance(chain, features, seen, gain, frames, prior.pattern) + error
    return np.asarray(np.linalg.inv(slopes @ np.linalg.solve(noise, slopes.T) + prior.precision))


def _as_here(features: Features, error: Floats, seen: Single, off: Single) -> float:
    """The variance of the map's error where pictures (levels, 2, r, c) are ``off`` by so much, over its mean
    everywhere: in the middle of the ranges it is far less than for large inclusions that are not deep."""
    with_it, without = features(np.stack([seen + off, seen]))
    return float(np.sum((with_it - without) ** 2, dtype=np.float64) / max(np.trace(error), 1e-30))


def _corrected(near: Near | None, at: Floats, off: Single, prior: Prior) -> Near:
    """Return what is known after one more rendering: how the map's error changed on the way there goes on in
    this direction (Broyden 1965; [broyden1965]).

    The direction is measured in the spread of the prior, over which the map's error changes; in that of the
    posterior all of a way along the valley would be laid to the little that it goes across.
    """
    if near is None:
        return _flat(at, off)
    way, metric = at - near.at, np.diag(prior.precision)
    length = float(way @ (metric * way))
    moved = replace(near, at=at, off=off)
    if length < _SHORT**2:
        return moved
    return moved.more(metric * way / length, np.asarray(off - near.of([at])[0], np.float32))


def _strange(found: Fitted, features: Features) -> bool:
    """Whether noise as it is known does not explain what is left."""
    return bool(stats.chi2.sf(found.chi_square, len(features.spread)) < _STRANGE)


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
    told = covariance(chain, features, fitted.pictures, gain, frames, prior.pattern)
    noise = linalg.cho_factor(louder * told + error)
    rest = np.delete(np.arange(len(fitted.x)), _HELD)
    looks = 0
    rendered: list[Near] = []

    def node(x: Floats, near: Near | None) -> _Node:
        """At a modulus, from unknowns x nearby; by rendering where it is not known how far the map is off."""
        nonlocal looks
        if off is None or near is not None:
            near = near or _flat(x, np.zeros_like(fitted.pictures))
            return _held(chain, features, prior, observed, noise, x, rest, near)
        if rendered:  # as far as the map is off at its neighbour
            beside = min(rendered, key=lambda one: abs(one.at[_HELD] - x[_HELD]))
            x = _held(chain, features, prior, observed, noise, x, rest, beside).x
        for _ in range(_LOOKS):
            x = inside(prior, x)
            near, looks = _flat(x, off(x)), looks + 1
            found = _held(chain, features, prior, observed, noise, x, rest, near)
            moved = np.abs(found.x[rest] - x[rest])[:4] / np.sqrt(np.diag(found.spread))
            x = found.x
            if moved.max() < _NEAR:
                break
        rendered.append(found.near)
        return found

    way = fitted.covariance[:, _HELD] / fitted.covariance[_HELD, _HELD]
    found: dict[float, _Node] = {}

    def visit(modulus: float) -> _Node:
        """From the nearest that is known, along the valley as the fit has it."""
        begin = found[min(found, key=lambda other: abs(other - modulus))].x if found else fitted.x
        found[modulus] = node(begin + way * (modulus - begin[_HELD]), _between(rendered, modulus))
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
    return _flat(np.asarray(at), np.asarray(seen))


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


def _flat(x: Floats, off: Single) -> Near:
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
        step, cut = step_inside(prior, x, information, weighted.T @ away - pull, free)
        if not cut and np.abs(step[rest] / np.sqrt(np.diag(inverse)))[:4].max() < _STILL:
            break
        x = inside(prior, x + step)
    assert best is not None
    return best
