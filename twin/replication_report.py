"""The replication as a page, CSV, JSON and a few lines on the terminal."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation import paper
from twin import replication_figures as figures
from twin.corpus import Corpus
from twin.earlier import GUESSES
from twin.inversion import SPOT_PX, Scalars
from twin.replication import GOAL, LARGE, Replication, Run, as_json, best_modulus, goal, worth_of_modulus
from twin.report import Page, digits, write_csv, write_json

Floats = NDArray[np.float64]

_UNITS = ("mm", "mm", "kPa")
_LETTERS = ("d", "h", "E")


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
        {"k_dn": k, "scalar": name, "slope": line.slope, "intercept": line.intercept, "r2": line.r2, "r2_interval": line.r2_interval}
        for k, data in {found.k_dn: main, found.low_k_dn: low}.items()
        for name, (_, _, line) in zip(("max", "total", "area"), figures.phantom_lines(data), strict=True)
    ]
    write_json(folder / "replicate.json", content)
    write_csv(folder / "estimates.csv", _estimates_csv(found))
    write_csv(folder / "errors.csv", _errors_csv(content))
    page(found, corpus, main, low).write(folder / "report.html")


def told(found: Replication) -> str:
    """Return the lines of a terminal: errors beside the paper's, the goal, what E is worth."""
    head, rows, _ = _table3(found)
    keep = [0, 1, 5, 6, 7]
    cells = [[str(row[i]) for i in keep] for row in [head, *rows]]
    widths = [min(max(len(row[i]) for row in cells), 62) for i in range(len(keep))]
    lines = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in cells]
    return "\n".join([*lines, "", *_verdict(found)])


def page(found: Replication, corpus: Corpus, main: Scalars, low: Scalars) -> Page:
    """Return the report."""
    made = Page(
        "The source paper, replicated in simulation",
        "Lee and Won 2011: size, depth and Young's modulus of an inclusion from tactile pictures, 3-D finite elements "
        f"and a neural network. {len(main.box)} random inclusions and the 9 phantoms, simulated; {found.repeats} "
        f"networks per estimate, seed {found.seed}.",
    )
    made.verdict(*_verdict(found))
    made.section("Tables I to III")
    made.table(*_table1(main, found))
    made.table(*_table2(found))
    made.figure(
        figures.estimates(found),
        f"Estimates of the nine phantoms at {found.main_mm:g} mm, leave-one-out; ours are means over the repeats.",
    )
    made.table(*_table3(found), strong=(0, 1))
    made.text(
        "The paper's Table III says root mean squared error, but its figures are mean absolute errors of its own Table II "
        "against Table I (first row); the root mean squared errors are in the second. A constant, which needs no "
        "picture, is better than the paper's estimates on h and E when it is the mean of the nine truths."
    )
    _protocols(made, found)
    _figures(made, found, corpus, main, low)
    _chains(made, found)
    _modulus(made, found)
    made.section("Earlier methods")
    made.table(*_earlier(found))
    made.text("The paper names its predecessors in three sentences. What had to be guessed:")
    made.bullets(GUESSES)
    made.section("What was simulated, and what could not be checked")
    made.bullets(_limits(found, corpus))
    return made


def _verdict(found: Replication) -> list[str]:
    result = goal(found)
    name, k = found.chosen
    words = next(run.variant.words for run in found.runs if run.variant.name == name)
    plain, best = result["plain_rmse_mm"], result["rmse_mm"]
    unseen = [n + 1 for n in range(9) if not found.levels[found.main_mm, found.k_dn].seen[_phantoms(found)[n]]]
    told = (
        f"The paper's chain (a line per scalar, k = {found.k_dn:g} counts) on the eight phantoms of 7 mm and more: RMSE "
        f"d {plain['size_mm']:.2f} mm, h {plain['depth_mm']:.2f} mm"
    )
    if unseen:
        told += f"; phantoms {', '.join(map(str, unseen))} show no spot above k"
    state = "met" if result["met"] else "not met"
    first, second = GOAL.values()
    return [
        told + ".",
        f"Best chain by cross-validation on the random inclusions, phantoms unseen ({name}: {words}; k = {k:g} counts): d "
        f"{best['size_mm']:.2f} mm, h {best['depth_mm']:.2f} mm. Goal of {first:g} and {second:g} mm: {state}.",
        _linear_line(found),
        worth_of_modulus(found),
    ]


