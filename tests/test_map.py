"""The mapping of a corpus: lines that are known, what is left out, thresholds from stored pictures."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from estimation import scalars
from tests import browser, painted
from twin import cli, mapping, mapping_report, mapping_verdict, thresholds
from twin.corpus import Corpus

MAX, TOTAL, AREA = mapping.PAIRS


def rows(count: int = 60, seed: int = 3) -> pd.DataFrame:
    """Rows of an index in which the maximum is a line, the total a parabola, the area scatter."""
    rng = np.random.default_rng(seed)
    x = np.linspace(1e-3, 30e-3, count)
    return pd.DataFrame(
        {
            "sample": np.arange(count),
            "fem_tared_max_mm": x,
            "tsis_tared_max_dn": 3.0 + 1500.0 * x + 0.3 * rng.standard_normal(count),
            "fem_tared_total_mm3": 100 * x,
            "tsis_tared_total_dn": 1e6 * (100 * x) ** 2,
            "fem_tared_area_mm2": rng.uniform(0, 600, count),
            "tsis_tared_area_px": rng.uniform(1, 1e5, count),
        }
    )


def test_line_parabola_and_scatter_are_told_apart() -> None:
    table = rows()
    line, bent, scatter = (mapping.map_pair(table, "c", 2.0, "tared", pair) for pair in mapping.PAIRS)
    assert line.fit is not None and bent.fit is not None and scatter.fit is not None
    assert line.fit.adequate and not bent.fit.adequate and not scatter.fit.adequate
    low, high = line.fit.line.slope_interval
    assert low < 1.5 < high and high - low < 0.05  # counts per µm
    assert bent.fit.best == "quadratic" and bent.fit.bow > 0.05
    assert scatter.fit.range is None and scatter.fit.line.r2 < 0.2


def test_normalised_line_is_the_line_in_other_units() -> None:
    one = mapping.map_pair(rows(), "c", 2.0, "tared", MAX)
    assert one.normalised is not None and one.fit is not None
    assert one.normalised.slope == pytest.approx(one.fit.line.slope * one.x.max() / one.y.max(), rel=1e-9)
    assert one.normalised.r2 == pytest.approx(one.fit.line.r2, rel=1e-9)
    row = one.row()
    assert row["left_out_linear_percent"] == pytest.approx(100 * one.fit.error)
    assert row["left_out_surface"] == pytest.approx(one.fit.line.left_out_rmse / one.fit.line.slope)


def test_pictures_without_a_pixel_above_k_have_no_maximum_but_a_total() -> None:
    table = rows()
    table.loc[:9, ["tsis_tared_area_px", "tsis_tared_max_dn"]] = 0.0
    found = {pair.name: mapping.map_pair(table, "c", 2.0, "tared", pair) for pair in mapping.PAIRS}
    assert [found[name].unseen for name in ("max", "total", "area")] == [10, 0, 10]
    assert found["max"].fit is not None
    assert found["max"].fit.line.slope == pytest.approx(1.5, rel=0.02)  # zeros would have bent it


def test_too_few_and_constants_have_no_line() -> None:
    one = mapping.map_pair(rows(5), "c", 2.0, "tared", MAX)
    assert one.fit is None and "5 samples" in one.why and one.row()["slope"] is None
    flat = rows().assign(fem_tared_max_mm=0.01)
    assert "same for all" in mapping.map_pair(flat, "c", 2.0, "tared", MAX).why


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("map")
    (folder / "mine.toml").write_text(painted.small_design().replace("counts = 10.0", "counts = 3.0"))
    return painted.paint(folder, count=14, blanks=0.1, design="mine.toml")


def test_sweep_gives_the_scalars_of_the_stored_pictures(corpus: Path) -> None:
    opened = Corpus(corpus)
    k = opened.design.signal.counts
    swept = thresholds.sweep(opened, 1)
    blank = opened.table.iloc[::2]["blank"].to_numpy()
    assert len(swept.sample) == (~blank).sum()
    at = list(swept.picture_k).index(k)
    told = opened.table[(opened.table["level"] == 1) & ~opened.table["blank"]]
    assert np.array_equal(swept.area_px[:, at], told["tsis_tared_area_px"])
    assert np.allclose(swept.max_dn[:, at], told["tsis_tared_max_dn"])
    first = int(swept.sample[0])
    other = scalars(opened.tared(first, [1])[0], 0.3 * k)
    assert swept.area_px[0, 0] == other["area_px"] and (np.diff(swept.area_px, axis=1) <= 0).all()
    assert (swept.area_px[:, at] > 0).any()
    assert 0.2 < swept.noise_dn < 3.0


def test_noise_of_a_pixel_is_found_under_a_blob() -> None:
    rng = np.random.default_rng(0)
    x = np.linspace(-1, 1, 300)
    blob = 40 * np.exp(-(x**2 + x[:, None] ** 2) * 4)
    noisy = np.rint(blob + 0.8 * rng.standard_normal(blob.shape))
    assert thresholds._noise(noisy) == pytest.approx(np.hypot(0.8, 12**-0.5), rel=0.25)


def test_map_writes_its_files_and_says_three_lines(
    corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["map", str(corpus), "--out", str(tmp_path / "out"), "--level", "2"]) == 0
    told = capsys.readouterr().out
    for line in ("What the map is", "Where a line holds", "What to change"):
        assert told.count(line) == 1
    found = json.loads((tmp_path / "out" / "map.json").read_text())
    assert {row["level_mm"] for row in found["corpora"][0]["maps"]} == {2.0}
    assert {row["kind"] for row in found["corpora"][0]["maps"]} == {"tared", "raw"}
    table = pd.read_csv(tmp_path / "out" / "map.csv")
    assert len(table) == 6 and np.isfinite(table.loc[table["kind"] == "tared", "slope"]).any()
    assert not {p.name for p in (tmp_path / "out").iterdir()} ^ mapping_report.FILES
    assert "<img" in (tmp_path / "out" / "report.html").read_text()
    if browser.CHROMIUM.find():  # opens from its file, without network, and has nothing to complain of
        assert browser.screenshot(tmp_path / "out" / "report.html", tmp_path / "map.png") == []


def test_two_corpora_are_compared(corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    other = painted.paint(tmp_path / "other", count=10, blanks=0.0, full_well_e=40000.0)
    assert cli.main(["map", str(corpus), str(other), "--out", str(tmp_path / "out")]) == 0
    assert capsys.readouterr().out.count("What to change") == 2
    found = json.loads((tmp_path / "out" / "map.json").read_text())
    assert [row[0] for row in found["differences"] if "full_well" in row[0]] == ["camera.full_well_e"]
    labels = [one["label"] for one in found["corpora"]]
    assert len(set(labels)) == 2


def test_verdict_asks_for_a_lower_threshold_only_above_noise() -> None:
    maps = [mapping.map_pair(rows(), "c", 2.0, "tared", pair) for pair in mapping.PAIRS]
    ks = [
        mapping_verdict.AtThreshold(k, unseen, 0.0, 0.99, 0.9, 1.0, 1.0)
        for k, unseen in ((3.0, 0.0), (5.0, 10.0), (10.0, 50.0))
    ]
    quiet = mapping_verdict.verdict(maps, "tared", 2.0, ks, 0.6, 10.0)[2]
    noisy = mapping_verdict.verdict(maps, "tared", 2.0, ks, 0.9, 10.0)[2]
    loud = mapping_verdict.verdict(maps, "tared", 2.0, ks, 2.1, 10.0)[2]
    assert "from 10 to 3 " in quiet and "from 10 to 5 " in noisy and "signal.counts" not in loud


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["map"], ["CORPUS"]),
        (["map", "{empty}"], ["plan.json"]),
        (["map", "{none}"], ["corpus", "none"]),
        (["map", "{noindex}"], ["index.parquet"]),
        (["map", "{one}"], ["1 finished samples", "8 or more"]),
        (["map", "{good}", "{good}"], ["twice"]),
        (["map", "{good}", "--level", "7"], ["--level", "7 mm", "1, 2"]),
        (["map", "{good}", "--level", "-1"], ["--level", "> 0"]),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], words: list[str], corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "empty").mkdir()
    places = {"empty": tmp_path / "empty", "none": tmp_path / "none", "good": corpus}
    if "{one}" in arguments or "{noindex}" in arguments:
        places["one"] = places["noindex"] = painted.paint(tmp_path / "p", count=1, blanks=0.0)
        if "{noindex}" in arguments:
            (places["one"] / "index.parquet").unlink()
    assert cli.main([word.format(**places) for word in arguments]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(word in error for word in words), error


def test_two_different_values_have_no_line():
    """A threshold that one inclusion alone passes: no traceback, a reason."""
    fit, why = mapping.judged(np.array([0.0] * 9 + [5.0]), np.arange(1.0, 11.0))
    assert fit is None and "two different values" in why
