"""Processes that explore: each tries layouts on one thread; and how long an exploration takes.

Run as a module this is one of them: `python -m twin.explore_crew DIR`.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

from twin import explore, layout_fields
from twin.evaluate import Bench, evaluate
from twin.explore import Exploration
from twin.pooled import end_with

_POLL_S = 0.5
_STOP_S = 10.0


class Broken(RuntimeError):
    """A process that explored ended otherwise than it should; the message is one line."""


@dataclass(frozen=True)
class State:
    """How far it is, in `headway`'s words; `failed` are layouts that cannot be."""

    done: int
    failed: int
    planned: int
    workers: int
    per_minute: float
    left_s: float | None


@dataclass(frozen=True)
class Cost:
    """Seconds on one core, measured: what a process needs once, and of a layout the share that its inclusions
    have in common and what each of them adds, by kind of field."""

    start: float
    shared: dict[str, float]
    each: dict[str, float]

    def layout(self, kind: str, inclusions: int) -> float:
        """Seconds of a layout whose fields are of this kind at most."""
        return self.shared[kind] + self.each[kind] * inclusions


def run(exploration: Exploration, workers: int, tell: Callable[[State], None]) -> explore.Progress:
    """Let so many processes work until all layouts are there, and return how far it is.

    Raises
    ------
    Broken
        Where none of the processes is left before the end.
    """
    study = explore.opened(exploration)
    before, began = explore.progress(exploration, study), time.monotonic()
    if before.done >= before.wanted and (exploration.folder / explore.BASELINE).exists():
        return before
    crew = [_start(exploration.folder, number) for number in range(workers)]
    try:
        while any(one.poll() is None for one in crew):
            time.sleep(_POLL_S)
            now = explore.progress(exploration, study)
            new, passed = now.done - before.done, time.monotonic() - began
            rate = new / passed
            left = (now.wanted - now.done) / rate if new else None
            alive = sum(one.poll() is None for one in crew)
            tell(State(now.complete, now.infeasible, now.wanted, alive, 60 * rate, left))
    finally:
        _stop(crew)
    for number, one in enumerate(crew):
        if one.returncode:
            log = exploration.folder / explore.WORKERS / f"{number}.log"
            lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines() or ["nothing"]
            raise Broken(f"worker {number} ended with status {one.returncode}: {lines[-1][:300]} (see {log})")
    return explore.progress(exploration, study)


def measure(exploration: Exploration) -> Cost:
    """Evaluate the study's own layout on one inclusion, then on another, in this process on one thread."""
    began = time.perf_counter()
    _one_thread()
    base = layout_fields.base(exploration.study, exploration.design)
    balls = exploration.study.balls()
    balls = balls if len(balls) > 1 else (balls[0], balls[0])
    emulator = None
    if exploration.emulator is not None:
        from twin import presses

        emulator = presses.emulator_of(exploration.design, exploration.emulator)
    study, bench = exploration.study, Bench()
    options = {"emulator": emulator, "quality": study.quality, "seed": study.seed, "bench": bench}

    def timed(count: int, detection: bool) -> tuple[float, float, float]:
        there = evaluate(base, balls[:count], study.unknown(), detection=detection, **options)  # type: ignore[arg-type]
        return tuple(there.seconds[part] for part in ("mechanics", "light", "information"))  # type: ignore[return-value]

    timed(1, True)  # compiles
    start = time.perf_counter() - began
    bench.kept, bench._lighting = type(bench.kept)(), None
    one = timed(1, True)
    two = timed(2, True)  # the second one alone: the first is kept
    counting = two[2] / 2
    each = {"camera": counting, "optical": two[1] + counting, "mechanical": sum(two[:2]) + counting}
    light = max(one[1] - two[1], 0.0)
    shared = {"camera": 0.0, "optical": light, "mechanical": light + max(one[0] - two[0], 0.0)}
    return Cost(start, shared, each)


def planned(exploration: Exploration, cost: Cost, workers: int) -> str:
    """Return the kind of every field and how long the study takes, for people."""
    study, axes = exploration.study, exploration.axes
    kinds = {name: layout_fields.kind_of(study, exploration.design, name, one) for name, one in axes.items()}
    said = {
        "camera": "counts alone: no light again",
        "optical": "light again, on the contact of the base",
        "mechanical": "contact and light again",
    }
    width = max(len(name) for name in kinds)
    lines = [
        f"{study.name}: {exploration.trials} layouts by {study.search.method}, "
        f"{len(study.inclusions)} inclusions"
    ]
    lines += [f"  {name:<{width}}  {kind:<10}  {said[kind]}" for name, kind in kinds.items()]
    worst = next(kind for kind in ("mechanical", "optical", "camera") if kind in kinds.values())
    mechanics = "solved (small strain, coarse mesh)" if exploration.emulator is None else "by the emulator"
    lines.append(f"  mechanics {mechanics}; light {study.quality}")
    seconds = cost.layout(worst, len(study.inclusions)) * _presses(exploration)
    total = exploration.trials * seconds / workers + cost.start
    lines.append(f"  {seconds:.1f} s a layout on one core, {cost.start:.0f} s once per worker (measured)")
    lines.append(f"  about {_span(total)} with {workers} worker{'s' if workers > 1 else ''}")
    return "\n".join(lines)


def _presses(exploration: Exploration) -> float:
    """Mean number of presses of the layouts over that of the study's own: fields of the protocol."""
    axes, study = exploration.axes, exploration.study
    base = layout_fields.base(study, exploration.design).protocol
    factor = 1.0
    for name, own in (
        ("protocol.indentation_mm", len(base.indentation_mm)),
        ("protocol.positions_mm", len(base.positions_mm)),
    ):
        if name in axes and axes[name].choices:
            counts = [len(choice) for choice in axes[name].choices or ()]
            factor *= sum(counts) / len(counts) / own
    return factor


def _start(folder: Path, number: int) -> subprocess.Popen[bytes]:
    threads = {name: "1" for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}
    log = (folder / explore.WORKERS / f"{number}.log").open("wb")
    # -P: a study's folder, where people stand, may hold a file called like a module
    command = [sys.executable, "-P", "-m", "twin.explore_crew", str(folder), str(os.getpid())]
    with log:
        return subprocess.Popen(command, env={**os.environ, **threads}, stdout=log, stderr=log)


def _stop(crew: list[subprocess.Popen[bytes]]) -> None:
    for one in crew:
        if one.poll() is None:
            one.terminate()
    until = time.monotonic() + _STOP_S
    for one in crew:
        with suppress(subprocess.TimeoutExpired):
            one.wait(max(until - time.monotonic(), 0.1))
        if one.poll() is None:
            one.kill()
            one.wait()


def _one_thread() -> None:
    from threadpoolctl import threadpool_limits

    from scenes import backend

    backend.use("cpu")
    backend.threads(1)
    threadpool_limits(1)


def _span(seconds: float) -> str:
    if seconds >= 7200:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.1f} min" if seconds >= 120 else f"{seconds:.0f} s"


def main(arguments: list[str]) -> int:
    """Explore in a folder until all layouts are there; ends with the process that started it."""
    folder, parent = Path(arguments[0]), int(arguments[1])
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears Ctrl-C, and says so
    end_with(parent)
    _one_thread()
    explore.work(explore.reopened(folder))
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
