"""`twin map`: the mapping of one corpus or several as a page, CSV, JSON and a short table."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from twin import mapping_figures as figures
from twin.design import Design
from twin.fields import flat
from twin.mapping import MOST, Mapped, labels, map_corpus, open_corpus
from twin.mapping_verdict import AtThreshold, area_r2, at_thresholds, headline, verdict
from twin.report import Page, digits, write_csv, write_json
from twin.stage import has_keys, staged
from twin.thresholds import PICTURE_STEPS, SIGMAS, Swept, sweep

if TYPE_CHECKING:
    from twin.corpus import Corpus

Floats = NDArray[np.float64]

FILES = {"report.html", "map.csv", "thresholds.csv", "map.json"}


@dataclass(frozen=True)
class One:
    """The mapping of one corpus.

    Attributes
    ----------
    maps : all press levels and kinds.
    level_mm : the level of figures and verdict.
    swept, ks, area : other thresholds at that level; R² (p, s) of the area for each pair of them.
    depth : sample number to the inclusion's depth, mm.
    """

    label: str
    corpus: Corpus
    maps: list[Mapped]
    kind: str
    level_mm: float
    swept: Swept
    ks: list[AtThreshold]
    area: Floats
    depth: dict[int, float]
    lines: list[str]

    def shown(self, kind: str | None = None) -> list[Mapped]:
        """The three maps of the level that is shown."""
        return [one for one in self.maps if (one.kind, one.level_mm) == (kind or self.kind, self.level_mm)]


def study(
    paths: Sequence[str | Path],
    level_mm: float | None = None,
    raw: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> list[One]:
    """Map the corpora. Raises `DesignError` in one line."""
    tell = progress or (lambda stage, done: None)
    corpora = [open_corpus(path) for path in paths]
    kind = "raw" if raw else "tared"
    names = labels(corpora)
    mapped = [map_corpus(corpus, label, level_mm) for corpus, label in zip(corpora, names, strict=True)]
    # Corpora are compared at one level, where they share one: that of the first.
    first = headline(mapped[0], kind)
    found = []
    for number, (corpus, label, maps) in enumerate(zip(corpora, names, mapped, strict=True)):
        level = first if first in corpus.indentation_mm else headline(maps, kind)
        step = corpus.indentation_mm.index(level)
        swept = sweep(
            corpus,
            step,
            picture_k=_thresholds(corpus, step),
            progress=partial(_tell_part, tell, number, len(corpora)),
        )
        rows = [corpus.row(int(sample), step) for sample in swept.sample]
        columns = [
            corpus.table[f"fem_tared_{name}"].to_numpy(np.float64)[rows] for name in ("max_mm", "area_mm2")
        ]
        ks = at_thresholds(swept, columns[0], columns[1], corpus.shape[0] * corpus.shape[1])
        table = corpus.table.iloc[:: corpus.levels]
        depth = dict(zip(table["sample"].tolist(), table["depth_mm"].tolist(), strict=True))
        lines = verdict(maps, kind, level, [] if raw else ks, swept.noise_dn, corpus.design.signal.counts)
        found.append(One(label, corpus, maps, kind, level, swept, ks, area_r2(swept), depth, lines))
    return found


def _thresholds(corpus: Corpus, step: int) -> list[float]:
    """Shares of the design's k, and the lowest whole count that noise allows."""
    k = corpus.design.signal.counts
    noise = sweep(corpus, step, most=8, surface=False, picture_k=[k]).noise_dn
    lowest = float(np.ceil(SIGMAS * noise))
    return sorted({share * k for share in PICTURE_STEPS} | ({lowest} if 0.2 * k <= lowest <= k else set()))


def _tell_part(tell: Callable[[str, float], None], part: int, parts: int, done: int, total: int) -> None:
    tell("pictures", (part + done / total) / parts)


def differences(corpora: Sequence[Corpus]) -> list[list[str]]:
    """Return the fields of the designs that are not the same: name, and the value in each corpus."""
    tables = [flat(TypeAdapter(Design).dump_python(corpus.design, mode="json")) for corpus in corpora]
    rest: list[dict[str, Any]] = [
        {"mechanics of the plan": c.plan.mechanics, "quality": c.plan.quality, "light": c.plan.light}
        for c in corpora
    ]
    tables = [one | more for one, more in zip(tables, rest, strict=True)]
    names = [
        name for name in {key: None for one in tables for key in one} if name not in ("name", "description")
    ]
    rows = [[name, *(str(one.get(name, "—")) for one in tables)] for name in names]
    return [row for row in rows if len(set(row[1:])) > 1]


