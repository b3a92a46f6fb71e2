"""Designs: the paper's sensor as it is shipped, its schema, and one plain line for every mistake."""

import dataclasses
import datetime
import json
import re
import tomllib
from importlib.resources import files

import jsonschema
import pytest

import fem
from scenes.tissue import tissue_optics
from twin.design import DesignError, design_schema, load_design, parse_design, shipped_designs

SHEET = {"thickness_mm": 0.5, "modulus_kPa": 100.0}
TSIS = files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8")


@pytest.fixture
def data():
    return tomllib.loads(TSIS)


def test_the_shipped_design_is_the_papers_sensor():
    design = load_design("tsis")
    assert shipped_designs() == ["rgb", "tsis", "white"]
    assert design.name == "tsis"
    assert design.waveguide.width_mm == 25 and design.waveguide.thickness_mm == 10
    assert [(layer.thickness_mm, layer.modulus_kPa) for layer in design.waveguide.layers] == [
        (2, 27),
        (3, 61),
        (5, 156),
    ]
    assert sorted(led.side for led in design.leds) == ["+x", "+y", "-x", "-y"]
    assert {(led.diameter_mm, led.coupling) for led in design.leds} == {(1.5, "air")}
    camera = design.camera
    assert (camera.columns, camera.rows, camera.pixel_um, camera.bits) == (768, 492, (8.4, 9.8), 8)
    assert camera.field_height_mm == pytest.approx(18.685, abs=1e-3)  # 25 mm x 4.8216 / 6.4512
    assert design.specimen.modulus_kPa == 5 and design.specimen.sides == "free"
    assert design.mechanics == "finite" and design.waveguide.dome_radius_mm is None


def test_index_of_the_guide_is_sylgards():
    """Schneider 2009: n² = 1 + 1.0093 L²/(L² - 0.013185), L in µm."""
    design = load_design("tsis")
    square = (design.light.wavelength_nm / 1000) ** 2
    expected = (1 + 1.0093 * square / (square - 0.013185)) ** 0.5
    assert design.waveguide.refractive_index == pytest.approx(expected, abs=5e-5)


def test_tissue_gives_back_what_the_design_says():
    """72 % by radiative transfer; 68 % by diffusion theory (Flock 1989), matched index."""
    specimen = load_design("tsis").specimen
    tissue = tissue_optics(specimen.scattering_per_mm, specimen.absorption_per_mm)
    assert tissue.reflectance == pytest.approx(0.72, abs=0.005)
    a = specimen.scattering_per_mm / (specimen.scattering_per_mm + specimen.absorption_per_mm)
    assert a / (1 + 2 * (1 - a) + 5 / 3 * (3 * (1 - a)) ** 0.5) == pytest.approx(0.68, abs=0.005)


def test_contact_sheet_takes_the_tissues_part_in_the_contact(data):
    data["surface"]["sheet"] = {"thickness_mm": 0.5, "modulus_kPa": 500.0, "backing": 0.3}
    design = parse_design(data)
    sheet = design.sensor().skin.sheet
    assert (sheet.thickness_mm, sheet.backing, sheet.poisson) == (0.5, 0.3, 0.49)
    by_hand = 1 / ((1 - 0.49**2) / 27 + (1 - 0.49**2) / 500)
    assert design.effective_modulus_kPa == pytest.approx(by_hand, rel=1e-12)
    assert design.slab().modulus_kPa == 5  # the press leaves the sheet's stiffness out


@pytest.mark.parametrize("name", ["rgb", "tsis", "white"])
def test_every_value_of_the_shipped_design_has_a_comment(name):
    """A comment on the line, on the ones above it, or (for the plain repeats of an LED) its own short one."""
    text = files("assets").joinpath("designs", f"{name}.toml").read_text(encoding="utf-8")
    assert load_design(name).name == name and text.startswith("#:schema ./schema.json\n")
    lines = text.splitlines()
    for number, line in enumerate(lines):
        if "=" in line and not line.startswith("#") and not line.startswith(("name", "description")):
            assert "#" in line or lines[number - 1].startswith("#"), f"line {number + 1}: {line}"


