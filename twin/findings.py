"""What the sensor doctor makes of a checkup: what was found, why it matters, what to change.

Pure functions of a `twin.doctor.Checkup`, so that every rule can be tried on made-up figures.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from twin.complaint import DesignError
from twin.doctor import STANDARD, Checkup

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from scenes.sensor import Led

Rank = Literal["error", "warning", "note"]
RANKS: tuple[Rank, ...] = ("error", "warning", "note")

CLOSURE_PERCENT = 0.2
"""How far the sum of the sinks may be from what was emitted."""
SATURATED = {"warning": 0.1, "error": 5.0}  # per cent of the pixels
_DARK = 0.25  # share of the range that the brightest pixels should reach
_SEEN, _CLEAR = 3.0, 10.0  # signal over noise
_MISSED, _LEAKED, _ASIDE, _FRAME = 15.0, 10.0, 60.0, 10.0  # per cent of the light
_BACKGROUND = 0.5  # untouched over pressed, above black
_UNEVEN = 10.0
_VEIL = 5.0
_RIM_MM = 1.5  # of the guide's edge where the pressed rim folds


@dataclass(frozen=True)
class Finding:
    """One line of advice: ``field`` is the dotted name of the value to look at."""

    rank: Rank
    field: str
    found: str
    why: str
    change: str

    def __str__(self) -> str:
        return f"{self.field}: {self.found}. {self.why}. {self.change}."


def findings(checkup: Checkup) -> list[Finding]:
    """Everything worth a line, errors first; within a rank in the order of the light's way."""
    rules = (_not_computed, _leds, _rim, _indices, _losses, _picture, _exposure, _signal, _balance)
    found = [finding for rule in rules for finding in rule(checkup)]
    return sorted(found, key=lambda finding: RANKS.index(finding.rank))


_WHY = (
    (
        r"leds\.\d+\.(along_mm|z_mm|diameter_mm)",
        "the disc hangs over the edge of the guide's side face: that light never gets in",
    ),
    (r"leds\.\d+\.gap_mm", "an embedded LED lies in its own half of the guide"),
    (r"leds\.\d+", "two discs cannot be in one place"),
    (r"camera\.field_of_view_mm", "the picture would show what lies beside the guide"),
    (r"surface\.gap_index", "no light is trapped, so that contact makes no contrast"),
    (r"camera\.offset_dn", "the black level alone fills the converter's range"),
)


def from_conflicts(conflicts: Sequence[DesignError]) -> list[Finding]:
    """Values that do not fit each other, so that nothing could be computed."""
    found = []
    for conflict in conflicts:
        why = next(
            (text for pattern, text in _WHY if re.fullmatch(pattern, conflict.field)), "values contradict"
        )
        found.append(
            Finding(
                "error",
                conflict.field,
                f"is {conflict.received}",
                _sentence(why),
                f"Allowed: {conflict.allowed}",
            )
        )
    return found


def _not_computed(checkup: Checkup) -> Iterator[Finding]:
    for line in checkup.failures:
        field, _, rest = line.partition(": ")
        if field.startswith("inclusion"):
            what = f"the standard inclusion ({STANDARD.size:g} mm, {STANDARD.depth:g} mm deep) does not fit"
            why = "No signal could be computed"
            yield Finding("note", field, what, why, _sentence(rest))
        elif re.fullmatch(r"leds\.\d+\.z_mm", field) and checkup.rim_mm is not None:
            continue  # `_rim` says so in its own words
        else:
            why = "The press could not be computed, so light was followed through the untouched sensor"
            yield Finding(
                "error", field, rest.rstrip("."), why, "Change that value, or check a lighter press"
            )


