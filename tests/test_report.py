"""The page of results: self-contained, the same bytes again, numbers as a person writes them."""

import json
import re

import numpy as np
import pytest

from twin.report import Page, digits, panels, png, svg, write_csv, write_json


def drawing() -> object:
    figure, axes = panels(1, 2, 2.0)
    axes[0].plot([0, 1], [0, 1])
    axes[1].set_title("<b>")
    return figure


def test_page_needs_no_network_and_escapes_what_it_is_given() -> None:
    page = Page("A & B", "x < y").section("One").text("a <script>").table(["n"], [["<i>"]], "c")
    text = page.verdict("v").bullets(["w"]).figure(drawing(), "a figure").html()
    assert not re.search(r'(src|href)="(?!data:|#)', text)
    assert "<script>" not in text and "<i>" not in text and "a &lt;script&gt;" in text
    assert text.count("<h2") == 1 and 'href="#s1"' in text


def test_figures_are_the_same_bytes_again() -> None:
    assert svg(drawing()) == svg(drawing())
    assert png(drawing()) == png(drawing())


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (0.0, "0"),
        (1234.6, "1235"),
        (123456.0, "123,456"),
        (0.012345, "0.0123"),
        (1.5e-7, "1.50e-07"),
        (-2.0, "-2.00"),
    ],
)
def test_digits(value: float, text: str) -> None:
    assert digits(value) == text
    assert digits(None) == digits(np.nan) == "—"


def test_numbers_reach_json_and_csv(tmp_path) -> None:
    rows = [{"a": np.float64(1 / 3), "b": None}, {"a": np.nan, "b": "x"}]
    write_json(tmp_path / "a.json", {"rows": rows, "array": np.eye(2), 3: np.int64(4)})
    assert json.loads((tmp_path / "a.json").read_text()) == {
        "rows": [{"a": 1 / 3, "b": None}, {"a": None, "b": "x"}],
        "array": [[1, 0], [0, 1]],
        "3": 4,
    }
    write_csv(tmp_path / "a.csv", rows)
    assert (tmp_path / "a.csv").read_text() == "a,b\n0.333333333,\n,x\n"
