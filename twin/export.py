"""A press as a file for other programs: volume results for ParaView, an input deck for CalculiX."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Literal

import fem
from twin import presses
from twin.complaint import DesignError, shown
from twin.design import Design
from twin.presses import Quality
from twin.stage import check_file, staged_file

Kind = Literal["vtu", "ccx"]

SUFFIXES: dict[str, str] = {"vtu": ".vtu", "ccx": ".inp"}


def check(
    design: Design, inclusion: fem.Inclusion | None, levels: Sequence[float], kind: Kind, name: str
) -> Path:
    """Return the absolute path of the file, or raise `DesignError` before any work is done."""
    target = check_file(name, kind, SUFFIXES[kind])
    presses.check(design, inclusion, levels)
    received = shown(list(levels))
    if kind == "vtu" and len(levels) != 1:
        raise DesignError("press.indentation_mm", received, "one depth for one .vtu file")
    if any(deeper <= depth for depth, deeper in pairwise(levels)):
        raise DesignError("press.indentation_mm", received, "depths that rise, each a step of the deck")
    bent = any(design.press.tilt_deg) or design.waveguide.dome_radius_mm is not None
    if kind == "ccx" and design.mechanics == "linear" and bent:
        raise DesignError(
            "mechanics", "'linear' with a tilt or a dome", "'finite' (a linear deck ties flat surfaces)"
        )
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
    levels : depths of the press, mm: one for ``"vtu"``, rising ones for ``"ccx"``, which solves nothing here.
    kind : ``"vtu"`` (see `fem.volume`) or ``"ccx"`` (see `fem.ccx`).
    name : path of the file, ending in ``.vtu`` or ``.inp``.
    """
    target = check(design, inclusion, levels, kind, name)
    tell = progress or (lambda stage, done: None)
    with staged_file(name, kind, SUFFIXES[kind]) as path:
        if kind == "ccx":
            from fem import ccx

            tell("file", 0.0)
            ccx.deck(
                path,
                design.probe(),
                design.slab(),
                inclusion,
                levels,
                mechanics=design.mechanics,
                quality=quality,
                tilt=design.press.tilt_deg,
                position=design.press.position_mm,
            )
        else:
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
