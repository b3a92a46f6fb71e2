"""One sample of a corpus: its presses, their light, its files. A function of the plan and the number alone.

The two halves are apart so that they can run in different processes: `pressed` is mechanics only, `lit` takes
what it returns. Neither knows of workers or order, and both give the same bytes wherever they run.
"""

from __future__ import annotations

import hashlib
import json
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin import presses, store
from twin.design import Design
from twin.exposure import (
    how_pressed,
    light_seed,
    mechanics_facts,
    picture_facts,
    seen_pressure,
    take,
    take_reference,
)
from twin.frame import versions

if TYPE_CHECKING:
    import pyvista

    from fem import Emulator
    from scenes import Rendering, SpectralRenderer
    from scenes.sensor import Sensor
    from scenes.traced import TracedLight
    from twin.plan import Plan


@dataclass(frozen=True)
class Contact:
    """One press level as the light needs it."""

    surface: pyvista.PolyData
    """Contact surface of `fem.press`, with and without inclusion."""
    level_mm: float
    press: dict[str, Any]
    facts: dict[str, Any]


def make(plan: Plan, number: int, corpus: Path) -> dict[str, Any]:
    """Make a sample's folder in a corpus; return its ``seconds`` and ``bytes``.

    Raises what `twin.simulate` raises, and OSError or `scenes.exr.ImageError` where files cannot be written.
    """
    start = time.perf_counter()
    contacts = pressed(plan, number)
    return lit(plan, number, contacts, time.perf_counter() - start, corpus)


def pressed(plan: Plan, number: int) -> list[Contact]:
    """Return the sample's contact surfaces, one for each press level."""
    design, inclusion, levels = plan.design(number), plan.inclusion(number), plan.indentations(number)
    found: Any
    if plan.mechanics == "emulator":
        found = presses.emulated(design, inclusion, levels, _emulator(str(plan.emulator)))
    elif plan.mechanics == "multipoles":
        found = presses.expanded(design, inclusion, levels, quality=plan.quality)
    else:
        found = presses.solved(design, inclusion, levels, quality=plan.quality, pictured=True)
    return [
        Contact(press.surface, level, how_pressed(design, press), mechanics_facts(design, press))
        for level, press in zip(levels, found, strict=True)
    ]


def lit(plan: Plan, number: int, contacts: list[Contact], seconds: float, corpus: Path) -> dict[str, Any]:
    """Light a sample's contact surfaces and write its folder; ``seconds`` is what its mechanics took."""
    start = time.perf_counter()
    design, (light, camera) = plan.design(number), plan.seeds(number)
    written = 0.0
    with store.sample_in_making(corpus, number) as folder:
        hashes: dict[str, str] = {}
        for level, contact in enumerate(contacts):
            plain = plan.inclusion(number) is None
            rendering = _render(plan, design, contact, "pressure_0" if plain else "pressure", light)
            same = rendering if plain else None
            reference = _reference(plan, number, level, contact, corpus, folder, same)
            began = time.perf_counter()
            image = take(design, rendering.radiance, camera, contact.level_mm)
            record = {
                "sample": number,
                "level": level,
                "group": plan.group(number),
                "blank": plain,
                "parameters": plan.parameters(number),
                "press": {**contact.press, "nominal_mm": plan.indentation_mm[level]},
                "fem": contact.facts,
                "tsis": {
                    **picture_facts(design, image, reference.counts, rendering.radiance),
                    "noise_percent": rendering.noise_percent,
                },
                "reference": reference.name,
                "seed": {"light": light, "camera": camera},
            }
            _write(folder / str(level), image, rendering, record, design)
            hashes |= reference.hashes
            written += time.perf_counter() - began
        hashes |= {path.name: store.sha256(path) for path in sorted(folder.iterdir())}
        took = {"mechanics": seconds, "light": time.perf_counter() - start - written, "write": written}
        from scenes import exr

        told = {"sample": number, "sha256": hashes, "seconds": took, "versions": versions()}
        exr.write_bytes(folder / store.SAMPLE, (json.dumps(told, indent=1, sort_keys=True) + "\n").encode())
        size = sum(path.stat().st_size for path in folder.iterdir())
    return {"sample": number, "seconds": took, "bytes": size}


def refer(plan: Plan, number: int, level: int, contact: Contact, corpus: Path) -> None:
    """Make the reference that the sample shares with others, unless it is there or it shares none."""
    if plan.shares_references:
        _reference(plan, number, level, contact, corpus, corpus)


@dataclass(frozen=True)
class _Reference:
    """What the camera sees without inclusion: (rows, columns[, 3]) counts, its file, hashes of its files."""

    counts: NDArray[np.float32]
    name: str
    hashes: dict[str, str]


