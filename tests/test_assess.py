"""What an assessment says of answers whose worth is known, and what parts of a picture are worth."""

import dataclasses
import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import browser
import numpy as np
import pytest

from estimation.scalars import scalars
from twin import ablation, assessing, assessing_report, learning_curve
from twin.assess import assess, figures, found_or_not, summed_up
from twin.assess import words as words_of
from twin.assessing_figure import draw
from twin.assessment import answered, record_of, words
from twin.complaint import DesignError
from twin.design import load_design, parse_design
from twin.estimator import Estimator
from twin.fields import put, tables_of
from twin.report import write_json

RANGES = np.array([[2.0, 13.0], [4.0, 12.0], [40.0, 120.0], [-2.0, 2.0], [-2.0, 2.0]])
SD = np.array([0.1, 0.05, 10.0])


def inclusions(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Truth (n, 3), and samples (n, 500, 3) of normal posteriors that are right."""
    rng = np.random.default_rng(seed)
    truth = rng.uniform([4.0, 4.0, 60.0], [13.0, 12.0, 100.0], (n, 3))
    middle = truth + SD * rng.standard_normal((n, 3))
    return truth, middle[:, None] + SD * rng.standard_normal((n, 500, 3))


def test_right_posteriors_are_called_right() -> None:
    truth, drawn = inclusions(800)
    told = figures(summed_up(drawn, truth), truth, np.tile(SD, (800, 1)), RANGES)
    part = told["4 mm and more"]
    assert all(abs(ratio - 1.0) < 0.08 for ratio in part["over_bound"].values())
    assert all(abs(share - 1.0) < 0.05 for share in part["explained"].values())
    assert all(abs(share - 0.9) < 0.03 for share in told["covered_90"].values())
    assert all(p > 1e-3 for p in told["rank_p"].values())


def test_posteriors_that_are_too_sure_are_found_out() -> None:
    truth, drawn = inclusions(800)
    sure = drawn.mean(axis=1, keepdims=True) + 0.5 * (drawn - drawn.mean(axis=1, keepdims=True))
    told = figures(summed_up(sure, truth), truth, np.tile(SD, (800, 1)), RANGES)
    assert all(share < 0.7 for share in told["covered_90"].values())
    assert all(p < 1e-6 for p in told["rank_p"].values())


def rows(n: int = 40) -> list[dict[str, Any]]:
    """Records of samples as a run leaves them, an eighth without inclusion."""
    truth, drawn = inclusions(n)
    found = []
    for number in range(n):
        blank = number % 8 == 0
        row: dict[str, Any] = {"sample": number, "blank": blank, "rendered": True}
        row["truth"] = None if blank else truth[number].tolist()
        for frames in ("1", "100"):
            row[frames] = {"presence": 0.01 if blank else 0.99}
            if not blank:
                one = assessing._short(drawn[number], truth[number : number + 1])
                row[frames] |= {"network": one, "rendered": one, "bound": SD.tolist(), "deflection": 9.0}
                row[frames] |= {"explains": True, "renders": 1, "misfit": 1.0}
        if not blank:
            row["parts"] = {"all levels": SD.tolist()}
        found.append(json.loads(json.dumps(row)))
    return found


def test_the_record_tells_all_that_the_words_say(tmp_path: Any) -> None:
    record = record_of(rows(), RANGES, True) | {"corpus_name": "made up"}
    assert record["inclusions"] == 35 and record["blanks"] == 5
    assert record["1"]["presence"]["area"] == 1.0
    text = words(record)
    assert "35 inclusions, 5 blanks" in text and "ideal observer 1.000" in text and "all levels" in text
    draw(
        {frames: answered(rows(), frames, "rendered") for frames in (1, 100)}, RANGES, 5.0, tmp_path / "a.png"
    )
    assert (tmp_path / "a.png").stat().st_size > 20_000


def test_means_of_some_of_the_samples_are_told_of_these(tmp_path: Any) -> None:
    """`--averaged`: the rest count for one exposure only."""
    some = rows()
    for row in some[16:]:
        del row["100"]
    record = record_of(some, RANGES, True) | {"corpus_name": "made up"}
    assert [record[frames]["inclusions"] for frames in ("1", "100")] == [35, 14]
    assert record["1"] == record_of(rows(), RANGES, True)["1"]
    assert record["100"] == record_of(some[:16], RANGES, True)["100"]
    for row in some:
        row.pop("100", None)
    alone = record_of(some, RANGES, True) | {"corpus_name": "made up"}
    assert "100" not in alone and "100 exposures" not in words(alone)
    write_json(tmp_path / "assessment.json", alone)
    draw({1: answered(some, 1, "rendered")}, RANGES, 5.0, tmp_path / "assessment.png")
    assert "mean of 100" not in assessing_report.write(tmp_path).read_text(encoding="utf-8")


def test_single_exposures_and_means_are_asked_of_the_first() -> None:
    """`--single` and `--averaged`."""
    assert [assessing.asked(3, *most) for most in ((None, None), (0, None), (3, None), (4, None))] == [
        (1, 100),
        (100,),
        (100,),
        (1, 100),
    ]
    assert [assessing.asked(3, *most) for most in ((None, 0), (4, 3), (3, 4), (3, 3))] == [
        (1,),
        (1,),
        (100,),
        (),
    ]


def test_means_alone(tmp_path: Any) -> None:
    """`--single 0`: nothing is said of one exposure."""
    means = rows()
    for row in means:
        del row["1"]
    record = record_of(means, RANGES, True) | {"corpus_name": "made up"}
    assert "1" not in record and record["100"] == record_of(rows(), RANGES, True)["100"]
    assert "1 exposure " not in words(record)
    write_json(tmp_path / "assessment.json", record)
    draw({100: answered(means, 100, "rendered")}, RANGES, 5.0, tmp_path / "assessment.png")
    page = assessing_report.write(tmp_path).read_text(encoding="utf-8")
    assert "mean of 100" in page and "one exposure" not in page


def test_the_page_holds_the_tables_and_a_learning_curve(tmp_path: Any) -> None:
    """All in one file, of whatever lies in the folder; a browser has nothing to complain of."""
    curve = {"corpus": "made up", "model": "m", "tested": 60, "parameters": [], "bound": [0.05, 0.03, 12.0]}
    curve["curve"] = [{"samples": n, "rmse": [4.0 / n, 3.0 / n, 900.0 / n]} for n in (40, 80)]
    (tmp_path / "curve.json").write_text(json.dumps(curve))
    learning_curve._draw(curve, tmp_path / "curve.png")
    alone = assessing_report.write(tmp_path).read_text(encoding="utf-8")
    assert "0.0375" in alone and "Errors and the bound" not in alone
    record = record_of(rows(), RANGES, True) | {"corpus_name": "made <up>"}
    write_json(tmp_path / "assessment.json", record)
    drawn = {frames: answered(rows(), frames, "rendered") for frames in (1, 100)}
    draw(drawn, RANGES, 5.0, tmp_path / "assessment.png")
    page = assessing_report.write(tmp_path)
    text = page.read_text(encoding="utf-8")
    for told in (
        "35 inclusions and 5 blanks of made &lt;up&gt;",
        "times the bound",
        "ideal observer",
        "0.0375",
    ):
        assert told in text
    if browser.CHROMIUM.find():
        assert browser.screenshot(page, tmp_path / "page.png") == []


def test_a_folder_of_something_else_is_left_alone(tmp_path: Any) -> None:
    told = {"model": "a", "corpus": "b", "seed": 0, "format": 1}
    assessing._claim(tmp_path / "new", told)
    assessing._claim(tmp_path / "new", told)
    with pytest.raises(DesignError, match="same model, corpus, seed and version"):
        assessing._claim(tmp_path / "new", told | {"seed": 1})
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(DesignError, match="--out"):
        assessing._claim(tmp_path / "mine", told)


def test_a_place_that_is_no_folder_is_refused_in_one_line(tmp_path: Path) -> None:
    told = {"model": "a", "corpus": "b", "seed": 0, "format": 1}
    (tmp_path / "afile").write_text("mine")
    for out in ("afile", "afile/deeper"):
        with pytest.raises(DesignError, match=r"--out: .*a folder that can be made"):
            assessing._claim(tmp_path / out, told)
    assessing._claim(tmp_path / "cut", told)
    (tmp_path / "cut" / assessing.SAMPLES / "head.json").write_bytes(b"{")
    with pytest.raises(DesignError, match=r"--out: .*same model, corpus, seed and version"):
        assessing._claim(tmp_path / "cut", told)


def test_an_answer_that_is_kept_is_not_made_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of many exposures, asked for later, are put beside the one exposure's answer of before."""
    network = SimpleNamespace(sample=lambda told, frames, count, seed: np.zeros((1, count, 3)))
    estimator = SimpleNamespace(
        features=lambda seen: seen,
        network=network,
        unscaled=lambda drawn: drawn,
        presence=lambda seen, frames, middle: 0.01 * frames,
        prior=SimpleNamespace(names=()),
    )
    base = load_design("tsis")
    plan = SimpleNamespace(
        parameters=lambda number: {}, inclusion=lambda number: None, base=base, indentation_mm=(1.0,)
    )
    for name, value in (
        ("loaded", lambda model, as_trained: estimator),
        ("opened", lambda corpus: SimpleNamespace(plan=plan)),
        ("levels_of", lambda source, estimator: [0]),
        ("stored", lambda *asked: np.zeros(3)),
        ("averaged", lambda *asked: np.zeros(3)),
    ):
        monkeypatch.setattr(assessing, name, value)
    one = assessing.Task("model", "corpus", 7, tmp_path / "000007.json", True, 0, (1,))
    assessing.answer(one)
    assert json.loads(one.place.read_bytes())["1"] == {"presence": 0.01}
    monkeypatch.setattr(assessing, "stored", None)  # would fail if it were asked for again
    both = dataclasses.replace(one, exposures=(1, 100))
    assert assessing._done(one) and not assessing._done(both)
    assessing.answer(both)
    row = json.loads(one.place.read_bytes())
    assert row["1"] == {"presence": 0.01} and row["100"] == {"presence": 1.0} and assessing._done(both)


def test_answers_of_the_network_do_not_pass_for_rendered_ones(tmp_path: Path) -> None:
    """Quick means beside a rendered answer are made anew where rendered ones are asked for; it stays."""
    place = tmp_path / "000007.json"
    place.write_text(json.dumps({"rendered": True, "quick": ["100"], "1": {"a": 1}, "100": {"a": 2}}))
    task = assessing.Task("model", "corpus", 7, place, True, 0, (1, 100))
    assert assessing._begun(task) == {"rendered": True, "1": {"a": 1}} and not assessing._done(task)
    assert assessing._done(dataclasses.replace(task, rendered=False))


def test_what_a_corpus_does_not_vary_is_as_its_design_says() -> None:
    """Not as the model's: tissue of 6 kPa is no discrepancy of one of 5."""
    base = parse_design(put(tables_of(load_design("tsis")), [("specimen.modulus_kPa", 6.0)]))
    plan = SimpleNamespace(
        base=base,
        indentation_mm=(1.0, 2.0, 2.9),
        parameters=lambda number: {"size_mm": 9.0, "depth_mm": None, "leds.0.flux_W": 0.02},
    )
    names = ("leds.0.flux_W", "leds.1.flux_W", "specimen.modulus_kPa", "press.indentation_mm.1")
    estimator: Any = SimpleNamespace(prior=SimpleNamespace(names=names))
    found = assessing.values_of(SimpleNamespace(plan=plan), estimator, 0, [0, 2])  # type: ignore[arg-type]
    assert found == {
        "size_mm": 9.0,
        "leds.0.flux_W": 0.02,
        "leds.1.flux_W": 0.01,
        "specimen.modulus_kPa": 6.0,
        "press.indentation_mm.0": 1.0,
        "press.indentation_mm.1": 2.9,
    }


@pytest.mark.parametrize(("chi_square", "wider"), [(40.0, 1.0), (96.0, 1.0), (960.0, 10.0)])
def test_a_fit_that_nothing_rendered_confirms_is_as_wide_as_its_misfit(
    chi_square: float, wider: float
) -> None:
    ranges = np.array([[-1e3, 1e3]] * 5)
    estimator: Any = SimpleNamespace(
        prior=SimpleNamespace(ranges=ranges),
        sight=SimpleNamespace(features=SimpleNamespace(spread=np.ones(96))),
    )
    fitted: Any = SimpleNamespace(x=np.arange(7.0), covariance=np.eye(7), chi_square=chi_square)
    drawn = Estimator.normal(estimator, fitted, 20_000, 0)
    np.testing.assert_allclose(drawn.var(axis=0), wider, rtol=0.05)


def test_words_are_of_the_sizes_that_were_held_out() -> None:
    """Small inclusions only: nothing of 8 mm and more; none at all: nothing but that."""
    truth, drawn = inclusions(200)
    small = truth[:, 0] < 7.0
    told = figures(summed_up(drawn[small], truth[small]), truth[small], np.tile(SD, (small.sum(), 1)), RANGES)
    text = words_of({"1": {**told, "presence": {}}}, "models/a")
    assert "4 mm and more" in text and "8 mm and more" not in text and text.endswith("model: models/a")
    blanks: Any = SimpleNamespace(blank=np.ones(3, bool), values=[{}] * 3, numbers=np.arange(3))
    nothing: Any = None
    found = assess(nothing, nothing, blanks, [0], 0, lambda share: None)
    assert found == {"samples": 0, "blanks": 3} and words_of(found, "m") == "model: m"


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"varied": {"camera.exposure_ms": 1.0}}, "what varies: received camera.exposure_ms"),
        ({"varied": {"size_mm": 1.0, "camera.gain_e_per_dn": 1.0}}, None),
        ({"camera": {"frames": 4}}, "camera.frames: received 4"),
        ({"camera": {"ambient": 0.2}}, "camera.ambient: received 0.2"),
        ({"camera": {"exposure_ms": 3.5}}, "camera.exposure_ms: received 3.5"),
        ({"leds": {"z_mm": -4.0}}, "leds.0.z_mm: received -4.0"),
        ({"specimen": {"modulus_kPa": 6.0}}, None),
        ({"signal": {"counts": 4.0}}, None),
        ({"press": {"indentation_mm": [3.0]}}, None),
        ({"press": {"tilt_deg": [2.0, 0.0]}}, "press.tilt_deg.0: received 2.0"),
    ],
)
def test_a_corpus_of_another_sensor_is_refused_by_its_first_difference(
    changes: dict[str, dict[str, float]], word: str | None
) -> None:
    """But for what the model knows to vary, and for what pictures do not depend on."""
    own, tables = tables_of(load_design("tsis")), tables_of(load_design("tsis"))
    varied = changes.pop("varied", {})
    for room, values in changes.items():
        for table in tables[room] if room == "leds" else [tables[room]]:
            table.update(values)
    design = parse_design(tables)
    plan = SimpleNamespace(indentation_mm=(1.0, 2.0), columns=varied, name="c")
    source: Any = SimpleNamespace(design=design, name="c", shape=(492, 768), plan=plan)
    estimator: Any = SimpleNamespace(
        card={"design": own, "shape": [492, 768], "indentation_mm": [1.0, 2.0]},
        chain=SimpleNamespace(design=load_design("tsis")),
        prior=SimpleNamespace(names=("specimen.modulus_kPa",)),
    )
    if word is None:
        assert assessing.levels_of(source, estimator) == [0, 1]
        return
    with pytest.raises(DesignError) as caught:
        assessing.levels_of(source, estimator)
    assert word in str(caught.value)


