"""The sensor as light sees it: guide, glass, LEDs, camera, skin, sheet and tissue (no Mitsuba here).

Frame: the origin is the centre of the undeformed contact surface and +z points into the specimen, so the
guide fills ``-thickness_mm <= z <= 0``, the glass lies below it and the camera's pinhole below the glass.
Lengths are mm, air gaps µm, wavelengths nm. Every class checks its own values; `Sensor` also checks them
against each other.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import field, replace
from itertools import accumulate, pairwise
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
    "Housing",
    "Led",
    "Lower",
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
class Lower:
    """A layer of the guide under its first one, of another index than its neighbours'."""

    thickness_mm: Annotated[Length, Field(description="Thickness of the layer, mm.")]
    refractive_index: Annotated[RefractiveIndex, Field(description="Refractive index of the layer.")]


@dataclass(frozen=True, config=CONFIG)
class Guide:
    """The waveguide as light sees it: a square block of elastomer, of one index or in layers.

    The faces between layers are horizontal planes, where they lie unpressed.
    """

    width_mm: Annotated[Length, Field(description="Side of the square contact surface, mm.")]
    thickness_mm: Annotated[Length, Field(description="Thickness from contact surface to glass, mm.")]
    refractive_index: Annotated[
        RefractiveIndex,
        Field(description="Refractive index of the guide at the contact, at the light's wavelength."),
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
    # not in the repr: what is hashed of guides of one index stays what it was
    lower: Annotated[
        tuple[Lower, ...],
        Field(
            max_length=15,
            description="Layers of other index under the first, which is what they leave of the thickness; "
            "the last lies on the glass.",
        ),
    ] = field(default=(), repr=False)

    def __post_init__(self) -> None:
        """The first layer has a thickness, and neighbours differ."""
        if self.top_mm < MIN_LAYER_MM * (1.0 - 1e-9):
            allowed = f"layers that leave the first one {MIN_LAYER_MM:g} mm of {self.thickness_mm:g} mm"
            raise ValueError(f"lower: received {self.thickness_mm - self.top_mm:g} mm; allowed {allowed}")
        indices = [index for _, index in self.layers]
        if any(same(*pair) for pair in pairwise(indices)):
            raise ValueError(f"lower: received indices {indices}; allowed neighbours that differ")

    @property
    def top_mm(self) -> float:
        """Thickness of the layer under the contact, mm: of all the guide where it has one index."""
        return self.thickness_mm - sum(layer.thickness_mm for layer in self.lower)

    @property
    def layers(self) -> tuple[tuple[float, float], ...]:
        """Thickness, mm, and index of each layer, from the contact side."""
        return (
            (self.top_mm, self.refractive_index),
            *((layer.thickness_mm, layer.refractive_index) for layer in self.lower),
        )

    @property
    def floors_mm(self) -> tuple[float, ...]:
        """Height of each layer's lower face, mm, from the contact side; the last is the glass's."""
        floors = accumulate(thickness for thickness, _ in self.layers[:-1])
        return (*(-depth for depth in floors), -self.thickness_mm)

    @property
    def bottom_index(self) -> float:
        """Refractive index at the glass."""
        return self.layers[-1][1]

    def index_at(self, z_mm: float) -> float:
        """Refractive index at a height, mm."""
        heights = zip(self.layers, self.floors_mm, strict=True)
        return next((index for (_, index), floor in heights if z_mm > floor), self.bottom_index)

    def under_contact_mm(self, share: float) -> float:
        """Height, mm, of a place so far down the guide, but no lower than its first layer."""
        return -min(share * self.thickness_mm, self.top_mm - 1e-3)


def same(index: float, other: float) -> bool:
    """Whether two indices are one to light: single precision cannot tell them apart."""
    return abs(index - other) < 1e-6


MIN_LAYER_MM = 0.05
"""Thinnest layer of the guide with an index of its own, as `Length` has it."""


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
class Housing:
    """The box below the glass, as wide as the guide, with the camera's pinhole in its floor."""

    reflectance: Annotated[
        float,
        Field(ge=0.0, le=0.98, description="Share of light that its inside sends back, evenly; 0: black."),
    ] = 0.0

    @property
    def reflects(self) -> bool:
        """Whether any light comes back from it."""
        return self.reflectance > 0.0


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
    # not in the repr: what is hashed of sensors in black stays what it was
    housing: Annotated[Housing, Field(description="The box below the glass.")] = field(
        default=Housing(), repr=False
    )

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
            f"a number below the guide's index {guide.refractive_index:g}"
            f"{' at the contact' if guide.lower else ''} (else no light is trapped)",
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
