"""Whether layouts tell as much when their light is followed ray by ray as in the light that judged them.

The reference quality gives every picture's derivatives (`scenes.scored`); bounds follow of them as they do in
`evaluate`. Noise of the paths would pass for information. It does not where the pictures are first reduced
to as many numbers as there are unknowns, z = Jᵀ W y with the derivatives J and weights W of the light that
judged: what an estimator reads off them that was made in that light and calibrated in the followed one. What
is left of the paths' noise is taken off by multiplying different repeats only, and told by leaving out each
in turn (the jackknife: Efron & Stein 1981; [efron1981]). That is the least that the pictures tell. They tell
at most what they do along the one direction in which all unknowns together hide the wanted one best.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.information import pixel_information
from twin import touches
from twin.bench import Bench, Work
from twin.complaint import DesignError
from twin.evaluate import Evaluation, Judged, Layout, evaluate, judge, noises_of
from twin.forward import Unknown
from twin.layers import Lighting, Lit
from twin.objectives import BOUNDS

if TYPE_CHECKING:
    from fem import Emulator

Floats = NDArray[np.float64]

PATHS = 2**16
"""Light paths per LED of one picture in one repeat."""

_WALKS = 2  # paths of the light that is walked on moved surfaces, for one of those
_MOST_BYTES = 2**30  # of gathered light that is kept from repeat to repeat
_LEAST = 4  # repeats, for a spread
_WELL_E = 1e7  # no full well: it would cut off one side of the paths' noise


@dataclass(frozen=True)
class Range:
    """A bound in followed light lies between two; each with what the paths' noise leaves open (sd)."""

    low: float
    low_sd: float
    high: float
    high_sd: float


@dataclass(frozen=True)
class Followed:
    """Bounds of one layout in both lights.

    Attributes
    ----------
    names : of the wanted unknowns.
    judged : (inclusions, wanted) bounds in the light that judged.
    reduced : (repeats, inclusions, p, p) what z of each repeat answers to the unknowns, in units in which
        judged information and prior add up to the unit matrix.
    told : (inclusions, p, p) information of z in the light that judged, in these units.
    prior : (inclusions, p, p) in these units.
    rows : (inclusions, wanted, p) of the wanted ones in these units.
    hidden : (inclusions, wanted, repeats, repeats) products of the pictures' changes along the direction that
        hides a wanted one best.
    paths : light paths of all pictures.
    """

    names: tuple[str, ...]
    judged: Floats
    reduced: Floats
    told: Floats
    prior: Floats
    rows: Floats
    hidden: Floats
    paths: int

    def range_of(self, name: str) -> Range:
        """Root mean square over the inclusions of the bound on one of the wanted."""
        at, many = self.names.index(name), len(self.reduced)
        every = np.arange(many)
        found = []
        for bound in (self._low, self._high):
            without = np.array([bound(at, np.delete(every, k)) for k in every])
            spread = np.sqrt((many - 1) / many * np.sum((without - without.mean()) ** 2))
            found += [bound(at, every), float(spread)]
        return Range(*found)

    def judged_of(self, name: str) -> float:
        """The same in the light that judged."""
        return _rms(self.judged[:, self.names.index(name)])

    def _high(self, at: int, repeats: NDArray[np.int64]) -> float:
        many, bounds = len(repeats), []
        for number, (told, prior) in enumerate(zip(self.told, self.prior, strict=True)):
            each = self.reduced[repeats, number]
            whole = each.sum(axis=0)
            solved = np.linalg.pinv(told, 1e-12, hermitian=True)
            own = sum(one.T @ solved @ one for one in each)
            value, vector = np.linalg.eigh((whole.T @ solved @ whole - own) / (many * (many - 1)))
            information = (vector * np.maximum(value, 0.0)) @ vector.T  # noise may make it less than nothing
            row = self.rows[number, at]
            bounds.append(float(np.sqrt(row @ np.linalg.solve(information + prior, row))))
        return _rms(bounds)

    def _low(self, at: int, repeats: NDArray[np.int64]) -> float:
        many, bounds = len(repeats), []
        for number, prior in enumerate(self.prior):
            row = self.rows[number, at]
            products = self.hidden[number, at][np.ix_(repeats, repeats)]
            information = (products.sum() - np.trace(products)) / (many * (many - 1))
            direction = row / (row @ row)  # along it the wanted one moves by one
            bounds.append(float(max(information + direction @ prior @ direction, 1e-30) ** -0.5))
        return _rms(bounds)


