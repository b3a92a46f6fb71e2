"""What frames say of their quality's bias: the measured figures, or why there are none."""

from __future__ import annotations

import dataclasses
import json
from importlib.resources import files
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import RectBivariateSpline
from sensors import bump
from test_simulate import small

from scenes.surface import resample
from scenes.traced import BIAS_SINCE, LIGHT
from twin import light_bias
from twin.design import Design, load_design, parse_design
from twin.fields import tables_of

DATA = json.loads(files("assets").joinpath("light_bias.json").read_text(encoding="utf-8"))


def changed(**fields: Any) -> Design:
    """The shipped design with other values at dotted names, dots written as two underscores."""
    tables = tables_of(load_design("tsis"))
    for name, value in fields.items():
        room, _, field = name.partition("__")
        for part in tables["leds"] if room == "leds" else [tables[room]]:
            part[field] = value
    return parse_design(tables)


CASES = {
    "air": {},
    "embedded": {"leds__coupling": "embedded"},
    "domed": {"waveguide__dome_radius_mm": 150.0},
    "air, full contact": {"surface__contact": "full"},
    "embedded, full contact": {"leds__coupling": "embedded", "surface__contact": "full"},
    "domed, full contact": {"waveguide__dome_radius_mm": 150.0, "surface__contact": "full"},
    "air, water film": {"surface__gap_index": 1.33},
}


def test_the_data_are_todays_and_name_their_command() -> None:
    assert BIAS_SINCE <= DATA["light"] <= LIGHT and "tests/test_standard_quality.py" in DATA["command"]
    assert set(DATA["cases"]) == set(CASES)


def test_what_changed_since_it_was_measured_does_not_touch_it() -> None:
    """Since then pressures beside the guide's edge come to the optical grid otherwise (`LIGHT` 6): the
    surface that the bias was measured on is smooth there, and came to it by a plain spline. The domed one is
    made on the grid."""
    pressed = bump()
    x, y = (np.unique(np.round(pressed.points[:, k], 9)) for k in (0, 1))
    order = np.lexsort((pressed.points[:, 1], pressed.points[:, 0]))
    pressure = np.asarray(pressed["pressure"])[order].reshape(x.size, y.size)
    fine = resample(pressed, x[-1] - x[0])
    before = RectBivariateSpline(x, y, pressure, s=0)(fine.nodes_mm, fine.nodes_mm).T
    np.testing.assert_allclose(fine.pressure_kPa, before, rtol=1e-5)


@pytest.mark.parametrize("quality", ["standard", "preview"])
@pytest.mark.parametrize("name", CASES)
def test_a_design_like_a_measured_one_is_told_its_figures(name: str, quality: str) -> None:
    told, measured = light_bias.bias_of(changed(**CASES[name]), quality), DATA["cases"][name]["percent"]
    if quality not in measured:
        assert name not in ("air", "embedded", "domed")
        assert told["bias_percent"] is None and told["bias_of"].startswith("not measured with ")
        return
    assert told["bias_percent"] == measured[quality]
    for off, error in told["bias_percent"].values():
        assert abs(off) < 1.5 and 0.0 < error < 1.0
    assert f"{quality} against reference: {name}, " in told["bias_of"]
    words = light_bias.in_words(told)
    assert "blob" in words and "±" in words and "\n" not in words


@pytest.mark.parametrize(
    ("fields", "why"),
    [
        ({"leds__tilt_deg": 20.0}, "LEDs that are not Lambertian"),
        ({"waveguide__walls": "diffuse"}, "diffuse walls"),
        ({"surface__sheet": {"thickness_mm": 0.3, "modulus_kPa": 100.0}}, "a contact sheet"),
        ({"specimen__scattering_per_mm": 5.0}, "specimen.scattering_per_mm = 5 (alike: 0.5 to 2)"),
        ({"specimen__anisotropy": 0.9}, "specimen.anisotropy = 0.9"),
        ({"glass__refractive_index": 1.8}, "glass.refractive_index = 1.8"),
        ({"glass__absorption_per_mm": 0.3}, "glass.absorption_per_mm = 0.3"),
        ({"surface__rms_height_um": 0.1}, "surface.rms_height_um = 0.1"),
        ({"leds__z_mm": -8.0}, "LEDs far off the middle"),
        ({"waveguide__dome_radius_mm": 500.0}, "waveguide.dome_radius_mm = 500"),
        ({"waveguide__dome_radius_mm": 150.0, "leds__coupling": "embedded"}, "embedded, domed, rough"),
        ({"surface__gap_index": 1.2}, "air, flat, rough, 1.2"),
    ],
)
def test_a_design_unlike_all_is_told_why(fields: dict[str, Any], why: str) -> None:
    told = light_bias.bias_of(changed(**fields), "standard")
    assert told["bias_percent"] is None
    assert told["bias_of"].startswith("not measured with ") and why in told["bias_of"]


def test_other_light_is_told_why(monkeypatch: pytest.MonkeyPatch) -> None:
    design = load_design("tsis")
    assert "measured against" in light_bias.bias_of(design, "reference")["bias_of"]
    assert "learned light" in light_bias.bias_of(design, "standard", learned=True)["bias_of"]
    mixed = dataclasses.replace(
        design, leds=(dataclasses.replace(design.leds[0], coupling="embedded"), *design.leds[1:])
    )
    assert "together" in light_bias.bias_of(mixed, "standard")["bias_of"]
    below = dataclasses.replace(design, leds=(dataclasses.replace(design.leds[0], side="below"),))
    assert "LEDs below" in light_bias.bias_of(below, "standard")["bias_of"]
    three = dataclasses.replace(design, leds=design.leds[:3])
    assert "all four sides" in light_bias.bias_of(three, "standard")["bias_of"]
    layers = [dict(layer) for layer in tables_of(design)["waveguide"]["layers"]]
    layers[-1]["refractive_index"] = 1.55
    layered = changed(waveguide__layers=layers)
    assert "layers of different index" in light_bias.bias_of(layered, "standard")["bias_of"]
    monkeypatch.setattr(light_bias, "BIAS_SINCE", LIGHT + 1)
    told = light_bias.bias_of(design, "standard")
    assert told["bias_percent"] is None and "earlier version" in told["bias_of"]


def test_index_and_thickness_that_a_design_leaves_out_count_as_light_sees_them() -> None:
    assert light_bias.bias_of(changed(waveguide__refractive_index=None), "standard")["bias_percent"]
    layers = tables_of(load_design("tsis"))["waveguide"]["layers"]
    thick = changed(waveguide__layers=[*layers, layers[-1]])
    assert "waveguide.thickness_mm = 15" in light_bias.bias_of(thick, "standard")["bias_of"]
    assert light_bias.bias_of(small(), "standard")["bias_percent"]  # the camera does not matter
