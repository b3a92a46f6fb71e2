"""The posterior with the light transport in it: what the network finds, corrected by rendering.

The network and the chain know the light only by a light map, whose errors are as large as the noise of one
exposure. So the most probable specimen is rendered, what the map is off there is taken out of the pictures,
and the fit goes on; where it ends, the map's own error no longer matters to first order. What remains unknown
lies along a narrow, bent valley: a stiffer inclusion that is a little smaller looks nearly the same. It is
followed from modulus to modulus, all else most probable and normal around it at each (Laplace's method for
marginals: Tierney and Kadane 1986, [tierney1986]).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, stats
from scipy.interpolate import CubicSpline, PchipInterpolator, interp1d

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import Fitted, Near, Prior, covariance, expected, fit, inside, jacobian, placed

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_RENDERS = 5
_STILL = 0.1  # standard deviations that do not matter
_FIRST, _NEAR = 0.3, 1.0
"""Standard deviations that a fit may move after the first rendering, and after one that tells how the map's
error changes, without another."""
_SHORT = 1e-3  # of the prior's spread: a way that tells nothing of how the error changes
_REMAINS = 0.05  # of the map's error after its correction nearby (see `tests/test_refining.py`)
_STRANGE = 1e-4  # chance of a misfit, below which the noise is taken to be louder than told
_LOUDEST = 10.0  # times its variance that are believed
_NODES = 9  # moduli at which all else is fitted
_REACH = 3.5  # standard deviations that they go away from the most probable
_STEPS = 2  # of Gauss and Newton at each, from its neighbour
_FINE = 800  # moduli in between
_ENDS = (0.1, 0.9)  # of the posterior
_LONG = 0.12  # of the moduli's range: a valley along which the map's error changes
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
    """

    samples: Floats
    fitted: Fitted
    near: Near
    explains: bool
    renders: int


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
    samples: int = 4000,
    seed: int = 0,
    begin: Near | None = None,
    always: Floats | float = 0.0,
) -> Refined:
    """Return the posterior for features (k,) of pictures that are means of so many exposures.

    Parameters
    ----------
    error : (k, k) covariance of the light map's errors in features.
    start : (5 + q,) where the fit begins.
    render : expected pictures (levels, 2, r, c) of a specimen's values, by light transport.
    begin : what is known of the light map's errors around the specimen, from other pictures of it: the
        fit begins there, for far from it that says nothing.
    always : (k, k) covariance of what rendered pictures are off by.
    """
    near = begin
    remains = _REMAINS**2 * error + always
    first = error + always if near is None else remains
    begins = start if near is None else near.at
    found = fit(chain, features, prior, observed, frames, begins, first, near)
    for renders in range(1, _RENDERS + 1):  # noqa: B007
        at = found.x
        values = prior.values(at)
        plain = found.pictures if near is None else found.pictures - near.of([at])[0]
        near = _corrected(near, at, placed(render(values)[None], [values])[0] - plain, prior)
        found = fit(chain, features, prior, observed, frames, at, remains, near)
        moved = float((np.abs(found.x - at) / np.sqrt(np.diag(found.covariance)))[:5].max())
        enough = _NEAR if len(near.slopes) else _FIRST
        if moved < _STILL or (moved < enough and not _strange(found, features)):
            break
    assert near is not None
    louder = found.chi_square / len(features.spread) if _strange(found, features) else 1.0
    followed = valley(chain, features, prior, observed, frames, found, remains, near, louder)
    ends = [inside(prior, x) for x in followed.ends()]
    if ends[1][_HELD] - ends[0][_HELD] > _LONG * (prior.ranges[_HELD, 1] - prior.ranges[_HELD, 0]):
        seen = []
        for x in ends:
            values = prior.values(x)
            rest = placed(render(values)[None], [values])[0] - expected(chain, prior, [x])[0]
            seen.append((x, np.asarray(rest, np.float32)))
        near, renders = _bent(near, seen, prior), renders + 2
        found = fit(chain, features, prior, observed, frames, found.x, remains, near)
        followed = valley(chain, features, prior, observed, frames, found, remains, near, louder)
    return Refined(followed.draw(prior, samples, seed), found, near, bool(louder < _LOUDEST), renders)


def _corrected(near: Near | None, at: Floats, off: Single, prior: Prior) -> Near:
    """Return what is known after one more rendering: how the map's error changed on the way there goes on in
    this direction (Broyden 1965; [broyden1965]).

    The direction is measured in the spread of the prior, over which the map's error changes; in that of the
    posterior all of a way along the valley would be laid to the little that it goes across.
    """
    if near is None:
        none = np.zeros((0, *off.shape), np.float32)
        return Near(at, off, np.zeros((0, len(at))), none, none)
    way, metric = at - near.at, np.diag(prior.precision)
    length = float(way @ (metric * way))
    # of the directions that are known already only their slope at the new place is kept
    u = near.along @ way
    shape = (-1, *(1,) * off.ndim)
    slopes = near.slopes + np.float32(2.0) * u.reshape(shape).astype(np.float32) * near.bends
    moved = replace(near, at=at, off=off, slopes=slopes)
    if length < _SHORT**2:
        return moved
    return moved.more(metric * way / length, np.asarray(off - near.of([at])[0], np.float32))


