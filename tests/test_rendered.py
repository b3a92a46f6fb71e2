"""What an estimator renders quickly: how pictures change from one specimen to another like it."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from test_tangent import bump

from twin import load_design, presses, rendered
from twin.design import Design


def seen(design: Design, surface: Any, traced: Any, monkeypatch: pytest.MonkeyPatch, quick: bool) -> Any:
    """Coarse pictures of a surface in place of an emulated one, (levels, 2 or 1, r, c)."""
    chain: Any = SimpleNamespace(
        design=design,
        emulator=None,
        fluxes=lambda values: np.array([led.flux_W for led in design.leds], np.float32),
        gain=lambda values: design.camera.gain_e_per_dn,
    )
    values = {"size_mm": 9.0, "depth_mm": 5.0, "modulus_kPa": 80.0, "offset_x_mm": 0.0, "offset_y_mm": 0.0}
    monkeypatch.setattr(presses, "check_emulated", lambda *told: None)
    monkeypatch.setattr(presses, "emulated", lambda *told: [SimpleNamespace(surface=surface)])
    return rendered.rendered(chain, (traced,), values, quick=quick).astype(float)


def test_quick_pictures_change_as_whole_ones(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of binned pixels and on coarser maps of light; what an inclusion changes is right to 0.1 %, which for a
    tenth more of one is a quarter of the photons' noise of 100 exposures in a block."""
    from scenes import SpectralRenderer, backend

    backend.use("cpu")
    design = load_design("tsis")
    both = []
    for higher in (0.5, 0.55):
        both.append(bump(higher, 2.0))
        for name in ("pressure", "displacement"):
            both[-1].point_data[f"{name}_0"] = bump(0.0).point_data[name]
    renderer = SpectralRenderer(design.sensor(), device="cpu")
    traced = renderer.render(both[0], quality="preview", samples=2**12).traced
    assert traced is not None
    whole, quick = (
        [seen(design, surface, traced[0], monkeypatch, fast)[0] for surface in both] for fast in (False, True)
    )
    assert whole[0].shape == (2, 41, 64) and quick[0].shape == (1, 41, 64)
    assert np.sqrt(((quick[0][0] - whole[0][0]) ** 2).mean()) < 2e-3 * whole[0].mean()
    change, same = whole[1][0] - whole[0][0], quick[1][0] - quick[0][0]
    off = np.sqrt(((same - change) ** 2).mean())
    share, block = off / np.sqrt((change**2).mean()), rendered.BLOCK[0] * rendered.BLOCK[1]
    noise = np.sqrt(whole[0].mean() / design.camera.gain_e_per_dn / block / 100.0)
    print(f"change off by {100 * share:.3f} %, {off:.5f} counts; noise of 100 exposures {noise:.5f}")
    assert share < 1.5e-3 and off < noise / 3.0
