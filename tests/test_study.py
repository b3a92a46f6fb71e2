"""Studies: what ships, what a file may say, and one plain line for every mistake."""

import math
from importlib.resources import files

import pytest

from twin.complaint import DesignError
from twin.design import load_design, parse_design
from twin.fields import expand, put, tables_of
from twin.plan import freeze
from twin.study import PARAMETERS, Distribution, load_study, parse_study
from twin.study_file import shipped_studies

STUDY = """
kind = "corpus"
name = "mine"
mechanics = "linear"
indentation_mm = [1, 2]

[[samples]]
name = "box"
sampler = "uniform"
count = 5
[samples.inclusion]
size_mm = [2, 13]
depth_mm = [4, 12]
modulus_kPa = 80
"""


def with_field(field, text):
    return f'{STUDY}\n[randomise."{field}"]\n{text}\n'


def test_the_shipped_studies():
    assert shipped_studies() == [
        "held-out",
        "paper",
        "paper-quick",
        "phantoms",
        "pictures",
        "quick",
        "solved",
        "training",
    ]
    for name in shipped_studies():
        assert load_study(name).study.name == name
    paper = load_study("paper").study
    assert (paper.mechanics, paper.quality, paper.indentation_mm) == ("finite", "standard", (1, 2, 3))
    box, phantoms = paper.samples
    assert (box.count, phantoms.table) == (125, "phantoms.csv")
    assert [box.inclusion.span(name) for name in PARAMETERS] == [(2, 13), (4, 12), (40, 120), (0, 0), (0, 0)]
    rows = files("assets").joinpath("studies", "phantoms.csv").read_text(encoding="utf-8").split()
    assert len(rows) == 10 and rows[0] == "size_mm,depth_mm,modulus_kPa"  # Table I


