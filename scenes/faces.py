"""Where rays meet the sensor's faces, and what polished faces do: the scene's laws without its dispatch.

`mi.Scene.ray_intersect` fills in a full interaction and calls the shape and BSDF that were met, which takes
longer than finding them. The sensor has eight kinds of faces, and all but the contact surface are flat, so
that little is needed here: the meeting itself is Mitsuba's, position, normals and contact fraction on the
mesh are interpolated as Mitsuba does it, and dielectrics follow Fresnel.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import floats
from .sensor import Sensor

NOTHING, CONTACT, TO_GLASS, TO_AIR, WALL, RIM, LED, LAYER, HOUSING = range(9)
_KINDS = {"contact": CONTACT, "guide_to_glass": TO_GLASS, "glass_to_air": TO_AIR}
_EPSILON = 1500.0 * 2.0**-24  # Mitsuba's for spawned rays, relative to the coordinates


@dataclass(frozen=True)
class Meeting:
    """Where rays meet the scene.

    Attributes
    ----------
    kind, shape
        NOTHING, CONTACT, ...; the scene's shape.
    d
        Direction of the ray that came.
    t, p
        Distance, and point.
    n
        Geometric normal: away from the guide's middle, but down on the contact surface.
    normal
        Shading normal: interpolated on the contact surface, `n` elsewhere.
    cosine
        Of the ray's way back with `normal`.
    fraction
        Real contact fraction, on the contact surface.
    """

    kind: mi.UInt32
    shape: mi.ShapePtr
    d: mi.Vector3f
    t: mi.Float
    p: mi.Point3f
    n: mi.Vector3f
    normal: mi.Vector3f
    cosine: mi.Float
    fraction: mi.Float

    @property
    def along(self) -> mi.Vector3f:
        """Part of the direction along the face."""
        return self.d + self.cosine * self.normal

    @property
    def mirrored(self) -> mi.Vector3f:
        """Direction after reflection."""
        return self.d + 2.0 * self.cosine * self.normal

    def leaving(self, direction: mi.Vector3f) -> mi.Ray3f:
        """The ray that goes on from here, off the face by a hair."""
        hair = (1.0 + dr.max(dr.abs(self.p))) * _EPSILON
        return mi.Ray3f(self.p + dr.mulsign(hair, dr.dot(self.n, direction)) * self.n, direction)


class Faces:
    """The faces of a scene from `build.load_scene`, as its surface lies now."""

    def __init__(self, scene: mi.Scene, sensor: Sensor) -> None:
        """Copy what is needed of the contact mesh onto records that are read at once."""
        self.scene = scene
        self._half = dr.opaque(mi.Float, sensor.guide.width_mm / 2)
        shapes = {shape.id(): shape for shape in scene.shapes()}
        number = {
            name: int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
            for name, shape in shapes.items()
        }
        table = np.zeros((max(number.values()) + 1, 4), dtype=np.float32)
        for name, index in number.items():
            table[index] = (*_normal(name), _kind(name))
        self._table = floats(table)
        # inside over outside; inside is the side that the normal points away from
        eta = np.ones(len(table), dtype=np.float32)
        for name, index in number.items():
            eta[index] = _eta(name, sensor)
        self._eta = floats(eta)

        contact = shapes["contact"]
        fraction = contact.attribute_buffer("vertex_contact_fraction")
        self._places = _in_fours(contact.vertex_positions_buffer(), 3, fraction)
        self._normals = _in_fours(contact.vertex_normals_buffer(), 3)
        self._corners = _in_fours(contact.faces_buffer(), 3)
        dr.eval(self._places, self._normals, self._corners)

    def meet(self, ray: mi.Ray3f, active: mi.Bool) -> Meeting:
        """Follow rays to the next face."""
        found = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
        valid = active & found.is_valid()
        shape = dr.reinterpret_array(mi.UInt32, found.shape)
        x, y, z, number = dr.gather(mi.Vector4f, self._table, shape, valid)
        kind = dr.select(valid, mi.UInt32(number), mi.UInt32(NOTHING))
        on_mesh = kind == CONTACT

        corners = dr.gather(mi.Vector4u, self._corners, found.prim_index, on_mesh)
        v, w = found.prim_uv.x, found.prim_uv.y
        u = 1.0 - v - w
        p0, p1, p2 = (dr.gather(mi.Vector4f, self._places, corners[k], on_mesh) for k in range(3))
        n0, n1, n2 = (dr.gather(mi.Vector4f, self._normals, corners[k], on_mesh).xyz for k in range(3))
        place = u * p0 + v * p1 + w * p2
        flat = mi.Vector3f(x, y, z)
        n = dr.select(on_mesh, dr.normalize(dr.cross(p1.xyz - p0.xyz, p2.xyz - p0.xyz)), flat)
        normal = dr.select(on_mesh, dr.normalize(u * n0 + v * n1 + w * n2), flat)
        p = dr.select(on_mesh, mi.Point3f(place.xyz), ray(found.t))
        # the lip beyond the walls keeps light in; what shines on it from beside the guide passes the guide by
        beside = dr.maximum(dr.abs(p.x), dr.abs(p.y)) > self._half
        kind = dr.select(on_mesh & beside, mi.UInt32(NOTHING), kind)
        fraction = dr.select(on_mesh & dr.isfinite(place.w), place.w, 0.0)  # slivers at a pressed-back rim
        t, cosine = dr.select(valid, found.t, 0.0), -dr.dot(ray.d, normal)
        return Meeting(kind, found.shape, ray.d, t, p, n, normal, cosine, fraction)

    def eta(self, meeting: Meeting) -> mi.Float:
        """Index inside over that outside, as `mi.fresnel` takes it."""
        return dr.gather(mi.Float, self._eta, dr.reinterpret_array(mi.UInt32, meeting.shape))

    def reflectance(self, meeting: Meeting) -> mi.Float:
        """Share of the light that a flat dielectric face mirrors."""
        return mi.fresnel(meeting.cosine, self.eta(meeting))[0]

    def polished(self, meeting: Meeting, sample: mi.Float) -> mi.Vector3f:
        """Direction after a flat dielectric face: mirrored with Fresnel's share as chance, else refracted."""
        mirrored, cosine, _, squeeze = mi.fresnel(meeting.cosine, self.eta(meeting))
        through = squeeze * meeting.along + cosine * meeting.normal
        return dr.select(sample <= mirrored, meeting.mirrored, through)


