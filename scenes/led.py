"""An LED: where it sits, how much it gives, and what of that cannot be."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from . import ies
from .quantity import CONFIG, Conflict, Wavelength
from .spectrum import ILLUMINANTS, SpectrumName, efficacy

FLUX_W = 0.010
"""Flux of an LED of which nothing is said, W."""

Side = Literal["+x", "-x", "+y", "-y", "below"]
Coupling = Literal["air", "embedded"]
Pattern = Literal["lambertian", "power", "ies"]


@dataclass(frozen=True, config=CONFIG)
class Led:
    """One LED: a disc at a side face of the guide that faces its middle, or under the guide, facing up."""

    side: Annotated[
        Side,
        Field(
            description="Where the LED sits: at the guide's side face +x, -x, +y or -y; or below, under the "
            "guide, at x_mm and y_mm, shining up."
        ),
    ]
    along_mm: Annotated[
        float,
        Field(
            ge=-250.0,
            le=250.0,
            description="Place of the LED's centre along that side, from the middle of the side, mm.",
        ),
    ] = 0.0
    z_mm: Annotated[
        float,
        Field(
            ge=-500.0,
            lt=0.0,
            description="Height of the LED's centre, mm; 0 is the contact surface, negative is below it.",
        ),
    ] = -5.0
    x_mm: Annotated[
        float, Field(ge=-250.0, le=250.0, description="Place of an LED below, along x from the middle, mm.")
    ] = 0.0
    y_mm: Annotated[
        float, Field(ge=-250.0, le=250.0, description="Place of an LED below, along y from the middle, mm.")
    ] = 0.0
    diameter_mm: Annotated[
        float, Field(ge=0.01, le=500.0, description="Diameter of the emitting disc, mm.")
    ] = 1.5
    flux_W: Annotated[
        float, Field(ge=0.0, le=1000.0, description="Radiant flux of the LED, W (0 is a failed LED).")
    ] = FLUX_W
    flux_lm: Annotated[
        float | None,
        Field(ge=0.0, le=1e6, description="Luminous flux of the LED, lm, in place of flux_W."),
    ] = None
    spectrum: Annotated[
        SpectrumName,
        Field(
            description="line; gaussian (peak_nm, fwhm_nm); or a typical LED of the CIE: B1 to B5 white of "
            "blue and phosphor, warm to cold, BH1 with red, RGB1 of three colours, V1 and V2 of violet."
        ),
    ] = "line"
    peak_nm: Annotated[
        Wavelength | None,
        Field(description="Wavelength of the line (light.wavelength_nm if left out) or of the peak, nm."),
    ] = None
    fwhm_nm: Annotated[
        float | None,
        Field(ge=0.1, le=300.0, description="Full width at half maximum of a gaussian spectrum, nm."),
    ] = None
    coupling: Annotated[
        Coupling,
        Field(
            description="'air': outside, through the flat side face (below: under the glass); 'embedded': "
            "inside the guide, which leaks light through the contact surface and shows hot spots (below: "
            "inside the glass)."
        ),
    ] = "air"
    gap_mm: Annotated[
        float,
        Field(
            ge=1e-3,
            le=100.0,
            description="Distance of the disc from the side face, or below from the glass's lower face, mm: "
            "outside (air) or inside (embedded).",
        ),
    ] = 0.5
    pattern: Annotated[
        Pattern,
        Field(
            description="Light over angle: lambertian (a bare chip); power, intensity as cos^exponent (a "
            "lens); ies, as the file says."
        ),
    ] = "lambertian"
    exponent: Annotated[
        float | None,
        Field(ge=0.5, le=1000.0, description="Exponent m of a power pattern, cos^m; 1 is lambertian."),
    ] = None
    tilt_deg: Annotated[
        float,
        Field(
            ge=-90.0,
            le=90.0,
            description="Angle by which the light's axis is raised from the disc's normal, degrees: to the "
            "contact, or below towards +y; what would shine behind the disc is mirrored by it. 0 for ies.",
        ),
    ] = 0.0
    ies: Annotated[
        str | None,
        Field(
            min_length=1,
            max_length=4000,
            description="Luminaire file (IES LM-63, type C) of an ies pattern, beside the design; only its "
            "shape counts.",
        ),
    ] = None

    def __post_init__(self) -> None:
        """Turn lumens into watts, where nothing was said of watts."""
        per_watt = None if self.flux_lm is None else self.lumens_per_watt
        if self.flux_lm is not None and per_watt and self.flux_W == FLUX_W:
            object.__setattr__(self, "flux_W", self.flux_lm / per_watt)

    @property
    def window_mm(self) -> float:
        """Radius of the window before this LED in a painted wall: light from its rim gets in at 45°."""
        return self.diameter_mm / 2 + self.gap_mm

    @property
    def lumens_per_watt(self) -> float | None:
        """Lumens per watt of its spectrum; None where the spectrum lacks its numbers."""
        needs = {"line": (self.peak_nm,), "gaussian": (self.peak_nm, self.fwhm_nm)}.get(self.spectrum, ())
        return None if None in needs else efficacy(self.spectrum, self.peak_nm, self.fwhm_nm)


@dataclass(frozen=True, config=CONFIG)
class Light:
    """What a sensor's LEDs have in common, and how their colours are summed."""

    wavelength_nm: Annotated[
        Wavelength,
        Field(
            description="Wavelength of LEDs that are a line, nm. Light of other wavelengths is told as "
            "radiance of this one that the camera would answer alike."
        ),
    ] = 550.0
    bands: Annotated[
        int,
        Field(ge=1, le=64, description="Wavelengths that a spectrum is rendered at; a line takes one."),
    ] = 3


