"""The page of a layout study: what it picks, what it escapes, and that a browser shows it without network."""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest
from browser import run, screenshot
from explored import write_study
from PIL import Image

from twin import explore_leds, explore_report
from twin.complaint import DesignError
from twin.explore_figures import least_size, shares
from twin.explore_results import front, importances, read, winners
from twin.explore_verdict import advised
from twin.objectives import BOUNDS


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_study(tmp_path_factory.mktemp("explored") / "leds")
    assert explore_report.write(folder) == folder / "report.html"
    return folder


def test_the_front_is_what_none_beats() -> None:
    """Against the definition, pair by pair, on 200 random layouts; a trial without a value is none of it."""
    losses = np.random.default_rng(0).uniform(size=(200, 3)).round(1)
    losses[7, 1] = np.nan
    found = front(losses)
    for place in range(200):
        beaten = any(
            all(a <= b for a, b in zip(other, losses[place], strict=True)) and (other < losses[place]).any()
            for other in losses
        )
        assert (place in found) == (not beaten and place != 7)
    assert list(losses[list(found), 0]) == sorted(losses[list(found), 0])


def test_winners_are_the_ends_and_the_compromise() -> None:
    losses = np.array([[0.0, 1.0], [0.2, 0.2], [1.0, 0.0], [0.6, 0.1], [2.0, 2.0]])
    assert winners(losses, front(losses)) == (0, 1, 2)
    assert winners(losses[:, :1], front(losses[:, :1])) == (0, 1, 3)
    assert winners(losses, ()) == ()


def test_results_are_those_of_the_folder(study: Path) -> None:
    results = read(study)
    assert (results.baseline.name, len(results.trials) + len(results.infeasible)) == ("baseline", 24)
    assert any("received 9 <mm>" in str(one.reason) for one in results.infeasible)
    for one in results.infeasible:
        assert "received 9 <mm>" in str(one.reason) or one.told["objectives"]["led_power_W"] > 0.2
    assert all(trial.objectives["led_power_W"] <= 0.2 for trial in results.trials)
    best = results.best()[0]
    assert best.objectives["bound_modulus_kPa"] == min(
        trial.objectives["bound_modulus_kPa"] for trial in results.trials
    )


@dataclass
class Judged:
    """A layout with two objectives, as `explore_verdict.advised` asks for them."""

    objectives: dict[str, float]


@dataclass
class Found:
    """Results of a search for the least bound and the deepest detection."""

    baseline: Judged
    found: list[Judged]
    objectives: ClassVar = {"bound_modulus_kPa": "minimize", "detection_depth_mm": "maximize"}

    def best(self) -> list[Judged]:
        return self.found


def test_what_is_advised_costs_nothing() -> None:
    """The best by the first objective, unless it is clearly worse than the baseline by another."""
    blind, better, deep = (
        Judged({"bound_modulus_kPa": bound, "detection_depth_mm": depth})
        for bound, depth in ((9.0, 2.6), (9.6, 8.8), (10.5, 9.8))
    )
    base = Judged({"bound_modulus_kPa": 11.7, "detection_depth_mm": 8.9})
    for found, wanted in (([blind, better, deep], better), ([better, deep], better), ([blind], blind)):
        assert advised(Found(base, found)) is wanted  # type: ignore[arg-type]


def test_shares_are_the_budgets(study: Path) -> None:
    """Nothing known better makes a bound worse, and the noise halved is four times the information."""
    base = read(study).baseline
    for known, halved in shares(base, "size_mm").values():
        assert -1e-9 <= halved <= known + 1e-9 <= 1 + 1e-9


def test_leds_one_by_one(study: Path) -> None:
    """Settings of the baseline: the best is no worse than its own, a dark LED no better, turns are stated."""
    results = read(study)
    found = explore_leds.read(results.baseline.folder)
    assert found is not None
    own, best, turns, same = (np.array(row["sd"]) for row in found["settings"])
    assert np.prod(best) <= np.prod(own) and (same <= own).all() and np.isfinite(turns).all()
    assert len(found["dark"]) == len(found["leds"]) == 4
    assert (np.array(found["dark"]) >= own * (1 - 1e-9)).all()
    low, high = np.array(found["binning"])
    assert (low <= own).all() and (own <= high).all()
    assert own == pytest.approx([results.baseline.objectives[name] for name in BOUNDS], rel=0.1)
    assert "LED by LED" in (study / "report.html").read_text(encoding="utf-8")


