"""`twin check`: a balance that closes, figures that closed forms know, and a design's mistakes by name."""

import json
from importlib.resources import files

import numpy as np
import pytest
from PIL import Image

from twin import cli, doctor, prescription
from twin.design import load_design

TSIS = files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8")


def mine(folder, *changes):
    """The shipped design with texts replaced, as a file."""
    text = TSIS
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    path = folder / "mine.toml"
    path.write_text(text)
    return path


@pytest.fixture(scope="module")
def checked(tmp_path_factory):
    """A folder that `twin check` made, of a design with losses of every kind."""
    folder = tmp_path_factory.mktemp("check")
    design = mine(
        folder,
        ("width_mm = 25.0\n", 'width_mm = 25.0\nabsorption_per_mm = 0.003\nwalls = "absorbing"\n'),
        (
            "thickness_mm = 2.0          # open: a common plate",
            "thickness_mm = 2.0\nabsorption_per_mm = 0.01",
        ),
    )
    assert cli.main(["check", str(design), "--out", str(folder / "out"), "--device", "cpu"]) == 0
    return folder / "out"


@pytest.fixture(scope="module")
def checkup():
    return doctor.check_up(load_design("tsis").pressed(mechanics="linear"), device="cpu")


def test_every_led_s_light_is_accounted_for(checked):
    """Emitted is the sum of the sinks within 0.2 %, LED by LED and together; what is first sums to all."""
    record = json.loads((checked / "check.json").read_text())
    light = record["light"]
    sums = np.sum([part["per_led"] for part in light["sinks_percent"].values()], axis=0)
    assert np.abs(sums - 100.0).max() < 0.2
    assert abs(sum(part["all"] for part in light["sinks_percent"].values()) - 100.0) < 0.2
    assert min(light["sinks_percent"][name]["all"] for name in ("tissue", "guide", "glass", "walls")) > 0.1
    first = np.sum([part["per_led"] for part in light["first_percent"].values()], axis=0)
    assert np.allclose(first, 100.0)
    detected = np.array(light["detected_percent"]["per_led"])
    assert (detected > 0).all() and (detected < light["sinks_percent"]["below"]["per_led"]).all()


def test_equal_leds_fare_alike(checkup):
    """Four of them, one on each side of a square guide: every share within its noise, 0.3 % of the light."""
    for name, part in checkup.sinks.items():
        assert np.ptp(part) < 0.3, name
    assert np.ptp(checkup.first["trapped"]) < 0.5


def test_light_from_air_is_trapped(checkup):
    """Beyond n = sqrt(2) nothing that enters by a flat side meets the contact surface too steeply, but for
    what came round by several faces. What never enters is what Fresnel mirrors of diffuse light, and the
    little that slips through the gap."""
    assert checkup.together(checkup.first["leaked"]) < 0.5
    n, cosine = 1.4336, (np.arange(20_000) + 0.5) / 20_000
    inside = np.sqrt(1.0 - (1.0 - cosine**2) / n**2)
    s = (cosine - n * inside) / (cosine + n * inside)
    p = (n * cosine - inside) / (n * cosine + inside)
    mirrored = 100.0 * np.mean((s**2 + p**2) * cosine)
    missed, error = checkup.together(checkup.first["missed"]), 100.0 * np.sqrt(0.08 / 2**14)
    assert mirrored - 3 * error < missed < mirrored + 3 * error + 1.0


def test_detected_light_is_what_the_pixels_count(checkup):
    """Back from mean counts of a picture, by photon energy and quantum efficiency, to watts on the pixels."""
    camera = checkup.design.camera
    dark = camera.offset_dn + camera.dark_current_e_s * camera.exposure_ms * 1e-3 / camera.gain_e_per_dn
    electrons = (checkup.blank.mean_dn - dark) * camera.gain_e_per_dn * camera.rows * camera.columns
    photon_J = 6.62607015e-34 * 299792458.0 / 550e-9
    watt = electrons * photon_J / camera.quantum_efficiency / (camera.exposure_ms * 1e-3)
    assert 100.0 * watt / 0.04 == pytest.approx(checkup.together(checkup.detected), rel=1e-4)