def _leds(checkup: Checkup) -> Iterator[Finding]:
    leds = checkup.design.leds
    lit = [number for number, led in enumerate(leds) if led.flux_W > 0.0]
    for number in sorted(set(range(len(leds))) - set(lit)):
        why = "Its layer of the picture is black"
        yield Finding("warning", f"leds.{number}.flux_W", "is 0, a failed LED", why, "Set its flux in W")
    blind = [number for number in lit if checkup.response[number] == 0.0]
    if blind:
        yield Finding(
            "error" if len(blind) == len(lit) else "warning",
            _these(blind, len(leds), ".peak_nm"),
            "the camera is blind to its light (quantum efficiency 0)",
            "Its layer of the picture is black",
            "Take an LED of a wavelength that it sees, or give camera.quantum_efficiency there",
        )
    seen = [number for number in lit if checkup.in_sight_percent[number] > 0.0]
    if seen:
        share = float(checkup.in_sight_percent[seen].sum())
        yield Finding(
            "warning",
            _these(seen, len(leds), ""),
            f"{share:.2g} % of the pixels look straight into an LED",
            "Its spot is brighter than any contact and hides what lies there",
            "Move it behind the edge of the field of view, couple it through air, or narrow the field",
        )
    missed = [number for number in lit if checkup.first["missed"][number] > _MISSED]
    if missed:
        gaps = max(leds[number].gap_mm for number in missed)
        yield Finding(
            "warning",
            _these(missed, len(leds), ".gap_mm"),
            f"{_span(checkup.first['missed'][missed])} % of its light never enters the guide",
            "It is lost and makes stray light in a real housing",
            f"Bring it nearer than {gaps:g} mm, or nearer to the middle of the side, or embed it",
        )
    for place, field, change in (
        ("below", "side", "Move it to a side face, unless it is there to light what does not touch"),
        ("embedded", "coupling", "Couple it through air at a flat side"),
        ("air", "z_mm", "Put it lower, or raise the guide's index"),
    ):
        leaks = [
            number
            for number in lit
            if checkup.first["leaked"][number] > _LEAKED and _place(leds[number]) == place
        ]
        if leaks:
            yield Finding(
                "warning",
                _these(leaks, len(leds), f".{field}"),
                f"{_span(checkup.first['leaked'][leaks])} % of its light meets the contact surface too "
                "steeply to be trapped",
                "It shines through without any contact: a bright background near the LED",
                change,
            )


def _place(led: Led) -> str:
    return "below" if led.side == "below" else led.coupling


def _these(numbers: Sequence[int], count: int, field: str) -> str:
    """The field of these LEDs; `leds.*` for all of several."""
    if len(numbers) == count > 1:
        return f"leds.*{field}"
    return ", ".join(f"leds.{number}{field}" for number in numbers)


def _span(values: NDArray[np.float64]) -> str:
    """Lowest to highest, whole numbers."""
    low, high = f"{values.min():.0f}", f"{values.max():.0f}"
    return low if low == high else f"{low} to {high}"


def _rim(checkup: Checkup) -> Iterator[Finding]:
    if checkup.rim_mm is None:
        return
    for number, led in enumerate(checkup.design.leds):
        top = led.z_mm + led.diameter_mm / 2
        if top > checkup.rim_mm and led.side != "below":
            yield Finding(
                "error",
                f"leds.{number}.z_mm",
                f"the LED's upper edge ({top:.2f} mm) lies above the rim ({checkup.rim_mm:.2f} mm under a "
                f"press of {checkup.indentation_mm:g} mm)",
                "The rim shades it, and brightness falls with the press instead of the contact",
                f"Put it at {checkup.rim_mm - led.diameter_mm / 2:.2f} mm or lower",
            )


