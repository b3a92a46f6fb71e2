"""The scene as files that the stock `mitsuba` package loads: XML, the contact surface as PLY, its optics.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mitsuba as mi
import numpy as np

from . import build, plugins, surface
from .reference import MAX_DEPTH, ROULETTE_DEPTH
from .sensor import Sensor

SCENE, CONTACT, TABLE = "scene.xml", "contact.ply", "contact.npy"
FILES = (SCENE, CONTACT, TABLE)
_SAMPLES = 64  # per pixel, where the user asks for no other number


def write(sensor: Sensor, table: mi.TensorXf, deformed: surface.OpticalSurface, folder: Path) -> None:
    """Write the sensor with this contact surface and its optics, `bsdf.Table.pack`, into a folder.

    `scene.xml` holds the same scene as `build.load_scene` (lengths in mm, radiance in W mm⁻² sr⁻¹) and stock
    `path`; `contact.ply` the deformed surface with `vertex_contact_fraction`; `contact.npy` the packed
    table as float32, which `frustrated_tir` reads.
    """
    scene = build.load_scene(sensor, table)
    build.put_surface(scene, sensor, deformed)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    contact.write_ply(str(folder / CONTACT))
    np.save(folder / TABLE, table.numpy(), allow_pickle=False)
    described = build.describe(
        sensor,
        {
            "type": "ply",
            "filename": CONTACT,
            "bsdf": {
                "type": "frustrated_tir",
                "filename": TABLE,
                "contact_fraction": {"type": "mesh_attribute", "name": "vertex_contact_fraction"},
            },
        },
    )
    integrator = {"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH}
    described["camera"] = described["camera"] | {"sampler": {"type": "independent", "sample_count": _SAMPLES}}
    described = {"type": "scene", "integrator": integrator, **described}
    (folder / SCENE).write_text(to_xml(described), encoding="utf-8")


def to_xml(described: dict[str, Any]) -> str:
    """A scene dictionary as XML text, by Mitsuba's own writer, with ids and exact transforms.

    Raises ValueError for a plugin that neither Mitsuba nor `plugins.TYPES` knows.
    """
    state = mi.parser.parse_dict(mi.parser.ParserConfig(mi.variant()), described)
    for node in state.nodes:
        name = node.props.plugin_name()
        if node.type == mi.ObjectType.Unknown:
            if name not in plugins.TYPES:
                raise ValueError(
                    f"scene: received the plugin {name!r}; allowed Mitsuba's and {plugins.TYPES}"
                )
            node.type = plugins.TYPES[name]
    root = ElementTree.fromstring(mi.parser.write_string(state))
    _amend(root, described)
    for element in root:
        if element.get("name") in described:
            element.set("id", element.attrib.pop("name"))
    ElementTree.indent(root, "    ")
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _amend(element: ElementTree.Element, described: dict[str, Any]) -> None:
    """Put in matrices for Mitsuba's chains of turns and shifts, which are rounded."""
    for child in element:
        value = described.get(child.get("name", ""))
        if isinstance(value, dict):
            _amend(child, value)
        elif isinstance(value, mi.ScalarTransform4f):
            for step in list(child):
                child.remove(step)
            numbers = np.array(value.matrix, dtype=np.float64).ravel()
            ElementTree.SubElement(child, "matrix", value=" ".join(repr(float(x)) for x in numbers))
