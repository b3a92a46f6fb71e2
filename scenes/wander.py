"""One visit of light to the tissue, as a volume: in through the contact, scattered, out again or absorbed.

The contact surface is taken for flat over the width of a spot of light, a millimetre or two.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import drjit as dr
import mitsuba as mi

from .bsdf import Table
from .faces import Meeting
from .sensor import Sensor
from .walk import Body, Medium, roam


class View(Protocol):
    """What collects light that leaves towards it."""

    def towards(self, point: mi.Point3f) -> mi.Vector3f:
        """Direction, down, from a point to the viewer, with z = -1."""

    def add(self, number: mi.UInt32, point: mi.Point3f, amount: mi.Float, active: mi.Bool) -> None:
        """Count an amount that leaves at a point."""


def body_of(sensor: Sensor) -> Body:
    """What light enters: the tissue, or the contact sheet before it."""
    skin, tissue = sensor.skin, sensor.tissue
    g = tissue.anisotropy
    if skin.sheet is None:
        return Body(Medium(tissue.scattering_per_mm / (1.0 - g), tissue.absorption_per_mm, g))
    sheet = skin.sheet
    medium = Medium(sheet.scattering_per_mm, sheet.absorption_per_mm)
    return Body(medium, sheet.thickness_mm, sheet.backing)


def wander(
    sensor: Sensor,
    table: Table,
    spots: mi.Texture2f,
    views: Sequence[View],
    met: Meeting,
    number: mi.UInt32,
    throughput: mi.Float,
    enters: mi.Bool,
    random: mi.PCG32,
) -> tuple[mi.Ray3f, mi.Float, mi.PCG32]:
    """Follow light that enters where it `met` the contact until it leaves; views see every collision.

    Returns
    -------
    The ray that leaves (in the guide, from the plane through there), the share of the light that it carries,
    0 where all is absorbed, and the state of the random numbers.
    """
    body, width = body_of(sensor), sensor.guide.width_mm
    index = sensor.guide.refractive_index / behind(sensor)
    frame = mi.Frame3f(met.normal)
    here = frame.to_local(met.d)

    def world(place: mi.Point3f) -> mi.Point3f:
        return met.p + frame.to_world(mi.Vector3f(place.x, place.y, -place.z))

    def fraction_at(point: mi.Point3f) -> mi.Float:
        return spots.eval(mi.Point2f(point.x / width + 0.5, point.y / width + 0.5))[0]

    def passing(where: mi.Point3f, cosine: mi.Float) -> mi.Float:
        square = 1.0 - (1.0 - dr.square(cosine)) / index**2
        through = table.transmittance(fraction_at(world(where)), dr.safe_sqrt(square))
        return dr.select(square > 0.0, through, 0.0)

    def witness(where: mi.Point3f, way: mi.Vector3f, share: mi.Float, g: mi.Float, collides: mi.Bool) -> None:
        for view in views:
            down = view.towards(world(where))
            length = dr.norm(down)
            out = frame.to_local(down) / length
            aim_x, aim_y = out.x * index, out.y * index
            up = dr.safe_sqrt(1.0 - dr.square(aim_x) - dr.square(aim_y))
            run = where.z / dr.maximum(up, 1e-6)
            leaves = world(where + run * mi.Vector3f(aim_x, aim_y, -up))
            seen = table.transmittance(fraction_at(leaves), out.z, collides) * out.z * length
            bend = phase(g, dr.dot(way, mi.Vector3f(aim_x, aim_y, -up)))
            amount = throughput * share * bend * dr.exp(-body.medium.extinction_per_mm * run) / up
            view.add(number, leaves, amount * seen, collides & (out.z > 0.0) & (up > 0.0))

    flat = mi.Vector2f(here.x, here.y) * index
    way = mi.Vector3f(flat.x, flat.y, dr.safe_sqrt(1.0 - dr.squared_norm(flat)))
    start = dr.zeros(mi.Point3f, dr.width(number))
    where, way, share, _, random = roam(body, start, way, random, passing, enters, witness)
    flat = mi.Vector2f(way.x, way.y) / index
    out = mi.Vector3f(flat.x, flat.y, dr.safe_sqrt(1.0 - dr.squared_norm(flat)))
    return mi.Ray3f(world(where), frame.to_world(out)), share, random


def behind(sensor: Sensor) -> float:
    """Refractive index of what light enters."""
    sheet = sensor.skin.sheet
    return sensor.tissue.refractive_index if sheet is None else sheet.refractive_index


def phase(g: mi.Float, cosine: mi.Float) -> mi.Float:
    """Henyey and Greenstein's phase function (1941; key henyey1941), 1/sr."""
    bend = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) * dr.inv_four_pi * dr.rsqrt(bend) / bend