def _reference(
    plan: Plan,
    number: int,
    level: int,
    contact: Contact,
    corpus: Path,
    folder: Path,
    same: Rendering | None = None,
) -> _Reference:
    """Return the reference of one level, of the sample's own or shared with all samples of equal light.

    ``same`` is its light, where the sample is blank and has it already.
    """
    design, (light, camera) = plan.design(number), plan.seeds(number)
    if plan.shares_references:
        key = _key(plan, contact, light)
        name, place, seed = f"references/{key}", corpus / "references" / key, light
        if shared := _shared(str(place), name):
            return shared
        place.parent.mkdir(exist_ok=True)
    else:
        folder_name = store.sample_folder(corpus, number).relative_to(corpus)
        name, place, seed = f"{folder_name}/{level}.reference", folder / f"{level}.reference", camera
    rendering = same or _render(plan, design, contact, "pressure_0", light)
    counts = take_reference(design, rendering.radiance, seed, contact.level_mm)
    record = {
        "press": {"nominal_mm": plan.indentation_mm[level], "indentation_mm": contact.level_mm},
        "parameters": {} if plan.shares_references else plan.parameters(number),
        "noise_percent": rendering.noise_percent,
        "seed": {"light": light, "camera": seed},
    }
    _write(place, counts, rendering, record, design)
    if plan.shares_references:
        return _shared(str(place), name) or _gone(place)
    return _Reference(counts, f"{name}.exr", {})


def _gone(place: Path) -> _Reference:
    raise FileNotFoundError(f"{place}.exr: was written and is gone")


@lru_cache(maxsize=64)
def _found(place: str, name: str, stamp: tuple[int, int]) -> _Reference:
    from scenes import exr

    planes = exr.read_exr(f"{place}.exr")
    names = [key for key in ("counts", "counts.R", "counts.G", "counts.B") if key in planes]
    counts = planes[names[0]] if len(names) == 1 else np.stack([planes[key] for key in names], axis=-1)
    hashes = {f"{name}{suffix}": store.sha256(Path(place + suffix)) for suffix in (".exr", ".png")}
    return _Reference(counts, f"{name}.exr", hashes)


def _shared(place: str, name: str) -> _Reference | None:
    """Return a reference that is there already; the picture is written last."""
    try:
        stamp = Path(f"{place}.exr").stat(), Path(f"{place}.png").stat()
    except OSError:
        return None
    return _found(place, name, (stamp[0].st_mtime_ns, stamp[1].st_mtime_ns))


def _key(plan: Plan, contact: Contact, light: int) -> str:
    """Return a name for all that decides a reference: the same name, the same bytes."""
    from scenes.traced import LIGHT
    from scenes.view import SIGHT

    told = hashlib.sha256()
    head = plan.head  # its design, not that of the sample, which knows where the corpus lies
    told.update(repr((head.design_sha256, sorted(head.ies.items()))).encode())
    told.update(repr((plan.light, light, contact.level_mm, LIGHT, SIGHT)).encode())
    if plan.head.paths is not None:
        told.update(repr(plan.head.paths).encode())
    if head.traced is not None:
        told.update(head.traced.sha256.encode())
    for array in (contact.surface.points, contact.surface["pressure_0"], contact.surface["displacement_0"]):
        told.update(np.ascontiguousarray(array, np.float64).tobytes())
    return told.hexdigest()[:16]


def _write(
    place: Path, image: NDArray[Any], rendering: Rendering, record: dict[str, Any], design: Design
) -> None:
    """Write PLACE.exr, radiance, fields and counts that have fractions, and PLACE.png, whole counts."""
    from scenes import exr
    from scenes.camera import count_dtype

    layers = {f"led.{number}": layer for number, layer in enumerate(rendering.radiance)}
    layers |= {"pressure": seen_pressure(rendering), "displacement.z": rendering.displacement_z}
    if image.dtype == np.float32:
        layers["counts"] = image
    store.write_frame(place.with_name(place.name + ".exr"), layers, record)
    whole = np.rint(image).astype(count_dtype(design.camera.bits))
    exr.write_png(place.with_name(place.name + ".png"), whole)


def _render(plan: Plan, design: Design, contact: Contact, field: str, seed: int) -> Rendering:
    renderer = _renderer(design)
    traced = None if plan.traced is None else _traced(str(plan.traced))
    return renderer.render(
        contact.surface,
        field=field,
        quality=plan.light,
        seed=light_seed(seed),
        samples=plan.head.paths,
        traced=traced,
    )


_KEPT: dict[Sensor, SpectralRenderer] = {}


def _renderer(design: Design) -> SpectralRenderer:
    """Return the scene of the design's sensor: that of the sample before, or what of it is the same."""
    from scenes import SpectralRenderer

    sensor = design.sensor()
    if sensor not in _KEPT:
        before = next(iter(_KEPT.values()), None)
        _KEPT.clear()
        _KEPT[sensor] = SpectralRenderer(
            sensor, count=design.light.bands, at=design.sensor, device="cpu", like=before
        )
    return _KEPT[sensor]


@lru_cache(maxsize=1)
def _traced(file: str) -> tuple[TracedLight, ...]:
    from scenes import traced

    return traced.load(file)


@lru_cache(maxsize=1)
def _emulator(file: str) -> Emulator:
    import fem

    return fem.load_emulator(file)
