"""Painted light of a press with and without inclusion, for tests that need pictures and no physics."""

from __future__ import annotations

import hashlib
import json
import tomllib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from other_camera import real_camera
from painted import small_design

from scenes.camera import count_dtype
from scenes.exr import flat_planes, write_exr, write_png
from twin.design import Design, parse_design
from twin.received import Received, Wanted


def small(**camera: object) -> Design:
    """The paper's sensor with 64 x 48 pixels."""
    return parse_design(tomllib.loads(small_design(**camera)), "small.toml")


def painted_light(
    design: Design, levels: tuple[float, ...], blob: float = 0.4, x_mm: float = 0.0, wide_mm2: float = 20.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Light with and without a blob, (levels, rows, columns[, 3]) W m⁻² sr⁻¹; brighter the deeper (mm)."""
    camera = design.camera
    rows, columns = camera.shape
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * camera.field_of_view_mm
    y = (0.5 - (np.arange(rows) + 0.5) / rows)[:, None] * camera.field_height_mm
    plain = np.exp(-((x / 14) ** 2) - (y / 12) ** 2)
    lit = plain * (1 + blob * np.exp(-((x - x_mm) ** 2 + y**2) / wide_mm2))
    bright = np.array(levels)[:, None, None] * 0.25
    both = np.stack([bright * lit, bright * plain])
    if camera.colour == "rgb":
        both = both[..., None] * np.array([1.0, 0.8, 0.6])
    return both[0], both[1]


def pair(
    design: Design, levels: tuple[float, ...] = (1.0, 2.0, 3.0), seed: int = 0, **options: int
) -> Received:
    """What the design's own camera delivers of painted light."""
    light = painted_light(design, levels)
    return real_camera(design, *light, seed, percent=0.0, camera=design.camera, **options)


def wanted(design: Design, levels: tuple[float, ...] = (1.0, 2.0, 3.0), most: int = 100) -> Wanted:
    """What a model of this design takes."""
    camera = design.camera
    return Wanted(camera.shape, camera.bits, camera.colour, levels, (1, most))


def write_folders(received: Received, levels: tuple[float, ...], root: Path) -> list[Path]:
    """Write what an estimator reads of the folders of ``twin simulate``."""
    folders = []
    for number, depth in enumerate(levels):
        folder = root / f"{number:02d}"
        folder.mkdir(parents=True)
        image, reference = received.images[number], received.references[number]
        write_png(folder / "image.png", np.rint(image).astype(count_dtype(received.bits)))
        if received.frames > 1:
            write_exr(folder / "image.exr", flat_planes({"counts": image}))
        write_exr(folder / "reference.exr", flat_planes({"counts": reference}))
        told = {place.name: hashlib.sha256(place.read_bytes()).hexdigest() for place in folder.iterdir()}
        record = {
            "press": {"indentation_mm": depth},
            "tsis": {"frames": received.frames, "reference_frames": received.reference_frames},
            "sha256": told,
        }
        (folder / "frame.json").write_text(json.dumps(record))
        folders.append(folder)
    return folders
