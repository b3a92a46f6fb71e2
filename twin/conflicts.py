"""What cannot stand together in a design, its press and an inclusion, in terms of the design's fields.

The mechanics refuse the same in their own words (`fem.model.check`); here it is found before any work, under
the names that a designer wrote.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import TYPE_CHECKING

from fem import Inclusion
from fem.model import MAX_SAG, MAX_SLENDERNESS
from scenes.sensor import colour_conflicts
from scenes.sensor import conflicts as optical_conflicts
from scenes.spectrum import longest
from twin.complaint import DesignError, shown

if TYPE_CHECKING:
    from twin.design import Design

MAX_THICKNESS_MM = 500.0
"""Thickest waveguide, as `scenes.sensor.Guide` has it."""

_MARGIN = 0.02
"""Least distance of the edge of a probe off the centre from the slab's side, in widths of the slab."""

_WIDEST = 0.9
"""Widest inclusion, in widths of the probe."""


def design_conflicts(design: Design) -> Iterator[DesignError]:
    """Yield a complaint for every value of a design that does not fit the others."""
    thickness = design.waveguide.thickness_mm
    if thickness > MAX_THICKNESS_MM:
        allowed = f"layers of at most {MAX_THICKNESS_MM:g} mm together"
        yield DesignError("waveguide.layers", f"{thickness:g} mm", allowed)
        return
    slab = design.specimen
    widest = MAX_SLENDERNESS * slab.thickness_mm
    if slab.width_mm > widest:
        allowed = f"at most {MAX_SLENDERNESS:g} times its thickness, {widest:g} mm (else the mesh is coarse)"
        yield DesignError("specimen.width_mm", shown(slab.width_mm), allowed)
    yield from _dome_conflicts(design)
    redmost = design.guide(longest(design.leds, design.light.wavelength_nm))  # where the index is lowest
    for conflict in optical_conflicts(redmost, design.leds, design.camera, design.surface, design.glass):
        field = conflict.field.replace("skin.", "surface.")
        yield DesignError(field, shown(conflict.received), conflict.allowed)
    for conflict in colour_conflicts(slab.inclusion, design.tissue(), design.surface):
        yield DesignError(f"specimen.{conflict.field}", str(conflict.received), conflict.allowed)
    if slab.width_mm < design.waveguide.width_mm:
        allowed = f"at least the waveguide's width of {design.waveguide.width_mm:g} mm"
        yield DesignError("specimen.width_mm", shown(slab.width_mm), allowed)
    else:
        yield from _pose_conflicts(design)
    for number, depth in enumerate(design.press.indentation_mm):
        if depth > design.max_indentation_mm:
            yield DesignError(f"press.indentation_mm.{number}", shown(depth), design.depth_in_words)


def _dome_conflicts(design: Design) -> Iterator[DesignError]:
    """The dome's corners stay well within the contact layer."""
    radius, layer = design.waveguide.dome_radius_mm, design.waveguide.layers[0].thickness_mm
    highest, corner = MAX_SAG * layer, design.waveguide.width_mm / math.sqrt(2)
    if design.probe().sag_mm <= highest:
        return
    # sag = R - sqrt(R² - c²), solved for R; a cap reaches its corners only from R = c on
    least = (corner**2 + highest**2) / (2 * highest) if highest < corner else corner
    allowed = (
        f"at least {math.ceil(100 * least) / 100:g} mm, so that the dome is at most {highest:g} mm high "
        f"({MAX_SAG:.0%} of the contact layer)"
    )
    yield DesignError("waveguide.dome_radius_mm", shown(radius), allowed)


def _pose_conflicts(design: Design) -> Iterator[DesignError]:
    """The probe stays on the slab, and symmetric sides ask for a press that is straight."""
    slab, press = design.specimen, design.press
    room = (slab.width_mm - design.waveguide.width_mm) / 2 - _MARGIN * slab.width_mm
    away = max(abs(part) for part in press.position_mm)
    if away > 0 and away > room:
        most = max(math.floor(100 * room) / 100, 0.0)
        allowed = f"up to {most:g} mm in x and y (the probe stays on the specimen)"
        yield DesignError("press.position_mm", shown(tuple(press.position_mm)), allowed)
    if any(press.tilt_deg) and slab.sides == "symmetric":
        allowed = "(0, 0) where specimen.sides is 'symmetric' (a tilted press needs 'free' sides)"
        yield DesignError("press.tilt_deg", shown(tuple(press.tilt_deg)), allowed)


def inclusion_conflicts(design: Design, inclusion: Inclusion) -> Iterator[DesignError]:
    """Yield a complaint for everything that keeps an inclusion from lying under the design's probe."""
    slab, probe, height = design.specimen, design.waveguide, 2 * inclusion.radii_mm[2]
    received = shown(tuple(inclusion.offset))
    if inclusion.depth + height >= slab.thickness_mm:
        what = (
            f"a size and depth (to its top) that add up to less than {slab.thickness_mm:g} mm, "
            f"where the chest wall is; {height:g} + {inclusion.depth:g} mm reaches it"
        )
        if height > inclusion.depth:
            yield DesignError("inclusion.size", shown(inclusion.size), what)
        else:
            yield DesignError("inclusion.depth", shown(inclusion.depth), what)
    for axis, name in enumerate("xy"):
        reach, shift = slab.width_mm / 2 - inclusion.radii_mm[axis], design.press.position_mm[axis]
        if abs(inclusion.offset[axis] + shift) >= reach:
            where = f" (the probe's is at {shift:g} mm)" if shift else ""
            what = (
                f"a centre less than {reach:g} mm from the specimen's along {name}{where}: "
                "the inclusion stays within the specimen"
            )
            yield DesignError("inclusion.offset", received, what)
            break
    if max(abs(part) for part in inclusion.offset) > probe.width_mm / 2:
        what = f"up to {probe.width_mm / 2:g} mm in x and y (the inclusion's centre lies under the probe)"
        yield DesignError("inclusion.offset", received, what)
    wide = 2 * max(inclusion.radii_mm[:2])
    if wide > _WIDEST * probe.width_mm:
        what = (
            f"inclusions at most {_WIDEST * probe.width_mm:g} mm wide, {_WIDEST:.0%} of the waveguide; "
            f"this one is {wide:g} mm"
        )
        yield DesignError("inclusion.size", shown(inclusion.size), what)


def black(design: Design, what: str) -> None:
    """Raise `DesignError` if a design's housing reflects, which `what` cannot show."""
    if design.housing.reflects:
        allowed = f"0 (black) in {what}; `simulate`, `check` and corpora of traced light show others"
        raise DesignError("housing.reflectance", shown(design.housing.reflectance), allowed)


def straight(design: Design, what: str) -> None:
    """Raise `DesignError` if a design's sensor is tilted or beside the middle, as `what` does not press."""
    for name in ("tilt_deg", "position_mm"):
        value = tuple(getattr(design.press, name))
        if any(value):
            allowed = f"(0, 0) in {what}: it presses straight down on the specimen's middle"
            raise DesignError(f"press.{name}", shown(value), allowed)


def colourless(design: Design, what: str) -> None:
    """Raise `DesignError` if a design's inclusion has optics of its own, which `what` cannot show."""
    if design.specimen.inclusion is not None:
        allowed = f"none in {what}: only `twin simulate --quality reference` follows light below the surface"
        raise DesignError("specimen.inclusion", "optics of its own", allowed)
