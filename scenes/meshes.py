"""Guide, contact surface and glass as triangle meshes for other programs (no Mitsuba here)."""

from __future__ import annotations

from typing import Any

import numpy as np
import trimesh

from . import surface
from .contact import real_contact
from .sensor import Sensor


def bodies(sensor: Sensor, deformed: surface.OpticalSurface) -> dict[str, trimesh.Trimesh]:
    """Meshes in mm, by name.

    `guide` is closed: the deformed contact surface on top, flat sides (as light meets them) and a flat
    bottom. `contact` is that surface alone, facing the specimen, with the vertex attributes `pressure`, kPa,
    `contact_fraction`, 0 to 1, and `displacement_z`, mm. `glass` is a closed box.
    """
    guide, glass = sensor.guide, sensor.glass
    top = surface.triangulate(deformed)
    top.invert()  # light's normals point into the guide
    pressure = np.maximum(deformed.pressure_kPa, 0.0)  # the spline swings below zero where contact ends
    fraction = real_contact(pressure, sensor.skin, sensor.effective_modulus_kPa)
    fields = {
        "pressure": pressure,
        "contact_fraction": fraction,
        "displacement_z": deformed.displacement_mm[..., 2],
    }
    for name, values in fields.items():
        top.vertex_attributes[name] = surface.with_skirt(deformed, values).astype(np.float32)
    box = trimesh.creation.box(extents=(guide.width_mm, guide.width_mm, glass.thickness_mm))
    box.apply_translation((0.0, 0.0, -guide.thickness_mm - glass.thickness_mm / 2))
    return {"guide": _closed(top, -guide.thickness_mm), "contact": top, "glass": box}


def _closed(top: trimesh.Trimesh, bottom_mm: float) -> trimesh.Trimesh:
    """The solid between a surface on a square grid and a flat bottom."""
    count = len(top.vertices)
    n = round(np.sqrt(count))
    grid = np.arange(count).reshape(n, n)
    # once around, counter-clockwise as seen from above: rows are y, columns x
    rim = np.concatenate([grid[0, :-1], grid[:-1, -1], grid[-1, :0:-1], grid[:0:-1, 0]])
    lower = np.asarray(top.vertices)[rim].copy()
    lower[:, 2] = bottom_mm
    middle = [[0.0, 0.0, bottom_mm]]
    below = count + np.arange(rim.size)
    following, below_following = np.roll(rim, -1), np.roll(below, -1)
    walls = np.concatenate(
        [np.column_stack([rim, below, below_following]), np.column_stack([rim, below_following, following])]
    )
    floor = np.column_stack([below_following, below, np.full(rim.size, count + rim.size)])
    vertices = np.concatenate([top.vertices, lower, middle])
    return trimesh.Trimesh(vertices, np.concatenate([top.faces, walls, floor]), process=False)


def as_bytes(mesh: trimesh.Trimesh, kind: str) -> bytes:
    """The file of a mesh, `kind` "stl" or "ply" (with its vertex attributes)."""
    options: dict[str, Any] = {"include_attributes": True} if kind == "ply" else {}
    data = mesh.export(file_type=kind, **options)
    return data.encode() if isinstance(data, str) else bytes(data)
