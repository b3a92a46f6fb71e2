"""Layout studies: what is refused, in one line; what fields mean; what kind each one is."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import twin
from twin import evaluate, explore, explore_leds, layout_fields
from twin.bench import optical_key
from twin.cli import main
from twin.complaint import DesignError
from twin.design import parse_design
from twin.explored import design_toml
from twin.layout_study import load, parse
from twin.study_file import shipped_studies

TEXT = """
kind = "layout"
name = "small"
constraints = ["led_power_W <= 0.1"]
[fields]
"leds.*.z_mm" = [-8.0, -2.0]
"layout.leds" = [1, 8]
"protocol.frames" = { choices = [1, 16] }
[objectives]
bound_modulus_kPa = "minimize"
[search]
method = "latin"
trials = 4
"""


def test_the_shipped_studies_can_be_explored():
    assert shipped_studies("layout") == ["camera", "layers", "leds", "places", "protocol", "surface"]
    for name in shipped_studies("layout"):
        source = load(name)
        assert source.study.question
        assert explore.checked(source, None, None).trials >= (3 if name == "places" else 16)


@pytest.mark.parametrize(
    ("before", "after", "words"),
    [
        ('"leds.*.z_mm"', '"leds.*.height"', ["fields.leds.*.height", "z_mm"]),
        ('"leds.*.z_mm"', '"nothing"', ["fields.nothing", "layout.leds"]),
        ('"layout.leds"', '"layout.lamps"', ["fields.layout.lamps", "layout.power_W"]),
        ("[-8.0, -2.0]", "[-2.0, -8.0]", ["fields.leds.*.z_mm", "[-2.0, -8.0]", "first below"]),
        ("[-8.0, -2.0]", "{ choices = [] }", ["fields.leds.*.z_mm"]),
        ("[-8.0, -2.0]", "{ choices = [-1.0, -1.0] }", ["twice"]),
        ("[-8.0, -2.0]", "[1.0, 2.0]", ["leds.0.z_mm", "< 0"]),
        ("[1, 8]", "[1.5, 8.0]", ["whole numbers"]),
        ("trials = 4", "trials = 0", ["search.trials", ">= 1"]),
        ("trials = 4", "", ["search.trials", "nothing"]),
        ('"latin"', '"random"', ["search.method", "'nsga2'"]),
        ('= "minimize"', '= "least"', ["objectives.bound_modulus_kPa", "'maximize'"]),
        ("bound_modulus_kPa =", "brightness =", ["objectives.brightness", "snr"]),
        ('0.1"]', '0.1", "led_power_W >= 0.2"]', ["constraints.1", "both be met"]),
        ('"led_power_W <= 0.1"', '"saturated_percent >= 101"', ["constraints.0", "0 to 100"]),
        ('"led_power_W <= 0.1"', '"led_power_W < 0.1"', ["constraints.0", "<= NUMBER"]),
        ('"layout"', '"corpus"', ["kind", "twin corpus plan"]),
        ('name = "small"', 'name = "small"\ncolour = 1', ["colour", "unknown key"]),
        ("[search]", "[[unknowns]]\nname='surface.dust'\nsd=0.1\n[search]", ["unknowns", "'surface.dust'"]),
        (
            "[search]",
            "[[inclusions]]\nsize_mm=9.0\ndepth_mm=25.0\nmodulus_kPa=80.0\n[search]",
            ["inclusion.depth", "chest wall"],
        ),
        ("[search]", "[protocol]\nindentation_mm=[40.0]\n[search]", ["protocol.indentation_mm", "40"]),
        ("[search]", '[set]\n"press.tilt_deg" = [1.0, 0.0]\n[search]', ["press.tilt_deg", "(1.0, 0.0)"]),
        ("[search]", '[set]\n"press.position_mm" = [0.0, 2.0]\n[search]', ["press.position_mm", "(0, 0)"]),
        ("[1, 16]", '["a"]', ["fields.protocol.frames", "'a'", ">= 1 and <= 10000"]),
        ("[1, 16]", "[[1], {}]", ["fields.protocol.frames", "an integer"]),
        ("[1, 16]", "[0, -4, 1.5, true, 10000000]", ["fields.protocol.frames", ">= 1 and <= 10000"]),
        ("{ choices = [1, 16] }", "[20000, 30000]", ["fields.protocol.frames", "<= 10000"]),
        (
            '"layout.leds" = [1, 8]',
            '"layout.arrangement" = { choices = [["around"], {}, 1] }',
            ["fields.layout.arrangement", "one of around, facing, one side"],
        ),
    ],
)
def test_a_mistake_is_one_line(tmp_path, capsys, before, after, words):
    assert before in TEXT
    file = tmp_path / "study.toml"
    file.write_text(TEXT.replace(before, after, 1))
    assert main(["explore", str(file), "--out", str(tmp_path / "out")]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and line.startswith("twin explore: ") and "study.toml" in line, line
    assert all(word in line for word in words), line
    assert not (tmp_path / "out").exists()


def test_a_study_of_one_kind_says_where_it_belongs(tmp_path, capsys):
    file = tmp_path / "study.toml"
    file.write_text(TEXT)
    assert main(["corpus", "plan", str(file), "--out", str(tmp_path / "out")]) == 2
    assert "twin explore" in capsys.readouterr().err


def test_a_fields_kind_is_what_it_changes():
    kinds = {
        "camera.bits": ({"choices": [8, 12]}, "camera"),
        "camera.read_noise_e": ([5.0, 20.0], "camera"),
        "protocol.frames": ([1, 16], "camera"),
        "camera.field_of_view_mm": ([18.0, 25.0], "optical"),
        "leds.*.z_mm": ([-8.0, -2.0], "optical"),
        "layout.leds": ([1, 8], "optical"),
        "surface.rms_slope": ([1.0, 3.0], "optical"),
        "protocol.indentation_mm": ({"choices": [[1.0], [1.0, 2.0]]}, "optical"),
        "press.indentation_mm": ({"choices": [[1.0], [1.0, 2.0]]}, "optical"),
        "waveguide.layers.0.modulus_kPa": ([10.0, 50.0], "mechanical"),
        "layout.layers": ({"choices": [[[5.0, 20.0]], [[2.0, 20.0], [8.0, 100.0]]]}, "mechanical"),
        "specimen.thickness_mm": ([25.0, 40.0], "mechanical"),
    }
    design, study = twin.load_design("tsis"), parse(TEXT)
    for name, (said, kind) in kinds.items():
        one = layout_fields.axis("fields", said)
        study_here = type(study)(**{**vars(study), "fields": {name: said}})
        assert layout_fields.kind_of(study_here, design, name, one) == kind, name


def test_fields_make_the_sensor_that_they_say():
    study, design = parse(TEXT), twin.load_design("tsis")
    made = layout_fields.layout(study, design, {"layout.leds": 6, "leds.*.z_mm": -3.0, "protocol.frames": 16})
    sides = [led.side for led in made.design.leds]
    assert sides == ["+x", "-x", "+y", "-y", "+x", "-x"]
    assert {led.z_mm for led in made.design.leds} == {-3.0}
    assert made.protocol.frames == 16
    frames = layout_fields.layout(study, design, {"protocol.frames": 16.0}).protocol.frames
    assert frames == 16 and isinstance(frames, int)
    on_x = sorted(led.along_mm for led in made.design.leds if led.side == "+x")
    assert on_x == pytest.approx([-6.25, 6.25])
    with pytest.raises(DesignError, match="z_mm"):
        layout_fields.layout(study, design, {"leds.*.z_mm": -9.9})


def test_a_trial_is_pressed_as_deep_as_the_studys_own_design():
    study, design = parse(TEXT + '[set]\n"press.indentation_mm" = [1.0]\n'), twin.load_design("tsis")
    assert layout_fields.base(study, design).protocol.indentation_mm == (1.0,)
    assert layout_fields.layout(study, design, {}).protocol.indentation_mm == (1.0,)


def test_a_protocol_that_says_nothing_of_exposures_takes_the_designs():
    study, design = parse(TEXT + '[set]\n"camera.frames" = 100\n'), twin.load_design("tsis")
    assert layout_fields.base(study, design).protocol.frames == 100
    assert layout_fields.layout(study, design, {}).protocol.frames == 100
    assert layout_fields.layout(study, design, {"protocol.frames": 4}).protocol.frames == 4


def test_the_light_of_layered_guides_is_kept_apart():
    """Layers of other index are not in the guide's own words, by which light is kept."""
    design = twin.load_design("tsis")

    def key(index: float | None):
        layers = design.waveguide.layers
        guide = replace(
            design.waveguide, layers=(layers[0], replace(layers[1], refractive_index=index), layers[2])
        )
        return repr(optical_key(replace(design, waveguide=guide)))

    assert len({key(None), key(1.38), key(1.5)}) == 3


