"""The picture of an assessment: estimates against the truth, and how well each says how sure it is."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.ticker import LogFormatter, NullLocator
from numpy.typing import NDArray
from scipy import stats

from twin.assess import LEAST_MM
from twin.report import BLUE, GREY, INK, RED, panels

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from twin.assessment import Answered

_LABELS = ("size d / mm", "depth h / mm", "modulus E / kPa")
_COLOURS = (BLUE, RED)
_KOLMOGOROV = 1.358
"""Largest distance of a distribution of n draws from its own, times sqrt(n), in 95 % of cases."""
_MOST = 97.0  # per cent of the intervals that errors are drawn to the ends of


def draw(
    answered: Mapping[int, Answered], ranges: NDArray[np.float64], tissue_kPa: float, place: Path
) -> None:
    """Draw answers by exposures, `ranges` (5, 2) of the parameters, into a PNG file."""
    figure, axes = panels(2, 3, 3.5)
    _errors(axes[0], answered, ranges[0], 0, "error of size d / mm")
    _errors(axes[1], answered, ranges[1], 1, "error of depth h / mm")
    axes[2].plot(ranges[2], ranges[2], color=GREY, lw=0.8)
    for (_, one), colour in zip(answered.items(), _COLOURS, strict=False):
        _bars(axes[2], one, 2, 0.0, colour)
    wide = _wider(ranges[2])
    axes[2].set(xlabel=f"true {_LABELS[2]}", ylabel=f"estimated {_LABELS[2]}", xlim=wide, ylim=wide)
    axes[0].legend(frameon=False, fontsize=8)
    _widths(axes[3], answered, ranges, tissue_kPa)
    _ratios(axes[4], answered)
    _ranks(axes[5], answered)
    for axis in axes:
        axis.title.set_fontsize(9)
    figure.savefig(place, dpi=130)


def _errors(
    axis: Axes, answered: Mapping[int, Answered], span: NDArray[np.float64], number: int, label: str
) -> None:
    """Estimate minus truth, which beside the truth itself would be too small to see."""
    axis.axhline(0.0, color=GREY, lw=0.8)
    reach, beyond = 0.0, 0
    for (frames, one), colour in zip(answered.items(), _COLOURS, strict=False):
        truth = one.truth[:, number]
        _bars(axis, one, number, truth, colour, _exposures(frames))
        ends = np.abs([one.answers.low[:, number] - truth, one.answers.high[:, number] - truth]).max(axis=0)
        reach = max(reach, 1.1 * float(np.percentile(ends, _MOST)))
    for one in answered.values():
        beyond += int((np.abs(one.answers.mean[:, number] - one.truth[:, number]) > reach).sum())
    title = f"{beyond} farther off are not shown" if beyond else ""
    axis.set(xlabel=f"true {_LABELS[number]}", ylabel=label, title=title)
    axis.set(xlim=_wider(span), ylim=(-reach, reach))


def _wider(span: NDArray[np.float64]) -> tuple[float, float]:
    """A range and a little more, so that what lies at its ends is seen."""
    low, high = span
    return low - 0.03 * (high - low), high + 0.03 * (high - low)


def _bars(
    axis: Axes,
    one: Answered,
    number: int,
    less: NDArray[np.float64] | float,
    colour: str,
    label: str | None = None,
) -> None:
    """Means with their 90 % intervals, less so much, over the truth."""
    mean = one.answers.mean[:, number]
    off = np.abs([one.answers.low[:, number], one.answers.high[:, number]] - mean)
    look = {"fmt": "o", "ms": 2.2, "color": colour, "ecolor": colour, "elinewidth": 0.5, "alpha": 0.6}
    axis.errorbar(_aside(one.truth[:, number]), mean - less, off, label=label, **look)


def _aside(truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inclusions that are truly alike side by side, not one over the other."""
    _, group, count = np.unique(truth, return_inverse=True, return_counts=True)
    turn = np.empty(len(truth))
    for number in range(len(count)):
        rows = np.flatnonzero(group == number)
        turn[rows] = np.arange(len(rows)) - 0.5 * (len(rows) - 1)
    return np.asarray(truth + 0.012 * np.ptp(truth) * turn)


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
    for each in (axis.xaxis, axis.yaxis):  # 60, not 6 x 10^1
        each.set_major_formatter("{x:g}")
        each.set_minor_formatter(LogFormatter())
    axis.set(
        xlabel="d³ (E/E₀ - 1)/(E/E₀ + 1.5) / mm³",
        ylabel="width of E's 90 % interval / kPa",
        title="how sure it says it is of E",
    )


