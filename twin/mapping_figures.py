"""Figures of `twin map`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from twin.mapping import PAIRS, Mapped
from twin.mapping_verdict import state_of
from twin.report import BLUE, GREEN, GREY, INK, RED, panels
from twin.thresholds import SIGMAS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from twin.mapping_report import One

_WORDS = {"max": "maximum", "total": "total", "area": "area"}
_SURFACE = {"max": "surface's maximum, µm", "total": "surface's total, mm³", "area": "surface's area, mm²"}
_PICTURE = {
    "max": "picture's maximum, counts",
    "total": "picture's total, 10⁶ counts",
    "area": "picture's area, 10³ px",
}
_MANY = 800  # points above which dots become pixels in the page
_COLOURS = (BLUE, RED, GREEN)


def scatter(one: One) -> Figure:
    """Draw the three regressions (Fig. 5 a to c) in units."""
    figure, axes = panels(1, 3, 3.5)
    dots: Any = None
    for axis, mapped, letter in zip(axes, one.shown(), "abc", strict=True):
        dots = _dots(axis, one, mapped, mapped.y) or dots
        _name(axis, mapped, letter)
        if mapped.fit is None:
            axis.text(
                0.5,
                0.5,
                mapped.why,
                ha="center",
                va="center",
                transform=axis.transAxes,
                fontsize=8.5,
                wrap=True,
            )
            continue
        across = np.linspace(mapped.x.min(), mapped.x.max(), 100)
        low, high = mapped.fit.line.fit.prediction(across)
        if mapped.fit.range is not None:
            axis.axvspan(*mapped.fit.range, color="#f0f0f0", zorder=0, lw=0)
        axis.fill_between(across, low, high, color=BLUE, alpha=0.13, lw=0)
        axis.plot(across, mapped.fit.line(across), color=BLUE, lw=1.6)
        axis.plot(across, mapped.fit.parabola(across), color=RED, lw=1.2, ls="--")
        told = (
            f"R² = {mapped.fit.line.r2:.3f}\nleave-one-out {100 * mapped.fit.error:.1f} %\n{state_of(mapped)}"
        )
        axis.text(0.03, 0.97, told, transform=axis.transAxes, va="top", fontsize=8.5, color=INK)
        axis.set_ylim(top=axis.get_ylim()[1] + 0.12 * np.ptp(axis.get_ylim()))
    _depth_bar(figure, axes, dots)
    return figure


def residuals(one: One) -> Figure:
    """Draw what the lines leave, per cent of the picture's span."""
    figure, axes = panels(1, 3, 2.7)
    dots: Any = None
    for axis, mapped, letter in zip(axes, one.shown(), "abc", strict=True):
        _name(axis, mapped, letter)
        axis.set_ylabel("residual, % of span" if letter == "a" else "")
        if mapped.fit is None:
            continue
        left = 100.0 * mapped.fit.line.fit.residual / np.ptp(mapped.y)
        dots = _dots(axis, one, mapped, left) or dots
        axis.axhline(0.0, color=BLUE, lw=1.2)
        for limit in (-5.0, 5.0):
            axis.axhline(limit, color=GREY, lw=0.9, ls=":")
    _depth_bar(figure, axes, dots)
    return figure


def levels(maps: Sequence[Mapped]) -> Figure:
    """Draw R², leave-one-out error and slope against the press level, tared and raw."""
    figure, axes = panels(1, 3, 3.0)
    first: dict[str, float] = {}
    for pair, colour in zip(PAIRS, _COLOURS, strict=True):
        for kind, dash in (("tared", "-"), ("raw", "--")):
            some = [one for one in maps if one.kind == kind and one.pair == pair and one.fit is not None]
            at = [one.level_mm for one in some]
            fits = [one.fit for one in some if one.fit is not None]
            if not fits:
                continue
            first.setdefault(pair.name, fits[0].line.slope)
            for axis, values in zip(
                axes,
                (
                    [fit.line.r2 for fit in fits],
                    [100 * fit.error for fit in fits],
                    [fit.line.slope / first[pair.name] for fit in fits],
                ),
                strict=True,
            ):
                if axis is axes[2] and kind == "raw" and pair.name == "max":
                    continue  # a slope of a scatter: it would squeeze the others
                axis.plot(at, values, dash, marker="o", ms=4.5, color=colour, lw=1.4)
    for axis, words in zip(
        axes, ("R²", "leave-one-out error, % of span", "slope over that of the shallowest"), strict=True
    ):
        axis.set_xlabel("press, mm")
        axis.set_ylabel(words)
        axis.set_xticks(sorted({one.level_mm for one in maps}))
    axes[0].set_ylim(-0.03, 1.03)
    axes[1].set_ylim(bottom=0)
    axes[1].axhline(5.0, color=GREY, lw=0.9, ls=":")
    handles = [
        Line2D([], [], color=c, lw=2, label=_WORDS[pair.name])
        for pair, c in zip(PAIRS, _COLOURS, strict=True)
    ]
    handles += [
        Line2D([], [], color=INK, ls=dash, label=kind) for kind, dash in (("tared", "-"), ("raw", "--"))
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=5, frameon=False, fontsize=8.5)
    return figure


