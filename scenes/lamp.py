"""How LEDs spread their light over angle: drawn from for rays, and evaluated for what is gathered or seen.

Angles are in the LED's own frame: from its axis, and about it from its tangent (along the side, in +x or +y)
towards its upright (+z; +y for LEDs below). Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import ies
from .arrays import floats
from .led import Led

_RINGS, _SPOKES = 513, 145  # of the table of a file, over the angle from the axis and about it


class Patterns:
    """The patterns of a sensor's LEDs; all that is Lambertian costs nothing."""

    def __init__(self, leds: Sequence[Led]) -> None:
        self.lambertian = all(led.pattern == "lambertian" and led.tilt_deg == 0.0 for led in leds)
        self._exponent = floats([(led.exponent or 0.0) if led.pattern == "power" else 1.0 for led in leds])
        tilts = np.radians([led.tilt_deg for led in leds])
        self._tilted = bool(tilts.any())
        self._lean = [floats(part) for part in (np.cos(tilts), np.sin(tilts))]
        self._files = {
            number: mi.MarginalContinuous2D0(_table(ies.read(led.ies)))
            for number, led in enumerate(leds)
            if led.ies is not None
        }

    def sharper(self, more: mi.Float) -> Patterns:
        """The same LEDs with so much larger exponents."""
        other = copy.copy(self)
        other._exponent = self._exponent + more
        return other

    def score(self, number: mi.UInt32, cosine: mi.Float) -> mi.Float:
        """Derivative to the exponent of the logarithm of the density of `draw`, (m+1) cos^m / (2 pi), of LEDs
        that do not lean."""
        exponent = dr.gather(mi.Float, self._exponent, number)
        return dr.rcp(exponent + 1.0) + dr.log(dr.maximum(cosine, 1e-6))

    def draw(self, number: mi.UInt32, sample: mi.Point2f) -> mi.Vector3f:
        """Directions as often as the LEDs send light there: along tangent, upright and axis."""
        if self.lambertian:
            return mi.warp.square_to_cosine_hemisphere(sample)
        # intensity ~ cos^m: the share of the flux within theta is 1 - cos^(m+1), even over the disc's r²
        exponent = dr.gather(mi.Float, self._exponent, number)
        disc = mi.warp.square_to_uniform_disk_concentric(sample)
        inner = dr.squared_norm(disc)
        cosine = dr.power(dr.maximum(1.0 - inner, 1e-12), dr.rcp(exponent + 1.0))
        spread = dr.sqrt(dr.maximum(1.0 - dr.square(cosine), 0.0)) * dr.rsqrt(dr.maximum(inner, 1e-12))
        direction = mi.Vector3f(spread * disc.x, spread * disc.y, cosine)
        if self._tilted:
            along, across = (dr.gather(mi.Float, part, number) for part in self._lean)
            upright = along * direction.y + across * direction.z
            axis = dr.abs(along * direction.z - across * direction.y)
            direction = mi.Vector3f(direction.x, upright, dr.maximum(axis, 1e-6))
        for led, table in self._files.items():
            place, _ = table.sample(sample)
            height = dr.clip(1.0 - dr.square(place.y), 1e-6, 1.0)
            sine = dr.sqrt(dr.maximum(1.0 - dr.square(height), 0.0))
            s, c = dr.sincos(2.0 * dr.pi * place.x)
            direction = dr.select(number == led, mi.Vector3f(sine * c, sine * s, height), direction)
        return direction

    def relative(self, number: mi.UInt32, cosine: mi.Float, tangent: mi.Float, upright: mi.Float) -> mi.Float:
        """Radiance over that of a Lambertian disc of the same flux, towards directions with this cosine and
        parts along tangent and upright, of any length.

        For intensity (m+1) F/(2 pi) cos^m it is (m+1)/2 cos^(m-1); where the axis leans, cos^m of the angles
        that the direction and its mirror image behind the disc have with it, over the cosine.
        """
        if self.lambertian:
            return mi.Float(1.0)
        exponent = dr.gather(mi.Float, self._exponent, number)
        height = dr.clip(cosine, 1e-4, 1.0)
        if self._tilted:
            along, across = (dr.gather(mi.Float, part, number) for part in self._lean)
            long = dr.rsqrt(dr.maximum(dr.square(tangent) + dr.square(upright), 1e-20))
            rise = across * upright * long * dr.safe_sqrt(1.0 - dr.square(height))
            ends = (dr.maximum(rise + sign * along * height, 0.0) for sign in (1.0, -1.0))
            bright = sum((dr.power(end, exponent) for end in ends), mi.Float(0.0)) / height
        else:
            bright = dr.power(height, exponent - 1.0)
        found = 0.5 * (exponent + 1.0) * bright
        if self._files:
            turn = dr.atan2(upright, tangent) * (0.5 * dr.inv_pi)
            place = mi.Point2f(turn - dr.floor(turn), dr.sqrt(dr.maximum(1.0 - height, 1e-8)))
            for led, table in self._files.items():
                seen = table.eval(place) / (4.0 * place.y * height)
                found = dr.select(number == led, seen, found)
        return found


def _table(lamp: ies.Lamp) -> NDArray[np.float32]:
    """Density of a lamp's light over x, the turn about its axis, and y = sqrt(1 - cos(theta)): [y, x].

    With dω = 4 pi y dx dy the density is that of the intensity times y; so the disc's middle is as finely
    divided as its rim, and the bilinear table is exact there.
    """
    spokes = 2 if len(lamp.horizontal_deg) == 1 else _SPOKES
    y = np.linspace(0.0, 1.0, _RINGS)
    vertical = np.degrees(np.arccos(1.0 - y**2))
    columns = [lamp.at(vertical, np.full(_RINGS, turn)) for turn in np.linspace(0.0, 360.0, spokes)]
    return np.ascontiguousarray(np.stack(columns, axis=1) * y[:, None], dtype=np.float32)