def test_rooms_get_their_own_input():
    design = load_design("tsis")
    felt = [(layer.thickness_mm, layer.modulus_kPa, layer.poisson) for layer in design.waveguide.layers]
    assert design.probe().layers == tuple(fem.Layer(*layer) for layer in felt)
    assert (design.slab().thickness_mm, design.slab().modulus_kPa) == (30, 5)
    assert design.pose() == fem.Pose((0, 0), (0, 0))
    sensor = design.sensor()
    assert (sensor.guide.thickness_mm, sensor.guide.width_mm) == (10, 25)
    assert sensor.tissue.refractive_index == 1.40
    by_hand = 1 / ((1 - 0.49**2) / 27 + (1 - 0.49**2) / 5)  # 1/E* of PDMS against tissue
    assert sensor.effective_modulus_kPa == pytest.approx(by_hand, rel=1e-12)


def test_designs_are_frozen_and_replaced_ones_are_checked_again():
    design = load_design("tsis")
    with pytest.raises(dataclasses.FrozenInstanceError):
        design.name = "other"
    wider = dataclasses.replace(design.camera, field_of_view_mm=26.0)
    with pytest.raises(ValueError, match=r"camera\.field_of_view_mm"):
        dataclasses.replace(design, camera=wider)


def test_schema_is_valid_describes_every_field_and_takes_the_shipped_design(data):
    schema = design_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    jsonschema.Draft202012Validator(schema).validate(data)
    objects = [schema, *schema["$defs"].values()]
    for node in objects:
        assert node["additionalProperties"] is False
        for name, field in node["properties"].items():
            assert field.get("description", "").strip(), f"{node['title']}.{name} has no description"


def test_schema_refuses_what_the_reader_refuses(data):
    data["camera"]["bits"] = 7
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(design_schema()).validate(data)
    with pytest.raises(DesignError):
        parse_design(data)


def test_the_schema_beside_the_shipped_designs_is_current():
    """Editors read it; print it anew with: twin schema > assets/designs/schema.json"""
    stored = files("assets").joinpath("designs", "schema.json").read_text(encoding="utf-8")
    assert json.loads(stored) == design_schema()
    assert TSIS.startswith("#:schema ./schema.json\n")


def test_a_design_needs_only_what_has_no_sensible_default(data):
    for section in ("light", "glass", "surface", "press", "signal", "description", "mechanics"):
        del data[section]
    for name in list(data["camera"]):
        if name not in ("columns", "rows", "pixel_um", "field_of_view_mm"):
            del data["camera"][name]
    data["leds"] = [{"side": "+x"}]
    design = parse_design(data)
    assert design.press.indentation_mm == (2.0,) and design.mechanics == "finite"
    assert design.press.tilt_deg == design.press.position_mm == (0.0, 0.0)
    assert design.signal.displacement_um == 2.0 and design.signal.counts == 10.0


def changed(data, path, value):
    """Set (or with ... delete) the value at a dotted path."""
    *steps, last = [int(step) if step.isdigit() else step for step in path.split(".")]
    node = data
    for step in steps:
        node = node[step]
    if value is ...:
        del node[last]
    else:
        node[last] = value
    return data


