"""Run a corpus: make every sample of its plan that is not there yet, on as many processes as there are.

A sample's mechanics and its light are two tasks, and only a few samples per worker are on their way at a time,
so that a million of them do not weigh on the scheduler. What a sample is depends on plan and number alone:
neither workers nor order nor an interruption show in it.
"""

from __future__ import annotations

import asyncio
import json
import queue
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from twin import index, interrupt, labour, store
from twin.complaint import DesignError, shown
from twin.crew import crew
from twin.labour import Corpus, Made, Trouble
from twin.occupied import locked, sweep
from twin.plan import load_plan
from twin.planned import PLAN

if TYPE_CHECKING:
    from distributed import Client, Future

    from twin.plan import Plan

WINDOW = 4
"""Samples on their way for each worker."""
_TICK_S = 0.5
_INDEX_EVERY_S = 300.0
_LOST_S = 60.0
_RATE_OVER = 200
"""Finished samples that the rate is taken from."""


class Stopped(RuntimeError):
    """A run that cannot go on for any sample: a full disk, no scheduler; one line. What is finished stays."""


@dataclass
class Progress:
    """How far a run is."""

    planned: int
    done: int
    failed: int = 0
    made: int = 0
    """Of `done`, how many by this run."""
    workers: int = 0
    started: float = field(default_factory=time.monotonic)
    notes: list[str] = field(default_factory=list)
    """What a user should know at the end, a line each."""
    recent: deque[float] = field(default_factory=lambda: deque(maxlen=_RATE_OVER))

    def count(self) -> None:
        """Take note of one more finished sample."""
        self.done, self.made = self.done + 1, self.made + 1
        self.recent.append(time.monotonic())

    @property
    def per_minute(self) -> float:
        """Samples a minute of late; 0 where none is finished yet."""
        if not self.recent:
            return 0.0
        since = self.started if self.made == len(self.recent) else self.recent[0]
        counted = len(self.recent) - (self.made != len(self.recent))
        return 60.0 * counted / max(time.monotonic() - since, 1e-9)

    @property
    def left_s(self) -> float | None:
        """Seconds to go at that rate."""
        return 60.0 * (self.planned - self.done - self.failed) / self.per_minute if self.recent else None


def run(
    directory: str | Path,
    workers: int | None = None,
    scheduler: str | None = None,
    *,
    retries: int = 1,
    numbers: Iterable[int] | None = None,
    progress: Callable[[Progress], None] | None = None,
) -> Progress:
    """Make the samples of a corpus's plan that are missing, those too that failed before.

    Parameters
    ----------
    workers : processes on this machine, one thread each; default one per core.
    scheduler : address of a Dask scheduler, whose workers see the folder under the same path, instead.
    retries : how often a sample that fails is tried again before `failed/NNNNNN.json` says why.
    numbers : samples to make, in this order; default all, rising.
    progress : called a few times a second.

    Raises
    ------
    DesignError
        In one line: no plan, no scheduler, or another run has the corpus.
    Stopped
        In one line: the disk is full, the scheduler is gone, workers see another corpus.
    """
    if workers is not None and workers < 1:
        raise DesignError("workers", shown(workers), "an integer > 0")
    folder = Path(directory).resolve()
    plan = load_plan(folder)
    corpus = Corpus(str(folder), store.sha256(folder / PLAN))
    tell = progress or (lambda state: None)
    try:
        with locked(folder):
            sweep(folder)
            there = store.finished(folder)
            wanted = range(len(plan)) if numbers is None else [plan._checked(number) for number in numbers]
            state = Progress(len(plan), len(there & set(wanted)) if numbers is None else len(there))
            table = index.Table(folder, plan, corpus.plan)
            try:
                if any(number not in there for number in wanted):
                    with crew(workers, scheduler) as client:
                        todo = (number for number in wanted if number not in there)
                        _Run(client, plan, corpus, state, retries, tell, table).make(todo)
            finally:
                if scheduler is None or state.done + state.failed >= state.planned:
                    sweep(folder)  # what workers left that were killed
                table.write()
                state.notes += [f"cannot be read: {line}" for line in list(table.bad.values())[:10]]
                if table.bad:
                    state.notes.append(f"{len(table.bad)} samples cannot be read: twin corpus verify DIR --repair")
    except OSError as error:
        raise Stopped(labour.trouble(error).error) from error
    return state


