"""Presses that are not straight down on the middle: tilted, off the centre, finite strain; and light."""

import dataclasses
import json

import numpy as np
import pytest
from sensors import HALF_MM, dense, paper_sensor, pressed
from test_simulate import INCLUSION, small

import twin
from fem import NotModelled as NotPressed
from twin import presses
from twin.reporting import summarise

QUICK = {"quality": "preview", "device": "cpu"}


def grid(frame_or_press, name="pressure"):
    """Field of the contact surface on its grid, (nx, ny) or (nx, ny, 3), and the lines x and y, mm."""
    surface = frame_or_press.surface
    x, y = (np.unique(np.round(surface.points[:, axis], 9)) for axis in (0, 1))
    field = np.asarray(surface.point_data[name])
    return field.reshape(len(x), len(y), *field.shape[1:]), x, y


@pytest.fixture(scope="module")
def tilted():
    """Turned by 6 degrees about y and pressed 1 mm: -x goes in first, +x hangs in the air."""
    return twin.simulate(small(), INCLUSION, 1.0, tilt=(0, 6), seed=7, **QUICK)


def test_a_tilted_sensor_touches_on_one_side_only(tilted):
    pressure, x, _ = grid(tilted)
    assert tilted.fem["path"] == "unilateral" and tilted.fem["min_pressure_kPa"] == 0.0
    assert pressure.min() == 0.0
    inner = np.abs(x) < 0.8 * HALF_MM
    assert pressure[inner & (x < -5)].mean() > 2 * pressure[inner & (x > 5)].mean()
    assert (pressure[x > 11] == 0).any()
    areas = np.asarray(tilted.surface.point_data["area"])
    force = (np.asarray(tilted.surface.point_data["pressure"]) * areas).sum() / 1e3
    assert force == pytest.approx(tilted.press["force_N"], rel=1e-6)


def test_open_contact_is_dark(tilted):
    """No pressure, no light: where contact has opened the picture is darker than where it is pressed."""
    picture = tilted.radiance.sum(axis=0)
    assert np.isfinite(picture).all() and (picture >= 0).all() and (tilted.pressure >= 0).all()
    middle = slice(20, 41)  # rows about y = 0
    assert picture[middle, 5:25].mean() > 2 * picture[middle, -20:-8].mean()


def test_the_record_tells_the_pose_and_how_far_to_trust_it(tilted, tmp_path, capfd):
    record = tilted.record()
    assert record["press"]["tilt_deg"] == [0, 6] and record["press"]["position_mm"] == [0, 0]
    assert record["fem"]["mechanics"] == "linear" and 0 < record["fem"]["error_percent"] < 50
    json.dumps(record, allow_nan=False)
    summarise([tilted], tmp_path)
    printed = " ".join(capfd.readouterr().out.split())
    assert "tilted by (0, 6)°" in printed and "linear, contact open in places" in printed


def test_light_of_contact_that_has_opened(variant):
    """Hertz's pressure on a disc of 6 mm radius: light comes out of it, and next to none from beside it."""
    from scenes import Renderer

    def dip(x, y):
        return np.sqrt(np.maximum(1 - (x**2 + y**2) / 36, 0.0))

    surface = pressed(lambda x, y: 1.5 * dip(x, y), lambda x, y: (0 * x, 0 * x, -0.2 * dip(x, y)))
    sensor = dense(paper_sensor(columns=96, rows=61, pixel_um=(67.2, 78.4)))
    found = Renderer(sensor, device="cpu").render(surface, quality="preview", seed=1)
    picture, place = found.radiance.sum(axis=0), np.hypot(*np.moveaxis(found.position_mm, -1, 0))
    assert np.isfinite(picture).all() and (picture >= 0).all()
    assert picture[place < 4.5].mean() > 20 * picture[(place > 8) & (place < 10)].mean()
    assert found.pressure[place > 8].max() < 1e-3


def test_a_sensor_off_the_middle_of_the_specimen_sees_the_mirror_image_at_the_other_side():
    design, found = small(), []
    for side in (1, -1):
        inclusion = dataclasses.replace(INCLUSION, offset=(2.0 * side, 0.0))
        there = design.pressed(position_mm=(8.0 * side, 0.0))
        (press,) = presses.solved(there, inclusion, [2.0], quality="preview", estimate=False)
        found.append(grid(press)[0])
    assert np.abs(found[0] - found[1][::-1]).max() < 1e-6 * found[0].max()
    assert np.abs(found[0] - found[0][::-1]).max() > 0.1  # kPa: not the same as straight above the middle


