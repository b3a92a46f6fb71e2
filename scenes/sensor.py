"""The sensor as light sees it: guide, glass, LEDs, camera, skin, sheet and tissue (no Mitsuba here).

Frame: the origin is the centre of the undeformed contact surface and +z points into the specimen, so the
guide fills ``-thickness_mm <= z <= 0``, the glass lies below it and the camera's pinhole below the glass.
Lengths are mm, air gaps µm, wavelengths nm. Every class checks its own values; `Sensor` also checks them
against each other.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple

from pydantic import Field
from pydantic.dataclasses import dataclass

from .skin import CONFIG, MIN_EXTINCTION, Absorption, RefractiveIndex, Skin, Tissue

# Bounds far outside of what such a sensor has, so that only slips (a unit, a power of ten) are refused.
Length = Annotated[float, Field(ge=0.05, le=500.0)]
PixelSize = Annotated[float, Field(ge=0.1, le=1000.0)]
Side = Literal["+x", "-x", "+y", "-y"]
Coupling = Literal["air", "embedded"]
Walls = Literal["polished", "absorbing", "diffuse"]


class NotModelled(ValueError):
    """A sensor or a press that the optics cannot show rightly yet; the message is one line."""


class Conflict(NamedTuple):
    """A value that does not fit the others: dotted field, what it holds, what would be allowed."""

    field: str
    received: object
    allowed: str


MAX_PIXELS = 16_000_000
"""Largest picture: some ten arrays of that many numbers are in memory at a time."""
MAX_LAYER_PIXELS = 64_000_000
"""Largest picture times its number of LEDs, each of which has a layer of radiance."""


@dataclass(frozen=True, config=CONFIG)
class Guide:
    """The waveguide as light sees it: a square block of elastomer with one index through all its layers."""

    width_mm: Annotated[Length, Field(description="Side of the square contact surface, mm.")]
    thickness_mm: Annotated[Length, Field(description="Thickness from contact surface to glass, mm.")]
    refractive_index: Annotated[
        RefractiveIndex, Field(description="Refractive index of the guide at the light's wavelength.")
    ] = 1.4336
    absorption_per_mm: Annotated[
        Absorption, Field(description="Absorption coefficient of the guide, 1/mm (PDMS: about 0.001).")
    ] = 0.0
    walls: Annotated[
        Walls,
        Field(
            description="Side faces: polished; or painted, but for windows before LEDs in air: absorbing, "
            "or diffuse (white)."
        ),
    ] = "polished"
    wall_albedo: Annotated[
        float, Field(ge=0.0, le=1.0, description="Share of light that diffuse walls send back, 0 to 1.")
    ] = 0.9


@dataclass(frozen=True, config=CONFIG)
class Glass:
    """The rigid plate between the guide and the camera, as wide as the guide."""

    thickness_mm: Annotated[Length, Field(description="Thickness of the plate, mm.")] = 2.0
    refractive_index: Annotated[
        RefractiveIndex, Field(description="Refractive index of the plate at the light's wavelength.")
    ] = 1.515
    absorption_per_mm: Annotated[
        Absorption, Field(description="Absorption coefficient of the plate, 1/mm.")
    ] = 0.0


@dataclass(frozen=True, config=CONFIG)
class Led:
    """One LED at a side face of the guide: a Lambertian disc that faces the guide's middle."""

    side: Annotated[Side, Field(description="Side face of the guide that the LED sits at: +x, -x, +y or -y.")]
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
    diameter_mm: Annotated[
        float, Field(ge=0.01, le=500.0, description="Diameter of the emitting disc, mm.")
    ] = 1.5
    flux_W: Annotated[
        float, Field(ge=0.0, le=1000.0, description="Radiant flux of the LED, W (0 is a failed LED).")
    ] = 0.010
    coupling: Annotated[
        Coupling,
        Field(
            description="'air': outside, through the flat side face; 'embedded': inside the guide, "
            "which leaks light through the contact surface and shows hot spots."
        ),
    ] = "air"
    gap_mm: Annotated[
        float,
        Field(
            ge=1e-3,
            le=100.0,
            description="Distance of the disc from the side face, mm: outside (air) or inside (embedded).",
        ),
    ] = 0.5

    @property
    def window_mm(self) -> float:
        """Radius of the window before this LED in a painted wall: light from its rim gets in at 45°."""
        return self.diameter_mm / 2 + self.gap_mm


