"""Build an emulator: solve what the plan asks for, fit, and leave samples out to see how far it is off."""

from __future__ import annotations

import os
from dataclasses import dataclass
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fem.emulator import CENTRED, Emulator, Errors, amplitudes, features, lagrange, resample, unfold
from fem.regression import Regression, regress
from fem.sampling import Plan, contrast, geometry_at
from fem.solver import one_thread
from fem.solving import KNOTS, NotBuilt, Progress, knots, run, solved
from fem.surface import line_weights

Floats = NDArray[np.float64]

Pair = tuple[Regression, Regression]
Known = tuple[tuple[Floats, Floats], ...]  # lengths and noise of both regressions

_FOLDS = 10
_FEWEST = {"sample": 30, "pair": 12}  # that a fit makes sense with
_HELD = 0.2  # share of the samples that the learning curve is measured on
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
    seconds = None if minutes is None else 60 * minutes
    run(plan, Path(folder), samples, seconds, workers or os.cpu_count() or 1, tell)
    tell("fit", 0.0)
    return fit(plan, folder, samples)


@dataclass(frozen=True)
class _Background:
    x: Floats
    unit: Floats
    pressure: Floats
    moved: Floats


@dataclass(frozen=True)
class _Samples:
    """Finished samples: points (n, 6), inputs, and fields (n, values) over their amplitude."""

    plan: Plan
    points: Floats
    inputs: Floats
    rise: Floats
    tared: Floats
    seconds: Floats

    def part(self, which: NDArray[np.bool_]) -> _Samples:
        found = (getattr(self, k)[which] for k in ("points", "inputs", "rise", "tared", "seconds"))
        return _Samples(self.plan, *found)


def fit(plan: Plan, folder: str | Path, samples: int | None = None) -> Emulator:
    """Fit the first `samples` solves of a folder (all by default), and cross-validate.

    Raises
    ------
    NotBuilt
        If there are too few.
    """
    known = _read(plan, Path(folder), "sample", samples)
    pairs = _read(plan, Path(folder), "pair", None)
    base = _read_background(plan, Path(folder))
    with one_thread():
        fitted = _fit(known, None)
        finer = regress(pairs.inputs[:, CENTRED], pairs.rise)
        errors = _cross_validated(known, fitted, pairs, finer, base)
    return Emulator(plan, base.x, base.unit, base.pressure, base.moved, *fitted, finer, errors)


def _cross_validated(
    known: _Samples, fitted: Pair, pairs: _Samples, finer: Regression, base: _Background
) -> Errors:
    """Errors of samples that are left out, some at a time, from fits with the same lengths."""
    lengths = tuple((f.lengths, f.noise) for f in fitted)
    found, gain = np.empty((len(known.points), 4)), np.empty((len(pairs.points), 2))
    for k in range(_FOLDS):
        held = np.arange(len(found)) % _FOLDS == k
        found[held] = _errors(known.part(held), _fit(known.part(~held), lengths), base)
        held = np.arange(len(gain)) % _FOLDS == k
        rest = pairs.part(~held)
        again = regress(rest.inputs[:, CENTRED], rest.rise, (finer.lengths, finer.noise))
        out = pairs.part(held)
        guess = again(out.inputs[:, CENTRED])
        gain[held] = _missed(out, "rise", out.rise, guess, base, fitted[0](out.inputs))
    inside = known.plan.inside(known.points)
    sizes, found = known.points[inside, 0], found[inside]
    return Errors(sizes, found[:, :2], found[:, 2:], gain, _curve(known, base))


def _read(plan: Plan, folder: Path, kind: str, first: int | None) -> _Samples:
    """Finished solves of a kind, "sample" or "pair" (fine minus lean mesh), their fields over the
    amplitudes."""
    found = list(solved(folder, kind, first))
    if len(found) < _FEWEST[kind]:
        raise NotBuilt(
            f"samples: received {len(found)} {kind}s that were solved; allowed {_FEWEST[kind]} and more"
        )
    points = np.stack([f["point"] for f in found])
    if kind == "pair":
        points[:, 2:4] = 0.0
    scales = amplitudes(points[:, None], contrast(plan.ratios))  # each (n, moduli)
    none = np.zeros((1, len(plan.ratios), 0))  # pairs have no displacements
    fields = [np.stack([f.get(name, none) for f in found]) for name in ("rise", "moved")]
    rise, tared = (
        f / s.reshape(len(f), 1, -1, *(1,) * (f.ndim - 3)) for f, s in zip(fields, scales, strict=True)
    )
    seconds = np.array([float(f["seconds"]) for f in found])
    n = len(found)
    return _Samples(plan, points, features(plan, points), rise.reshape(n, -1), tared.reshape(n, -1), seconds)


