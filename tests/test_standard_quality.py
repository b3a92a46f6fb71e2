"""The standard picture against the reference, which follows every ray through guide and tissue.

Pictures of 96 x 61 pixels, each 8 x 8 of the paper's camera: all that is compared are means over more.
"""

from __future__ import annotations

import dataclasses
from functools import cache

import numpy as np
import pytest
from sensors import HALF_MM, bump, domed, paper_sensor

from scenes.sensor import Sensor

COARSE = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
CASES = {
    "air": lambda: paper_sensor("air", **COARSE),
    "embedded": lambda: paper_sensor("embedded", **COARSE),
    "domed": lambda: paper_sensor("air", **COARSE),
    "air, full contact": lambda: _with_skin("air", contact="full"),
    "embedded, full contact": lambda: _with_skin("embedded", contact="full"),
    "domed, full contact": lambda: _with_skin("air", contact="full"),
    "air, water film": lambda: _with_skin("air", gap_index=1.33),
}
PASSES, PATHS = 12, 2**20
"""Reference pictures and their light paths per LED."""

BLOB, BACKGROUND = (26, 35, 44, 52), (26, 35, 17, 25)
BIN = 2


def _with_skin(coupling: str, **changes: object) -> Sensor:
    base = paper_sensor(coupling, **COARSE)  # type: ignore[arg-type]
    return dataclasses.replace(base, skin=dataclasses.replace(base.skin, **changes))


@cache
def pictures(name: str, passes: int = PASSES, paths: int = PATHS) -> tuple[np.ndarray, np.ndarray]:
    """Standard picture (rows, columns) and reference pictures (passes, rows, columns), all LEDs together."""
    from scenes import Renderer

    renderer, press = Renderer(CASES[name](), "cpu"), domed() if name.startswith("domed") else bump()
    standard = [
        renderer.render(press, quality="standard", seed=k).radiance.sum(axis=0, dtype=np.float64)
        for k in (1, 2)
    ]
    runs = [
        renderer.render(press, quality="reference", seed=100 + k, samples=paths).radiance.sum(axis=0)
        for k in range(passes)
    ]
    return np.mean(standard, axis=0), np.array(runs, dtype=np.float64)


def compared(standard: np.ndarray, runs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Relative difference, per cent, of standard and reference, and its standard error; over the leading
    axis the reference is averaged."""
    mean, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(len(runs))
    return 100 * (standard / mean - 1), 100 * error / mean


def crop(picture: np.ndarray, where: tuple[int, int, int, int]) -> np.ndarray:
    top, end, left, right = where
    return np.asarray(picture[..., top:end, left:right].mean(axis=(-2, -1)))


def binned(picture: np.ndarray) -> np.ndarray:
    rows, columns = (size // BIN for size in picture.shape[-2:])
    part = picture[..., : rows * BIN, : columns * BIN]
    return np.asarray(part.reshape(*picture.shape[:-2], rows, BIN, columns, BIN).mean(axis=(-3, -1)))


def profile(picture: np.ndarray) -> np.ndarray:
    """Along the middle, a millimetre each, (24,)."""
    line = picture[..., BLOB[0] : BLOB[1], :].mean(axis=-2)
    return np.asarray(line.reshape(*line.shape[:-1], 24, 4).mean(axis=-1))


@pytest.mark.parametrize("name", ["air", "embedded, full contact"])
def test_all_light_and_that_of_the_rim_are_the_references(variant: str, name: str) -> None:
    """All of it within 0.5 %, and within 4 % what is seen of the outermost millimetre, where light goes over
    the rim."""
    standard, runs = pictures(name, 4, 2**17)
    for what, off, error, allowed in (
        ("all", *compared(standard.mean(), runs.mean(axis=(1, 2))), 0.5),
        ("rim", *compared(_rim(standard), _rim(runs)), 4.0),
    ):
        print(f"{name}, {what}: {off:+.2f} ± {error:.2f} %")
        assert abs(off) < allowed + 3 * error, what


def _rim(picture: np.ndarray) -> np.ndarray:
    columns = round(COARSE["columns"] / (2 * HALF_MM))
    return np.asarray((picture[..., :columns] + picture[..., -columns:]).mean(axis=(-2, -1)))


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", CASES)
def test_blob_and_background_are_the_references(variant: str, name: str) -> None:
    """Within 0.5 %."""
    standard, runs = pictures(name)
    for what, where in (("blob", BLOB), ("background", BACKGROUND)):
        off, error = compared(crop(standard, where), crop(runs, where))
        print(f"{name}, {what}: {off:+.2f} ± {error:.2f} %")
        assert abs(off) < 0.5 + 2 * error, what


def _bins_of(name: str) -> object:
    dark = pytest.mark.xfail(
        strict=True, raises=AssertionError, reason="a dome's rim in front of an LED is 10 to 12 % dark"
    )
    return pytest.param(name, marks=dark) if name.startswith("domed") else name


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("name", [_bins_of(name) for name in CASES])
def test_bins_are_the_references(variant: str, name: str) -> None:
    """Bins of 16 x 16 pixels within 3 %, borders and LED spots included."""
    standard, runs = pictures(name)
    off, error = compared(binned(standard), binned(runs))
    place = np.unravel_index((np.abs(off) - 4 * error).argmax(), off.shape)
    rms, noise = (np.sqrt((values**2).mean()) for values in (off, error))
    worst = f"{off[place]:+.2f} ± {error[place]:.2f} % at {tuple(map(int, place))}"
    print(f"{name}, bins: rms {rms:.2f} %, of it noise {noise:.2f}; {worst}")
    assert np.all(np.abs(off) < 3.0 + 4 * error)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.xfail(strict=True, raises=AssertionError, reason="1 to 3 % off in the outer 3 mm, goal 0.5 %")
@pytest.mark.parametrize("name", CASES)
def test_a_profile_is_the_references(variant: str, name: str) -> None:
    """Each millimetre along the middle within 0.5 %."""
    standard, runs = pictures(name)
    off, error = compared(profile(standard), profile(runs))
    print(f"{name}, profile: {np.round(off, 1)}, ± {error.mean():.2f} %")
    assert np.all(np.abs(off) < 0.5 + 2.5 * error)
