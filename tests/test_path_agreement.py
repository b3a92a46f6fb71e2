"""The standard picture against Mitsuba's stock path tracer, which knows none of its shortcuts (minutes)."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
import pytest
from sensors import bump, dense, paper_sensor

# (first row, last + 1, first column, last + 1) of the paper's 492 x 768 pixels: the blob in the middle, the
# background beside it, and the edge of the picture next to an LED, where an embedded one makes its hot spot.
CROPS = {
    "blob": (230, 262, 368, 400),
    "background": (230, 262, 150, 182),
    "beside an LED": (40, 72, 360, 392),
}
SAMPLES = {"air": 81_920, "embedded": 65_536}
"""Per pixel, so that the mean of a crop is good to 0.2 %."""

Coupling = Literal["air", "embedded"]


SEEDS = (1, 2, 3, 4)


@cache
def standard(coupling: Coupling) -> tuple[Any, np.ndarray]:
    """The renderer, its surface in place, and standard pictures of all LEDs, one per seed, W m⁻² sr⁻¹."""
    from scenes import Renderer

    renderer = Renderer(dense(paper_sensor(coupling)), "cpu")
    runs = [renderer.render(bump(), quality="standard", seed=seed) for seed in SEEDS]
    print(f"{coupling}: noise of one pixel {runs[0].noise_percent:.2f} %")
    return renderer, np.array([run.radiance.sum(axis=0, dtype=np.float64) for run in runs])


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", CROPS)
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_standard_picture_agrees_with_path(variant: str, coupling: Coupling, name: str) -> None:
    """Means over 32 x 32 pixels within 0.5 %, path's own standard error below 0.2 %.

    On blob and background already with a single picture; beside an LED, where one picture's own noise reaches
    that size (it is smoothed, so a crop has little more to average than a pixel), with four.
    """
    from scenes.reference import path_trace

    renderer, pictures = standard(coupling)
    top, end_row, left, end_column = CROPS[name]
    mean, error = path_trace(renderer.scene, renderer.sensor, SAMPLES[coupling], 7, crop=CROPS[name])
    own = np.sqrt(np.sum(error**2)) / error.size / mean.mean()
    ours = pictures[:, top:end_row, left:end_column].mean(axis=(1, 2)) / mean.mean() - 1.0
    print(
        f"{coupling}, {name}: path {mean.mean():.5g} W/m²/sr ± {100 * own:.2f} %, "
        f"standard {100 * ours.mean():+.2f} %, each {', '.join(f'{100 * one:+.2f}' for one in ours)} %"
    )
    assert own < 2e-3
    assert abs(ours.mean()) < 5e-3
    if name != "beside an LED":
        assert abs(ours[0]) < 5e-3
    assert np.abs(ours).max() < 1e-2