# Text of the study with a mistake, and what the line must hold: field, value received, what is allowed.
BAD = {
    "no TOML": ("kind = ", ["not TOML"]),
    "another kind": (STUDY.replace('"corpus"', '"layout"'), ["kind", "'layout'", "twin explore"]),
    "no kind": (STUDY.replace('kind = "corpus"', ""), ["kind", "nothing", "'corpus'"]),
    "unknown key": (STUDY.replace("name =", "colour = 3\nname =", 1), ["colour", "unknown key", "name"]),
    "unknown key of a group": (STUDY.replace("count", "counts"), ["samples.0.counts", "count"]),
    "unknown parameter": (STUDY.replace("size_mm", "size"), ["samples.0.inclusion.size", "size_mm"]),
    "a reversed range": (STUDY.replace("[2, 13]", "[13, 2]"), ["samples.0.inclusion.size_mm", "[13.0, 2.0]"]),
    "an empty range": (STUDY.replace("[2, 13]", "[2, 2]"), ["samples.0.inclusion.size_mm", "one number"]),
    "half a range": (
        STUDY.replace("[2, 13]", "[2]"),
        ["samples.0.inclusion.size_mm.1", "nothing", "a number"],
    ),
    "a word": (STUDY.replace("[2, 13]", '"big"'), ["samples.0.inclusion.size_mm", "'big'", "a number"]),
    "NaN": (STUDY.replace("[2, 13]", "[nan, 13]"), ["samples.0.inclusion.size_mm.0", "nan", "finite"]),
    "a negative size": (
        STUDY.replace("[2, 13]", "[-2, 13]"),
        ["samples.0.inclusion.size_mm", "-2.0", ">= 0.1"],
    ),
    "no count": (STUDY.replace("count = 5", ""), ["samples.0.count", "nothing", "'uniform'"]),
    "count of none": (STUDY.replace("count = 5", "count = 0"), ["samples.0.count", "0", ">= 1"]),
    "too many": (STUDY.replace("count = 5", "count = 10000001"), ["samples.0.count", "10000001", "1e+07"]),
    "half a sample": (STUDY.replace("count = 5", "count = 2.5"), ["samples.0.count", "2.5", "an integer"]),
    "unknown sampler": (STUDY.replace('"uniform"', '"halton"'), ["samples.0.sampler", "'halton'", "'sobol'"]),
    "too many blanks": (STUDY.replace("count = 5", "count = 5\nblanks = 1.5"), ["blanks", "1.5", "<= 1"]),
    "a table for nothing": (STUDY.replace("count = 5", 'count = 5\ntable = "a.csv"'), ["samples.0.table"]),
    "no groups": (STUDY.split("[[")[0], ["samples", "nothing"]),
    "two groups of one name": (STUDY + STUDY[STUDY.index("[[samples]]") :], ["samples.1.name", "'box'"]),
    "a level of nothing": (STUDY.replace("[1, 2]", "[1, 0]"), ["indentation_mm.1", "0", ">= 0.0001"]),
    "no level": (STUDY.replace("[1, 2]", "[]"), ["indentation_mm", "[]", "1 to 100"]),
    "unknown quality": (
        STUDY.replace("name =", 'quality = "best"\nname =', 1),
        ["quality", "'best'", "preview"],
    ),
    "a few paths": (STUDY.replace("name =", "paths = 12\nname =", 1), ["paths", "12", ">= 1024"]),
    "a negative seed": (STUDY.replace("name =", "seed = -1\nname =", 1), ["seed", "-1", ">= 0"]),
    "an emulator for nothing": (STUDY.replace("name =", 'emulator = "a.npz"\nname =', 1), ["emulator"]),
    "unknown distribution": (
        with_field("leds.*.flux_W", 'distribution = "cauchy"'),
        ["randomise.leds.*.flux_W.distribution", "'cauchy'", "'lognormal'"],
    ),
    "no spread": (with_field("leds.*.flux_W", 'distribution = "normal"'), ["leds.*.flux_W.sd", "nothing"]),
    "too much": (
        with_field("leds.*.flux_W", 'distribution = "lognormal"\nsd = 0.1\nlow = 1.0'),
        ["leds.*.flux_W.low", "sd, relative"],
    ),
    "a reversed distribution": (
        with_field("leds.*.flux_W", 'distribution = "uniform"\nlow = 2.0\nhigh = 1.0'),
        ["leds.*.flux_W.low", "2.0", "below high = 1"],
    ),
    "a spread of NaN": (
        with_field("leds.*.flux_W", 'distribution = "normal"\nsd = nan'),
        ["leds.*.flux_W.sd", "nan", "finite"],
    ),
    "a negative spread": (
        with_field("leds.*.flux_W", 'distribution = "normal"\nsd = -1.0'),
        ["leds.*.flux_W.sd", "-1.0", ">= 0"],
    ),
    "a grid without modulus": (
        STUDY.replace('"uniform"\ncount = 5', '"grid"').replace("inclusion]", "grid]").replace("80", "[]"),
        ["samples.0.grid.modulus_kPa", "[]"],
    ),
}


@pytest.mark.parametrize("case", BAD)
def test_mistakes_of_a_study_are_one_line(case):
    text, words = BAD[case]
    with pytest.raises(DesignError) as caught:
        parse_study(text, "mine.toml")
    line = str(caught.value)
    assert "\n" not in line and line.startswith("mine.toml: ")
    assert not [word for word in words if word not in line], line


