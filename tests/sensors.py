"""What the tests of the optics share: the paper's sensor, and a pressed bump in closed form."""

from __future__ import annotations

import dataclasses
from functools import cache
from typing import Any, Literal

import numpy as np
import pyvista as pv

from scenes.contact import ContactOptics, contact_optics
from scenes.sensor import Camera, Glass, Guide, Led, Sensor, Side
from scenes.skin import Skin, Tissue
from scenes.surface import NODES, OpticalSurface

HALF_MM = 12.5
ALBEDO = 0.68


def paper_sensor(coupling: Literal["air", "embedded"] = "air", **camera: Any) -> Sensor:
    """Four LEDs, 25 x 25 x 10 mm of PDMS on glass; keywords replace fields of the camera."""
    sides: tuple[Side, ...] = ("+x", "-x", "+y", "-y")
    view = {"columns": 768, "rows": 492, "pixel_um": (8.4, 9.8), "field_of_view_mm": 25.0}
    return Sensor(
        guide=Guide(width_mm=2 * HALF_MM, thickness_mm=10.0),
        glass=Glass(),
        leds=tuple(Led(side=side, coupling=coupling) for side in sides),
        camera=Camera(**{**view, **camera}),
        skin=Skin(),
        tissue=Tissue(),
        effective_modulus_kPa=5.55,
    )


def dense(sensor: Sensor) -> Sensor:
    """The same before tissue so dense that light comes back where it went in, as stock `path` sees it."""
    return dataclasses.replace(sensor, tissue=Tissue(scattering_per_mm=1000.0, absorption_per_mm=20.0))


def pressed(pressure: Any, displacement: Any, cells: int = 50) -> pv.PolyData:
    """A contact surface of square cells whose fields are functions of x and y, mm.

    `pressure` returns (n,) kPa, `displacement` its three parts, mm.
    """
    line = np.linspace(-HALF_MM, HALF_MM, cells + 1)
    x, y = (v.ravel() for v in np.meshgrid(line, line))
    corner = (np.arange(cells)[:, None] * (cells + 1) + np.arange(cells)).ravel()
    quads = np.column_stack(
        [np.full_like(corner, 4), corner, corner + 1, corner + cells + 2, corner + cells + 1]
    )
    surface = pv.PolyData(np.column_stack([x, y, np.zeros_like(x)]), quads.ravel())
    surface.point_data["displacement"] = np.column_stack([v + 0.0 * x for v in displacement(x, y)])
    surface.point_data["pressure"] = pressure(x, y) + 0.0 * x
    return surface


def bump() -> pv.PolyData:
    """What a press on a stiff inclusion leaves, roughly: 0.9 kPa and 60 % more in the middle, 4 mm wide."""

    def rise(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.exp(-(x**2 + y**2) / 32.0)

    return pressed(
        lambda x, y: 0.9 * (1.0 + 0.6 * rise(x, y)),
        lambda x, y: (0.05 * x / HALF_MM, 0.05 * y / HALF_MM, -0.05 - 0.02 * rise(x, y)),
        cells=100,
    )


def domed() -> OpticalSurface:
    """The same on a dome of 150 mm radius, which tissue follows and leaves at the corners: 1/150 mm curved.
    Finite elements have a press of 1 mm curved by 1/220 in the middle to 1/110 mm, without a fold."""
    line = np.linspace(-HALF_MM, HALF_MM, NODES)
    square = line**2 + line[:, None] ** 2
    rest, rise = -square / 300.0, np.exp(-square / 32.0)
    displacement = np.stack([0.0 * rest, 0.0 * rest, -0.05 - 0.02 * rise], axis=-1)
    pressure = 0.9 * (1.0 + 0.6 * rise) * np.clip(1.0 - square / 200.0, 0.0, None) ** 0.5
    return OpticalSurface(line, displacement, pressure, rest)


@cache
def contact_table(albedo: float = ALBEDO) -> ContactOptics:
    return contact_optics(1.4336, 1.0, 1.40, albedo, 10.0, 550.0)


def contact_bsdf(fraction: float, albedo: float = ALBEDO) -> dict[str, Any]:
    from scenes.bsdf import Table

    return {
        "type": "frustrated_tir",
        "table": Table.pack(contact_table(albedo)),
        "contact_fraction": {"type": "uniform", "value": fraction},
    }