def _linear_line(found: Replication) -> str:
    """What the best chain with a linear mapping does: the three scalars, tared, and a linear map."""
    linear = [one for one in found.crossed if one.variant.mapping in ("lines", "joint") and not one.variant.logs]
    best = min(linear, key=lambda one: float(((one.rmse / one.truth.std(axis=0))[:2] ** 2).sum()))
    run = found.run(best.variant.name, "125/9", (found.main_mm,), best.k_dn)
    off = paper.rmse(paper.true_inclusions()[LARGE], run.estimate[LARGE])
    met = "met" if all(off[i] <= limit for i, limit in enumerate(GOAL.values())) else "not met"
    return (
        f"Best of the chains whose mapping is linear ({best.variant.name}: {best.variant.words}; k = {best.k_dn:g} counts): d "
        f"{off[0]:.2f} mm, h {off[1]:.2f} mm; goal {met}."
    )


def _phantoms(found: Replication) -> NDArray[np.int64]:
    return found.levels[found.main_mm, found.k_dn].phantoms


def _table1(main: Scalars, found: Replication) -> tuple[list[str], list[list[str]], str]:
    head = ["no.", "d, mm", "h, mm", "E, kPa", "surface max, µm", "total, mm³", "area, mm²", "picture max, counts", "total, 10⁶", "area, px", "spot"]
    rows = []
    for number, place in enumerate(main.phantoms):
        surface, picture = main.surface[place], main.picture[place]
        rows.append(
            [
                str(number + 1),
                *(f"{v:g}" for v in main.truth[place]),
                digits(1e3 * surface[0]),
                digits(surface[1]),
                digits(surface[2]),
                digits(picture[0]),
                digits(1e-6 * picture[1]),
                f"{picture[2]:.0f}",
                "yes" if main.seen[place] else "no",
            ]
        )
    caption = (
        f"Table I and what the twin makes of it at {found.main_mm:g} mm, tared, k of the picture {found.k_dn:g} counts as the design "
        f"has it. A spot is {SPOT_PX} pixels above k; without one there is no maximum."
    )
    return head, rows, caption


def _table2(found: Replication) -> tuple[list[str], list[list[str]], str]:
    head = ["no.", "truth", "paper, Table II", "our run of the paper's chain", f"chain {found.chosen[0]}"]
    plain = found.run("paper", "leave-one-out", (found.main_mm,), found.k_dn)
    best = found.run(found.chosen[0], "leave-one-out", (found.main_mm,), found.chosen[1])
    rows = []
    for n, truth in enumerate(paper.true_inclusions()):
        rows.append(
            [
                str(n + 1),
                " / ".join(f"{v:g}" for v in truth),
                " / ".join(f"{v:.2f}" for v in paper.published_estimates()[n]),
                *(" / ".join(f"{v:.2f}" for v in run.estimate[n]) for run in (plain, best)),
            ]
        )
    caption = (
        f"Table II: estimated d mm / h mm / E kPa, mean of {found.repeats} networks, leave-one-out, {found.main_mm:g} mm. "
        "Phantom 1 (2 mm) is below what the picture shows; its row says what a network answers to next to nothing."
    )
    return head, rows, caption


def _table3(found: Replication) -> tuple[list[str], list[list[str]], str]:
    head = ["estimates", "protocol", "MAE d", "MAE h", "MAE E", "RMSE d", "RMSE h", "RMSE E", "bias d", "bias h", "bias E"]
    truth = paper.true_inclusions()
    printed = paper.published_errors()
    rows = [
        ["paper, as printed (Table III)", "LOO", *(_short(v, i) for i, v in enumerate(printed)), *["—"] * 6],
        _error_row("paper, from its Table II", "LOO", truth, paper.published_estimates()),
        _error_row("constant: middle of the box", "none", truth, paper.constant(truth, paper.prior_mean())),
        _error_row("constant: mean of the nine", "knows the test", truth, paper.constant(truth)),
    ]
    name, k = found.chosen
    for label, variant, threshold in (
        (f"ours, paper's chain, k = {found.k_dn:g}", "paper", found.k_dn),
        (f"the same, lines through phantoms, k = {found.k_dn:g}", "paper-phantoms", found.k_dn),
        (f"ours, {name}, k = {k:g}", name, k),
    ):
        for protocol, short in (("125/9", f"{found.trained}/9"), ("leave-one-out", "LOO")):
            run = found.run(variant, protocol, (found.main_mm,), threshold)
            rows.append(_error_row(label, short, truth, run.estimate))
    for one in found.earlier:
        rows.append(_error_row(f"{one.name} as guessed", "LOO lines", truth, one.estimate))
    caption = (
        f"Table III, all nine phantoms, mm, mm, kPa; ours at {found.main_mm:g} mm. LOO: leave-one-out; "
        f"{found.trained}/9: trained on the random inclusions, asked for the phantoms."
    )
    return head, rows, caption


