"""What an exploration found, in a line for each objective."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from twin import explored, layout_fields, touches
from twin.explore import BASELINE, TRIALS, Exploration
from twin.forward import step_of


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
    followed = _followed(exploration) if exploration.emulator is None else []
    if followed:
        which = ", ".join(map(str, followed))
        lines.append(
            f"inclusions {which}: pressed on meshes that follow them, whose ripples pass for knowledge: "
            "their bounds are too low by a third and more (EXPLORE.md says what multipoles press)"
        )
    return lines


def _followed(exploration: Exploration) -> list[int]:
    """Numbers of the study's inclusions, from 0, that the study's own layout presses so, from any place."""
    study, design = exploration.study, exploration.design
    base = layout_fields.base(study, design)
    moving = [unknown for unknown in study.unknown() if touches.touches_contact(unknown.name)]
    found = []
    for number, ball in enumerate(study.balls()):
        steps = {u.name: step_of(u, touches.value_of(base.design, ball, u.name)) for u in moving}
        places = [(ball.offset[0] - x, ball.offset[1] - y) for x, y in base.protocol.positions_mm]
        if not all(touches.mesh_stays(base.design, replace(ball, offset=place), steps) for place in places):
            found.append(number)
    return found


def best(exploration: Exploration, objective: str, direction: str = "minimize") -> dict[str, Any] | None:
    """Return the record of the best layout that meets the constraints, None where none does."""
    rows = [explored.read(folder) for folder in sorted((exploration.folder / TRIALS).iterdir())]
    met = [row for row in rows if row and row["state"] == "complete" and _meets(exploration, row)]
    of = min if direction == "minimize" else max
    return of(met, key=lambda row: row["objectives"][objective]) if met else None


def _meets(exploration: Exploration, row: Mapping[str, Any]) -> bool:
    return all(limit.excess(row["objectives"][limit.name]) <= 0 for limit in exploration.limits)
