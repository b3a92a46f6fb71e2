"""`twin emulate`: build the emulator of the contact field of a design's sensor."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

import fem
from fem.emulator_errors import LARGE, Errors
from twin.captions import percent_in_words
from twin.complaint import DesignError, shown
from twin.design import Design
from twin.stage import check_file

if TYPE_CHECKING:
    from fem.sampling import Plan

SUFFIX = ".npz"

FINITE = 0.5
"""Deepest press learned at finite strain, as a share of the deepest that a design allows: 3 mm of 6 for
`tsis`. Beyond, the probe's soft corners fold over inclusions under them."""


_ROOM = 1.1
"""How much thicker the thickest specimens are than what holds the smallest and shallowest inclusion."""


def plan_of(design: Design, seed: int = 0) -> Plan:
    """Return what to learn of a design: its sensor, and specimens around the design's.

    Raises
    ------
    DesignError
        For a design with a domed sensor, or one that is not pressed straight down on the middle, and for a
        specimen too thin for inclusions of that size.
    """
    for field, value in (
        ("waveguide.dome_radius_mm", design.waveguide.dome_radius_mm),
        ("press.tilt_deg", tuple(design.press.tilt_deg)),
        ("press.position_mm", tuple(design.press.position_mm)),
    ):
        if value not in (None, (0.0, 0.0)):
            raise DesignError(
                field, shown(value), "none: emulators know flat sensors, straight on the middle"
            )
    from fem.sampling import CLEARANCE, Plan, Ranges

    slab, width = design.slab(), design.waveguide.width_mm
    smallest, shallowest, thickest = 0.08 * width, 0.16 * width, 4 / 3
    least = math.ceil(10 * _ROOM * (CLEARANCE + smallest + shallowest) / thickest) / 10
    if slab.thickness_mm < least:
        allowed = f"at least {least:g} mm: an emulator's inclusions keep {CLEARANCE:g} mm from the chest wall"
        raise DesignError("specimen.thickness_mm", shown(slab.thickness_mm), allowed)
    ranges = Ranges(
        size_mm=(smallest, 0.52 * width),
        depth_mm=(shallowest, 0.48 * width),
        modulus_kPa=(4.0 * slab.modulus_kPa, 24.0 * slab.modulus_kPa),
        offset_mm=0.24 * width,
        indentation_mm=(0.1, design.max_indentation_mm * (1.0 if design.mechanics == "linear" else FINITE)),
        tissue_kPa=(0.6 * slab.modulus_kPa, 1.6 * slab.modulus_kPa),
        thickness_mm=(0.8 * slab.thickness_mm, thickest * slab.thickness_mm),
    )
    return Plan(
        design.probe(),
        slab.width_mm,
        slab.poisson,
        slab.sides,
        ranges=ranges,
        mechanics=design.mechanics,
        seed=seed,
    ).by_multipoles()


def emulate(
    design: Design,
    out: str,
    *,
    minutes: float | None = None,
    samples: int | None = None,
    workers: int | None = None,
    seed: int = 0,
    progress: Callable[[str, float], None] | None = None,
) -> fem.Emulator:
    """Build the emulator of a design's sensor, write it to `out` and return it.

    The solves are kept in the folder `out` + ".samples": the same call goes on with them.

    Parameters
    ----------
    out : name of the file, ending in ``.npz``.
    minutes, samples : when to stop solving; 30 minutes if neither is given.
    workers : processes; all cores by default.
    """
    target = check_file(out, "out", SUFFIX)
    plan = plan_of(design, seed)
    target.parent.mkdir(parents=True, exist_ok=True)
    if minutes is None and samples is None:
        minutes = 30.0
    folder = target.with_name(target.name + ".samples")
    built = fem.build_emulator(
        plan, folder, minutes=minutes, samples=samples, workers=workers, progress=progress
    )
    fem.save_emulator(built, target)
    return built


def summary(emulator: fem.Emulator, out: str) -> str:
    """Return what a person wants to know of a new emulator, several lines."""
    errors, lines = emulator.errors, []
    low, high = emulator.plan.ranges.indentation_mm
    lines.append(
        f"emulator: {emulator.plan.mechanics} mechanics, presses of {low:g} to {high:g} mm, "
        f"{len(errors.size_mm)} samples held out in turn"
    )
    smallest = emulator.plan.ranges.size_mm[0]
    lines += _errors(errors, "inclusions of 4 mm and more", max(smallest, LARGE))
    if smallest < LARGE:
        lines += _errors(errors, "smaller ones", smallest)
    for what, found in (("", errors.finer), (", what finite strain adds", errors.finer_more)):
        if found.any():  # multipoles leave nothing to a finer mesh
            for name, column in (("pressure", 0), ("displacement", 3)):
                typical, bad = (percent_in_words(float(np.percentile(found[:, column], p))) for p in (50, 95))
                lines.append(f"what the standard mesh adds to tared {name}{what}: off by {typical} and {bad}")
    for count, more, seconds, median, bad, mean, worse, *_ in errors.curve:
        solves = f"{count:.0f} samples" + (f" ({more:.0f} at finite strain)" if more else "")
        lines.append(
            f"with {solves}, {seconds / 60:.0f} core minutes beside pairs of meshes: pressure, largest off "
            f"the edge {median:.2g} % and {bad:.2g} %; root mean square {mean:.2g} % and {worse:.2g} %"
        )
    failed = int(errors.solves[:, 1].sum())
    lines.append(f"solves that failed: {failed} of {int(errors.solves[:, 0].sum())}")
    lines.append(f"file: {Path(out)}")
    return "\n".join(lines)


def _errors(errors: Errors, what: str, size: float) -> Iterator[str]:
    """Yield what held-out samples say of inclusions of a size and alike."""
    of = errors.size_mm[errors.alike(size)]
    if not of.size:
        yield f"tared pressure and displacement, {what}: errors not known, too few samples were held out"
        return
    if ((of >= LARGE) != (size >= LARGE)).any():  # too few of its kind
        what += f", by the nearest samples of {of.min():.2g} to {of.max():.2g} mm"
    kinds = ("largest off the edge", "root mean square over the surface", "largest on all of it")
    for name in ("pressure", "displacement"):
        told = []
        for kind, words in enumerate(kinds):
            typical, bad = (percent_in_words(errors.percentile(name, p, size, kind)) for p in (50, 95))
            told.append(f"{words} {typical} and {bad}")
        yield f"tared {name}, {what}, median and 95th percentile over its maximum: {'; '.join(told)}"
