"""`twin assess`: how well a model tells inclusions of a corpus that it has not seen, by network and rendered.

Every sample is answered as `twin estimate` would, once from its stored pictures and once from means of many
exposures, and each answer is kept in OUT/samples: the same command goes on. A corpus of full solves or of
another light tells what a mismatch of the model costs.
"""

from __future__ import annotations

import json
import multiprocessing
import os
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.detection import ideal_auc
from twin.assess import FRAMES, Answers, averaged, figures, found_or_not, stored, summed_up
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.estimates import NAMES
from twin.estimator import Estimator, load_estimator
from twin.report import write_json
from twin.train import TEST, level_names

SAMPLES, RECORD, PICTURE = "samples", "assessment.json", "assessment.png"
METHODS = ("network", "rendered")
_ALL = 1e3
SIZES = ((2.0, 3.0), (3.0, 4.0), (4.0, 8.0), (8.0, np.inf))
DEPTHS = ((0.0, 8.0), (8.0, np.inf))
"""Sizes and depths, mm, by which presence is told."""
_DRAWS = 4000
_NUMBERS = ("mean", "sd", "low", "high", "rank")


@dataclass(frozen=True)
class Task:
    """One sample to answer, as a worker process takes it."""

    model: str
    corpus: str
    sample: int
    place: Path
    rendered: bool
    seed: int


@dataclass(frozen=True)
class Answered:
    """Answers to all inclusions of a corpus by one method from means of so many exposures.

    Attributes
    ----------
    numbers : (n,) of the samples.
    truth, limits : (n, 3), limits are standard deviations of the bound.
    """

    numbers: NDArray[np.int64]
    truth: NDArray[np.float64]
    limits: NDArray[np.float64]
    answers: Answers


