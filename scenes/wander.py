"""One visit of light to the tissue, as a volume: in through the contact, scattered, out again or absorbed.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arrays import tensor
from .bsdf import Table
from .faces import Meeting
from .sensor import Sensor
from .skin import Tissue
from .walk import Body, Medium, Scores, fresnel, roam

_LEAST = 1e-6  # of a chance that is divided by: what is rarer never happens


class View(Protocol):
    """What collects light that leaves towards it.

    Its rays' slope grows by `spread_per_mm` for each mm aside: what lies deeper is seen from farther.
    """

    @property
    def spread_per_mm(self) -> float: ...

    def towards(self, point: mi.Point3f) -> mi.Vector3f:
        """Direction, down, from a point to the viewer, with z = -1."""

    def add(self, number: mi.UInt32, point: mi.Point3f, amounts: Sequence[mi.Float], active: mi.Bool) -> None:
        """Count an amount that leaves at a point, and its derivatives."""


@dataclass(frozen=True)
class Spots:
    """Real contact fraction over the guide's face, and its derivatives to parameters.

    Light's choices at the contact hang on the fraction alone, so that a picture's derivative is the mean of
    what paths carry times the derivative of the logarithm of their density, their score (the likelihood
    ratio method: Glynn 1990; [glynn1990]): no second set of paths is followed, and none part ways.
    """

    fraction: mi.Texture2f
    slopes: mi.Texture2f | None
    width_mm: float

    @staticmethod
    def of(sensor: Sensor, fraction: NDArray[np.float64], slopes: NDArray[np.float64] | None) -> Spots:
        """From maps [iy, ix] (m, m) and (q, m, m) over the guide's face."""
        maps = [
            None if one is None else mi.Texture2f(tensor(one), wrap_mode=dr.WrapMode.Clamp)
            for one in (
                fraction[..., None].astype(np.float32),
                None if slopes is None else np.moveaxis(slopes, 0, -1).astype(np.float32),
            )
        ]
        return Spots(maps[0], maps[1], sensor.guide.width_mm)

    def covers(self, point: mi.Point3f) -> mi.Bool:
        """Whether the guide lies there, not bare skin."""
        return dr.maximum(dr.abs(point.x), dr.abs(point.y)) < 0.5 * self.width_mm

    def at(self, point: mi.Point3f) -> mi.Float:
        """Contact fraction."""
        return self.fraction.eval(self._place(point))[0]

    def derivatives(self, point: mi.Point3f) -> list[mi.Float]:
        """Of the contact fraction, to each parameter."""
        return [] if self.slopes is None else list(self.slopes.eval(self._place(point)))

    def scores(self, point: mi.Point3f, through: mi.Float, steep: mi.Float, passes: mi.Bool) -> Scores:
        """Derivatives of the logarithm of the chance of what light did that met a transmittance."""
        if self.slopes is None:
            return ()
        relative = dr.select(
            passes, steep / dr.maximum(through, _LEAST), -steep / dr.maximum(1.0 - through, _LEAST)
        )
        return tuple(relative * slope for slope in self.derivatives(point))

    def _place(self, point: mi.Point3f) -> mi.Point2f:
        return mi.Point2f(point.x / self.width_mm + 0.5, point.y / self.width_mm + 0.5)


