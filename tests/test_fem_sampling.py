"""What an emulator's plan draws: specimens that fit, each with its number, and none where none can."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_fem_emulator import PROBE, RANGES

from fem.emulating import build_emulator
from fem.sampling import NotBuilt, Plan, Ranges, geometry_at


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
