"""The sensor as light sees it: guide, glass, LEDs, camera, skin and tissue (no Mitsuba here).

Frame: the origin is the centre of the undeformed contact surface and +z points into the specimen, so the
guide fills ``-thickness_mm <= z <= 0``, the glass lies below it and the camera's pinhole below the glass.
Lengths are mm, air gaps µm, wavelengths nm. Every class checks its own values; `Sensor` also checks them
against each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated

from pydantic import Field
from pydantic.dataclasses import dataclass

from .dispersion import GLASS, Glassware
from .imager import Camera, camera_conflicts
from .led import Led, Side, led_conflicts
from .quantity import CONFIG, Conflict, Length, RefractiveIndex, Wavelength

__all__ = [
    "Camera",
    "Conflict",
    "Glass",
    "Guide",
    "Led",
    "NotModelled",
    "RefractiveIndex",
    "Sensor",
    "Side",
    "Skin",
    "Tissue",
    "conflicts",
]


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

    def at(self, wavelength_nm: float) -> Glass:
        """Return the plate as light of this wavelength sees it."""
        if self.material is None:
            return self
        return replace(self, refractive_index=GLASS[self.material](wavelength_nm), material=None)


@dataclass(frozen=True, config=CONFIG)
class Skin:
    """Rough contact between guide and tissue: how pressure turns into real contact and air gaps."""

    rms_slope: Annotated[
        float,
        Field(
            ge=0.01,
            le=20.0,
            description="Root-mean-square slope h' of the tissue's surface, without unit.",
        ),
    ] = 2.0
    rms_height_um: Annotated[
        float,
        Field(
            ge=0.1,
            le=1000.0,
            description="Root-mean-square height of the tissue's surface, µm; sets the gaps outside contact.",
        ),
    ] = 10.0
    kappa: Annotated[
        float,
        Field(
            ge=1.0,
            le=4.0,
            description="Factor of the contact law: 1.6 (Persson) to 2.5 (Bush, Gibson and Thomas).",
        ),
    ] = 1.6
    gap_index: Annotated[
        float,
        Field(
            ge=1.0, le=4.0, description="Refractive index of what fills the gaps: 1 for air, 1.33 for water."
        ),
    ] = 1.0


@dataclass(frozen=True, config=CONFIG)
class Tissue:
    """The specimen's surface, as light sees it."""

    refractive_index: Annotated[RefractiveIndex, Field(description="Refractive index of the specimen.")] = (
        1.40
    )
    albedo: Annotated[
        float,
        Field(
            ge=0.0,
            lt=1.0,
            description="Share of the light that enters the specimen and comes back out, 0 to 1.",
        ),
    ] = 0.68


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

    def __post_init__(self) -> None:
        for conflict in conflicts(self.guide, self.leds, self.camera, self.skin):
            raise ValueError(f"{conflict.field}: received {conflict.received!r}; allowed {conflict.allowed}")


def conflicts(guide: Guide, leds: tuple[Led, ...], camera: Camera, skin: Skin) -> Iterator[Conflict]:
    """Yield every value that does not fit the others, in the order of the arguments.

    The fields are named ``leds.0.z_mm``, ``camera.field_of_view_mm``, ``skin.gap_index`` and so on.
    """
    yield from led_conflicts(leds, guide.width_mm, guide.thickness_mm)
    yield from camera_conflicts(camera, guide.width_mm, guide.thickness_mm, len(leds))
    if skin.gap_index >= guide.refractive_index:
        yield Conflict(
            "skin.gap_index",
            skin.gap_index,
            f"a number below the guide's index {guide.refractive_index:g} (else no light is trapped)",
        )
