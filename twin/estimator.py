"""A trained estimator: from a sensor's pictures to the posterior of size, depth and modulus."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import fem
from estimation.features import Features
from estimation.posterior import MOST_FRAMES, REFERENCE_FRAMES, Posterior
from scenes.sensor import NotModelled
from scenes.traced import TracedLight
from twin import likeness
from twin.block_noise import mean_variance
from twin.bounding import limits, more_along_valley
from twin.chain import BLOCK, Chain, whole_blocks
from twin.discrepancy import Discrepancy
from twin.estimates import NAMES, Estimate
from twin.fitting import Fitted, Prior, fit, reachable
from twin.presence import presence
from twin.put_back import put_back, where
from twin.received import Received
from twin.refining import Refined, refine
from twin.rendered import rendered as render
from twin.retake import average

_LEFT_PERCENT = 0.05  # of misalignment, standard deviation, after pictures were put back

Single = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Sight:
    """What a fit looks at, and what that is off by.

    Attributes
    ----------
    features : of pictures.
    error : (k, k) second moments of what the chain's features are off by.
    discrepancy : what rendered ones are off by, too (`twin.calibrate`); nothing by default.
    """

    features: Features
    error: NDArray[np.float64]
    discrepancy: Discrepancy | None = None

    def without(self, pictures: Single) -> Single:
        """Return pictures (levels, 2, r, c) without what they are off by every time."""
        return pictures if self.discrepancy is None else self.discrepancy.without(pictures)

    def told(self, pictures: Single) -> Single:
        """Return features (k,) of pictures without that."""
        return np.asarray(self.features(self.without(pictures)[None])[0])

    def off(self, pictures: NDArray[np.floating]) -> NDArray[np.float64] | float:
        """Return second moments (k, k) of what features of pictures (levels, 2, ...) are off by when they are
        rendered."""
        return 0.0 if self.discrepancy is None else self.discrepancy.at(pictures)

    def only(self, blocks: NDArray[np.bool_]) -> Sight:
        """Return the same of some blocks (r, c) of each picture alone."""
        return replace(self, features=self.features.only(blocks))


@dataclass(frozen=True, eq=False)
class Estimator:
    """What a sensor's pictures tell, as it was trained; see `estimator_file.load_estimator`."""

    card: dict[str, Any]
    chain: Chain
    features: Features
    network: Posterior
    prior: Prior
    error: NDArray[np.float64]
    """(k, k) covariance of the features' errors of the chain."""
    novelty: Mapping[str, NDArray[Any]]
    """What `twin.likeness.learn` gave."""
    traced: tuple[TracedLight, ...] = ()
    """Learned light of each band, to render with; none where the corpus was traced press by press."""
    calibration: Sight | None = None
    """What `twin calibrate` gave; the network does not know of it."""

    @threadpool_limits.wrap(limits=1)  # small matrices: on a busy machine threads only wait for each other
    def estimate(
        self, received: Received, *, samples: int = 4000, seed: int = 0, rendered: bool = True
    ) -> Estimate:
        """Return what is known after the pictures; ``samples`` of the posterior are drawn from ``seed``.

        The network's answer is refined by rendering (`refining.refine`, half a minute) unless ``rendered`` is
        False, the pictures are refused or hold no inclusion, or what is rendered does not explain them, even
        if the camera stands a little off.
        """
        seen, frames = self.coarse(received), exposures(received)
        counts = seen + black(self.chain)
        like, strangest = likeness.likeness(self.novelty, counts[:, 0], counts[:, 1])
        told = self.features(seen[None])
        drawn = self.unscaled(self.network.sample(told, frames, samples, seed)[0])
        there = self.presence(seen, frames, drawn.mean(axis=0))
        reason = None
        if like < self.card["refuse_below"]:
            reason = f"pictures unlike this sensor's: {strangest}"
        refined = None
        if rendered and self.traced and reason is None and there >= 0.5:
            start = drawn.mean(axis=0)
            refined = self.refined(seen, frames, start, samples=samples, seed=seed)
            if refined is None or not refined.explains:
                again, back = self._put_back(received, frames, start, samples, seed)
                if again is not None:
                    refined, seen = again, back
        fitted = self.fitted(seen, frames, drawn.mean(axis=0)) if refined is None else refined.fitted
        method, answer = "network", drawn
        if refined is not None and refined.explains:
            method, answer = "rendered" if refined.renders else "fitted", refined.samples
        elif self.calibration is not None:
            method, answer = "unrendered", self.normal(fitted, samples, seed)
        wanted, seen = answer[:, : len(NAMES)], self.sight.without(seen)
        gain = np.array([self.chain.gain(self.prior.values(fitted.x[: len(self.prior.middle)]))])
        rounded = method == "rendered"
        variance = mean_variance(self.chain.design, seen[None], gain, frames, rounded=rounded)[0]
        return Estimate(
            NAMES,
            wanted,
            wanted.mean(axis=0),
            np.cov(wanted.T),
            np.percentile(wanted, [5.0, 95.0], axis=0).T,
            there,
            like,
            reason,
            np.asarray(seen[:, 0] - seen[:, 1], np.float64),
            np.asarray(fitted.pictures[:, 0] - fitted.pictures[:, 1], np.float64),
            np.sqrt(variance.sum(axis=1, dtype=np.float64)),
            method,
            fitted.chi_square / len(self.sight.features.spread),
        )

    def presence(self, seen: Single, frames: float, start: NDArray[np.floating]) -> float:
        """Return the probability of an inclusion, for coarse counts (levels, 2, r, c), by a fit from a start
        (5,); see `presence.presence`."""
        sight, fitted = self.sight, self.fitted(seen, frames, start)
        off = sight.error + sight.off(fitted.pictures)
        return presence(self.chain, sight.features, self.prior, sight.told(seen), frames, fitted, off)

    def normal(self, fitted: Fitted, samples: int, seed: int) -> NDArray[np.float64]:
        """Samples (n, 5) about the most probable specimen, within the prior's ranges. What the noise does not
        explain makes them wider."""
        rng = np.random.default_rng([seed, 13])
        low, high = self.prior.ranges.T
        wider = max(1.0, fitted.chi_square / len(self.sight.features.spread))
        drawn = rng.multivariate_normal(fitted.x[:5], wider * fitted.covariance[:5, :5], samples)
        return np.clip(drawn, low, high)

    @property
    def sight(self) -> Sight:
        """What fits look at."""
        return self.calibration or Sight(self.features, self.error)

    def refined(
        self,
        seen: Single,
        frames: float,
        start: NDArray[np.floating],
        *,
        samples: int = 4000,
        seed: int = 0,
        begin: Refined | None = None,
        threads: int | None = None,
        prior: Prior | None = None,
        blocks: NDArray[np.bool_] | None = None,
    ) -> Refined | None:
        """Return the posterior by rendering, of coarse counts (levels, 2, r, c) or some ``blocks`` (r, c) of
        them, from a start (5,); None where the learned light does not know the best fit."""
        prior = prior or self.prior
        sight = self.sight if blocks is None else self.sight.only(blocks)

        def pictures(values: Mapping[str, float], quick: bool = False) -> Single:
            values = reachable(self.chain, dict(values))
            return render(self.chain, self.traced, values, threads=threads, quick=quick, rounded=True)

        try:
            return refine(
                self.chain,
                sight.features,
                prior,
                sight.error,
                sight.told(seen),
                frames,
                np.concatenate([start, np.zeros(prior.basis.shape[1])]),
                pictures,
                quick=lambda values: pictures(values, quick=True),
                samples=samples,
                seed=seed,
                begin=begin,
                always=sight.off(seen if blocks is None else seen[..., blocks]),
            )
        except (fem.NotModelled, NotModelled):
            return None

    def _put_back(
        self, received: Received, frames: float, start: NDArray[np.floating], samples: int, seed: int
    ) -> tuple[Refined | None, Single]:
        """Return what `refined` does of pictures of a camera that stands a little off, and these pictures put
        back; blocks that it has not seen are those that are expected."""
        sight = self.sight
        error = sight.error + sight.off(self.coarse(received))
        parts = (self.chain, sight.features, error, lambda one: sight.without(self.coarse(one)))
        matrix = where(*parts, self.prior.of_another_camera(self._pattern), received, start)
        now, blocks = put_back(received, matrix)
        back, prior = self.coarse(now), self.prior.of_another_camera(self._pattern, _LEFT_PERCENT)
        found = self.refined(back, frames, start, samples=samples, seed=seed, prior=prior, blocks=blocks)
        return found, back if found is None else np.where(blocks, back, found.fitted.pictures)

    @property
    def _pattern(self) -> float:
        return 0.01 * likeness.PATTERN * self.chain.design.camera.prnu_percent

    def coarse(self, received: Received) -> Single:
        """Return coarse counts above black, (levels, 2, r, c)."""
        both = zip(received.images, received.references, strict=True)
        found = np.stack([np.stack([average(whole_blocks(one), BLOCK) for one in pair]) for pair in both])
        return np.asarray(found - black(self.chain) - self.chain.pattern_dn, np.float32)

    def unscaled(self, unit: NDArray[np.floating]) -> NDArray[np.float64]:
        """Parameters (..., 5) from 0 to 1."""
        low, high = self.prior.ranges.T
        return np.asarray(low + (high - low) * unit)

    def limits(
        self, values: Mapping[str, float], frames: float, more: NDArray[np.float64] | float = 0.0
    ) -> tuple[NDArray[np.float64], float]:
        """Return the bound and the deflection at true values; see `bounding.limits`."""
        sight = self.sight
        return limits(self.chain, sight.features, self.prior, values, frames, sight.off, more)

    def more_along_valley(
        self, values: Mapping[str, float], *, threads: int | None = None
    ) -> NDArray[np.float64]:
        """Return (k,) what the bound of rendered pictures wants; see `bounding.more_along_valley`.

        Raises `fem.NotModelled` and `scenes.sensor.NotModelled` where pictures cannot be rendered.
        """

        def pictures(at: Mapping[str, float]) -> Single:
            return render(
                self.chain, self.traced, reachable(self.chain, dict(at)), threads=threads, quick=True
            )

        return more_along_valley(self.chain, self.sight.features, self.prior, values, pictures)

    def fitted(self, seen: Single, frames: float, start: NDArray[np.floating]) -> Fitted:
        """Return the most probable specimen by the chain, for coarse counts (levels, 2, r, c), from a start
        (5,)."""
        x = np.concatenate([start, np.zeros(self.prior.basis.shape[1])])
        sight = self.sight
        error = sight.error + sight.off(seen)
        return fit(self.chain, sight.features, self.prior, sight.told(seen), frames, x, error)


def black(chain: Chain) -> float:
    """Counts of a pixel without light."""
    return chain.design.camera.offset_dn + chain.dark_dn / chain.design.camera.gain_e_per_dn


def exposures(received: Received) -> float:
    """Return the exposures that pictures count as, where references are the mean of few."""
    variance = 1.0 / received.frames
    if received.reference_frames < max(received.frames, REFERENCE_FRAMES):
        variance += 1.0 / received.reference_frames - 1.0 / max(received.frames, REFERENCE_FRAMES)
    return float(np.clip(1.0 / variance, 1.0, MOST_FRAMES))