BAD = [
    # field, value (... is absent), received and allowed as the line must say
    ("camera.colums", 768, "the unknown key 'colums' = 768", "one of columns, rows"),
    ("camera.columns", 768.5, "768.5", "an integer >= 1"),
    ("camera.columns", "768", "'768'", "an integer >= 1"),
    ("camera.columns", ..., "nothing", "an integer >= 1"),
    ("camera.bits", 7, "7", "an integer >= 8 and <= 16"),
    ("camera.bits", True, "True", "an integer >= 8 and <= 16"),
    ("camera.pixel_um", [8.4], "nothing", "a number >= 0.1 and <= 1000"),
    ("camera.pixel_um", 8.4, "8.4", "a list of 2, each a number >= 0.1 and <= 1000"),
    ("camera.field_of_view_mm", 26.0, "26.0", "within the guide's 25 mm"),
    ("camera.offset_dn", 255.0, "255.0", "below the 255 counts of 8 bits"),
    ("camera", ..., "nothing", "a table with the keys columns, rows"),
    ("camera", 3, "3", "a table with the keys columns, rows"),
    ("waveguide.layers.1.thickness_mm", -3.0, "-3.0", "a number >= 0.05 and <= 500"),
    ("waveguide.layers.0.poisson", 0.5, "0.5", "a number >= 0 and <= 0.4999"),
    ("waveguide.layers", [], "[]", "a list of 1 to 16"),
    ("waveguide.refractive_index", 0.9, "0.9", "a number >= 1 and <= 4"),
    ("waveguide.width_mm", float("nan"), "nan", "a finite number >= 0.05 and <= 500"),
    ("waveguide.width_mm", float("inf"), "inf", "a finite number >= 0.05 and <= 500"),
    ("waveguide.width_mm", "wide", "'wide'", "a number >= 0.05 and <= 500"),
    ("leds.2.along_mm", 12.0, "12.0", "-11.75 to 11.75 mm"),
    ("leds.2.along_mm", float("-inf"), "-inf", "a finite number"),
    ("leds.1.z_mm", -0.5, "-0.5", "-9.25 to -0.75 mm"),
    ("leds.1.z_mm", -11.0, "-11.0", "-9.25 to -0.75 mm"),
    ("leds.0.diameter_mm", 11.0, "11.0", "25 x 10 mm"),
    ("leds.0.side", "top", "'top'", "one of '+x', '-x', '+y', '-y'"),
    ("leds.0.coupling", "glue", "'glue'", "one of 'air', 'embedded'"),
    ("leds", [], "[]", "a list of 1 to 64"),
    ("surface.gap_index", 1.5, "1.5", "a number below the guide's index 1.4336"),
    ("specimen.width_mm", 20.0, "20.0", "at least the waveguide's width of 25 mm"),
    ("specimen.scattering_per_mm", 0.0, "0.0", "a number >= 0.01 and <= 1000"),
    ("specimen.absorption_per_mm", -0.1, "-0.1", "a number >= 0 and <= 1000"),
    ("specimen.anisotropy", 1.0, "1.0", "a number >= -0.9 and <= 0.99"),
    ("surface.contact", "wet", "'wet'", "one of 'rough', 'full'"),
    ("surface.dust", 1.1, "1.1", "a number >= 0 and <= 1"),
    ("surface.sheet", {"thickness_mm": 0.5}, "nothing", "a number >= 0.001 and <= 1e+07"),
    ("surface.sheet", 0.5, "0.5", "a table with the keys"),
    ("surface.sheet", {**SHEET, "thickness_mm": 0.0}, "0.0", "a number >= 0.02 and <= 50"),
    ("surface.sheet", {**SHEET, "backing": 1.5}, "1.5", "a number >= 0 and <= 1"),
    (
        "surface.sheet",
        {**SHEET, "scattering_per_mm": 0.0, "absorption_per_mm": 0.0},
        "0.0",
        "with the absorption at least 0.01 per mm",
    ),
    ("press.indentation_mm", [2.0, 7.0], "7.0", "a number >= 0.0001 and <= 6 mm"),
    ("press.indentation_mm", 2.0, "2.0", "a list of 1 to 100, each a number >= 0.0001"),
    ("press.tilt_deg", [2.0], "nothing", "a number >= -10 and <= 10"),
    ("press.tilt_deg", 2.0, "2.0", "a list of 2, each a number >= -10 and <= 10"),
    ("press.tilt_deg.1", 10.5, "10.5", "a number >= -10 and <= 10"),
    ("press.tilt_deg.0", float("nan"), "nan", "a finite number >= -10"),
    ("press.position_mm.0", "5", "'5'", "a number"),
    ("press.position_mm.1", -501.0, "-501.0", "a number >= -500 and <= 500"),
    ("press.position_mm", [0.0, -16.4], "(0.0, -16.4)", "up to 16.3 mm in x and y"),
    ("specimen.sides", "fixed", "'fixed'", "one of 'free', 'symmetric'"),
    ("mechanics", "plastic", "'plastic'", "one of 'finite', 'linear'"),
    ("mechanics", True, "True", "one of 'finite', 'linear'"),
    ("waveguide.dome_radius_mm", 0.0, "0.0", "a number >= 0.1 and <= 1e+06"),
    ("waveguide.dome_radius_mm", True, "True", "a number >= 0.1"),
    ("waveguide.dome_radius_mm", datetime.date(2020, 1, 1), "2020-01-01", "a number >= 0.1"),
    ("waveguide.dome_radius_mm", float("inf"), "inf", "a finite number >= 0.1"),
    ("waveguide.dome_radius_mm", 98.0, "98.0", "at least 98.46 mm"),  # (312.5 + 1.6²) / 3.2
    ("waveguide.dome_radius_mm", 10.0, "10.0", "at least 98.46 mm"),  # misses the corners altogether
    ("signal.counts", 0, "0", "a number >= 0.001 and <= 65535"),
    ("light.wavelength_nm", 200, "200", "a number >= 350 and <= 1100"),
    ("name", 5, "5", "a text in quotes"),
    ("name", "a\tb", "'a\\tb'", "1 to 100 characters, without control characters"),
    ("name", "", "''", "1 to 100 characters"),
    ("waveguide.layers.0.modulus_kPa", 1e8, "100000000.0", "a number >= 0.001 and <= 1e+07"),
    ("waveguide.layers.0.thickness_mm", 1e-3, "0.001", "a number >= 0.05 and <= 500"),
    ("specimen.modulus_kPa", 1e-9, "1e-09", "a number >= 0.001 and <= 1e+07"),
    ("specimen.width_mm", 301.0, "301.0", "at most 10 times its thickness, 300 mm"),
    ("glass.thickness_mm", 1e300, "1e+300", "a number >= 0.05 and <= 500"),
    ("leds.0.flux_W", 1e9, "1000000000.0", "a number >= 0 and <= 1000"),
    ("leds.0.diameter_mm", 1e-5, "1e-05", "a number >= 0.01"),
    ("leds.0.gap_mm", 1e-9, "1e-09", "a number >= 0.001 and <= 100"),
    ("camera.distance_mm", 1e-6, "1e-06", "a number >= 1 and <= 10000"),
    ("camera.f_number", 0.1, "0.1", "a number >= 0.5 and <= 64"),
    ("camera.exposure_ms", 1e9, "1000000000.0", "a number >= 0.001 and <= 100000"),
    ("camera.quantum_efficiency", 1e-9, "1e-09", "a number >= 0.001 and <= 1"),
    ("camera.full_well_e", 1, "1", "a number >= 100 and <= 1e+07"),
    ("camera.gain_e_per_dn", 1e-9, "1e-09", "a number >= 0.001 and <= 100000"),
    ("camera.read_noise_e", 1e9, "1000000000.0", "a number >= 0 and <= 10000"),
    ("camera.dark_current_e_s", 1e9, "1000000000.0", "a number >= 0 and <= 1e+06"),
    ("surface.rms_slope", 1e-6, "1e-06", "a number >= 0.01 and <= 20"),
    ("surface.rms_height_um", 1e6, "1000000.0", "a number >= 0.1 and <= 1000"),
]


