"""Whether light followed ray by ray answers to the modulus as the light that layouts are judged by.

The bound on E follows from how the pictures change with it. Here a press is lit twice by the reference
quality, with the contact as it is and as it is for a stiffer inclusion, along the same paths. The change is
weighed pixel by pixel as an estimator would weigh it that knows all else, w = J / noise² (the matched filter
of Kay 1993, section 4.3; [kay1993]): a number in standard deviations of the camera's noise, whose own noise
is told by independent repeats. Weighed as an estimator does that knows nothing else, most of the change
cancels, because size and depth change the pictures nearly alike, and the noise of the paths drowns the rest:
how many it would take is told, too.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.information import bound, pixel_information
from twin import coarse as pixels
from twin.bench import Bench, Work
from twin.complaint import DesignError
from twin.evaluate import Judged, Layout, evaluate, noises_of
from twin.forward import Unknown
from twin.layers import Lighting
from twin.touches import surface_of

if TYPE_CHECKING:
    from fem import Emulator
    from scenes.render import Quality

Floats = NDArray[np.float64]

UNKNOWN = "modulus_kPa"
PATHS = 2**17
"""Light paths per LED of one picture."""

_STIFFER = 0.5  # share of the modulus by which the inclusion is made stiffer, along the slope
_LEAST = 3  # repeats, for a spread


@dataclass(frozen=True)
class Answers:
    """How one layout's pictures change with the modulus, in sd of its camera's noise, per unit of it.

    Attributes
    ----------
    bound : on the modulus, of each inclusion, in its unit.
    judged : (inclusions,) of all else known, in the light that the layout was judged by.
    followed : (repeats, inclusions) the same by light followed ray by ray.
    judged_alone, followed_alone : the same of all else unknown.
    paths : light paths of all pictures.
    """

    bound: Floats
    judged: Floats
    followed: Floats
    judged_alone: Floats
    followed_alone: Floats
    paths: int

    @property
    def share(self) -> tuple[float, float]:
        """What is followed over what was judged, inclusions weighed by what was judged, and its sd."""
        each = self.followed @ self.judged / (self.judged @ self.judged)
        return float(each.mean()), float(each.std(ddof=1) / np.sqrt(len(each)))

    @property
    def strength(self) -> float:
        """Root mean square of what was judged."""
        return float(np.sqrt(np.mean(self.judged**2)))

    def paths_for(self, share: float) -> float:
        """Light paths until what is followed, all else unknown, is known to this share of what was judged."""
        each = self.followed_alone @ self.judged_alone / (self.judged_alone @ self.judged_alone)
        return float(self.paths / len(each) * np.var(each, ddof=1) / share**2)


@dataclass
class Follower:
    """One layout whose light is followed, repeat by repeat.

    Attributes
    ----------
    layout, balls, unknowns, emulator : as of `evaluate.evaluate`.
    fill : as of `evaluate.evaluate`; quality and seed likewise.
    follow : what followed light is: "reference"; the other qualities are for tests.
    paths : light paths per LED of one picture.
    bench : as of `evaluate.evaluate`.
    """

    layout: Layout
    balls: Sequence[fem.Inclusion]
    unknowns: Sequence[Unknown]
    emulator: Emulator | None = None
    fill: float | None = None
    quality: str = "preview"
    seed: int = 0
    follow: Quality = "reference"
    paths: int = PATHS
    bench: Bench = field(default_factory=Bench)
    _found: list[Floats] = field(default_factory=list)

    def __post_init__(self) -> None:
        if UNKNOWN not in {unknown.name for unknown in self.unknowns}:
            raise DesignError("unknowns", f"them without {UNKNOWN}", "the modulus among them")
        found = evaluate(
            self.layout,
            self.balls,
            self.unknowns,
            emulator=self.emulator,
            quality=self.quality,
            seed=self.seed,
            detection=False,
            fill=self.fill,
            bench=self.bench,
        )
        self._small = found.camera
        noises = noises_of(found.camera, found.block, self.layout.protocol)
        self._filters = [_filters(one, noises) for one in found.judged]
        self._bounds = np.array([bound(one.information, [UNKNOWN]).sd[0] for one in found.judged])
        seconds = {"mechanics": 0.0, "light": 0.0}
        work = Work(
            found.camera,
            found.unknowns,
            self.emulator,
            self.quality,
            self.seed,
            self.bench,
            seconds,
            self.balls[0],
        )
        relative = any(unknown.relative for unknown in found.unknowns if unknown.name == UNKNOWN)
        self._steps = [_STIFFER * (1.0 if relative else ball.modulus) for ball in self.balls]
        self._pairs = [self._pressed(work, *one) for one in zip(self.balls, self._steps, strict=True)]
        self._lighting = Lighting(found.camera)

    def _pressed(self, work: Work, ball: fem.Inclusion, step: float) -> list[tuple[Any, Any]]:
        """Contacts as they are and of a stiffer inclusion, of every press."""
        pairs = []
        for place in self.layout.protocol.positions_mm:
            for level in self.layout.protocol.indentation_mm:
                touch = work.touch(ball, level, place)
                stiffer = touch.fields + step * touch.slopes[UNKNOWN][0]
                pairs.append((surface_of(self._small, touch.fields), surface_of(self._small, stiffer)))
        return pairs

    def again(self, progress: Callable[[float], object] = lambda done: None) -> None:
        """Follow the light once more through all presses, on paths of their own."""
        spectral, seed = self._lighting.spectral, len(self._found)
        many = sum(len(pairs) for pairs in self._pairs)
        found, done = [], 0
        for number, pairs in enumerate(self._pairs):
            total = np.zeros(2)
            for press, shapes in enumerate(pairs):
                own = (seed * many + done) % 2**20
                before, after = (
                    self._counts(
                        spectral.render(shape, quality=self.follow, seed=own, samples=self.paths).radiance
                    )
                    for shape in shapes
                )
                total += np.array([np.sum(one[press] * (after - before)) for one in self._filters[number][0]])
                done += 1
                progress(done / many)
            found.append(total / self._steps[number])
        self._found.append(np.array(found))

    def _counts(self, radiance: Any) -> Floats:
        """Counts without the full well, which would cut off one side of the paths' noise."""
        layers = pixels.counted(self._small, radiance).layers
        return np.asarray(layers.sum(axis=0))

    @property
    def answers(self) -> Answers:
        """What was found so far; raises `ValueError` before there are repeats for a spread."""
        if len(self._found) < _LEAST:
            raise ValueError(f"repeats: received {len(self._found)}; allowed {_LEAST} or more")
        told = np.array([response for _, response in self._filters])
        found = np.array(self._found)
        presses = sum(len(pairs) for pairs in self._pairs)
        paths = len(found) * presses * 2 * self.paths * len(self.layout.design.leds)
        return Answers(self._bounds, told[:, 0], found[..., 0], told[:, 1], found[..., 1], paths)


