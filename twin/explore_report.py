"""The page of a layout study: what to build and why, the front, the best layouts beside the baseline.

explore_report.write("out/leds")    # reads the study's folder, writes out/leds/report.html
"""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np

from estimation.budget import Budget
from twin import explore_figures as figures
from twin import explore_leds
from twin.complaint import DesignError
from twin.explore_front import front
from twin.explore_results import Importance, Results, Trial, importances, read
from twin.explore_verdict import design_of, in_words, verdict
from twin.forward import noise_of
from twin.objectives import OBJECTIVES, STANDARD
from twin.report import Page, digits

CONFIRMED = "confirmed.json"
"""What `twin explore --confirm` leaves in the folder."""

_SYMBOLS = {"size_mm": ("d", "mm"), "depth_mm": ("h", "mm"), "modulus_kPa": ("E", "kPa")}
_COPY = """\
<script>
document.querySelectorAll('button[data-copy]').forEach(function (button) {
  button.addEventListener('click', function () {
    var text = document.getElementById(button.dataset.copy).textContent;
    var done = function () { button.textContent = 'copied'; };
    if (navigator.clipboard) navigator.clipboard.writeText(text).then(done, function () {});
  });
});
</script>"""
_STYLE = """\
<style>
details { margin: .5rem 0; } summary { cursor: pointer; font-weight: 600; }
pre { background: #f6f8fa; padding: .7rem .9rem; overflow: auto; max-height: 22rem; font-size: .8rem;
      line-height: 1.4; }
.get { font-size: .88rem; margin: .4rem 0; } .get a { color: #2b6ca3; margin-right: 1rem; }
button { font: inherit; font-size: .85rem; }
</style>"""


def write(folder: str | Path) -> Path:
    """Write report.html into a study's folder and return its path; raises `DesignError` in one line."""
    place, results = Path(folder) / "report.html", read(folder)
    best = [(one.folder, dict(one.values)) for one in results.best()[:1]]
    # Without the emulator that the study was made with, the page stands without that section.
    with suppress(DesignError, OSError):
        explore_leds.find(Path(folder), [(results.baseline.folder, None), *best])
    page(results).write(place)
    return place


def page(results: Results) -> Page:
    """Return the report of a study."""
    mattered = importances(results)
    best = results.best()
    many = len(results.trials)
    tried = f"{many} layout{'' if many == 1 else 's'} judged"
    if results.infeasible:
        tried += f", {len(results.infeasible)} that could not be or miss a constraint"
    made = Page(f"Layouts: {results.name}", " ".join(filter(None, [results.question, f"{tried}."])))
    made.verdict(*verdict(results, mattered))
    if results.description:
        made.text(results.description)
    made.section("All layouts")
    made.markup(front(results))
    made.text(
        "Choose the axes; click a point, or press the left and right keys, for its values. Bounds are the "
        "least standard deviations that any estimator can reach with what was known before (the prior), root "
        "mean square over the study's inclusions."
    )
    _best(made, results, [results.baseline, *best])
    _known(made, results, [results.baseline, *best])
    if mattered:
        _mattered(made, mattered, len(results.trials))
    _leds(made, [results.baseline, *best[:1]])
    _designs(made, results, best)
    _confirmed(made, results.folder / CONFIRMED)
    _limits(made, results)
    return made


def _best(made: Page, results: Results, shown: Sequence[Trial]) -> None:
    made.section("Best beside the baseline")
    fields = [name for name in results.fields() if any(name in one.values for one in shown)]
    rows = [[name, *(in_words(one.values.get(name, "—")) for one in shown)] for name in fields]
    strong = []
    for name, objective in OBJECTIVES.items():
        if not any(name in one.objectives for one in shown):
            continue
        if name in results.objectives:
            strong.append(len(rows))
        rows.append([objective.text, *(_found(one.objectives.get(name)) for one in shown)])
    made.table(
        ["", *(one.name for one in shown)],
        rows,
        "Fields of the study, then all objectives; shaded: those it searched by.",
        strong,
    )
    designs = [design_of(one) for one in shown]
    held = [(one, design) for one, design in zip(shown, designs, strict=True) if design is not None]
    if not held:
        return
    trials = [one for one, _ in held]
    noises = [noise_of(design, _frames(one)) for one, design in held]
    extent = [(design.camera.field_of_view_mm, design.camera.field_height_mm) for _, design in held]
    full = [2.0**design.camera.bits - 1.0 for _, design in held]
    ball = figures.inclusion_label(trials[0].told["inclusions"][0]).replace("\n", ", ")
    depth = _levels(shown[0])[0]
    made.figure(
        figures.layouts(trials, noises, extent, [_press(one, depth) for one in trials], full),
        f"The press nearest to {depth:g} mm on the first inclusion ({ball}; mm and kPa). Right: what "
        "one more mm of d and of h and 10 kPa of E add to each pixel, in standard deviations of its noise as "
        "the protocol averages it; the same scale in each column.",
        pixels=True,
    )
    if not any(name in figures.UNITS for name in trials[0].told["inclusions"][0]["sd"]):
        return
    made.figure(
        figures.bounds(trials),
        "Prior-included bound on each inclusion; the others of the unknowns are unknown within their priors.",
    )