@dataclass(frozen=True)
class Lump:
    """An ellipsoid in the tissue with optics of its own, in the sensor's frame.

    Attributes
    ----------
    medium
        What it is made of.
    centre_mm, inverse
        Points whose `inverse` @ (point - `centre_mm`) is no longer than 1 are in it.
    """

    medium: Medium
    centre_mm: mi.Point3f
    inverse: mi.Matrix3f

    @staticmethod
    def of(sensor: Sensor, place: tuple[NDArray[np.float64], NDArray[np.float64]]) -> Lump | None:
        """The inclusion at a place, centre (3,) and axes (3, 3) in mm; None where its optics are the
        tissue's."""
        if sensor.inclusion is None:
            return None
        centre, axes = place
        middle = mi.Point3f(*(dr.opaque(mi.Float, float(part)) for part in centre))
        rows = [[dr.opaque(mi.Float, float(one)) for one in row] for row in np.linalg.inv(axes)]
        return Lump(medium_of(sensor.inclusion.of(sensor.tissue)), middle, mi.Matrix3f(rows))

    def holds(self, point: mi.Point3f) -> mi.Bool:
        """Which points are in it."""
        return dr.squared_norm(self.unit(point)) < 1.0

    def unit(self, point: mi.Point3f) -> mi.Vector3f:
        """A point where the lump is the unit ball."""
        return self.inverse @ mi.Vector3f(point - self.centre_mm)

    def share(self, start: mi.Point3f, end: mi.Point3f) -> mi.Float:
        """Share of the way from one point to another that lies in it."""
        begin = self.unit(start)
        way = self.unit(end) - begin
        square = dr.maximum(dr.squared_norm(way), 1e-20)
        middle = -dr.dot(begin, way) / square
        half = dr.square(middle) - (dr.squared_norm(begin) - 1.0) / square
        reach = dr.safe_sqrt(half)
        return dr.clip(middle + reach, 0.0, 1.0) - dr.clip(middle - reach, 0.0, 1.0)


@dataclass(frozen=True)
class Relief:
    """The contact surface as light in the tissue meets it: height, mm, and slopes along x and y, on a grid
    over the guide's face; beyond, it goes on straight."""

    maps: mi.Texture2f
    width_mm: float
    last_mm: float  # middle of the grid's last cell

    @staticmethod
    def on(height: NDArray[np.float64], width_mm: float) -> Relief:
        """From heights at the middles of cells [iy, ix], (m, m) mm."""
        middles = (np.arange(len(height)) + 0.5) / len(height) * width_mm - width_mm / 2
        slope_y, slope_x = np.gradient(height, middles, middles, edge_order=2)
        stacked = np.stack([height, slope_x, slope_y], axis=-1).astype(np.float32)
        maps = mi.Texture2f(tensor(stacked), wrap_mode=dr.WrapMode.Clamp)
        return Relief(maps, width_mm, float(middles[-1]))

    def at(self, point: mi.Point3f) -> tuple[mi.Float, mi.Vector3f]:
        """Depth of points in the tissue, mm, and the normal above which they lie, into it."""
        last, width = self.last_mm, self.width_mm
        x, y = (dr.clip(at, -last, last) for at in (point.x, point.y))
        height, slope_x, slope_y = self.maps.eval(mi.Point2f(x / width + 0.5, y / width + 0.5))
        height += (point.x - x) * slope_x + (point.y - y) * slope_y
        normal = dr.normalize(mi.Vector3f(-slope_x, -slope_y, 1.0))
        return (point.z - height) * normal.z, normal

    def onto(self, point: mi.Point3f) -> tuple[mi.Point3f, mi.Vector3f]:
        """The points of the surface over or under points near it, and the normals there."""
        depth, normal = self.at(point)
        return mi.Point3f(point.x, point.y, point.z - depth / normal.z), normal


def medium_of(tissue: Tissue) -> Medium:
    """Tissue as a medium to walk in."""
    g = tissue.anisotropy
    return Medium(tissue.scattering_per_mm / (1.0 - g), tissue.absorption_per_mm, g)


def body_of(sensor: Sensor, relief: Relief | None = None, lump: Lump | None = None) -> Body:
    """What light enters: the tissue, or the contact sheet before it."""
    skin = sensor.skin
    if skin.sheet is None:
        return Body(medium_of(sensor.tissue), ball=lump, face=relief)
    sheet = skin.sheet
    medium = Medium(sheet.scattering_per_mm, sheet.absorption_per_mm)
    return Body(medium, sheet.thickness_mm, sheet.backing, ball=lump, face=relief)