def _read_background(plan: Plan, folder: Path) -> _Background:
    found = list(solved(folder, "background", None))
    if len(found) < KNOTS[0] * KNOTS[1]:
        raise NotBuilt(
            f"folder: received {folder}, which lacks the background; "
            "allowed is one that `build_emulator` filled"
        )
    shaped = [
        np.stack([f[name] for f in found]).reshape(*KNOTS, *found[0][name].shape)
        for name in ("unit", "pressure", "moved")
    ]
    return _Background(found[0]["x"], *shaped)


def _fit(known: _Samples, lengths: Known | None) -> Pair:
    """Regressions of the rise and of the tared displacement; lengths and noise of both, or None to find
    them."""
    if lengths is None:
        # images of one sample would look like proof of no noise
        alone = [regress(known.inputs, f) for f in (known.rise, known.tared)]
        lengths = (alone[0].lengths, alone[0].noise), (alone[1].lengths, alone[1].noise)
    inputs, rise, tared = _with_images(known)
    return regress(inputs, rise, lengths[0]), regress(inputs, tared, lengths[1])


def _with_images(known: _Samples) -> tuple[Floats, Floats, Floats]:
    """Inputs and fields of the samples, and of their images just beyond the planes of symmetry."""
    plan, n = known.plan, len(known.plan.grid())
    margin = _IMAGES * plan.ranges.offset_mm
    found = [(known.inputs, known.rise, known.tared)]
    for turned, right, up in list(product((False, True), (1, -1), (1, -1)))[1:]:
        points = known.points.copy()
        points[:, 2:4] = known.points[:, (3, 2) if turned else (2, 3)] * (right, up)
        x, y = points[:, 2], points[:, 3]
        near = (x > -margin) & (y > -margin) & (y < x + margin)
        if not near.any():
            continue
        offset = (right, 2 * up) if turned else (2 * right, up)  # any that unfolds like this image
        count = int(near.sum())
        shape = (count, -1, n, n)
        rise, tared = unfold(known.rise[near].reshape(shape), known.tared[near].reshape(*shape, 3), offset)
        found.append((features(plan, points[near]), rise.reshape(count, -1), tared.reshape(count, -1)))
    inputs, rises, tareds = (np.vstack(part) for part in zip(*found, strict=True))
    return inputs, rises, tareds


def _errors(held: _Samples, fitted: Pair, base: _Background) -> Floats:
    """Errors (n, 4) of the tared pressure, then of the tared displacement into the probe, as `_missed`."""
    rise = _missed(held, "rise", held.rise, fitted[0](held.inputs), base)
    return np.hstack([rise, _missed(held, "tared", held.tared, fitted[1](held.inputs), base)])


def _missed(
    held: _Samples, kind: str, true: Floats, guess: Floats, base: _Background, whole: Floats | None = None
) -> Floats:
    """Largest error and its root mean square, the worst of all levels and moduli, per cent of the maximum of
    `whole`, by default of the true field; (n, 2). Fields (n, values) over their amplitude."""
    plan, n = held.plan, len(held.plan.grid())
    area = np.outer(line_weights(base.x), line_weights(base.x))
    area /= area.sum()
    at = knots(plan)
    out = np.empty((len(held.points), 2))
    shape, axes = (-1, len(plan.ratios), n, n), 1 if kind == "rise" else 3
    for i, point in enumerate(held.points):
        onto = resample(plan, geometry_at(plan, point, 100.0), base.x)
        thick, soft = lagrange(at[0], 1 / point[4]), lagrange(at[1], float(np.log(point[5])))
        unit = np.tensordot(soft, np.tensordot(thick, base.unit, 1), 1) if kind == "rise" else 1.0

        def on_grid(field: Floats, onto: tuple[Floats, Floats] = onto, unit: Floats | float = unit) -> Floats:
            up = field.reshape(*shape, axes)[..., -1]  # the pressure, or the displacement along z
            return np.asarray(onto[0] @ up @ onto[1].T * unit)

        miss = on_grid(guess[i] - true[i])
        top = np.abs(on_grid((true if whole is None else whole)[i])).max(axis=(2, 3))
        out[i, 0] = 100 * (np.abs(miss).max(axis=(2, 3)) / top).max()
        out[i, 1] = 100 * (np.sqrt((miss**2 * area).sum(axis=(2, 3))) / top).max()
    return out


def _curve(known: _Samples, base: _Background) -> Floats:
    """Learning curve, as `Errors.curve`."""
    total = len(known.points)
    rest = np.arange(total) >= round((1 - _HELD) * total)
    rest_thick = known.part(rest & (known.points[:, 0] >= 4.0) & known.plan.inside(known.points))
    rows = []
    for share in (0.125, 0.25, 0.5, 1.0):
        count = round(share * int((~rest).sum()))
        if count < _FEWEST["sample"] or not len(rest_thick.points):
            continue
        fitted = _fit(known.part(np.arange(total) < count), None)
        found = _errors(rest_thick, fitted, base)
        spent = known.seconds[:count].sum()
        tops = [np.percentile(found[:, k], percent) for k in (0, 1) for percent in (50, 95)]
        rows.append([count, spent, *tops])
    return np.array(rows).reshape(-1, 6)
