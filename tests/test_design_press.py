"""What a design says of presses and inclusions: what fits under the sensor, one line where it does not."""

import dataclasses
import re

import numpy as np
import pytest

import fem
from fem import Inclusion
from fem.model import check as fem_check
from twin.design import Design, DesignError, load_design


def test_what_is_not_an_inclusion_is_named():
    with pytest.raises(DesignError, match=r"inclusion: received \(10, 5, 100\); allowed a twin\.Inclusion"):
        load_design("tsis").check_inclusion((10, 5, 100))


@pytest.mark.parametrize(
    "values", [("10", 5, 100), (10, True, 100), (10, 5, None), (0.01, 5, 100), (10, 5, 1e9)]
)
def test_inclusions_take_numbers_only(values):
    with pytest.raises(ValueError):
        Inclusion(*values)
    assert Inclusion(np.float32(10), np.int64(5), 100) == Inclusion(10, 5, 100)


@pytest.mark.parametrize(
    ("inclusion", "field"),
    [
        (Inclusion(10, 20, 100), "inclusion.depth"),  # its far side touches the chest wall at 30 mm
        (Inclusion(26, 5, 100), "inclusion.size"),
        (Inclusion(10, 5, 100, offset=(25.0, 0.0)), "inclusion.offset"),  # touches the slab's side at 30 mm
        (Inclusion(10, 5, 100, offset=(0.0, -40.0)), "inclusion.offset"),
        (Inclusion(10, 5, 100, offset=(12.6, 0.0)), "inclusion.offset"),  # beside the probe
        (Inclusion(10, 5, 100, stretch=(1, 1, 2.5)), "inclusion.size"),  # 25 mm high
        (Inclusion(5, 22, 100, stretch=(1, 1, 1.6)), "inclusion.depth"),
        (Inclusion(10, 5, 100, stretch=(2.3, 1, 1)), "inclusion.size"),  # 23 mm wide under a probe of 25
    ],
)
def test_inclusion_stays_in_the_slab_and_under_the_probe(inclusion, field):
    with pytest.raises(DesignError) as caught:
        load_design("tsis").check_inclusion(inclusion)
    assert caught.value.field == field


def test_where_the_inclusion_may_lie_depends_on_where_the_sensor_stands():
    """At 16 mm of the specimen's centre, 12 mm more and a radius of 5 mm leave its half width of 30 mm."""
    design, inclusion = load_design("tsis"), Inclusion(10, 5, 100, offset=(12, 0))
    design.check_inclusion(inclusion)
    design.pressed(position_mm=(-16, 0)).check_inclusion(inclusion)
    with pytest.raises(DesignError, match=r"inclusion\.offset: .* less than 25 mm .* along x .*at 16 mm"):
        design.pressed(position_mm=(16, 0)).check_inclusion(inclusion)


def test_tilted_presses_need_free_sides():
    design = load_design("tsis")
    sided = dataclasses.replace(design, specimen=dataclasses.replace(design.specimen, sides="symmetric"))
    assert sided.slab().sides == "symmetric"
    with pytest.raises(DesignError, match=r"press\.tilt_deg: received \(0\.0, 1\.0\); allowed \(0, 0\)"):
        sided.pressed(tilt_deg=(0, 1))


def test_a_design_is_pressed_another_way():
    design = load_design("tsis")
    other = design.pressed(mechanics="linear", tilt_deg=[1, -2], position_mm=np.array([3.0, 4.0]))
    assert (other.mechanics, other.press.tilt_deg, other.press.position_mm) == ("linear", (1, -2), (3, 4))
    assert other.pose() == fem.Pose((1, -2), (3, 4)) and design.pressed() is design
    assert other.pressed(mechanics="finite", tilt_deg=(0, 0), position_mm=(0, 0)) == design


@pytest.mark.parametrize(
    ("how", "line"),
    [
        ({"mechanics": "plastic"}, "mechanics: received 'plastic'; allowed one of 'finite', 'linear'"),
        ({"tilt_deg": 3}, "press.tilt_deg: received 3; allowed a list of 2"),
        ({"tilt_deg": "12"}, "press.tilt_deg: received '12'; allowed a list of 2"),
        ({"tilt_deg": (1, 2, 3)}, "press.tilt_deg: received (1, 2, 3); allowed a list of 2"),
        ({"tilt_deg": (0, -11)}, "press.tilt_deg.1: received -11; allowed a number >= -10 and <= 10"),
        ({"position_mm": (True, 0)}, "press.position_mm.0: received True; allowed a number"),
        ({"position_mm": (16.4, 0)}, "press.position_mm: received (16.4, 0.0); allowed up to 16.3 mm"),
    ],
)
def test_another_way_to_press_is_checked_like_a_design(how, line):
    with pytest.raises(DesignError, match=re.escape(line)):
        load_design("tsis").pressed(**how)


def test_designs_and_mechanics_refuse_the_same():
    """What a design lets through, the mechanics take, and the other way round, in random cases."""
    rng = np.random.default_rng(3)
    design, agreed = load_design("tsis"), {True: 0, False: 0}
    for _ in range(800):
        size, depth, modulus = rng.uniform(2, 20), rng.uniform(1, 22), 100.0
        stretch = tuple(rng.uniform(0.6, 1.6, 3)) if rng.random() < 0.5 else (1, 1, 1)
        offset = tuple(rng.uniform(-15, 15, 2)) if rng.random() < 0.7 else (0, 0)
        inclusion = Inclusion(size, depth, modulus, offset=offset, stretch=stretch)
        wide = rng.choice([25.0, 25.5, 40.0, 60.0])
        guide = dataclasses.replace(
            design.waveguide, dome_radius_mm=rng.choice([None, 90.0, 98.45, 98.46, 120.0])
        )
        sides = str(rng.choice(["free", "symmetric"]))
        slab = dataclasses.replace(design.specimen, width_mm=wide, sides=sides)
        tilt = tuple(rng.uniform(-3, 3, 2)) if rng.random() < 0.3 else (0.0, 0.0)
        position = tuple(rng.uniform(-18, 18, 2)) if rng.random() < 0.4 else (0.0, 0.0)
        verdicts = []
        try:
            other = dataclasses.replace(design, waveguide=guide, specimen=slab)
            other.pressed(tilt_deg=tilt, position_mm=position).check_inclusion(inclusion)
            verdicts.append(True)
        except ValueError:
            verdicts.append(False)
        probe = fem.Probe(25.0, guide.layers, guide.dome_radius_mm)
        try:
            fem_check(probe, fem.Slab(30.0, wide, 5.0, sides=sides), inclusion, fem.Pose(tilt, position))
            verdicts.append(True)
        except ValueError:
            verdicts.append(False)
        assert verdicts[0] == verdicts[1], (inclusion, guide.dome_radius_mm, slab, tilt, position)
        agreed[verdicts[0]] += 1
    assert min(agreed.values()) > 80


def test_press_is_limited_to_a_fifth_of_the_slab():
    design: Design = load_design("tsis")
    design.check_indentation(6.0)
    for depth in (6.001, 0.0, -1.0, float("nan")):
        with pytest.raises(DesignError, match=r"press\.indentation_mm"):
            design.check_indentation(depth)