@pytest.mark.parametrize(("path", "value", "received", "allowed"), BAD)
def test_every_mistake_is_one_line_with_file_field_value_and_what_is_allowed(
    data, path, value, received, allowed
):
    with pytest.raises(DesignError) as caught:
        parse_design(changed(data, path, value), "my.toml")
    line = str(caught.value)
    assert "\n" not in line
    assert line.startswith(f"my.toml: {path}")
    assert f"received {received}" in line
    assert allowed in line.split("; allowed ")[1]


def test_further_mistakes_are_counted(data):
    data["camera"]["bits"], data["camera"]["rows"], data["glass"]["thickness_mm"] = 7, 0, -1
    with pytest.raises(DesignError, match=r"camera.rows: received 0; allowed .* \(\+2 more\)$"):
        parse_design(data)


def test_embedded_led_stays_in_its_half_of_the_guide(data):
    data["leds"][0] |= {"coupling": "embedded", "gap_mm": 12.5}
    with pytest.raises(DesignError, match=r"leds.0.gap_mm: received 12.5; allowed less than 12.5 mm"):
        parse_design(data)
    data["leds"][0]["coupling"] = "air"
    parse_design(data)


def test_every_number_of_the_schema_is_bounded():
    """A slip of the unit or of the power of ten is refused, whichever value it hits."""

    def numbers(node, path=""):
        if isinstance(node, dict):
            if node.get("type") in ("number", "integer"):
                yield path, node
            for key, child in node.items():
                yield from numbers(child, f"{path}.{key}")
        elif isinstance(node, list):
            for child in node:
                yield from numbers(child, path)

    found = list(numbers(design_schema()))
    assert len(found) > 30
    for path, node in found:
        assert {"minimum", "exclusiveMinimum"} & set(node), path
        assert {"maximum", "exclusiveMaximum"} & set(node), path


