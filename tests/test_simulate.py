"""The chain from press to picture, at preview quality: seeds, levels, taring, what a frame says of itself.

Mechanics are linear here, which is quick; what other presses do to a picture is in test_simulate_presses.py.
"""

import dataclasses
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import fem
import twin
from estimation import scalars
from twin.exposure import picture_facts, saturated_percent, take

HERE = Path(__file__).resolve().parent
INCLUSION = twin.Inclusion(size=10, depth=5, modulus=100)


def small(columns=96, rows=61):
    """The shipped design with a coarse camera: the same field of view in fewer, larger pixels."""
    design = twin.load_design("tsis")
    scale = 768 / columns
    camera = dataclasses.replace(
        design.camera, columns=columns, rows=rows, pixel_um=(8.4 * scale, 9.8 * scale)
    )
    # Larger pixels gather more light: keep the counts those of the shipped camera.
    camera = dataclasses.replace(camera, exposure_ms=camera.exposure_ms / scale**2)
    return dataclasses.replace(design, camera=camera, mechanics="linear")


@pytest.fixture(scope="module")
def design():
    return small()


@pytest.fixture(scope="module")
def levels(design):
    return twin.simulate(design, INCLUSION, [1.0, 2.0], quality="preview", seed=7)


def test_one_level_gives_a_frame_and_several_a_list(design, levels):
    assert [frame.press["indentation_mm"] for frame in levels] == pytest.approx([1.0, 2.0])
    frame = twin.simulate(design, INCLUSION, quality="preview", seed=7)
    assert isinstance(frame, twin.Frame)
    assert frame.press["indentation_mm"] == 2.0  # the design's


FIELDS = ("displacement", "pressure", "displacement_0", "pressure_0")


def test_a_level_does_not_depend_on_the_others_beyond_the_solvers_tolerance(design, levels):
    alone = twin.simulate(design, INCLUSION, 2.0, quality="preview", seed=7)
    for name in FIELDS:
        one, other = alone.surface.point_data[name], levels[1].surface.point_data[name]
        assert np.abs(one - other).max() < 1e-7 * np.abs(other).max(), name
    assert np.allclose(alone.radiance, levels[1].radiance, rtol=1e-4, atol=1e-5 * alone.radiance.max())
    off = np.abs(alone.image.astype(int) - levels[1].image)
    assert off.max() <= 1 and off.mean() < 1e-3  # a count that was about to round the other way


@pytest.mark.slow
def test_the_same_call_gives_the_same_bytes(design, levels):
    again = twin.simulate(design, INCLUSION, [1.0, 2.0], quality="preview", seed=7)
    for frame, other in zip(again, levels, strict=True):
        for name in ("image", "reference", "radiance", "pressure", "displacement_z"):
            assert getattr(frame, name).tobytes() == getattr(other, name).tobytes(), name
        for name in FIELDS:
            assert frame.surface.point_data[name].tobytes() == other.surface.point_data[name].tobytes(), name


HASHES = """
import hashlib, sys
sys.path[:0] = sys.argv[2:]
from scenes import backend
from test_simulate import INCLUSION, small, twin
backend.use("auto")
backend.threads(int(sys.argv[1]))
frame = twin.simulate(small(), INCLUSION, 2.0, quality="preview", seed=7)
arrays = [frame.image, frame.reference, frame.radiance, *frame.surface.point_data.values()]
print(*(hashlib.sha256(array.tobytes()).hexdigest() for array in arrays))
"""


@pytest.mark.slow
def test_one_thread_and_two_give_the_same_bytes():
    found = set()
    for threads in ("1", "2"):
        environment = {**os.environ, "OMP_NUM_THREADS": threads, "OPENBLAS_NUM_THREADS": threads}
        command = [sys.executable, "-c", HASHES, threads, str(HERE), str(HERE.parent)]
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        found.add(ended.stdout)
    assert len(found) == 1 and len(found.pop().split()) >= 7


def test_another_seed_gives_other_noise_in_light_and_camera(design, levels):
    _, other = twin.simulate(design, INCLUSION, [1.0, 2.0], quality="preview", seed=8)
    assert not np.array_equal(other.image, levels[1].image)
    assert not np.array_equal(other.radiance, levels[1].radiance)
    assert np.array_equal(other.pressure, levels[1].pressure)  # mechanics draw no random numbers


def test_shapes_and_kinds_are_as_promised(design, levels):
    frame, shape = levels[1], (61, 96)
    assert frame.image.shape == shape and frame.image.dtype == np.uint8
    assert frame.radiance.shape == (4, *shape) and frame.radiance.dtype == np.float32
    assert frame.tared.shape == shape
    assert (frame.radiance >= 0).all()
    for name in ("displacement", "pressure", "displacement_0", "pressure_0"):
        assert name in frame.surface.point_data
    assert frame.design is design and frame.inclusion is INCLUSION and frame.seed == 7


def test_scalars_are_those_of_the_frames_own_arrays(levels):
    for frame in levels:
        signal = frame.design.signal
        assert frame.tsis["raw"] == scalars(frame.image, signal.counts)
        assert frame.tsis["tared"] == scalars(frame.image - frame.reference.astype(float), signal.counts)
        expected = fem.scalars(frame.surface, signal.displacement_um)
        assert (frame.fem["raw"], frame.fem["tared"]) == (expected["raw"], expected["tared"])


def test_mechanics_scale_with_the_press(levels):
    """Small strain is linear: twice the indentation, twice the force and the tared displacement."""
    one, two = levels
    assert two.press["force_N"] == pytest.approx(2 * one.press["force_N"], rel=1e-12)
    assert two.fem["tared"]["max_mm"] == pytest.approx(2 * one.fem["tared"]["max_mm"], rel=1e-9)
    assert two.fem["min_pressure_kPa"] == pytest.approx(2 * one.fem["min_pressure_kPa"], rel=1e-9)