def _indices(checkup: Checkup) -> Iterator[Finding]:
    design = checkup.design
    guide, gap = design.guide(), design.surface.gap_index
    n = guide.refractive_index
    sheet = design.surface.sheet
    behind, field = (sheet, "surface.sheet") if sheet else (design.specimen, "specimen")
    tissue = behind.refractive_index
    air = [str(k) for k, led in enumerate(design.leds) if _place(led) == "air"]
    lit = [guide.index_at(led.z_mm) for led in design.leds if led.side != "below"]
    entered = min((guide.index_at(design.leds[int(k)].z_mm) for k in air), default=n)
    if lit and n < max(lit):
        angle = np.degrees(np.arccos(n / max(lit)))
        yield Finding(
            "note",
            "waveguide.layers.0.refractive_index",
            f"light flatter than {angle:.0f}° to the surface in the layer of {max(lit):.4g} never comes to "
            "the contact",
            f"The first layer's index ({n:.4g}) is below that of a layer that LEDs shine into",
            "A first layer of higher index, or LEDs at its height, use more of the light",
        )
    if air and entered**2 - 1.0 < gap**2:
        yield Finding(
            "warning",
            "waveguide.refractive_index",
            f"{entered:.4g} lets light of LEDs in air (leds {', '.join(air)}) out through the contact "
            "surface",
            f"Only above {np.sqrt(1.0 + gap**2):.3f} is all light from a side face trapped by gaps of index "
            f"{gap:g}",
            "Take a guide of higher index" + (" or keep the gaps dry" if gap > 1.0 else ""),
        )
    if tissue < n:
        angle = np.degrees(np.arcsin(tissue / n))
        yield Finding(
            "note",
            f"{field}.refractive_index",
            f"light flatter than {90 - angle:.0f}° to the surface stays trapped even where contact is full",
            f"The {'sheet' if sheet else 'tissue'}'s index ({tissue:g}) is below the guide's ({n:.4g})",
            "A guide of lower index, or LEDs that shine more steeply, use more of the light",
        )
    if n - gap < 0.05:
        yield Finding(
            "warning",
            "surface.gap_index",
            f"{gap:g} is nearly the guide's {n:.4g}",
            "Hardly any light is trapped, so that contact makes little contrast",
            "Keep the contact dry, or take a guide of higher index",
        )


def _losses(checkup: Checkup) -> Iterator[Finding]:
    design, together = checkup.design, checkup.together
    aside = together(checkup.sinks.get("aside", np.zeros(len(design.leds)))) - together(
        checkup.first["missed"]
    )
    reaches = together(checkup.first["trapped"]) + together(checkup.first["leaked"])
    if aside > _ASIDE and design.waveguide.walls == "polished":
        yield Finding(
            "note",
            "waveguide.walls",
            f"{aside:.0f} % of the light crosses the guide and leaves by its side faces",
            f"Only {reaches:.0f} % ever come to the contact surface, and most of that goes by untouched",
            "White walls (walls = 'diffuse') send it back, at the price of a background that is less trapped",
        )
    frame = together(checkup.sinks.get("frame", np.zeros(len(design.leds))))
    if frame > _FRAME:
        yield Finding(
            "note",
            "glass.thickness_mm",
            f"{frame:.0f} % of the light ends in the black frame about the glass",
            "Light that slips into the plate reaches its rim",
            "Raise the LEDs, take a thinner plate, or one of lower index",
        )


def _picture(checkup: Checkup) -> Iterator[Finding]:
    design = checkup.design
    if checkup.from_housing_percent > _VEIL:
        yield Finding(
            "warning",
            "housing.reflectance",
            f"{checkup.from_housing_percent:.1f} % of the picture's light is the housing, seen in the glass",
            "It lies over the picture as a veil that no contact makes; its noise stays when it is tared",
            "Blacken the inside (reflectance = 0)",
        )
    camera, width = design.camera, design.waveguide.width_mm
    margin = (width - max(camera.field_of_view_mm, camera.field_height_mm)) / 2
    if margin < _RIM_MM:
        yield Finding(
            "note",
            "camera.field_of_view_mm",
            f"the picture reaches within {max(margin, 0.0):.2g} mm of the guide's edge",
            "There the pressed rim folds and bends the view",
            f"{width - 2 * _RIM_MM:g} mm would leave it out, if its signal is not wanted",
        )
    if np.isfinite(checkup.uniformity) and checkup.uniformity > _UNEVEN:
        yield Finding(
            "warning",
            "leds",
            f"without an inclusion, the picture is {checkup.uniformity:.0f} times brighter in one place than "
            "in another",
            "Noise and saturation then limit opposite ends of the picture",
            "Spread the LEDs over more sides, or couple them through air",
        )
    weak = [k for k, share in enumerate(checkup.lit_percent) if 0 < share < 25.0 / len(design.leds)]
    for number in weak:
        if design.leds[number].flux_W > 0.0:
            yield Finding(
                "note",
                f"leds.{number}",
                f"gives {checkup.lit_percent[number]:.1f} % of the picture's light",
                f"An even share would be {100.0 / len(design.leds):.0f} %",
                "Give it more flux or a better place",
            )


