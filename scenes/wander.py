"""One visit of light to the tissue, as a volume: in through the contact, scattered, out again or absorbed.

The contact surface is taken for flat over the width of a spot of light, a millimetre or two.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi

from .bsdf import Table
from .sensor import Sensor

_LEAST_WEIGHT = 0.1  # below it, Russian roulette


class View(Protocol):
    """What collects light that leaves towards it."""

    def towards(self, point: mi.Point3f) -> mi.Vector3f:
        """Direction, down, from a point to the viewer, with z = -1."""

    def add(self, number: mi.UInt32, point: mi.Point3f, amount: mi.Float, active: mi.Bool) -> None:
        """Count an amount that leaves at a point."""


@dataclass(frozen=True)
class _Tissue:
    """Tissue as a volume that scatters, below a surface that is flat over the width of a light spot."""

    scattering: float  # 1/mm
    absorption: float
    anisotropy: float
    index: float  # of the guide over the tissue's

    @staticmethod
    def of(sensor: Sensor) -> _Tissue:
        tissue = sensor.tissue
        return _Tissue(
            tissue.scattering_per_mm / (1.0 - tissue.anisotropy),
            tissue.absorption_per_mm,
            tissue.anisotropy,
            sensor.guide.refractive_index / tissue.refractive_index,
        )

    def phase(self, cosine: mi.Float) -> mi.Float:
        """Henyey and Greenstein's phase function (1941; key henyey1941), 1/sr."""
        g = self.anisotropy
        bend = 1.0 + g * g - 2.0 * g * cosine
        return (1.0 - g * g) * dr.inv_four_pi * dr.rsqrt(bend) / bend

    def turn(self, direction: mi.Vector3f, u: mi.Point2f) -> mi.Vector3f:
        """A direction after scattering."""
        g = self.anisotropy
        if abs(g) < 1e-3:
            return mi.warp.square_to_uniform_sphere(u)
        inner = (1.0 - g * g) / (1.0 - g + 2.0 * g * u.x)
        cosine = dr.clip((1.0 + g * g - inner * inner) / (2.0 * g), -1.0, 1.0)
        sine = dr.safe_sqrt(1.0 - cosine * cosine)
        s, c = dr.sincos(dr.two_pi * u.y)
        return mi.Frame3f(direction).to_world(mi.Vector3f(sine * c, sine * s, cosine))


def wander(
    sensor: Sensor,
    table: Table,
    spots: mi.Texture2f,
    views: Sequence[View],
    si: mi.SurfaceInteraction3f,
    number: mi.UInt32,
    throughput: mi.Float,
    enters: mi.Bool,
    random: mi.PCG32,
) -> tuple[mi.Ray3f, mi.Float, mi.PCG32]:
    """Follow light that enters at `si` until it leaves, and show it to the views at every scattering.

    Returns
    -------
    The ray that leaves (in the guide, from the plane through `si`), the share of the light that it carries,
    0 where all is absorbed, and the state of the random numbers.
    """
    tissue, frame, width = _Tissue.of(sensor), si.sh_frame, sensor.guide.width_mm
    extinction = tissue.scattering + tissue.absorption
    albedo = tissue.scattering / extinction

    def fraction_at(point: mi.Point3f, active: mi.Bool) -> mi.Float:
        return spots.eval(mi.Point2f(point.x / width + 0.5, point.y / width + 0.5), active)[0]

    def going(place, way, share, inside, random):  # type: ignore[no-untyped-def]
        return inside

    def step(place, way, share, inside, random):  # type: ignore[no-untyped-def]
        free = -dr.log(1.0 - random.next_float32()) / extinction
        rise = dr.select(way.z > 0.0, -place.z / dr.maximum(way.z, 1e-9), dr.inf)
        surfaces = inside & (rise < free)
        place = place + way * dr.minimum(free, rise)
        place.z = dr.select(surfaces, 0.0, dr.minimum(place.z, 0.0))

        # at the surface: out through the contact, or mirrored
        a = fraction_at(si.p + frame.to_world(place), surfaces)
        flat = mi.Vector2f(way.x, way.y) / tissue.index
        steep = 1.0 - dr.squared_norm(flat)
        escape = dr.select(steep > 0.0, table.transmittance(a, dr.safe_sqrt(steep), surfaces), 0.0)
        leaves = surfaces & (random.next_float32() < escape)
        # in the volume: seen by the views, then on in another direction
        scatters = inside & ~surfaces
        share = dr.select(scatters, share * albedo, share)
        for view in views:
            down = view.towards(si.p + frame.to_world(place))
            length = dr.norm(down)
            out = frame.to_local(down) / length
            inner = mi.Vector2f(out.x, out.y) * tissue.index
            up = dr.safe_sqrt(1.0 - dr.squared_norm(inner))
            aim = mi.Vector3f(inner.x, inner.y, up)
            run = -place.z / up
            exit = si.p + frame.to_world(place + aim * run)
            seen = table.transmittance(fraction_at(exit, scatters), out.z, scatters) * out.z * length
            amount = throughput * share * tissue.phase(dr.dot(way, aim)) * dr.exp(-extinction * run) / up
            view.add(number, exit, amount * seen, scatters & (out.z > 0.0) & (up > 0.0))
        turned = tissue.turn(way, mi.Point2f(random.next_float32(), random.next_float32()))
        mirrored = mi.Vector3f(way.x, way.y, -way.z)
        way = dr.select(scatters, turned, dr.select(surfaces & ~leaves, mirrored, way))
        weak = scatters & (share < _LEAST_WEIGHT)
        stays = random.next_float32() < _LEAST_WEIGHT
        share = dr.select(weak, dr.select(stays, share / _LEAST_WEIGHT, 0.0), share)
        return place, way, share, inside & ~leaves & (share > 0.0), random

    flat = -mi.Vector2f(si.wi.x, si.wi.y) * tissue.index
    way = mi.Vector3f(flat.x, flat.y, -dr.safe_sqrt(1.0 - dr.squared_norm(flat)))
    state = (dr.zeros(mi.Point3f), way, dr.select(enters, mi.Float(1.0), 0.0), enters, random)
    place, way, share, _, random = dr.while_loop(state, going, step)
    flat = mi.Vector2f(way.x, way.y) / tissue.index
    out = mi.Vector3f(flat.x, flat.y, dr.safe_sqrt(1.0 - dr.squared_norm(flat)))
    return mi.Ray3f(si.p + frame.to_world(place), frame.to_world(out)), share, random
