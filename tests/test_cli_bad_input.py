"""Bad input: exit status 2, one line with field, value and what is allowed, and nothing left behind."""

import os
import subprocess
import sys
from importlib.resources import files
from pathlib import Path

import pytest

import fem
from scenes.camera import CameraError
from twin import cli

TSIS = files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8")
PRESS = ["simulate", "--size", "10", "--depth", "5", "--modulus", "100"]
FINE = [*PRESS, "--out", "out"]
EXPORT = ["export", *PRESS[1:]]


def mine(old, new):
    """Return the shipped design with one text replaced."""
    assert old in TSIS
    return TSIS.replace(old, new, 1)


# Arguments, and what the line must hold: field, value received, what is allowed.
FLAGS = {
    "unknown verb": (["simulat"], ["VERB", "'simulat'", "demo", "simulate", "export", "schema"]),
    "unknown flag": ([*FINE, "--sise", "3"], ["--sise", "--help"]),
    "shortened flag": ([*FINE, "--qual", "preview"], ["--qual"]),
    "no size": (["simulate", "--depth", "5", "--modulus", "9", "--out", "out"], ["--size", "nothing", "> 0"]),
    "no modulus": (
        ["simulate", "--size", "5", "--depth", "5", "--out", "out"],
        ["--modulus", "nothing", "> 0"],
    ),
    "no out": (PRESS, ["--out", "nothing", "folder"]),
    "negative size": ([*FINE, "--size", "-3"], ["--size", "'-3'", "> 0"]),
    "size is a word": ([*FINE, "--size", "big"], ["--size", "'big'", "> 0"]),
    "size is not a number": ([*FINE, "--size", "nan"], ["--size", "'nan'", "finite number"]),
    "infinite modulus": ([*FINE, "--modulus", "inf"], ["--modulus", "'inf'", "finite number"]),
    "size without value": ([*FINE, "--size"], ["--size", "no value"]),
    "zero indentation": ([*FINE, "--indentation", "0"], ["--indentation", "'0'", "> 0"]),
    "one of several indentations": ([*FINE, "--indentation", "1", "-2"], ["--indentation", "'-2'", "> 0"]),
    "indentation without value": ([*FINE, "--indentation"], ["--indentation", "no value"]),
    "too deep a press": ([*FINE, "--indentation", "1", "6.5"], ["--indentation", "6.5", "<= 6 mm"]),
    "negative force": ([*FINE, "--force", "-1"], ["--force", "'-1'", "> 0"]),
    "indentation and force": ([*FINE, "--indentation", "1", "--force", "1"], ["--force", "--indentation"]),
    "unknown quality": (
        [*FINE, "--quality", "best"],
        ["--quality", "'best'", "preview, standard, reference"],
    ),
    "unknown device": ([*FINE, "--device", "tpu"], ["--device", "'tpu'", "auto, cpu, cuda"]),
    "noise next to nothing": ([*FINE, "--noise", "1e-300"], ["--noise", "'1e-300'", ">= 0.001"]),
    "a design without end": (["simulate", "/dev/zero", *FINE[1:]], ["/dev/zero", "more than 1000000 bytes"]),
    "seed is not whole": ([*FINE, "--seed", "1.5"], ["--seed", "'1.5'", "an integer"]),
    "negative seed": ([*FINE, "--seed", "-1"], ["--seed", "'-1'", "an integer"]),
    "touches the chest wall": ([*FINE, "--depth", "20"], ["--depth", "20.0", "30 mm", "chest wall"]),
    "leaves the slab": ([*FINE, "--offset", "28", "0"], ["--offset", "(28.0, 0.0)", "less than 25 mm"]),
    "beside the probe": ([*FINE, "--offset", "13", "0"], ["--offset", "(13.0, 0.0)", "up to 12.5 mm"]),
    "a tilt too steep": ([*FINE, "--tilt", "0", "12"], ["--tilt", "12.0", "<= 10"]),
    "half a tilt": ([*FINE, "--tilt", "1"], ["--tilt", "number of values", "2"]),
    "a tilt in words": ([*FINE, "--tilt", "1", "left"], ["--tilt", "'left'", "a finite number"]),
    "off the specimen": ([*FINE, "--position", "17", "0"], ["--position", "(17.0, 0.0)", "up to 16.3 mm"]),
    "a position like no other": ([*FINE, "--position", "0", "1e9"], ["--position", "1000000000.0", "<= 500"]),
    "pressed where the inclusion is not": (
        [*FINE, "--position", "16", "0", "--offset", "12", "0"],
        ["--offset", "(12.0, 0.0)", "less than 25 mm", "at 16 mm"],
    ),
    "a stretch of nothing": ([*FINE, "--stretch", "1", "0", "1"], ["--stretch", "'0'", "> 0"]),
    "a stretch too long": ([*FINE, "--stretch", "1", "6", "1"], ["--stretch", "6.0", "<= 5"]),
    "two stretches": ([*FINE, "--stretch", "1", "2"], ["--stretch", "number of values", "3"]),
    "a stretch of none": (
        ["simulate", "--no-inclusion", "--stretch", "1", "1", "2", "--out", "out"],
        ["--stretch", "--no-inclusion"],
    ),
    "stretched to the chest wall": (
        [*FINE, "--stretch", "1", "1", "2.5"],
        ["--size", "10.0", "25 + 5 mm", "30 mm", "chest wall"],
    ),
    "stretched beyond the probe": (
        [*FINE, "--stretch", "2.4", "1", "1"],
        ["--size", "10.0", "22.5 mm", "24 mm"],
    ),
    "unknown mechanics": ([*FINE, "--mechanics", "plastic"], ["--mechanics", "'plastic'", "finite, linear"]),
    "an emulator that is not there": (
        [*FINE, "--mechanics", "emulator", "--emulator", "no/such.npz"],
        ["--emulator", "'no/such.npz'", "twin emulate"],
    ),
    "an emulator that is none": (
        [*FINE, "--mechanics", "emulator", "--emulator", "."],
        ["--emulator", "'.'", "twin emulate"],
    ),
    "traced light that is not there": (
        [*FINE, "--traced", "no/such.npz"],
        ["traced", "'no/such.npz'", "--light"],
    ),
    "traced light that is none": ([*FINE, "--traced", "."], ["traced", "'.'", "--light"]),
    "traced light and its noise": ([*FINE, "--traced", "a.npz", "--noise", "1"], ["traced", "with noise"]),
    "traced light at reference quality": (
        [*FINE, "--traced", "a.npz", "--quality", "reference"],
        ["traced", "reference quality"],
    ),
    "training on next to nothing": (
        ["train", "c", "--samples", "3", "--out", "m"],
        ["--samples", "3", ">= 30"],
    ),
    "a calibration without a place": (["calibrate", "m", "c"], ["--out", "the model to write"]),
    "a calibration by no corpus": (
        ["calibrate", "m", "c", "--out", "a"],
        ["CORPUS", "'c'", "folder of a corpus"],
    ),
    "a calibration by no samples": (
        ["calibrate", "m", "c", "--samples", "0", "--out", "a"],
        ["--samples", ">= 1"],
    ),
    "an assessment without a place": (["assess", "m", "c"], ["--out", "folder"]),
    "an assessment of no corpus": (
        ["assess", "m", "c", "--out", "a"],
        ["CORPUS", "'c'", "folder of a corpus"],
    ),
    "an assessment of no samples": (
        ["assess", "m", "c", "--samples", "0", "--out", "a"],
        ["--samples", ">= 1"],
    ),
    "an emulator without its mechanics": (
        [*FINE, "--emulator", "a.npz"],
        ["--emulator", "--mechanics emulator"],
    ),
    "export by an emulator": (
        [*EXPORT, "--mechanics", "emulator", "--vtu", "a.vtu"],
        ["--mechanics", "finite, linear"],
    ),
    "export of nothing": (EXPORT, ["--vtu, --ccx", "nothing", "one of them"]),
    "export of two": ([*EXPORT, "--vtu", "a.vtu", "--ccx", "a"], ["--ccx", "--vtu"]),
    "a deck that comes back up": (
        [*EXPORT, "--indentation", "2", "1", "--ccx", "a"],
        ["--indentation", "[2.0, 1.0]", "depths that rise"],
    ),
    "a linear deck that is tilted": (
        [*EXPORT, "--mechanics", "linear", "--tilt", "1", "0", "--ccx", "a"],
        ["--mechanics", "'linear' with a tilt", "'finite'"],
    ),
    "another suffix": ([*EXPORT, "--vtu", "a.vtk"], ["--vtu", "'a.vtk'", "ends in .vtu"]),
    "a suffix alone": ([*EXPORT, "--vtu", ".vtu"], ["--vtu", "'.vtu'", "ends in .vtu"]),
    "a name that cannot be a file": ([*EXPORT, "--vtu", "a\0b.vtu"], ["--vtu", "a file"]),
    "two depths in one file": (
        [*EXPORT, "--indentation", "1", "2", "--vtu", "a.vtu"],
        ["--indentation", "[1.0, 2.0]", "one depth"],
    ),
    "too deep an export": (
        [*EXPORT, "--indentation", "7", "--vtu", "a.vtu"],
        ["--indentation", "7.0", "<= 6"],
    ),
    "export by force": ([*EXPORT, "--force", "1", "--vtu", "a.vtu"], ["--force", "--help"]),
    "half an offset": ([*FINE, "--offset", "1"], ["--offset", "number of values", "2"]),
    "inclusion and none": ([*FINE, "--no-inclusion"], ["--size", "--no-inclusion"]),
    "a tiny inclusion": ([*FINE, "--size", "0.01"], ["--size", "0.01", ">= 0.1"]),
    "an absurd modulus": ([*FINE, "--modulus", "1e30"], ["--modulus", "1e+30", "<= 1e+07"]),
    "an absurd offset": ([*FINE, "--offset", "0", "1e9"], ["--offset", "1000000000.0", "<= 500"]),
    "a tiny force": ([*FINE, "--force", "1e-9"], ["--force", "1e-09", ">= 0.0001"]),
    "a tiny indentation": ([*FINE, "--indentation", "1e-9"], ["--indentation", "1e-09", ">= 0.0001"]),
    "a design after the levels": (
        ["simulate", "--indentation", "1", "2", "tsis", *FINE[1:]],
        ["--indentation", "'tsis'", "DESIGN goes first", "twin simulate tsis --indentation"],
    ),
    "empty out": ([*PRESS, "--out", ""], ["--out", "an empty name", "folder"]),
    "long out": ([*PRESS, "--out", "o" * 300], ["--out", "folder", "name too long"]),
    "an out that cannot be": ([*PRESS, "--out", "a\0b"], ["--out", "folder"]),
    "empty design": (["simulate", "", *FINE[1:]], ["DESIGN", "an empty name", "TOML file"]),
    "unknown design": (["simulate", "tsi", *FINE[1:]], ["DESIGN", "'tsi'", "tsis"]),
    "missing file": (["simulate", "no/such.toml", *FINE[1:]], ["DESIGN", "'no/such.toml'", "TOML file"]),
    "a folder as design": (["simulate", ".", *FINE[1:]], ["DESIGN", "'.'", "a TOML file"]),
    "a name that cannot be": (["simulate", "a\0b", *FINE[1:]], ["DESIGN", "TOML file"]),
    "demo with an unknown flag": (["demo", "--size", "3"], ["--size"]),
    "schema with an argument": (["schema", "tsis"], ["tsis"]),
}

