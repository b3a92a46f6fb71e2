"""What an exploration found, in a line for each objective."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from twin import explored
from twin.explore import BASELINE, TRIALS, Exploration


def findings(exploration: Exploration) -> list[str]:
    """Return the best layout by each objective beside the study's own, a line each."""
    base = explored.read(exploration.folder / BASELINE)
    lines = []
    for name, direction in exploration.study.objectives.items():
        found = best(exploration, name, direction)
        if found is None or base is None:
            continue
        values = ", ".join(
            f"{k} = {v:.4g}" if isinstance(v, float) else f"{k} = {v}" for k, v in found["values"].items()
        )
        lines.append(
            f"{name}: {found['objectives'][name]:.4g} at layout {found['number']} ({values}); "
            f"the base has {base['objectives'][name]:.4g}"
        )
    return lines


def best(exploration: Exploration, objective: str, direction: str = "minimize") -> dict[str, Any] | None:
    """Return the record of the best layout that meets the constraints, None where none does."""
    rows = [explored.read(folder) for folder in sorted((exploration.folder / TRIALS).iterdir())]
    met = [row for row in rows if row and row["state"] == "complete" and _meets(exploration, row)]
    of = min if direction == "minimize" else max
    return of(met, key=lambda row: row["objectives"][objective]) if met else None


def _meets(exploration: Exploration, row: Mapping[str, Any]) -> bool:
    return all(limit.excess(row["objectives"][limit.name]) <= 0 for limit in exploration.limits)
