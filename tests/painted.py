"""A corpus whose light is painted, not simulated: real plan, files, camera and index, in a second."""

from __future__ import annotations

import json
import re
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from scenes import exr
from scenes.camera import count_dtype
from twin import index, planned, store
from twin.exposure import picture_facts, take, take_reference
from twin.frame import versions
from twin.plan import Plan, freeze

STUDY = """\
kind = "corpus"
name = "painted"
description = "Painted light"
design = "{design}"
mechanics = "linear"
indentation_mm = {levels}
[[samples]]
name = "box"
sampler = "uniform"
count = {count}
blanks = {blanks}
[samples.inclusion]
size_mm = [4, 12]
depth_mm = [4, 10]
modulus_kPa = [40, 120]
offset_x_mm = [-4, 4]
offset_y_mm = [-2, 2]
{more}
"""

SHAPE = (48, 64)


def small_design(**camera: Any) -> str:
    """The TOML text of `tsis` with 64 x 48 pixels of the same field, no fuller than the large ones."""
    text = files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8")
    rows, columns = SHAPE
    wide, high = 768 / columns, 492 / rows
    pixel = [8.4 * wide, 9.8 * high]
    values = {"columns": columns, "rows": rows, "pixel_um": pixel, "exposure_ms": 6.0 / wide / high, **camera}
    for name, value in values.items():
        line = f"{name} = {json.dumps(value)}"
        text, found = re.subn(rf"(?m)^{name} = .*$", line, text)
        if not found:
            text = text.replace("[camera]", f"[camera]\n{line}", 1)
    return text


def paint(
    folder: Path,
    *,
    count: int = 4,
    levels: tuple[float, ...] = (1.0, 2.0),
    blanks: float = 0.25,
    shared: bool = False,
    more: str = "",
    design: str | None = None,
    grain: float = 0.0,
    **camera: Any,
) -> Path:
    """Make a corpus under a folder and return its own folder. ``design`` is a shipped one, else a small one.

    ``grain`` is Monte Carlo noise of each pixel and LED, relative, which decides how well files pack.
    """
    folder.mkdir(parents=True, exist_ok=True)
    if design is None:
        (folder / "small.toml").write_text(small_design(**camera), encoding="utf-8")
    text = STUDY.format(
        design=design or "small.toml", levels=list(levels), count=count, blanks=blanks, more=more
    )
    (folder / "study.toml").write_text(text, encoding="utf-8")
    plan = freeze(folder / "study.toml", folder / "corpus")
    for number in range(count):
        _sample(plan, number, folder / "corpus", shared, grain)
    reindex(folder / "corpus")
    return folder / "corpus"


def reindex(corpus: Path) -> None:
    plan = planned.load_plan(corpus)
    assert not index.build(corpus, plan, planned.sha256(corpus / "plan.json")).bad


def rehash(corpus: Path, number: int = 0) -> None:
    """Have sample.json and the index say what a sample's files are now, as who forges them would."""
    folder = store.sample_folder(corpus, number)
    told = json.loads((folder / store.SAMPLE).read_text())
    for name in told["sha256"]:
        place = corpus / name if "/" in name else folder / name
        told["sha256"][name] = store.sha256(place)
    (folder / store.SAMPLE).write_text(json.dumps(told))
    reindex(corpus)


def edit_index(corpus: Path, **columns: Any) -> None:
    """Change columns of the index: each a function of its list of values."""
    table = pq.read_table(corpus / index.FILE)
    for name, change in columns.items():
        place = table.schema.get_field_index(name)
        field = table.schema.field(place)
        table = table.set_column(place, field, [change(table[name].to_pylist())])
    pq.write_table(table, corpus / index.FILE)


