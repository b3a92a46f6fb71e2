"""The mapping on a terminal: a short table, and the verdict."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from twin.mapping_verdict import state_of
from twin.report import digits

if TYPE_CHECKING:
    from twin.mapping_report import One


def told(found: Sequence[One]) -> str:
    """Return the lines of the level that is shown, and three lines of verdict, for each corpus."""
    head = [
        "corpus",
        "press",
        "scalar",
        "n",
        "unseen",
        "slope",
        "R²",
        "LOO %",
        "parabola %",
        "monotone %",
        "line",
    ]
    rows = []
    for each in found:
        for one in each.shown():
            row = one.row()
            rows.append(
                [
                    each.label,
                    f"{one.level_mm:g} mm",
                    f"{one.pair.name}, {one.kind}",
                    str(len(one.x)),
                    str(one.unseen),
                    "—"
                    if one.fit is None
                    else f"{digits(row['slope'])} {one.pair.picture_unit}/{one.pair.surface_unit}",
                    digits(row["r2"]),
                    *(
                        digits(row[f"left_out_{name}_percent"], 2)
                        for name in ("linear", "quadratic", "monotone")
                    ),
                    state_of(one),
                ]
            )
    widths = [max(len(line[i]) for line in [head, *rows]) for i in range(len(head))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in [head, *rows]
    ]
    for each in found:
        lines += ["", *([f"{each.label}:"] if len(found) > 1 else []), *each.lines]
    return "\n".join(lines)