def write(found: Sequence[One], out: str | Path) -> None:
    """Write report.html, map.csv, thresholds.csv and map.json into a folder, all or nothing."""
    with staged(out, _holds_map) as folder:
        write_csv(folder / "map.csv", [one.row() for each in found for one in each.maps])
        write_csv(
            folder / "thresholds.csv",
            [
                {"corpus": each.label, "level_mm": each.level_mm, **asdict(one)}
                for each in found
                for one in each.ks
            ],
        )
        write_json(folder / "map.json", as_json(found))
        page(found).write(folder / "report.html")


def _holds_map(folder: Path) -> bool:
    """Whether a folder holds what `write` wrote, and nothing else."""
    return {entry.name for entry in folder.iterdir()} <= FILES and has_keys(folder / "map.json", "corpora")


def as_json(found: Sequence[One]) -> dict[str, Any]:
    """Return all numbers."""
    return {
        "corpora": [
            {
                "label": one.label,
                "name": one.corpus.name,
                "samples": len(one.corpus),
                "k": {
                    "counts": one.corpus.design.signal.counts,
                    "um": one.corpus.design.signal.displacement_um,
                },
                "level_mm": one.level_mm,
                "kind": one.kind,
                "verdict": one.lines,
                "maps": [mapped.row() for mapped in one.maps],
                "thresholds": [asdict(k) for k in one.ks],
                "noise_dn": one.swept.noise_dn,
                "area_r2": {
                    "picture_k_dn": one.swept.picture_k,
                    "surface_k_um": one.swept.surface_k,
                    "r2": one.area,
                },
                "surface_error": one.swept.surface_error,
            }
            for one in found
        ],
        "differences": differences([one.corpus for one in found]),
    }


def page(found: Sequence[One]) -> Page:
    """Return the report."""
    title = "From surface to picture: " + ", ".join(one.label for one in found)
    made = Page(
        title, "Three scalars of the contact surface against the same three of the picture, by a line each."
    )
    for one in found:
        made.verdict(*([f"{one.label}:"] if len(found) > 1 else []), *one.lines)
    if len(found) > 1:
        made.section("Side by side").table(*_side_by_side(found))
        made.figure(
            figures.compared(found), "The lines of all corpora over the samples that they were fitted to."
        )
        rows = differences([one.corpus for one in found])
        if rows:
            head = ["field", *(one.label for one in found)]
            more = f" (the first 20 of {len(rows)})" if len(rows) > 20 else ""
            made.table(head, rows[:20], "What the corpora's sensors and runs do not have in common" + more)
        else:
            made.text("The corpora have the same sensor and were run alike.")
    for one in found:
        _corpus(made, one, f"{one.label}: " if len(found) > 1 else "")
    made.section("How it is counted").bullets(_NOTES)
    return made


_NOTES = (
    "max is the surface's largest tared displacement and the mean of 3 x 3 pixels at the centroid of what "
    "exceeds k; "
    "total the integral over the surface and the sum over the picture; area where k is exceeded. Tared: "
    "minus the "
    "same press without inclusion. Samples without inclusion are left out; samples without a pixel above k "
    "have "
    "no maximum and no area, and are left out of those two lines.",
    f"Of corpora of more than {MOST} inclusions, so many at even distances are mapped.",
    "A line counts as adequate where its leave-one-out error is at most 5 % of the span of the picture's "
    "scalar and "
    "its bend is insignificant (p >= 0.05) or below 1 % of the span. The range is the widest run of "
    "neighbouring "
    "samples in which that is so; it is the best of many tried.",
    "Intervals are 95 %, for independent normal residuals of one variance. Residuals here follow depth, so "
    "the "
    "intervals describe this corpus, not another distribution of inclusions.",
    "Normalised: both scalars divided by the largest of the corpus, as the paper's Fig. 5 normalises its "
    "groups.",
    "Everything is simulated; how a real sensor maps can only be told by measuring one.",
)


