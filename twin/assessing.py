"""`twin assess`: how well a model tells inclusions of a corpus that it has not seen, by network and rendered.

Every sample is answered as `twin estimate` would, once from its stored pictures and once from means of many
exposures, and each answer is kept in OUT/samples: the same command goes on. A corpus of full solves or of
another light tells what a mismatch of the model costs.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fem
from scenes.sensor import NotModelled
from twin import ablation, assessing_report
from twin.assess import FRAMES, averaged, stored, summed_up
from twin.assessment import METHODS, SHORT, answered, record_of
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.estimates import NAMES
from twin.estimator import Estimator
from twin.estimator_file import load_estimator, without_luminaires
from twin.fields import PRESS, flat, number_at, tables_of
from twin.imagined import check_fields
from twin.pooled import each
from twin.report import write_json
from twin.stage import usable
from twin.train import TEST, check_camera, level_names

SAMPLES, RECORD, PICTURE = "samples", assessing_report.ASSESSMENT, assessing_report.ASSESSED
KEPT = "curve.parts"
"""What a folder with a learning curve holds."""
_DRAWS = 4000
_OPEN = ("name", "description", "mechanics", "press.indentation_mm", "signal.")
"""Of a design, what may differ from the model's."""


@dataclass(frozen=True)
class Sample:
    """A sample of a corpus for a model, as a worker process takes it, and where what comes of it goes."""

    model: str
    corpus: str
    number: int
    place: Path


@dataclass(frozen=True)
class Task(Sample):
    """One to answer."""

    rendered: bool
    seed: int
    exposures: tuple[int, ...] = FRAMES
    as_trained: bool = False


