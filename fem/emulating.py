"""Build an emulator: solve what the plan asks for, fit, and leave samples out to see how far it is off."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fem.emulator import CENTRED, Emulator, amplitudes, features, lagrange, resample
from fem.emulator_errors import Errors, off_the_edge
from fem.regression import Regression, regress
from fem.sampling import NotBuilt, Plan, contrast
from fem.solver import one_thread
from fem.solving import KNOTS, Progress, knots, run, solved, tally
from fem.specimen import geometry_at
from fem.surface import line_weights
from fem.symmetry import unfold
from fem.topology import Resolution

Floats = NDArray[np.float64]

Pair = tuple[Regression, Regression]
Known = tuple[tuple[Floats, Floats], ...]  # lengths and noise of both regressions

_FOLDS = 10
_FEWEST = {"sample": 30, "pair": 12, "stretch": 10, "stretched_pair": 12}  # that a fit makes sense with
_NAMES = {
    "sample": "samples",
    "pair": "pairs of meshes",
    "stretch": "samples at finite strain",
    "stretched_pair": "pairs of meshes at finite strain",
}
_LEAST = 12  # samples at finite strain that the learning curve begins with
_HELD = 3  # one in so many of the tissues is what the learning curve is measured on, with both offsets
_IMAGES = 0.5  # how far beyond the symmetry planes images of the samples are learned, in largest offsets


def build_emulator(
    plan: Plan,
    folder: str | Path,
    *,
    samples: int | None = None,
    minutes: float | None = None,
    workers: int | None = None,
    progress: Progress | None = None,
) -> Emulator:
    """Solve the plan's samples into a folder, and fit; solves that the folder already holds are not repeated.

    Parameters
    ----------
    samples, minutes
        When to stop solving: at so many samples, or after so long; give one or both.
    workers
        Processes; all cores by default.
    progress
        Called as progress(stage, fraction done).

    Raises
    ------
    NotBuilt
        If the folder holds the samples of another plan, or too few samples were solved, in one line.
    """
    tell = progress or (lambda stage, fraction: None)
    if samples is None and minutes is None:
        raise NotBuilt("samples, minutes: received neither; allowed is one of them or both")
    for name, value in (("samples", samples), ("minutes", minutes), ("workers", workers)):
        if value is not None and not value > 0:
            raise NotBuilt(f"{name}: received {value}; allowed are positive numbers")
    fewest = _FEWEST["sample"]
    if samples is not None and samples < fewest:
        raise NotBuilt(f"samples: received {samples}; allowed {fewest} and more")
    plan.point(fewest - 1)  # refuses ranges that hold nothing before anything is solved
    seconds = None if minutes is None else 60 * minutes
    run(plan, Path(folder), samples, seconds, workers or os.cpu_count() or 1, tell)
    tell("fit", 0.0)
    return fit(plan, folder, samples)


@dataclass(frozen=True)
class _Background:
    x: Floats
    pressure: Floats
    moved: Floats

    def unit(self, plan: Plan, point: Floats) -> Floats:
        """Pressure on plain tissue at small strain and the other levels, (levels, m, m), per mm and kPa of
        the tissue."""
        at = knots(plan)
        weights = np.multiply.outer(lagrange(at[0], 1 / point[4]), lagrange(at[1], float(np.log(point[5]))))
        return np.asarray(np.tensordot(weights, self.pressure, 2))


@dataclass(frozen=True)
class _Samples:
    """Finished solves of one kind: their numbers, points (n, 7), inputs, and fields over their amplitude (n,
    cases, k, k) and (n, cases, k, k, 3) on a mesh; cases are moduli, or levels of finite strain."""

    plan: Plan
    res: Resolution
    number: NDArray[np.int64]
    points: Floats
    inputs: Floats
    rise: Floats
    tared: Floats
    seconds: Floats

    def part(self, which: NDArray[np.bool_]) -> _Samples:
        rest = ("number", "points", "inputs", "rise", "tared", "seconds")
        return _Samples(self.plan, self.res, *(getattr(self, name)[which] for name in rest))

    @property
    def typical(self) -> NDArray[np.bool_]:
        """Which of them lie within the ranges, off both planes of symmetry, as what is asked for will."""
        return np.asarray(self.plan.inside(self.points) & (self.points[:, 3] > 0))

    def on_grid(self, i: int, kind: str, fields: Floats, x: Floats) -> Floats:
        """Pressure's rise, or displacement along z, of one sample on the answers' grid, (cases, m, m), times
        its amplitude but s."""
        onto = resample(geometry_at(self.plan, self.points[i], 100.0), self.res, x)
        scale = amplitudes(self.points[i], 1.0)[kind == "tared"]
        up = fields[..., 2] if kind == "tared" else fields
        return np.asarray(scale * (onto[0] @ up @ onto[1].T))


@dataclass(frozen=True)
class _Known:
    """All that a fit is made from; `more` is what finite strain adds, `pairs` and `pairs_more` what a finer
    mesh adds to either."""

    samples: _Samples
    pairs: _Samples
    more: _Samples | None
    pairs_more: _Samples | None
    base: _Background

    def without(self, held: Callable[[NDArray[np.int64]], NDArray[np.bool_]]) -> _Known:
        """Leave out the samples whose numbers are held."""
        more = None if self.more is None else self.more.part(~held(self.more.number))
        return replace(self, samples=self.samples.part(~held(self.samples.number)), more=more)

    @property
    def last(self) -> _Samples:
        """The samples that the answers' error is measured on."""
        return self.samples if self.more is None else self.more


