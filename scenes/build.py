"""The Mitsuba scene: guide, walls, glass, LEDs and the deformed contact surface, which is updated in place.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from . import (
    bsdf,  # noqa: F401  registers the BSDF
    housing,
    pinhole,
    surface,
)
from .arrays import floats, numbers
from .contact import ContactOptics, contact_optics, real_contact
from .sensor import Led, NotModelled, Sensor
from .tissue import Coupling, body_behind, couple

_BLACK = {"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}}
_OUTWARD = {"+x": (1.0, 0.0), "-x": (-1.0, 0.0), "+y": (0.0, 1.0), "-y": (0.0, -1.0)}
_CLEARANCE_MM = 0.01  # of the pressed surface above the next layer of other index
_WALL_TOP_MM = 0.5  # walls reach above the contact surface, which bulges a little beside the press


def optics_of(sensor: Sensor) -> ContactOptics:
    """The table of the contact's optics for this sensor."""
    skin = sensor.skin
    index, body = body_behind(skin, sensor.tissue)
    return contact_optics(
        sensor.guide.refractive_index,
        skin.gap_index,
        index,
        body.reflectance,
        skin.rms_height_um,
        sensor.wavelength_nm,
        dust=skin.dust,
    )


def coupling_of(sensor: Sensor, optics: ContactOptics) -> Coupling:
    """Tissue or sheet of this sensor behind its contact."""
    index, body = body_behind(sensor.skin, sensor.tissue)
    return couple(optics, body, sensor.guide.refractive_index, index, sensor.skin.gap_index)


def load_scene(sensor: Sensor, table: mi.TensorXf) -> mi.Scene:
    """Load the sensor with a flat, unloaded contact surface whose optics are `table` (`bsdf.Table.pack`).

    The contact surface is the mesh with id `contact`; LED number i is the shape with id `led_i`. Media are
    separated by single faces: guide to air (side walls), guide to glass, glass to air, and `layer_i` over the
    guide's layer i, counted from 0, whose walls are `wall_+x_i` and so on. The glass's rim is
    held in a black frame; below it lies a housing that reflects (`housing_floor` and so on), or nothing: a
    black one. Side walls stay flat: their bulge under load, 0.1 mm, is left out.
    """
    scene = describe(sensor, _contact_mesh(sensor, table))
    return mi.load_dict(scene, optimize=False)  # merging would lose the walls' names


def describe(sensor: Sensor, contact: mi.Mesh | dict[str, Any]) -> dict[str, Any]:
    """The scene as Mitsuba's dictionary, with this contact surface."""
    guide, glass = sensor.guide, sensor.glass
    half, bottom = guide.width_mm / 2, -guide.thickness_mm
    lowest = bottom - glass.thickness_mm
    scene: dict[str, Any] = {
        "type": "scene",
        "camera": pinhole.describe(sensor),
        "contact": contact,
        "guide_to_glass": _face(half, bottom, _dielectric(guide.bottom_index, glass.refractive_index)),
        "glass_to_air": _face(half, lowest, _dielectric(glass.refractive_index, 1.0)),
    }
    indices, floors = [index for _, index in guide.layers], guide.floors_mm
    for side, outward in _OUTWARD.items():
        wall = _side_wall(sensor, indices[0])
        scene[f"wall_{side}"] = _wall(half, floors[0], _WALL_TOP_MM, outward, wall)
        scene[f"rim_{side}"] = _wall(half, lowest, bottom, outward, _BLACK)
    for number, led in enumerate(sensor.leds):
        scene[f"led_{number}"] = _led(led, half, lowest)
    for k in range(1, len(indices)):
        scene[f"layer_{k}"] = _face(half, floors[k - 1], _dielectric(indices[k - 1], indices[k]))
        for side, outward in _OUTWARD.items():
            wall = _side_wall(sensor, indices[k])
            scene[f"wall_{side}_{k}"] = _wall(half, floors[k], floors[k - 1], outward, wall)
    return scene | housing.describe(sensor)


def _side_wall(sensor: Sensor, index: float) -> dict[str, Any]:
    """Of a layer of this index; polished where LEDs in air shine through: `trace` paints the walls around
    their windows."""
    guide = sensor.guide
    if guide.walls == "polished" or any(led.coupling == "air" for led in sensor.leds):
        return _dielectric(index, 1.0)
    albedo = guide.wall_albedo if guide.walls == "diffuse" else 0.0
    paint = {"type": "diffuse", "reflectance": {"type": "uniform", "value": albedo}}
    return {"type": "twosided", "bsdf": paint}


def put_surface(scene: mi.Scene, sensor: Sensor, deformed: surface.OpticalSurface) -> None:
    """Move the scene's contact mesh to the deformed shape and set its real contact fraction, in place.

    Raises `NotModelled` where it would reach through the first of a guide's layers of different index.
    """
    if sensor.guide.lower:
        _check_above(sensor, deformed)
    mesh = surface.triangulate(deformed)
    parameters = mi.traverse(scene)
    if 3 * len(mesh.vertices) != len(
        parameters["contact.vertex_positions"]
    ):  # Mitsuba would read beyond the end
        raise ValueError(
            f"deformed: received {deformed.nodes_mm.size} nodes per side; allowed {surface.NODES}"
        )
    parameters["contact.vertex_positions"] = floats(mesh.vertices)
    parameters["contact.vertex_normals"] = floats(mesh.vertex_normals)
    parameters["contact.vertex_contact_fraction"] = floats(_fraction(sensor, deformed))
    parameters.update()


