"""The standard picture against the reference, which follows every ray through guide and tissue (minutes)."""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from sensors import bump, paper_sensor

from scenes.sensor import Sensor

CASES = {
    "air": lambda: paper_sensor("air"),
    "embedded": lambda: paper_sensor("embedded"),
    "full contact": lambda: _with_skin(contact="full"),
    "water film": lambda: _with_skin(gap_index=1.33),
}
PASSES, PATHS = 12, 2**20
"""Reference pictures and their light paths per LED: noise of a 16 x 16 pixel bin of about 1 %."""

BLOB, BACKGROUND = (214, 278, 352, 416), (214, 278, 134, 198)
BIN = 16


def _with_skin(**changes: object) -> Sensor:
    base = paper_sensor("air")
    return dataclasses.replace(base, skin=dataclasses.replace(base.skin, **changes))


@cache
def pictures(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Standard picture (rows, columns) and reference pictures (PASSES, rows, columns), all LEDs together."""
    from scenes import Renderer

    renderer = Renderer(CASES[name](), "cpu")
    standard = renderer.render(bump(), quality="standard", seed=1).radiance.sum(axis=0, dtype=np.float64)
    runs = [
        renderer.render(bump(), quality="reference", seed=100 + k, samples=PATHS).radiance.sum(axis=0)
        for k in range(PASSES)
    ]
    return standard, np.array(runs, dtype=np.float64)


KNOWN = 5.0
"""Per cent that standard is off at most, as measured on all cases: it must not get worse."""


def compared(standard: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative difference, per cent, of standard and reference, and its standard error; over the leading
    axis the reference is averaged."""
    mean, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    return 100 * (standard / mean - 1), 100 * error / mean


def binned(picture: np.ndarray) -> np.ndarray:
    rows, columns = (size // BIN for size in picture.shape[-2:])
    part = picture[..., : rows * BIN, : columns * BIN]
    return part.reshape(*picture.shape[:-2], rows, BIN, columns, BIN).mean(axis=(-3, -1))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.xfail(
    raises=AssertionError, reason="the width of the spread follows the angle of entry only to second order"
)
@pytest.mark.parametrize("name", CASES)
def test_standard_is_the_reference(variant: str, name: str) -> None:
    standard, runs = pictures(name)

    def crop(picture: np.ndarray, where: tuple[int, int, int, int]) -> np.ndarray:
        top, end, left, right = where
        return picture[..., top:end, left:right].mean(axis=(-2, -1))

    found = {}
    for what, where in (("blob", BLOB), ("background", BACKGROUND)):
        found[what] = compared(crop(standard, where), crop(runs, where))
    line = slice(214, 278)
    found["profile"] = compared(
        standard[line].mean(axis=0).reshape(24, 32).mean(axis=1),
        runs[:, line].mean(axis=1).reshape(PASSES, 24, 32).mean(axis=2),
    )
    found["bins"] = compared(binned(standard), binned(runs))
    for what, (off, error) in found.items():
        worst = np.unravel_index(np.abs(off).argmax(), np.shape(off)) if np.ndim(off) else ()
        print(f"{name}, {what}: worst {np.asarray(off)[worst]:+.2f} ± {np.asarray(error)[worst]:.2f} %")
    for what in ("blob", "background"):
        off, error = found[what]
        if np.any(np.abs(off) > KNOWN + 2 * error):  # no assertion: that is expected to fail
            pytest.fail(f"{what}: {off} %, beyond the {KNOWN} % that the README tells")
    for what, allowed in (("blob", 0.5), ("background", 0.5), ("profile", 0.5), ("bins", 3.0)):
        off, error = found[what]
        assert np.all(np.abs(off) < allowed + 2 * error), what
