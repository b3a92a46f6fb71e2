"""The nouns of a press: waveguide layers, probe, tissue slab, inclusion; and what is refused.

Frame: origin at the centre of the undeformed contact surface, +z into the specimen. Lengths mm, moduli kPa.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, ConfigDict, Field
from pydantic.dataclasses import dataclass

_STRICT = ConfigDict(extra="forbid", allow_inf_nan=False)

# Bounds far outside of what a tactile sensor or tissue has, so that only slips (a unit, a power of ten) and
# what the elements cannot resolve are refused.
Length = Annotated[float, Field(ge=0.05, le=500)]
Modulus = Annotated[float, Field(ge=1e-3, le=1e7, description="Young's modulus, kPa")]
Poisson = Annotated[float, Field(ge=0, le=0.4999, description="Poisson's ratio; up to 0.4999 does not lock")]

MAX_TILT = 10.0
"""Steepest tilt, degrees: at 10 degrees a 25 mm probe dips one edge 2 mm before its centre touches."""

MAX_SLENDERNESS = 10.0
"""Widest slab, in thicknesses: beyond it the elements outside the probe are so long that the force of a 2 mm
press is off by more than 2 %."""


MAX_SAG = 0.8
"""Highest dome, as a share of the contact layer's thickness."""


def _number(value: object) -> float:
    """Refuse the text and the truth values that pydantic would read as numbers; numpy's scalars pass."""
    if isinstance(value, str | bytes | bool) or not hasattr(value, "__float__"):
        raise ValueError("a number")
    return float(value)


_NUMBER = BeforeValidator(_number)
Offset = Annotated[float, Field(ge=-500, le=500), _NUMBER]
Stretch = Annotated[float, Field(ge=0.2, le=5), _NUMBER]
Tilt = Annotated[float, Field(ge=-MAX_TILT, le=MAX_TILT), _NUMBER]
DomeRadius = Annotated[
    Annotated[float, Field(ge=0.1, le=1e6)] | None,
    Field(description="radius of a domed contact surface, mm, apex in the middle; none for a flat one"),
]
Sides = Annotated[
    Literal["free", "symmetric"],
    Field(description='the slab\'s sides: "free", or "symmetric" (no displacement across them)'),
]


class NotModelled(ValueError):
    """Physics that this version does not model, such as contact that opens: one line says which."""


class NotConverged(ValueError):
    """No equilibrium was found: one line says how far the press got."""


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
    dome_radius_mm: DomeRadius = None

    @property
    def thickness_mm(self) -> float:
        return sum(layer.thickness_mm for layer in self.layers)

    @property
    def sag_mm(self) -> float:
        """How far the corners of a domed contact surface lie below its apex, mm; infinite if it misses
        them."""
        if self.dome_radius_mm is None:
            return 0.0
        below = self.dome_radius_mm**2 - self.width_mm**2 / 2
        return self.dome_radius_mm - math.sqrt(below) if below > 0 else math.inf


@dataclass(frozen=True, config=_STRICT)
class Slab:
    """Square tissue slab, its far face fully fixed to the chest wall at z = thickness.

    `sides`: "free", or "symmetric": no displacement across them, as if the tissue went on mirrored.
    """

    thickness_mm: Annotated[Length, Field(description="thickness from contact surface to chest wall, mm")]
    width_mm: Annotated[Length, Field(description="side of the square slab, mm")]
    modulus_kPa: Modulus
    poisson: Poisson = 0.49
    sides: Sides = "free"


