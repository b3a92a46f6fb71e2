"""The page of an assessment: how near the bound, how sure, what each part of a picture is worth, and what
more samples would buy. It is made of the JSON and PNG files that lie in the folder.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from twin.assess import FRAMES, LEAST_MM
from twin.assessment import METHODS, span
from twin.estimates import NAMES
from twin.report import Page

REPORT = "report.html"
ASSESSMENT, ASSESSED = "assessment.json", "assessment.png"
CURVE, CURVED = "curve.json", "curve.png"
_SIZES = ("4 mm and more", "8 mm and more", "all")
_HEAD = ("d / mm", "h / mm", "E / kPa")
_EXPOSURES = {1: "one exposure", 100: "the mean of 100"}
_BY = {"network": "the network alone", "rendered": "refined by rendering"}


def write(folder: Path) -> Path:
    """Write the page of what lies in the folder, and return its place."""
    record, curve = (_read(folder / name) for name in (ASSESSMENT, CURVE))
    page = Page("How well inclusions are told", _lead(record, curve))
    if record is not None:
        page.verdict(*_verdict(record))
        _estimates(page, record)
        page.picture(
            (folder / ASSESSED).read_bytes(), "Estimates over truth, and how often intervals hold it."
        )
        _presence(page, record)
        _parts(page, record)
    _curve(page, curve, folder)
    page.write(folder / REPORT)
    return folder / REPORT


def _read(place: Path) -> dict[str, Any] | None:
    return json.loads(place.read_bytes()) if place.is_file() else None


def _lead(record: Mapping[str, Any] | None, curve: Mapping[str, Any] | None) -> str:
    if record is None:
        return "" if curve is None else f"corpus {curve['corpus']}"
    return f"{record['inclusions']} inclusions and {record['blanks']} blanks of {record['corpus_name']}"


def _there(record: Mapping[str, Any]) -> list[int]:
    return [frames for frames in FRAMES if str(frames) in record]


def _told(record: Mapping[str, Any], frames: int) -> tuple[str, dict[str, Any]]:
    """The best method that was tried, and its figures."""
    part = record[str(frames)]
    method = next(method for method in reversed(METHODS) if method in part)
    return method, part[method]


def _verdict(record: Mapping[str, Any]) -> list[str]:
    lines = []
    for frames in _there(record):
        method, one = _told(record, frames)
        part = one.get(_SIZES[0])
        if not part:
            continue
        size, depth, modulus = (f"{part['rmse'][key]:.3g}" for key in NAMES)
        over = ", ".join(f"{part['over_bound'][key]:.2f}" for key in NAMES)
        held = ", ".join(f"{100 * share:.0f}" for share in one["covered_90"].values())
        lines.append(
            f"From {_EXPOSURES[frames]}, {_BY[method]}, {part['samples']} inclusions of {LEAST_MM:g} mm "
            f"and more are told to {size} mm, {depth} mm and {modulus} kPa: {over} times the bound. "
            f"90 % intervals hold the truth in {held} %."
        )
    return lines


def _estimates(page: Page, record: Mapping[str, Any]) -> None:
    rows, strong = [], []
    sure = []
    for frames in _there(record):
        for method in METHODS:
            one = record[str(frames)].get(method)
            if not one:
                continue
            for size in _SIZES:
                if part := one.get(size):
                    cells = [f"{part['rmse'][k]:.3g} ({part['over_bound'][k]:.2f})" for k in NAMES]
                    share = f"{100 * part['explained'][NAMES[2]]:.0f} %"
                    rows.append([_EXPOSURES[frames], _BY[method], size, part["samples"], *cells, share])
                    if method == _told(record, frames)[0] and size == _SIZES[0]:
                        strong.append(len(rows) - 1)
            held = [f"{100 * share:.0f} %" for share in one["covered_90"].values()]
            ranks = [f"{p:.2g}" for p in one["rank_p"].values()]
            sure.append([_EXPOSURES[frames], _BY[method], *held, *ranks])
    page.section("Errors and the bound")
    page.table(
        ["pictures", "answered by", "inclusions", "n", *_HEAD, "E explained"],
        rows,
        "Root mean square errors, in brackets over the bound of the same forward model with the prior in it. "
        "Explained: (prior² - error²) / (prior² - bound²).",
        strong,
    )
    page.section("How sure")
    page.table(
        [
            "pictures",
            "answered by",
            *(f"{h.split()[0]} held" for h in _HEAD),
            *(f"{h.split()[0]} ranks" for h in _HEAD),
        ],
        sure,
        "Share of 90 % intervals that hold the truth; chance of the truths' ranks if posteriors are right.",
    )


def _presence(page: Page, record: Mapping[str, Any]) -> None:
    rows = []
    for frames in _there(record):
        for cell in record[str(frames)]["presence"].get("beside_ideal") or ():
            size, depth = (span(*cell[name]) for name in ("size_mm", "depth_mm"))
            figures = [f"{cell['area']:.3f}", f"{cell['ideal']:.3f}"]
            rows.append([_EXPOSURES[frames], size, depth, cell["inclusions"], *figures])
    if rows:
        page.section("Inclusion or none")
        page.table(
            ["pictures", "size", "depth", "n", "area", "ideal observer"],
            rows,
            "Area under the curve of the probability of an inclusion, against specimens without.",
        )


def _parts(page: Page, record: Mapping[str, Any]) -> None:
    if not record["bound_by_part"]:
        return
    page.section("What each part of the pictures is worth")
    page.table(
        ["what is looked at", *_HEAD],
        [[name, *(f"{sd[key]:.3g}" for key in NAMES)] for name, sd in record["bound_by_part"].items()],
        f"Bounds, root mean square over the inclusions of {LEAST_MM:g} mm and more.",
    )


def _curve(page: Page, curve: Mapping[str, Any] | None, folder: Path) -> None:
    page.section("What more samples buy")
    if curve is None:
        page.text("Not tried: `twin assess MODEL CORPUS --curve` with this folder as --out.")
        return
    rows = [[row["samples"], *(f"{value:.3g}" for value in row["rmse"])] for row in curve["curve"]]
    rows.append(["bound", *(f"{value:.3g}" for value in curve["bound"])])
    page.table(
        ["samples that light was learned from", *_HEAD],
        rows,
        f"Root mean square errors of {curve['tested']} inclusions of {LEAST_MM:g} mm and more from one "
        "exposure, by the fit alone, without rendering. The bound knows the ranges' spread, not their ends.",
        [len(rows) - 1],
    )
    chance = 100 / (2 * curve["tested"]) ** 0.5
    page.picture(
        (folder / CURVED).read_bytes(),
        f"The same, over the number of samples. Bars: {chance:.0f} %, the standard error of a root mean "
        f"square of {curve['tested']} normal errors; points share their inclusions, so that steps are known "
        "better.",
    )