def _exposure(checkup: Checkup) -> Iterator[Finding]:
    camera, advised = checkup.design.camera, checkup.advised_exposure_ms
    shown = checkup.standard or checkup.blank or checkup.background
    if advised is None:
        yield Finding(
            "error",
            "camera",
            "no light reaches the camera",
            "Every picture is black",
            "See flux_W of the LEDs",
        )
        return
    which = "standard press" if checkup.standard or checkup.blank else "untouched picture"
    full = max(shown.saturated_percent - checkup.spots_percent, 0.0)  # spots of LEDs have a line of their own
    top = 2**camera.bits - 1
    if full > SATURATED["warning"]:
        yield Finding(
            "error" if full > SATURATED["error"] else "warning",
            "camera.exposure_ms",
            f"{full:.3g} % of the pixels are full on the {which}",
            "A full pixel cannot show that contact grew",
            f"Set {advised:g} ms (from {camera.exposure_ms:g} ms), or stop down the lens",
        )
    elif shown.brightest_dn < camera.offset_dn + _DARK * (top - camera.offset_dn):
        yield Finding(
            "warning",
            "camera.exposure_ms",
            f"the brightest pixel reaches {shown.brightest_dn:.0f} of {top} counts",
            "Most of the range is unused, and noise weighs more",
            f"Set {advised:g} ms (from {camera.exposure_ms:g} ms), or open the lens",
        )
    if checkup.blank is not None:
        black = camera.offset_dn
        untouched, pressed = checkup.background.mean_dn - black, checkup.blank.mean_dn - black
        if pressed > 0 and untouched > _BACKGROUND * pressed:
            yield Finding(
                "warning",
                "leds",
                f"untouched, the picture has {untouched / pressed:.0%} of the light of a press",
                "What is not contact takes up range and adds noise",
                "Couple the LEDs through air, or keep them out of the camera's sight",
            )


def _signal(checkup: Checkup) -> Iterator[Finding]:
    signal, design = checkup.signal, checkup.design
    if signal is None:
        return
    times = f"{signal.over_noise:.1f} times a pixel's noise"
    what = f"the standard inclusion adds {signal.counts:.1f} counts, {times}"
    longer = "Expose longer, average frames, or press deeper"
    if signal.over_noise < _SEEN:
        yield Finding("error", "signal", what, "One frame cannot show it", longer)
    elif signal.over_noise < _CLEAR:
        yield Finding("warning", "signal", what, "Only averages over many pixels show it", longer)
    if signal.over_noise >= _SEEN and signal.counts <= design.signal.counts:
        yield Finding(
            "warning",
            "signal.counts",
            f"the standard inclusion adds {signal.counts:.1f} counts, not above the threshold of "
            f"{design.signal.counts:g}",
            "The picture's scalars will be zero",
            "Lower the threshold, or expose longer",
        )
    saturated = checkup.standard is not None and checkup.standard.saturated_percent > SATURATED["error"]
    if signal.noise_dn < 1.3 / np.sqrt(12.0) and not saturated:
        yield Finding(
            "note",
            "camera.gain_e_per_dn",
            f"the noise is {signal.noise_dn:.2f} counts, that of the converter's step",
            "Counts are too coarse for the light that is there",
            "Take more bits, or fewer electrons per count",
        )


def _balance(checkup: Checkup) -> Iterator[Finding]:
    off = checkup.closure_percent
    worst = float(off[np.abs(off).argmax()])
    if abs(worst) > CLOSURE_PERCENT:
        yield Finding(
            "warning",
            "light",
            f"the sinks of leds.{int(np.abs(off).argmax())} add up to {100.0 + worst:.2f} % of its light",
            f"More than {CLOSURE_PERCENT:g} % is missing: these figures are rough here",
            "Report this design: it is a fault of the program",
        )


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]
