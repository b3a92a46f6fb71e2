"""What of a corpus is there: planned, done, missing, failed and why. Reads only."""

from __future__ import annotations

import json
import os
import re
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

from scenes import exr
from twin import store
from twin.occupied import holder, leftovers
from twin.plan import load_plan

_SPAN_S = 1800.0
_MOST = 2**20  # bytes of a failure's file


@dataclass(frozen=True)
class Reason:
    """Samples that failed alike."""

    error: str
    """One line, that of the first."""
    count: int
    samples: list[int]
    """The first ten of them."""


@dataclass(frozen=True)
class Status:
    """A corpus at one moment."""

    name: str
    folder: str
    planned: int
    done: int
    missing: int
    """Neither done nor failed."""
    failed: int
    reasons: list[Reason]
    frames: int
    """Of the samples that are done."""
    per_minute: float | None
    """Samples a minute in the last half hour of the latest run; None where too few are there."""
    bytes: int
    leftovers: list[str]
    """Temporary files and folders, which belong to the run that is going on or to one that was killed."""
    running: str | None
    """Which process runs it now."""
    indexed: bool
    """Whether there is an index."""


def status(directory: str | Path) -> Status:
    """Return what of a corpus is there.

    Raises
    ------
    DesignError
        In one line, if the folder has no plan that can be read.
    """
    folder = Path(directory)
    plan = load_plan(folder)
    done = {number for number in store.finished(folder) if number < len(plan)}
    failed = {
        number: why for number, why in _failures(folder).items() if number < len(plan) and number not in done
    }
    return Status(
        name=plan.name,
        folder=str(folder),
        planned=len(plan),
        done=len(done),
        missing=len(plan) - len(done) - len(failed),
        failed=len(failed),
        reasons=_grouped(failed),
        frames=len(done) * len(plan.indentation_mm),
        per_minute=_rate(folder, done),
        bytes=_size(folder),
        leftovers=[path.relative_to(folder).as_posix() for path in leftovers(folder)],
        running=holder(folder),
        indexed=(folder / "index.parquet").is_file(),
    )


def _failures(folder: Path) -> dict[int, str]:
    found = {}
    for place in sorted(folder.glob("failed/[0-9]*.json")):
        if not place.stem.isdecimal() or len(place.stem) > 12:
            continue
        why = "failed/ has a file that cannot be read"
        try:
            with open(place, "rb") as file:
                said = json.loads(file.read(_MOST))
            if isinstance(said, dict) and isinstance(said.get("error"), str):
                told = " ".join(said["error"].split())[:500]
                why = "".join(sign if sign.isprintable() else "?" for sign in told) or why
        except (OSError, ValueError, RecursionError):
            pass
        found[int(place.stem)] = why
    return found


def _grouped(failed: dict[int, str]) -> list[Reason]:
    """Group reasons that differ in their numbers only; the most frequent first."""
    kinds = {number: re.sub(r"[-+]?[0-9][0-9.e+-]*", "#", why) for number, why in failed.items()}
    found = []
    for kind, count in Counter(kinds.values()).most_common():
        members = sorted(number for number, one in kinds.items() if one == kind)
        found.append(Reason(failed[members[0]], count, members[:10]))
    return found


def _rate(folder: Path, done: set[int]) -> float | None:
    """Samples a minute of late, from when the first of them was begun to when the last was done."""
    times = []
    for number in done:
        try:
            times.append((os.stat(store.sample_folder(folder, number) / store.SAMPLE).st_mtime, number))
        except OSError:
            continue
    times.sort()
    recent = [(moment, number) for moment, number in times if moment >= times[-1][0] - _SPAN_S]
    if len(recent) < 3 or recent[-1][0] <= recent[0][0]:
        return None
    first, number = recent[0]
    try:
        took = sum(store.read_note(folder, number).seconds.values())
    except exr.ImageError:
        return None
    return 60.0 * len(recent) / (recent[-1][0] - first + took)


def _size(folder: Path) -> int:
    total = 0
    for place, _, names in os.walk(folder):
        for name in names:
            try:
                total += os.lstat(os.path.join(place, name)).st_size
            except OSError:
                continue
    return total


def as_json(found: Status) -> str:
    """Return the status as JSON."""
    return json.dumps(asdict(found), indent=2, ensure_ascii=False)


def in_words(found: Status) -> str:
    """Return the status as a few lines."""
    lines = [
        f"{found.name}: {found.done} of {found.planned} samples done, "
        f"{found.missing} missing, {found.failed} failed",
        f"frames: {found.frames}, {_bytes(found.bytes)}" + ("" if found.indexed else ", no index yet"),
    ]
    if found.per_minute is not None:
        lines.append(f"rate: {found.per_minute:.3g} samples a minute")
    if found.running:
        lines.append(f"running: {found.running}")
    for reason in found.reasons:
        which = ", ".join(map(str, reason.samples)) + (", ..." if reason.count > len(reason.samples) else "")
        lines.append(f"failed ({reason.count}; {which}): {reason.error}")
    if found.leftovers:
        whose = (
            "of the run that is going on" if found.running else "of a run that was killed; run removes them"
        )
        lines.append(f"temporary: {len(found.leftovers)}, {whose}")
    if not found.running and found.done < found.planned:
        lines.append(f"next: twin corpus run {found.folder}")
    return "\n".join(lines)


def _bytes(count: int) -> str:
    for unit, size in (("GB", 1e9), ("MB", 1e6), ("kB", 1e3)):
        if count >= size:
            return f"{count / size:.3g} {unit}"
    return f"{count} B"
