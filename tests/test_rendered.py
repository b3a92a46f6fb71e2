"""What an estimator renders: coarse pictures, from pixels that are binned."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_tangent import bump

from twin import load_design, presses, rendered
from twin.design import Design


def coarse(design: Design, traced: Any) -> np.ndarray:
    chain = SimpleNamespace(
        design=design,
        emulator=None,
        fluxes=lambda values: np.array([led.flux_W for led in design.leds], np.float32),
        gain=lambda values: design.camera.gain_e_per_dn,
    )
    values = {"size_mm": 9.0, "depth_mm": 5.0, "modulus_kPa": 80.0, "offset_x_mm": 0.0, "offset_y_mm": 0.0}
    return rendered.rendered(chain, (traced,), values)  # type: ignore[arg-type]


def test_binned_pixels_give_the_same_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means over blocks are what all pixels give within 0.02 %, tared ones within 0.1 % of the blob."""
    from scenes import SpectralRenderer, backend

    backend.use("cpu")
    design = load_design("tsis")
    surface = bump(0.5, 2.0)
    surface.point_data["pressure_0"] = bump(0.0).point_data["pressure"]
    surface.point_data["displacement_0"] = bump(0.0).point_data["displacement"]
    monkeypatch.setattr(presses, "check_emulated", lambda *told: None)
    monkeypatch.setattr(presses, "emulated", lambda *told: [SimpleNamespace(surface=surface)])
    traced = SpectralRenderer(design.sensor(), device="cpu").render(surface, quality="preview", samples=2**12)
    assert traced.traced is not None
    found = []
    for binned in (1, 2):
        monkeypatch.setattr(rendered, "_BINNED", binned)
        assert rendered.coarser(design)[1] == binned
        found.append(coarse(design, traced.traced[0])[0].astype(float))
    every, some = found
    assert every.shape == (2, 41, 64) and every.mean() > 10.0
    blob, off = every[0] - every[1], some - every
    assert np.sqrt((off**2).mean()) < 2e-4 * every.mean()
    assert np.sqrt(((off[0] - off[1]) ** 2).mean()) < 1e-3 * np.sqrt((blob**2).mean())
    assert np.abs(off[0] - off[1]).max() < 2e-3 * blob.max()