def _ratios(axis: Axes, answered: Mapping[int, Answered]) -> None:
    """With the 90 % that errors of so few inclusions leave open, as if they were normal."""
    edges = np.array([LEAST_MM, 6.0, 8.0, 10.0, 13.0])
    middle, lines = 0.5 * (edges[:-1] + edges[1:]), list(itertools.product(answered, range(3)))
    least, most = 0.5, 2.0
    for place, (frames, number) in enumerate(lines):
        one, colour = answered[frames], _COLOURS[list(answered).index(frames) % len(_COLOURS)]
        error, found = one.answers.mean[:, number] - one.truth[:, number], np.full((3, len(middle)), np.nan)
        for column, (low, high) in enumerate(itertools.pairwise(edges)):
            rows = (one.truth[:, 0] >= low) & (one.truth[:, 0] < high)
            if count := int(rows.sum()):
                ratio = np.sqrt(np.mean(error[rows] ** 2) / np.nanmean(one.limits[rows, number] ** 2))
                ends = np.sqrt(count / stats.chi2.ppf([0.95, 0.05], count))
                found[:, column] = ratio, *(ratio * ends)
        least = min(least, float(np.nanmin(found[1:], initial=np.inf)))
        most = max(most, float(np.nanmax(found[1:], initial=0.0)))
        aside = 0.22 * (place - 0.5 * (len(lines) - 1))
        off = np.abs(found[1:] - found[0])
        look = {"fmt": "osD"[number], "ms": 3.5, "color": colour, "elinewidth": 0.7}
        axis.errorbar(middle + aside, found[0], off, label=f"{'dhE'[number]}, {_exposures(frames)}", **look)
    axis.axhline(1.0, color=GREY, lw=0.8)
    for edge in edges[1:-1]:
        axis.axvline(edge, color=GREY, lw=0.4, ls=":")
    axis.set(
        xlabel="true size d / mm, in four classes",
        ylabel="RMSE over the bound",
        title="how near the bound (bars: 90 %)",
        xlim=(edges[0], edges[-1]),
        yscale="log",
        ylim=(0.45 * least, 1.1 * most),  # the legend has the room below
    )
    axis.set_yticks([tick for tick in 2.0 ** np.arange(-4, 8) if 0.45 * least < tick < 1.1 * most])
    axis.yaxis.set_major_formatter("{x:g}")
    axis.yaxis.set_minor_locator(NullLocator())
    axis.legend(frameon=False, fontsize=7, ncols=2, loc="lower center")


def _ranks(axis: Axes, answered: Mapping[int, Answered]) -> None:
    """Distribution of the truth's place in the posterior, which says something of few inclusions, too."""
    even = np.linspace(0.0, 1.0, 101)
    axis.plot(even, even, color=GREY, lw=0.8)
    for (_, one), colour in zip(answered.items(), _COLOURS, strict=False):
        count = len(one.truth)
        chance = _KOLMOGOROV / np.sqrt(max(count, 1))
        axis.fill_between(even, even - chance, even + chance, color=colour, alpha=0.08, lw=0)
        for number, style in enumerate(("-", "--", ":")):
            rank = np.sort(one.answers.rank[:, number])
            axis.step(
                [0.0, *rank, 1.0],
                [0.0, *np.arange(1, count + 1) / count, 1.0],
                style,
                where="post",
                color=colour,
            )
    axis.set(
        xlabel="share of the posterior below the truth",
        ylabel="share of inclusions",
        title="on the diagonal if intervals are right (d -, h --, E ·)\nshaded: strays farther in 1 of 20",
        xlim=(0, 1),
        ylim=(0, 1),
    )


def _exposures(frames: int) -> str:
    return f"{frames} exposure{'s' * (frames > 1)}"