def test_an_ellipsoid_is_told_and_its_stretch_of_one_is_the_sphere(tilted):
    sphere = dataclasses.replace(INCLUSION, stretch=(1, 1, 1))
    assert sphere == INCLUSION
    wide = dataclasses.replace(tilted, inclusion=dataclasses.replace(INCLUSION, stretch=(1.2, 1, 0.8)))
    assert wide.record()["inclusion"]["stretch"] == (1.2, 1.0, 0.8)


@pytest.mark.slow
def test_finite_strain_raises_force_and_signal():
    """At 1 mm the tared signal grows by about 2 %; the two agree as the press goes to zero."""
    design = small()
    linear, finite = (
        {
            depth: press
            for depth, press in zip(
                (0.02, 1.0),
                presses.solved(
                    design.pressed(mechanics=mechanics),
                    INCLUSION,
                    (0.02, 1.0),
                    quality="preview",
                    estimate=False,
                ),
                strict=True,
            )
        }
        for mechanics in ("linear", "finite")
    )
    assert finite[0.02].force_N == pytest.approx(linear[0.02].force_N, rel=2e-3)
    assert 1.005 < finite[1.0].force_N / linear[1.0].force_N < 1.05
    assert (finite[1.0].mechanics, linear[1.0].mechanics) == ("finite", "linear")
    assert finite[1.0].path in ("sliding", "unilateral") and linear[1.0].path == "tied"


@pytest.mark.slow
def test_a_finite_press_makes_a_picture():
    frame = twin.simulate(small().pressed(mechanics="finite"), INCLUSION, 2.0, **QUICK)
    assert frame.fem["mechanics"] == "finite" and frame.tsis["tared"]["total_dn"] > 0


@pytest.mark.parametrize(
    ("options", "field"),
    [
        ({"mechanics": "plastic"}, "mechanics"),
        ({"tilt": (0, 11)}, "press.tilt_deg.1"),
        ({"tilt": 2.0}, "press.tilt_deg"),
        ({"position": (0, -17)}, "press.position_mm"),
        ({"position": (float("nan"), 0)}, "press.position_mm.0"),
    ],
)
def test_impossible_ways_to_press_are_refused_in_one_line(options, field):
    with pytest.raises(twin.DesignError) as caught:
        twin.simulate(small(), INCLUSION, 2.0, **options, **QUICK)
    assert caught.value.field == field and "\n" not in str(caught.value)


def test_a_domed_guide_is_lit_where_it_touches():
    """Its corners stay off the tissue: dark, at rest under the apex by what a sphere's cap is lower there."""
    design = small()
    domed = dataclasses.replace(design, waveguide=dataclasses.replace(design.waveguide, dome_radius_mm=120.0))
    frame = twin.simulate(domed, INCLUSION, 0.5, **QUICK)
    assert frame.fem["path"] == "unilateral"
    picture = frame.radiance.sum(axis=0)
    rows, columns = picture.shape
    middle = picture[rows // 2 - 2 : rows // 2 + 2, columns // 2 - 2 : columns // 2 + 2].mean()
    assert np.isfinite(picture).all() and middle > 3 * picture[:3, :3].mean()
    assert frame.pressure[0, 0] < 1e-6 < frame.pressure[rows // 2, columns // 2]


def test_what_the_mesh_cannot_follow_is_one_line(monkeypatch):
    def fail(*args, **options):
        raise ValueError("mesh: received a geometry that turns an element inside out; allowed are others")

    monkeypatch.setattr("fem.press", fail)
    with pytest.raises(NotPressed, match=r"^mesh: received"):
        presses.solved(small(), INCLUSION, [2.0])


def test_several_forces_come_from_one_call():
    found = presses.solved(small(), INCLUSION, [0.2, 0.5], by_force=True, quality="preview", estimate=False)
    assert [press.force_N for press in found] == pytest.approx([0.2, 0.5], rel=1e-8)
    assert [press.force_0_N for press in found] == pytest.approx([0.2, 0.5], rel=1e-8)
    assert found[1].indentation_mm == pytest.approx(2.5 * found[0].indentation_mm, rel=1e-6)  # linear