def test_the_inclusion_shows_in_the_middle_of_the_tared_picture(levels):
    frame = levels[1]
    signal = np.clip(frame.tared.astype(float) - frame.design.signal.counts, 0, None)
    assert signal.sum() > 0
    rows, columns = np.indices(signal.shape)
    # Within 1 mm (4 pixels) of the middle, where the inclusion lies.
    assert (columns * signal).sum() / signal.sum() == pytest.approx(47.5, abs=4)
    assert (rows * signal).sum() / signal.sum() == pytest.approx(30, abs=4)


def test_without_inclusion_the_tared_picture_is_noise(design):
    frame = twin.simulate(design, None, 2.0, quality="preview", seed=7)
    assert frame.fem["tared"] == {"max_mm": 0.0, "total_mm3": 0.0, "area_mm2": 0.0}
    counts = frame.tared.astype(float)
    assert abs(counts.mean()) < 5 * counts.std() / np.sqrt(counts.size)
    assert frame.tsis["tared"]["area_px"] < 0.001 * counts.size


def test_a_press_by_force_has_that_force(design, levels):
    frame = twin.simulate(design, INCLUSION, force=levels[1].press["force_N"], quality="preview")
    assert frame.press["force_N"] == pytest.approx(levels[1].press["force_N"], rel=1e-9)
    assert frame.press["indentation_mm"] == pytest.approx(2.0, rel=1e-9)


def test_camera_noise_differs_between_levels_but_not_its_fixed_pattern(design):
    """Averaging levels must average noise away: the draws of two levels are unrelated."""
    frames = twin.simulate(design, None, [2.0, 2.000001], quality="preview", seed=3)
    first, second = (frame.tared.astype(float).ravel() for frame in frames)
    assert abs(np.corrcoef(first, second)[0, 1]) < 5 / np.sqrt(first.size)


def test_progress_runs_from_0_to_1_through_named_stages(design):
    told = []
    tell = lambda stage, done: told.append((stage, done))  # noqa: E731
    twin.simulate(design, None, [1.0, 3.0], quality="preview", progress=tell)
    done = [share for _, share in told]
    assert done == sorted(done) and done[-1] == 1.0 and done[0] >= 0
    assert {stage for stage, _ in told} == {"mechanics", "light 1 of 2", "light 2 of 2"}


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"indentation": 2.0, "force": 1.0}, "press"),
        ({"indentation": -1.0}, "press.indentation_mm"),
        ({"indentation": [2.0, 7.0]}, "press.indentation_mm"),
        ({"indentation": []}, "press.indentation_mm"),
        ({"indentation": "deep"}, "press.indentation_mm"),
        ({"force": float("inf")}, "press.force_N"),
        ({"force": 2.0}, "press.force_N"),  # 2 N presses 7 mm deep
        ({"seed": -1}, "seed"),
        ({"seed": 1.5}, "seed"),
        ({"seed": True}, "seed"),
        ({"seed": "1"}, "seed"),
        ({"indentation": True}, "press.indentation_mm"),
        ({"indentation": "2"}, "press.indentation_mm"),
        ({"indentation": [1.0, np.True_]}, "press.indentation_mm"),
        ({"indentation": np.ones((1, 1))}, "press.indentation_mm"),
        ({"force": 1e-9}, "press.force_N"),
    ],
)
def test_impossible_presses_are_refused_in_one_line(design, options, field):
    with pytest.raises(twin.DesignError) as caught:
        twin.simulate(design, INCLUSION, **{"quality": "preview", **options})
    assert caught.value.field == field
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("indentation", "seed"), [(np.float32(2.0), np.array(7))])
def test_numpys_numbers_are_numbers(design, levels, indentation, seed):
    frame = twin.simulate(design, INCLUSION, indentation, quality="preview", seed=seed)
    assert isinstance(frame, twin.Frame)
    assert type(frame.seed) is int
    assert np.array_equal(frame.image, levels[1].image)


def test_full_pixels_are_counted(design, levels):
    """At a hundred times the exposure every lit pixel is full, at the converter's end or at the well's."""
    assert levels[1].tsis["saturated_percent"] < 0.1
    bright = dataclasses.replace(design.camera, exposure_ms=100 * design.camera.exposure_ms)
    roomy = dataclasses.replace(bright, bits=16)  # no count of 16 bits is reached: the well is full before
    for camera in (bright, roomy):
        changed = dataclasses.replace(design, camera=camera)
        image = take(changed, levels[1].radiance, 7, 2.0)
        found = picture_facts(changed, image, levels[1].reference, levels[1].radiance)
        assert found["saturated_percent"] > 90
    assert image.max() < 2**16 - 1


def test_a_pixel_is_full_where_one_of_its_channels_is():
    """Blue full all over, red and green not: all pixels are, not a third."""
    design = twin.load_design("rgb")
    image = np.zeros((*design.camera.shape, 3), np.uint16)
    image[:, : design.camera.columns // 2, 2] = 2**design.camera.bits - 1
    assert saturated_percent(design, image, np.zeros(image.shape)) == 50.0


def test_moduli_too_far_apart_for_the_solver_are_refused_in_one_line(design, monkeypatch):
    def fail(*args):
        raise np.linalg.LinAlgError("not positive definite")

    monkeypatch.setattr("fem.pressing.path", fail)
    with pytest.raises(fem.NotModelled, match="moduli or lengths so far apart"):
        fem.press(design.probe(), design.slab(), fem.Inclusion(11, 5, 100), 1.0)