@dataclass(frozen=True, config=CONFIG)
class Camera:
    """The camera below the glass: a pinhole at a distance, and a sensor with EMVA 1288 noise."""

    columns: Annotated[int, Field(ge=1, le=16384, description="Pixels along x.")]
    rows: Annotated[int, Field(ge=1, le=16384, description="Pixels along y.")]
    pixel_um: Annotated[
        tuple[PixelSize, PixelSize],
        Field(description="Width (x) and height (y) of one pixel on the sensor, µm."),
    ]
    field_of_view_mm: Annotated[
        Length,
        Field(description="Width (x) of the part of the contact surface that fills the picture, mm."),
    ]
    distance_mm: Annotated[
        float,
        Field(
            ge=1.0,
            le=10_000.0,
            description="Distance of the pinhole (entrance pupil) below the glass's lower face, mm.",
        ),
    ] = 40.0
    f_number: Annotated[
        float,
        Field(ge=0.5, le=64.0, description="f-number of the lens: focal length over entrance pupil."),
    ] = 4.0
    exposure_ms: Annotated[
        float,
        Field(
            ge=1e-3,
            le=1e5,
            description="Exposure time of one frame, ms; fixed, never chosen per picture.",
        ),
    ] = 10.0
    quantum_efficiency: Annotated[
        float, Field(ge=1e-3, le=1.0, description="Electrons per photon at the light's wavelength, 0 to 1.")
    ] = 0.5
    full_well_e: Annotated[
        float, Field(ge=100.0, le=1e7, description="Electrons at which a pixel saturates.")
    ] = 45_000.0
    read_noise_e: Annotated[
        float, Field(ge=0.0, le=1e4, description="Standard deviation of the read noise, electrons.")
    ] = 12.0
    dark_current_e_s: Annotated[
        float, Field(ge=0.0, le=1e6, description="Dark current of one pixel, electrons per second.")
    ] = 20.0
    prnu_percent: Annotated[
        float,
        Field(ge=0.0, le=100.0, description="Photo-response non-uniformity (spread of the pixels' gain), %."),
    ] = 1.0
    dsnu_e: Annotated[
        float,
        Field(
            ge=0.0,
            le=1e4,
            description="Dark-signal non-uniformity (spread of the pixels' offset), electrons.",
        ),
    ] = 10.0
    gain_e_per_dn: Annotated[float, Field(ge=1e-3, le=1e5, description="Electrons per digital count.")] = (
        45_000.0 / 255.0
    )
    offset_dn: Annotated[
        float, Field(ge=0.0, le=65535.0, description="Counts of a pixel without signal (black level).")
    ] = 4.0
    bits: Annotated[int, Field(ge=8, le=16, description="Bits of one pixel's count: 8 to 16.")] = 8
    pattern_seed: Annotated[
        int,
        Field(
            ge=0,
            lt=2**63,
            description="Seed of the camera's own fixed pattern (PRNU and DSNU): one number, one camera.",
        ),
    ] = 1

    @property
    def field_height_mm(self) -> float:
        """Height (y) of the part of the contact surface that fills the picture, mm."""
        sensor_width, sensor_height = self.columns * self.pixel_um[0], self.rows * self.pixel_um[1]
        return self.field_of_view_mm * sensor_height / sensor_width


@dataclass(frozen=True, config=CONFIG)
class Sensor:
    """All that the optics need to know, checked as a whole."""

    guide: Annotated[Guide, Field(description="The waveguide.")]
    glass: Annotated[Glass, Field(description="The plate between guide and camera.")]
    leds: Annotated[tuple[Led, ...], Field(min_length=1, description="The light sources.")]
    camera: Annotated[Camera, Field(description="The camera below the glass.")]
    skin: Annotated[Skin, Field(description="Rough contact between guide and tissue.")]
    tissue: Annotated[Tissue, Field(description="The specimen's optics.")]
    effective_modulus_kPa: Annotated[
        float,
        Field(
            ge=1e-4,
            le=1e8,
            description="Contact modulus E*, 1/E* = sum of (1 - nu²)/E over guide and tissue, kPa.",
        ),
    ]
    wavelength_nm: Annotated[
        float, Field(ge=350.0, le=1100.0, description="Wavelength of the light, nm.")
    ] = 550.0

    def __post_init__(self) -> None:
        for conflict in conflicts(self.guide, self.leds, self.camera, self.skin):
            raise ValueError(f"{conflict.field}: received {conflict.received!r}; allowed {conflict.allowed}")


