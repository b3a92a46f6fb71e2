"""How far an emulator at finite strain is off after half an hour on two cores, and what longer builds reach:
`make bench` prints it."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import fem
from fem.emulating import build_emulator, fit
from fem.emulator import Emulator
from fem.ground import cubic, lines
from fem.specimen import geometry_at
from fem.surface import line_weights
from twin import load_design
from twin.emulate import plan_of

MINUTES, WORKERS = 30.0, 2
MEDIAN_PERCENT, HIGH_PERCENT = 1.0, 4.0
"""Goal for the error of the tared pressure over its maximum, of held-out inclusions of 4 mm and more: met as
root mean square over the surface; the largest error of a press is asked for, too."""
FAILED_PERCENT = 2.0  # of the solves that may be missing

UNSEEN = {"standard": 4, "preview": 2}
"""Presses that no sample has seen: on the standard mesh under the probe's middle; beside it, where that takes
minutes, on the coarser one, whose own error is as large."""


@pytest.mark.slow
@pytest.mark.timeout(7200)
def test_emulator_after_half_an_hour(tmp_path: Path) -> None:
    plan = plan_of(load_design("tsis"))
    built = build_emulator(plan, tmp_path, minutes=MINUTES, workers=WORKERS)
    show(built)
    again = fit(plan, tmp_path)
    assert np.array_equal(again.rise.weights, built.rise.weights)
    for quality, count in UNSEEN.items():
        missed = np.array([missed_by(built, point, quality) for point in unseen(built, quality, count)])
        print(f"tared pressure against presses of {quality} quality, worst of 1, 2, 3 mm, as above, %:")
        print(np.round(missed, 2).tolist())
        if quality == "standard":
            assert missed[:, 0].max() <= HIGH_PERCENT
    errors = built.errors
    assert errors.failed_percent <= FAILED_PERCENT
    assert errors.percentile("pressure", 50, kind=1) <= MEDIAN_PERCENT
    assert errors.percentile("pressure", 95, kind=1) <= HIGH_PERCENT
    assert seconds_of_an_answer(built) < 5e-3
    largest = [[errors.percentile("pressure", percent, kind=kind) for percent in (50, 95)] for kind in (0, 2)]
    assert (
        largest[0][0] <= 2 * MEDIAN_PERCENT and largest[0][1] <= 2 * HIGH_PERCENT
    )  # one bad solve breaks it
    if any(median > MEDIAN_PERCENT or high > HIGH_PERCENT for median, high in largest):
        words = (f"{median:.2f} % and {high:.2f} %" for median, high in largest)
        pytest.xfail(
            f"largest errors off the edge {next(words)}, on the whole surface {next(words)}, "
            f"goal {MEDIAN_PERCENT:g} and {HIGH_PERCENT:g}"
        )


def show(built: Emulator) -> None:
    errors = built.errors
    thick = int((errors.size_mm >= 4).sum())
    print(f"\n{len(errors.size_mm)} samples left out in turn, {thick} of 4 mm and more; error, %:")
    for name in ("pressure", "displacement"):
        for size, what in ((4.0, "d >= 4 mm"), (0.0, "d < 4 mm")):
            found = [errors.percentile(name, p, size, kind) for kind in (0, 1, 2) for p in (50, 95)]
            print(
                f"  tared {name}, {what}: largest off the edge, median {found[0]:.2f}, 95th percentile "
                f"{found[1]:.2f}; root mean square over the area {found[2]:.2f}, {found[3]:.2f}; "
                f"largest with the edge {found[4]:.2f}, {found[5]:.2f}"
            )
    print("learning curve, a common third held out, d >= 4 mm: samples at small and at finite strain,")
    print("core minutes; median, 95th percentile of the largest error off the edge, of the root mean square,")
    print("and of the largest error with the edge:")
    for count, more, seconds, *found in errors.curve:
        print(f"  {count:4.0f} {more:4.0f} {seconds / 60:5.1f} ", *(f"{value:5.2f}" for value in found))
    print(f"failed solves: {errors.solves[:, 1].sum():.0f} of {errors.solves[:, 0].sum():.0f}")
    print(f"one answer: {1e3 * seconds_of_an_answer(built):.2f} ms")


def seconds_of_an_answer(built: Emulator) -> float:
    plan, times = built.plan, []
    inclusion, slab = fem.Inclusion(9.0, 6.0, 80.0, (2.0, 1.0)), plan.slab(30.0, 5.0)
    for _ in range(20):
        start = time.perf_counter()
        built(plan.probe, slab, inclusion, 2.0)
        times.append(time.perf_counter() - start)
    return min(times)


def unseen(built: Emulator, quality: str, count: int) -> list[np.ndarray]:
    """Points of another seed within the ranges, 4 mm and more, under the middle for the standard mesh."""
    plan = replace(built.plan, seed=built.plan.seed + 7)
    found = []
    for point in plan.points():
        middle = point[2] == 0
        if point[0] >= 4.0 and plan.inside(point[None])[0] and middle == (quality == "standard"):
            found.append(point)
        if len(found) == count:
            break
    return found


def missed_by(built: Emulator, point: np.ndarray, quality: str) -> list[float]:
    """Error of the tared pressure, per cent of its maximum, the worst of three levels: largest off the
    edge, root mean square, largest."""
    plan = built.plan
    modulus = (1 + 1.5 * point[6]) / (1 - point[6]) * point[5]
    geometry = geometry_at(plan, point, float(np.clip(modulus, *plan.ranges.modulus_kPa)))
    area = np.outer(line_weights(built.x), line_weights(built.x)) / plan.probe.width_mm**2
    levels, out = [1.0, 2.0, 3.0], []
    assert geometry.inclusion is not None
    presses = fem.press(
        plan.probe,
        geometry.slab,
        geometry.inclusion,
        levels,
        mechanics="finite",
        quality=quality,
        estimate=False,
    )
    for level, press in zip(levels, fem.on_background(presses, smooth=built.plan.degree > 0), strict=True):
        onto = [cubic(line, built.x) for line in lines(press.surface)]
        true = onto[0] @ _tared(press) @ onto[1].T
        miss = _tared(built(plan.probe, geometry.slab, geometry.inclusion, level)) - true
        inner = np.abs(miss[1:-1, 1:-1]).max()
        out.append([inner, np.sqrt((miss**2 * area).sum()), np.abs(miss).max()] / np.abs(true).max())
    return [float(value) for value in 100 * np.max(out, axis=0)]


def _tared(press: fem.Press | fem.Emulated) -> np.ndarray:
    data, n = press.surface.point_data, round(press.surface.n_points**0.5)
    return np.asarray(data["pressure"] - data["pressure_0"]).reshape(n, n)
