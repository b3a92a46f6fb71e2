"""The standard picture against Mitsuba's stock path tracer, which knows none of its shortcuts (minutes)."""

from __future__ import annotations

from functools import cache
from typing import Any, Literal

import numpy as np
import pytest
from sensors import bump, paper_sensor

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


@cache
def standard(coupling: Coupling) -> tuple[Any, np.ndarray]:
    """The renderer, its surface in place, and the standard picture of all LEDs, W m⁻² sr⁻¹."""
    from scenes import Renderer

    renderer = Renderer(paper_sensor(coupling), "cpu")
    return renderer, renderer.render(bump(), quality="standard", seed=1).radiance.sum(
        axis=0, dtype=np.float64
    )


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("name", CROPS)
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_standard_picture_agrees_with_path(variant: str, coupling: Coupling, name: str) -> None:
    """Means over 32 x 32 pixels within 0.5 %, path's own standard error below 0.2 %."""
    from scenes.reference import path_trace

    renderer, picture = standard(coupling)
    crop = CROPS[name]
    mean, error = path_trace(renderer.scene, renderer.sensor, SAMPLES[coupling], 7, crop=crop)
    ours, path = picture[crop[0] : crop[1], crop[2] : crop[3]].mean(), mean.mean()
    own = np.sqrt(np.sum(error**2)) / error.size
    print(
        f"{coupling}, {name}: standard {ours:.5g}, path {path:.5g} ± {100 * own / path:.2f} % W/m²/sr, "
        f"difference {100 * (ours / path - 1):+.2f} %"
    )
    assert own < 2e-3 * path
    assert ours == pytest.approx(path, rel=5e-3)