def test_importance_finds_what_was_turned(study: Path) -> None:
    """Power is the flux and nothing else."""
    for one in importances(read(study)):
        assert sum(one.share.values()) == pytest.approx(1.0)
        if one.objective == "led_power_W":
            assert max(one.share, key=lambda name: one.share[name]) == "leds.*.flux_W"


def test_importance_is_that_of_a_choice_with_one_good_value(study: Path) -> None:
    """On a grid: all but the first of four sheets gain nine, whatever the slope, which gives up to one."""
    results = read(study)
    grid = [(sheet, slope) for sheet in (0.0, 0.05, 0.1, 0.3) for slope in (0.3, 0.8, 2.0, 6.0)]
    trials = tuple(
        replace(
            results.trials[0],
            values={"layout.sheet_mm": sheet, "surface.rms_slope": slope},
            objectives={"bound_modulus_kPa": (9.0 if sheet == 0.0 else 0.0) + 0.1 * slope},
        )
        for sheet, slope in grid
    )
    objectives = {"bound_modulus_kPa": "minimize"}
    (found,) = importances(replace(results, trials=trials, objectives=objectives))
    assert list(found.share) == ["layout.sheet_mm", "surface.rms_slope"]
    assert found.share["layout.sheet_mm"] > 0.5


def test_least_size_in_closed_form() -> None:
    """The standard lump at the depth it is lost, and d³ / (h + d/2)² at others."""
    assert least_size(np.array([11.0]), 11.0, 5.0) == pytest.approx(5.0)
    size = least_size(np.array([4.0, 20.0]), 11.0, 5.0)
    assert size**3 / (np.array([4.0, 20.0]) + size / 2) ** 2 == pytest.approx(125 / 13.5**2)


def test_page_escapes_and_loads_nothing(study: Path) -> None:
    text = (study / "report.html").read_text(encoding="utf-8")
    assert not re.search(r'(src|href)="(?!data:|#)', text) and "url(" not in text and "import(" not in text
    assert "<how bright>" not in text and "<side>" not in text and "9 <mm>" not in text
    assert "&lt;how bright&gt;" in text and "one &lt;/script&gt;&lt;side&gt;" in text
    assert text.count("<script") == text.count("</script>") == 3
    assert len(re.findall(r"<p>(Build|Keep|No layout|Why: |What still limits it: )", text)) == 3
    assert explore_report.page(read(study)).html() == text  # the same folder, the same bytes


def test_winners_designs_are_ready_for_simulate(study: Path, tmp_path: Path) -> None:
    """What the page holds is a design that can be read again, the same."""
    import base64
    import html

    import twin

    text = (study / "report.html").read_text(encoding="utf-8")
    best = read(study).best()[0]
    held = base64.b64decode(re.findall(r'href="data:application/toml;base64,([^"]+)"', text)[0]).decode()
    assert html.escape(held) in text and held == best.design_toml
    (tmp_path / "winner.toml").write_text(held, encoding="utf-8")
    assert twin.load_design(tmp_path / "winner.toml") == twin.load_design(best.folder / "design.toml")


def test_a_browser_shows_it(study: Path, tmp_path: Path) -> None:
    """From the file, without network and without a word on the console; the front is drawn and answers."""
    page = study / "report.html"
    assert screenshot(page, tmp_path / "laptop.png") == []
    picture = np.asarray(Image.open(tmp_path / "laptop.png").convert("RGB"), np.float64)
    assert picture.shape == (768, 1366, 3)
    assert (np.ptp(picture, axis=2) > 60).sum() > 200  # dots in colour: the front is on the first screen
    results = read(study)
    number = results.trials[-1].number
    drawn, said = run(page, "--dump-dom", at=f"#trial-{number}")
    assert said == []
    assert f"<h3>trial {number}" in drawn
    assert drawn.count("<circle") == len(results.trials) + 1


def test_a_study_without_a_layout_says_so(tmp_path: Path) -> None:
    folder = write_study(tmp_path / "none", trials=2)
    text = explore_report.write(folder).read_text(encoding="utf-8")
    assert "No layout could be judged" in text and "9 &lt;mm&gt;" in text


def test_folders_that_are_none_are_refused(tmp_path: Path) -> None:
    with pytest.raises(DesignError, match=r"DIR: received .*; allowed a folder of `twin explore`"):
        explore_report.write(tmp_path)
