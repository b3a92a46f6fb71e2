"""The picture of an estimate: what was seen and expected, and what is known of the inclusion after it.

One sheet: for each press level the picture, the tared counts that were seen and those expected at the
posterior mean, and their difference over its noise; beside them the posterior, parameter by parameter and
pair by pair, with the ranges that the model was trained for. Same estimate, same bytes.
"""

from __future__ import annotations

import io
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from scenes.exr import write_bytes
from twin.estimates import Estimate, decimals, probability
from twin.frame import grey
from twin.panels import FAINT, INK, scale_bar
from twin.pictures import DPI, HEIGHT_PX, STYLE, WIDTH_PX
from twin.posterior_figure import draw_corner
from twin.received import Received

BLUE, RED, GREY = "#2b6ca3", "#c2452d", "#dddddd"

_SHOWN = 3  # press levels, at most
_STRANGE = 4.0  # standard deviations that the colours of the residual span
_TITLES = ("Picture", "Tared, seen", "Tared, expected", "Seen minus expected")


@dataclass(frozen=True, eq=False)
class Sheet:
    """What is drawn of an estimate."""

    estimate: Estimate
    received: Received
    ranges: Mapping[str, Sequence[float]]
    """Of each parameter, as the model was trained for."""
    field_mm: tuple[float, float]
    """Width and height of the picture at the contact surface."""
    indentation_mm: Sequence[float]
    """Press levels."""
    refuse_below: float
    """Likeness below which pictures are refused."""
    notes: Sequence[str]
    """Lines at the sheet's foot, such as the model's name."""


def overview(sheet: Sheet, path: Path) -> None:
    """Draw an estimate into a PNG of 1800 x 1200 pixels.

    Raises `scenes.exr.ImageError` where the file cannot be written.
    """
    with mpl.rc_context():
        mpl.rcdefaults()  # a user's own matplotlibrc must not change the picture
        mpl.rcParams.update(STYLE)
        canvas = FigureCanvasAgg(Figure(figsize=(WIDTH_PX / DPI, HEIGHT_PX / DPI), dpi=DPI))
        _draw(canvas.figure, sheet)
        stream = io.BytesIO()
        with warnings.catch_warnings():  # a file may have a name that the sheet's type cannot write
            warnings.filterwarnings("ignore", r"Glyph \d+ .*missing from font", UserWarning)
            canvas.print_png(stream, metadata={"Software": None})
    write_bytes(path, stream.getvalue())


def _draw(figure: Figure, sheet: Sheet) -> None:
    estimate, received = sheet.estimate, sheet.received
    figure.text(0.03, 0.967, _headline(estimate), fontsize=11.5, fontweight="bold", va="top")
    exposures = [
        f"{count} exposure{'' if count == 1 else 's'}"
        for count in (received.frames, received.reference_frames)
    ]
    below = (
        f"mean and standard deviation of the posterior  ·  pictures of {exposures[0]}, "
        f"references of {exposures[1]}"
    )
    figure.text(0.03, 0.932, below, fontsize=7.5, color=FAINT, va="top")
    levels = _levels(len(estimate.observed))
    if len(levels) == 1:
        places = [
            (0.055 + 0.3 * column, 0.50 - 0.40 * row, 0.27, 0.33) for row in (0, 1) for column in (0, 1)
        ]
        _level(figure, sheet, levels[0], places, titles=True)
    for row, level in enumerate(levels if len(levels) > 1 else ()):
        step = 0.275 if len(levels) == 3 else 0.36
        places = [(0.045 + 0.148 * column, 0.885 - step * (row + 1), 0.134, 0.235) for column in range(4)]
        _level(figure, sheet, level, places, titles=row == 0)
    draw_corner(figure, estimate, sheet.ranges, (0.69, 0.105, 0.293, 0.735))
    _gauges(figure, sheet)
    for number, line in enumerate(sheet.notes):
        figure.text(0.03, 0.032 - 0.016 * number, line, fontsize=6, color=FAINT)


def _headline(estimate: Estimate) -> str:
    sd = np.sqrt(np.diag(estimate.covariance))
    size, depth, modulus = (
        f"{value:.{decimals(apart)}f} ± {apart:.{decimals(apart)}f}"
        for value, apart in zip(estimate.mean, sd, strict=True)
    )
    what = f"{size} mm wide, top {depth} mm deep, {modulus} kPa"
    if estimate.presence >= 0.5:
        return f"Inclusion, {what}"
    return f"Probably no inclusion; if there is one, {what}"


