"""What an assessment says: figures over all samples that were answered, in JSON and in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.detection import ideal_auc
from twin.assess import FRAMES, LEAST_MM, Answers, figures, found_or_not
from twin.estimates import NAMES

METHODS = ("network", "rendered")
SHORT = ("mean", "sd", "low", "high", "rank")
"""Fields of `Answers`, as a sample's record holds them."""
SIZES = ((2.0, 3.0), (3.0, 4.0), (4.0, 8.0), (8.0, np.inf))
DEPTHS = ((0.0, 8.0), (8.0, np.inf))
"""Sizes and depths, mm, by which presence is told."""


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


def answered(rows: list[dict[str, Any]], frames: int, method: str) -> Answered:
    """Return the answers to all inclusions that such means were answered of, from their records."""
    there = [row for row in rows if not row["blank"] and str(frames) in row]
    parts = [row[str(frames)] for row in there]
    short = {name: np.array([part[method][name] for part in parts]).reshape(-1, 3) for name in SHORT}
    limits = [part["bound"] or [np.nan] * len(NAMES) for part in parts]
    return Answered(
        np.array([row["sample"] for row in there], np.int64),
        np.array([row["truth"] for row in there]).reshape(-1, 3),
        np.array(limits).reshape(-1, 3),
        Answers(**short),
    )


def record_of(rows: list[dict[str, Any]], ranges: NDArray[np.float64], rendered: bool) -> dict[str, Any]:
    """Return the figures of all samples' records; ``ranges`` (5, 2) of the parameters."""
    blanks = sum(row["blank"] for row in rows)
    found: dict[str, Any] = {"inclusions": len(rows) - blanks, "blanks": blanks}
    every = rows
    for frames in FRAMES:
        rows = [row for row in every if str(frames) in row]
        if not rows:
            continue
        blank = np.array([row["blank"] for row in rows])
        part: dict[str, Any] = {"inclusions": int((~blank).sum()), "blanks": int(blank.sum())}
        for method in METHODS[: 1 + rendered]:
            one = answered(rows, frames, method)
            part[method] = figures(one.answers, one.truth, one.limits, ranges)
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
    seen = [row["parts"] for row in every if "parts" in row and row["truth"][0] >= LEAST_MM]
    names = seen[0] if seen else ()
    found["bound_by_part"] = {
        name: dict(zip(NAMES, np.sqrt(np.mean([np.square(one[name]) for one in seen], axis=0)), strict=True))
        for name in names
    }
    return found


def _beside_ideal(
    presence: NDArray[np.float64],
    blank: NDArray[np.bool_],
    truth: NDArray[np.float64],
    deflection: NDArray[np.float64],
) -> list[dict[str, Any]]:
    """Areas under the curve of the model and of an ideal observer, by size and depth."""
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


def words(record: Mapping[str, Any]) -> str:
    """Return what a person wants to know of an assessment, several lines."""
    lines = [f"{record['inclusions']} inclusions, {record['blanks']} blanks of {record['corpus_name']}"]
    for frames in FRAMES:
        if str(frames) not in record:
            continue
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
                size, depth = (span(*cell[name]) for name in ("size_mm", "depth_mm"))
                lines.append(
                    f"        {cell['inclusions']:>3} of {size}, {depth} deep: {cell['area']:.3f}, "
                    f"ideal observer {cell['ideal']:.3f}"
                )
    if record["bound_by_part"]:
        lines.append(f"bounds d, h / mm, E / kPa from {LEAST_MM:g} mm on, by what is looked at:")
    for name, sd in record["bound_by_part"].items():
        lines.append(f"  {name:<36}" + "".join(f"{sd[key]:8.3g}" for key in NAMES))
    return "\n".join(lines)


def span(low: float, high: float | None) -> str:
    """Say from where to where; files have no infinity but None."""
    return f"{low:g} mm and more" if high is None or high == np.inf else f"{low:g} to {high:g} mm"
