"""Freeze a study into a plan: draw every sample, check that it can be simulated, write it down.

`load_plan` reads one again; see `twin.planned`.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import fem
from twin import learned, presses
from twin.complaint import DesignError, shown
from twin.conflicts import black, colourless
from twin.design import Design, load_design, parse_design, shipped_designs
from twin.draws import check_bounds
from twin.fields import expand, number_at, tables_of
from twin.frame import versions
from twin.learn_light import light_of
from twin.planned import (
    EMULATOR,
    FORMAT,
    IES,
    PLAN,
    SAMPLES,
    TRACED,
    Plan,
    design_sha256,
    load_plan,
    sha256,
)
from twin.presses import Quality
from twin.sample_table import MAX_NUMBERS, write_samples
from twin.settling import Columns, Drawn, Setting, drawn
from twin.stage import has_keys, staged
from twin.study import MAX_COUNT, PARAMETERS, CorpusMechanics, Distribution, Source, load_study

if TYPE_CHECKING:
    pass

__all__ = ["Plan", "freeze", "load_plan"]

Progress = Callable[[str, float], None]


def freeze(
    study: str | Path,
    out: str | Path,
    *,
    seed: int | None = None,
    mechanics: CorpusMechanics | None = None,
    emulator: str | Path | None = None,
    traced: str | Path | None = None,
    quality: presses.Quality | None = None,
    light: presses.Quality | None = None,
    paths: int | None = None,
    count: int | None = None,
    progress: Progress | None = None,
) -> Plan:
    """Write the plan of a study, a shipped one or a file, into a new folder, and return it.

    What is None is as the study has it; ``count`` keeps the first so many samples of every group. A plan that
    nothing was run of is replaced.

    Raises
    ------
    DesignError
        In one line.
    """
    source = load_study(study)
    settings = source.study
    if count is not None and count < 1:
        raise DesignError("count", shown(count), "an integer > 0")
    if paths is not None and not 2**10 <= paths <= 2**32:
        raise DesignError("paths", shown(paths), f"an integer from {2**10} to {2**32}")
    paths = paths or settings.paths
    design = _design(source)
    try:
        colourless(design, "a corpus")
    except DesignError as error:
        raise error.renamed(source=source.name) from None
    mechanics = mechanics or settings.mechanics or design.mechanics
    file = _emulator_file(source, design, mechanics, emulator)
    light_file = learned.light_file(traced) if traced is not None else None
    if light_file is None and settings.traced is not None:
        light_file = learned.light_file(settings.traced, source.folder)
    try:
        if light_file is not None:
            black(design, "learned light")
        if mechanics != "emulator":
            design = design.pressed(mechanics="linear" if mechanics == "multipoles" else mechanics)
        lit = light or settings.light or quality or settings.quality
        if light_file is not None and paths is not None:
            raise DesignError("paths", f"{paths} with learned light", "it with light that follows paths")
        if light_file is not None and lit == "reference":
            raise DesignError(
                "traced", "it with light = 'reference'", "it with 'preview' or 'standard' light"
            )
        seed = settings.seed if seed is None else seed
        pressed = quality or settings.quality if mechanics == "multipoles" else None
        if pressed is not None:
            presses.check_expanded(design, None, pressed)
        setting = _setting(source, design, seed, file, light_file, pressed)
    except DesignError as error:
        field = re.sub(r"^press\.(indentation_mm)", r"\1", error.field)
        raise error.renamed(field, source=error.source or source.name) from None
    with staged(out, holds_plan) as folder:
        groups = []
        try:
            for number, group in enumerate(settings.samples):

                def tell(share: float, number: int = number) -> None:
                    if progress is not None:
                        progress("draws", (number + share) / len(settings.samples))

                groups.append(drawn(setting, group, source.folder, f"samples.{number}", count, tell))
            fields, columns = _joined(setting, groups)
        except DesignError as error:
            raise error.renamed(source=error.source or source.name) from None
        planned = [
            {
                "name": group.name,
                "sampler": group.sampler,
                "count": len(one.columns["blank"]),
                "redrawn": one.redrawn,
                "fields": list(one.fields),
            }
            for group, one in zip(settings.samples, groups, strict=True)
        ]
        write_samples(folder / SAMPLES, columns, fields, [group.name for group in settings.samples])
        head = {
            "format": FORMAT,
            "name": settings.name,
            "description": settings.description,
            **_carried(setting, folder, file, light_file),
            "seed": setting.seed,
            "quality": quality or settings.quality,
            "light": lit,
            "mechanics": mechanics,
            "indentation_mm": list(settings.indentation_mm),
            "light_seed": settings.light_seed,
            **({} if paths is None else {"paths": paths}),
            "randomise": {key: _said(value) for key, value in settings.randomise.items()},
            "samples": {"file": SAMPLES, "count": len(columns["sample"]), "sha256": sha256(folder / SAMPLES)},
            "groups": planned,
            "k": asdict(setting.design.signal),
            "versions": versions(),
            "study": source.text,
        }
        text = json.dumps(head, indent=1, allow_nan=False, ensure_ascii=False)
        (folder / PLAN).write_text(text + "\n", encoding="utf-8")
        load_plan(folder)  # what cannot be read is not left behind
    return load_plan(out)


def holds_plan(folder: Path) -> bool:
    """Return whether a folder holds a plan that nothing was run of, and nothing else."""
    names = {entry.name for entry in folder.iterdir()}
    rest = {name for name in names if not IES.fullmatch(name)}
    return rest <= {PLAN, SAMPLES, EMULATOR, TRACED} and has_keys(folder / PLAN, "format", "design_sha256")


def _design(source: Source) -> Design:
    name = source.study.design
    return load_design(name if name in shipped_designs() else source.folder / name)


def _emulator_file(
    source: Source, design: Design, mechanics: CorpusMechanics, given: str | Path | None
) -> Path | None:
    """Return the emulator's file, None where none is needed."""
    if mechanics != "emulator":
        if given is not None:
            raise DesignError("emulator", "it with other mechanics", "it with mechanics emulator only")
        return None
    if given is not None:
        return learned.emulator_file(given)
    if source.study.emulator is not None:
        return learned.emulator_file(source.study.emulator, source.folder)
    return learned.usual_emulator(design.name)


