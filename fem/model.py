"""The nouns of a press: waveguide layers, probe, tissue slab, inclusion; and what is refused.

Frame: origin at the centre of the undeformed contact surface, +z into the specimen. Lengths mm, moduli kPa.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

# Bounds far outside of what a tactile sensor or tissue has, so that only slips (a unit, a power of ten) and
# what the elements cannot resolve are refused.
Length = Annotated[float, Field(ge=0.05, le=500)]
Modulus = Annotated[float, Field(ge=1e-3, le=1e7, description="Young's modulus, kPa")]
Poisson = Annotated[float, Field(ge=0, le=0.4999, description="Poisson's ratio; up to 0.4999 does not lock")]

MAX_SLENDERNESS = 10.0
"""Widest slab, in thicknesses: beyond it the elements outside the probe are so long that the force of a 2 mm
press is off by more than 2 %."""


def _number(value: object) -> float:
    """Refuse the text and the truth values that pydantic would read as numbers; numpy's scalars pass."""
    if isinstance(value, str | bytes | bool) or not hasattr(value, "__float__"):
        raise ValueError("a number")
    return float(value)


_NUMBER = BeforeValidator(_number)
Offset = Annotated[float, Field(ge=-500, le=500), _NUMBER]


class NotModelled(ValueError):
    """Physics that this version does not model, such as contact that opens: one line says which."""


@dataclass(frozen=True, config=_STRICT)
class Layer:
    """One elastic layer of the waveguide."""

    thickness_mm: Annotated[Length, Field(description="thickness, mm")]
    modulus_kPa: Modulus
    poisson: Poisson = 0.49


@dataclass(frozen=True, config=_STRICT)
class Probe:
    """Square layered waveguide; `layers` run from the contact side, the last is bonded to rigid glass."""

    width_mm: Annotated[Length, Field(description="side of the square contact surface, mm")]
    layers: Annotated[tuple[Layer, ...], Field(min_length=1, description="layers from the contact side")]

    @property
    def thickness_mm(self) -> float:
        return sum(layer.thickness_mm for layer in self.layers)


@dataclass(frozen=True, config=_STRICT)
class Slab:
    """Square tissue slab, sides free, its far face fully fixed to the chest wall at z = thickness."""

    thickness_mm: Annotated[Length, Field(description="thickness from contact surface to chest wall, mm")]
    width_mm: Annotated[Length, Field(description="side of the square slab, mm")]
    modulus_kPa: Modulus
    poisson: Poisson = 0.49


@dataclass(frozen=True, config=_STRICT)
class Inclusion:
    """Stiff sphere bonded in the tissue.

    `depth` goes to its *top*, the point nearest the contact surface (with the centre's depth the largest
    inclusion of the source paper would stick out of the tissue). `offset` is inclusion minus probe centre.
    """

    size: Annotated[float, Field(ge=0.1, le=500, description="diameter, mm"), _NUMBER]
    depth: Annotated[float, Field(ge=0.1, le=500, description="depth to the top, mm"), _NUMBER]
    modulus: Annotated[Modulus, _NUMBER]
    offset: Annotated[tuple[Offset, Offset], Field(description="inclusion minus probe centre, mm")] = (
        0.0,
        0.0,
    )
    poisson: Annotated[Poisson, _NUMBER] = 0.49

    @property
    def centre_mm(self) -> float:
        """Depth of the centre, mm."""
        return self.depth + self.size / 2


def check(probe: Probe, slab: Slab, inclusion: Inclusion | None) -> None:
    """Raise ValueError for the impossible and NotModelled for the merely unsupported, in one line."""
    if probe.width_mm > slab.width_mm:
        raise NotModelled(
            f"probe.width_mm: received {probe.width_mm:g}; not modelled: a probe that overhangs the slab, "
            f"allowed up to slab.width_mm = {slab.width_mm:g}"
        )
    if slab.width_mm > MAX_SLENDERNESS * slab.thickness_mm:
        raise NotModelled(
            f"slab.width_mm: received {slab.width_mm:g}; not modelled: slabs this much wider than thick, "
            f"allowed up to {MAX_SLENDERNESS:g} x slab.thickness_mm = {MAX_SLENDERNESS * slab.thickness_mm:g}"
        )
    if inclusion is None:
        return
    bottom = inclusion.depth + inclusion.size
    if bottom >= slab.thickness_mm:
        raise ValueError(
            f"inclusion.depth + inclusion.size: received {bottom:g} mm; "
            f"allowed below the chest wall at slab.thickness_mm = {slab.thickness_mm:g} mm"
        )
    reach = max(abs(inclusion.offset[0]), abs(inclusion.offset[1])) + inclusion.size / 2
    if reach >= slab.width_mm / 2:
        raise ValueError(
            f"inclusion.offset + inclusion.size / 2: received {reach:g} mm from the centre; "
            f"allowed inside the slab, below {slab.width_mm / 2:g} mm"
        )
    if inclusion.offset != (0.0, 0.0):
        x, y = inclusion.offset
        raise NotModelled(
            f"inclusion.offset: received ({x:g}, {y:g}) mm; "
            "not modelled yet: off-centre inclusions, allowed (0, 0)"
        )
    widest = 0.9 * probe.width_mm
    if inclusion.size > widest:
        raise NotModelled(
            f"inclusion.size: received {inclusion.size:g} mm; not modelled: inclusions as wide as the probe, "
            f"allowed up to {widest:g} mm"
        )