def _protocols(made: Page, found: Replication) -> None:
    made.text(
        "The paper says both that 125 samples train and 9 validate, and that leave-one-out is used; and its lines are "
        "fitted to the nine phantoms that are then estimated. Rows above are named by protocol; "
        "'lines through phantoms' is the paper's fit, which under leave-one-out omits the phantom asked for. "
        "All other rows fit the lines to the random inclusions alone."
    )


def _figures(made: Page, found: Replication, corpus: Corpus, main: Scalars, low: Scalars) -> None:
    step = corpus.indentation_mm.index(found.main_mm)
    made.section("Figures 3(c), 4 and 5")
    made.figure(
        figures.relief(corpus, step, main.sample[main.phantoms]),
        f"Fig. 3(c): tared pictures at {found.main_mm:g} mm as a relief. The paper's is of a 2 mm inclusion of another phantom "
        "(MammaCare) of unknown depth; ours at 5 mm drowns in noise.",
        pixels=True,
    )
    made.figure(
        figures.model(corpus, step),
        f"Fig. 4: the finite-element model, phantom 9 under {found.main_mm:g} mm, cut at y = 0, drawn coarse and at small strain.",
        pixels=True,
    )
    made.figure(
        figures.regressions(main, low, found.k_dn, found.low_k_dn),
        "Fig. 5 (a) to (c): regressions over the nine phantoms. Each group of three is divided by its largest, so that "
        "three points lie at (1, 1), which is how we read the paper. Band: 95 % confidence of the line.",
    )


def _chains(made: Page, found: Replication) -> None:
    made.section("Which chain, which threshold, which press")
    made.text(
        "All chains below take the same three tared scalars of one noisy picture. The paper's own comes first; the "
        "others say what its mapping and its joint target cost. Phantom 1 is left out here and stands by itself."
    )
    truth = paper.true_inclusions()
    head = ["chain", "what it is", "press, mm", "k", "RMSE d", "RMSE h", "RMSE E", "phantom 1: d / h / E"]
    rows, strong = [], []
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
                *(_short(v, i) for i, v in enumerate(off)),
                " / ".join(f"{v:.1f}" for v in run.estimate[0]),
            ]
        )
    made.table(head, rows, f"Eight phantoms of 7 mm and more, {found.trained}/9. Shaded: chosen by cross-validation.", strong)
    head = ["chain", "k", "RMSE d", "RMSE h", "RMSE E", "90 % within ± d", "± h", "± E", "explains d %", "h %", "E %"]
    rows, strong = [], []
    for one in found.crossed:
        if (one.variant.name, one.k_dn) == found.chosen:
            strong.append(len(rows))
        rows.append(
            [
                one.variant.name,
                f"{one.k_dn:g}",
                *(_short(v, i) for i, v in enumerate(one.rmse)),
                *(_short(v, i) for i, v in enumerate(one.half_width)),
                *(f"{100 * v:.0f}" for v in one.explained),
            ]
        )
    made.table(
        head,
        rows,
        f"Cross-validated on the random inclusions (five folds), {found.main_mm:g} mm; RMSE of those of 4 mm and more, the rest of "
        f"all. k = {found.low_k_dn:g} counts is the lowest whole count that is 5 times the noise of a pixel of the tared picture "
        f"({found.noise_dn:.2f} counts).",
        strong,
    )
    made.figure(figures.crossed(found), "The chosen chain on the random inclusions, cross-validated. Band: holds 90 %.")


def _modulus(made: Page, found: Replication) -> None:
    best = best_modulus(found)
    made.section("What E is worth")
    made.text(worth_of_modulus(found))
    rows = []
    for n, truth in enumerate(paper.true_inclusions()):
        run = found.run(best.variant.name, "125/9", (found.main_mm,), best.k_dn)
        middle, half = run.estimate[n, 2], best.half_width[2]
        inside = abs(truth[2] - middle) <= half
        rows.append([str(n + 1), f"{truth[2]:g}", f"{middle:.0f}", f"{middle - half:.0f} to {middle + half:.0f}", "yes" if inside else "no"])
    made.table(
        ["no.", "true E, kPa", "estimated", "90 % interval", "holds the truth"],
        rows,
        f"E of the phantoms by the chain that tells most of E ({best.variant.name}, k = {best.k_dn:g}), with the cross-validated interval.",
    )


def _earlier(found: Replication) -> tuple[list[str], list[list[str]], str]:
    truth = paper.true_inclusions()
    head = ["method", "what we ran", *(f"{a} {b}" for a in ("all nine: RMSE", "7 mm and more: RMSE") for b in _LETTERS)]
    rows = []
    for one in found.earlier:
        cells = [_rmse(truth, one.estimate), _rmse(truth[LARGE], one.estimate[LARGE])]
        rows.append([one.name, one.words, *(_short(v, i % 3) for i, v in enumerate(np.concatenate(cells)))])
    return head, rows, f"Same pictures, {found.main_mm:g} mm; k = {found.low_k_dn:g} counts for [11]."