def _filters(judged: Judged, noises: tuple[Any, Any]) -> tuple[Floats, Floats]:
    """Weights (2, presses, rows, columns[, 3]) of a change of the pictures, all else known and unknown, such
    that the camera's noise has sd 1; and what they make of a kPa in the light that judged (2,).

    References do not change with the inclusion, but weigh where nuisances are to be told from it.
    """
    weight = np.stack([pixel_information(mean, noises[k % 2]) for k, mean in enumerate(judged.mean)])
    slopes = judged.jacobian.reshape(len(judged.names), -1).astype(np.float64)
    weighed = slopes * weight.ravel()
    at = judged.names.index(UNKNOWN)
    told = judged.information
    alone = np.linalg.solve(told.fisher + told.prior, weighed)[at]
    filters, responses = [], []
    for one in (weighed[at], alone):
        spread = np.sqrt(np.sum(one**2 / np.where(weight.ravel() > 0, weight.ravel(), np.inf)))
        filters.append((one / spread).reshape(judged.mean.shape)[::2])
        responses.append(one @ slopes[at] / spread)
    return np.stack(filters), np.array(responses)


def compare(
    followers: Sequence[Follower], minutes: float, tell: Callable[[float], None] = lambda done: None
) -> list[Answers]:
    """Follow light through the layouts in turn until the time is up, at least three times through each."""
    began, turns = time.monotonic(), 0

    def spent(_: float = 0.0) -> float:
        share = (time.monotonic() - began) / (60.0 * minutes)
        tell(min(share, 1.0))
        return share

    while turns < _LEAST or spent() < 1.0:
        for one in followers:
            one.again(spent)
        turns += 1
    return [one.answers for one in followers]


def in_words(names: Sequence[str], answers: Sequence[Answers]) -> list[str]:
    """Return what was found, in lines; the first layout is what the others are compared with."""
    base, lines = answers[0], []
    before, before_sd = base.share
    for name, one in zip(names, answers, strict=True):
        share, sd = one.share
        lines.append(
            f"{name}: pictures followed ray by ray answer to E {share:.3f} ± {sd:.3f} times as judged"
        )
        if one is not base:
            judged = one.strength / base.strength
            ratio = judged * share / before
            spread = ratio * np.hypot(sd / share, before_sd / before)
            lines[-1] += f"; {judged:.2f} times as much as {names[0]}, followed {ratio:.2f} ± {spread:.2f}"
    need, spent = (max(one.paths_for(0.1) for one in answers), sum(one.paths for one in answers))
    lines.append(
        f"that is, all else known, from {spent:.2g} light paths; all else unknown, as the bound has it, "
        f"{need:.1g} would tell the answer to a tenth"
    )
    return lines


def record(names: Sequence[str], answers: Sequence[Answers]) -> str:
    """Return the same as JSON, with the lines."""
    layouts = [
        {
            "layout": name,
            "bound": one.bound.tolist(),
            "judged": one.judged.tolist(),
            "followed": one.followed.mean(axis=0).tolist(),
            "followed_sd": (one.followed.std(axis=0, ddof=1) / np.sqrt(len(one.followed))).tolist(),
            "share": one.share[0],
            "share_sd": one.share[1],
            "repeats": len(one.followed),
            "paths": one.paths,
            "paths_for_a_tenth_all_else_unknown": one.paths_for(0.1),
        }
        for name, one in zip(names, answers, strict=True)
    ]
    return json.dumps({"lines": in_words(names, answers), "layouts": layouts}, indent=1) + "\n"