def _setting(
    source: Source,
    design: Design,
    seed: int,
    file: Path | None,
    traced: Path | None,
    multipoles: Quality | None,
) -> Setting:
    """Return what all samples share, checked."""
    tables = tables_of(design)
    tables["press"]["indentation_mm"] = list(source.study.indentation_mm)
    design = parse_design(tables)
    tables = tables_of(design)
    varied = tuple(expand(tables, source.study.randomise))
    for one in varied:
        check_bounds(f"randomise.{one.field}", one.distribution, one.base)
    emulator = None if file is None else presses.emulator_of(design, file)
    light = None if traced is None else light_of(traced)
    return Setting(seed, tables, design, varied, emulator, light, multipoles)


def _joined(setting: Setting, groups: Sequence[Drawn]) -> tuple[list[str], Columns]:
    """Return the fields that vary, and the columns of all groups one after the other."""
    fields = list(dict.fromkeys([*(v.field for v in setting.varied), *(f for g in groups for f in g.fields)]))
    counts = [len(group.columns["blank"]) for group in groups]
    total, most = sum(counts), min(MAX_COUNT, MAX_NUMBERS // (len(fields) + 8))
    if total > most:
        raise DesignError(
            "samples", f"{total} samples", f"at most {most} with {len(fields)} fields that vary"
        )
    columns: Columns = {
        "sample": np.arange(total),
        "group": np.repeat(np.arange(len(groups)), counts),
        "blank": np.concatenate([group.columns["blank"] for group in groups]),
    }
    for name in (*PARAMETERS, *fields):
        parts = []
        for number, (group, count) in enumerate(zip(groups, counts, strict=True)):
            if name not in group.columns:
                base = number_at(setting.tables, name, f"samples.{number}")
                if base is None:
                    allowed = f"a table with {name} in every group, or a design that sets it"
                    raise DesignError(f"samples.{number}", "nothing", allowed)
                parts.append(np.full(count, float(base)))
            else:
                parts.append(group.columns[name])
        columns[name] = np.concatenate(parts)
    return fields, columns


def _carried(setting: Setting, folder: Path, file: Path | None, traced: Path | None) -> dict[str, Any]:
    """Copy the emulator and luminaire files into the corpus, and return what plan.json says of them."""
    design, ies = {**setting.tables, "leds": [dict(led) for led in setting.tables["leds"]]}, {}
    for number, led in enumerate(design["leds"]):
        if led["ies"] is not None:
            name = f"leds.{number}.ies"
            shutil.copyfile(led["ies"], folder / name)
            led["ies"], ies[name] = name, sha256(folder / name)
    emulator = None
    if file is not None:
        shutil.copyfile(file, folder / EMULATOR)
        emulator = {"file": EMULATOR, "sha256": sha256(folder / EMULATOR)}
        fem.load_emulator(folder / EMULATOR)
    light = None
    if traced is not None:
        shutil.copyfile(traced, folder / TRACED)
        light = {"file": TRACED, "sha256": sha256(folder / TRACED)}
    return {
        "design": design,
        "design_sha256": design_sha256(design),
        "emulator": emulator,
        "ies": ies,
        "traced": light,
    }


def _said(distribution: Distribution) -> dict[str, Any]:
    """Return what a study says of a distribution."""
    return {
        name: list(value) if isinstance(value, tuple) else value
        for name, value in asdict(distribution).items()
        if value is not None and value is not False
    }