# Field, distribution, and what the line must hold: found when the design is known.
UNFIT = {
    "no such field": ("camera.gian", {"sd": 1}, ["camera.gian", "'gian'", "gain_e_per_dn"]),
    "no such table": ("camra.gain", {"sd": 1}, ["'camra'", "camera"]),
    "no such LED": ("leds.4.flux_W", {"sd": 1}, ["'4'", "0 to 3"]),
    "beyond a number": ("camera.f_number.x", {"sd": 1}, ["camera.f_number.x", "nothing lies below"]),
    "a word": ("leds.*.side", {"sd": 1}, ["leds.0.side", "'+x'", "one number"]),
    "a list": ("press.tilt_deg", {"sd": 1}, ["press.tilt_deg", "one number"]),
    "a switch": ("camera.vignetting", {"sd": 1}, ["camera.vignetting", "False"]),
    "an integer": ("camera.pattern_seed", {"sd": 1}, ["'normal'", "'integer' or 'choice'"]),
    "not set": ("waveguide.dome_radius_mm", {"sd": 1}, ["waveguide.dome_radius_mm", "does not set"]),
    "nothing to multiply": ("leds.*.along_mm", {"sd": 1, "relative": True}, ["leds.0.along_mm = 0"]),
    "the picture's size": ("camera.bits", {"distribution": "choice", "of": (8,)}, ["camera.bits"]),
    "the threshold": ("signal.counts", {"sd": 1}, ["signal.counts", "differ from picture"]),
    "all levels by one depth": ("press.indentation_mm", {"sd": 1}, ["relative", "press.indentation_mm.*"]),
    "a part of nothing": ("surface.sheet.thickness_mm", {"sd": 1}, ["surface.sheet", "nothing lies below"]),
}


@pytest.mark.parametrize("case", UNFIT)
def test_fields_that_do_not_suit_the_design_are_one_line(case):
    field, about, words = UNFIT[case]
    with pytest.raises(DesignError) as caught:
        expand(tables_of(load_design("tsis")), {field: Distribution(**{"distribution": "normal", **about})})
    line = str(caught.value)
    assert line.startswith("randomise.") and "\n" not in line
    assert not [word for word in words if word not in line], line


def test_a_star_is_every_element_and_a_field_is_said_once():
    tables, spread = tables_of(load_design("tsis")), Distribution("normal", sd=0.1, relative=True)
    found = expand(tables, {"leds.*.flux_W": spread, "press.indentation_mm": spread})
    # the press's common factor comes first, and its levels share one stream
    assert [one.field for one in found][:2] == ["press.indentation_mm.0", "leds.0.flux_W"]
    assert len(found) == 5 and [one.base for one in found[1:]] == [0.01] * 4
    with pytest.raises(DesignError, match=r"leds\.0\.flux_W again; allowed it once"):
        expand(tables, {"leds.*.flux_W": spread, "leds.0.flux_W": spread})
    absolute = Distribution("normal", sd=0.1)
    with pytest.raises(DesignError, match=r"true beside randomise\.press\.indentation_mm"):
        expand(tables, {"press.indentation_mm.*": absolute, "press.indentation_mm": spread})


@pytest.mark.parametrize("name", ["tsis", "white", "rgb"])
def test_tables_of_a_design_are_the_design(name):
    design = load_design(name)
    tables = tables_of(design)
    assert parse_design(tables) == design
    changed = parse_design(put(tables, [("leds.1.gap_mm", 0.25), ("camera.pattern_seed", 7.0)]))
    assert changed.leds[1].gap_mm == 0.25 and changed.camera.pattern_seed == 7
    assert tables_of(design) == tables  # what was given stays as it is


def freezing(tmp_path, text, **options):
    (tmp_path / "study.toml").write_text(text)
    return freeze(tmp_path / "study.toml", tmp_path / "corpus", **options)


# Study, and what the line must hold: found when samples are drawn.
IMPOSSIBLE = {
    "through the chest wall": (
        STUDY.replace("[2, 13]", "[20, 22]").replace("[4, 12]", "[10, 12]"),
        ["samples.0", "draws cannot be simulated", "chest wall"],
    ),
    "too deep a press": (
        STUDY.replace("[1, 2]", "[1, 7]"),
        ["study.toml: indentation_mm.1", "7.0", "<= 6 mm"],
    ),
    "no such design": (STUDY.replace("name =", 'design = "a.toml"\nname =', 1), ["DESIGN", "a.toml"]),
    "no such emulator": (STUDY.replace('"linear"', '"emulator"'), ["emulator", "tsis.npz", "twin emulate"]),
    "no such table": (
        STUDY.split("[[")[0] + '[[samples]]\nname = "t"\nsampler = "table"\ntable = "none.csv"',
        ["table", "none.csv", "can be read"],
    ),
    "LEDs off the guide": (
        with_field("leds.*.z_mm", 'distribution = "uniform"\nlow = -20.0\nhigh = -11.0'),
        ["samples.0", "leds.0.z_mm", "stays on the guide"],
    ),
    "bounds far off": (
        with_field("leds.*.flux_W", 'distribution = "normal"\nsd = 0.01\nrelative = true\nlow = 2.0'),
        ["randomise.leds.0.flux_W.low", "around 1"],
    ),
}


