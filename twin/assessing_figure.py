"""The picture of an assessment: estimates against the truth, and how well each says how sure it is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from twin.assess import LEAST_MM
from twin.report import BLUE, GREY, INK, RED, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from twin.assessment import Answered

_LABELS = ("size d / mm", "depth h / mm", "modulus E / kPa")
_COLOURS = (BLUE, RED)
_BINS = 10


def draw(
    answered: Mapping[int, Answered], ranges: NDArray[np.float64], tissue_kPa: float, place: Path
) -> None:
    """Draw answers by exposures, `ranges` (5, 2) of the parameters, into a PNG file."""
    figure, axes = panels(2, 3, 3.5)
    for number, (axis, label) in enumerate(zip(axes, _LABELS, strict=False)):
        axis.plot(ranges[number], ranges[number], color=GREY, lw=0.8)
        for (frames, one), colour in zip(answered.items(), _COLOURS, strict=False):
            mean, truth = one.answers.mean[:, number], one.truth[:, number]
            off = np.abs([one.answers.low[:, number], one.answers.high[:, number]] - mean)
            axis.errorbar(
                truth,
                mean,
                off,
                fmt="o",
                ms=2.2,
                color=colour,
                ecolor=colour,
                elinewidth=0.5,
                alpha=0.6,
                label=_exposures(frames),
            )
        axis.set(
            xlabel=f"true {label}", ylabel=f"estimated {label}", xlim=ranges[number], ylim=ranges[number]
        )
    axes[0].legend(frameon=False, fontsize=8)
    _widths(axes[3], answered, ranges, tissue_kPa)
    _ratios(axes[4], answered)
    _ranks(axes[5], answered)
    for axis in axes:
        axis.title.set_fontsize(9)
    figure.savefig(place, dpi=130)


def _widths(
    axis: Axes, answered: Mapping[int, Answered], ranges: NDArray[np.float64], tissue_kPa: float
) -> None:
    for (_, one), colour in zip(answered.items(), _COLOURS, strict=False):
        size, _, modulus = one.truth.T
        ratio = modulus / tissue_kPa
        signal = size**3 * (ratio - 1.0) / (ratio + 1.5)
        width = one.answers.high[:, 2] - one.answers.low[:, 2]
        axis.loglog(signal, width, "o", ms=2.6, color=colour, alpha=0.6)
    axis.axhline(0.9 * np.ptp(ranges[2]), color=GREY, lw=0.8)
    axis.annotate(
        "nothing known",
        (0.02, 0.9 * np.ptp(ranges[2])),
        (0, 3),
        ("axes fraction", "data"),
        "offset points",
        fontsize=7.5,
        color=INK,
    )
    axis.set(
        xlabel="d³ (E/E₀ - 1)/(E/E₀ + 1.5) / mm³",
        ylabel="width of E's 90 % interval / kPa",
        title="how sure it says it is of E",
    )


def _ratios(axis: Axes, answered: Mapping[int, Answered]) -> None:
    edges = np.array([LEAST_MM, 6.0, 8.0, 10.0, 13.0])
    for (frames, one), colour in zip(answered.items(), _COLOURS, strict=False):
        for number, (style, name) in enumerate((("-", "d"), ("--", "h"), (":", "E"))):
            error = one.answers.mean[:, number] - one.truth[:, number]
            found = []
            for low, high in itertools.pairwise(edges):
                rows = (one.truth[:, 0] >= low) & (one.truth[:, 0] < high)
                least = np.nanmean(one.limits[rows, number] ** 2) if rows.any() else np.nan
                found.append(np.sqrt(np.mean(error[rows] ** 2) / least) if rows.any() else np.nan)
            middle = 0.5 * (edges[:-1] + edges[1:])
            axis.plot(middle, found, style, color=colour, label=f"{name}, {_exposures(frames)}")
    axis.axhline(1.0, color=GREY, lw=0.8)
    axis.set(
        xlabel="true size d / mm", ylabel="RMSE over the bound", title="how near the bound", ylim=(0, None)
    )
    axis.legend(frameon=False, fontsize=7, ncols=2)


def _ranks(axis: Axes, answered: Mapping[int, Answered]) -> None:
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    for (_, one), colour in zip(answered.items(), _COLOURS, strict=False):
        for number, style in enumerate(("-", "--", ":")):
            count = np.histogram(one.answers.rank[:, number], edges)[0] / max(len(one.truth), 1) * _BINS
            axis.stairs(count, edges, color=colour, ls=style)
    axis.axhline(1.0, color=GREY, lw=0.8)
    axis.set(
        xlabel="share of the posterior below the truth",
        ylabel="density of inclusions",
        title="flat if intervals are right (d -, h --, E ·)",
        ylim=(0, None),
    )


def _exposures(frames: int) -> str:
    return f"{frames} exposure{'s' * (frames > 1)}"