# A design file, and what the line must hold.
DESIGNS = {
    "unknown key": (mine("columns = 768", "colums = 768"), ["camera.colum", "columns"]),
    "unknown section": (TSIS + "\n[lens]\nfocal_mm = 10\n", ["lens", "unknown key"]),
    "wrong type": (mine("columns = 768", 'columns = "768"'), ["camera.columns", "'768'", "an integer"]),
    "negative thickness": (
        mine("thickness_mm = 3.0", "thickness_mm = -3.0"),
        ["waveguide.layers.1", "-3.0", ">= 0.05"],
    ),
    "index below 1": (
        mine("refractive_index = 1.4336", "refractive_index = 0.9"),
        ["waveguide", "0.9", ">= 1"],
    ),
    "LED beside the guide": (mine("along_mm = 0.0", "along_mm = 12.0"), ["leds.0.along_mm", "12.0", "11.75"]),
    "LED below the guide": (mine("z_mm = -5.0", "z_mm = -10.0"), ["leds.0.z_mm", "-10.0", "-9.25"]),
    "not a number": (mine("width_mm = 25.0", "width_mm = nan"), ["waveguide.width_mm", "nan", "finite"]),
    "missing section": (mine("[specimen]", "[signals]"), ["specimen", "nothing", "table"]),
    "field wider than the guide": (
        mine("field_of_view_mm = 25.0", "field_of_view_mm = 25.1"),
        ["camera.field_of_view_mm", "25.1", "25 mm"],
    ),
    "not TOML": (mine("columns = 768", "columns 768"), ["line 9", "TOML"]),
    "a key twice": (mine("columns = 768", "rows = 768"), ["line ", "TOML"]),
    "a date as name": (mine('name = "tsis"', "name = 2020-01-01"), ["name", "2020", "text"]),
    "a steep dome": (
        mine("width_mm = 25.0", "width_mm = 25.0\ndome_radius_mm = 60.0"),
        ["waveguide.dome_radius_mm", "60.0", "at least 98.46 mm"],
    ),
    "a tilt that is a number": (mine("tilt_deg = [0.0, 0.0]", "tilt_deg = 2.0"), ["press.tilt_deg", "2.0"]),
    "unknown sides": (
        mine('sides = "free"', 'sides = "glued"'),
        ["specimen.sides", "'glued'", "'symmetric'"],
    ),
    "a nested surprise": (
        mine("anisotropy = 0.0", "anisotropy = {a = [1, {b = 2}]}"),
        ["specimen.anisotropy", "a number"],
    ),
    "nothing at all": ("", ["nothing", "(+4 more)"]),
}