@pytest.mark.parametrize("case", IMPOSSIBLE)
def test_studies_that_cannot_be_simulated_are_one_line_and_leave_nothing(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("twin.learned.shipped", list)
    text, words = IMPOSSIBLE[case]
    with pytest.raises(DesignError) as caught:
        freezing(tmp_path, text)
    line = str(caught.value)
    assert "\n" not in line and not [word for word in words if word not in line], line
    assert [entry.name for entry in tmp_path.iterdir()] == ["study.toml"]


def table(tmp_path, text):
    (tmp_path / "t.csv").write_text(text)
    head = STUDY.split("[[")[0]
    return freezing(tmp_path, head + '[[samples]]\nname = "t"\nsampler = "table"\ntable = "t.csv"')


def test_a_table_gives_blanks_offsets_and_fields_of_the_design(tmp_path):
    plan = table(
        tmp_path,
        "size_mm,depth_mm,modulus_kPa,offset_x_mm,camera.exposure_ms\n8,5,100,,5\n\n,,,,\n6,4,40,-2,7\n",
    )
    assert len(plan) == 3 and plan.inclusion(1) is None
    assert plan.inclusion(0).offset == (0, 0) and plan.inclusion(2).offset == (-2, 0)
    assert [plan.design(n).camera.exposure_ms for n in range(3)] == [5, 6, 7]  # 6 is the design's
    assert math.isnan(plan.columns["size_mm"][1]) and plan.parameters(1)["size_mm"] is None
    assert plan.groups[0].fields == ("camera.exposure_ms",)


HEADER = "size_mm,depth_mm,modulus_kPa"
ROWS = {
    "empty": ("", ["the first line", "no size_mm"]),
    "no rows": (HEADER, ["rows", "none"]),
    "no depth": ("size_mm,modulus_kPa\n8,100", ["no depth_mm"]),
    "unknown column": (f"{HEADER},colour\n8,5,100,1", ["'colour'", "dotted fields"]),
    "unknown field": (f"{HEADER},camera.x\n8,5,100,1", ["'x'", "gain_e_per_dn"]),
    "a column twice": (f"{HEADER},size_mm\n8,5,100,8", ["'size_mm' twice"]),
    "a word": (f"{HEADER}\n8,5,stiff", ["line 2, modulus_kPa", "'stiff'", "finite number"]),
    "NaN": (f"{HEADER}\n8,nan,100", ["line 2, depth_mm", "'nan'"]),
    "half a row": (f"{HEADER}\n8,5,100\n8,5", ["line 3", "2 values", "3"]),
    "half a blank": (f"{HEADER}\n,5,", ["line 2, depth_mm", "'5'", "nothing where size_mm is empty"]),
    "a negative size": (f"{HEADER}\n-8,5,100", ["line 2, size_mm", "-8.0", ">= 0.1"]),
    "through the wall": (f"{HEADER}\n8,5,100\n18,15,100", ["samples.0, sample 1", "chest wall"]),
}


@pytest.mark.parametrize("case", ROWS)
def test_mistakes_of_a_table_are_one_line(case, tmp_path):
    text, words = ROWS[case]
    with pytest.raises(DesignError) as caught:
        table(tmp_path, text)
    line = str(caught.value)
    assert "\n" not in line and not [word for word in words if word not in line], line