def wander(
    sensor: Sensor,
    table: Table,
    spots: Spots,
    relief: Relief,
    views: Sequence[View],
    met: Meeting,
    number: mi.UInt32,
    throughput: mi.Float,
    enters: mi.Bool,
    random: mi.PCG32,
    scores: Scores = (),
    lump: Lump | None = None,
) -> tuple[mi.Ray3f, mi.Float, mi.PCG32, Scores]:
    """Follow light that enters where it `met` the contact until it leaves; views see every collision, and
    what a sheet's backing throws back.

    Returns
    -------
    The ray that leaves (in the guide, from the relief), the share of the light that it carries,
    0 where all is absorbed, the state of the random numbers, and the scores that `scores` grew to.
    """
    body = body_of(sensor, relief, lump)
    index = sensor.guide.refractive_index / behind(sensor)
    bare = fresnel(behind(sensor), 1.0)
    extinction, more = body.medium.extinction_per_mm, 0.0
    if lump is not None:
        more = lump.medium.extinction_per_mm - extinction

    def steep(where: mi.Point3f, cosine: mi.Float) -> tuple[mi.Float, mi.Float]:
        square = 1.0 - (1.0 - dr.square(cosine)) / index**2
        found = table.steep(spots.at(where), dr.safe_sqrt(square))
        touched = tuple(dr.select(square > 0.0, one, 0.0) for one in found)
        covered, free = spots.covers(where), (bare(where, cosine), 0.0)
        return tuple(dr.select(covered, one, other) for one, other in zip(touched, free, strict=True))

    def passing(where: mi.Point3f, cosine: mi.Float) -> mi.Float:
        return steep(where, cosine)[0]

    def scoring(where: mi.Point3f, cosine: mi.Float, leaves: mi.Bool, meets: mi.Bool) -> Scores:
        added = spots.scores(where, *steep(where, cosine), leaves)
        return tuple(dr.select(meets, one, 0.0) for one in added)

    def witness(
        where: mi.Point3f,
        way: mi.Vector3f,
        share: mi.Float,
        g: mi.Float,
        shines: mi.Bool,
        backed: mi.Bool,
        so_far: Scores,
    ) -> None:
        depth, normal = relief.at(where)
        for view in views:
            down = view.towards(where)
            length = dr.norm(down)
            out = down / length
            away = -dr.dot(out, normal)
            along = index * (out + away * normal)
            up = dr.safe_sqrt(1.0 - dr.squared_norm(along))
            aim, run = along - up * normal, depth / dr.maximum(up, 1e-6)
            leaves, _ = relief.onto(where + run * aim)
            through, slope = table.steep(spots.at(leaves), away, shines)
            dense = extinction * run
            if lump is not None:
                dense += more * run * lump.share(where, leaves)
            per_sr = dr.select(backed, up * dr.inv_pi, phase(g, dr.dot(way, aim)))
            amount = throughput * share * per_sr * dr.exp(-dense) / up
            # a pixel sees more of what lies deeper; its radiance is that of the area it sees at the face
            amount *= away * length * dr.square(1.0 - view.spread_per_mm * index * dr.maximum(depth, 0.0))
            changes = zip(so_far, spots.derivatives(leaves), strict=True)
            slopes = [amount * (through * score + slope * change) for score, change in changes]
            seen = shines & (away > 0.0) & (up > 0.0) & spots.covers(leaves)
            view.add(number, leaves, [amount * through, *slopes], seen)

    start, normal = relief.onto(met.p)
    along = index * (met.d - dr.dot(met.d, normal) * normal)
    way = along + dr.safe_sqrt(1.0 - dr.squared_norm(along)) * normal
    where, way, share, _, random, scores = roam(
        body, start, way, random, passing, enters, witness, scores, scoring if scores else None
    )
    _, normal = relief.at(where)
    along = (way - dr.dot(way, normal) * normal) / index
    out = along - dr.safe_sqrt(1.0 - dr.squared_norm(along)) * normal
    return mi.Ray3f(where, out), share, random, scores


def behind(sensor: Sensor) -> float:
    """Refractive index of what light enters."""
    sheet = sensor.skin.sheet
    return sensor.tissue.refractive_index if sheet is None else sheet.refractive_index


def phase(g: mi.Float, cosine: mi.Float) -> mi.Float:
    """Henyey and Greenstein's phase function (1941; key henyey1941), 1/sr."""
    bend = 1.0 + g * g - 2.0 * g * cosine
    return (1.0 - g * g) * dr.inv_four_pi * dr.rsqrt(bend) / bend