def _known(made: Page, results: Results, shown: Sequence[Trial]) -> None:
    made.section("Costs and detection")
    told = [one for one in shown[:2] if _has_budget(one)]
    if told:
        known = told[0].budgets()[0].wanted
        wanted = "modulus_kPa" if "modulus_kPa" in known else known[-1]
        made.figure(
            figures.budget(told, wanted),
            f"Error budget of {_SYMBOLS[wanted][0]}: what a bound loses when one of the unknowns becomes "
            "known, exactly (grey) or twice as well as now (colour): the calibration, or the averaging, that "
            "would buy most stands on top. The unknowns share what they cost: the bars do not add up.",
        )
        budgets = [one.budgets() for one in told]
        made.table(
            [
                "bound, rms over inclusions",
                *(f"{one.name}: {x}" for one in told for x in ("now", "all known")),
            ],
            _budget_rows(budgets),
            "All known: with every unknown but d, h and E known exactly, so that noise alone is left.",
        )
    if any("detection_depth_mm" in one.objectives for one in shown):
        design = design_of(shown[0])
        slab = 30.0 if design is None else design.specimen.thickness_mm
        made.figure(
            figures.found_by_depth(shown, STANDARD, slab),
            "Smallest stiff inclusion that is found (ideal observer, AUC 0.99) over its depth: from where "
            f"one of {STANDARD[0]:g} mm is lost, by the far field of a sphere, d³ / (h + d/2)². A floor that "
            "noise sets, for comparing layouts: model and tissue are taken as exact and even.",
        )


def _budget_rows(budgets: Sequence[Sequence[Budget]]) -> list[list[str]]:
    rows = []
    for number, name in enumerate(budgets[0][0].wanted):
        symbol, unit = _SYMBOLS[name]
        cells = []
        for one in budgets:
            for values in ([each.sd for each in one], [each.best for each in one]):
                cells.append(digits(float(np.sqrt(np.mean([value[number] ** 2 for value in values])))))
        rows.append([f"{symbol}, {unit}", *cells])
    return rows


def _mattered(made: Page, mattered: Sequence[Importance], count: int) -> None:
    made.section("Fields that mattered")
    ways = "; ".join(dict.fromkeys(one.way for one in mattered))
    chance = 100.0 / np.sqrt(count)
    made.figure(
        figures.importance(mattered),
        "Share of each field in how far the objective varies over the layouts that were tried: "
        f"{ways}. Nothing is said outside the study's ranges; shares below {chance:.0f} % may be chance.",
    )


def _leds(made: Page, shown: Sequence[Trial]) -> None:
    """Settings of the LEDs, from light that is there already."""
    told = [(one, found) for one in shown if (found := explore_leds.read(one.folder)) is not None]
    if not told:
        return
    made.section("LED by LED")
    for one, found in told:
        names = found["names"]
        head = ["setting", "times the design's flux", "W at once", "brightest, %"]
        head += [f"bound on {_SYMBOLS[name][0]}, {_SYMBOLS[name][1]}" for name in names]
        rows = [
            [
                row["words"],
                " / ".join(digits(value, 2) for value in row["intensity"]),
                digits(row["power_W"]),
                f"{100 * row['full']:.0f}",
                *(digits(value) for value in row["sd"]),
            ]
            for row in found["settings"]
        ]
        best = found["settings"][1]["intensity"]
        for place, share, sd in zip(found["leds"], best, found["dark"], strict=False):
            at_best = f"{digits(share, 2)} in the best"
            rows.append([f"LED {place}: dark", at_best, "", "", *(digits(value) for value in sd)])
        low, high = found["binning"]
        spread = [f"{digits(a)} to {digits(b)}" for a, b in zip(low, high, strict=True)]
        rows.append([f"bin of ± {100 * found['tolerance']:.0f} %, 9 of 10 sensors", "", "", "", *spread])
        made.table(
            head,
            rows,
            f"{one.name}: light is linear, so no picture was rendered for these. Brightest: a pixel over "
            "what the camera takes, less four standard deviations; fluxes, other than drift, are known.",
        )