def test_noise_is_that_of_the_camera_s_data_sheet(checkup):
    """EMVA 1288: shot, dark and read noise, and the converter's step, in one frame."""
    camera, signal = checkup.design.camera, checkup.signal
    row, column = signal.at_px
    assert 0 <= row < camera.rows and 0 <= column < camera.columns
    # the standard press is brightest near the signal: between the mean and the brightest pixel
    low, high = (
        np.sqrt(
            ((count - camera.offset_dn) * camera.gain_e_per_dn + camera.read_noise_e**2)
            / camera.gain_e_per_dn**2
            + 1.0 / 12.0
        )
        for count in (checkup.standard.mean_dn, checkup.standard.brightest_dn)
    )
    assert 0.95 * low < signal.noise_dn < 1.05 * high
    assert signal.over_noise == pytest.approx(signal.counts / signal.noise_dn)


def test_advised_exposure_fills_the_range(checkup):
    """Scaling the brightest counts by the advice lands near 80 % of the range (noise of the light aside)."""
    camera = checkup.design.camera
    scale = checkup.advised_exposure_ms / camera.exposure_ms
    brightest = (checkup.standard.brightest_dn - camera.offset_dn) * scale / 251.0
    assert 0.75 < brightest < 1.0


def test_folder_holds_record_and_picture(checked):
    assert {path.name for path in checked.iterdir()} == {"check.json", "check.png"}
    with Image.open(checked / "check.png") as picture:
        assert picture.size == (1800, 1200)
        assert len(picture.convert("RGB").getcolors(2**24)) > 100
    assert prescription.holds_checkup(checked)


def test_mistakes_are_named_and_ranked(tmp_path, capsys):
    """Values that can be read but do not fit: all of them, each with advice, and status 0."""
    design = mine(
        tmp_path,
        ("along_mm = 0.0              # open: middle of the side", "along_mm = 12.2"),
        ("gap_index = 1.0", "gap_index = 1.5"),
    )
    assert cli.main(["check", str(design), "--json"]) == 0
    record = json.loads(capsys.readouterr().out)
    assert not record["ok"] and record["count"]["error"] == 2
    assert [finding["field"] for finding in record["findings"]] == ["leds.0.along_mm", "surface.gap_index"]
    assert all(finding["why"] and finding["change"] for finding in record["findings"])
    assert cli.main(["check", str(design), "--out", str(tmp_path / "out")]) == 0
    assert "leds.0.along_mm: is 12.2" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "out").iterdir()] == ["check.json"]


def test_shaded_led_and_a_specimen_too_thin(tmp_path, capsys):
    """What cannot be pressed or lit is a finding, not the end: the untouched sensor is still looked over."""
    design = mine(
        tmp_path,
        ("z_mm = -5.0                 # open: middle of the guide's thickness", "z_mm = -0.9"),
        ("thickness_mm = 30.0", "thickness_mm = 14.0"),
    )
    assert cli.main(["check", str(design), "--json", "--device", "cpu"]) == 0
    record = json.loads(capsys.readouterr().out)
    fields = {finding["field"]: finding["rank"] for finding in record["findings"]}
    assert fields["leds.0.z_mm"] == "error" and fields["inclusion.size"] == "note"
    assert not record["light"]["pressed"] and record["signal"] is None
    assert record["exposure"]["standard"] is None and record["exposure"]["background"]["mean_dn"] > 4.0
    assert max(map(abs, record["light"]["closure_percent"]["per_led"])) < 0.2


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["check", "nosuch"], ["DESIGN", "'nosuch'", "tsis"]),
        (["check", "tsis", "--indentation", "7"], ["--indentation", "7.0", "<= 6 mm"]),
        (["check", "tsis", "--indentation", "0"], ["--indentation", "'0'", "> 0"]),
        (["check", "tsis", "--mechanics", "none"], ["--mechanics", "'none'", "linear"]),
        (["check", "tsis", "--out", ""], ["--out", "an empty name", "folder"]),
        (["check", "tsis", "--seed", "x"], ["--seed", "'x'", "an integer"]),
    ],
)
def test_bad_input_is_one_line(arguments, words, capfd):
    assert cli.main(arguments) == 2
    error = capfd.readouterr().err
    assert len(error.splitlines()) == 1
    assert all(word in error for word in words), error


def test_a_broken_file_is_refused(tmp_path, capfd):
    """Conflicts are findings; a value that cannot be read is bad input."""
    assert cli.main(["check", str(mine(tmp_path, ("bits = 8 ", "bits = 80 ")))]) == 2
    assert "camera.bits" in capfd.readouterr().err
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").write_text("mine")
    assert cli.main(["check", "tsis", "--out", str(tmp_path / "out")]) == 2
    assert "--out" in capfd.readouterr().err