def _bent(near: Near, ends: Sequence[tuple[Floats, Single]], prior: Prior) -> Near:
    """Return what is known after renderings at both ends of the valley, unknowns and differences there: the
    parabola through these and the middle."""
    way, metric = ends[1][0] - ends[0][0], np.diag(prior.precision)
    along = metric * way / float(way @ (metric * way))
    u = np.array([along @ (x - near.at) for x, _ in ends])
    rest = [off - near.of([x])[0] for x, off in ends]
    slope, bend = np.linalg.solve(np.stack([u, u**2], axis=1), np.stack([one.ravel() for one in rest]))
    shape = near.off.shape
    return near.more(along, slope.reshape(shape).astype(np.float32), bend.reshape(shape).astype(np.float32))


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
        others = CubicSpline(self.modulus_kPa, np.delete(self.points[:, :5], _HELD, axis=1))(modulus)
        roots = interp1d(self.modulus_kPa, np.linalg.cholesky(self.spread), axis=0)(modulus)
        others += np.einsum("nij,nj->ni", roots, rng.standard_normal(others.shape))
        drawn = np.insert(others, _HELD, modulus, axis=1)
        return np.clip(drawn, prior.ranges[:, 0], prior.ranges[:, 1])

    def ends(self) -> Floats:
        """Return unknowns (2, 5 + q) far down and up the valley."""
        return np.asarray(CubicSpline(self.modulus_kPa, self.points)(self._quantile(np.array(_ENDS))))

    def _quantile(self, shares: Floats) -> Floats:
        fine = np.linspace(self.modulus_kPa[0], self.modulus_kPa[-1], _FINE)
        logs = PchipInterpolator(self.modulus_kPa, self.log_density)(fine)  # never above its nodes
        below = np.cumsum(np.exp(logs - logs.max()))
        return np.asarray(np.interp(shares, below / below[-1], fine))


def valley(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    frames: float,
    fitted: Fitted,
    error: Floats,
    near: Near,
    louder: float = 1.0,
) -> Valley:
    """Follow the posterior from modulus to modulus, away from the most probable specimen.

    ``louder`` multiplies the noise's variance.
    """
    sd = float(np.sqrt(fitted.covariance[_HELD, _HELD]))
    top = float(fitted.x[_HELD])
    low = max(top - _REACH * sd, prior.ranges[_HELD, 0])
    high = min(top + _REACH * sd, prior.ranges[_HELD, 1])
    moduli = np.linspace(low, high, _NODES)
    first = int(np.argmin(np.abs(moduli - top)))
    rest = np.delete(np.arange(len(fitted.x)), _HELD)
    gain = chain.gain(prior.values(fitted.x))
    told = covariance(chain, features, fitted.pictures, gain, frames, prior.pattern)
    noise = linalg.cho_factor(louder * told + error)
    slope = fitted.covariance[rest, _HELD] / fitted.covariance[_HELD, _HELD]
    found: dict[int, tuple[Floats, float, Floats]] = {}
    begin = fitted.x.copy()
    begin[rest] += slope * (moduli[first] - top)
    for way in (range(first, _NODES), range(first - 1, -1, -1)):
        for node in way:
            next_ = [found[n][0] for n in (node - 1, node + 1) if n in found]
            beyond = [found[n][0] for n in (node - 2, node + 2) if n in found]
            start = begin if not next_ else 2.0 * next_[0] - beyond[0] if beyond else next_[0]
            start = start.copy()
            start[_HELD] = moduli[node]
            found[node] = _held(chain, features, prior, observed, noise, start, rest, near)
    nodes = [found[n] for n in range(_NODES)]
    return Valley(
        moduli,
        np.array([one[1] for one in nodes]),
        np.array([one[0] for one in nodes]),
        np.array([one[2][:4, :4] for one in nodes]),
    )


def _held(
    chain: Chain,
    features: Features,
    prior: Prior,
    observed: NDArray[np.floating],
    noise: tuple[Floats, bool],
    start: Floats,
    rest: NDArray[np.intp],
    near: Near,
) -> tuple[Floats, float, Floats]:
    """Most probable unknowns with the modulus held, log density there, and covariance of the others."""
    x = start
    precision = prior.precision[np.ix_(rest, rest)]
    for step in range(_STEPS + 1):
        x = inside(prior, x)
        seen, slopes = jacobian(chain, features, prior, x, near)
        away = observed - features(seen[None])[0]
        weighted = linalg.cho_solve(noise, slopes[rest].T)
        inverse = np.linalg.inv(slopes[rest] @ weighted + precision)
        off = (x - prior.middle)[rest]
        if step < _STEPS:
            x = x.copy()
            x[rest] += inverse @ (weighted.T @ away - precision @ off)
    cost = away @ linalg.cho_solve(noise, away) + off @ precision @ off
    # the ranges are flat; their normal stand-in only bounds what the pictures do not tell
    return x, float(-0.5 * cost + 0.5 * np.linalg.slogdet(inverse)[1]), inverse
