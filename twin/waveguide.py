"""The waveguide of a design: what its layers are to the press and to light."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

import fem
from fem.model import DomeRadius, Length
from scenes import dispersion
from scenes.sensor import Guide, Lower, Walls, same
from scenes.skin import Absorption, RefractiveIndex

CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)


@dataclass(frozen=True, config=CONFIG)
class Layer(fem.Layer):
    """One layer of the waveguide: elastic, and transparent."""

    refractive_index: Annotated[
        RefractiveIndex | None,
        Field(
            description="Refractive index of this layer, the same for all light; that of the waveguide if "
            "left out."
        ),
    ] = None


def _transparent(layer: Any) -> Any:
    """A layer of the mechanics as one of the design."""
    return Layer(**vars(layer)) if type(layer) is fem.Layer else layer


@dataclass(frozen=True, config=CONFIG)
class Waveguide:
    """The waveguide: a square, layered block of transparent elastomer, bonded to the glass."""

    width_mm: Annotated[Length, Field(description="Side of the square contact surface, mm.")]
    layers: Annotated[
        tuple[Annotated[Layer, BeforeValidator(_transparent)], ...],
        Field(min_length=1, max_length=16, description="Elastic layers, from the contact side."),
    ]
    refractive_index: Annotated[
        RefractiveIndex | None,
        Field(
            description="Refractive index of all layers that have none of their own, the same for all light; "
            "that of Sylgard 184, which falls with the wavelength, if left out."
        ),
    ] = None
    absorption_per_mm: Annotated[
        Absorption, Field(description="Absorption coefficient of all layers, 1/mm (PDMS: about 0.001).")
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
    dome_radius_mm: Annotated[
        DomeRadius,
        Field(description="Radius of a domed contact surface with its apex in the middle, mm; none if flat."),
    ] = None

    @property
    def thickness_mm(self) -> float:
        """Thickness of all layers together, mm."""
        return sum(layer.thickness_mm for layer in self.layers)

    def optics(self, wavelength_nm: float) -> Guide:
        """Return the waveguide as light of a wavelength sees it.

        Layers beside each other that have one index are one to light.
        """
        index = self.refractive_index or dispersion.pdms(wavelength_nm)
        found: list[Lower] = []
        for layer in self.layers:
            one = Lower(layer.thickness_mm, layer.refractive_index or index)
            if found and same(found[-1].refractive_index, one.refractive_index):
                above = found.pop()
                one = Lower(above.thickness_mm + one.thickness_mm, above.refractive_index)
            found.append(one)
        return Guide(
            width_mm=self.width_mm,
            thickness_mm=self.thickness_mm,
            refractive_index=found[0].refractive_index,
            absorption_per_mm=self.absorption_per_mm,
            walls=self.walls,
            wall_albedo=self.wall_albedo,
            lower=tuple(found[1:]),
        )