def led_conflicts(
    leds: tuple[Led, ...], width: float, thickness: float, glass: float, distance: float
) -> Iterator[Conflict]:
    """Yield what keeps LEDs from standing at a guide, or between its plate of glass and the camera.

    Width and thickness of the guide, thickness of the glass and distance of the camera below it are mm.
    """
    for number, led in enumerate(leds):
        if led.side == "below":
            yield from _below_conflicts(f"leds.{number}", led, width, glass, distance)
        else:
            yield from _place_conflicts(f"leds.{number}", led, width, thickness)
        yield from _light_conflicts(f"leds.{number}", led)
    yield from _overlapping_leds(leds, width)


def _place_conflicts(path: str, led: Led, width: float, thickness: float) -> Iterator[Conflict]:
    """The emitting disc must lie on its side face, and an embedded one in its own half of the guide."""
    radius = led.diameter_mm / 2
    if led.diameter_mm > min(width, thickness):
        yield Conflict(
            f"{path}.diameter_mm", led.diameter_mm, f"at most the side face of {width:g} x {thickness:g} mm"
        )
        return
    reach = width / 2 - radius
    if abs(led.along_mm) > reach:
        yield Conflict(
            f"{path}.along_mm",
            led.along_mm,
            f"-{reach:g} to {reach:g} mm (the disc stays on the guide's side)",
        )
    if not radius - thickness <= led.z_mm <= -radius:
        yield Conflict(
            f"{path}.z_mm",
            led.z_mm,
            f"{radius - thickness:g} to {-radius:g} mm (the disc stays on the guide's side)",
        )
    if led.coupling == "embedded" and led.gap_mm >= width / 2:
        yield Conflict(
            f"{path}.gap_mm", led.gap_mm, f"less than {width / 2:g} mm (half the guide) for an embedded LED"
        )


def _below_conflicts(path: str, led: Led, width: float, glass: float, distance: float) -> Iterator[Conflict]:
    """The disc lies under the guide, inside the plate or between it and the camera."""
    reach = width / 2 - led.diameter_mm / 2
    for name, place in (("x_mm", led.x_mm), ("y_mm", led.y_mm)):
        if abs(place) > reach:
            allowed = (
                f"-{reach:g} to {reach:g} mm (the disc stays under the guide)"
                if reach > 0
                else "a smaller disc"
            )
            yield Conflict(f"{path}.{name}", place, allowed)
    if led.coupling == "embedded" and led.gap_mm >= glass:
        yield Conflict(
            f"{path}.gap_mm", led.gap_mm, f"less than the glass's {glass:g} mm for an embedded LED"
        )
    if led.coupling == "air" and led.gap_mm >= distance:
        yield Conflict(f"{path}.gap_mm", led.gap_mm, f"less than the camera's distance of {distance:g} mm")


