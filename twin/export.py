"""A press as files for other programs: volume results for ParaView, input decks for CalculiX."""

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
from twin.stage import begins, check_file, staged, staged_file

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


README = """\
A press of the twin as input decks of CalculiX (https://www.calculix.de, 2.20 or newer). Units: mm, mN, kPa.

  ccx -i with         with the inclusion
  ccx -i without      the same mesh, with tissue in its place

Each writes NAME.dat: after every step the displacements of the probe's contact nodes (mm; in the probe's
frame, +z into the specimen) and the force on the chest wall (mN, of the part that is meshed). The tared
displacement is that of "without" minus that of "with". Levels, mm: {levels}; {steps}
"""
_DECKS = ("with.inp", "without.inp")
_LINEAR = "one step each."
_FINITE = (
    "each takes {n} steps: the press, then {m} of the same\n"
    "travel, for the contact to settle. Where those still differ, take the mean of the last two."
)


def check_decks(design: Design, inclusion: fem.Inclusion | None, levels: Sequence[float]) -> None:
    """Raise `DesignError` before any work is done if this press cannot be a deck."""
    presses.check(design, inclusion, levels)
    if any(deeper <= depth for depth, deeper in pairwise(levels)):
        raise DesignError(
            "press.indentation_mm", shown(list(levels)), "depths that rise, each a step of the deck"
        )
    bent = any(design.press.tilt_deg) or design.waveguide.dome_radius_mm is not None
    if design.mechanics == "linear" and bent:
        raise DesignError(
            "mechanics", "'linear' with a tilt or a dome", "'finite' (a linear deck ties flat surfaces)"
        )


def export_decks(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    name: str,
    *,
    quality: Quality = "standard",
) -> Path:
    """Write the decks of CalculiX, with and without inclusion, and how to run them, into a folder.

    Parameters
    ----------
    levels : depths of the press, mm, rising.
    name : the folder, which appears whole or not at all.
    """
    check_decks(design, inclusion, levels)
    from fem import ccx

    steps = _LINEAR if design.mechanics == "linear" else _FINITE.format(n=1 + ccx.SETTLE, m=ccx.SETTLE)
    told = README.format(levels=", ".join(f"{level:g}" for level in levels), steps=steps)
    try:
        with staged(name, _holds_decks) as folder:
            for file, bare in zip(_DECKS, (False, True), strict=True):
                fem.deck(
                    folder / file,
                    design.probe(),
                    design.slab(),
                    inclusion,
                    levels,
                    mechanics=design.mechanics,
                    quality=quality,
                    tilt=design.press.tilt_deg,
                    position=design.press.position_mm,
                    without_inclusion=bare,
                )
            (folder / "README.txt").write_text(told, encoding="utf-8")
    except DesignError as error:
        raise error.renamed("ccx") if error.field == "out" else error from None
    return Path(name).absolute()


def _holds_decks(folder: Path) -> bool:
    """Only what this writes, so that no answer of CalculiX is ever lost."""
    names = {entry.name for entry in folder.iterdir()}
    return names <= {*_DECKS, "README.txt"} and begins(folder / "README.txt", README)
