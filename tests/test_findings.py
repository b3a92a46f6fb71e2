"""The doctor's rules, each on figures made up to set it off, and none of them on a sound sensor."""

from dataclasses import replace

import numpy as np
import pytest

from twin.design import load_design
from twin.doctor import Checkup, Exposure, Signal
from twin.findings import RANKS, findings

SINKS = ("tissue", "guide", "glass", "walls", "frame", "leds", "below", "aside", "housing")


def sound(**changes):
    """A checkup of the shipped design with a narrower field, whose figures give no cause for a line."""
    design = load_design("tsis")
    design = replace(
        design,
        camera=replace(design.camera, field_of_view_mm=20.0),
        specimen=replace(design.specimen, refractive_index=1.44),
    )
    shares = dict(zip(SINKS, (20.0, 0.0, 0.0, 10.0, 5.0, 5.0, 10.0, 50.0, 0.0), strict=True))
    values = {
        "design": design,
        "indentation_mm": 2.0,
        "emitted_W": np.full(4, 0.01),
        "sinks": {name: np.full(4, share) for name, share in shares.items()},
        "first": {
            name: np.full(4, share)
            for name, share in zip(
                ("missed", "trapped", "leaked", "elsewhere"), (8.0, 60.0, 2.0, 30.0), strict=True
            )
        },
        "detected": np.full(4, 0.01),
        "response": np.ones(4),
        "lit_percent": np.full(4, 25.0),
        "in_sight_percent": np.zeros(4),
        "light_is_pressed": True,
        "background": Exposure(20.0, 6.0, 0.0),
        "blank": Exposure(150.0, 80.0, 0.0),
        "standard": Exposure(190.0, 90.0, 0.0),
        "signal": Signal(40.0, 1.0, (246, 384)),
        "advised_exposure_ms": 7.0,
        "rim_mm": -0.6,
        "noise_percent": 2.0,
        "uniformity": 3.0,
    }
    return Checkup(**{**values, **changes})


def share(checkup, name, value, leds=slice(None)):
    """One of the checkup's shares with another value for some LEDs."""
    parts = {key: part.copy() for key, part in getattr(checkup, name).items()}
    for key, amount in value.items():
        parts[key][leds] = amount
    return replace(checkup, **{name: parts})


def test_a_sound_sensor_has_no_findings():
    assert findings(sound()) == []


@pytest.mark.parametrize(
    ("blind", "field"), [([1, 3], "leds.1.peak_nm, leds.3.peak_nm"), (range(4), "leds.*.peak_nm")]
)
def test_leds_that_the_camera_cannot_see_are_named(blind, field):
    response = np.ones(4)
    response[list(blind)] = 0.0
    (finding,) = findings(sound(response=response))
    assert finding.field == field and "blind" in finding.found
    assert finding.rank == ("error" if len(blind) == 4 else "warning")


def at(section, **values):
    checkup = sound()
    design = checkup.design
    return replace(checkup, design=replace(design, **{section: replace(getattr(design, section), **values)}))


def led(number=0, **values):
    checkup = sound()
    leds = list(checkup.design.leds)
    leds[number] = replace(leds[number], **values)
    return replace(checkup, design=replace(checkup.design, leds=tuple(leds)))