def _levels(count: int) -> list[int]:
    """Which levels are shown: all, or the first, the middle and the last."""
    if count <= _SHOWN:
        return list(range(count))
    return [round(step * (count - 1) / (_SHOWN - 1)) for step in range(_SHOWN)]


def _level(
    figure: Figure, sheet: Sheet, level: int, places: Sequence[tuple[float, ...]], *, titles: bool
) -> None:
    """Four panels of one press level, each as large as its place allows."""
    estimate, received = sheet.estimate, sheet.received
    width, height = sheet.field_mm
    extent = (-width / 2, width / 2, -height / 2, height / 2)
    panels = []
    for (left, low, wide, tall), title in zip(places, _TITLES, strict=True):
        across = wide * WIDTH_PX
        up = min(across * height / width, 0.8 * tall * HEIGHT_PX)
        across = up * width / height
        axes = figure.add_axes((left, low + tall - up / HEIGHT_PX, across / WIDTH_PX, up / HEIGHT_PX))
        axes.set_xticks([])
        axes.set_yticks([])
        if titles:
            axes.set_title(title)
        panels.append(axes)
    brightest = max(float(received.images.max()), 1.0)
    image = np.asarray(received.images[level], np.float64)
    shown = image if image.ndim == 2 else image / brightest
    drawn = panels[0].imshow(
        shown, cmap="gray", vmin=0, vmax=brightest, extent=extent, interpolation="antialiased"
    )
    if image.ndim == 2:
        _bar_below(panels[0], drawn, "counts")
    corner = image[-max(len(image) // 6, 1) :, : max(image.shape[1] // 3, 1)].mean()
    scale_bar(panels[0], extent[0] + 1, extent[2] + 1, 5.0, "white" if corner < brightest / 2 else INK)
    panels[0].set_ylabel(f"{sheet.indentation_mm[level]:g} mm", fontsize=8, fontweight="bold")
    seen, expected = estimate.observed[level], estimate.predicted[level]
    limit = max(float(np.abs(seen).max()), float(np.abs(expected).max()), 1e-9)
    for axes, counts in zip(panels[1:3], (seen, expected), strict=True):
        drawn = axes.imshow(
            grey(counts), cmap="RdBu_r", vmin=-limit, vmax=limit, extent=extent, interpolation="nearest"
        )
        _bar_below(axes, drawn, "counts")
    strange = grey((seen - expected) / estimate.noise[level])
    drawn = panels[3].imshow(
        strange, cmap="PuOr_r", vmin=-_STRANGE, vmax=_STRANGE, extent=extent, interpolation="nearest"
    )
    rms = float(np.sqrt(np.mean(strange**2)))
    _bar_below(panels[3], drawn, f"standard deviations; rms {rms:.2f}", extend="both")


def _bar_below(axes: Axes, drawn: Any, label: str, extend: str = "neither") -> None:
    below = axes.inset_axes((0.0, -0.1, 1.0, 0.045))
    bar = axes.figure.colorbar(drawn, cax=below, orientation="horizontal", extend=extend)
    bar.outline.set_linewidth(0.5)
    bar.set_label(label, fontsize=6.5, labelpad=1)
    bar.locator = MaxNLocator(5, prune="both")
    bar.update_ticks()
    below.tick_params(labelsize=6.5, length=2, pad=1)


def _gauges(figure: Figure, sheet: Sheet) -> None:
    """Probability of an inclusion and likeness, as bars from 0 to 1."""
    estimate = sheet.estimate
    rows = (
        ("an inclusion is there", probability(estimate.presence), estimate.presence, None),
        ("likeness", f"{estimate.likeness:.2g}", estimate.likeness, sheet.refuse_below),
    )
    axes = figure.add_axes((0.835, 0.675, 0.148, 0.165))
    axes.set_axis_off()
    axes.set_xlim(0, 1)
    axes.set_ylim(0, 1)
    for number, (name, text, value, limit) in enumerate(rows):
        top = 0.97 - 0.36 * number
        axes.text(0, top, name, va="top")
        axes.text(1, top, text, va="top", ha="right", fontweight="bold")
        axes.barh(top - 0.17, 1.0, 0.07, color=GREY)
        axes.barh(top - 0.17, value, 0.07, color=BLUE)
        if limit is not None:
            axes.plot([limit, limit], [top - 0.22, top - 0.12], color=RED, lw=1.2)
    explained = (
        "likeness: share of valid pictures that are less\n"
        f"like the model's than these; refused below {sheet.refuse_below:g}"
    )
    axes.text(0, 0.3, explained, fontsize=5.5, color=FAINT, va="top", linespacing=1.4)