def _limits(found: Replication, corpus: Corpus) -> list[str]:
    plan = corpus.plan
    mechanics = {"emulator": "an emulator of finite-element solutions", "finite": "finite strain, sliding contact"}
    return [
        f"Simulated: mechanics ({mechanics.get(plan.mechanics, 'linear elasticity')}, {plan.quality} quality), light "
        f"({plan.light} quality), camera noise. No nuisance varies: tissue modulus, roughness, LED flux and depth of press are "
        "the same in training and test, and all samples share one Monte Carlo pattern. Real phantoms are worse.",
        "Training and test come from the same simulator (an inverse crime): the figures say what the paper's method can "
        "do with a perfect forward model, not what it does on a bench.",
        "Not checked, for want of real phantoms: silicone's modulus, contact and adhesion, roughness, LED coupling, "
        "position of the probe over the inclusion, and every count in a picture.",
        "Not in the paper and chosen here: press level, k, layers of the guide, slab, distribution of the random inclusions, "
        "layers and stopping of the network (two tanh layers of 10, 15 % of the samples stop the training).",
        "Read into the paper: h is the depth of the inclusion's top; pictures are tared; Fig. 5 is normalised in groups.",
    ]


def _estimates_csv(found: Replication) -> list[dict[str, Any]]:
    truth = paper.true_inclusions()
    none = np.full((9, 3), np.nan)
    sets: list[tuple[str, str, str, float | None, Floats, Floats]] = [
        ("paper-printed", "leave-one-out", "", None, paper.published_estimates(), none),
        ("constant-prior", "none", "", None, paper.constant(truth, paper.prior_mean()), none),
        ("constant-mean", "none", "", None, paper.constant(truth), none),
    ]
    sets += [
        (run.variant.name, run.protocol, _levels(run), run.k_dn, run.estimate, run.spread) for run in found.runs
    ]
    sets += [(one.name, "leave-one-out lines", f"{found.main_mm:g}", found.low_k_dn, one.estimate, none) for one in found.earlier]
    rows = []
    for name, protocol, mm, k, estimate, spread in sets:
        for n in range(9):
            row: dict[str, Any] = {"method": name, "protocol": protocol, "press_mm": mm, "k_dn": k, "phantom": n + 1}
            for i, key in enumerate(paper.PARAMETERS):
                row |= {f"true_{key}": truth[n, i], key: estimate[n, i], f"sd_{key}": spread[n, i]}
            rows.append(row)
    return rows


def _errors_csv(content: dict[str, Any]) -> list[dict[str, Any]]:
    sets = [("paper-printed", "leave-one-out", "", None, content["paper"]["recomputed"])]
    sets += [(f"constant-{name}", "none", "", None, one) for name, one in content["constants"].items()]
    sets += [
        (run["variant"], run["protocol"], "+".join(f"{mm:g}" for mm in run["level_mm"]), run["k_dn"], run)
        for run in content["runs"]
    ]
    sets += [(one["name"], "leave-one-out lines", f"{content['main_mm']:g}", content["low_k_dn"], one) for one in content["earlier"]]
    rows = []
    for name, protocol, mm, k, one in sets:
        for which in ("all", "large"):
            row: dict[str, Any] = {"method": name, "protocol": protocol, "press_mm": mm, "k_dn": k, "phantoms": which}
            for kind in ("mae", "rmse", "bias"):
                row |= {f"{kind}_{key}": one[which][kind][i] for i, key in enumerate(paper.PARAMETERS)}
            rows.append(row)
    return rows


def _levels(run: Run) -> str:
    return "+".join(f"{mm:g}" for mm in run.level_mm)


def _error_row(label: str, protocol: str, truth: Floats, estimate: Floats) -> list[str]:
    found = paper.errors(truth, estimate)
    values = [*found.mae, *found.rmse, *found.bias]
    return [label, protocol, *(_short(v, i % 3) for i, v in enumerate(values))]


def _rmse(truth: Floats, estimate: Floats) -> Floats:
    return paper.rmse(truth, estimate)


def _short(value: float, parameter: int) -> str:
    """A length with two digits after the point, a modulus with one."""
    if not np.isfinite(value):
        return "—"
    text = f"{value:.1f}" if parameter == 2 else f"{value:.2f}"
    return text.replace("-", "−") if float(text) else text.lstrip("-")


