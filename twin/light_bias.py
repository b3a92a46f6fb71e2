"""How far the light of a quality is off the reference, as it was measured on sensors like a design's.

The figures are those of `assets/light_bias.json`, which names the command that measures them. They are the
method's own error, which no number of light paths makes smaller; Monte Carlo noise comes on top.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from functools import lru_cache
from importlib.resources import files
from typing import Any

from scenes.traced import BIAS_SINCE, LIGHT
from twin.design import Design
from twin.fields import tables_of

PLACES = ("blob", "background")


def bias_of(design: Design, quality: str, *, learned: bool = False) -> dict[str, Any]:
    """Return ``bias_percent``, and ``bias_of``: what that was measured on, or why there is none.

    ``bias_percent`` holds for each of `PLACES` the light over the reference's, less one, and its standard
    error, per cent each; or is None.

    Parameters
    ----------
    learned : the light that walked far was learned from many presses (`scenes.traced`).
    """
    data = _data()
    if quality == "reference":
        return _none("reference light is what the other qualities are measured against")
    if learned:
        return _none("learned light was not measured")
    if not BIAS_SINCE <= data["light"] <= LIGHT:
        return _none("measured for an earlier version of the light only")
    why = next(_unlike(design, data["alike"]), None)
    if why is not None:
        return _none(f"not measured with {why}")
    kind = _kind(design, data)
    found = next((name for name, case in data["cases"].items() if _is(kind, case)), None)
    percent = None if found is None else data["cases"][found]["percent"].get(quality)
    if percent is None:
        return _none(f"not measured with {', '.join(str(part) for part in kind.values() if part)}")
    what = f"{quality} against reference: {found}, {data['measured_on']}"
    return {"bias_percent": {place: list(percent[place]) for place in PLACES}, "bias_of": what}


def in_words(quality: Mapping[str, Any]) -> str:
    """Return one line on a `bias_of`."""
    found = quality["bias_percent"]
    if found is None:
        return f"bias of the light: {quality['bias_of']}"
    told = ", ".join(f"{place} {off:+.2f} ± {error:.2f} %" for place, (off, error) in found.items())
    return f"bias of the light: {told} ({quality['bias_of']})"


def _none(why: str) -> dict[str, Any]:
    return {"bias_percent": None, "bias_of": why}


@lru_cache(maxsize=1)
def _data() -> dict[str, Any]:
    found: dict[str, Any] = json.loads(
        files("assets").joinpath("light_bias.json").read_text(encoding="utf-8")
    )
    return found


def _unlike(design: Design, alike: Mapping[str, Any]) -> Iterator[str]:
    """Yield what a design has that no measured sensor had."""
    tables = tables_of(design)
    lit = [led for led in design.leds if led.flux_W > 0.0]
    if any(led.side == "below" for led in lit):
        yield "LEDs below"
    if any(led.pattern != "lambertian" or led.tilt_deg != 0.0 for led in lit):
        yield "LEDs that are not Lambertian"
    if {led.side for led in lit if led.side != "below"} != {"+x", "-x", "+y", "-y"}:
        yield "LEDs on other than all four sides"
    thickness = design.waveguide.thickness_mm
    if any(led.side != "below" and abs(led.z_mm / thickness + 0.5) > _OFF_MIDDLE for led in lit):
        yield "LEDs far off the middle of the side faces' height"
    if design.guide().lower:
        yield "a guide in layers of different index"
    if len({led.coupling for led in lit}) != 1:
        yield "LEDs in air and embedded ones together" if lit else "no LED lit"
    if design.surface.sheet is not None:
        yield "a contact sheet"
    if design.waveguide.walls != "polished":
        yield f"{design.waveguide.walls} walls"
    if design.housing.reflects:
        yield "a housing that reflects"
    # what the light sees, also where the design leaves it out
    told = {"waveguide.refractive_index": design.guide().refractive_index}
    told["waveguide.thickness_mm"] = thickness
    told["glass.refractive_index"] = design.glass.at(design.light.wavelength_nm).refractive_index
    for name, (low, high) in alike.items():
        room, _, field = name.partition(".")
        value = told[name] if name in told else tables[room][field]
        if value is not None and not low <= value <= high:
            yield f"{name} = {value:g} (alike: {low:g} to {high:g})"


def _kind(design: Design, data: Mapping[str, Any]) -> dict[str, Any]:
    """What tells the measured cases apart."""
    near = [case["gap_index"] for case in data["cases"].values()]
    gap = design.surface.gap_index
    nearest = min(near, key=lambda one: abs(one - gap))
    return {
        "coupling": next(led.coupling for led in design.leds if led.flux_W > 0.0),
        "surface": "flat" if design.waveguide.dome_radius_mm is None else "domed",
        "contact": design.surface.contact,
        "gap_index": nearest if abs(nearest - gap) <= _GAP else gap,
    }


_GAP = 0.05  # of the index in the gaps, within which it is the measured one
_OFF_MIDDLE = 0.2  # of the guide's thickness, from the middle, where LEDs count as those measured


def _is(kind: Mapping[str, Any], case: Mapping[str, Any]) -> bool:
    return all(case[name] == value for name, value in kind.items())
