"""The paper replicated on painted corpora: its own figures, chains that are known, the same tables again."""

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from estimation import paper
from estimation.ann import Settings
from tests import browser, painted
from twin import cli, earlier, inversion, learned, replicate, replication, replication_findings
from twin.complaint import DesignError
from twin.corpus import Corpus
from twin.inversion import PICTURE, PLAIN, SURFACE, Variant
from twin.planned import sha256

SHORT = Settings(hidden=(4,), steps=25)

PHANTOMS = """\
size_mm,depth_mm,modulus_kPa
2,5,120
8,5,120
13,5,120
7,4,100
7,8,100
7,12,100
10,5,40
10,5,70
10,5,100
"""


def scalars(
    count: int = 60, noise: float = 0.0, gain: tuple[float, ...] = (1500.0, 1e6, 200.0)
) -> inversion.Scalars:
    """A made-up surface that tells d and h, and a picture that is a line of it."""
    rng = np.random.default_rng(1)
    low, high = np.array([paper.RANGES[name] for name in paper.PARAMETERS]).T
    truth = np.vstack([low + (high - low) * rng.random((count, 3)), paper.true_inclusions()])
    d, h, e = truth.T
    contrast = (e / 5 - 1) / (e / 5 + 1.5)
    surface = np.stack([d**3 * contrast / (h + d / 2) ** 2 * 1e-3, 1e-3 * d**3 * contrast, d * h], axis=1)
    picture = np.array([5.0, 1e5, 50.0]) + surface * np.array(gain) * (
        1 + noise * rng.standard_normal(surface.shape)
    )
    return inversion.Scalars(
        truth, surface, picture, np.arange(len(truth)), np.arange(count, count + 9), (2.0,)
    )


@pytest.mark.parametrize("mapping", ["lines", "joint"])
@pytest.mark.parametrize("source", ["box", "phantoms"])
def test_a_picture_that_is_a_line_of_the_surface_maps_back_exactly(mapping: str, source: str) -> None:
    data = scalars()
    rows = data.box if source == "box" else data.phantoms
    back = inversion.mapped(data, Variant("x", "", mapping, source), rows)  # type: ignore[arg-type]
    assert np.allclose(back(data.picture), data.surface, rtol=1e-6, atol=1e-9)


def test_joint_map_between_logarithms_is_exact_for_powers() -> None:
    data = scalars()
    some = replace(data, picture=1e4 * data.surface[:, [0, 1, 2]] ** 0.7)
    variant = Variant("x", "", "joint", logs=True)
    told = inversion.mapped(some, variant, some.box)(some.picture)
    middle = (some.surface > 0.3 * np.median(some.surface, axis=0)).all(axis=1)  # far above the lift
    assert np.abs(told - inversion.inputs(some, variant))[middle].max() < 0.03


def test_chain_with_exact_lines_answers_as_with_the_surface_itself() -> None:
    data = scalars()
    cache: dict = {}
    direct = inversion.estimate(
        data, Variant("none", "", "none"), left_out=False, repeats=2, settings=SHORT, cache=cache
    )
    chain = inversion.estimate(data, PLAIN, left_out=False, repeats=2, settings=SHORT, cache=cache)
    assert len(cache) == 1  # both ask the same networks
    assert np.allclose(direct, chain, rtol=1e-5)


def test_size_and_depth_are_learned_by_both_protocols() -> None:
    data = scalars(noise=0.01)
    truth = paper.true_inclusions()
    for left_out in (False, True):
        found = inversion.estimate(data, PLAIN, left_out=left_out, repeats=4).mean(axis=0)
        off = paper.rmse(truth[1:], found[1:])
        known = paper.rmse(truth[1:], paper.constant(truth[1:]))
        assert (off[:2] < 0.5 * known[:2]).all(), (left_out, off)


def test_phantoms_that_are_left_out_do_not_touch_their_own_answer() -> None:
    data = scalars()
    wrong = data.picture.copy()
    wrong[data.phantoms[3]] *= 3.0
    variant = Variant("x", "", source="phantoms")
    one = inversion.queries(data, variant, data.phantoms[[3]], left_out=True)
    other = inversion.mapped(replace(data, picture=wrong), variant, np.delete(data.phantoms, 3))
    assert np.allclose(one, other(data.picture[data.phantoms[[3]]]))


def test_cross_validation_sees_no_test_sample() -> None:
    data = scalars(30)
    fair = replication.cross(data, PLAIN, 10.0, 0, SHORT)
    assert fair.estimate.shape == (30, 3) and np.isfinite(fair.estimate).all()
    random = replace(
        data, truth=np.vstack([np.random.default_rng(2).permutation(data.truth[:30]), data.truth[30:]])
    )
    assert (replication.cross(random, PLAIN, 10.0, 0, SHORT).explained < 0.2).all()