def only_line(status, out, err, folder, before):
    """Check what holds for every mistake and return the line."""
    assert status == 2
    assert out == ""
    lines = err.splitlines()
    assert len(lines) == 1, err
    assert "Traceback" not in err
    assert sorted(folder.rglob("*")) == before
    return lines[0]


def run(arguments, folder, monkeypatch, capfd):
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    capfd.readouterr()
    status = cli.main(arguments)
    out, err = capfd.readouterr()
    return only_line(status, out, err, folder, before)


@pytest.mark.parametrize(("arguments", "words"), FLAGS.values(), ids=FLAGS.keys())
def test_flags(arguments, words, tmp_path, monkeypatch, capfd):
    line = run(arguments, tmp_path, monkeypatch, capfd)
    assert line.startswith("twin")
    for word in words:
        assert word in line


@pytest.mark.parametrize(("text", "words"), DESIGNS.values(), ids=DESIGNS.keys())
def test_design_files(text, words, tmp_path, monkeypatch, capfd):
    (tmp_path / "my.toml").write_text(text, encoding="utf-8")
    line = run(["simulate", "my.toml", *FINE[1:]], tmp_path, monkeypatch, capfd)
    for word in ["my.toml", "received", "allowed", *words]:
        assert word in line


def test_a_design_that_is_not_text(tmp_path, monkeypatch, capfd):
    (tmp_path / "my.toml").write_bytes(b"\xff\xfe\x00")
    assert "UTF-8" in run(["simulate", "my.toml", *FINE[1:]], tmp_path, monkeypatch, capfd)


