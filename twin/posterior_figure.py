"""A posterior as a corner plot: parameters alone and in pairs, beside what the model was trained for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, gaussian_filter1d

from twin.estimates import Estimate, decimals
from twin.panels import FAINT, INK

BLUE, MIDDLE, PALE, GREY = "#2b6ca3", "#8db3d3", "#d6e4f0", "#bbbbbb"
LABELS = {"size_mm": "size d, mm", "depth_mm": "depth h, mm", "modulus_kPa": "modulus E, kPa"}

_BINS, _SMOOTH = 50, 1.8
_WIDER = 2.0  # width of the axes over that of the central 98 % of the samples


def draw_corner(
    figure: Figure,
    estimate: Estimate,
    ranges: Mapping[str, Sequence[float]],
    box: tuple[float, float, float, float],
) -> None:
    """Fill a box of the figure (left, low, width, height, as shares of it).

    Axes span the posterior, within ``ranges``; over each parameter a grey bar is its whole range, and the
    blue part of it the central 90 %.
    """
    left, low, width, height = box
    count, gap = len(estimate.names), 0.014
    wide, tall = (width - (count - 1) * gap) / count, (height - (count - 1) * 3.4 * gap) / count
    spans = [_span(estimate.samples[:, index], ranges[name]) for index, name in enumerate(estimate.names)]
    for row in range(count):
        for column in range(row + 1):
            bottom = low + (count - 1 - row) * (tall + 3.4 * gap)
            axes = figure.add_axes((left + column * (wide + gap), bottom, wide, tall))
            if row == column:
                _single(axes, estimate, row, spans[row], ranges[estimate.names[row]])
            else:
                _couple(axes, estimate, (column, row), (spans[column], spans[row]))
            axes.tick_params(labelsize=6.5)
            axes.xaxis.set_major_locator(MaxNLocator(4))
            axes.set_xlim(*spans[column])
            if row == count - 1:
                axes.set_xlabel(LABELS.get(estimate.names[column], estimate.names[column]))
            else:
                axes.set_xticklabels([])
            if column == 0 and row:
                axes.set_ylabel(LABELS.get(estimate.names[row], estimate.names[row]))
            elif row != column:
                axes.set_yticklabels([])
    lines = (
        "shaded, and blue in the bar of the whole range: central 90 %; dotted: even over that range;",
        "contours: 50 and 90 % of the probability; cross: mean",
    )
    figure.text(left, low - 0.055, "\n".join(lines), fontsize=5.5, color=FAINT, va="top", linespacing=1.4)


def _span(samples: NDArray[np.float64], given: Sequence[float]) -> tuple[float, float]:
    """What the axes show: the posterior with some room, but nothing beyond the range."""
    low, high = np.quantile(samples, [0.01, 0.99])
    room = max((_WIDER - 1) / 2 * (high - low), 1e-3 * (given[1] - given[0]))
    return max(float(low - room), given[0]), min(float(high + room), given[1])


def _single(
    axes: Axes, estimate: Estimate, index: int, span: tuple[float, float], given: Sequence[float]
) -> None:
    values, (below, above) = estimate.samples[:, index], estimate.interval[index]
    counts, edges = np.histogram(values, bins=_BINS, range=span)
    # mirrored at the ends of the axes, so that nothing leaks over the end of a range
    density = gaussian_filter1d(counts / (len(values) * (edges[1] - edges[0])), _SMOOTH, mode="reflect")
    middle = (edges[1:] + edges[:-1]) / 2
    axes.axvspan(below, above, color=PALE, lw=0)
    axes.plot(middle, density, color=BLUE, lw=1.1)
    even = 1 / (given[1] - given[0])
    axes.axhline(even, color=INK, lw=0.8, ls=(0, (1, 2)))
    axes.axvline(estimate.mean[index], color=BLUE, lw=0.8)
    axes.set_ylim(0, 1.1 * max(float(density.max()), even))
    axes.set_yticks([])
    name, digits = estimate.names[index], decimals(float(np.sqrt(estimate.covariance[index, index])))
    numbers = [f"{value:.{digits}f}" for value in (estimate.mean[index], below, above)]
    text = f"{LABELS.get(name, name)}\n{numbers[0]}  ({numbers[1]} to {numbers[2]})"
    axes.set_title(text, fontsize=7, fontweight="normal", pad=13)
    _in_range(axes, (below, above), given)


def _in_range(axes: Axes, interval: tuple[float, float], given: Sequence[float]) -> None:
    """A bar over the panel: the whole range, and the interval in it."""
    bar = axes.inset_axes((0.12, 1.02, 0.74, 0.05))
    bar.set_axis_off()
    bar.set_xlim(*given)
    bar.set_ylim(-1, 1)
    bar.plot(given, [0, 0], color=GREY, lw=3, solid_capstyle="butt")
    # Never so short that it cannot be seen.
    least = 0.02 * (given[1] - given[0])
    middle, half = sum(interval) / 2, max(interval[1] - interval[0], least) / 2
    bar.plot([middle - half, middle + half], [0, 0], color=BLUE, lw=3, solid_capstyle="butt")
    for place, value, side in zip((-0.04, 1.04), given, ("right", "left"), strict=True):
        style = {"fontsize": 6, "color": FAINT, "ha": side, "va": "center_baseline"}
        bar.text(place, 0.5, f"{value:g}", transform=bar.transAxes, **style)


def _couple(
    axes: Axes,
    estimate: Estimate,
    pair: tuple[int, int],
    spans: tuple[tuple[float, float], tuple[float, float]],
) -> None:
    x, y = (estimate.samples[:, index] for index in pair)
    counts, across, up = np.histogram2d(x, y, bins=_BINS, range=[list(span) for span in spans])
    smooth = gaussian_filter(counts, _SMOOTH, mode="reflect")
    order = np.sort(smooth, axis=None)[::-1]
    inside = np.cumsum(order) / max(float(order.sum()), 1e-300)
    levels = sorted({float(order[np.searchsorted(inside, share)]) for share in (0.9, 0.5)})
    middle = [(edges[1:] + edges[:-1]) / 2 for edges in (across, up)]
    if levels[0] > 0:
        filled = [*levels, float(order[0]) * 1.001]
        axes.contourf(*middle, smooth.T, levels=filled, colors=[PALE, MIDDLE][-len(levels) :])
        axes.contour(*middle, smooth.T, levels=levels, colors=[BLUE], linewidths=0.7)
    axes.plot(*(estimate.mean[index] for index in pair), "+", color=INK, ms=5, mew=0.8)
    axes.set_ylim(*spans[1])
    axes.yaxis.set_major_locator(MaxNLocator(4))
