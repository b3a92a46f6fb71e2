"""What a person sees of a long run: a bar on a terminal, else a line now and then."""

from __future__ import annotations

import time
from collections.abc import Callable
from datetime import timedelta
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

if TYPE_CHECKING:
    from twin.run import Progress as State

LINE_EVERY_S = 30.0
_CALM_S = 0.2


class Headway:
    """Progress on stderr: samples done and failed, samples a minute, time left."""

    def __init__(self, in_words: Callable[[Any], str] | None = None) -> None:
        self._words = in_words or words
        self._console = Console(stderr=True)
        self._told, self._said = -LINE_EVERY_S, ""
        self._bar: Progress | None = None
        if self._console.is_terminal:
            columns = (BarColumn(), TextColumn("{task.description}"), TimeElapsedColumn())
            self._bar = Progress(*columns, console=self._console, transient=True)
            self._task = self._bar.add_task("starting", total=None)

    def __enter__(self) -> Self:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Take the bar away."""
        if self._bar:
            self._bar.stop()

    def __call__(self, state: Any) -> None:
        now = time.monotonic()
        if now - self._told < (_CALM_S if self._bar else LINE_EVERY_S):
            return
        self._told = now
        if self._bar:
            done = state.done + state.failed
            self._bar.update(self._task, description=self._words(state), completed=done, total=state.planned)
        elif (said := self._words(state)) != self._said:
            self._console.print(said, highlight=False, soft_wrap=True)
            self._said = said


def layouts(state: Any) -> str:
    """Return how far an exploration is, in one line."""
    return _in_words(state, "layouts", "infeasible")


def words(state: State) -> str:
    """Return how far a run is, in one line."""
    return _in_words(state, "samples", "failed")


def _in_words(state: Any, what: str, bad: str) -> str:
    parts = [f"{state.done} of {state.planned} {what}"]
    if state.failed:
        parts.append(f"{state.failed} {bad}")
    if not state.workers:
        parts.append("waiting for workers")
    if state.left_s is not None:
        parts.append(f"{state.per_minute:.3g} a minute")
        parts.append(f"{timedelta(seconds=round(state.left_s))} left")
    return ", ".join(parts)
