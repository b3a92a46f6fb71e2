"""The housing below the glass: a box, white inside, that light leaves the glass into and comes back from.

The box is as wide as the guide and as deep as the camera's pinhole, which looks through its floor. Its five
sides are Lambertian. The camera sees them mirrored: in the glass, and in the contact surface where little
touches.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from .irradiance import look_up
from .sensor import NotModelled, Sensor

Array = NDArray[np.float64]

CELLS = 32  # per side of each of the box's sides
SIDES = ("floor", "+x", "-x", "+y", "-y")
_SMOOTHING_CELLS = 1.5  # standard deviation
_FIXED_POINT = float(2**20)
_BEHIND_MM = 0.01  # of the floor behind the pinhole, which must not lie on it
_LEAST = 1e-9


@dataclass(frozen=True)
class Box:
    """Its shape, mm: half of its width, height of the glass's lower face, height of the floor."""

    half: float
    top: float
    floor: float

    @staticmethod
    def of(sensor: Sensor) -> Box:
        top = -sensor.guide.thickness_mm - sensor.glass.thickness_mm
        return Box(sensor.guide.width_mm / 2, top, top - sensor.camera.distance_mm - _BEHIND_MM)

    @property
    def depth(self) -> float:
        """From glass to floor, mm."""
        return self.top - self.floor

    @property
    def areas_mm2(self) -> Array:
        """Of the `SIDES`, (5,)."""
        width = 2.0 * self.half
        return np.array([width**2] + 4 * [width * self.depth])

    def side(self, p: mi.Point3f) -> tuple[mi.UInt32, mi.Float, mi.Float]:
        """Which of the `SIDES` a point of the box lies on, and where on it, 0 to 1: along +x, or +y on the
        sides of x; along +y, or up."""
        on_floor = p.z < self.floor + 1e-3
        on_x = dr.abs(p.x) > dr.abs(p.y)
        ahead = dr.select(on_x, p.x, p.y) > 0.0
        side = dr.select(on_x, 1, 3) + dr.select(ahead, mi.UInt32(0), mi.UInt32(1))
        across = dr.select(on_floor | ~on_x, p.x, p.y) / (2.0 * self.half) + 0.5
        up = dr.select(on_floor, p.y / (2.0 * self.half) + 0.5, (p.z - self.floor) / self.depth)
        return dr.select(on_floor, mi.UInt32(0), side), across, up

    def meet(self, x: mi.Float, y: mi.Float, lean_x: mi.Float, lean_y: mi.Float) -> mi.Point3f:
        """Where rays from the glass meet the box, that run so far in x and y per mm down."""

        def until(at: mi.Float, lean: mi.Float) -> mi.Float:
            return (self.half - dr.mulsign(at, lean)) / dr.maximum(dr.abs(lean), _LEAST)

        run = dr.minimum(self.depth, dr.minimum(until(x, lean_x), until(y, lean_y)))
        run = dr.maximum(run, 0.0)
        return mi.Point3f(x + run * lean_x, y + run * lean_y, self.top - run)


class Tally:
    """Light that falls on the box's sides, counted while light is followed."""

    def __init__(self, sensor: Sensor) -> None:
        self._box, self._n_led = Box.of(sensor), len(sensor.leds)
        self._counts = dr.zeros(mi.Int64, self._n_led * len(SIDES) * CELLS**2)

    def add(self, number: mi.UInt32, p: mi.Point3f, amount: mi.Float, active: mi.Bool) -> None:
        """Count light of LEDs that falls on points of the box."""
        side, across, up = self._box.side(p)
        column, row = (mi.UInt32(dr.clip(at * CELLS, 0.0, CELLS - 1.0)) for at in (across, up))
        cell = ((number * len(SIDES) + side) * CELLS + row) * CELLS + column
        dr.scatter_add(self._counts, mi.Int64(dr.round(amount * _FIXED_POINT)), cell, active)

    def collected(self) -> Array:
        """All that was counted, (n_led, 5, CELLS, CELLS) on cells [up, across] of the `SIDES`."""
        found = self._counts.numpy().reshape(self._n_led, len(SIDES), CELLS, CELLS)
        return np.asarray(found / _FIXED_POINT)


