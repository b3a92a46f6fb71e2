"""Expected pictures and their derivatives, with presses made up in closed form in place of an emulator."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
from sensors import pressed
from test_simulate import small

import twin
from estimation.information import bound
from twin import forward, presses
from twin.complaint import DesignError
from twin.forward import Unknown

BALL = twin.Inclusion(size=9.0, depth=5.0, modulus=80.0, offset=(1.0, -0.5))


@dataclass
class Press:
    surface: Any


def pressing(design: twin.Design, ball: Any, levels: Any, emulator: Any) -> list[Press]:
    """A bump that rises with size, depth and modulus, over 0.45 kPa per mm and kPa of tissue over 5."""

    def one(level: float) -> Press:
        base = 0.45 * level * design.specimen.modulus_kPa / 5.0
        rise = base * 0.5 * (ball.size / ball.depth) ** 2 * ball.modulus / (ball.modulus + 20.0) / 3.0
        x0, y0 = ball.offset

        def pressure(x: np.ndarray, y: np.ndarray) -> np.ndarray:
            return base + rise * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (0.3 * ball.size**2))

        surface = pressed(pressure, lambda x, y: (0.0, 0.0, -0.01 * pressure(x, y)))
        plain = pressed(lambda x, y: base, lambda x, y: (0.0, 0.0, -0.01 * base))
        for name in ("pressure", "displacement"):
            surface[f"{name}_0"] = plain[name]
        return Press(surface)

    return [one(level) for level in levels]


@pytest.fixture
def found(variant: str, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(presses, "emulated", pressing)

    def expected(
        unknowns: list[Unknown],
        levels: tuple[float, ...] = (2.0,),
        design: twin.Design | None = None,
        **more: Any,
    ) -> forward.Expected:
        stage = (design or small(), BALL, levels, unknowns)
        return forward.expected(*stage, emulator=None, **more)  # type: ignore[arg-type]

    return expected


@pytest.mark.slow
def test_gain_and_flux_have_closed_forms(found: Any) -> None:
    """Counts go as one over the electrons per count, and a LED's share of them as its flux."""
    design = replace(small(), leds=small().leds[:2])
    each = [Unknown(f"leds.{k}.flux_W", 0.05, relative=True) for k in range(2)]
    told = found([Unknown("camera.gain_e_per_dn", 0.01, relative=True), *each], design=design)
    light = told.mean - design.camera.offset_dn
    assert told.jacobian[0] == pytest.approx(-light, rel=1e-4, abs=1e-6)
    assert np.abs(told.jacobian[1:].sum(axis=0) - light).max() < 0.01 * light.max()
    assert (told.jacobian[1:] >= -1e-6 * light.max()).all()


@pytest.mark.slow
def test_smooth_differences_agree_with_light_traced_anew(found: Any) -> None:
    """Summed over the picture; light that walks on after the contact took its part is what is left out."""
    unknowns = [Unknown("size_mm", 3.0), Unknown("specimen.modulus_kPa", 0.05, True)]
    smooth, traced = (found(unknowns, quality="standard", again=again).jacobian for again in (True, False))
    totals = [part[:, 0].sum(axis=(1, 2)) for part in (smooth, traced)]
    print("smooth over traced, less 1, %:", 100 * (totals[0] / totals[1] - 1))
    assert totals[0] == pytest.approx(totals[1], rel=0.06)
    assert not smooth[0, 1].any()  # the reference knows nothing of the inclusion
    assert smooth[1, 1].any()


def test_offset_moves_the_picture(found: Any) -> None:
    """d/dx0 = -d/dx of the tared picture, along rows too: +y is up in it."""
    told = found([Unknown("offset_x_mm", 1.0), Unknown("offset_y_mm", 1.0)])
    columns = told.mean.shape[2]
    width = small().camera.field_of_view_mm
    tared = told.mean[0] - told.mean[1]
    by_row, by_column = np.gradient(tared)
    along = [-by_column * columns / width, by_row * columns / width]
    for slope, expected in zip(told.jacobian[:, 0], along, strict=True):
        assert np.corrcoef(slope.ravel(), expected.ravel())[0, 1] > 0.98


def test_bounds_shrink_with_levels_and_frames_and_grow_with_unknowns(found: Any) -> None:
    wanted = ["size_mm", "depth_mm"]
    few = [Unknown("size_mm", 3.0), Unknown("depth_mm", 2.0)]
    more = [*few, Unknown("specimen.modulus_kPa", 0.05, True)]

    def sd(told: forward.Expected, unknowns: list[Unknown], frames: int = 1) -> np.ndarray:
        return bound(forward.information(told, unknowns, small(), frames=frames), wanted).sd

    told, both = found(more), found(few, (1.0, 2.0))
    one = sd(told, more)
    least = sd(replace(told, names=told.names[:2], jacobian=told.jacobian[:2]), few)
    assert (sd(both, few) < least).all()
    assert (sd(told, more, frames=100) < one).all()
    assert (least < one).all()


def test_unknowns_that_are_none_are_refused(found: Any) -> None:
    for wrong in (
        Unknown("specimen.colour", 1.0),
        Unknown("size_mm", 0.0),
        Unknown("leds.*.flux_W", 0.1, True),
    ):
        with pytest.raises(DesignError, match=r"received .*; allowed "):
            found([wrong])


def test_noise_is_the_cameras() -> None:
    camera = replace(small().camera, read_noise_e=30.0, dark_current_e_s=1000.0, offset_dn=5.0)
    noise = forward.noise_of(replace(small(), camera=camera), frames=4)
    dark = 1000.0 * camera.exposure_ms * 1e-3
    assert noise.shot == 1.0 / camera.gain_e_per_dn
    assert noise.read_dn * camera.gain_e_per_dn == pytest.approx(np.sqrt(900.0 + dark))
    assert noise.offset_dn == pytest.approx(5.0 + dark / camera.gain_e_per_dn)
    assert (noise.frames, noise.bits) == (4, camera.bits)


def test_the_deepest_press_has_slopes_to_the_thickness(found: Any) -> None:
    """Of thinner specimens it would be too deep: both steps are taken on the other side."""
    design = small()
    design = replace(design, press=replace(design.press, indentation_mm=(6.0,)))
    told = found([Unknown("specimen.thickness_mm", 1.0)], levels=(6.0,), design=design)
    assert np.abs(told.jacobian).max() < 1e-6 * told.mean.max()  # these presses know nothing of it
