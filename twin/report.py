"""A page of results in one file, HTML that needs no network: text, tables, figures; CSV and JSON beside it.

    page = Page("Mapping", "what the corpus says")
    page.section("Lines").text("...").table(["k", "R²"], [["2", "0.99"]]).figure(figure, "caption")
    page.write(folder / "report.html")

Figures are matplotlib's, as SVG inside the file, and the same
input gives the same bytes.
"""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.figure import Figure

INK, BLUE, RED, GREY, GREEN = "#222222", "#2b6ca3", "#c2452d", "#8a8a8a", "#3a8f4d"
"""Colours of all figures: text, ours, what is compared with, what stands behind, a second of ours."""

_WIDTH = 10.4  # inches of a figure as wide as the page

_STYLE = """\
:root { color-scheme: light; }
body { font: 16px/1.5 system-ui, -apple-system, "Segoe UI", Roboto, sans-serif; color: #222; background: #fff;
       max-width: 1180px; margin: 2rem auto; padding: 0 1.2rem; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .2rem; }
h2 { font-size: 1.25rem; margin: 2.4rem 0 .5rem; border-bottom: 1px solid #ddd; padding-bottom: .2rem; }
p { max-width: 78ch; margin: .6rem 0; }
.lead { color: #555; margin-top: 0; }
.verdict { background: #f1f5f9; border-left: 4px solid #2b6ca3; padding: .6rem 1rem; margin: 1rem 0; }
.verdict p { margin: .3rem 0; max-width: none; }
ul { max-width: 78ch; }
figure { margin: 1rem 0 1.4rem; max-width: 1080px; }
figure img { width: 100%; height: auto; display: block; }
figcaption, caption { color: #555; font-size: .88rem; text-align: left; max-width: 95ch; }
caption { padding: .4rem 0; caption-side: top; }
.wide { overflow-x: auto; }
table { border-collapse: collapse; font-size: .88rem; margin: .8rem 0 1.2rem;
        font-variant-numeric: tabular-nums; }
th, td { padding: .22rem .45rem; text-align: right; border-bottom: 1px solid #e5e5e5; white-space: nowrap; }
th { border-bottom: 2px solid #999; vertical-align: bottom; font-weight: 600; }
th:first-child, td:first-child { text-align: left; padding-left: 0; }
th.text, td.text { text-align: left; }
td.long { white-space: normal; max-width: 52ch; }
tr.strong td { font-weight: 600; background: #f1f5f9; }
nav { font-size: .92rem; margin: 1rem 0; }
nav a { color: #2b6ca3; margin-right: 1.1rem; text-decoration: none; }
@media print { body { max-width: none; } }
"""


class Page:
    """An HTML page that grows from top to bottom; every method returns it."""

    def __init__(self, title: str, lead: str = "") -> None:
        self.title, self.lead = title, lead
        self._sections: list[tuple[str, str]] = []
        self._parts: list[str] = []

    def section(self, title: str) -> Page:
        """Begin a section, listed at the top of the page."""
        name = f"s{len(self._sections) + 1}"
        self._sections.append((name, title))
        return self._put(f'<h2 id="{name}">{html.escape(title)}</h2>')

    def text(self, *paragraphs: str) -> Page:
        """Add paragraphs of plain text."""
        return self._put("\n".join(f"<p>{html.escape(text)}</p>" for text in paragraphs))

    def verdict(self, *lines: str) -> Page:
        """Add what a reader in a hurry takes away."""
        inner = "".join(f"<p>{html.escape(line)}</p>" for line in lines)
        return self._put(f'<div class="verdict">{inner}</div>')

    def bullets(self, items: Sequence[str]) -> Page:
        """Add a list."""
        return self._put("<ul>" + "".join(f"<li>{html.escape(item)}</li>" for item in items) + "</ul>")

    def table(
        self,
        head: Sequence[str],
        rows: Sequence[Sequence[Any]],
        caption: str = "",
        strong: Sequence[int] = (),
    ) -> Page:
        """Add a table of cells that are shown as they are; rows in `strong` stand out.

        Columns of words are set to the left; a cell of more than 40 characters may wrap.
        """
        wordy = [_is_wordy([str(row[place]) for row in rows]) for place in range(len(head))]
        top = "".join(
            f"<th{' class=text' if words else ''}>{html.escape(name)}</th>"
            for name, words in zip(head, wordy, strict=True)
        )
        lines = []
        for number, row in enumerate(rows):
            cells = "".join(_cell(str(value), words) for value, words in zip(row, wordy, strict=True))
            lines.append(f"<tr{' class=strong' if number in strong else ''}>{cells}</tr>")
        said = f"<caption>{html.escape(caption)}</caption>" if caption else ""
        body = "\n".join(lines)
        return self._put(
            f'<div class="wide"><table>{said}<thead><tr>{top}</tr></thead>\n'
            f"<tbody>{body}</tbody></table></div>"
        )

    def figure(self, figure: Figure, caption: str, *, pixels: bool = False) -> Page:
        """Add a figure as wide as the page; as pixels where its parts are many."""
        if pixels:
            return self.picture(png(figure), caption)
        return self.picture(svg(figure), caption, "svg+xml")

    def picture(self, made: bytes, caption: str, kind: str = "png") -> Page:
        """Add a picture of a file's bytes, as wide as the page."""
        data = base64.b64encode(made).decode()
        return self._put(
            f'<figure><img alt="{html.escape(caption, quote=True)}" src="data:image/{kind};base64,{data}">'
            f"<figcaption>{html.escape(caption)}</figcaption></figure>"
        )

    def markup(self, part: str) -> Page:
        """Add HTML as it is: whoever made it has escaped what it was given, and loads nothing."""
        return self._put(part)

    def html(self) -> str:
        """Return the whole page."""
        links = "".join(f'<a href="#{name}">{html.escape(title)}</a>' for name, title in self._sections)
        body = "\n".join(self._parts)
        return (
            '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
            '<meta name="viewport" content="width=device-width, initial-scale=1">'
            f"<title>{html.escape(self.title)}</title>\n<style>\n{_STYLE}</style></head>\n<body>\n"
            f'<h1>{html.escape(self.title)}</h1>\n<p class="lead">{html.escape(self.lead)}</p>\n'
            f"<nav>{links}</nav>\n{body}\n</body></html>\n"
        )

    def write(self, place: Path) -> None:
        """Write the page."""
        place.write_text(self.html(), encoding="utf-8")

    def _put(self, part: str) -> Page:
        self._parts.append(part)
        return self