def assess(
    model: str | Path,
    corpus: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    rendered: bool = True,
    workers: int | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> dict[str, Any]:
    """Answer samples of a corpus, write `RECORD` and `PICTURE` into a folder, and return the record.

    Parameters
    ----------
    samples : how many at most; of the group "test" where there is one.
    rendered : whether answers are refined by rendering, too: half a minute a sample.

    Raises
    ------
    DesignError
        In one line.
    """
    source, estimator = Corpus(corpus), load_estimator(model)
    _levels(source, estimator)
    numbers = [int(n) for n in source.samples if source.plan.group(int(n)) == TEST]
    numbers = (numbers or [int(n) for n in source.samples])[:samples]
    folder = Path(out)
    told = {
        "model": estimator.card["sha256"],
        "corpus": source.plan.head.samples.sha256,
        "seed": seed,
        "format": 1,
    }
    _claim(folder, told)
    tasks = [
        Task(str(model), str(corpus), number, folder / SAMPLES / f"{number:06d}.json", rendered, seed)
        for number in numbers
    ]
    left = [task for task in tasks if not _done(task)]
    progress("samples", 1.0 - len(left) / max(len(tasks), 1))
    pool = ProcessPoolExecutor(workers or os.cpu_count(), multiprocessing.get_context("spawn"), _one_thread)
    with pool:
        try:
            for count, one in enumerate(as_completed([pool.submit(answer, task) for task in left]), start=1):
                one.result()
                progress("samples", 1.0 - (len(left) - count) / len(tasks))
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    rows = [json.loads(task.place.read_bytes()) for task in tasks]
    record = {**told, "corpus_name": source.name, **_record(rows, estimator, rendered)}
    from twin.assessing_figure import draw

    write_json(folder / RECORD, record)
    tissue_kPa = estimator.chain.design.specimen.modulus_kPa
    drawn = {frames: answered(rows, frames, METHODS[rendered]) for frames in FRAMES}
    draw(drawn, estimator.prior.ranges, tissue_kPa, folder / PICTURE)
    return record


def _levels(source: Corpus, estimator: Estimator) -> list[int]:
    """Numbers of the corpus's press levels that the model wants; raises `DesignError` for other sensors."""
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
    return [there.index(depth) for depth in depths]


def _claim(folder: Path, told: Mapping[str, Any]) -> None:
    """Make the folder, or go on with one that was made for the same model, corpus and seed."""
    head = folder / SAMPLES / "head.json"
    if head.is_file():
        if json.loads(head.read_bytes()) != told:
            allowed = "a new folder, or that of the same model, corpus and seed"
            raise DesignError("--out", shown(str(folder)), allowed)
        return
    if folder.exists() and any(folder.iterdir()):
        raise DesignError("--out", shown(str(folder)), "a new or empty folder")
    head.parent.mkdir(parents=True, exist_ok=True)
    write_json(head, told)


def _done(task: Task) -> bool:
    if not task.place.is_file():
        return False
    row = json.loads(task.place.read_bytes())
    return row["rendered"] or not task.rendered


@lru_cache(maxsize=1)
def _loaded(model: str) -> Estimator:
    return load_estimator(model)


@lru_cache(maxsize=1)
def _opened(corpus: str) -> Corpus:
    return Corpus(corpus)


def answer(task: Task) -> None:
    """Answer one sample and write its record; runs in a worker process."""
    estimator, source = _loaded(task.model), _opened(task.corpus)
    plan = source.plan
    levels = _levels(source, estimator)
    values = level_names({k: v for k, v in plan.parameters(task.sample).items() if v is not None}, levels)
    blank = plan.inclusion(task.sample) is None
    row: dict[str, Any] = {
        "sample": task.sample,
        "blank": blank,
        "truth": None if blank else [values[name] for name in NAMES],
        "rendered": task.rendered,
    }
    off = None
    for frames in FRAMES:
        if frames == 1:
            seen = stored(estimator, source, task.sample, levels)
        else:
            seen = averaged(estimator, source, task.sample, levels, frames, task.seed)
        told = estimator.features(seen[None])
        found: dict[str, Any] = {"presence": float(estimator.network.present(told, frames)[0])}
        row[str(frames)] = found
        if blank:
            continue
        truth = np.array([row["truth"]])
        drawn = estimator.unscaled(estimator.network.sample(told, frames, _DRAWS, task.seed)[0])
        found["network"] = found["rendered"] = _short(drawn, truth)
        try:
            least, found["deflection"] = estimator.limits(values, frames)
            found["bound"] = np.sqrt(np.diag(least)[: len(NAMES)]).tolist()
        except fem.NotModelled:
            found["bound"] = found["deflection"] = None
        if task.rendered and estimator.traced:
            refined = estimator.refined(
                told[0], frames, drawn.mean(axis=0), samples=_DRAWS, seed=task.seed, begin=off, threads=1
            )
            if refined is not None:
                off = refined.off
                found["misfit"] = refined.fitted.chi_square / len(estimator.features.spread)
                found["renders"], found["explains"] = refined.renders, refined.explains
                if refined.explains:
                    found["rendered"] = _short(refined.samples, truth)
    part = task.place.with_name(f".{task.place.name}.{os.getpid()}.part")
    write_json(part, row)
    os.replace(part, task.place)


def _short(drawn: NDArray[np.float64], truth: NDArray[np.float64]) -> dict[str, list[float]]:
    one = summed_up(drawn[None, :, : len(NAMES)], truth)
    return {name: getattr(one, name)[0].tolist() for name in _NUMBERS}


def answered(rows: list[dict[str, Any]], frames: int, method: str) -> Answered:
    """Return all inclusions' answers from their records."""
    there = [row for row in rows if not row["blank"]]
    parts = [row[str(frames)] for row in there]
    short = {name: np.array([part[method][name] for part in parts]).reshape(-1, 3) for name in _NUMBERS}
    limits = [part["bound"] or [np.nan] * len(NAMES) for part in parts]
    return Answered(
        np.array([row["sample"] for row in there], np.int64),
        np.array([row["truth"] for row in there]).reshape(-1, 3),
        np.array(limits).reshape(-1, 3),
        Answers(**short),
    )


def _record(rows: list[dict[str, Any]], estimator: Estimator, rendered: bool) -> dict[str, Any]:
    blank = np.array([row["blank"] for row in rows])
    found: dict[str, Any] = {"inclusions": int((~blank).sum()), "blanks": int(blank.sum())}
    for frames in FRAMES:
        part: dict[str, Any] = {}
        for method in METHODS[: 1 + rendered]:
            one = answered(rows, frames, method)
            part[method] = figures(one.answers, one.truth, one.limits, estimator.prior.ranges)
        presence = np.array([row[str(frames)]["presence"] for row in rows])
        truth = np.array([row["truth"] for row in rows if not row["blank"]]).reshape(-1, 3)
        part["presence"] = found_or_not(presence, blank, truth)
        ideal = np.array([row[str(frames)]["deflection"] or np.nan for row in rows if not row["blank"]])
        if part["presence"]:
            part["presence"]["beside_ideal"] = _beside_ideal(presence, blank, truth, ideal)
        if rendered:
            tried = [row[str(frames)] for row in rows if not row["blank"]]
            part["explained_by_rendering"] = float(np.mean([one.get("explains", False) for one in tried]))
            part["renders"] = float(np.mean([one.get("renders", 0) for one in tried]))
        found[str(frames)] = part
    return found


def _beside_ideal(
    presence: NDArray[np.float64],
    blank: NDArray[np.bool_],
    truth: NDArray[np.float64],
    deflection: NDArray[np.float64],
) -> list[dict[str, Any]]:
    """Areas under the curve of the network and of an ideal observer, by size and depth."""
    empty, full = presence[blank], presence[~blank]
    if not len(empty):
        return []
    area = (full[:, None] > empty).mean(axis=1) + 0.5 * (full[:, None] == empty).mean(axis=1)
    ideal = ideal_auc(deflection)
    found = []
    for low, high in SIZES:
        for shallow, deep in DEPTHS:
            size, depth = truth[:, 0], truth[:, 1]
            rows = (size >= low) & (size < high) & (depth >= shallow) & (depth < deep)
            if rows.any():
                found.append(
                    {
                        "size_mm": [low, high],
                        "depth_mm": [shallow, deep],
                        "inclusions": int(rows.sum()),
                        "area": float(area[rows].mean()),
                        "ideal": float(np.nanmean(ideal[rows])),
                    }
                )
    return found


def words(record: Mapping[str, Any], out: str) -> str:
    """Return what a person wants to know of an assessment, several lines."""
    lines = [f"{record['inclusions']} inclusions, {record['blanks']} blanks of {record['corpus_name']}"]
    for frames in FRAMES:
        for method in METHODS:
            one = record[str(frames)].get(method)
            for size in ("4 mm and more", "8 mm and more"):
                part = one and one.get(size)
                if not part:
                    continue
                told = ", ".join(
                    f"{short} {part['rmse'][key]:.3g} ({part['over_bound'][key]:.2f} x bound)"
                    for short, key in zip(("d", "h", "E"), NAMES, strict=True)
                )
                lines.append(
                    f"{frames:>3} exposure{'s' if frames > 1 else ' '} {method:<8} {part['samples']:>3} of "
                    f"{size}: RMSE {told}; E explained {100 * part['explained'][NAMES[2]]:.0f} %"
                )
            if one:
                covered = ", ".join(f"{100 * value:.0f} %" for value in one["covered_90"].values())
                ranks = ", ".join(f"{value:.2g}" for value in one["rank_p"].values())
                lines.append(f"      90 % intervals cover {covered}; ranks p {ranks}")
        presence = record[str(frames)]["presence"]
        if presence.get("beside_ideal"):
            lines.append(
                f"      inclusion or none: area under the curve {presence['area']:.4f}; by size and depth:"
            )
            for cell in presence["beside_ideal"]:
                size, depth = (_span(*cell[name]) for name in ("size_mm", "depth_mm"))
                lines.append(
                    f"        {cell['inclusions']:>3} of {size}, {depth} deep: {cell['area']:.3f}, "
                    f"ideal observer {cell['ideal']:.3f}"
                )
    return "\n".join([*lines, f"look at: {Path(out) / PICTURE}"])


def _span(low: float, high: float) -> str:
    return f"{low:g} mm and more" if high > _ALL else f"{low:g} to {high:g} mm"


def _one_thread() -> None:
    import torch
    from threadpoolctl import threadpool_limits

    torch.set_num_threads(1)
    threadpool_limits(1)
