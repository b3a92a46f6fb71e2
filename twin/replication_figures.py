"""Figures of `twin replicate`: the paper's 3(c), 4 and 5, and what its tables look like as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from numpy.typing import NDArray

import fem
from estimation import paper
from estimation.regression import Line, fit_line
from twin.frame import grey
from twin.inversion import Scalars
from twin.panels import quads
from twin.replication import FROM_MM
from twin.report import BLUE, GREEN, GREY, INK, RED, panels

if TYPE_CHECKING:
    from twin.corpus import Corpus
    from twin.replication import Replication

Floats = NDArray[np.float64]

GROUPS = ((0, 1, 2), (3, 4, 5), (6, 7, 8))
"""Places in Table I of the phantoms that differ in size, in depth, in modulus."""

_BLOCK = 6  # pixels of a relief's facet


def relief(corpus: Corpus, level: int, samples: NDArray[np.int64]) -> Figure:
    """Draw Fig. 3(c): the tared picture of phantoms 1 and 9 as a coloured relief."""
    figure = Figure(figsize=(10.4, 4.0), facecolor="white", layout="constrained")
    camera = corpus.design.camera
    for place, number in enumerate((0, 8)):
        axes: Any = figure.add_subplot(1, 2, place + 1, projection="3d")
        picture = grey(corpus.tared(int(samples[number]), [level])[0])
        rows, columns = (side // _BLOCK for side in picture.shape)
        means = (
            picture[: rows * _BLOCK, : columns * _BLOCK]
            .reshape(rows, _BLOCK, columns, _BLOCK)
            .mean(axis=(1, 3))
        )
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * camera.field_of_view_mm
        y = (0.5 - (np.arange(rows) + 0.5) / rows) * camera.field_height_mm
        axes.plot_surface(
            *np.meshgrid(x, y), means, cmap="jet", rstride=1, cstride=1, lw=0, antialiased=False
        )
        size, depth, modulus = paper.true_inclusions()[number]
        axes.set_title(
            f"phantom {number + 1}: d {size:g} mm, h {depth:g} mm, {modulus:g} kPa", fontsize=10, color=INK
        )
        axes.set_xlabel("x, mm", fontsize=9)
        axes.set_ylabel("y, mm", fontsize=9)
        axes.set_zlabel("counts over the reference", fontsize=9)
        axes.tick_params(labelsize=8)
        axes.set_box_aspect((4, 3, 2))
    return figure


def model(corpus: Corpus, level: int) -> Figure:
    """Draw Fig. 4: mesh and vertical displacement, a press on phantom 9, y = 0 (coarse, small strain)."""
    design, depth = corpus.design, corpus.indentation_mm[level]
    size, deep, modulus = paper.true_inclusions()[8]
    inclusion = fem.Inclusion(size=float(size), depth=float(deep), modulus=float(modulus))
    pressed = fem.press(
        design.probe(), design.slab(), inclusion, depth, quality="preview", mechanics="linear"
    )
    cut = pressed.cut
    moved = np.asarray(cut.points) + np.asarray(cut.point_data["displacement"])
    tared = (
        1e3
        * (np.asarray(cut.point_data["displacement"]) - np.asarray(cut.point_data["displacement_0"]))[:, 2]
    )
    corners = quads(cut)
    material = np.asarray(cut.cell_data["material"])
    figure, axes = panels(1, 2, 4.0)
    ends = np.quantile(np.abs(tared), 0.995)
    for axis, kind in zip(axes, ("mesh", "signal"), strict=True):
        shape = moved[corners][..., [0, 2]]
        drawn = PolyCollection(shape, lw=0.25, edgecolor="#444444" if kind == "mesh" else "face")
        if kind == "mesh":
            drawn.set_array(material.astype(float))
            drawn.set_cmap("Pastel1")
        else:
            drawn.set_array(tared[corners].mean(axis=1))
            drawn.set_cmap("RdBu_r")
            drawn.set_clim(-ends, ends)
        axis.add_collection(drawn)
        axis.set_xlim(moved[:, 0].min() - 1, moved[:, 0].max() + 1)
        axis.set_ylim(moved[:, 2].min() - 1, moved[:, 2].max() + 1)
        axis.set_aspect("equal")
        axis.set_xlabel("x, mm")
        axis.set_ylabel("z, mm (into the tissue)")
    bar = figure.colorbar(drawn, ax=axes[1], shrink=0.8)
    bar.set_label("vertical displacement due to the inclusion, µm", fontsize=9)
    bar.ax.tick_params(labelsize=8)
    axes[0].set_title("(a) probe below, slab and inclusion above: cells", loc="left", fontsize=10)
    axes[1].set_title("(b) with minus without inclusion", loc="left", fontsize=10)
    return figure


def phantom_lines(data: Scalars) -> list[tuple[Floats, Floats, Line]]:
    """Regress as in Fig. 5: picture on surface over the nine, each group of three divided by its largest.

    Returns x (9,), y (9,) and the line, for maximum, total and area.
    """
    found = []
    for column in range(3):
        x, y = data.surface[data.phantoms, column].copy(), data.picture[data.phantoms, column].copy()
        for group in GROUPS:
            some = list(group)
            x[some] /= max(x[some].max(), 1e-12)
            y[some] /= max(y[some].max(), 1e-12)
        found.append((x, y, fit_line(x, y)))
    return found


def regressions(data: Scalars, low: Scalars, k: float, low_k: float) -> Figure:
    """Draw Fig. 5 (a) to (c) at the design's threshold, and below at the lower one."""
    rows = 1 if low_k == k else 2
    figure, axes = panels(rows, 3, 3.0)
    for row, (some, threshold) in enumerate([(data, k), (low, low_k)][:rows]):
        for column, (x, y, line) in enumerate(phantom_lines(some)):
            axis = axes[3 * row + column]
            for group, colour, words in zip(
                GROUPS, (BLUE, GREEN, RED), ("size", "depth", "modulus"), strict=True
            ):
                axis.plot(x[list(group)], y[list(group)], "o", color=colour, ms=6, label=f"{words} varies")
            ends = np.array([0.0, 1.0])
            axis.plot(ends, line(ends), color=INK, lw=1.3)
            low_end, high_end = line.fit.confidence(np.linspace(0, 1, 50))
            axis.fill_between(np.linspace(0, 1, 50), low_end, high_end, color=GREY, alpha=0.2, lw=0)
            name = ("maximum", "total", "area")[column]
            axis.set_title(
                f"({'abcdef'[3 * row + column]}) {name}, k = {threshold:g} counts", loc="left", fontsize=10
            )
            axis.set_xlabel("surface, normalised")
            axis.set_ylabel("picture, normalised" if column == 0 else "")
            axis.text(
                0.03,
                0.97,
                f"R² = {line.r2:.3f}\nslope {line.slope:.2f}",
                transform=axis.transAxes,
                va="top",
                fontsize=8.5,
            )
            axis.set_ylim(-0.25, 1.25)
    axes[0].legend(frameon=False, fontsize=8, loc="lower right")
    return figure