@dataclass(frozen=True)
class _Fits:
    """Regressions of each kind of samples: rise, tared displacement."""

    samples: Pair
    more: Pair | None

    @property
    def lengths(self) -> tuple[Known, Known | None]:
        def of(pair: Pair) -> Known:
            return tuple((f.lengths, f.noise) for f in pair)

        return of(self.samples), None if self.more is None else of(self.more)


def fit(plan: Plan, folder: str | Path, samples: int | None = None) -> Emulator:
    """Fit the first `samples` solves of a folder (all by default), and cross-validate.

    Raises
    ------
    NotBuilt
        If there are too few.
    """
    place = Path(folder)
    kinds = [("sample", samples), ("pair", None)]
    if plan.finite:
        kinds.append(("stretch", samples))
        kinds.append(("stretched_pair", None))
    read = [_read(plan, place, *kind) for kind in kinds]
    more, pairs_more = read[2:] if plan.finite else (None, None)
    known = _Known(read[0], read[1], more, pairs_more, _read_background(place))
    solves = np.zeros((4, 2))
    solves[: len(kinds)] = [tally(place, *kind) for kind in kinds]
    with one_thread():
        fits = _fit(known, None)
        gains = [_gain(pairs) for pairs in (known.pairs, known.pairs_more) if pairs is not None]
        errors = _cross_validated(known, fits, gains, solves)
    base, (rise, tared), (finer, finer_tared) = known.base, fits.samples, gains[0]
    parts = plan, base.x, base.pressure, base.moved, rise, tared, finer, finer_tared
    if fits.more is None:
        return Emulator(*parts, None, None, None, None, errors)
    (rise_more, tared_more), (finer_more, finer_tared_more) = fits.more, gains[1]
    return Emulator(*parts, rise_more, tared_more, finer_more, finer_tared_more, errors)


def _gain(pairs: _Samples, known: Pair | None = None) -> Pair:
    """What a finer mesh adds to rise and tared displacement; with lengths and noise of other regressions, or
    None to find them."""
    inputs = pairs.inputs[:, [k for k in CENTRED if k < pairs.inputs.shape[1]]]
    first, second = (None, None) if known is None else ((one.lengths, one.noise) for one in known)
    return regress(inputs, _flat(pairs.rise), first), regress(inputs, _flat(pairs.tared), second)