@dataclass(frozen=True)
class Mirror:
    """One way in which the pixels see the box: where their rays meet it, and the mirror's share."""

    place: mi.Point3f
    share: mi.Float


def mirrors(
    sensor: Sensor,
    lean: tuple[mi.Float, mi.Float],
    at_glass: tuple[mi.Float, mi.Float],
    by_glass: mi.Float,
    by_contact: mi.Float,
) -> list[Mirror]:
    """What pixels see of the box: mirrored in the glass, and in the contact surface.

    Parameters
    ----------
    lean
        Run in x and y per mm up, of the pixels' rays in air.
    at_glass
        Where light mirrored in the contact surface comes out of the glass, x and y, mm.
    by_glass, by_contact
        Share of the box's radiance that comes to the camera in either way.
    """
    box = Box.of(sensor)
    straight = [one * sensor.camera.distance_mm for one in lean]
    return [
        Mirror(box.meet(x, y, *lean), share)
        for (x, y), share in ((straight, by_glass), (at_glass, by_contact))
    ]


def seen(sensor: Sensor, seen_in: list[Mirror], fallen: Array) -> NDArray[np.float32]:
    """Radiance at the pixels, (n_led, pixels), W mm⁻² sr⁻¹, of light that has `fallen` on the box, W
    (`Tally.collected`): L = rho E / pi of each cell, somewhat smoothed."""
    box = Box.of(sensor)
    irradiance = fallen / (box.areas_mm2 / CELLS**2)[:, None, None]
    even = gaussian_filter(irradiance, (0, 0, _SMOOTHING_CELLS, _SMOOTHING_CELLS), mode="nearest")
    radiance = sensor.housing.reflectance / np.pi * even
    total = [mi.Float(0.0) for _ in radiance]
    for mirror in seen_in:
        side, across, up = box.side(mirror.place)
        for number in range(len(SIDES)):
            for led, here in enumerate(look_up(radiance[:, number], across, up)):
                total[led] += dr.select(side == number, mirror.share * here, 0.0)
    dr.eval(total)
    return np.stack([np.asarray(layer) for layer in total])


def describe(sensor: Sensor) -> dict[str, Any]:
    """The box's sides for Mitsuba's scene, by name; none if it is black: nothing comes back from it."""
    if not sensor.housing.reflects:
        return {}
    box = Box.of(sensor)
    paint = {"type": "diffuse", "reflectance": {"type": "uniform", "value": sensor.housing.reflectance}}
    material = {"type": "twosided", "bsdf": paint}
    turn = mi.ScalarTransform4f
    floor = turn().translate([0, 0, box.floor]).scale([box.half, box.half, 1])
    sides = {"floor": floor}
    for name in SIDES[1:]:
        sign, axis = (1.0 if name[0] == "+" else -1.0), "xy".index(name[1])
        outward = np.eye(3)[axis] * sign
        middle = outward * box.half + [0.0, 0.0, 0.5 * (box.top + box.floor)]
        look = turn().look_at(origin=middle.tolist(), target=(middle - outward).tolist(), up=[0, 0, 1])
        sides[name] = look.scale([box.half, 0.5 * box.depth, 1])
    return {
        f"housing_{name}": {"type": "rectangle", "to_world": place, "bsdf": material}
        for name, place in sides.items()
    }


def refuse(sensor: Sensor, what: str) -> None:
    """Refuse a housing that reflects where it would be left out."""
    if sensor.housing.reflects:
        received = f"housing.reflectance: received {sensor.housing.reflectance:g}"
        raise NotModelled(f"{received}; allowed 0 (black) for {what}")