def table() -> pd.DataFrame:
    data = scalars()
    rows = pd.DataFrame(data.truth, columns=list(paper.PARAMETERS))
    rows[list(SURFACE)], rows[list(PICTURE)] = data.surface, data.picture
    return rows.assign(sample=data.sample, level=0, blank=False)


def test_phantoms_are_found_by_what_they_are() -> None:
    rows = table().sample(frac=1.0, random_state=3)
    found = inversion.scalars_of(rows, 0, 2.0)
    assert np.array_equal(found.truth[found.phantoms], paper.true_inclusions())
    assert len(found.box) == 60


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda rows: rows.drop(columns="fem_tared_max_mm"), ["no column fem_tared_max_mm"]),
        (lambda rows: rows[rows["size_mm"] != 13.0], ["13 mm", "Table I", "number 3"]),
        (lambda rows: rows[rows["sample"] > 50], ["9 samples", "12 or more"]),
    ],
)
def test_corpora_that_do_not_fit_are_refused_in_one_line(change, words: list[str]) -> None:
    with pytest.raises(DesignError) as caught:
        inversion.scalars_of(change(table()), 0, 2.0)
    assert all(word in str(caught.value) for word in words) and "\n" not in str(caught.value)


def test_plane_methods_know_size_and_depth_from_their_own_lines(monkeypatch: pytest.MonkeyPatch) -> None:
    from twin.design import load_design

    design = load_design("tsis")
    small, deep = (earlier._shape(earlier.plane(design, (8, h, 500), 2.0)) for h in (4, 10))
    assert small[0] > deep[0] > 0 and small[1] < deep[1]  # shallow: higher and narrower
    assert earlier._shape(earlier.plane(design, (12, 4, 500), 2.0))[0] > small[0]


