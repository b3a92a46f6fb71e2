"""`twin emulate --light`: learn the traced light of a sensor, so that pictures have no noise of the light.

Presses of many specimens around the design's are traced, one file each in the folder OUT + ".presses": the
same call goes on with them. What is learned is `scenes.traced.TracedLight`.
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import qmc

import fem
from scenes import ies
from twin import learned, presses
from twin.complaint import DesignError, shown
from twin.conflicts import black, colourless
from twin.design import Design, parse_design
from twin.fields import put, tables_of
from twin.pooled import each
from twin.stage import check_file, staged_file

if TYPE_CHECKING:
    from scenes.traced import TracedLight

PRESSES = 384
"""Presses that are traced, each with and without its inclusion."""
_DEEP, _DEEPEST = 1 / 3, 1 / 6
"""So many of them are in so much of the range of depths, at its deep end: light changes fastest there."""
_CELLS = 100  # of the maps that are kept, per side
_NUISANCE = {"specimen.modulus_kPa": 0.15, "specimen.thickness_mm": 0.1, "surface.rms_slope": 0.35}
"""What else differs from press to press: up to so much of its value either way."""


@dataclass(frozen=True)
class Task:
    """One press to trace, as a worker process takes it."""

    design: Design
    inclusion: fem.Inclusion
    depth_mm: float
    emulator: str
    seed: int
    place: Path


def learn_light(
    design: Design,
    out: str,
    *,
    emulator: str | Path | None = None,
    samples: int = PRESSES,
    workers: int = 1,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> tuple[TracedLight, ...]:
    """Trace presses of a design's sensor, write what is learned to `out` and return it, one for each band.

    Parameters
    ----------
    out : name of the file, ending in ``.npz``.
    emulator : of the design's mechanics; by default the usual one, `twin.learned.usual_emulator`.
    samples : presses, 64 or more.

    Raises
    ------
    DesignError
        In one line.
    """
    from scenes import spectral, traced

    target = check_file(out, "out", ".npz")
    colourless(design, "learned light")
    black(design, "learned light")
    for number, led in enumerate(design.leds):
        if led.flux_W == 0.0:
            allowed = "more than 0: light is learned for each watt"
            raise DesignError(f"leds.{number}.flux_W", shown(led.flux_W), allowed, source=design.name)
    if samples < 64:
        raise DesignError("samples", shown(samples), "64 or more")
    file = learned.usual_emulator(design.name) if emulator is None else learned.emulator_file(emulator)
    known = presses.emulator_of(design, file)
    folder = target.with_name(target.name + ".presses")
    folder.mkdir(parents=True, exist_ok=True)
    tasks = tasks_of(design, known, str(file), samples, seed, folder)
    tell = progress or (lambda stage, share: None)
    left = [task for task in tasks if not _kept(task)]
    tell("presses", 1.0 - len(left) / len(tasks))
    each(
        trace,
        left,
        workers,
        _one_thread,
        lambda count: tell("presses", 1.0 - (len(left) - count) / len(tasks)),
    )
    tell("fit", 1.0)
    sensors = spectral.band_sensors(design.sensor(), count=design.light.bands, at=design.sensor)
    files = [path for task in tasks for path in _files(task)]
    told = [_array(path, "description") for path in files]
    light = tuple(
        traced.learn(sensor, told, (_array(path, f"traced.{number}") for path in files))
        for number, (_, _, sensor) in enumerate(sensors)
    )
    with staged_file(out, "out", ".npz") as place:
        traced.save(light, place)
    return light


def light_of(file: str | Path) -> tuple[TracedLight, ...]:
    """Return the light of each band from a file of `learn_light`; raises `DesignError` for others."""
    from scenes import traced

    try:
        return traced.load(learned.light_file(file))
    except (OSError, traced.NotModelled):
        allowed = " or ".join(["a file of `twin emulate --light`", *learned.shipped()])
        raise DesignError("traced", shown(str(file)), allowed) from None


def tasks_of(
    design: Design, emulator: fem.Emulator, file: str, samples: int, seed: int, folder: Path
) -> list[Task]:
    """Return the presses to trace: a Sobol sequence over inclusions, depths and `_NUISANCE`."""
    ranges, tables = emulator.plan.ranges, tables_of(design)
    found: list[Task] = []
    rng = np.random.default_rng(seed)
    for unit in qmc.Sobol(9, scramble=True, rng=rng).random_base2((2 * samples - 1).bit_length()):
        if len(found) == samples:
            break
        fields = [
            (name, float(_middle(design, name) * (1.0 + share * (2.0 * u - 1.0))))
            for (name, share), u in zip(_NUISANCE.items(), unit[6:], strict=True)
        ]
        away = min(ranges.offset_mm, 0.1 * design.waveguide.width_mm)
        inclusion = fem.Inclusion(
            _between(ranges.size_mm, unit[0]),
            _between(ranges.depth_mm, unit[1]),
            _between(ranges.modulus_kPa, unit[2]),
            (away * (2 * float(unit[3]) - 1), away * (2 * float(unit[4]) - 1)),
        )
        low, high = ranges.indentation_mm
        low = max(low, 0.2 * high)  # well below the first level that is usual: the end is told worst
        if len(found) >= round((1.0 - _DEEP) * samples):
            low = high - _DEEPEST * (high - low)
        depth = _between((low, high), unit[5])
        changed = parse_design(put(tables, fields))
        try:
            presses.check_emulated(changed, inclusion, [depth], emulator)
        except fem.NotModelled:
            continue
        number = len(found)
        place = folder / f"{seed}.{number:04d}.npz"
        found.append(Task(changed, inclusion, depth, file, seed * 10_000 + number, place))
    return found


def trace(task: Task) -> None:
    """Trace a press and write its description and traced light; runs in a worker process."""
    from scenes import SpectralRenderer, surface, traced, transport
    from twin.labour import give_back
    from twin.sample import _emulator

    press = presses.emulated(task.design, task.inclusion, [task.depth_mm], _emulator(task.emulator))[0]
    renderer = SpectralRenderer(
        task.design.sensor(), count=task.design.light.bands, at=task.design.sensor, device="cpu"
    )
    for field, path in zip(("pressure", "pressure_0"), _files(task), strict=True):
        if _of(task, path):
            continue
        seen = renderer.render(press.surface, field=field, seed=task.seed % 2**26)
        assert seen.traced is not None
        one = renderer.renderers[0]
        shape = surface.resample(
            press.surface, one.sensor.guide.width_mm, suffix=field.removeprefix("pressure")
        )
        ground = transport.survey(one.scene, one.sensor)
        arrays: dict[str, NDArray[Any]] = {"mark": np.array(_mark(task))}
        arrays["description"] = traced.describe(shape, ground.fraction).astype(np.float32)
        arrays |= {
            f"traced.{number}": traced.blocks(maps, _CELLS).astype(np.float32)
            for number, maps in enumerate(seen.traced)
        }
        _write(path, arrays)
    give_back()


def summary(light: tuple[TracedLight, ...], out: str) -> str:
    """Return what a person wants to know of learned light, several lines."""
    lines = [
        f"traced light: {one.presses} presses, each pair left out in turn {one.error_percent:.2g} % off in "
        "all of it, noise of the tracing included"
        for one in light
    ]
    return "\n".join([*lines, f"file: {out}"])


def _files(task: Task) -> list[Path]:
    return [task.place, task.place.with_name(task.place.name.removesuffix(".npz") + ".blank.npz")]


def _mark(task: Task) -> str:
    """What decides a press's light: files of another design or an earlier version are traced anew."""
    from scenes.traced import PRESSES_SINCE

    luminaires = tuple(ies.digest(led.ies) for led in task.design.leds if led.ies is not None)
    told = (PRESSES_SINCE, task.design, task.inclusion, task.depth_mm, task.seed, *luminaires)
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def _kept(task: Task) -> bool:
    return all(_of(task, path) for path in _files(task))


def _of(task: Task, path: Path) -> bool:
    try:
        return _read(path)[2] == _mark(task)
    except (OSError, ValueError, KeyError):
        return False


def _write(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    part = path.with_name(f".{path.name}.{os.getpid()}.part.npz")
    np.savez_compressed(part, allow_pickle=False, **arrays)
    os.replace(part, path)


def _read(path: Path) -> tuple[NDArray[np.float32], list[NDArray[np.float32]], str]:
    """Description, light of each band, and `_mark` of a press's file."""
    with np.load(path, allow_pickle=False) as file:
        bands = [file[f"traced.{number}"] for number in range(len(file.files) - 2)]
        return file["description"], bands, str(file["mark"])


def _array(path: Path, name: str) -> NDArray[np.float32]:
    with np.load(path, allow_pickle=False) as file:
        return np.asarray(file[name])


def _between(ends: tuple[float, float], share: float) -> float:
    return float(ends[0] + (ends[1] - ends[0]) * share)


def _middle(design: Design, name: str) -> float:
    room, _, field = name.partition(".")
    return float(getattr(getattr(design, room), field))


def _one_thread() -> None:
    from scenes import backend

    backend.use("cpu")
    import drjit as dr

    dr.set_thread_count(1)
