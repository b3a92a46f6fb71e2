"""A contact sheet before the tissue: standard light against every ray followed."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sensors import bump, paper_sensor, pressed

from scenes.skin import Sheet

SHEETS = {
    "thin, on a white backing": Sheet(0.1, 500.0, scattering_per_mm=5.0, backing=0.9),
    "clear, on a white backing": Sheet(0.2, 500.0, scattering_per_mm=0.0, absorption_per_mm=0.2, backing=0.9),
    "of high index": Sheet(0.5, 500.0, refractive_index=1.6, scattering_per_mm=10.0),
}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n.startswith("clear") else n for n in SHEETS]
)
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


def test_a_thin_sheet_that_hardly_scatters_does_not_blur(variant: str) -> None:
    """Its backing answers as fine as it is thin, whatever its own mean free path, here 50 mm."""
    from scenes import Renderer

    base = paper_sensor("air", columns=64, rows=48, pixel_um=(100.8, 100.5))
    sheet = Sheet(0.1, 100.0, scattering_per_mm=0.0, absorption_per_mm=0.02, backing=0.8)
    sensor = dataclasses.replace(base, skin=dataclasses.replace(base.skin, sheet=sheet))

    def square(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return 0.3 + 3.0 * ((x > 0) & (x < 6) & (abs(y) < 3))

    surface, renderer = pressed(square, lambda x, y: (0.0, 0.0, 0.0 * x)), Renderer(sensor, "cpu")
    ours = renderer.render(surface, quality="preview", seed=1)
    theirs = renderer.render(surface, quality="reference", seed=1, samples=2**18)
    x, y = np.moveaxis(ours.position_mm, -1, 0)[:2]
    inside = (x > 1) & (x < 5) & (abs(y) < 2)
    light, all_light = (one.radiance.sum(axis=0)[inside] for one in (ours, theirs))
    off = 100.0 * (light.mean() / all_light.mean() - 1.0)
    error = 100.0 * all_light.std() / np.sqrt(inside.sum()) / all_light.mean()
    print(f"inside the contact: {off:+.1f} ± {error:.1f} %")
    assert abs(off) < 3.0 * error < 5.0