def light(plan: Plan, number: int, level: int, grain: float = 0.0, plain: bool = False) -> np.ndarray:
    """(n_led, rows, columns[, 3]) W m⁻² sr⁻¹ that half floats hold exactly: a lit side each, and a blob."""
    design, inclusion = plan.design(number), plan.inclusion(number)
    camera = design.camera
    rows, columns = camera.shape
    width, height = camera.field_of_view_mm, camera.field_height_mm
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * width
    y = (0.5 - (np.arange(rows) + 0.5) / rows)[:, None] * height
    blob = np.zeros((rows, columns))
    if inclusion is not None and not plain:
        away2 = (x - inclusion.offset[0]) ** 2 + (y - inclusion.offset[1]) ** 2
        blob = 0.02 * inclusion.size * np.exp(-away2 / inclusion.depth**2)
    rng = np.random.default_rng([number, level, plain])
    layers = []
    for led in design.leds:
        ramp = (x + 0 * y if led.side[1] == "x" else y + 0 * x) * (1 if led.side[0] == "+" else -1)
        layer = (0.06 + 0.02 * level) * led.flux_W / 0.01 * np.exp(0.05 * ramp) * (1 + blob)
        layer *= 1 + grain * rng.standard_normal(layer.shape)
        layers.append(layer if camera.colour == "mono" else layer[..., None] * [1.0, 0.8, 0.6])
    return np.array(layers).astype(np.float16).astype(np.float32)


def _sample(plan: Plan, number: int, corpus: Path, shared: bool, grain: float) -> None:
    design, (_, seed) = plan.design(number), plan.seeds(number)
    with store.sample_in_making(corpus, number) as folder:
        hashes = {}
        for level, depth in enumerate(plan.indentations(number)):
            radiance = light(plan, number, level, grain)
            plain = light(plan, 0 if shared else number, level, grain, plain=True)
            image = take(design, radiance, seed, depth)
            reference = take_reference(design, plain, 7 if shared else seed, depth)
            name = f"{level:016x}" if shared else f"{level}.reference"
            place = corpus / "references" / name if shared else folder / name
            place.parent.mkdir(exist_ok=True)
            _write(place, plain, reference, {"level": level}, design.camera.bits)
            stored = f"references/{name}.exr"
            if shared:
                hashes |= {f"references/{name}{end}": store.sha256(Path(f"{place}{end}")) for end in ENDS}
            else:
                stored = f"{store.sample_folder(corpus, number).relative_to(corpus)}/{name}.exr"
            record = _record(plan, number, level, depth, picture_facts(design, image, reference, radiance))
            _write(folder / str(level), radiance, image, {**record, "reference": stored}, design.camera.bits)
        hashes |= {path.name: store.sha256(path) for path in folder.iterdir()}
        seconds = {"mechanics": 0.5, "light": 1.0, "write": 0.1}
        told = {"sample": number, "sha256": hashes, "seconds": seconds, "versions": versions()}
        (folder / store.SAMPLE).write_text(json.dumps(told))


ENDS = (".exr", ".png")


def _write(place: Path, radiance: np.ndarray, counts: np.ndarray, record: dict[str, Any], bits: int) -> None:
    layers = {f"led.{number}": layer for number, layer in enumerate(radiance)}
    flat = np.zeros(radiance.shape[1:3], np.float32)
    layers |= {"pressure": flat + 1, "displacement.z": flat - 0.1}
    if counts.dtype == np.float32:
        layers["counts"] = counts
    store.write_frame(Path(f"{place}.exr"), layers, record)
    exr.write_png(Path(f"{place}.png"), np.rint(counts).astype(count_dtype(bits)))


def _record(plan: Plan, number: int, level: int, depth: float, tsis: dict[str, Any]) -> dict[str, Any]:
    inclusion = plan.inclusion(number)
    size = 0.0 if inclusion is None else inclusion.size * depth
    scalars = {"max_mm": 1e-3 * size, "total_mm3": 0.1 * size, "area_mm2": 10.0 * size}
    return {
        "sample": number,
        "level": level,
        "group": plan.group(number),
        "blank": inclusion is None,
        "parameters": plan.parameters(number),
        "press": {"indentation_mm": depth, "force_N": 0.3 * depth, "nominal_mm": plan.indentation_mm[level]},
        "fem": {"raw": scalars, "tared": scalars, "min_pressure_kPa": 0.5, "error_percent": None},
        "tsis": {**tsis, "noise_percent": 0.5},
        "seed": {"light": 0, "camera": 0},
    }