@pytest.mark.parametrize(
    ("columns", "rows", "allowed"),
    [
        (5000, 4000, "at most 3200 with 5000 columns (16 million pixels)"),
        (2000, 8000, None),
        (4000, 4000, None),
    ],
)
def test_pictures_fit_the_memory(data, columns, rows, allowed):
    data["camera"] |= {"columns": columns, "rows": rows, "field_of_view_mm": 3.0}
    data["leds"].append({"side": "+x", "along_mm": 5.0})
    line = allowed or f"at most {64_000_000 // 5 // columns} with {columns} columns and 5 LEDs"
    with pytest.raises(DesignError, match=re.escape(f"camera.rows: received {rows}; allowed {line}")):
        parse_design(data)
    data["leds"].pop()
    if allowed is None:
        parse_design(data)


EMBEDDED = {"coupling": "embedded", "gap_mm": 4.0}


@pytest.mark.parametrize(
    ("one", "other", "cut"),
    [
        ({"side": "+x"}, {"side": "+x", "along_mm": 1.4}, True),
        ({"side": "+x"}, {"side": "+x", "along_mm": 1.5}, False),  # they just touch
        ({"side": "+x"}, {"side": "+x", "along_mm": 0.9, "z_mm": -6.2}, False),  # 3-4-5: 1.5 mm apart
        ({"side": "+x"}, {"side": "-x"}, False),
        ({"side": "+x"}, {"side": "+x", "gap_mm": 1.0}, False),  # one behind the other
        # Embedded 4 mm deep, the planes meet at x = y = 8.5 mm.
        ({"side": "+x", "along_mm": 8.0, **EMBEDDED}, {"side": "+y", "along_mm": 8.0, **EMBEDDED}, True),
        ({"side": "-x", "along_mm": 8.0, **EMBEDDED}, {"side": "+y", "along_mm": -8.0, **EMBEDDED}, True),
        ({"side": "+x", "along_mm": 8.0, **EMBEDDED}, {"side": "+y", "along_mm": 7.7, **EMBEDDED}, False),
        ({"side": "+x", "along_mm": 8.0, **EMBEDDED}, {"side": "-y", "along_mm": 8.0, **EMBEDDED}, False),
        (
            {"side": "+x", "along_mm": 8.0, **EMBEDDED},
            {"side": "+y", "along_mm": 8.0, "z_mm": -6.2, **EMBEDDED},
            False,
        ),
    ],
)
def test_leds_do_not_cut_each_other(data, one, other, cut):
    data["leds"] = [one, other]
    if not cut:
        parse_design(data)
        return
    with pytest.raises(
        DesignError, match=r"leds\.1: received .*; allowed a place where it does not cut leds\.0"
    ):
        parse_design(data)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[" * 20000 + "]" * 20000, "nested too deep"),
        ("a = " + "9" * 6000, "a number that is too long"),
        (TSIS.replace("columns = 768", "columns = " + "9" * 4000), "camera.columns"),
        (TSIS.replace("columns = 768", "columns = " + "9" * 6000), "a number that is too long"),
        (TSIS.replace("width_mm = 25.0", "width_mm = " + "9" * 4000), "waveguide.width_mm"),
    ],
    ids=["nested", "long", "long integer", "very long integer", "long number"],
)
def test_monstrous_files_are_one_line(text, words, tmp_path):
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    with pytest.raises(DesignError) as caught:
        load_design(tmp_path / "my.toml")
    assert words in str(caught.value) and len(str(caught.value)) < 400


def test_the_mark_of_windows_editors_is_skipped(tmp_path):
    (tmp_path / "my.toml").write_text(TSIS, encoding="utf-8-sig")
    assert load_design(tmp_path / "my.toml") == load_design("tsis")


def test_a_path_is_read_and_a_missing_one_is_named(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(TSIS.replace('name = "tsis"', 'name = "mine"'), encoding="utf-8")
    assert load_design(path).name == "mine"
    with pytest.raises(
        DesignError, match=r"absent.toml'; allowed a shipped design \(rgb, tsis, white\) or a TOML file"
    ):
        load_design(tmp_path / "absent.toml")