LIGHT = np.array([0.5, 40.0, 30.0, 29.5])
CASES = {
    "an LED that is off": (led(flux_W=0.0), "warning", "leds.0.flux_W", "failed"),
    "an LED in sight": (
        sound(in_sight_percent=np.array([0.2, 0.0, 0.0, 0.0])),
        "warning",
        "leds.0",
        "straight into",
    ),
    "light goes by": (
        share(sound(), "first", {"missed": 30.0}, slice(0, 2)),
        "warning",
        "leds.0.gap_mm, leds.1.gap_mm",
        "30 %",
    ),
    "light leaks": (share(sound(), "first", {"leaked": 20.0}), "warning", "leds.*.z_mm", "too steeply"),
    "an LED below": (
        share(led(1, side="below"), "first", {"leaked": 80.0}, 1),
        "warning",
        "leds.1.side",
        "Move it to a side face",
    ),
    "an LED in the rim's shade": (led(2, z_mm=-1.0), "error", "leds.2.z_mm", "Put it at -1.35 mm or lower"),
    "a guide that air sees through": (
        at("waveguide", refractive_index=1.38),
        "warning",
        "waveguide.refractive_index",
        "1.414",
    ),
    "tissue of lower index": (
        at("specimen", refractive_index=1.36),
        "note",
        "specimen.refractive_index",
        "18°",
    ),
    "a wet gap": (at("surface", gap_index=1.40), "warning", "surface.gap_index", "nearly the guide's"),
    "light that crosses": (
        share(sound(), "sinks", {"aside": 80.0, "tissue": -10.0}),
        "note",
        "waveguide.walls",
        "72 %",
    ),
    "a black frame": (
        share(sound(), "sinks", {"frame": 20.0, "walls": -5.0}),
        "note",
        "glass.thickness_mm",
        "20 %",
    ),
    "the rim in the picture": (
        at("camera", field_of_view_mm=24.0),
        "note",
        "camera.field_of_view_mm",
        "within 0.5 mm",
    ),
    "a white housing": (sound(from_housing_percent=12.3), "warning", "housing.reflectance", "12.3 %"),
    "uneven light": (sound(uniformity=25.0), "warning", "leds", "25 times"),
    "a weak LED": (sound(lit_percent=LIGHT), "note", "leds.0", "0.5 %"),
    "no light": (sound(advised_exposure_ms=None), "error", "camera", "no light"),
    "some full pixels": (
        sound(standard=Exposure(255.0, 99.0, 1.0)),
        "warning",
        "camera.exposure_ms",
        "Set 7 ms",
    ),
    "all pixels full": (
        sound(standard=Exposure(255.0, 255.0, 100.0)),
        "error",
        "camera.exposure_ms",
        "100 %",
    ),
    "too dark": (sound(standard=Exposure(30.0, 9.0, 0.0)), "warning", "camera.exposure_ms", "30 of 255"),
    "a bright background": (sound(background=Exposure(99.0, 60.0, 0.0)), "warning", "leds", "untouched"),
    "no signal": (sound(signal=Signal(1.0, 1.0, (0, 0))), "error", "signal", "One frame cannot"),
    "a faint signal": (sound(signal=Signal(12.0, 2.0, (0, 0))), "warning", "signal", "6.0 times"),
    "a signal below k": (
        sound(signal=Signal(9.0, 0.5, (0, 0))),
        "warning",
        "signal.counts",
        "threshold of 10",
    ),
    "coarse counts": (sound(signal=Signal(30.0, 0.3, (0, 0))), "note", "camera.gain_e_per_dn", "more bits"),
    "a balance that is off": (
        share(sound(), "sinks", {"aside": 50.5}, 1),
        "warning",
        "light",
        "leds.1 add up to 100.50 %",
    ),
    "a press that failed": (
        sound(failures=("press: received 2 mm; no equilibrium beyond 1.5 mm",)),
        "error",
        "press",
        "no equilibrium",
    ),
    "an inclusion that does not fit": (
        sound(failures=("inclusion.size: received 10.0; allowed less",), signal=None),
        "note",
        "inclusion.size",
        "does not fit",
    ),
}


@pytest.mark.parametrize("case", CASES)
def test_each_mistake_has_its_line(case):
    """Exactly one finding about that value, of that rank, in one line with all three parts."""
    checkup, rank, field, words = CASES[case]
    found = [finding for finding in findings(checkup) if finding.field == field]
    assert len(found) == 1, findings(checkup)
    assert found[0].rank == rank and words in str(found[0])
    assert found[0].found and found[0].why and found[0].change and "\n" not in str(found[0])


def test_errors_come_first():
    checkup = sound(uniformity=25.0, lit_percent=LIGHT, advised_exposure_ms=None)
    ranks = [RANKS.index(finding.rank) for finding in findings(checkup)]
    assert ranks == sorted(ranks) and len(set(ranks)) == 3