def conflicts(guide: Guide, leds: tuple[Led, ...], camera: Camera, skin: Skin) -> Iterator[Conflict]:
    """Yield every value that does not fit the others, in the order of the arguments.

    The fields are named ``leds.0.z_mm``, ``camera.field_of_view_mm``, ``skin.gap_index`` and so on.
    """
    for number, led in enumerate(leds):
        yield from _led_conflicts(f"leds.{number}", led, guide)
    yield from _overlapping_leds(leds, guide)
    yield from _too_many_pixels(camera, len(leds))
    fields = {"width": camera.field_of_view_mm, "height": camera.field_height_mm}
    for name, extent in fields.items():
        if extent > guide.width_mm * (1 + 1e-9):
            yield Conflict(
                "camera.field_of_view_mm",
                camera.field_of_view_mm,
                f"a field whose {name} ({extent:.4g} mm) stays within the guide's {guide.width_mm:g} mm",
            )
            break
    if camera.offset_dn >= 2**camera.bits - 1:
        yield Conflict(
            "camera.offset_dn",
            camera.offset_dn,
            f"a number below the {2**camera.bits - 1} counts of {camera.bits} bits",
        )
    if skin.gap_index >= guide.refractive_index:
        yield Conflict(
            "skin.gap_index",
            skin.gap_index,
            f"a number below the guide's index {guide.refractive_index:g} (else no light is trapped)",
        )
    if skin.sheet and skin.sheet.scattering_per_mm + skin.sheet.absorption_per_mm < MIN_EXTINCTION:
        yield Conflict(
            "skin.sheet.scattering_per_mm",
            skin.sheet.scattering_per_mm,
            f"with the absorption at least {MIN_EXTINCTION:g} per mm (clear sheets are part of the guide)",
        )


def _led_conflicts(path: str, led: Led, guide: Guide) -> Iterator[Conflict]:
    """The emitting disc must lie on its side face, and an embedded one in its own half of the guide."""
    radius, width, thickness = led.diameter_mm / 2, guide.width_mm, guide.thickness_mm
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


def _too_many_pixels(camera: Camera, leds: int) -> Iterator[Conflict]:
    pixels = camera.rows * camera.columns
    if pixels > MAX_PIXELS:
        allowed = f"at most {MAX_PIXELS // camera.columns} with {camera.columns} columns"
        yield Conflict("camera.rows", camera.rows, f"{allowed} ({MAX_PIXELS // 1_000_000} million pixels)")
    elif pixels * leds > MAX_LAYER_PIXELS:
        allowed = f"at most {MAX_LAYER_PIXELS // camera.columns // leds} with {camera.columns} columns"
        most = f"{MAX_LAYER_PIXELS // 1_000_000} million pixels times LEDs"
        yield Conflict("camera.rows", camera.rows, f"{allowed} and {leds} LEDs ({most})")


def _overlapping_leds(leds: tuple[Led, ...], guide: Guide) -> Iterator[Conflict]:
    """No two discs may overlap in one plane, nor embedded ones of neighbouring sides cut each other."""
    for number, led in enumerate(leds):
        for earlier in range(number):
            if _touch(leds[earlier], led, guide):
                place = (led.side, led.along_mm, led.z_mm)
                yield Conflict(f"leds.{number}", place, f"a place where it does not cut leds.{earlier}")


def _touch(one: Led, other: Led, guide: Guide) -> bool:
    radii = one.diameter_mm / 2, other.diameter_mm / 2
    if one.coupling != other.coupling:
        return False  # the side face lies between them
    if one.side == other.side:
        apart = math.hypot(one.along_mm - other.along_mm, one.z_mm - other.z_mm)
        return math.isclose(one.gap_mm, other.gap_mm, abs_tol=1e-9) and apart < sum(radii) * (1 - 1e-9)
    if one.coupling == "air" or one.side[1] == other.side[1]:
        return False  # outside different faces, or parallel planes in different halves of the guide
    # Planes of neighbouring sides meet in an upright line; each disc covers a stretch of it, if any.
    away = other.along_mm - _plane(one, guide), one.along_mm - _plane(other, guide)
    squares = radii[1] ** 2 - away[0] ** 2, radii[0] ** 2 - away[1] ** 2
    if min(squares) <= 0.0:
        return False
    return abs(one.z_mm - other.z_mm) < math.sqrt(squares[0]) + math.sqrt(squares[1])


def _plane(led: Led, guide: Guide) -> float:
    """The x (or y) of an embedded LED's disc, mm."""
    return float(f"{led.side[0]}1") * (guide.width_mm / 2 - led.gap_mm)