def _corpus(made: Page, one: One, prefix: str) -> None:
    made.section(f"{prefix}Three lines at {one.level_mm:g} mm, {one.kind}")
    made.figure(
        figures.scatter(one),
        "Each dot is an inclusion, its colour the depth of its top. Line with 95 % prediction band; "
        "dashed: parabola; "
        "grey: the range in which the line holds.",
    )
    made.figure(
        figures.residuals(one),
        "What the line leaves, % of the span; dotted: the 5 % that an adequate line may leave on average. "
        "Where colours separate, it is depth that the line cannot know.",
    )
    made.table(*_fits(one.maps))
    made.table(*_adequacy(one.maps))
    made.section(f"{prefix}Press level, tared or raw")
    made.figure(
        figures.levels(one.maps),
        "Solid: tared; dashed: raw. Slopes are relative to the tared ones of the shallowest press (the raw "
        "maximum's is not drawn). Raw area is constant where all of the probe touches, and has no line.",
    )
    made.section(f"{prefix}Threshold k")
    made.figure(
        figures.thresholds(one),
        f"Maximum and area of tared pictures, taken again at other thresholds, {one.level_mm:g} mm. "
        f"Noise of a "
        f"pixel of the tared picture: {one.swept.noise_dn:.2f} counts; left of the dotted line (5 times "
        f"that) noise "
        "makes pixels of its own.",
    )
    head = ["k of the picture, counts", *(f"k of the surface {k:g} µm" for k in one.swept.surface_k)]
    rows = [
        [f"{k:g}", *(digits(v) for v in line)] for k, line in zip(one.swept.picture_k, one.area, strict=True)
    ]
    off = one.swept.surface_error
    made.table(
        head,
        rows,
        "R² of the area's line for pairs of thresholds. The surface's area is counted again from the stored "
        "displacement, within the field of view and in half floats"
        + (
            f"; at the design's k it departs from the record by {100 * off:.1f} % (median)."
            if np.isfinite(off)
            else "."
        ),
    )


def _fits(maps: Sequence[Mapped]) -> tuple[list[str], list[list[str]], str]:
    head = [
        "press",
        "kind",
        "scalar",
        "n",
        "unseen",
        "slope",
        "95 %",
        "intercept",
        "R²",
        "95 %",
        "LOO %",
        "norm. slope",
        "norm. intercept",
    ]
    rows, left_out = list[list[str]](), dict[str, list[str]]()
    for one in maps:
        row = one.row()
        first = [f"{one.level_mm:g} mm", one.kind, one.pair.name, str(len(one.x)), str(one.unseen)]
        if one.fit is None:
            left_out.setdefault(one.why, []).append(f"{one.level_mm:g} mm {one.kind} {one.pair.name}")
            continue
        rows.append(
            [
                *first,
                digits(row["slope"]),
                f"{digits(row['slope_low'])} to {digits(row['slope_high'])}",
                digits(row["intercept"]),
                f"{row['r2']:.3f}",
                f"{row['r2_low']:.3f} to {row['r2_high']:.3f}",
                f"{row['left_out_linear_percent']:.1f}",
                digits(row["normalised_slope"]),
                digits(row["normalised_intercept"]),
            ]
        )
    caption = (
        "The lines, picture = intercept + slope x surface. Units: max counts and µm, total 10⁶ counts and "
        "mm³, area 10³ "
        "pixels and mm². LOO: leave-one-out error (rms), % of the span of the picture's scalar."
    )
    if left_out:
        told = "; ".join(", ".join(names) + f" ({why})" for why, names in left_out.items())
        caption += f" No line: {told}."
    return head, rows, caption


def _adequacy(maps: Sequence[Mapped]) -> tuple[list[str], list[list[str]], str]:
    head = [
        "press",
        "kind",
        "scalar",
        "line %",
        "parabola %",
        "monotone %",
        "bow %",
        "p of the bend",
        "adequate",
        "holds from",
        "to",
        "samples",
    ]
    rows = []
    for one in maps:
        if one.fit is None:
            continue
        row = one.row()
        rows.append(
            [
                f"{one.level_mm:g} mm",
                one.kind,
                one.pair.name,
                *(f"{row[f'left_out_{name}_percent']:.1f}" for name in ("linear", "quadratic", "monotone")),
                f"{row['bow_percent']:.1f}",
                f"{row['p_bend']:.1g}",
                "yes" if row["adequate"] else "no",
                digits(row["range_from"]),
                digits(row["range_to"]),
                str(row["range_samples"]),
            ]
        )
    return (
        head,
        rows,
        "Is a line adequate? Leave-one-out errors of three fits, % of the span; range in the surface's unit.",
    )


def _side_by_side(found: Sequence[One]) -> tuple[list[str], list[list[str]], str]:
    head = ["corpus", "press", "scalar", "n", "unseen", "slope", "95 %", "R²", "LOO %", "line adequate"]
    rows = []
    for each in found:
        for one in each.shown():
            row = one.row()
            rows.append(
                [
                    each.label,
                    f"{one.level_mm:g} mm",
                    one.pair.name,
                    str(len(one.x)),
                    str(one.unseen),
                    digits(row["slope"]),
                    "" if one.fit is None else f"{digits(row['slope_low'])} to {digits(row['slope_high'])}",
                    digits(row["r2"]),
                    digits(row["left_out_linear_percent"], 2),
                    {True: "yes", False: "no", None: "—"}[row["adequate"]],
                ]
            )
    return head, rows, f"The lines of the {found[0].kind} scalars."