def panels(rows: int, columns: int, height: float) -> tuple[Figure, list[Axes]]:
    """Return a figure as wide as the page with panels `height` inches high, row by row."""
    figure = Figure(figsize=(_WIDTH, rows * height), facecolor="white", layout="constrained")
    figure.get_layout_engine().set(w_pad=0.08, h_pad=0.06)
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    for axis in axes:
        plain(axis)
    return figure, axes


def plain(axis: Axes) -> Axes:
    """Take the frame off a panel, but for its two axes; small tick labels."""
    axis.tick_params(labelsize=8.5, colors=INK)
    axis.xaxis.label.set_size(9.5)
    axis.yaxis.label.set_size(9.5)
    for side in ("top", "right"):
        axis.spines[side].set_visible(False)
    return axis


def svg(figure: Figure) -> bytes:
    """Return a figure as SVG; the same figure gives the same bytes."""
    stream = io.BytesIO()
    with rc_context({"svg.hashsalt": "tsis", "svg.fonttype": "path", "font.family": "DejaVu Sans"}):
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None}, dpi=150)
    return stream.getvalue()


def png(figure: Figure) -> bytes:
    """Return a figure as PNG, sharp at twice the page's width; the same figure gives the same bytes."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=160, metadata={"Software": None})
    return stream.getvalue()


def write_json(place: Path, content: Any) -> None:
    """Write numbers, lists and mappings, numpy's too; NaN and infinity as null."""
    text = json.dumps(plainly(content), indent=1, ensure_ascii=False, allow_nan=False)
    place.write_text(text + "\n", encoding="utf-8")


def write_csv(place: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """Write rows under the names of the first; floats with 9 digits, what is not known empty."""
    with open(place, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(rows[0])
        for row in rows:
            writer.writerow([_text(row[name]) for name in rows[0]])


def plainly(content: Any) -> Any:
    """Return what JSON can hold."""
    if isinstance(content, Mapping):
        return {str(key): plainly(value) for key, value in content.items()}
    if isinstance(content, np.ndarray):
        return plainly(content.tolist())
    if isinstance(content, (list, tuple)):
        return [plainly(value) for value in content]
    if isinstance(content, np.generic):
        return plainly(content.item())
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    return content


def digits(value: float | None, count: int = 3) -> str:
    """Return a number with so many digits, no exponent between 1e-4 and 1e7; — for what is not known."""
    if value is None or not math.isfinite(value):
        return "—"
    if value == 0:
        return "0"
    power = math.floor(math.log10(abs(value)))
    if not -4 <= power < 7:
        return f"{value:.{count - 1}e}"
    text = f"{value:.{max(count - 1 - power, 0)}f}"
    return text if abs(float(text)) < 10_000 else f"{float(text):,.0f}"


def _cell(value: str, words: bool) -> str:
    kinds = " ".join(filter(None, ["text" if words else "", "long" if len(value) > 40 else ""]))
    named = f' class="{kinds}"' if kinds else ""
    return f"<td{named}>{html.escape(value)}</td>"


def _is_wordy(cells: Sequence[str]) -> bool:
    """Whether most of a column's cells begin with a letter; dashes stand for either."""
    known = [cell for cell in cells if cell not in ("", "—")]
    return 2 * sum(cell[0].isalpha() for cell in known) > len(known)


def _text(value: Any) -> str:
    value = value.item() if isinstance(value, np.generic) else value
    if value is None or (isinstance(value, float) and not math.isfinite(value)):
        return ""
    return f"{value:.9g}" if isinstance(value, float) else str(value)