def _cross_validated(known: _Known, fits: _Fits, gains: list[Pair], solves: Floats) -> Errors:
    """Errors of samples that are left out, some at a time, from fits with the same lengths."""
    last, found = known.last, np.empty((len(known.last.points), 6))
    for k in range(_FOLDS):

        def held(number: NDArray[np.int64], k: int = k) -> NDArray[np.bool_]:
            return np.asarray(number // known.samples.plan.shared % _FOLDS == k)  # with all of its tissue

        fold = held(last.number)
        found[fold] = _errors(known, _fit(known.without(held), fits.lengths), last.number[fold])
    inside = last.typical & np.isfinite(found).all(axis=1)
    finer = _finer_errors(known, fits, known.pairs, gains[0])
    more = np.empty((0, 6))
    if known.pairs_more is not None:
        more = _finer_errors(known, fits, known.pairs_more, gains[1])
    fields = found[inside, :3], found[inside, 3:], finer, more
    return Errors(last.points[inside, 0], *fields, _curve(known), solves)


def _finer_errors(known: _Known, fits: _Fits, pairs: _Samples, gains: Pair) -> Floats:
    """Errors (n, 6) of what a finer mesh adds, of each pair left out, over the tared pressure at small
    strain, then over the tared displacement, as `_missed`."""
    plan, x, found = known.samples.plan, known.base.x, np.empty((len(pairs.points), 6))
    lean = replace(pairs, res=plan.resolution)
    for i in range(len(pairs.points)):
        fold = np.arange(len(pairs.points)) == i
        guesses = _gain(pairs.part(~fold), gains)
        inputs = features(plan, pairs.points[i : i + 1])[:, :-1]
        unit = known.base.unit(plan, pairs.points[i])
        unit = unit[1:] if pairs is known.pairs_more else unit[:1]
        for k, kind in enumerate(("rise", "tared")):
            added = getattr(pairs, kind)[i]
            guess = guesses[k](gains[k].inputs[i : i + 1]).reshape(added.shape)
            whole = fits.samples[k](inputs).reshape(-1, *getattr(known.samples, kind).shape[2:])
            if pairs is known.pairs_more:
                along = lagrange(contrast(plan.ratios), float(pairs.points[i, 6]))
                whole = np.tensordot(along, whole, 1)[None]
            scale = unit if kind == "rise" else 1.0
            miss, true = pairs.on_grid(i, kind, guess - added, x), lean.on_grid(i, kind, whole, x)
            found[i, 3 * k : 3 * k + 3] = _missed(miss * scale, true * scale, x)
    return found


def _read(plan: Plan, folder: Path, kind: str, first: int | None) -> _Samples:
    """Finished solves of a kind, their fields over the amplitudes."""
    found = list(solved(folder, kind, first))
    if len(found) < _FEWEST[kind]:
        what = f"{len(found)} {_NAMES[kind]} that were solved"
        raise NotBuilt(f"samples: received {what}; allowed {_FEWEST[kind]} and more")
    points = np.stack([f["point"] for f in found])
    finite, paired = kind.startswith("stretch"), kind.endswith("pair")
    if paired:
        points[:, 2:4] = 0.0
    s = points[:, 6:] if finite else contrast(plan.ratios)
    scales = amplitudes(points[:, None], s)  # each (n, cases or 1)
    rise = np.stack([f["rise"] for f in found]) / scales[0][..., None, None]
    tared = np.stack([f["moved"] for f in found]) / scales[1][..., None, None, None]
    seconds = np.array([float(f["seconds"]) for f in found])
    number = np.array([int(f["number"]) for f in found])
    inputs = features(plan, points)
    if not finite:
        inputs = inputs[:, :-1]
    res = plan.fine if paired else plan.coarse if finite else plan.resolution
    return _Samples(plan, res, number, points, inputs, rise, tared, seconds)


def _read_background(folder: Path) -> _Background:
    found = list(solved(folder, "background"))
    if len(found) < KNOTS[0] * KNOTS[1]:
        raise NotBuilt(
            f"folder: received {folder}, which lacks the background; "
            "allowed is one that `build_emulator` filled"
        )
    shaped = [
        np.stack([f[name] for f in found]).reshape(*KNOTS, *found[0][name].shape)
        for name in ("pressure", "moved")
    ]
    return _Background(found[0]["x"], *shaped)


def _flat(fields: Floats) -> Floats:
    return fields.reshape(len(fields), -1)


def _fit(known: _Known, lengths: tuple[Known, Known | None] | None) -> _Fits:
    """Regressions of all kinds; lengths and noise of each, or None to find them."""
    first, more = lengths or (None, None)
    return _Fits(_fit_kind(known.samples, first), None if known.more is None else _fit_kind(known.more, more))


def _fit_kind(known: _Samples, lengths: Known | None) -> Pair:
    """Regressions of the rise and of the tared displacement."""
    inputs, rise, tared = _with_images(known)
    first, second = lengths or (None, None)
    own = len(known.number)
    return regress(inputs, rise, first, own), regress(inputs, tared, second, own)


def _with_images(known: _Samples) -> tuple[Floats, Floats, Floats]:
    """Inputs and flat fields of the samples, and of their images just beyond the planes of symmetry."""
    plan, columns = known.plan, known.inputs.shape[1]
    margin = _IMAGES * plan.ranges.offset_mm
    found = [(known.inputs, _flat(known.rise), _flat(known.tared))]
    seen = [known.points[:, 2:4]]
    for turned, right, up in list(product((False, True), (1, -1), (1, -1)))[1:]:
        points = known.points.copy()
        points[:, 2:4] = known.points[:, (3, 2) if turned else (2, 3)] * (right, up)
        x, y = points[:, 2], points[:, 3]
        near = (x > -margin) & (y > -margin) & (y < x + margin)
        for other in seen:  # one under the middle or beside it along x is its own image
            near &= np.abs(points[:, 2:4] - other).max(axis=1) > 1e-9
        seen.append(points[:, 2:4])
        if not near.any():
            continue
        offset = (right, 2 * up) if turned else (2 * right, up)  # any that unfolds like this image
        rise, tared = unfold(known.rise[near], known.tared[near], offset)
        found.append((features(plan, points[near])[:, :columns], _flat(rise), _flat(tared)))
    inputs, rises, tareds = (np.vstack(part) for part in zip(*found, strict=True))
    return inputs, rises, tareds


def _errors(known: _Known, fits: _Fits, numbers: NDArray[np.int64]) -> Floats:
    """Errors (n, 6) of the answers for samples of these numbers: tared pressure, then tared displacement into
    the probe, as `_missed`; NaN where the same specimen failed at small strain."""
    base, samples, more, plan = known.base, known.samples, known.more, known.samples.plan
    out = np.full((len(numbers), 6), np.nan)
    for row, number in enumerate(numbers):
        at = np.flatnonzero(samples.number == number)
        if not len(at):
            continue
        i = int(at[0])
        unit = base.unit(plan, samples.points[i])[1 if plan.finite else 0 :]
        for k, kind in enumerate(("rise", "tared")):
            true = getattr(samples, kind)[i]
            guess = fits.samples[k](samples.inputs[i : i + 1]).reshape(true.shape)
            if (
                more is not None and fits.more is not None
            ):  # the one modulus that finite strain was solved for
                along = lagrange(contrast(plan.ratios), float(samples.points[i, 6]))
                true, guess = (np.tensordot(along, f, 1)[None] for f in (true, guess))
            fields = [samples.on_grid(i, kind, f, base.x) for f in (guess - true, true)]
            if more is not None and fits.more is not None:
                j = int(np.flatnonzero(more.number == number)[0])
                true = getattr(more, kind)[j]
                guess = fits.more[k](more.inputs[j : j + 1]).reshape(true.shape)
                added = (more.on_grid(j, kind, f, base.x) for f in (guess - true, true))
                fields = [f + a for f, a in zip(fields, added, strict=True)]
            miss, true = (f * (unit if kind == "rise" else 1.0) for f in fields)
            out[row, 3 * k : 3 * k + 3] = _missed(miss, true, base.x)
    return out


def _missed(miss: Floats, true: Floats, x: Floats) -> tuple[float, float, float]:
    """Largest error off the probe's edge, root mean square over the area, and largest error with the edge,
    the worst of all cases, per cent of the true field's maximum off it; fields (cases, m, m) on lines x."""
    area = np.outer(line_weights(x), line_weights(x)) / (x[-1] - x[0]) ** 2
    inner, size = off_the_edge(x), np.abs(miss)
    mean = np.sqrt((miss**2 * area).sum(axis=(1, 2)))
    top = np.abs(true)[:, inner].max(axis=1)
    parts = (size[:, inner].max(axis=1), mean, size.max(axis=(1, 2)))
    return tuple(float(100 * (part / top).max()) for part in parts)  # type: ignore[return-value]


def _curve(known: _Known) -> Floats:
    """Learning curve, as `Errors.curve`."""
    last = known.last
    tissues = last.number // last.plan.shared
    some = np.unique(tissues[last.points[:, 3] > 0])[_HELD - 1 :: _HELD]
    test = last.number[last.typical & (last.points[:, 0] >= 4.0) & np.isin(tissues, some)]
    kept = known.without(lambda number: np.isin(number // last.plan.shared, some))
    rows = []
    for share in (0.125, 0.25, 0.5, 1.0):
        parts = [
            None if kind is None else kind.part(np.arange(len(kind.number)) < round(share * len(kind.number)))
            for kind in (kept.samples, kept.more)
        ]
        solves = [0 if part is None else len(part.number) for part in parts]
        if solves[0] < _FEWEST["sample"] or (known.more is not None and solves[1] < _LEAST) or not len(test):
            continue
        assert parts[0] is not None
        fewer = replace(kept, samples=parts[0], more=parts[1])
        found = _errors(known, _fit(fewer, None), test)
        found = found[np.isfinite(found).all(axis=1)]
        spent = sum(float(part.seconds.sum()) for part in parts if part is not None)
        rows.append([*solves, spent, *(np.percentile(found[:, k], p) for k in (0, 1, 2) for p in (50, 95))])
    return np.array(rows).reshape(-1, 9)