class _Run:
    """The samples on their way, and what becomes of them."""

    def __init__(
        self,
        client: Client,
        plan: Plan,
        corpus: Corpus,
        state: Progress,
        retries: int,
        tell: Callable[[Progress], None],
        table: index.Table,
    ) -> None:
        self.client, self.plan, self.corpus, self.state = client, plan, corpus, state
        self.retries, self.tell, self.table = retries, tell, table
        self.folder = Path(corpus.folder)
        self.run_id = f"{time.time_ns():x}"  # so that tasks of a killed run are never taken for ours
        self.ready: queue.SimpleQueue[Future] = queue.SimpleQueue()
        self.running: dict[Future, tuple[int, int]] = {}
        self.beat = self.indexed = time.monotonic()

    def make(self, todo: Iterator[int]) -> None:
        again: deque[tuple[int, int]] = deque()
        todo = self._references(todo)
        while True:
            self._look()
            while len(self.running) < WINDOW * max(self.state.workers, 1):
                number, attempt = again.popleft() if again else (next(todo, None), 0)
                if number is None:
                    break
                self._start(number, attempt)
            if not self.running:
                return
            for future in self._finished():
                number, attempt = self.running.pop(future)
                outcome = _outcome(future)
                if isinstance(outcome, Made):
                    self.state.count()
                elif outcome.stops:
                    raise Stopped(outcome.error)
                elif attempt < self.retries:
                    again.append((number, attempt + 1))
                else:
                    self._record(number, attempt + 1, outcome)

    def _start(self, number: int, attempt: int) -> None:
        name = f"{self.run_id}-{number}-{attempt}"
        found = self.client.submit(labour.press, self.corpus, number, key=f"press-{name}", pure=False)
        future = self.client.submit(
            labour.light, self.corpus, number, found, key=f"light-{name}", priority=1, pure=False
        )
        self.running[future] = number, attempt
        future.add_done_callback(self.ready.put)

    def _references(self, todo: Iterator[int]) -> Iterator[int]:
        """Have what all samples share made first, one task each: else every worker would make all of it."""
        if not self.plan.shares_references:
            return todo
        first = next(todo, None)
        if first is None:
            return todo
        name = f"{self.run_id}-{first}"
        found = self.client.submit(labour.press, self.corpus, first, key=f"press-{name}", pure=False)
        futures = [
            self.client.submit(
                labour.refer, self.corpus, first, level, found, key=f"refer-{name}-{level}", pure=False
            )
            for level in range(len(self.plan.indentation_mm))
        ]
        for future in futures:
            self.running[future] = first, 0
            future.add_done_callback(self.ready.put)
        while self.running:
            self._look()
            for future in self._finished():
                del self.running[future]
                outcome = _outcome(future)
                if isinstance(outcome, Trouble) and outcome.stops:
                    raise Stopped(outcome.error)  # others go on: the sample itself will say what is wrong
        return _chained(first, todo)

    def _finished(self) -> Iterator[Future]:
        """Yield what is finished, as soon as something is, but wait no longer than a tick."""
        try:
            yield self.ready.get(timeout=_TICK_S)
            while True:
                yield self.ready.get_nowait()
        except queue.Empty:
            return

    def _look(self) -> None:
        """Whatever is due every now and then: signals, the number of workers, the index, the progress."""
        interrupt.stop_if_asked()
        now = time.monotonic()
        if self.client.status == "running":
            self.beat = now
        elif self.client.status == "closed" or now - self.beat > _LOST_S:
            raise Stopped("the scheduler is gone; what is finished stays, run again continues")
        self.state.workers = sum(self.client.nthreads().values()) if self.client.status == "running" else 0
        if now - self.indexed > _INDEX_EVERY_S:
            self.table.write()
            self.indexed = time.monotonic()
        self.tell(self.state)

    def _record(self, number: int, attempts: int, why: Trouble) -> None:
        from scenes import exr

        place = store.failure_file(self.folder, number)
        place.parent.mkdir(exist_ok=True)
        said = {"sample": number, "error": why.error, "attempts": attempts, "traceback": why.traceback}
        try:
            exr.write_bytes(place, (json.dumps(said, indent=1, sort_keys=True) + "\n").encode())
        except exr.ImageError as error:
            raise Stopped(labour.trouble(error).error) from error
        self.state.failed += 1


def _chained(first: int, rest: Iterator[int]) -> Iterator[int]:
    yield first
    yield from rest


def _outcome(future: Future) -> Any:
    """Return what a task answered; where Dask could not run it at all, why."""
    try:
        return future.result()
    except (Exception, asyncio.CancelledError) as error:
        name = type(error).__name__
        if name == "KilledWorker":
            return Trouble("KilledWorker: every worker that tried it died", traceback.format_exc())
        if isinstance(error, ImportError):
            return Trouble(f"a worker cannot run twin ({name}: {error})", traceback.format_exc(), stops=True)
        return Trouble(f"{name}: {' '.join(str(error).split())}"[:2000], traceback.format_exc())
