"""A contact sheet before the tissue: standard light against every ray followed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sensors import bump, paper_sensor

from scenes.skin import Sheet

SHEETS = {
    "thin, on a white backing": Sheet(0.1, 500.0, scattering_per_mm=5.0, backing=0.9),
    "clear, on a white backing": Sheet(0.2, 500.0, scattering_per_mm=0.0, absorption_per_mm=0.2, backing=0.9),
    "of high index": Sheet(0.5, 500.0, refractive_index=1.6, scattering_per_mm=10.0),
}


@pytest.mark.parametrize("name", SHEETS)
def test_all_light_is_the_references(variant: str, name: str) -> None:
    """What a backing throws back is seen without another scattering; radiance is of the sheet's index."""
    from scenes import Renderer

    base = paper_sensor("air", columns=96, rows=61, pixel_um=(67.2, 78.4))
    sensor = dataclasses.replace(base, skin=dataclasses.replace(base.skin, sheet=SHEETS[name]))
    renderer = Renderer(sensor, "cpu")

    def light(quality: str, seed: int) -> float:
        found = renderer.render(bump(), quality=quality, seed=seed, samples=2**16)  # type: ignore[arg-type]
        return float(found.radiance.sum(dtype=np.float64))

    ours, theirs = (np.array([light(q, seed) for seed in range(1, 5)]) for q in ("standard", "reference"))
    off = 100.0 * (ours.mean() / theirs.mean() - 1.0)
    error = 100.0 * np.hypot(*(one.std(ddof=1) / 2.0 / one.mean() for one in (ours, theirs)))
    print(f"{name}: {off:+.2f} ± {error:.2f} %")
    assert abs(off) < 1.0 + 3.0 * error
