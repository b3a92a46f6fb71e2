"""The replication as a page, CSV, JSON and a few lines on the terminal."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from estimation import paper
from twin import replication_figures as figures
from twin.corpus import Corpus
from twin.earlier import GUESSES
from twin.inversion import Scalars
from twin.replication import LARGE, Replication
from twin.replication_findings import as_json, worth_of_modulus
from twin.replication_tables import (
    earlier_table,
    errors_csv,
    estimates_csv,
    short,
    table1,
    table2,
    table3,
    verdict,
)
from twin.report import Page, write_csv, write_json

Floats = NDArray[np.float64]


def write(found: Replication, corpus: Corpus, folder: Path) -> None:
    """Write report.html, estimates.csv, errors.csv and replicate.json into a folder."""
    content = as_json(found)
    main = found.levels[found.main_mm, found.k_dn]
    low = found.levels[found.main_mm, found.low_k_dn]
    content["corpus"] = {
        "name": corpus.name,
        "samples": len(corpus),
        "mechanics": corpus.plan.mechanics,
        "quality": corpus.plan.quality,
        "light": corpus.plan.light,
        "indentation_mm": list(corpus.indentation_mm),
    }
    content["signals"] = {"surface": main.surface[main.phantoms], "picture": main.picture[main.phantoms]}
    content["fig5"] = [
        {
            "k_dn": k,
            "scalar": name,
            "slope": line.slope,
            "intercept": line.intercept,
            "r2": line.r2,
            "r2_interval": line.r2_interval,
        }
        for k, data in {found.k_dn: main, found.low_k_dn: low}.items()
        for name, (_, _, line) in zip(("max", "total", "area"), figures.phantom_lines(data), strict=True)
    ]
    write_json(folder / "replicate.json", content)
    write_csv(folder / "estimates.csv", estimates_csv(found))
    write_csv(folder / "errors.csv", errors_csv(content))
    page(found, corpus, main, low).write(folder / "report.html")


def told(found: Replication) -> str:
    """Return the lines of a terminal: errors beside the paper's, the goal, what E is worth."""
    head, rows, _ = table3(found)
    keep = [0, 1, 5, 6, 7]
    cells = [[str(row[i]) for i in keep] for row in [head, *rows]]
    widths = [min(max(len(row[i]) for row in cells), 62) for i in range(len(keep))]
    lines = [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]
    return "\n".join([*lines, "", *verdict(found)])


def page(found: Replication, corpus: Corpus, main: Scalars, low: Scalars) -> Page:
    """Return the report."""
    made = Page(
        "The source paper, replicated in simulation",
        "Lee and Won 2011: size, depth and Young's modulus of an inclusion from tactile pictures, 3-D "
        "finite elements "
        f"and a neural network. {len(main.box)} random inclusions and the 9 phantoms, simulated; "
        f"{found.repeats} "
        f"networks per estimate, seed {found.seed}.",
    )
    made.verdict(*verdict(found))
    made.section("Tables I to III")
    made.table(*table1(main, found))
    made.table(*table2(found))
    made.figure(
        figures.estimates(found),
        f"Estimates of the nine phantoms at {found.main_mm:g} mm, leave-one-out; ours are means over the "
        f"repeats.",
    )
    made.table(*table3(found), strong=(0, 1))
    made.text(
        "The paper's Table III says root mean squared error, but its figures are mean absolute errors of "
        "its own Table II "
        "against Table I (first row); the root mean squared errors are in the second. A constant, which "
        "needs no "
        "picture, is better than the paper's estimates on h and E when it is the mean of the nine truths."
    )
    _protocols(made, found)
    _figures(made, found, corpus, main, low)
    _chains(made, found)
    _modulus(made, found)
    made.section("Earlier methods")
    made.table(*earlier_table(found))
    made.text("The paper names its predecessors in three sentences. What had to be guessed:")
    made.bullets(GUESSES)
    made.section("What was simulated, and what could not be checked")
    made.bullets(_limits(found, corpus))
    return made


def _protocols(made: Page, found: Replication) -> None:
    made.text(
        "The paper says both that 125 samples train and 9 validate, and that leave-one-out is used; and "
        "its lines are "
        "fitted to the nine phantoms that are then estimated. Rows above are named by protocol; "
        "'lines through phantoms' is the paper's fit, which under leave-one-out omits the phantom asked for. "
        "All other rows fit the lines to the random inclusions alone."
    )


def _figures(made: Page, found: Replication, corpus: Corpus, main: Scalars, low: Scalars) -> None:
    step = corpus.indentation_mm.index(found.main_mm)
    made.section("Figures 3(c), 4 and 5")
    made.figure(
        figures.relief(corpus, step, main.sample[main.phantoms]),
        f"Fig. 3(c): tared pictures at {found.main_mm:g} mm as a relief. The paper's is of a 2 mm "
        "inclusion of another phantom (MammaCare) of unknown depth; ours at 5 mm stays below any k that "
        "the noise "
        "of a single pixel allows (pixels are averaged 6 x 6 here).",
        pixels=True,
    )
    made.figure(
        figures.model(corpus, step),
        f"Fig. 4: the finite-element model, phantom 9 under {found.main_mm:g} mm, cut at y = 0, drawn "
        f"coarse and at small strain.",
        pixels=True,
    )
    made.figure(
        figures.regressions(main, low, found.k_dn, found.low_k_dn),
        "Fig. 5 (a) to (c): regressions over the nine phantoms. Each group of three is divided by its "
        "largest, so that "
        "three points lie at (1, 1), which is how we read the paper. Band: 95 % confidence of the line.",
    )