@dataclass(frozen=True, config=_STRICT)
class Inclusion:
    """Sphere or ellipsoid bonded in the tissue.

    `stretch` turns the sphere into an ellipsoid: its diameters along x, y, z are `size * stretch`. `depth`
    goes to its *top*, the point nearest the contact surface (with the centre's depth the largest
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
    stretch: Annotated[
        tuple[Stretch, Stretch, Stretch], Field(description="diameters along x, y, z over size")
    ] = (1.0, 1.0, 1.0)

    @property
    def radii_mm(self) -> tuple[float, float, float]:
        """Half diameters along x, y, z, mm."""
        x, y, z = self.stretch
        return self.size * x / 2, self.size * y / 2, self.size * z / 2

    @property
    def centre_mm(self) -> float:
        """Depth of the centre, mm."""
        return self.depth + self.radii_mm[2]


@dataclass(frozen=True, config=_STRICT)
class Pose:
    """How the probe meets the slab.

    `tilt_deg` turns the probe about the x and then the y axis through the centre of its contact surface;
    `position_mm` is its centre minus the slab's.
    """

    tilt_deg: Annotated[tuple[Tilt, Tilt], Field(description="rotation about x and y, degrees")] = (0.0, 0.0)
    position_mm: Annotated[tuple[Offset, Offset], Field(description="probe minus slab centre, mm")] = (
        0.0,
        0.0,
    )


STRAIGHT = Pose()
"""Straight down, above the slab's middle."""


def check(probe: Probe, slab: Slab, inclusion: Inclusion | None, pose: Pose = STRAIGHT) -> None:
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
    thinnest = probe.layers[0].thickness_mm * MAX_SAG
    if probe.sag_mm > thinnest:
        raise ValueError(
            f"probe.dome_radius_mm: received {probe.dome_radius_mm:g}, whose corners lie "
            f"{probe.sag_mm:.3g} mm below the apex; allowed are domes less than {thinnest:g} mm high "
            f"({MAX_SAG:.0%} of the contact layer)"
        )
    room = (slab.width_mm - probe.width_mm) / 2
    away = max(abs(p) for p in pose.position_mm)
    if away > 0 and away > room - 0.02 * slab.width_mm:
        raise NotModelled(
            f"position: received ({pose.position_mm[0]:g}, {pose.position_mm[1]:g}) mm; "
            f"not modelled: a probe at or over the slab's side, "
            f"allowed up to {max(0.0, room - 0.02 * slab.width_mm):g} mm"
        )
    if any(pose.tilt_deg) and slab.sides == "symmetric":
        raise NotModelled(
            f"tilt: received ({pose.tilt_deg[0]:g}, {pose.tilt_deg[1]:g}) degrees "
            "with slab.sides = symmetric; not modelled: allowed are free sides"
        )
    if inclusion is not None:
        _check_inclusion(probe, slab, inclusion, pose)


def _check_inclusion(probe: Probe, slab: Slab, inclusion: Inclusion, pose: Pose) -> None:
    bottom = inclusion.depth + 2 * inclusion.radii_mm[2]
    if bottom >= slab.thickness_mm:
        raise ValueError(
            f"inclusion.depth + inclusion.size: received {bottom:g} mm; "
            f"allowed below the chest wall at slab.thickness_mm = {slab.thickness_mm:g} mm"
        )
    for axis in (0, 1):
        reach = abs(inclusion.offset[axis] + pose.position_mm[axis]) + inclusion.radii_mm[axis]
        if reach >= slab.width_mm / 2:
            raise ValueError(
                f"inclusion.offset + inclusion.size / 2: received {reach:g} mm from the slab's centre; "
                f"allowed inside the slab, below {slab.width_mm / 2:g} mm"
            )
    if max(abs(o) for o in inclusion.offset) > probe.width_mm / 2:
        x, y = inclusion.offset
        raise NotModelled(
            f"inclusion.offset: received ({x:g}, {y:g}) mm; not modelled: inclusions beside the probe, "
            f"allowed up to {probe.width_mm / 2:g} mm, the probe's edge"
        )
    widest = 0.9 * probe.width_mm
    size = 2 * max(inclusion.radii_mm[:2])
    if size > widest:
        raise NotModelled(
            f"inclusion.size: received {size:g} mm; not modelled: inclusions as wide as the probe, "
            f"allowed up to {widest:g} mm"
        )