def _in_fours(buffer: mi.Float, width: int, last: mi.Float | None = None) -> mi.Float:
    """Values in groups of `width`, and one more each, as groups of four, which are read at once."""
    groups = dr.width(buffer) // width
    place = dr.arange(mi.UInt32, groups)
    found = dr.zeros(type(buffer), 4 * groups)
    for k in range(width):
        dr.scatter(found, dr.gather(type(buffer), buffer, place * width + k), place * 4 + k)
    if last is not None:
        dr.scatter(found, last, place * 4 + 3)
    return found


def _kind(name: str) -> int:
    if name in _KINDS:
        return _KINDS[name]
    return {"wall": WALL, "rim": RIM, "led": LED, "layer": LAYER, "housing": HOUSING}[name.split("_")[0]]


def _eta(name: str, sensor: Sensor) -> float:
    """Index inside over that outside, of a face as `build` names it; 1 where light does not pass."""
    kind, number = _kind(name), name.rpartition("_")[2]
    indices = [index for _, index in sensor.guide.layers]
    if kind == LAYER:
        return indices[int(number) - 1] / indices[int(number)]
    if kind == WALL:
        return indices[int(number) if number.isdigit() else 0]
    glass = sensor.glass.refractive_index
    return {TO_GLASS: indices[-1] / glass, TO_AIR: glass}.get(kind, 1.0)


def _normal(name: str) -> tuple[float, float, float]:
    """As `build` sets them, of a housing's sides inwards; LEDs and the contact surface have none here."""
    if _kind(name) in (TO_GLASS, TO_AIR, LAYER):
        return 0.0, 0.0, -1.0
    kind, _, side = name.partition("_")
    if kind not in ("wall", "rim", "housing") or side == "floor":
        return 0.0, 0.0, 1.0
    sign = 1.0 if (side[0] == "+") != (kind == "housing") else -1.0
    return (sign, 0.0, 0.0) if side[1] == "x" else (0.0, sign, 0.0)
