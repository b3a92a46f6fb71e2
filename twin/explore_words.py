"""What an exploration found, in a line for each objective."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twin import explored
from twin.explore import BASELINE, TRIALS, Exploration


def findings(exploration: Exploration) -> list[str]:
    """Return the best layout by each objective beside the study's own, a line each."""
    rows = [explored.read(folder) for folder in sorted((exploration.folder / TRIALS).iterdir())]
    met = [row for row in rows if row and row["state"] == "complete" and _meets(exploration, row)]
    base = explored.read(exploration.folder / BASELINE)
    lines = []
    for name, direction in exploration.study.objectives.items():
        if not met or base is None:
            continue
        best = (min if direction == "minimize" else max)(met, key=lambda row: row["objectives"][name])
        values = ", ".join(
            f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in best["values"].items()
        )
        lines.append(
            f"{name}: {best['objectives'][name]:.4g} at layout {best['number']} ({values}); "
            f"the base has {base['objectives'][name]:.4g}"
        )
    return lines


def _meets(exploration: Exploration, row: Mapping[str, Any]) -> bool:
    return all(limit.excess(row["objectives"][limit.name]) <= 0 for limit in exploration.limits)