@dataclass
class Follower:
    """One layout whose light is followed, repeat by repeat.

    Attributes
    ----------
    layout, balls, unknowns, emulator : as of `evaluate.evaluate`.
    fill : as of `evaluate.evaluate`; quality and seed likewise.
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
    paths: int = PATHS
    bench: Bench = field(default_factory=Bench)
    _found: list[list[tuple[Floats, Floats]]] = field(default_factory=list)
    _straight: dict[Any, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._told: Evaluation = evaluate(
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
        self._small = self._told.camera
        self._lighting = Lighting(self._small)
        self._names = tuple(name for name in BOUNDS.values() if name in self._told.judged[0].names)
        if not self._names:
            wanted = ", ".join(BOUNDS.values())
            raise DesignError("unknowns", f"none of {wanted}", "at least one of them")
        self._filters = [self._filter(one) for one in self._told.judged]
        unknowns, seconds = self._told.unknowns, {"mechanics": 0.0, "light": 0.0}
        self._work = work = Work(
            self._small, unknowns, self.emulator, self.quality, self.seed, self.bench, seconds, self.balls[0]
        )
        self._moving = work.moving
        protocol = self.layout.protocol
        self._presses = [
            (place, level) for place in protocol.positions_mm for level in protocol.indentation_mm
        ]
        self._shapes: dict[Any, tuple[Any, list[Any]]] = {}
        for number, ball in enumerate(self.balls):
            for place, level in self._presses:
                touch = work.touch(ball, level, place)
                self._shapes[number, place, level] = self._beside(touch, 0)
                if level not in self._shapes:
                    self._shapes[level] = self._beside(touch, 1)

    def _beside(self, touch: touches.Touch, plain: int) -> tuple[Any, list[Any]]:
        """A contact surface, and those beside it."""
        from scenes.scored import Slope  # only now: see scenes.backend

        shape = touches.surface_of(self._small, touch.plain if plain else touch.fields)
        slopes = [(touch.slopes[one.name][plain], touch.steps[one.name]) for one in self._moving]
        return shape, [Slope(np.moveaxis(slope[:3], 0, -1), slope[3], step) for slope, step in slopes]

    def _filter(self, judged: Judged) -> _Filter:
        noises = noises_of(self._small, self._told.block, self.layout.protocol)
        means = enumerate(judged.mean)
        weight = np.stack([pixel_information(mean, noises[k % 2]) for k, mean in means]).ravel()
        slopes = judged.jacobian.reshape(len(judged.names), -1).astype(np.float64)
        weight[~slopes.any(axis=0)] = 0.0  # full
        known = 1.0 / np.sqrt(np.diag(judged.information.prior))
        value, vector = np.linalg.eigh(known[:, None] * judged.information.fisher * known)
        even = known[:, None] * vector / np.sqrt(1.0 + np.maximum(value, 0.0))
        root = np.sqrt(weight)
        rows = even[[judged.names.index(name) for name in self._names]]
        return _Filter(even, root, (even.T @ slopes) * root, even.T @ judged.information.prior @ even, rows)

    def again(self, progress: Callable[[float], object] = lambda done: None) -> None:
        """Follow the light once more through all presses, on paths of their own."""
        number, many, lit = len(self._found), len(self._shapes), {}
        for done, press in enumerate(self._shapes):
            lit[press] = self._light(press, (number * many + done) % 2**20)
            progress((done + 1) / many)
        big = replace(self._small, camera=replace(self._small.camera, full_well_e=_WELL_E))
        names = tuple(one.name for one in self._moving)
        found = []
        for ball, (inclusion, filter_) in enumerate(zip(self.balls, self._filters, strict=True)):
            pictures = [(lit[ball, place, level], lit[level]) for place, level in self._presses]
            both = [
                Lit(np.stack([one[0], plain[0]]), np.stack([one[1], plain[1]], axis=1), names)
                for one, plain in pictures
            ]
            judged = judge(big, self._told.block, self.layout.protocol, inclusion, self._told.unknowns, both)
            slopes = judged.jacobian.reshape(len(judged.names), -1).astype(np.float64)
            answers = (filter_.even.T @ slopes) * filter_.root
            hides = filter_.rows / np.sum(filter_.rows**2, axis=1, keepdims=True)
            found.append((filter_.slopes @ answers.T, (hides @ answers).astype(np.float32)))
        self._found.append(found)

    def _light(self, press: Any, seed: int) -> tuple[Floats, Floats]:
        """A picture and its derivatives, all bands together."""
        from scenes.scored import moved, scored
        from scenes.tangent import gathered

        spectral, (shape, beside) = self._lighting.spectral, self._shapes[press]
        straight = self._straight.get(press)
        if straight is None:
            straight = [gathered(renderer, shape) for renderer in spectral.renderers]
            size = sum(one.light.nbytes + one.slopes.nbytes for one in straight)
            if (len(self._straight) + 1) * size < _MOST_BYTES:
                self._straight[press] = straight
        each = []
        for renderer, band, here in zip(spectral.renderers, spectral.bands, straight, strict=True):
            many = max(self.paths // band.parts, 2)
            picture, answers = scored(renderer, shape, beside, many, seed)
            answers += moved(renderer, shape, here, beside, _WALKS * many, seed)
            each.append((picture, answers))
        picture = spectral.together([one for one, _ in each])
        slopes = [spectral.together([of[k] for _, of in each]) for k in range(len(self._moving))]
        return picture, np.stack(slopes)

    @property
    def answers(self) -> Followed:
        """What was found so far; raises `ValueError` before there are repeats for a spread."""
        if len(self._found) < _LEAST:
            raise ValueError(f"repeats: received {len(self._found)}; allowed {_LEAST} or more")
        hidden = []
        for ball in range(len(self.balls)):
            changes = np.stack([repeat[ball][1] for repeat in self._found])
            hidden.append(np.einsum("awn,bwn->wab", changes, changes, optimize=True))
        filters = self._filters
        return Followed(
            self._names,
            np.array([[one.sd[name] for name in self._names] for one in self._told.judged]),
            np.array([[reduced for reduced, _ in repeat] for repeat in self._found]),
            np.array([one.slopes @ one.slopes.T for one in filters]),
            np.array([one.prior for one in filters]),
            np.array([one.rows for one in filters]),
            np.array(hidden, np.float64),
            len(self._found) * len(self._shapes) * self.paths * len(self.layout.design.leds),
        )


@dataclass(frozen=True)
class _Filter:
    """How pictures of one inclusion are reduced.

    Attributes
    ----------
    even : (p, p) unknowns from numbers in which judged information and prior add up to the unit matrix.
    root : (pixels,) square root of what each pixel tells.
    slopes : (p, pixels) judged slopes to these numbers, times `root`.
    prior : (p, p) of these numbers.
    rows : (wanted, p) of `even`.
    """

    even: Floats
    root: Floats
    slopes: Floats
    prior: Floats
    rows: Floats


def compare(
    followers: Sequence[Follower], minutes: float, tell: Callable[[float], None] = lambda done: None
) -> list[Followed]:
    """Follow light through the layouts until the time is up, at least four times through each; the time is
    shared out evenly, however many presses a layout takes."""
    began = time.monotonic()
    turns, taken = [0] * len(followers), [0.0] * len(followers)

    def spent(_: float = 0.0) -> float:
        share = (time.monotonic() - began) / (60.0 * minutes)
        tell(min(share, 1.0))
        return share

    while min(turns) < _LEAST or spent() < 1.0:
        few = [number for number, done in enumerate(turns) if done < _LEAST] if spent() >= 1.0 else []
        number = min(few or range(len(followers)), key=lambda k: taken[k])
        start = time.monotonic()
        followers[number].again(spent)
        turns[number] += 1
        taken[number] += time.monotonic() - start
    return [one.answers for one in followers]


_UNITS = {"size_mm": ("size", "mm"), "depth_mm": ("depth", "mm"), "modulus_kPa": ("E", "kPa")}


def in_words(names: Sequence[str], found: Sequence[Followed]) -> list[str]:
    """Return what was found, in lines; the first layout is what the others are compared with."""
    base, lines = found[0], []
    for name, one in zip(names, found, strict=True):
        parts = []
        for unknown in one.names:
            label, unit = _UNITS[unknown]
            spread = one.range_of(unknown)
            ends = f"{spread.low:.3g} ± {spread.low_sd:.1g} to {spread.high:.3g} ± {spread.high_sd:.1g}"
            parts.append(f"{label} {ends} {unit} (judged {one.judged_of(unknown):.3g})")
        lines.append(
            f"{name}: bounds in light followed ray by ray, rms over the inclusions: {'; '.join(parts)}"
        )
        if one is not base:
            gains = []
            for unknown in one.names:
                first, second = base.range_of(unknown), one.range_of(unknown)
                least = first.low / second.high
                sd = least * np.hypot(first.low_sd / first.low, second.high_sd / second.high)
                judged = base.judged_of(unknown) / one.judged_of(unknown)
                gains.append(
                    f"{_UNITS[unknown][0]} at least {least:.2f} ± {sd:.2f} times (judged {judged:.2f})"
                )
            lines.append(f"{name} tells more than {names[0]}: {', '.join(gains)}")
    lines.append(
        f"from {sum(one.paths for one in found):.2g} light paths; to the right of each: the bound that an "
        "estimator made in judged light reaches once it is calibrated in the followed one"
    )
    return lines


def record(names: Sequence[str], found: Sequence[Followed]) -> str:
    """Return the same as JSON, with the lines."""
    layouts = []
    for name, one in zip(names, found, strict=True):
        bounds = {}
        for unknown in one.names:
            spread = one.range_of(unknown)
            bounds[unknown] = {"judged": one.judged_of(unknown), **vars(spread)}
        layouts.append({"layout": name, "bounds": bounds, "repeats": len(one.reduced), "paths": one.paths})
    return json.dumps({"lines": in_words(names, found), "layouts": layouts}, indent=1) + "\n"


def _rms(values: Floats | Sequence[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