def _check_above(sensor: Sensor, deformed: surface.OpticalSurface) -> None:
    """Refuse a surface that reaches the plane under it, which does not give way."""
    lowest, top = float((deformed.rest_mm + deformed.displacement_mm[..., 2]).min()), sensor.guide.top_mm
    if lowest < _CLEARANCE_MM - top:
        allowed = f"more than {_CLEARANCE_MM - lowest:.3g} mm under this press"
        told = f"waveguide.layers: received {top:g} mm above the first change of index; allowed {allowed}"
        raise NotModelled(told)


def light_only(scene: mi.Scene, sensor: Sensor, number: int | None) -> None:
    """Switch all LEDs off but `number`, or all on for None."""
    parameters = mi.traverse(scene)
    for other, led in enumerate(sensor.leds):
        on = number is None or other == number
        parameters[f"led_{other}.emitter.radiance.value"] = radiance(led) if on else 0.0
    parameters.update()


def led_frame(
    led: Led, half_mm: float, floor_mm: float | None = None
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre (3,) mm of an LED's disc, its unit axis (3,) into the guide, and a unit tangent (3,).

    LEDs below need `floor_mm`, the height of the glass's lower face.
    """
    if led.side == "below":
        assert floor_mm is not None
        height = floor_mm + (-led.gap_mm if led.coupling == "air" else led.gap_mm)
        return np.array([led.x_mm, led.y_mm, height]), np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0])
    outward = np.array([*_OUTWARD[led.side], 0.0])
    tangent = np.array([abs(outward[1]), abs(outward[0]), 0.0])  # along the side, in +x or +y
    away = led.gap_mm if led.coupling == "air" else -led.gap_mm
    centre = outward * (half_mm + away) + tangent * led.along_mm + np.array([0.0, 0.0, led.z_mm])
    return centre, -outward, tangent


def _contact_mesh(sensor: Sensor, table: mi.TensorXf) -> mi.Mesh:
    start = surface.flat(sensor.guide.width_mm, 0.0)
    shape = surface.triangulate(start)
    properties = mi.Properties()
    properties["bsdf"] = mi.load_dict(
        {
            "type": "frustrated_tir",
            "table": table,
            "contact_fraction": {"type": "mesh_attribute", "name": "vertex_contact_fraction"},
        }
    )
    mesh = mi.Mesh("contact", len(shape.vertices), len(shape.faces), properties, has_vertex_normals=True)
    mesh.add_attribute("vertex_contact_fraction", 1, np.zeros(len(shape.vertices), dtype=np.float32))
    parameters = mi.traverse(mesh)
    parameters["faces"] = numbers(shape.faces)
    parameters["vertex_positions"] = floats(shape.vertices)
    parameters["vertex_normals"] = floats(shape.vertex_normals)
    parameters.update()
    return mesh


def _fraction(sensor: Sensor, deformed: surface.OpticalSurface) -> np.ndarray:
    fraction = real_contact(deformed.pressure_kPa, sensor.skin, sensor.effective_modulus_kPa)
    return surface.with_skirt(deformed, fraction)


def _dielectric(inside: float, outside: float) -> dict[str, Any]:
    if inside == outside:  # Mitsuba refuses an interface between equal indices
        return {"type": "null"}
    return {"type": "dielectric", "int_ior": inside, "ext_ior": outside}


def _face(half: float, z: float, material: dict[str, Any]) -> dict[str, Any]:
    """A horizontal square whose normal points down, away from the guide."""
    turn = mi.ScalarTransform4f().translate([0, 0, z]).rotate([1, 0, 0], 180).scale([half, half, 1])
    return {"type": "rectangle", "to_world": turn, "bsdf": material}


def _wall(
    half: float, low: float, high: float, outward: tuple[float, float], material: dict[str, Any]
) -> dict[str, Any]:
    """A vertical rectangle between two heights whose normal points outward."""
    place = mi.ScalarPoint3f(outward[0] * half, outward[1] * half, 0.5 * (low + high))
    aim = place + mi.ScalarVector3f(*outward, 0.0)
    look = mi.ScalarTransform4f().look_at(origin=place, target=aim, up=[0, 0, 1])
    return {"type": "rectangle", "to_world": look.scale([half, 0.5 * (high - low), 1]), "bsdf": material}


def _led(led: Led, half: float, floor: float) -> dict[str, Any]:
    centre, axis, _ = led_frame(led, half, floor)
    up = [0, 1, 0] if led.side == "below" else [0, 0, 1]
    place = mi.ScalarTransform4f().look_at(origin=centre.tolist(), target=(centre + axis).tolist(), up=up)
    return {
        "type": "disk",
        "to_world": place.scale(led.diameter_mm / 2),
        "bsdf": _BLACK,
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": radiance(led)}},
    }


def radiance(led: Led) -> float:
    """Radiance of an LED's disc, W / (mm² sr), if it is Lambertian; else times `lamp.Patterns.relative`."""
    return float(led.flux_W / (dr.pi * (dr.pi * led.diameter_mm**2 / 4)))
