"""Figures of a corpus's card: pictures, histograms, correlations, errors; to be read at a laptop's width."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.corpus import Corpus
from twin.corpus_files import INCLUSION

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_ROWS, _COLUMNS = 4, 6  # of the montage
_MOST_HISTOGRAMS = 20
_MOST_POINTS = 5000  # of a scatter, drawn at even distances
_INK, _BAR = "#222222", "#3b6ea5"
_WORDS = {
    "size_mm": "size, mm",
    "depth_mm": "depth to the top, mm",
    "modulus_kPa": "modulus, kPa",
    "offset_x_mm": "offset along x, mm",
    "offset_y_mm": "offset along y, mm",
    "force_N": "force, N",
}


def varied(corpus: Corpus) -> list[str]:
    """Return which columns of the inclusion are not the same for all samples."""
    found = []
    for name in INCLUSION:
        values = corpus.table[name].to_numpy()[:: corpus.levels]
        values = values[np.isfinite(values)]
        if values.size and np.ptp(values) > 0:
            found.append(name)
    return found


def montage(corpus: Corpus) -> Figure:
    """Draw tared pictures of the middle press level: rows by size, each from shallow to deep."""
    level = corpus.levels // 2
    picked = _picked(corpus)
    rows = math.ceil(len(picked) / _COLUMNS)
    stored = corpus.shape
    wide = corpus.design.camera.field_of_view_mm / corpus.design.camera.field_height_mm
    width = 11.0
    tile = (width - 1.1) / _COLUMNS
    figure = Figure(figsize=(width, rows * (tile / wide + 0.42) + 0.75), facecolor="white")
    axes = figure.subplots(rows, _COLUMNS, squeeze=False)
    pictures = [_grey(corpus.tared(sample, [level])[0]) for sample in picked]
    ends = np.array([np.quantile(picture, (0.005, 0.995)) for picture in pictures])
    lowest, highest = math.floor(ends[:, 0].min()), max(math.ceil(ends[:, 1].max()), 1)
    drawn = None
    for place, axis in enumerate(axes.flat):
        axis.set_axis_off()
        if place >= len(picked):
            continue
        sample = picked[place]
        row = corpus.row(sample, level)
        # Pixels need not be square: the picture is stretched to what it shows.
        drawn = axis.imshow(
            pictures[place],
            cmap="viridis",
            vmin=lowest,
            vmax=highest,
            aspect=stored[1] / stored[0] / wide,
        )
        size, depth, modulus, _, _ = (corpus.cell(name, row) for name in INCLUSION)
        if corpus.cell("blank", row):
            axis.set_title("no inclusion", fontsize=8.5, color=_INK, pad=3)
        else:
            title = f"{size:.1f} mm, {depth:.1f} mm deep\n{modulus:.0f} kPa"
            axis.set_title(title, fontsize=8.5, color=_INK, pad=3, linespacing=1.05)
            axis.contour(
                corpus.mask(sample), levels=[0.5], colors=["white"], linewidths=0.8, linestyles="dotted"
            )
    nominal = corpus.indentation_mm[level]
    figure.suptitle(
        f"Picture minus reference, pressed {nominal:g} mm; dotted: where the inclusion lies",
        fontsize=11, color=_INK, x=0.01, ha="left", y=1 - 0.12 / figure.get_figheight(), va="top",
    )  # fmt: skip
    height = figure.get_figheight()
    figure.subplots_adjust(
        left=0.01, right=1 - 0.9 / width, bottom=0.1 / height, top=1 - 0.72 / height, wspace=0.05,
        hspace=0.42 / (tile / wide),
    )  # fmt: skip
    if drawn is not None:
        bar = figure.add_axes((1 - 0.72 / width, 0.15 / height, 0.16 / width, 1 - 0.87 / height))
        figure.colorbar(drawn, cax=bar).set_label("counts", fontsize=9)
        bar.tick_params(labelsize=8)
    return figure


def _picked(corpus: Corpus) -> list[int]:
    """Return samples to show: from small to large, in each row from shallow to deep, a blank last."""
    first = corpus.table.iloc[:: corpus.levels]
    blanks = first[first["blank"]]["sample"].to_numpy()
    solid = first[~first["blank"]].sort_values(["size_mm", "depth_mm", "sample"])
    room = min(_ROWS * _COLUMNS - (len(blanks) > 0), len(solid))
    places = np.linspace(0, len(solid) - 1, room).round().astype(int) if room else np.zeros(0, int)
    shown = solid.iloc[np.unique(places)]
    found: list[int] = []
    for start in range(0, len(shown), _COLUMNS):
        part = shown.iloc[start : start + _COLUMNS].sort_values(["depth_mm", "sample"])
        found += [int(sample) for sample in part["sample"]]
    return found + [int(sample) for sample in blanks[:1]]


def parameters(corpus: Corpus) -> Figure:
    """Draw histograms of what varies: inclusions, forces, and what was randomised."""
    names = [*varied(corpus), "force_N", *corpus.randomised][:_MOST_HISTOGRAMS]
    figure, axes = _grid(len(names), 4, 2.1)
    for axis, name in zip(axes, names, strict=True):
        if name == "force_N":
            _by_level(corpus, axis, name)
        else:
            values = corpus.table[name].to_numpy()[:: corpus.levels]
            _histogram(axis, values[np.isfinite(values)])
        axis.set_xlabel(_WORDS.get(name, name), fontsize=9)
    for axis in axes[::4]:
        axis.set_ylabel("samples", fontsize=9)
    return figure


def scalars(corpus: Corpus) -> Figure:
    """Draw the surface's tared scalars against the picture's, in a colour for each press level, with r."""
    pairs = (
        (
            "max",
            "fem_tared_max_mm",
            1e3,
            "largest displacement, µm",
            "tsis_tared_max_dn",
            "maximum, {}counts",
        ),
        ("total", "fem_tared_total_mm3", 1.0, "volume, mm³", "tsis_tared_total_dn", "sum, {}counts"),
        ("area", "fem_tared_area_mm2", 1.0, "area, mm²", "tsis_tared_area_px", "area, {}pixels"),
    )
    figure, axes = _grid(3, 3, 3.4)
    for axis, (title, across, factor, words, up, unit) in zip(axes, pairs, strict=True):
        power = _thousands(corpus.table[up].to_numpy())
        for level, colour in enumerate(_colours(corpus.levels)):
            x = corpus.table[across].to_numpy()[level :: corpus.levels] * factor
            y = corpus.table[up].to_numpy()[level :: corpus.levels] / 10.0**power
            told = f"{corpus.indentation_mm[level]:g} mm: r = {pearson(x, y):.3f}"
            step = max(1, math.ceil(len(x) / _MOST_POINTS))
            axis.plot(x[::step], y[::step], "o", ms=3.5, mew=0, alpha=0.7, color=colour, label=told)
        axis.set_title(title, fontsize=10, color=_INK, loc="left")
        axis.set_xlabel(f"surface: {words}", fontsize=9)
        axis.set_ylabel(f"picture: {unit.format(f'$10^{power}$ ' if power else '')}", fontsize=9)
        low, high = axis.get_ylim()
        axis.set_ylim(low, high + 0.28 * (high - low))  # room for the legend above the points
        axis.legend(fontsize=8, frameon=False, loc="upper left", handletextpad=0.1, borderaxespad=0.2)
    return figure


def _thousands(values: NDArray[Any]) -> int:
    """Return the power of ten, a multiple of 3, that leaves the largest value between 1 and 1000."""
    largest = float(np.abs(values).max())
    return max(0, 3 * math.floor(math.log10(largest) / 3)) if largest > 0 else 0


def pearson(x: NDArray[Any], y: NDArray[Any]) -> float:
    """Return Pearson's correlation of two columns (n,), NaN where one of them does not vary."""
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan
    return float(np.corrcoef(x, y)[0, 1])