def estimates(found: Replication) -> Figure:
    """Draw the nine estimates of the paper, of the plain chain and of the chosen one against the truth."""
    truth = paper.true_inclusions()
    plain_run = found.run("paper", "leave-one-out", (found.main_mm,), found.k_dn)
    chosen = found.run(found.chosen[0], "leave-one-out", (found.main_mm,), found.chosen[1])
    figure, axes = panels(1, 3, 3.4)
    sets = (
        ("paper, as printed", paper.published_estimates(), RED, "s", -0.18),
        ("our run of its chain", plain_run.estimate, GREY, "^", 0.0),
        ("chain chosen on random inclusions", chosen.estimate, BLUE, "o", 0.18),
    )
    for axis, column, words in zip(axes, range(3), ("size, mm", "depth, mm", "modulus, kPa"), strict=True):
        number = np.arange(1, 10)
        axis.plot(number, truth[:, column], "_", color=INK, ms=22, mew=2, label="truth")
        for label, values, colour, mark, shift in sets:
            axis.plot(number + shift, values[:, column], mark, color=colour, ms=5, label=label)
        axis.set_xlabel("phantom (Table I)")
        axis.set_ylabel(words)
        axis.set_xticks(number)
    handles, names = axes[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside upper left", ncols=4, frameon=False, fontsize=8.5)
    return figure


def crossed(found: Replication) -> Figure:
    """Draw cross-validated estimates of the random inclusions against the truth, chosen chain."""
    best = found.best()
    figure, axes = panels(1, 3, 3.2)
    for axis, column, words in zip(axes, range(3), ("size, mm", "depth, mm", "modulus, kPa"), strict=True):
        x, y = best.truth[:, column], best.estimate[:, column]
        ends = np.array([min(x.min(), y.min()), max(x.max(), y.max())])
        half = best.half_width[column]
        axis.fill_between(ends, ends - half, ends + half, color=BLUE, alpha=0.12, lw=0)
        axis.plot(ends, ends, color=INK, lw=1)
        small = best.truth[:, 0] < FROM_MM
        axis.plot(x[~small], y[~small], "o", color=BLUE, ms=3.5, mew=0, alpha=0.8)
        axis.plot(x[small], y[small], "o", mfc="none", color=GREY, ms=3.5, label=f"below {FROM_MM:g} mm")
        axis.set_xlabel(f"true {words}")
        axis.set_ylabel(f"estimated {words}")
        share = best.explained[column]
        told = f"explains {100 * share:.0f} %" if share > 0 else "worse than a constant"
        axis.text(0.03, 0.97, told, transform=axis.transAxes, va="top", fontsize=8.5)
        if column == 1:
            axis.legend(frameon=False, fontsize=8, loc="lower right", handletextpad=0.1)
    return figure
