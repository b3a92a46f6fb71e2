"""What a person sees of a run: how far it is, and what came out."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Self

from rich import box
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.table import Table

from twin import interrupt
from twin.captions import inclusion_in_words, mechanics_in_words, percent_in_words
from twin.frame import Frame
from twin.light_bias import in_words as bias_in_words

SATURATED_PERCENT = 0.1
"""Share of full pixels that is worth a line: fewer do not move the scalars."""


class Reporter:
    """Progress on stderr: a bar with the time left on a terminal, otherwise one line per finished stage.

    Call it with a stage's name when the stage starts, and the share of all work that is done by then. Each
    call also hears Ctrl-C (`interrupt.stop_if_asked`).
    """

    def __init__(self) -> None:
        self._console = Console(stderr=True)
        self._stage, self._since = "", 0.0
        self._bar: Progress | None = None
        if self._console.is_terminal:
            columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn(), TextColumn("left"))
            self._bar = Progress(*columns, TimeRemainingColumn(), console=self._console, transient=True)
            self._task = self._bar.add_task("starting", total=1.0)

    def __enter__(self) -> Self:
        if self._bar:
            self._bar.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._bar:
            self._bar.stop()
        if kind is None:
            self._close_stage()

    def __call__(self, stage: str, done: float) -> None:
        interrupt.stop_if_asked()
        if self._bar:
            self._bar.update(self._task, description=stage, completed=done)
        elif stage != self._stage:
            self._close_stage()
            self._stage, self._since = stage, time.perf_counter()

    def _close_stage(self) -> None:
        # Told when it ends, so that a mistake found on the way is the only line there is.
        if self._stage and not self._bar:
            self._console.print(f"{self._stage}: {time.perf_counter() - self._since:.1f} s", highlight=False)


def summarise(frames: Sequence[Frame], out: Path) -> None:
    """Print the scalars of each frame, raw and tared, and where the files are."""
    table = Table(title=_title(frames[0]), title_justify="left", box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.add_column("press", justify="right", no_wrap=True)
    surface_and_picture = (
        "max\nµm",
        "total\nmm³",
        "area\nmm²",
        "max\ncounts",
        "total\ncounts",
        "area\npixels",
    )
    for place, quantity in zip(3 * ("surface",) + 3 * ("picture",), surface_and_picture, strict=True):
        table.add_column(f"{place}\n{quantity}", justify="right", no_wrap=True)
    for frame in frames:
        press = f"{frame.press['indentation_mm']:.3g} mm, {frame.press['force_N']:.3g} N"
        for kind in ("raw", "tared"):
            surface, picture = frame.fem[kind], frame.tsis[kind]
            table.add_row(
                f"{press} {kind}" if kind == "raw" else kind,
                f"{1e3 * surface['max_mm']:.2f}",
                f"{surface['total_mm3']:.3f}",
                f"{surface['area_mm2']:.1f}",
                f"{picture['max_dn']:.1f}",
                f"{picture['total_dn']:.0f}",
                f"{picture['area_px']}",
            )
    console = Console(highlight=False)
    console.print(table)
    console.print("tared: minus the same press without inclusion", soft_wrap=True)
    for line in _trust(frames):
        console.print(line, soft_wrap=True)
    for line in _warnings(frames):
        console.print(line, soft_wrap=True)
    folders = [out] if len(frames) == 1 else [out / f"{number:02d}" for number in range(len(frames))]
    console.print("look at: " + ", ".join(str(folder / "overview.png") for folder in folders), soft_wrap=True)
    console.print(f"all files: {out}", soft_wrap=True)


def _warnings(frames: Sequence[Frame]) -> Iterator[str]:
    """Yield a line for what makes a picture useless: pixels that are full, or no light at all."""
    worst = max(frame.tsis.get("saturated_percent", 0.0) for frame in frames)
    if worst > SATURATED_PERCENT:
        where = "" if len(frames) == 1 else " of the brightest frame"
        yield f"saturated: {worst:.1f} % of the pixels{where}; a shorter camera.exposure_ms avoids it"
    if not all(frame.radiance.any() for frame in frames):
        yield "dark: no light reaches the camera; see flux_W of the leds"


def _trust(frames: Sequence[Frame]) -> Iterator[str]:
    """Yield how the mechanics were computed, how far off the tared displacement may be, and the light."""
    ways = [mechanics_in_words(frame.fem) for frame in frames]
    for way in dict.fromkeys(ways):
        where = ""
        if len(set(ways)) > 1:
            depths = (
                f.press["indentation_mm"] for f, found in zip(frames, ways, strict=True) if found == way
            )
            where = " at " + ", ".join(f"{depth:.3g}" for depth in depths) + " mm"
        yield f"mechanics: {way}{where}"
    if frames[0].inclusion is not None:
        errors = [frame.fem["error_percent"] for frame in frames]
        largest = None if None in errors else max(errors)
        told = percent_in_words(largest, " of the tared displacement's maximum")
        what = "estimated error of the mesh"
        if frames[0].fem["path"] == "multipoles":
            what = "what the last multipoles change"
        if frames[0].fem["mechanics"] == "emulator":
            what = "95 % of held-out solves were met within"
        yield f"{what}: {told}"
    worst = max(frame.tsis["noise_percent"] for frame in frames)
    yield f"noise of the light: {worst:.2g} % of its mean (rms of a pixel, Monte Carlo)"
    yield bias_in_words(frames[0].tsis)


def _title(frame: Frame) -> str:
    inclusion = frame.inclusion
    title = f"{frame.design.name}, "
    title += "no inclusion" if inclusion is None else f"inclusion {inclusion_in_words(inclusion)}"
    tilt, position = frame.press["tilt_deg"], frame.press["position_mm"]
    if inclusion is not None and any(inclusion.offset):
        title += f", off centre by ({inclusion.offset[0]:g}, {inclusion.offset[1]:g}) mm"
    if any(tilt):
        title += f", tilted by ({tilt[0]:g}, {tilt[1]:g})°"
    if any(position):
        title += f", sensor at ({position[0]:g}, {position[1]:g}) mm"
    return title