def _light_conflicts(path: str, led: Led) -> Iterator[Conflict]:
    """A spectrum has its own numbers and no others, and flux is given once."""
    if led.spectrum == "gaussian" and led.peak_nm is None:
        yield Conflict(f"{path}.peak_nm", led.peak_nm, "a wavelength, nm, for a gaussian spectrum")
    if led.spectrum == "gaussian" and led.fwhm_nm is None:
        yield Conflict(f"{path}.fwhm_nm", led.fwhm_nm, "a width, nm, for a gaussian spectrum")
    if led.spectrum in ILLUMINANTS and led.peak_nm is not None:
        yield Conflict(f"{path}.peak_nm", led.peak_nm, f"none with {led.spectrum}, which is a table")
    if led.spectrum != "gaussian" and led.fwhm_nm is not None:
        yield Conflict(f"{path}.fwhm_nm", led.fwhm_nm, "none but with a gaussian spectrum")
    yield from _pattern_conflicts(path, led)
    if led.flux_lm is None:
        return
    per_watt = led.lumens_per_watt
    if per_watt is None:
        allowed = "a flux_W, or this with the peak_nm (and fwhm_nm) that turns lumens into watts"
        yield Conflict(f"{path}.flux_lm", led.flux_lm, allowed)
    elif per_watt < 1e-3:
        yield Conflict(f"{path}.flux_lm", led.flux_lm, "a flux_W, where light is invisible")
    elif not math.isclose(led.flux_W * per_watt, led.flux_lm, rel_tol=1e-6, abs_tol=1e-12):
        yield Conflict(f"{path}.flux_lm", led.flux_lm, f"none beside flux_W = {led.flux_W:g}: one of the two")


def _pattern_conflicts(path: str, led: Led) -> Iterator[Conflict]:
    for name, value, pattern in (("exponent", led.exponent, "power"), ("ies", led.ies, "ies")):
        if value is None and led.pattern == pattern:
            yield Conflict(f"{path}.{name}", value, f"a value where pattern is {pattern!r}")
        elif value is not None and led.pattern != pattern:
            yield Conflict(f"{path}.{name}", value, f"none but where pattern is {pattern!r}")
    if led.pattern == "ies" and led.tilt_deg != 0.0:
        yield Conflict(f"{path}.tilt_deg", led.tilt_deg, "0 where pattern is 'ies': turn the file")
    if led.pattern == "ies" and led.ies is not None:
        try:
            ies.read(led.ies)
        except ies.IesError as error:
            yield Conflict(f"{path}.ies", led.ies, str(error))


def _overlapping_leds(leds: tuple[Led, ...], width: float) -> Iterator[Conflict]:
    """No two discs may overlap in one plane, nor embedded ones of neighbouring sides cut each other."""
    for number, led in enumerate(leds):
        for earlier in range(number):
            if _touch(leds[earlier], led, width):
                across = (led.x_mm, led.y_mm) if led.side == "below" else (led.along_mm, led.z_mm)
                place = (led.side, *across)
                yield Conflict(f"leds.{number}", place, f"a place where it does not cut leds.{earlier}")


def _touch(one: Led, other: Led, width: float) -> bool:
    radii = one.diameter_mm / 2, other.diameter_mm / 2
    if one.coupling != other.coupling:
        return False  # the side face lies between them
    if "below" in (one.side, other.side) and one.side != other.side:
        return False  # the glass's upper face lies between them
    if one.side == other.side:
        apart = math.hypot(one.along_mm - other.along_mm, one.z_mm - other.z_mm)
        if one.side == "below":
            apart = math.hypot(one.x_mm - other.x_mm, one.y_mm - other.y_mm)
        return math.isclose(one.gap_mm, other.gap_mm, abs_tol=1e-9) and apart < sum(radii) * (1 - 1e-9)
    if one.coupling == "air" or one.side[1] == other.side[1]:
        return False  # outside different faces, or parallel planes in different halves of the guide
    # Planes of neighbouring sides meet in an upright line; each disc covers a stretch of it, if any.
    away = other.along_mm - _plane(one, width), one.along_mm - _plane(other, width)
    squares = radii[1] ** 2 - away[0] ** 2, radii[0] ** 2 - away[1] ** 2
    if min(squares) <= 0.0:
        return False
    return abs(one.z_mm - other.z_mm) < math.sqrt(squares[0]) + math.sqrt(squares[1])


def _plane(led: Led, width: float) -> float:
    """The x (or y) of an embedded LED's disc, mm."""
    return float(f"{led.side[0]}1") * (width / 2 - led.gap_mm)
