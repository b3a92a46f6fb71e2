"""Painted walls: light enters by windows, gathered by its own LED's and traced by those of others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from sensors import bump, paper_sensor


@pytest.mark.parametrize(
    ("along_mm", "gap_mm", "dark"), [((-3.0, 3.0), 3.0, ()), ((-2.0, 0.0, 2.0), 1.5, (0, 2))]
)
def test_light_enters_by_windows_of_others(
    variant: str, along_mm: tuple[float, ...], gap_mm: float, dark: tuple[int, ...]
) -> None:
    """Two LEDs whose cones meet each other's window; one of three of a colour sensor, the others of other
    bands. Without that light preview was 6 and 11 % darker than every ray followed."""
    from scenes import Renderer

    base = paper_sensor("air", columns=64, rows=48, pixel_um=(100.8, 100.5))
    leds = tuple(
        replace(base.leds[0], gap_mm=gap_mm, along_mm=along, flux_W=0.0 if k in dark else 0.01)
        for k, along in enumerate(along_mm)
    )
    sensor = replace(base, leds=leds, guide=replace(base.guide, walls="absorbing"))
    renderer = Renderer(sensor, "cpu")
    ours = renderer.render(bump(), quality="preview", seed=1).radiance.mean(axis=(1, 2))
    found = renderer.render(bump(), quality="reference", seed=1, samples=2**19)
    theirs = found.radiance.mean(axis=(1, 2))
    lit = theirs > 0
    assert lit.sum() == len(leds) - len(dark)
    off = 100.0 * (ours[lit] / theirs[lit] - 1.0)
    error = found.noise_percent / np.sqrt(64 * 48)
    print(" ".join(f"{one:+.2f}" for one in off), f"± {error:.2f} %")
    assert np.abs(off).max() < 1.0 + 3.0 * error
