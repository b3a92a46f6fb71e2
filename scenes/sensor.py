"""The sensor as light sees it: guide, glass, LEDs, camera, skin, sheet and tissue (no Mitsuba here).

Frame: the origin is the centre of the undeformed contact surface and +z points into the specimen, so the
guide fills ``-thickness_mm <= z <= 0``, the glass lies below it and the camera's pinhole below the glass.
Lengths are mm, air gaps µm, wavelengths nm. Every class checks its own values; `Sensor` also checks them
against each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Literal

from pydantic import Field
from pydantic.dataclasses import dataclass

from .dispersion import GLASS, Glassware
from .imager import Camera, camera_conflicts
from .led import Led, Side, led_conflicts
from .quantity import CONFIG, Conflict, Length, RefractiveIndex, Wavelength
from .skin import MAX_CONTRAST, MIN_EXTINCTION, Absorption, Colour, Skin, Tissue

__all__ = [
    "Camera",
    "Conflict",
    "Glass",
    "Guide",
    "Led",
    "NotModelled",
    "Sensor",
    "Side",
    "Walls",
    "conflicts",
]

Walls = Literal["polished", "absorbing", "diffuse"]


class NotModelled(ValueError):
    """A sensor or a press that the optics cannot show rightly yet; the message is one line."""


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
        RefractiveIndex, Field(description="Refractive index of the plate, the same for all light.")
    ] = 1.515
    material: Annotated[
        Glassware | None,
        Field(description="Glass whose index over wavelength takes the place of refractive_index."),
    ] = None
    absorption_per_mm: Annotated[
        Absorption, Field(description="Absorption coefficient of the plate, 1/mm.")
    ] = 0.0

    def at(self, wavelength_nm: float) -> Glass:
        """Return the plate as light of this wavelength sees it."""
        if self.material is None:
            return self
        return replace(self, refractive_index=GLASS[self.material](wavelength_nm), material=None)


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
    wavelength_nm: Annotated[Wavelength, Field(description="Wavelength of the light, nm.")] = 550.0
    inclusion: Annotated[
        Colour | None, Field(description="An inclusion's own optics; only the reference quality sees it.")
    ] = None

    def __post_init__(self) -> None:
        found = list(conflicts(self.guide, self.leds, self.camera, self.skin, self.glass))
        found += colour_conflicts(self.inclusion, self.tissue, self.skin)
        for conflict in found[:1]:
            raise ValueError(f"{conflict.field}: received {conflict.received!r}; allowed {conflict.allowed}")


def conflicts(
    guide: Guide, leds: tuple[Led, ...], camera: Camera, skin: Skin, glass: Glass | None = None
) -> Iterator[Conflict]:
    """Yield every value that does not fit the others, in the order of the arguments.

    The fields are named ``leds.0.z_mm``, ``camera.field_of_view_mm``, ``skin.gap_index`` and so on.
    """
    plate = glass or Glass()
    yield from led_conflicts(leds, guide.width_mm, guide.thickness_mm, plate.thickness_mm, camera.distance_mm)
    yield from camera_conflicts(camera, guide.width_mm, guide.thickness_mm, len(leds))
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


def colour_conflicts(colour: Colour | None, tissue: Tissue, skin: Skin) -> Iterator[Conflict]:
    """Yield what keeps an inclusion's own optics from being walked in."""
    if colour is None:
        return
    if skin.sheet is not None:
        yield Conflict("inclusion", "it behind a contact sheet", "none: no light gets past the sheet")
    most, own = MAX_CONTRAST * tissue.extinction_per_mm, colour.of(tissue).extinction_per_mm
    if own > most:
        allowed = f"µs + µa (µs = µs' / (1 - g)) up to {most:.3g} per mm, {MAX_CONTRAST:g} times the tissue's"
        yield Conflict("inclusion", f"{own:.3g} per mm of scattering and absorption", allowed)
