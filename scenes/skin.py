"""What the guide touches, as contact and light see it: roughness, dust, sheet, tissue (no Mitsuba here).

Lengths are mm, gaps and roughness µm, coefficients 1/mm. Every class checks its own values.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Literal

from pydantic import ConfigDict, Field
from pydantic.dataclasses import dataclass

CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)

RefractiveIndex = Annotated[float, Field(ge=1.0, le=4.0)]
ContactState = Literal["rough", "full"]
Scattering = Annotated[float, Field(ge=0.01, le=1000.0)]
SheetScattering = Annotated[float, Field(ge=0.0, le=1000.0)]
Absorption = Annotated[float, Field(ge=0.0, le=1000.0)]
Anisotropy = Annotated[float, Field(ge=-0.9, le=0.99)]

_SCATTERING = "Reduced scattering coefficient µs' = (1 - g) µs of the {}, 1/mm."
_ABSORPTION = "Absorption coefficient µa of the {}, 1/mm."
_ANISOTROPY = "Mean cosine g of one scattering; 0 is even, skin has about 0.9."

_COLOUR = ("scattering_per_mm", "absorption_per_mm", "anisotropy")

MAX_CONTRAST = 20.0
"""Largest extinction µs + µa (µs not reduced) of an inclusion, over the tissue's: free paths everywhere are
drawn for the denser of the two (`walk.roam`), and take that much longer."""

MIN_EXTINCTION = 0.01
"""Least scattering and absorption together of a contact sheet, 1/mm."""


@dataclass(frozen=True, config=CONFIG)
class Sheet:
    """A compliant sheet on the guide: the light gets no farther, the tissue presses from behind.

    The roughness is that of `Skin`. Its stiffness counts in the contact of the rough faces only; the press
    itself leaves it out, which is right for sheets that are thin beside the inclusion's depth.
    """

    thickness_mm: Annotated[float, Field(ge=0.02, le=50.0, description="Thickness of the sheet, mm.")]
    modulus_kPa: Annotated[
        float,
        Field(
            ge=1e-3, le=1e7, description="Young's modulus of the sheet, kPa; enters the rough contact only."
        ),
    ]
    poisson: Annotated[
        float, Field(ge=0.0, le=0.4999, description="Poisson's ratio of the sheet, up to 0.4999.")
    ] = 0.49
    refractive_index: Annotated[RefractiveIndex, Field(description="Refractive index of the sheet.")] = 1.41
    scattering_per_mm: Annotated[SheetScattering, Field(description=_SCATTERING.format("sheet"))] = 10.0
    absorption_per_mm: Annotated[Absorption, Field(description=_ABSORPTION.format("sheet"))] = 0.01
    backing: Annotated[
        float,
        Field(ge=0.0, le=1.0, description="Reflectance of what lies behind the sheet, 0 (black) to 1."),
    ] = 0.0


@dataclass(frozen=True, config=CONFIG)
class Skin:
    """The contact between guide and tissue: how pressure turns into real contact and gaps."""

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
            ge=1.0,
            le=4.0,
            description="Refractive index of what fills the gaps: 1 for air, 1.33 for water or gel.",
        ),
    ] = 1.0
    contact: Annotated[
        ContactState,
        Field(description="rough: real contact grows with pressure; full: wherever pressed (adhesion, gel)."),
    ] = "rough"
    dust: Annotated[
        float,
        Field(ge=0.0, le=1.0, description="Share of the area that never touches, as under talc, 0 to 1."),
    ] = 0.0
    sheet: Annotated[
        Sheet | None,
        Field(
            description="A sheet on the guide that the light enters in the tissue's place; none if absent."
        ),
    ] = None


@dataclass(frozen=True, config=CONFIG)
class Colour:
    """An inclusion's own optics; what is left out is the tissue's, as its refractive index always is."""

    scattering_per_mm: Annotated[
        Scattering | None, Field(description=_SCATTERING.format("inclusion; the tissue's if left out"))
    ] = None
    absorption_per_mm: Annotated[
        Absorption | None, Field(description=_ABSORPTION.format("inclusion; the tissue's if left out"))
    ] = None
    anisotropy: Annotated[
        Anisotropy | None, Field(description="Mean cosine g of one scattering; the tissue's if left out.")
    ] = None

    def of(self, tissue: Tissue) -> Tissue:
        """The tissue, with this in the place of its own."""
        own = {name: getattr(self, name) for name in _COLOUR}
        return replace(tissue, **{name: value for name, value in own.items() if value is not None})


@dataclass(frozen=True, config=CONFIG)
class Tissue:
    """The specimen, as light sees it: it scatters in depth."""

    refractive_index: Annotated[RefractiveIndex, Field(description="Refractive index of the specimen.")] = (
        1.40
    )
    scattering_per_mm: Annotated[Scattering, Field(description=_SCATTERING.format("tissue"))] = 1.0
    absorption_per_mm: Annotated[Absorption, Field(description=_ABSORPTION.format("tissue"))] = 0.02
    anisotropy: Annotated[Anisotropy, Field(description=_ANISOTROPY)] = 0.0

    @property
    def extinction_per_mm(self) -> float:
        """µs + µa, 1/mm, with µs not reduced."""
        return self.scattering_per_mm / (1.0 - self.anisotropy) + self.absorption_per_mm
