"""What a study of layouts comes to: which one to build, why, and what still limits it, in three lines."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from twin import explore_figures as figures
from twin.complaint import DesignError
from twin.design import Design, load_design
from twin.explore_results import Importance, Results, Trial
from twin.objectives import OBJECTIVES, STANDARD
from twin.report import digits

_MOST_CHANGES = 4
_CLEARLY = 0.05  # of an objective


def verdict(results: Results, mattered: Sequence[Importance] = ()) -> list[str]:
    """Return what to build, why, and what still limits it: three lines."""
    best = results.best()
    name, way = next(iter(results.objectives.items()))
    if not best:
        return [
            "No layout could be judged: see the reasons below.",
            f"{len(results.infeasible)} were tried.",
            "Widen the fields' ranges or the constraints.",
        ]
    base = results.baseline
    top = advised(results)
    now, before = top.objectives[name], base.objectives.get(name, np.nan)
    words = OBJECTIVES[name].text
    gain = before / now if way == "minimize" else now / before
    if gain > 1.01:
        first = (
            f"Build {top.name}: {words}: {digits(now)} instead of {digits(before)}, {gain:.2f} times better, "
            f"with {changes(top, base)}."
        )
        if top is not best[0]:
            first += (
                f" {best[0].name} comes to {digits(best[0].objectives[name])}, but{_lost(results, best[0])}."
            )
    elif gain >= 0.99:
        first = f"Keep the baseline: no layout is clearly better in this: {words} ({digits(before)})."
    else:
        first = (
            f"Keep the baseline: {words}: {digits(before)}; the best that was found, {top.name}, "
            f"has {digits(now)}."
        )
    return [first, _why(results, top, mattered), _still(top, base)]


def advised(results: Results) -> Trial:
    """Return the first of the winners that is clearly worse than the baseline in nothing, or the first."""
    best = results.best()
    return next((one for one in best if not _lost(results, one)), best[0])


def _lost(results: Results, trial: Trial) -> str:
    """The objectives by which a layout is clearly worse than the baseline, in words; empty where none is."""
    found = []
    for name, way in results.objectives.items():
        now, before = trial.objectives.get(name, np.nan), results.baseline.objectives.get(name, np.nan)
        worse = now - before if way == "minimize" else before - now
        if worse > _CLEARLY * abs(before):
            found.append(f" {OBJECTIVES[name].text}: {digits(now)} (baseline {digits(before)})")
    return ",".join(found)


def changes(trial: Trial, base: Trial, most: int = _MOST_CHANGES) -> str:
    """Return which values differ from the baseline's, in words."""
    found = [
        f"{name} = {in_words(value)}"
        for name, value in trial.values.items()
        if base.values.get(name) is None or base.values[name] != value
    ]
    if not found:
        return "the baseline's own values"
    text = ", ".join(found[:most])
    return text if len(found) <= most else f"{text} and {len(found) - most} more"


def _why(results: Results, top: Trial, mattered: Sequence[Importance]) -> str:
    parts = []
    if mattered:
        one = mattered[0]
        leading = sorted(one.share.items(), key=lambda item: -item[1])[:2]
        said = ", then ".join(f"{name} ({100 * share:.0f} %)" for name, share in leading)
        parts.append(f"what moves it most is {said}")
    compared = [
        f"{words} {digits(top.objectives[name])}{unit} (baseline {digits(results.baseline.objectives[name])})"
        for name, words, unit in (("snr", "tared signal over noise", ""), ("led_power_W", "LED flux", " W"))
        if name in top.objectives and name in results.baseline.objectives
    ]
    return "Why: " + "; ".join(filter(None, [*parts, ", ".join(compared)])) + "."


def _still(top: Trial, base: Trial) -> str:
    text = "What still limits it: "
    try:
        share = figures.shares(top, "modulus_kPa")
    except (OSError, KeyError, ValueError):
        share = {}
    if share:
        name, (_, halved) = max(share.items(), key=lambda item: item[1][1])
        text += f"knowing {name} twice as well would take {100 * halved:.0f} % off the bound on E"
        if name.startswith("noise"):
            text = text.replace(f"knowing {name} twice as well", "halving the pictures' noise")
    else:
        text += "not stored"
    reach, before = (one.objectives.get("detection_depth_mm") for one in (top, base))
    if reach is not None and before is not None:
        size, modulus = STANDARD
        design = design_of(top)
        slab = np.inf if design is None else design.specimen.thickness_mm
        deep = [f"{digits(one)} mm deep" if one < slab else "at any depth" for one in (reach, before)]
        if min(reach, before) < slab:
            text += f"; a lump of {size:g} mm and {modulus:g} kPa would be found {deep[0]} "
            text += f"(baseline: {deep[1]})"
    return text + "."


def design_of(trial: Trial) -> Design | None:
    """Return a layout's design, None where its file cannot be read."""
    try:
        return load_design(trial.folder / "design.toml")
    except (DesignError, OSError):
        return None


def in_words(value: Any) -> str:
    """Return a field's value as people read it."""
    return f"{value:.4g}" if isinstance(value, float) else str(value)