def assess(
    model: str | Path,
    corpus: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    single: int | None = None,
    averaged: int | None = None,
    rendered: bool = True,
    as_trained: bool = False,
    workers: int | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> dict[str, Any]:
    """Answer samples of a corpus, write `RECORD`, `PICTURE` and a page into a folder, and return the record.

    Parameters
    ----------
    samples : how many at most; of the group "test" where there is one.
    single, averaged : of how many of these, the first, single exposures and means of many are answered; all
        by default. Where both are, fits to means begin where those to single exposures end.
    rendered : whether answers are refined by rendering, too: a minute or two a sample.
    as_trained : whether a calibrated model is taken as it was before `twin calibrate`: that is right for
        pictures of its own chain.

    Raises
    ------
    DesignError
        In one line.
    """
    if single == 0 and averaged == 0:
        raise DesignError("--single, --averaged", "0, 0", "one of them above 0")
    source, estimator = Corpus(corpus), load_estimator(model)
    levels_of(source, estimator)
    numbers = [int(n) for n in source.samples if source.plan.group(int(n)) == TEST]
    numbers = (numbers or [int(n) for n in source.samples])[:samples]
    folder = Path(out)
    told = {
        "model": estimator.card["sha256"],
        "corpus": source.plan.digest,
        "seed": seed,
        "format": 2,
        **({"as_trained": True} if as_trained else {}),
    }
    _claim(folder, told)
    tasks = []
    for place, number in enumerate(numbers):
        if exposures := asked(place, single, averaged):
            kept = folder / SAMPLES / f"{number:06d}.json"
            parts = (str(model), str(corpus), number, kept, rendered, seed)
            tasks.append(Task(*parts, exposures, as_trained))
    left = [task for task in tasks if not _done(task)]

    def share(count: int) -> None:
        progress("samples", 1.0 - (len(left) - count) / max(len(tasks), 1))

    share(0)
    each(answer, left, workers or os.cpu_count() or 1, one_thread, share)
    rows = [json.loads(task.place.read_bytes()) for task in tasks]
    record = {**told, "corpus_name": source.name, **record_of(rows, estimator.prior.ranges, rendered)}
    from twin.assessing_figure import draw

    write_json(folder / RECORD, record)
    tissue_kPa = estimator.chain.design.specimen.modulus_kPa
    drawn = {frames: answered(rows, frames, METHODS[rendered]) for frames in FRAMES if str(frames) in record}
    draw(drawn, estimator.prior.ranges, tissue_kPa, folder / PICTURE)
    assessing_report.write(folder)
    return record


def asked(place: int, single: int | None, averaged: int | None) -> tuple[int, ...]:
    """Return how many exposures a sample is answered from, each; of so many samples at most; None for all."""
    limits = zip(FRAMES, (single, averaged), strict=True)
    return tuple(frames for frames, most in limits if most is None or place < most)


def levels_of(source: Corpus, estimator: Estimator) -> list[int]:
    """Numbers of the corpus's press levels that the model wants; raises `DesignError` for other sensors, and
    for pictures that are means of exposures."""
    check_camera(source)
    design, card = source.design, estimator.card
    names = ("pixels", "LEDs")
    given = (list(source.shape), len(design.leds))
    wanted = (card["shape"], len(estimator.chain.design.leds))
    for name, one, other in zip(names, given, wanted, strict=True):
        if one != other:
            raise DesignError(name, shown(one), f"{other}, as the model was trained for", source=source.name)
    there, depths = list(source.plan.indentation_mm), card["indentation_mm"]
    if not set(depths) <= set(there):
        allowed = f"levels {depths}, as the model was trained for"
        raise DesignError("indentation_mm", shown(there), allowed, source=source.name)
    _same_sensor(source, estimator)
    check_fields(source.plan)
    return [there.index(depth) for depth in depths]


def values_of(source: Corpus, estimator: Estimator, number: int, levels: list[int]) -> dict[str, float]:
    """Values of a sample by name, as the corpus's design has them where only the model varies them."""
    plan = source.plan
    tables = tables_of(plan.base)
    found = {n: number_at(tables, n, n) for n in estimator.prior.names if not n.startswith(PRESS)}
    found |= {f"{PRESS}.{level}": depth for level, depth in enumerate(plan.indentation_mm)}
    found |= plan.parameters(number)
    return level_names({name: value for name, value in found.items() if value is not None}, levels)


def _same_sensor(source: Corpus, estimator: Estimator) -> None:
    """Refuse a sensor that differs from the model's in more than the model knows to vary."""
    own, other = (
        flat(without_luminaires(tables)) for tables in (estimator.card["design"], tables_of(source.design))
    )
    varied = set(estimator.prior.names)
    for field in sorted(set(own) | set(other)):
        if field.startswith(_OPEN) or field in varied or own.get(field) == other.get(field):
            continue
        allowed = f"{shown(own.get(field))}, as the model's sensor has"
        raise DesignError(field, shown(other.get(field)), allowed, source=source.name)


def free(folder: Path) -> bool:
    """Whether a folder is empty, or holds what `twin assess` made: estimates or a learning curve."""
    if not folder.exists() or not any(folder.iterdir()):
        return True
    return any((folder / name).is_file() for name in (f"{SAMPLES}/head.json", KEPT))


def _claim(folder: Path, told: Mapping[str, Any]) -> None:
    """Make the folder, or go on with one that was made for the same model, corpus and seed."""
    head = folder / SAMPLES / "head.json"
    with usable("--out", folder):
        if head.is_file():
            try:
                same = json.loads(head.read_bytes()) == told
            except ValueError:  # cut off, or no text at all
                same = False
            if not same:
                allowed = "a new folder, or that of the same model, corpus, seed and version"
                raise DesignError("--out", shown(str(folder)), allowed)
            return
        if not free(folder):
            raise DesignError("--out", shown(str(folder)), "a new or empty folder")
        head.parent.mkdir(parents=True, exist_ok=True)
        write_json(head, told)


def _done(task: Task) -> bool:
    row = _begun(task)
    return all(str(frames) in row for frames in task.exposures)


def _begun(task: Task) -> dict[str, Any]:
    """What an earlier run has kept of a sample; nothing where it was answered with less than is asked for."""
    row: dict[str, Any] = json.loads(task.place.read_bytes()) if task.place.is_file() else {}
    if task.rendered and not row.get("rendered"):
        return {}
    for frames in row.pop("quick", ()) if task.rendered else ():  # beside answers by rendering, but not by it
        row.pop(frames, None)
    return row


@lru_cache(maxsize=1)
def loaded(model: str, as_trained: bool = False) -> Estimator:
    """Return a model, loaded once in a worker process, with its calibration or without."""
    found = load_estimator(model)
    return replace(found, calibration=None) if as_trained else found


@lru_cache(maxsize=1)
def opened(corpus: str) -> Corpus:
    """Return a corpus, opened once in a worker process."""
    return Corpus(corpus)


def answer(task: Task) -> None:
    """Answer one sample and write its record; runs in a worker process."""
    estimator, source = loaded(task.model, task.as_trained), opened(task.corpus)
    plan = source.plan
    levels = levels_of(source, estimator)
    values = values_of(source, estimator, task.number, levels)
    blank = plan.inclusion(task.number) is None
    row = _begun(task) or {
        "sample": task.number,
        "blank": blank,
        "truth": None if blank else [values[name] for name in NAMES],
        "rendered": task.rendered,
    }
    if not blank and "parts" not in row:
        with suppress(fem.NotModelled):
            parts = ablation.bounds(estimator.chain, estimator.prior, values)
            row["parts"] = {name: sd.tolist() for name, sd in parts.items()}
    begin, start, more = None, None, None
    for frames in (count for count in task.exposures if str(count) not in row):
        if frames == 1:
            seen = stored(estimator, source, task.number, levels)
        else:
            seen = averaged(estimator, source, task.number, levels, frames, task.seed)
        told = estimator.features(seen[None])
        drawn = estimator.unscaled(estimator.network.sample(told, frames, _DRAWS, task.seed)[0])
        found: dict[str, Any] = {"presence": estimator.presence(seen, frames, drawn.mean(axis=0))}
        row[str(frames)] = found
        if row["rendered"] and not task.rendered:
            row.setdefault("quick", []).append(str(frames))
        if blank:
            continue
        truth, rendered = np.array([row["truth"]]), task.rendered and bool(estimator.traced)
        found["network"] = found["rendered"] = _short(drawn, truth)
        try:
            if more is None:
                more = estimator.more_along_valley(values, threads=1) if rendered else 0.0
            least, found["deflection"] = estimator.limits(values, frames, more)
            found["bound"] = np.sqrt(np.diag(least)[: len(NAMES)]).tolist()
        except (fem.NotModelled, NotModelled):
            found["bound"] = found["deflection"] = None
        if rendered:
            begins = drawn.mean(axis=0) if start is None else start
            refined = estimator.refined(
                seen, frames, begins, samples=_DRAWS, seed=task.seed, begin=begin, threads=1
            )
            if refined is not None:
                start = refined.fitted.x[: drawn.shape[1]]
                begin = refined if refined.renders else None
                found["misfit"] = refined.fitted.chi_square / len(estimator.sight.features.spread)
                found["renders"], found["explains"] = refined.renders, refined.explains
            if refined is not None and refined.explains:
                found["rendered"] = _short(refined.samples, truth)
            elif estimator.calibration is not None:
                fitted = estimator.fitted(seen, frames, drawn.mean(axis=0))
                found["rendered"] = _short(estimator.normal(fitted, _DRAWS, task.seed), truth)
    part = task.place.with_name(f".{task.place.name}.{os.getpid()}.part")
    write_json(part, row)
    os.replace(part, task.place)


def _short(drawn: NDArray[np.float64], truth: NDArray[np.float64]) -> dict[str, list[float]]:
    one = summed_up(drawn[None, :, : len(NAMES)], truth)
    return {name: getattr(one, name)[0].tolist() for name in SHORT}


def one_thread() -> None:
    """Keep a worker process to one core."""
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)
