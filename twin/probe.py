"""How long a corpus will take and how large it will be, from a sample or two that are really simulated."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from twin.planned import Plan

TASK_SECONDS = 1e-3
"""What one task costs a Dask scheduler, s: its documentation's order of magnitude, on the careful side."""
TASKS = 2
"""Tasks of a sample: its mechanics, and its pictures."""
MAX_LOAD = 0.5
"""Share of a scheduler's time that may go into tasks: beyond it, workers begin to wait."""
_ENTRY_BYTES = 4096
"""What a file system rounds a file up to."""


@dataclass(frozen=True)
class Cost:
    """What a sample of a plan costs on one core: seconds of each part, bytes written, and how many files.

    ``start`` is what a worker needs once, to compile and to set up its scene, in seconds.
    """

    mechanics: float
    light: float
    write: float
    bytes: float
    start: float

    @property
    def seconds(self) -> float:
        """All parts together."""
        return self.mechanics + self.light + self.write


def measure(plan: Plan, progress: Callable[[str, float], None] | None = None) -> Cost:
    """Simulate two samples of a plan on one core, one after the other, into a folder that is thrown away.

    The first one compiles and sets up; the second one is what the others will cost. They come from the middle
    of the plan, so that neither is an extreme of a grid, and have inclusions where any has.
    """
    from twin import sample

    tell = progress or (lambda stage, done: None)
    numbers = np.flatnonzero(~plan.columns["blank"])
    numbers = numbers if len(numbers) else np.arange(len(plan))
    middle = len(numbers) // 2
    took, found = [], {}
    with tempfile.TemporaryDirectory(prefix="twin-probe-") as folder, _one_thread():
        for place, number in enumerate((numbers[middle], numbers[min(middle + 1, len(numbers) - 1)])):
            tell("probe", place / 2)
            corpus = Path(folder)
            if place and len(numbers) == 1:  # the same one again: elsewhere
                corpus = corpus / "again"
                corpus.mkdir()
            begun = time.perf_counter()
            found = sample.make(plan, int(number), corpus)
            took.append(time.perf_counter() - begun)
        tell("probe", 1.0)
    once, again = took
    seconds: Mapping[str, float] = found["seconds"]
    parts = {part: float(seconds[part]) for part in ("mechanics", "light", "write")}
    rest = max(again - sum(parts.values()), 0.0)  # what none of the parts counted
    parts["write"] += rest
    return Cost(**parts, bytes=float(found["bytes"]), start=max(once - again, 0.0))


@contextmanager
def _one_thread() -> Iterator[None]:
    """Work as one of several workers does: on one thread."""
    from threadpoolctl import threadpool_limits

    from scenes import backend

    backend.use("cpu")
    import drjit  # only now: see scenes.backend

    before = drjit.thread_count()
    try:
        backend.threads(1)
        with threadpool_limits(1):
            yield
    finally:
        backend.threads(max(before, 1))


def described(plan: Plan) -> str:
    """Return what a plan holds, for people, one line for each group."""
    levels = ", ".join(f"{level:g}" for level in plan.indentation_mm)
    frames = len(plan) * len(plan.indentation_mm)
    blank = int(plan.columns["blank"].sum())
    lines = [
        f"{plan.name}: {len(plan)} samples ({blank} blank) at {levels} mm, {frames} frames; seed {plan.seed}",
        f"mechanics {plan.mechanics}, {plan.quality}; light {plan.light}; "
        f"{sum('.' in name for name in plan.columns)} numbers of the design vary",
    ]
    for group in plan.groups:
        again = f", {group.redrawn} draws refused and drawn again" if group.redrawn else ""
        lines.append(f"  {group.name}: {group.count} {group.sampler}{again}")
    return "\n".join(lines)


def projected(plan: Plan, cost: Cost, frames: int, workers: float) -> str:
    """Return what so many frames of a plan's kind take, for people: time, storage, bandwidth, scheduler."""
    levels = len(plan.indentation_mm)
    samples = -(-frames // levels)
    core_seconds = samples * cost.seconds
    size = samples * (cost.bytes + _ENTRY_BYTES / 2 * (2 * levels + 1))
    most = MAX_LOAD * cost.seconds / (TASKS * TASK_SECONDS)
    rate = workers / cost.seconds
    rows = (
        ("frames", f"{frames} in {samples} samples"),
        (
            "a sample",
            f"{cost.seconds:.2f} s on one core (mechanics {cost.mechanics:.2f}, light {cost.light:.2f}, "
            f"files {cost.write:.2f}), {cost.bytes / 1e6:.2f} MB; {cost.start:.0f} s once per worker",
        ),
        ("core hours", f"{core_seconds / 3600:.3g}"),
        (
            f"{workers:g} workers",
            f"{_span(core_seconds / workers + cost.start)}, {60 * rate:.1f} samples a minute",
        ),
        ("storage", _size(size)),
        ("bandwidth", f"{_size(rate * cost.bytes)}/s written by {workers:g} workers"),
        (
            "scheduler",
            f"{rate * TASKS:.3g} tasks a second, {100 * rate * TASKS * TASK_SECONDS:.2g} % of its time at "
            f"{1e3 * TASK_SECONDS:g} ms a task; up to {most:.0f} workers for one scheduler",
        ),
    )
    return "\n".join(f"{name:>12}  {text}" for name, text in rows)


def _span(seconds: float) -> str:
    """Return a time for people."""
    for unit, length in (("days", 86400.0), ("h", 3600.0), ("min", 60.0)):
        if seconds >= 2 * length:
            return f"{seconds / length:.1f} {unit}"
    return f"{seconds:.0f} s"


def _size(amount: float) -> str:
    """Return bytes for people."""
    for unit, length in (("TB", 1e12), ("GB", 1e9), ("MB", 1e6)):
        if amount >= length:
            return f"{amount / length:.3g} {unit}"
    return f"{amount / 1e3:.3g} kB"
