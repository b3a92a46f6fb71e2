"""Frames of the shipped white and colour designs, in small: their files, their light, what is averaged."""

import json
from dataclasses import replace

import numpy as np
import pytest

import twin
from scenes.exr import read_exr, read_png
from scenes.lens import lens_of, through

INCLUSION = twin.Inclusion(10, 5, 100)


def small(name: str, **camera: object) -> twin.Design:
    """The shipped design with pixels 12 (rgb) or 6 times as large a side."""
    design, factor = twin.load_design(name), 12 if name == "rgb" else 6
    rows, columns = design.camera.rows // factor, design.camera.columns // factor
    width, height = (factor * pitch for pitch in design.camera.pixel_um)
    changed = {"rows": rows, "columns": columns, "pixel_um": (width, height), "exposure_ms": 0.05, **camera}
    return replace(design, camera=replace(design.camera, **changed))


@pytest.fixture(scope="module")
def colour() -> twin.Frame:
    return twin.simulate(small("rgb"), INCLUSION, 2.0, quality="preview", seed=3)


def test_colour_frames_files(colour: twin.Frame, tmp_path) -> None:
    assert colour.radiance.shape == (3, 45, 60, 3)
    assert colour.image.shape == (45, 60, 3) and colour.image.dtype == np.uint16
    folder = colour.write(tmp_path / "out")
    layers = read_exr(folder / "frame.exr")
    names = {f"led.{led}.{channel}" for led in range(3) for channel in "RGB"}
    assert set(layers) == names | {"pressure", "displacement.z"}
    assert np.array_equal(layers["led.1.G"], colour.radiance[1, ..., 1])
    assert np.array_equal(read_png(folder / "image.png"), colour.image)
    assert np.array_equal(read_exr(folder / "reference.exr")["counts.B"], colour.reference[..., 2])
    lens = json.loads((folder / "frame.json").read_text())["lens"]
    assert lens["focal_length_mm"] == pytest.approx(lens_of(colour.design.sensor()).focal_mm, rel=1e-12)


def test_each_side_shines_in_its_own_colour(colour: twin.Frame) -> None:
    """Of the LEDs red at +x, green at +y, blue at -x, each is brightest in its channel."""
    light = colour.radiance.sum(axis=(1, 2), dtype=np.float64)
    assert list(light.argmax(axis=1)) == [0, 1, 2]
    assert np.all(light.max(axis=1) > 3 * np.sort(light, axis=1)[:, 1])
    red, blue = colour.radiance[0, ..., 0], colour.radiance[2, ..., 2]
    x = np.linspace(-1, 1, 60)
    assert np.sum(red * x) > 0 > np.sum(blue * x)


def test_counts_are_those_of_the_photons(colour: twin.Frame) -> None:
    """Mean counts of each channel against photons counted by hand from the layers in the file."""
    camera = colour.design.camera
    light = through(colour.design.sensor(), colour.radiance.sum(axis=0, dtype=np.float64)).mean(axis=(0, 1))
    magnification = 720 * 6.9e-3 / 25.0
    watt = np.pi / (4 * 2.8**2 * (1 + magnification) ** 2) * light * (12 * 6.9e-6) ** 2
    photons = watt * 0.05e-3 / (6.62607015e-34 * 299_792_458.0 / 550e-9)
    expected = 32.0 + photons * np.array([0.48, 0.58, 0.52]) / 5.4
    np.testing.assert_allclose(colour.image.mean(axis=(0, 1)), expected, atol=0.3 + 0.002 * expected.max())
    assert expected.min() > 60.0
    assert camera.bits == 12


@pytest.mark.slow
def test_white_frames_averaged_and_binned(tmp_path) -> None:
    """Their mean keeps fractions of counts, in image.exr; noise falls as the root of their number."""
    frames = [
        twin.simulate(small("white", frames=n, binning=2), None, 2.0, quality="preview", seed=3)
        for n in (1, 16)
    ]
    one, many = frames
    assert one.radiance.shape == (4, 41, 64) and one.image.shape == (41, 64)
    assert one.image.dtype == np.uint16 and many.image.dtype == np.float32
    assert np.array_equal(one.radiance, many.radiance)
    # both share light and pattern with their references of 16 frames
    single, mean = ((frame.image - frame.reference).std() for frame in frames)
    assert single / mean == pytest.approx(np.sqrt((1 + 1 / 16) / (2 / 16)), rel=0.1)
    folder = many.write(tmp_path / "out")
    assert np.array_equal(read_exr(folder / "image.exr")["counts"], many.image)
    assert np.array_equal(read_png(folder / "image.png"), np.rint(many.image))
