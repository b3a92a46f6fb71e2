"""Figures of a layout study: layouts side by side, bounds, budgets, what can be found, what mattered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from estimation.information import Noise, pixel_information
from twin.report import BLUE, GREEN, GREY, INK, RED, panels

if TYPE_CHECKING:
    from twin.explore_results import Importance, Trial

Floats = NDArray[np.float64]

COLOURS = (RED, INK, BLUE, GREEN)
"""Of the baseline and of up to three winners, in all figures."""

UNITS = {"size_mm": ("d", "mm", 1.0), "depth_mm": ("h", "mm", 1.0), "modulus_kPa": ("E", "10 kPa", 10.0)}
"""Symbol, unit and step of a sensitivity map."""


def layouts(
    trials: Sequence[Trial],
    noises: Sequence[Noise],
    extent_mm: Sequence[tuple[float, float]],
    presses: Sequence[tuple[int, float]],
    full: Sequence[float],
) -> Figure:
    """Draw each layout's picture, its tared picture and what a step of d, h and E does, over the noise.

    ``noises`` is of one true pixel of each layout, ``extent_mm`` width and height that its pictures show,
    ``presses`` the number and the depth (mm) of the press that is shown, ``full`` the camera's largest count:
    pictures are shown in per cent of it, so that cameras of other bits look alike.
    """
    rows = len(trials)
    figure = Figure(figsize=(10.4, 1.75 * rows + 0.45), facecolor="white", layout="constrained")
    figure.get_layout_engine().set(w_pad=0.02, h_pad=0.03)
    axes: Any = figure.subplots(rows, 5, squeeze=False)
    held = []
    for trial, noise, (press, _), top in zip(trials, noises, presses, full, strict=True):
        counts, slopes = trial.pictures()
        at = 2 * press  # its reference follows
        mean = _grey(counts, 3)[at : at + 2]
        weight = np.sqrt(pixel_information(mean[0], noise))
        maps = {
            name: UNITS[name][2] * _grey(slopes[name], 3)[at] * weight for name in UNITS if name in slopes
        }
        held.append((100.0 * mean / top, maps))
    ends = {
        name: max(
            (float(np.quantile(np.abs(maps[name]), 0.999)) for _, maps in held if name in maps), default=1
        )
        for name in UNITS
    }
    brightest = max(float(mean[0].max()) for mean, _ in held)
    signal = max(float(np.quantile(np.abs(mean[0] - mean[1]), 0.999)) for mean, _ in held)
    for row, (trial, (mean, maps), (wide, high)) in enumerate(zip(trials, held, extent_mm, strict=True)):
        where = (-wide / 2, wide / 2, -high / 2, high / 2)
        drawn = [(mean[0], "gray", 0.0, brightest), (mean[0] - mean[1], "RdBu_r", -signal, signal)]
        drawn += [(maps[name], "PuOr_r", -ends[name], ends[name]) for name in maps]
        for column, (picture, colours, low, top) in enumerate(drawn):
            axis = axes[row, column]
            shown = axis.imshow(
                picture, cmap=colours, vmin=low, vmax=top, extent=where, interpolation="nearest"
            )
            axis.set_xticks([])
            axis.set_yticks([])
            for side in axis.spines.values():
                side.set_visible(False)
            if row == rows - 1:
                bar = figure.colorbar(
                    shown, ax=axes[:, column], location="bottom", shrink=0.85, pad=0.02, aspect=18
                )
                bar.ax.tick_params(labelsize=8)
                bar.outline.set_visible(False)
        label = f"{trial.name}\n{presses[row][1]:g} mm"
        axes[row, 0].set_ylabel(label, fontsize=10, color=COLOURS[row % len(COLOURS)], fontweight="bold")
        for column in range(len(drawn), 5):
            axes[row, column].set_visible(False)
    heads = ["picture, % of range", "tared, % of range"]
    heads += [f"{UNITS[name][0]} + {UNITS[name][1].replace('mm', '1 mm')}, σ a pixel" for name in held[0][1]]
    for axis, head in zip(axes[0], heads, strict=False):
        axis.set_title(head, fontsize=9.5, color=INK)
    return figure


def bounds(trials: Sequence[Trial]) -> Figure:
    """Draw the bounds on d, h and E of every inclusion, one group of bars for each."""
    wanted = [name for name in UNITS if name in trials[0].told["inclusions"][0]["sd"]]
    figure, axes = panels(1, len(wanted), 2.9)
    count = len(trials[0].told["inclusions"])
    labels = [inclusion_label(one) for one in trials[0].told["inclusions"]]
    width = 0.8 / len(trials)
    for axis, name in zip(axes, wanted, strict=True):
        for number, trial in enumerate(trials):
            values = [one["sd"][name] for one in trial.told["inclusions"]]
            place = np.arange(count) + (number - (len(trials) - 1) / 2) * width
            axis.bar(place, values, 0.92 * width, color=COLOURS[number % len(COLOURS)], label=trial.name)
        axis.set_xticks(np.arange(count), labels, fontsize=8)
        symbol, unit, _ = UNITS[name]
        axis.set_ylabel(f"bound on {symbol}, {unit.split()[-1]}")
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=4, frameon=False, fontsize=9)
    return figure


def inclusion_label(told: dict[str, Any]) -> str:
    """Three lines below a group of bars."""
    return f"d {told['size_mm']:g}\nh {told['depth_mm']:g}\nE {told['modulus_kPa']:g}"


def budget(trials: Sequence[Trial], wanted: str = "modulus_kPa", most: int = 8) -> Figure:
    """Draw what knowing each unknown exactly, and twice as well, would take off the bound, per cent.

    Root mean square over the inclusions, for the baseline and the winner; unknowns below 0.5 % are left out,
    but for the first three.
    """
    found = [shares(trial, wanted) for trial in trials]
    largest = {name: max(one.get(name, (0.0, 0.0))[0] for one in found) for name in found[0]}
    order = sorted(largest, key=lambda name: -largest[name])[:most]
    order = [name for place, name in enumerate(order) if place < 3 or largest[name] >= 0.005]
    figure, axes = panels(1, len(trials), 0.32 * len(order) + 1.1)
    place = np.arange(len(order))[::-1]
    longest = max(max(one[name][0] for name in order if name in one) for one in found)
    for number, (axis, trial, share) in enumerate(zip(axes, trials, found, strict=True)):
        known = [100 * share.get(name, (0.0, 0.0))[0] for name in order]
        halved = [100 * share.get(name, (0.0, 0.0))[1] for name in order]
        axis.barh(place, known, 0.66, color=GREY, alpha=0.45, label="known exactly")
        axis.barh(place, halved, 0.36, color=COLOURS[number % len(COLOURS)], label="known twice as well")
        axis.set_yticks(place, order if number == 0 else [""] * len(order), fontsize=8.5)
        axis.set_xlim(0, 108 * longest + 1)
        axis.set_xlabel(f"off the bound on {UNITS[wanted][0]}, %")
        axis.set_title(trial.name, loc="left", fontsize=10, color=COLOURS[number % len(COLOURS)])
    axes[0].legend(frameon=False, fontsize=8.5, loc="lower right")
    return figure


def shares(trial: Trial, wanted: str) -> dict[str, tuple[float, float]]:
    """Share of the bound that goes with each unknown known exactly, and twice as well (rms of inclusions)."""
    budgets = trial.budgets()
    at = budgets[0].wanted.index(wanted)
    whole = np.sqrt(np.mean([one.sd[at] ** 2 for one in budgets]))
    found = {}
    for name in [cost.name for cost in budgets[0].costs]:
        costs = [next(cost for cost in one.costs if cost.name == name) for one in budgets]
        known, halved = (
            np.sqrt(np.mean([getattr(cost, kind)[at] ** 2 for cost in costs])) for kind in ("known", "halved")
        )
        found["noise of the pictures" if name == "noise" else name] = (
            float(1 - known / whole),
            float(1 - halved / whole),
        )
    return found


def found_by_depth(trials: Sequence[Trial], standard: tuple[float, float], slab_mm: float) -> Figure:
    """Draw the least diameter that is found over its depth, from where the standard lump is lost.

    The signal of a small stiff sphere goes as d³ over the square of its centre's depth (Eshelby's far field):
    with the standard lump just found at depth h0, that is d³ / (h + d/2)² = d0³ / (h0 + d0/2)².
    """
    figure, axes = panels(1, 1, 2.9)
    depth = np.linspace(2.0, 0.7 * slab_mm, 80)
    for number, trial in enumerate(trials):
        reach = trial.objectives.get("detection_depth_mm")
        if reach is None or not np.isfinite(reach):
            continue
        axes[0].plot(
            depth,
            least_size(depth, reach, standard[0]),
            color=COLOURS[number % len(COLOURS)],
            label=trial.name,
        )
    axes[0].set_xlabel("depth of the top, mm")
    axes[0].set_ylabel("smallest diameter found, mm")
    axes[0].set_ylim(0, None)
    axes[0].legend(frameon=False, fontsize=9, loc="upper left")
    return figure


def least_size(depth: Floats, reach: float, size: float) -> Floats:
    """Diameter d (n,), mm, with d³ / (h + d/2)² as of the size at the depth it is found to."""
    target = size**3 / (reach + size / 2) ** 2
    low, high = np.full(depth.shape, 1e-3), np.full(depth.shape, 100.0)
    for _ in range(60):
        middle = (low + high) / 2
        over = middle**3 / (depth + middle / 2) ** 2 > target
        low, high = np.where(over, low, middle), np.where(over, middle, high)
    return np.asarray((low + high) / 2)


def importance(found: Sequence[Importance]) -> Figure:
    """Draw each field's share in what the objectives do."""
    names = list(dict.fromkeys(name for one in found for name in one.share))
    names.sort(key=lambda name: -max(one.share.get(name, 0.0) for one in found))
    names = names[:10]
    figure, axes = panels(1, len(found), 0.32 * len(names) + 1.0)
    place = np.arange(len(names))[::-1]
    for number, (axis, one) in enumerate(zip(axes, found, strict=True)):
        axis.barh(place, [100 * one.share.get(name, 0.0) for name in names], 0.62, color=BLUE)
        axis.set_yticks(place, names if number == 0 else [""] * len(names), fontsize=8.5)
        axis.set_xlim(0, 100)
        axis.set_xlabel("share, %")
        axis.set_title(one.objective, loc="left", fontsize=10)
    return figure


def _grey(pictures: Floats, planes: int) -> Floats:
    """Mean of the channels where there are any; `planes` is the number of dimensions without."""
    return np.asarray(pictures.mean(axis=-1)) if pictures.ndim > planes else pictures