def _file(folder):
    (folder / "out").write_text("mine")


def _foreign_folder(folder):
    (folder / "out").mkdir()
    (folder / "out" / "thesis.tex").write_text("mine")


def _parent_is_a_file(folder):
    (folder / "out").write_text("mine")
    return "out/deeper/still"


def _dangling_link(folder):
    (folder / "out").symlink_to(folder / "nowhere")


@pytest.mark.parametrize("prepare", [_file, _foreign_folder, _parent_is_a_file, _dangling_link])
def test_places_that_cannot_take_the_result(prepare, tmp_path, monkeypatch, capfd):
    out = prepare(tmp_path) or "out"
    line = run([*PRESS, "--out", out], tmp_path, monkeypatch, capfd)
    assert "--out" in line and repr(out) in line and "folder" in line
    if not (tmp_path / "out").is_symlink():
        kept = tmp_path / "out" if (tmp_path / "out").is_file() else tmp_path / "out" / "thesis.tex"
        assert kept.read_text() == "mine"


@pytest.mark.parametrize(
    ("error", "status", "words"),
    [
        (CameraError("radiance: received nan,\nallowed: numbers"), 2, "radiance: received nan, allowed"),
        (fem.NotModelled("press: received too much"), 2, "press: received too much"),
        (MemoryError(), 1, "not enough memory"),
    ],
)
def test_failures_on_the_way_are_one_line(error, status, words, tmp_path, monkeypatch, capfd):
    def fail(*args, **options):
        raise error

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(cli, "simulate", fail)
    assert cli.main(FINE) == status
    printed = capfd.readouterr().err
    assert len(printed.splitlines()) == 1 and words in printed
    assert not list(tmp_path.iterdir())


