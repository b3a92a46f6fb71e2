"""Ways of rays through horizontal layers of different index, from the side face to the contact surface.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

_NEWTON_STEPS = 8


@dataclass(frozen=True)
class Leg:
    """A stretch between horizontal faces beyond the layer that a ray enters: index, and height in mm."""

    index: float
    height: mi.Float | float


@dataclass(frozen=True)
class Way:
    """How rays that enter the guide through one layer come to their targets; lengths are mm.

    Attributes
    ----------
    along_axis, along_side
        Runs along the LED's axis inside the guide, and along its side.
    up, index
        Height in the layer that is entered, from the disc's height on, and the layer's index.
    legs
        What comes after it.
    """

    along_axis: mi.Float
    along_side: mi.Float
    up: mi.Float
    index: float
    legs: tuple[Leg, ...]


def steepness(way: Way) -> mi.Float:
    """Height over the whole run at which a straight line would leave as the ray does that follows the way.

    The horizontal run of a ray through layers of heights h is sum of h m q / sqrt(n² + (n² - m²) q²), by
    Snell's law, q its tangent in the layer of the lowest index m. It is concave in q, so that Newton's method
    comes to the target from below, and the flattest ray is at infinite q.
    """
    far = dr.sqrt(dr.square(way.along_axis) + dr.square(way.along_side))
    stack = [Leg(way.index, dr.maximum(way.up, 1e-3)), *way.legs]
    least = min(leg.index for leg in stack)
    q = far / sum((leg.height * (least / leg.index) for leg in stack), mi.Float(0.0))
    for _ in range(_NEWTON_STEPS):
        run, rise = mi.Float(0.0), mi.Float(0.0)
        for leg in stack:
            inverse = dr.rsqrt(leg.index**2 + (leg.index**2 - least**2) * dr.square(q))
            run += leg.height * least * q * inverse
            rise += leg.height * least * leg.index**2 * inverse * dr.square(inverse)
        q += (far - run) / rise
    sine2 = least**2 * dr.square(q) / (1.0 + dr.square(q))
    return far * dr.sqrt((way.index**2 - sine2) / dr.maximum(sine2, 1e-9))


def risen(p_z: mi.Float, entered: float, index: float) -> mi.Float:
    """Vertical part of index x direction in a layer, of a ray that had another in the one it entered."""
    if index == entered:
        return p_z
    return dr.sqrt(dr.maximum(index**2 - entered**2 + dr.square(p_z), 1e-9))