@pytest.fixture(scope="module")
def corpus(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Painted: 24 random inclusions and the nine phantoms, two levels."""
    folder = tmp_path_factory.mktemp("paper")
    (folder / "phantoms.csv").write_text(PHANTOMS)
    more = '[[samples]]\nname = "phantoms"\nsampler = "table"\ntable = "phantoms.csv"'
    design = painted.small_design().replace("counts = 10.0", "counts = 2.0")
    (folder / "mine.toml").write_text(design, encoding="utf-8")
    made = painted.paint(folder, count=24, blanks=0.0, more=more, design="mine.toml")
    plan = Corpus(made).plan
    for number in range(24, len(plan)):
        painted._sample(plan, number, made, False, 0.0)
    painted.reindex(made)
    return made


@pytest.fixture
def brief(monkeypatch: pytest.MonkeyPatch) -> None:
    """Few networks, few plane solutions: this is about files and protocols, not skill."""
    monkeypatch.setattr(earlier, "_TABLES", {"[9]": 3, "[10]": 3})
    monkeypatch.setattr(earlier, "_FEW", 6)
    whole = replication.replicate

    def short(*arguments, **options):
        return whole(*arguments, **{**options, "repeats": 2, "settings": Settings(hidden=(3,), steps=4)})

    monkeypatch.setattr(replication, "replicate", short)


def test_replicate_writes_the_papers_figures_and_the_same_tables_again(
    corpus: Path, tmp_path: Path, brief: None, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("a", "b"):
        assert (
            cli.main(["replicate", "--corpus", str(corpus), "--out", str(tmp_path / name), "--seed", "5"])
            == 0
        )
    told = capsys.readouterr().out
    assert "it explains" in told and "Goal of 0.6 and 0.8 mm" in told
    assert {path.name for path in (tmp_path / "a").iterdir()} == set(replicate.FILES)
    for name in ("estimates.csv", "errors.csv", "replicate.json"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    found = json.loads((tmp_path / "a" / "replicate.json").read_text())
    again = found["paper"]["recomputed"]["all"]
    assert np.allclose(again["mae"], [1.25, 2.10, 28.6], atol=[0.005, 0.005, 0.05])
    assert np.allclose(again["rmse"], [1.51, 2.45, 31.3], atol=[0.005, 0.005, 0.05])
    assert np.allclose(found["constants"]["mean_of_the_nine"]["all"]["rmse"], [2.90, 2.36, 24.9], atol=0.05)
    assert np.allclose(found["paper"]["table3_printed"], [1.25, 2.09, 28.65])
    protocols = {(run["variant"], run["protocol"]) for run in found["runs"]}
    assert {("paper", "125/9"), ("paper", "leave-one-out"), ("paper-phantoms", "leave-one-out")} <= protocols
    assert [one["name"] for one in found["earlier"]] == ["[9]", "[10]", "[11]"]
    page = (tmp_path / "a" / "report.html").read_text()
    for words in ("1.51", "2.45", "31.3", "could not be checked", "Fig. 3(c)", "Fig. 4", "Fig. 5", "guessed"):
        assert words in page, words
    if browser.CHROMIUM.find():  # opens from its file, without network, and has nothing to complain of
        assert browser.screenshot(tmp_path / "a" / "report.html", tmp_path / "replica.png") == []
    rows = list(csv.DictReader((tmp_path / "a" / "errors.csv").read_text().splitlines()))
    printed = next(row for row in rows if row["method"] == "paper-printed" and row["phantoms"] == "all")
    assert float(printed["rmse_size_mm"]) == pytest.approx(1.51, abs=0.005)


def test_what_e_is_worth_is_said_plainly() -> None:
    rng = np.random.default_rng(0)
    truth = np.column_stack([np.full(400, 8.0), np.full(400, 6.0), rng.uniform(40, 120, 400)])

    def worth(estimate: np.ndarray) -> str:
        off = estimate - truth
        explained = 1 - (off**2).mean(axis=0) / np.maximum(truth.var(axis=0), 1e-9)
        half = np.quantile(np.abs(off), 0.9, axis=0)
        one = replication.Crossed(PLAIN, (2.0,), 10.0, estimate, truth, off.std(axis=0), half, explained)
        found = replication.Replication(
            400, 1, 0, 2.0, 10.0, 4.0, 0.6, {}, crossed=[one], chosen=("paper", 10.0)
        )
        return replication_findings.worth_of_modulus(found)

    assert "worth nothing" in worth(np.broadcast_to(truth.mean(axis=0), truth.shape))
    assert "worth nothing" not in worth(truth + [0, 0, 1] * rng.standard_normal((400, 3)) * 5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--corpus", "{corpus}"], ["--out"]),
        (["--corpus", "{corpus}", "--out", "{out}", "--quick"], ["--quick", "--corpus"]),
        (["--corpus", "{corpus}", "--out", "{out}", "--emulator", "x.npz"], ["--emulator", "--corpus"]),
        (["--corpus", "{out}", "--out", "{out}"], ["corpus"]),
        (["--out", "{out}", "--workers", "0"], ["--workers", "> 0"]),
        (["--corpus", "{corpus}", "--out", "{taken}"], ["--out", "something else"]),
        (["--corpus", "{corpus}", "--out", "{own}"], ["--out", "something else"]),
        (["--out", "{out}", "--emulator", "{out}/none.npz"], ["none.npz"]),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str], words: list[str], corpus: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "letter.txt").write_text("mine")
    (tmp_path / "own").mkdir()
    (tmp_path / "own" / "report.html").write_text("my own")
    places = {"corpus": corpus} | {name: tmp_path / name for name in ("out", "taken", "own")}
    assert cli.main(["replicate", *(word.format(**places) for word in arguments)]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1 and all(word in error for word in words), error
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("planned", "emulator", "solve", "word"),
    [
        ("tsis", None, True, "--solve: received a corpus planned with an emulator"),
        ("another", "tsis", False, "--emulator: received a corpus planned with another emulator"),
        (None, "tsis", False, "--emulator: received a corpus planned without it"),
        ("tsis", "tsis", False, None),
        ("tsis", "tsis", True, None),
        (None, None, True, None),
    ],
)
def test_a_corpus_that_was_made_otherwise_is_not_gone_on_with(
    tmp_path, monkeypatch, planned, emulator, solve, word
):
    shipped = {"tsis": sha256(learned.usual_emulator("tsis")), "another": 64 * "0"}
    made_by = None if planned is None else SimpleNamespace(sha256=shipped[planned])
    head = SimpleNamespace(seed=0, emulator=made_by)
    monkeypatch.setattr(replicate, "load_plan", lambda folder: SimpleNamespace(name="paper", head=head))
    done = SimpleNamespace(failed=0)
    monkeypatch.setattr("twin.run.run", lambda *arguments, **options: done)
    (tmp_path / "plan.json").touch()
    asked = (tmp_path, "paper", 0, emulator, solve, 1, lambda stage, share: None)
    if word is None:
        replicate.simulate(*asked)
        return
    with pytest.raises(DesignError, match=word):
        replicate.simulate(*asked)