def test_exposures_leave_room_for_stray_light():
    """As bright again as the LEDs: together they fill the share of the range that is asked for."""
    design = twin.load_design("tsis")
    light = 0.2 + np.zeros((1, len(design.leds), *design.camera.shape))
    stray = replace(design, camera=replace(design.camera, ambient=float(light[0, :, 0, 0].sum())))
    alone, both = (evaluate._exposed(one, one, 0.8, [light]) for one in (design, stray))
    assert both.camera.exposure_ms == pytest.approx(alone.camera.exposure_ms / 2, rel=2e-3)


def test_a_failed_led_has_no_settings(monkeypatch):
    lamps = [SimpleNamespace(count=2, flux_W=np.array([0.01, 0.0]))]
    monkeypatch.setattr(explore_leds.lamps, "lamps_of", lambda evaluation: lamps)
    one = SimpleNamespace(names=("size_mm", "camera.gain_e_per_dn"), layer_jacobian=np.zeros(1))
    assert explore_leds.findings(SimpleNamespace(judged=[one])) is None


def test_layers_of_their_own_index_are_not_dropped_in_silence():
    design = twin.load_design("tsis")
    first, *rest = design.waveguide.layers
    own = replace(first, refractive_index=1.42)
    base = replace(design, waveguide=replace(design.waveguide, layers=(own, *rest)))
    with pytest.raises(DesignError, match=r"fields\.layout\.layers: .*indices of their own"):
        layout_fields.changed_design(base, {"layout.layers": [[5.0, 20.0]]}, "fields")


def test_a_written_design_is_read_as_it_was():
    import tomllib

    for name in ("tsis", "white", "rgb"):
        design = twin.load_design(name)
        assert parse_design(tomllib.loads(design_toml(design))) == design