def test_inclusions_found_are_told_by_their_size() -> None:
    """Half of those below 4 mm, all of the others."""
    truth = np.array([[2.5, 5, 80], [3.5, 5, 80], [5.0, 5, 80], [9.0, 5, 80]])
    presence = np.array([0.1, 0.9, 0.9, 0.9, 0.2])
    told = found_or_not(presence, np.array([False] * 4 + [True]), truth)
    assert told["found_at_5_percent"] == {"2 to 4 mm": 0.5, "4 to 8 mm": 1.0, "8 mm and more": 1.0}


def test_information_of_the_scalars_is_that_of_noisy_pictures() -> None:
    """Means and covariance of the paper's scalars over pictures with noise, against the closed form."""
    y, x = np.mgrid[-1:1:4j, -1:1:5j]
    coarse = 20.0 * np.exp(-2.0 * (x**2 + y**2))
    sd, threshold, side = 1.5, 10.0, ablation.BLOCK
    rng = np.random.default_rng(0)

    def seen(scale: float, count: int) -> np.ndarray:
        pixels = np.kron(scale * coarse, np.ones(side))
        found = [scalars(pixels + sd * rng.standard_normal(pixels.shape), threshold) for _ in range(count)]
        return np.array([[one["max_dn"], one["total_dn"], one["area_px"]] for one in found])

    many = 3000
    covariance = np.cov(seen(1.0, many).T)
    slope = (seen(1.05, many).mean(axis=0) - seen(0.95, many).mean(axis=0)) / 0.1
    expected = slope @ np.linalg.solve(covariance, slope)
    variance = np.full((1, 4, 5), sd**2 / (side[0] * side[1]))
    told = ablation._scalars(coarse[None], coarse[None, None], variance, threshold)
    assert told[0, 0] == pytest.approx(expected, rel=0.08)


def test_a_calibrated_model_can_be_taken_as_it_was_trained() -> None:
    """And its answers are kept apart from those of the model as it is."""
    calibrated, trained = (assessing.loaded("tsis", as_trained) for as_trained in (False, True))
    assert calibrated.calibration is not None and trained.calibration is None
    assert np.array_equal(calibrated.features.axes, trained.features.axes)
    assert trained.sight.discrepancy is None