def _designs(made: Page, results: Results, best: Sequence[Trial]) -> None:
    made.section("Designs")
    if not best:
        made.text("None.")
        return
    made.text("Each is a whole design: save it and press an inclusion with it.")
    parts = [_STYLE]
    for number, trial in enumerate(best):
        try:
            text = trial.design_toml
        except OSError:
            continue
        file = f"{results.name}-{trial.number}.toml"
        link = base64.b64encode(text.encode()).decode()
        command = (
            f"twin simulate {file} --size 10 --depth 5 --modulus 100 --indentation "
            f"{' '.join(f'{level:g}' for level in _levels(trial))} --out out/{results.name}-{trial.number}"
        )
        parts.append(
            f"<details{' open' if number == 0 else ''}><summary>{html.escape(trial.name)}</summary>\n"
            f'<p class="get"><a download="{html.escape(file, quote=True)}" '
            f'href="data:application/toml;base64,{link}">save {html.escape(file)}</a>'
            f'<button data-copy="toml-{number}">copy</button></p>\n'
            f'<pre>{html.escape(command)}</pre>\n<pre id="toml-{number}">{html.escape(text)}</pre></details>'
        )
    made.markup("\n".join([*parts, _COPY]))


def _confirmed(made: Page, file: Path) -> None:
    """What `twin explore --confirm` found."""
    if file.is_file():
        made.section("Light followed ray by ray")
        made.bullets(json.loads(file.read_bytes())["lines"])


def _limits(made: Page, results: Results) -> None:
    made.section("Limits")
    if results.infeasible:
        kinds: dict[str, list[str]] = {}
        for one in results.infeasible:
            reason = str(one.reason)
            kinds.setdefault(reason.partition(":")[0], []).append(reason)
        most = sorted(kinds.items(), key=lambda item: -len(item[1]))[:12]
        made.table(
            ["what", "layouts", "for example"],
            [[what, str(len(reasons)), reasons[0].partition(": ")[2]] for what, reasons in most],
            "Layouts that could not be, or that miss a constraint.",
        )
    seconds = [one.told.get("seconds", {}) for one in results.trials]
    parts = "mechanics", "light", "information"
    spent = {name: sum(one.get(name, 0.0) for one in seconds) for name in parts}
    inclusions = results.baseline.told.get("inclusions", [])
    balls = "; ".join(figures.inclusion_label(one).replace("\n", ", ") for one in inclusions)
    items = [
        f"Inclusions (mm, kPa): {balls}.",
        "Bounds are of the linearised model about each inclusion with normal priors, and of the twin's own "
        "physics: a real sensor that differs from it does worse.",
        "Time over all layouts: " + ", ".join(f"{name} {value:.0f} s" for name, value in spent.items()) + ".",
    ]
    if results.constraints:
        items.append("Constraints: " + "; ".join(results.constraints) + ".")
    made.bullets(items)


def _frames(trial: Trial) -> int:
    return int(trial.told.get("protocol", {}).get("frames", 1))


def _levels(trial: Trial) -> list[float]:
    return [float(level) for level in trial.told.get("protocol", {}).get("indentation_mm", [2.0])]


def _press(trial: Trial, depth: float) -> tuple[int, float]:
    """Number and depth of the press at the first place that is nearest to a depth."""
    levels = _levels(trial)
    number = min(range(len(levels)), key=lambda k: abs(levels[k] - depth))
    return number, levels[number]


def _has_budget(trial: Trial) -> bool:
    try:
        return bool(trial.budgets())
    except (OSError, KeyError, ValueError):
        return False


def _found(value: float | None) -> str:
    """An objective: whole numbers as such."""
    return f"{value:.0f}" if value is not None and value == round(value) else digits(value)