def errors(corpus: Corpus) -> Figure:
    """Draw histograms of noise, error and saturation, in a colour for each press level."""
    said = {
        "noise_percent": "Monte Carlo noise of a pixel, %",
        "error_percent": "error of the mechanics, %",
        "saturated_percent": "full pixels, %",
    }
    known = [name for name in said if np.isfinite(corpus.table[name].to_numpy()).any()]
    figure, axes = _grid(len(known), 3, 2.4)
    for axis, name in zip(axes, known, strict=True):
        _by_level(corpus, axis, name)
        axis.set_xlabel(said[name], fontsize=9)
    if axes:
        axes[0].set_ylabel("frames", fontsize=9)
    return figure


def _by_level(corpus: Corpus, axis: Axes, name: str) -> None:
    values = corpus.table[name].to_numpy()
    values = values[np.isfinite(values)]
    if np.ptp(values) == 0:
        told = f"{values[0]:.3g} in all frames"
        axis.text(0.5, 0.5, told, ha="center", va="center", fontsize=9, transform=axis.transAxes)
        axis.set_xticks([])
        axis.set_yticks([])
        return
    edges = np.linspace(values.min(), values.max(), 25)
    for level, colour in enumerate(_colours(corpus.levels)):
        part = corpus.table[name].to_numpy()[level :: corpus.levels]
        told = f"{corpus.indentation_mm[level]:g} mm"
        axis.hist(part[np.isfinite(part)], bins=edges, color=colour, alpha=0.75, label=told)
    axis.legend(fontsize=8, frameon=False, handlelength=1, borderaxespad=0.2)


def _histogram(axis: Axes, values: NDArray[Any]) -> None:
    if values.size:
        axis.hist(values, bins=min(30, max(6, round(math.sqrt(values.size)))), color=_BAR)


def _colours(count: int) -> list[Any]:
    """Return colours that stay apart in grey and for the colour-blind, from dark to light."""
    from matplotlib import colormaps

    return [colormaps["viridis"](0.08 + 0.75 * step / max(count - 1, 1)) for step in range(count)]


def _grid(count: int, most_across: int, height: float) -> tuple[Figure, list[Axes]]:
    across = max(1, min(most_across, count))
    rows = max(1, math.ceil(count / across))
    width = 11.0 * across / most_across if across < most_across else 11.0
    figure = Figure(figsize=(max(width, 4.0), rows * height), facecolor="white", layout="constrained")
    axes = figure.subplots(rows, across, squeeze=False)
    for axis in axes.flat[count:]:
        axis.set_axis_off()
    for axis in axes.flat[:count]:
        axis.tick_params(labelsize=8)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    return figure, list(axes.flat[:count])


def _grey(picture: NDArray[np.float32]) -> NDArray[np.float32]:
    return picture if picture.ndim == 2 else picture.mean(axis=2)
