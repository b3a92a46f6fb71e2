"""A press as a file for other programs: volume results for ParaView."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import fem
from twin import presses
from twin.complaint import DesignError, shown
from twin.design import Design
from twin.presses import Quality
from twin.stage import check_file, staged_file

Kind = Literal["vtu"]

SUFFIXES: dict[str, str] = {"vtu": ".vtu"}


def check(
    design: Design, inclusion: fem.Inclusion | None, levels: Sequence[float], kind: Kind, name: str
) -> Path:
    """Return the absolute path of the file, or raise `DesignError` before any work is done."""
    target = check_file(name, kind, SUFFIXES[kind])
    presses.check(design, inclusion, levels)
    if kind == "vtu" and len(levels) != 1:
        raise DesignError("press.indentation_mm", shown(list(levels)), "one depth for one .vtu file")
    return target


def export(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    kind: Kind,
    name: str,
    *,
    quality: Quality = "standard",
    progress: Callable[[str, float], None] | None = None,
) -> Path:
    """Press, and write the file whole or not at all.

    Parameters
    ----------
    levels : depth of the press, mm: one for ``"vtu"``.
    kind : ``"vtu"`` (see `fem.volume`).
    name : path of the file, ending in ``.vtu``.
    """
    target = check(design, inclusion, levels, kind, name)
    tell = progress or (lambda stage, done: None)
    with staged_file(name, kind, SUFFIXES[kind]) as path:
        (press,) = presses.solved(
            design,
            inclusion,
            levels,
            quality=quality,
            estimate=False,
            progress=lambda stage, share: tell("mechanics", 0.9 * share),
        )
        tell("file", 0.9)
        fem.save_volume(press.volume(), path)
    tell("file", 1.0)
    return target
