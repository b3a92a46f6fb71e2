"""From a design and an inclusion to presses, one for each level: what can be pressed, and who computes it."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np

import fem
from fem import emulator_limits, spheres
from fem.background import spheres_on_background
from fem.mesh import QUALITIES
from fem.model import check as check_mechanics
from twin import learned
from twin.complaint import DesignError, shown
from twin.design import Design

if TYPE_CHECKING:
    from fem import Emulated, Emulator, Press

Mechanics = Literal["finite", "linear"]
Quality = Literal["preview", "standard", "reference"]

# What an emulator calls otherwise than a design.
_NAMES = {
    "probe.": "waveguide.",
    "slab.": "specimen.",
    "tilt": "press.tilt_deg",
    "position": "press.position_mm",
    "indentation": "press.indentation_mm",
    "force": "press.force_N",
}

MIN_FORCE_N = 1e-4
"""Smallest press by force: far below what any camera sees."""

# The force grows faster than the depth, and with an inclusion: only beyond this factor of what plain tissue
# carries at small strain at the deepest press is it out of reach without a look.
_SURELY_TOO_MUCH = 2.0

_OWN = 0.7  # share of the time that a press takes without its background

# Samples of a corpus follow each other in the same tissue, off both axes 0.3 GiB of it; a layout's slopes
# ask for six of every inclusion, coarse, of at most 0.1 GiB each.
_FINE, _COARSE = (lru_cache(maxsize=size)(fem.multipoles) for size in (2, 8))


def levels_of(
    design: Design, indentation: float | Sequence[float] | None, force: float | Sequence[float] | None
) -> tuple[list[float], bool, bool]:
    """Return the press levels (mm or N), whether they are forces, and whether a list of answers is wanted.

    Without a level it is the first of the design.
    """
    if indentation is not None and force is not None:
        raise DesignError("press", "both indentation and force", "one of them")
    given = force if force is not None else indentation
    if given is None:
        given = design.press.indentation_mm[0]
    several = isinstance(given, Sequence) or np.ndim(given) > 0
    field = "press.force_N" if force is not None else "press.indentation_mm"
    try:
        each = list(given) if several else [given]  # type: ignore[arg-type]
        if isinstance(given, str | bytes) or any(isinstance(level, bool | np.bool_ | str) for level in each):
            raise TypeError
        if any(np.ndim(level) for level in each):
            raise TypeError
        levels = [float(level) for level in each]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise DesignError(field, shown(given), "a number > 0, or a list of them") from None
    if not levels:
        raise DesignError(field, "no level", "at least one number > 0")
    return levels, force is not None, several


def check(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float] = (),
    *,
    by_force: bool = False,
) -> None:
    """Raise, before any work is done, if it cannot be pressed: levels are mm, or N ``by_force``."""
    if inclusion is not None:
        design.check_inclusion(inclusion)
    check_mechanics(design.probe(), design.slab(), inclusion, design.pose())
    for level in levels:
        if not by_force:
            design.check_indentation(level)
        elif not MIN_FORCE_N <= level < np.inf:
            raise DesignError("press.force_N", shown(level), f"a finite number >= {MIN_FORCE_N:g} N")


def solved(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    *,
    by_force: bool = False,
    quality: Quality = "standard",
    estimate: bool = True,
    pictured: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> list[Press]:
    """Return the presses by finite elements, one for each level, all found on one way down.

    Parameters
    ----------
    pictured : surfaces stand on the background that all inclusions share (`fem.on_background`), without
        their own mesh's ripples.

    Raises
    ------
    DesignError, fem.NotModelled, fem.NotConverged
        In one line.
    """
    if by_force:
        _refuse_hopeless(design, levels)
    own, tell = _OWN if pictured else 1.0, progress
    try:
        presses = fem.press(
            design.probe(),
            design.slab(),
            inclusion,
            **{"force" if by_force else "indentation": list(levels)},
            mechanics=design.mechanics,
            quality=quality,
            tilt=design.press.tilt_deg,
            position=design.press.position_mm,
            estimate=estimate,
            progress=None if tell is None else lambda stage, share: tell(stage, own * share),
        )
        if pictured:
            if tell is not None:
                tell("background", own)
            presses = fem.on_background(presses, smooth=True)
    except ValueError as error:
        # what the mesh cannot follow comes as a plain ValueError in the same words
        if type(error) is ValueError and ": received " in str(error):
            raise fem.NotModelled(str(error)) from None
        raise
    if by_force:
        _check_depth(design, presses, levels)
    return presses


def emulator_of(design: Design, emulator: Emulator | str | Path | None) -> Emulator:
    """Return the emulator itself or of a name or file, by default the usual one of the design's name.

    Raises
    ------
    DesignError, fem.emulator_file.NotAnEmulator
        In one line, where there is none, how to build one.
    """
    if emulator is None:
        emulator = learned.usual_emulator(design.name)
    if not isinstance(emulator, str | Path):
        return emulator
    try:
        return fem.load_emulator(learned.emulator_file(emulator))
    except OSError:
        allowed = f"a file that `twin emulate DESIGN --out {learned.FOLDER / 'NAME.npz'}` wrote"
        allowed += f", or {', '.join(learned.shipped())}, which ships" if learned.shipped() else ""
        raise DesignError("emulator", shown(str(emulator)), allowed) from None


def emulated(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    emulator: Emulator,
    *,
    by_force: bool = False,
) -> list[Emulated]:
    """Return the presses by an emulator, one for each level.

    Raises
    ------
    fem.NotModelled
        For what it was not built for, and outside of its ranges, in one line.
    """
    with _in_designs_words():
        return [
            emulator(
                design.probe(),
                design.slab(),
                inclusion,
                None if by_force else level,
                force=level if by_force else None,
                tilt=design.press.tilt_deg,
                position=design.press.position_mm,
            )
            for level in levels
        ]


def check_emulated(
    design: Design, inclusion: fem.Inclusion | None, levels: Sequence[float], emulator: Emulator
) -> None:
    """Raise `fem.NotModelled` for what `emulated` would refuse of presses by depth, in microseconds."""
    plan, pose = emulator.plan, design.press
    with _in_designs_words():
        emulator_limits.check(
            plan,
            design.probe(),
            design.slab(),
            inclusion,
            plan.mechanics,
            tilt=pose.tilt_deg,
            position=pose.position_mm,
        )
        for level in levels:
            emulator_limits.within("indentation", level, plan.ranges.indentation_mm, "mm")


def expanded(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    *,
    by_force: bool = False,
    quality: Quality = "standard",
    degree: int | None = None,
) -> list[Emulated]:
    """Return the presses at small strain by multipoles in tissue that is solved once (`fem.multipoles`), on
    the background of `solved`.

    Parameters
    ----------
    degree : of the last multipoles, by default the quality's.

    Raises
    ------
    DesignError, fem.NotModelled
        In one line.
    """
    check_expanded(design, inclusion, quality)
    with _in_designs_words():
        tissue = (_COARSE if quality == "preview" else _FINE)(
            design.probe(), design.slab(), quality, degree=degree
        )
        found = tissue.press(inclusion, levels, by_force)
    if by_force:
        _check_depth(design, found, levels)
    return spheres_on_background(found, design.probe(), design.slab(), QUALITIES[quality])


def check_expanded(design: Design, inclusion: fem.Inclusion | None, quality: Quality) -> None:
    """Raise, before any work is done, for what `expanded` would refuse."""
    if quality not in spheres.QUALITIES:
        allowed = " or ".join(map(repr, spheres.QUALITIES))
        raise DesignError("quality", f"{quality!r} with multipoles", allowed)
    with _in_designs_words():
        spheres.refuse(design.probe(), design.slab(), inclusion, design.pose())


@contextmanager
def _in_designs_words() -> Iterator[None]:
    """Name what an emulator refuses as a design does."""
    try:
        yield
    except ValueError as error:
        field, colon, rest = str(error).partition(":")
        for start, name in _NAMES.items():
            if field == start or (start.endswith(".") and field.startswith(start)):
                field = name + field.removeprefix(start)
        raise fem.NotModelled(field + colon + rest) from None


def _refuse_hopeless(design: Design, forces: Sequence[float]) -> None:
    """Raise `DesignError`, at the cost of a preview, where the force is far beyond the deepest press."""
    probe = replace(design.probe(), dome_radius_mm=None)
    depth = design.max_indentation_mm
    flat = fem.press(probe, design.slab(), None, depth, mechanics="linear", quality="preview", estimate=False)
    for force in forces:
        if force > _SURELY_TOO_MUCH * flat.force_N:
            raise _too_deep(design, force, flat.force_N)


def _check_depth(design: Design, presses: Sequence[Press | Emulated], forces: Sequence[float]) -> None:
    """Raise `DesignError` if one of the forces presses deeper than is allowed."""
    for force, press in zip(forces, presses, strict=True):
        deepest = max(press.indentation_mm, press.indentation_0_mm)
        if deepest > design.max_indentation_mm * (1 + 1e-9):
            raise _too_deep(design, force, force * design.max_indentation_mm / deepest)


def _too_deep(design: Design, force: float, most: float) -> DesignError:
    allowed = f"a number > 0 and <= about {most:.3g} N, which presses {design.max_indentation_mm:g} mm deep"
    return DesignError("press.force_N", shown(force), allowed)