def twin(*arguments, folder):
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent), "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.run(
        [sys.executable, "-m", "twin", *arguments],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
    )


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ([*FINE, "--size", "-3"], ["--size", "'-3'"]),
        (["simulate", "absent.toml", *FINE[1:]], ["DESIGN", "'absent.toml'"]),
        # Found only once the work is under way: these too are the only line there is.
        ([*FINE, "--device", "cuda"], ["--device", "'cuda'", "allowed"]),
        (["train", "corpus", "--device", "cuda", "--out", "model"], ["--device", "'cuda'", "allowed"]),
        (
            ["assess", "tsis", "corpus", "--single", "0", "--averaged", "0", "--out", "o"],
            ["--single", "0, 0"],
        ),
        ([*FINE, "--force", "9", "--quality", "preview"], ["--force", "9.0", "<= about"]),
        (
            [*FINE, "--force", "2", "--quality", "preview", "--mechanics", "linear"],
            ["--force", "2.0", "<= about 1.66 N", "6 mm deep"],
        ),
        ([*EXPORT, "--vtu", "."], ["--vtu", "'.'", ".vtu"]),
    ],
)
def test_as_a_program(arguments, words, tmp_path):
    ended = twin(*arguments, folder=tmp_path)
    line = only_line(ended.returncode, ended.stdout, ended.stderr, tmp_path, [])
    for word in words:
        assert word in line


def test_help_schema_and_mistakes_do_not_wait_for_mitsuba(tmp_path):
    program = (
        "import sys; from twin import cli; "
        "cli.main(['schema']); cli.main(['--help']); cli.main(['simulate', '--size', '0']); "
        "slow = {'mitsuba', 'drjit', 'torch', 'matplotlib'}; print(slow & set(sys.modules), file=sys.stderr)"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parent.parent)}
    ended = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert ended.stderr.splitlines()[-1] == "set()"


@pytest.mark.parametrize("verb", [[], ["demo"], ["simulate"], ["export"], ["schema"]])
def test_every_verb_has_help_with_an_example(verb, capfd):
    assert cli.main([*verb, "--help"]) == 0
    printed = capfd.readouterr().out
    assert "twin demo" in printed if not verb else "example" in printed and f"twin {verb[0]}" in printed