def thresholds(one: One) -> Figure:
    """Draw what is seen, and how good the lines of maximum and area are, against the picture's k."""
    figure, axes = panels(1, 3, 2.9)
    at = [k.k_dn for k in one.ks]
    axes[0].plot(at, [k.unseen_percent for k in one.ks], "o-", color=INK, ms=4.5, lw=1.4)
    axes[0].set_ylabel("inclusions unseen, %")
    axes[0].set_ylim(-2, 102)
    for name, colour in (("max", BLUE), ("area", GREEN)):
        axes[1].plot(
            at,
            [getattr(k, f"r2_{name}") for k in one.ks],
            "o-",
            color=colour,
            ms=4.5,
            lw=1.4,
            label=_WORDS[name],
        )
        axes[2].plot(at, [getattr(k, f"error_{name}") for k in one.ks], "o-", color=colour, ms=4.5, lw=1.4)
    axes[1].set_ylabel("R² of the line")
    axes[1].set_ylim(-0.03, 1.03)
    axes[1].legend(frameon=False, fontsize=8.5)
    axes[2].set_ylabel("leave-one-out error, % of span")
    axes[2].set_ylim(bottom=0)
    design = one.corpus.design.signal.counts
    for axis in axes:
        axis.set_xlabel("threshold k of the picture, counts")
        axis.axvline(SIGMAS * one.swept.noise_dn, color=GREY, lw=1, ls=":")
        axis.axvline(design, color=RED, lw=1, ls="-", alpha=0.6)
    axes[0].annotate(
        "the design's k", (design, 60), xytext=(4, 0), textcoords="offset points", fontsize=8, color=RED
    )
    return figure


def compared(found: Sequence[One]) -> Figure:
    """Draw the lines of several corpora together."""
    from matplotlib import colormaps

    figure, axes = panels(1, 3, 3.5)
    for number, one in enumerate(found):
        colour = colormaps["tab10"](number % 10)
        for axis, mapped, letter in zip(axes, one.shown(), "abc", strict=True):
            _name(axis, mapped, letter)
            axis.plot(
                mapped.x,
                mapped.y,
                "o",
                ms=3,
                mew=0,
                alpha=0.45,
                color=colour,
                rasterized=len(mapped.x) > _MANY,
            )
            if mapped.fit is not None:
                ends = np.array([mapped.x.min(), mapped.x.max()])
                axis.plot(ends, mapped.fit.line(ends), color=colour, lw=1.8)
    handles = [
        Line2D([], [], color=colormaps["tab10"](n % 10), lw=2, label=f"{one.label}, {one.level_mm:g} mm")
        for n, one in enumerate(found)
    ]
    figure.legend(handles=handles, loc="outside upper left", ncols=4, frameon=False, fontsize=8.5)
    return figure


def _dots(axis: Axes, one: One, mapped: Mapped, y: Any) -> Any:
    if not len(mapped.x):
        return None
    depth = [one.depth.get(int(sample), np.nan) for sample in mapped.sample]
    every = [value for value in one.depth.values() if np.isfinite(value)]
    return axis.scatter(
        mapped.x,
        y,
        c=depth,
        s=16,
        lw=0,
        alpha=0.9,
        cmap="viridis",
        vmin=min(every, default=0),
        vmax=max(every, default=1),
        zorder=3,
        rasterized=len(mapped.x) > _MANY,
    )


def _depth_bar(figure: Figure, axes: Sequence[Axes], dots: Any) -> None:
    if dots is not None:
        bar = figure.colorbar(dots, ax=list(axes), pad=0.01, aspect=30)
        bar.set_label("depth of the top, mm", fontsize=9)
        bar.ax.tick_params(labelsize=8)
        bar.outline.set_visible(False)


def _name(axis: Axes, mapped: Mapped, letter: str) -> None:
    axis.set_title(f"({letter}) {_WORDS[mapped.pair.name]}", loc="left", fontsize=10, color=INK)
    axis.set_xlabel(_SURFACE[mapped.pair.name])
    axis.set_ylabel(_PICTURE[mapped.pair.name])