def _chains(made: Page, found: Replication) -> None:
    made.section("Which chain, which threshold, which press")
    made.text(
        "All chains below take the same three tared scalars of one noisy picture. The paper's own comes "
        "first; the "
        "others say what its mapping and its joint target cost. Phantom 1 is left out here and stands by "
        "itself."
    )
    truth = paper.true_inclusions()
    head = ["chain", "what it is", "press, mm", "k", "RMSE d", "RMSE h", "RMSE E", "phantom 1: d / h / E"]
    rows, strong = list[list[str]](), list[int]()
    for run in [run for run in found.runs if run.protocol == "125/9"]:
        off = paper.rmse(truth[LARGE], run.estimate[LARGE])
        if (run.variant.name, run.k_dn) == found.chosen and run.level_mm == (found.main_mm,):
            strong.append(len(rows))
        rows.append(
            [
                run.variant.name,
                run.variant.words,
                " + ".join(f"{mm:g}" for mm in run.level_mm),
                f"{run.k_dn:g}" if run.variant.mapping != "none" else "—",
                *(short(v, i) for i, v in enumerate(off)),
                " / ".join(f"{v:.1f}" for v in run.estimate[0]),
            ]
        )
    made.table(
        head,
        rows,
        f"Eight phantoms of 7 mm and more, {found.trained}/9. Shaded: chosen by cross-validation.",
        strong,
    )
    head = [
        "chain",
        "k",
        "RMSE d",
        "RMSE h",
        "RMSE E",
        "90 % within ± d",
        "± h",
        "± E",
        "explains d %",
        "h %",
        "E %",
    ]
    rows, strong = list[list[str]](), list[int]()
    for one in found.crossed:
        if (one.variant.name, one.k_dn) == found.chosen:
            strong.append(len(rows))
        rows.append(
            [
                one.variant.name,
                f"{one.k_dn:g}",
                *(short(v, i) for i, v in enumerate(one.rmse)),
                *(short(v, i) for i, v in enumerate(one.half_width)),
                *(f"{100 * v:.0f}".replace("-", "−") for v in one.explained),
            ]
        )
    made.table(
        head,
        rows,
        f"Cross-validated on the random inclusions (five folds), {found.main_mm:g} mm; those of 4 mm "
        f"and more. k = {found.low_k_dn:g} counts is the lowest whole count that is 5 times the noise of a "
        f"pixel of the tared picture "
        f"({found.noise_dn:.2f} counts).",
        strong,
    )
    made.figure(
        figures.crossed(found),
        "The chosen chain on the random inclusions, cross-validated. Band: holds 90 % of those of 4 mm and "
        "more.",
    )


def _modulus(made: Page, found: Replication) -> None:
    best = found.best()
    made.section("What E is worth")
    made.text(worth_of_modulus(found))
    rows = []
    for n, truth in enumerate(paper.true_inclusions()):
        run = found.run(best.variant.name, "125/9", (found.main_mm,), best.k_dn)
        middle, half = run.estimate[n, 2], best.half_width[2]
        inside = abs(truth[2] - middle) <= half
        rows.append(
            [
                str(n + 1),
                f"{truth[2]:g}",
                f"{middle:.0f}",
                f"{middle - half:.0f} to {middle + half:.0f}",
                "yes" if inside else "no",
            ]
        )
    made.table(
        ["no.", "true E, kPa", "estimated", "90 % interval", "holds the truth"],
        rows,
        f"E of the phantoms by the chosen chain ({best.variant.name}, k = {best.k_dn:g}), "
        f"with the cross-validated interval.",
    )


def _limits(found: Replication, corpus: Corpus) -> list[str]:
    plan = corpus.plan
    mechanics = {
        "emulator": "an emulator of finite-element solutions",
        "finite": "finite strain, sliding contact",
    }
    return [
        f"Simulated: mechanics ({mechanics.get(plan.mechanics, 'linear elasticity')}, {plan.quality} "
        f"quality), light "
        f"({plan.light} quality), camera noise. No nuisance varies: tissue modulus, roughness, LED flux "
        f"and depth of press are "
        "the same in training and test, and all samples share one Monte Carlo pattern. Real phantoms are "
        "worse.",
        "Training and test come from the same simulator (an inverse crime): the figures say what the "
        "paper's method can "
        "do with a perfect forward model, not what it does on a bench.",
        "Not checked, for want of real phantoms: silicone's modulus, contact and adhesion, roughness, LED "
        "coupling, "
        "position of the probe over the inclusion, and every count in a picture.",
        "Not in the paper and chosen here: press level, k, layers of the guide, slab, distribution of the "
        "random inclusions, "
        "layers and stopping of the network (two tanh layers of 10, 15 % of the samples stop the training).",
        "Read into the paper: h is the depth of the inclusion's top; pictures are tared; Fig. 5 is "
        "normalised in groups.",
    ]
