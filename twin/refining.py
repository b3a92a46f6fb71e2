"""The posterior with the light transport in it: what the network finds, corrected by rendering.

The network and the chain know the light only by a light map, whose errors are as large as the noise of one
exposure. So the most probable specimen is rendered, what the map is off there is taken out of the pictures,
and the fit goes on; where it ends, the map's own error no longer matters to first order. Where that error is
so far below the noise that it does not widen the posterior, nothing is rendered. What remains unknown
lies along a narrow, bent valley (`twin.valley`): a stiffer inclusion that is a little smaller looks nearly
the same.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from estimation.features import Features
from twin.chain import Chain
from twin.fitting import ALIGNMENT, Fitted, Near, Prior, covariance, expected, fit, jacobian, placed
from twin.study import PARAMETERS
from twin.valley import NEAR, STILL, flat, valley

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

_RENDERS = 5
_FIRST = 0.3  # standard deviations that a fit may move after the first rendering, without another
_ALIKE = 0.1  # counts rms, that references are apart whose difference from the map's is the same
_FAR = 3.0  # standard deviations that a fit moves from what was rendered whole, to be rendered so again
_SHORT = 1e-3  # of the prior's spread: a way that tells nothing of how the error changes
_REMAINS = 0.01  # of the map's error after its correction nearby (see `tests/test_refining.py`)
_AS_WELL = 1.05  # times wider by the map's error a posterior may be without any rendering
_STRANGE = 1e-4  # chance of a misfit, below which the noise is taken to be louder than told
_LOUDEST = 10.0  # times its variance that are believed


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
    off : by how much rendered pictures are above the chain's; None where none was.
    """

    samples: Floats
    fitted: Fitted
    near: Near
    explains: bool
    renders: int
    off: Off | None


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
    render : expected pictures (levels, 2, r, c) of a specimen's values, by light transport, with what
        rounding does to blocks (`twin.block_noise.rounding`).
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
            still = flat(found.x, np.zeros_like(found.pictures))
            return Refined(followed.draw(prior, samples, seed), found, still, True, 0, None)
    known = None if begin is None else begin.off
    off = known or Off(chain, prior, found.x, render, quick)
    here = off.look(found)
    remains = _REMAINS**2 * _as_here(features, error, found.pictures, here) * error + always
    for renders in range(1, _RENDERS + 1):
        at = found.x
        here = here if renders == 1 else off.look(found)
        near = _corrected(near, at, here, prior)
        found = fit(chain, features, prior, observed, frames, at, remains, near)
        moved = float((np.abs(found.x - at) / np.sqrt(np.diag(found.covariance)))[:5].max())
        enough = NEAR if len(near.slopes) else _FIRST
        if moved < STILL or (moved < enough and not _strange(found, features)):
            break
    assert near is not None
    louder = found.chi_square / len(features.spread) if _strange(found, features) else 1.0

    remains = remains + (louder - 1.0) * always  # told by few pictures, it may be too small itself
    followed, more = valley(chain, features, prior, observed, frames, found, remains, off, louder)
    drawn, explains = followed.draw(prior, samples, seed), bool(louder < _LOUDEST)
    return Refined(drawn, found, near, explains, renders + more, off)


class Off:
    """By how much rendered pictures are above the chain's at unknowns (5 + q,).

    Quickly, from what was rendered whole at one specimen, as long as the references are about as they are
    there: along the valley only the inclusion changes, which they do not show. What else changes a little is
    left as it was: it moves picture and reference alike, and their difference would pass for an inclusion's.
    """

    def __init__(
        self,
        chain: Chain,
        prior: Prior,
        at: Floats,
        render: Callable[[Mapping[str, float]], Single],
        quick: Callable[[Mapping[str, float]], Single] | None,
    ) -> None:
        self._chain, self._prior, self._render = chain, prior, render
        self._quick = None if any(name in prior.names for name in ALIGNMENT) else quick
        self.whole(at)

    def whole(self, x: Floats) -> Single:
        """Render a specimen whole, from which others are told quickly."""
        values = self._prior.values(x)
        self._at, self._plain = x, expected(self._chain, self._prior, [x])[0]
        seen = placed(self._render(values)[None], [values])[0]
        self._first = np.asarray(seen - self._plain, np.float32)
        self._begins: Single | None = None
        return self._first

    def look(self, found: Fitted) -> Single:
        """The same where a fit ends; rendered whole where quick pictures from the last would be worse than
        the noise: means of exposures are found far, by their measure, from where the map or one of them led.
        """
        away = np.abs(found.x - self._at) / np.sqrt(np.diag(found.covariance))
        return self.whole(found.x) if away[: len(PARAMETERS)].max() > _FAR else self(found.x)

    def __call__(self, x: Floats) -> Single:
        if np.array_equal(x, self._at):
            return self._first
        seen = expected(self._chain, self._prior, [x])[0]
        if self._quick is None or np.sqrt(np.mean((seen - self._plain)[:, 1] ** 2)) > _ALIKE:
            return self.whole(x)
        if self._begins is None:
            self._begins = (self._first + self._plain)[:, :1] - self._quick(self._prior.values(self._at))
        alone = np.concatenate([x[: len(PARAMETERS)], self._at[len(PARAMETERS) :]])
        plain = expected(self._chain, self._prior, [alone])[0][:, :1]
        pressed = self._begins + self._quick(self._prior.values(alone)) - plain
        return np.concatenate([pressed, self._first[:, 1:]], axis=1)


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
        return flat(at, off)
    way, metric = at - near.at, np.diag(prior.precision)
    length = float(way @ (metric * way))
    moved = replace(near, at=at, off=off)
    if length < _SHORT**2:
        return moved
    return moved.more(metric * way / length, np.asarray(off - near.of([at])[0], np.float32))


def _strange(found: Fitted, features: Features) -> bool:
    """Whether noise as it is known does not explain what is left."""
    return bool(stats.chi2.sf(found.chi_square, len(features.spread)) < _STRANGE)
