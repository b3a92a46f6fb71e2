"""What an emulator's plan draws: specimens that fit, each with its number, and none where none can."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import pytest
from test_fem_emulator import PROBE, RANGES

from fem.emulating import build_emulator
from fem.sampling import NotBuilt, Plan, Ranges
from fem.solving import _tasks, file_of
from fem.specimen import geometry_at
from twin import load_design
from twin.emulate import plan_of


@pytest.mark.parametrize(
    ("ranges", "field"),
    [
        ({"size_mm": (5.0, 5.0)}, "size_mm"),
        ({"modulus_kPa": (5.0, 80.0)}, "modulus_kPa"),
        ({"depth_mm": (-1.0, 5.0)}, "depth_mm"),
    ],
)
def test_senseless_ranges_are_refused(ranges: dict[str, tuple[float, float]], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        Ranges(**ranges)  # type: ignore[arg-type]


def test_ranges_that_hold_no_specimen_are_refused() -> None:
    """At once where none can fit, and where one in thousands does, without looking for ever."""
    with pytest.raises(ValueError, match=r"ranges.thickness_mm: received up to 15 mm; .* over 16 mm"):
        Plan(PROBE, 44.0, ranges=replace(RANGES, thickness_mm=(10.0, 15.0)))
    plan = Plan(PROBE, 44.0, ranges=replace(RANGES, thickness_mm=(10.0, 16.01)))
    with pytest.raises(NotBuilt, match="hardly a specimen fits") as caught:
        build_emulator(plan, "nowhere", samples=30)
    assert "\n" not in str(caught.value) and not Path("nowhere").exists()


def test_points_stay_within_a_slab_as_wide_as_the_probe() -> None:
    plan = Plan(PROBE, 20.0, ranges=replace(RANGES, offset_mm=6.0))
    points = np.array([plan.point(k) for k in range(0, 80, 4)])  # those that keep their offsets
    assert (points[:, 2] + points[:, 0] / 2 < 10.0).all()
    for point in points:
        geometry_at(plan, point, 50.0)


def test_points_fit_and_are_nested() -> None:
    """All points keep their distance from the chest wall and lie in one octant; more of them do not change
    the first ones."""
    plan = Plan(PROBE, 44.0, seed=5)
    points = np.array([plan.point(k) for k in range(0, 200, 20)])
    assert (points[:, 0] + points[:, 1] <= points[:, 4] - 4).all()
    assert ((points[:, 2] >= points[:, 3]) & (points[:, 3] >= 0)).all()
    assert np.array_equal(points[3], plan.point(60))


def test_points_by_multipoles_share_their_tissue() -> None:
    """So many in a row have one thickness and modulus, and of those that finite strain is solved for, each
    kind of offsets is one; other tissues come from the ranges evenly."""
    plan = plan_of(load_design("tsis"))
    points = np.array(list(islice(plan.points(), 40 * plan.shared)))
    groups = points.reshape(40, plan.shared, 7)
    assert plan.shared > 1 and (groups[:, :, 4:6] == groups[:, :1, 4:6]).all()
    assert len(np.unique(groups[:, 0, 4])) == 40 and len(np.unique(points[:, 0])) == len(points)
    assert (points[:, 0] + points[:, 1] <= points[:, 4] - 4).all()
    stretched = np.array([plan.stretched(number) for number in range(len(points))])
    assert 3 * stretched.sum() == len(points)
    offsets = (points[stretched, 2:4] > 0).sum(axis=1).reshape(40, -1)
    assert (np.sort(offsets) == [0, 0, 1, 2]).all()
    for row, ends in ((4, plan.ranges.thickness_mm), (5, plan.ranges.tissue_kPa)):
        share = np.sort((groups[:, 0, row] - ends[0]) / (ends[1] - ends[0]))
        assert np.abs(share - (np.arange(40) + 0.5) / 40).max() < 0.15


def test_a_tissue_that_nothing_fits_into_is_left() -> None:
    """Below 10 mm none does; it is not looked through for ever, and the ranges are not said to be empty."""
    plan = plan_of(load_design("tsis"))
    tight = replace(plan, ranges=replace(plan.ranges, thickness_mm=(6.0, 40.0)))
    points = np.array(list(islice(tight.points(), 600)))
    assert (points[:, 0] + points[:, 1] <= points[:, 4] - 4).all()
    tissues = tight._tissues(np.array([6.0, 3.0]), np.array([40.0, 8.0]))
    assert min(thickness for thickness, _ in islice(tissues, 50)) < 8.0


def test_tasks_are_whole_tissues_and_what_is_left_of_them(tmp_path: Path) -> None:
    plan = plan_of(load_design("tsis"))

    def asked(samples: int | None) -> dict[str, list[list[int]]]:
        found: dict[str, list[list[int]]] = {}
        for kind, numbers in islice(_tasks(plan, tmp_path, samples), 80):
            found.setdefault(kind, []).append(numbers)
        return found

    n = plan.shared
    assert asked(2 * n + 1)["sample"] == [list(range(n)), list(range(n, 2 * n)), [2 * n]]
    assert asked(None)["sample"][:2] == asked(2 * n)["sample"]
    file_of(tmp_path, "sample", 0).touch()
    file_of(tmp_path, "sample", n - 1).touch()  # not solved at finite strain
    assert asked(n)["sample"] == [list(range(n - 1))]
    file_of(tmp_path, "stretch", 0).touch()
    assert asked(n)["sample"] == [list(range(1, n - 1))]
