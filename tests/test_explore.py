"""Explorations: who tries what, what survives a kill, who shares, what is kept. Evaluations are made up."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from optuna.storages import RDBStorage

import fem
from estimation.information import Information
from twin import explore, explore_words, explored, objectives
from twin.complaint import DesignError
from twin.evaluate import Evaluation, Judged, Layout
from twin.forward import Unknown

STUDY = """
kind = "layout"
name = "shared"
constraints = ["led_power_W <= 0.06"]
[fields]
"layout.leds" = [1, 8]
"layout.power_W" = [0.01, 0.07]
"leds.*.z_mm" = [-11.0, -2.0]
[objectives]
bound_modulus_kPa = "minimize"
detection_depth_mm = "maximize"
[search]
method = "METHOD"
trials = 12
population = 4
[[inclusions]]
size_mm = 9.0
depth_mm = 6.0
modulus_kPa = 80.0
"""


def evaluated(layout: Layout, balls: Any, unknowns: Any, *, pause: float = 0.0, **_: Any) -> Evaluation:
    """A bound that falls with the power and the number of LEDs, at once or after a while."""
    time.sleep(pause)
    power, count = sum(led.flux_W for led in layout.design.leds), len(layout.design.leds)
    wanted = (Unknown("size_mm", 3.0), Unknown("modulus_kPa", 23.0))
    told = Information(("size_mm", "modulus_kPa"), np.diag([100.0 * power, power * count]), np.eye(2))
    picture = np.ones((2, 3, 4), np.float32)
    judged = Judged(
        balls[0],
        picture,
        np.ones((2, count, 3, 4), np.float32),
        told.names,
        np.ones((2, 2, 3, 4), np.float32),
        None,
        told,
        {"size_mm": 0.1, "modulus_kPa": 1.0 / (power * count)},
    )
    found = {name: 1.0 for name in objectives.OBJECTIVES}
    found |= {"led_power_W": power, "bound_modulus_kPa": 1.0 / (power * count), "detection_depth_mm": count}
    seconds = {"mechanics": 0.0, "light": 0.0, "information": 0.0}
    return Evaluation(layout, wanted, (judged,), found, seconds, 32.0, layout.design)


def slowly(layout: Layout, balls: Any, unknowns: Any, **more: Any) -> Evaluation:
    return evaluated(layout, balls, unknowns, pause=0.15)


def worker(folder: Path) -> None:
    explore.work(explore.reopened(folder), evaluate=slowly)


def prepared(tmp_path: Path, method: str = "latin", name: str = "out", **more: Any) -> explore.Exploration:
    file = tmp_path / f"{method}.toml"
    file.write_text(STUDY.replace("METHOD", method))
    return explore.prepare(file, tmp_path / name, **more)


def test_inclusions_whose_bounds_are_of_a_mesh_are_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where presses are solved: those too shallow for multipoles, or too far beside the middle."""
    ball = "[[inclusions]]\nsize_mm = 9.0\ndepth_mm = {}\nmodulus_kPa = 80.0\noffset_x_mm = {}\n"
    more = ball.format(2.5, 0.0) + ball.format(6.0, 3.0) + ball.format(6.0, 7.0)
    monkeypatch.setattr("test_explore.STUDY", STUDY + more)
    found = replace(prepared(tmp_path), emulator=None)
    (line,) = explore_words.findings(found)
    assert line.startswith("inclusions 1, 3: pressed on meshes that follow them")


def records(folder: Path) -> list[dict[str, Any]]:
    found = [explored.read(place) for place in sorted((folder / "trials").iterdir())]
    return [one for one in found if one is not None]


def values(folder: Path) -> list[Any]:
    return [tuple(sorted(one["values"].items())) for one in records(folder)]


@pytest.mark.parametrize("method", ["grid", "latin", "nsga2", "tpe"])
def test_every_search_records_all_layouts(tmp_path: Path, method: str) -> None:
    """Those that cannot be have their reason: an LED beside the guide, more power than is allowed."""
    found = prepared(tmp_path, method)
    explore.work(found, evaluate=evaluated)
    told = explore.progress(found)
    assert told.done == told.wanted == 12 and told.running == 0
    states = records(found.folder)
    assert len(states) == 12 and told.infeasible == sum(one["state"] == "infeasible" for one in states)
    for one in states:
        too_low = one["values"]["leds.*.z_mm"] < -9.25
        too_bright = one["values"]["layout.power_W"] > 0.06
        assert (one["state"] == "infeasible") == (too_low or too_bright), one
        if one["state"] == "infeasible":
            assert ("z_mm" if too_low else "led_power_W <= 0.06") in one["reason"]
        else:
            power, count = one["values"]["layout.power_W"], one["values"]["layout.leds"]
            assert one["objectives"]["bound_modulus_kPa"] == pytest.approx(1.0 / (power * count))
    base = explored.read(found.folder / "baseline")
    assert base is not None and base["state"] == "complete"
    assert len(explore_words.findings(found)) == 2
    for place in (found.folder / "trials").iterdir():
        if explored.read(place)["state"] == "complete":  # type: ignore[index]
            with np.load(place / "pictures.npz", allow_pickle=False) as data:
                assert data["mean_0"].shape == (2, 3, 4) and "fisher_0" in data
            assert (place / "design.toml").exists()


def test_the_search_learns(tmp_path: Path) -> None:
    """NSGA-II finds a brighter sensor with more LEDs than the first layouts that it tried at random."""
    file = tmp_path / "long.toml"
    file.write_text(STUDY.replace("METHOD", "nsga2").replace("trials = 12", "trials = 32"))
    found = explore.prepare(file, tmp_path / "out")
    explore.work(found, evaluate=evaluated)
    bounds = [one["objectives"]["bound_modulus_kPa"] for one in records(found.folder) if "objectives" in one]
    assert np.median(bounds[-8:]) < 0.7 * np.median(bounds[:8])


def test_the_same_seed_tries_the_same_layouts_even_when_cut_off(tmp_path: Path) -> None:
    whole, cut = (prepared(tmp_path, "nsga2", name) for name in ("whole", "cut"))
    explore.work(whole, evaluate=evaluated)
    left = iter([True] * 5)
    explore.work(cut, evaluate=evaluated, go_on=lambda: next(left, False))
    assert len(records(cut.folder)) == 5
    explore.work(prepared(tmp_path, "nsga2", "cut"), evaluate=evaluated)
    assert values(whole.folder) == values(cut.folder)


def test_killed_and_resumed(tmp_path: Path) -> None:
    """Kill -9 loses what was under way and nothing else; its layout is tried again."""
    found = prepared(tmp_path)
    process = multiprocessing.get_context("spawn").Process(target=worker, args=(found.folder,))
    process.start()
    until = time.monotonic() + 60
    while len(records(found.folder)) < 3 and time.monotonic() < until:
        time.sleep(0.02)
    os.kill(process.pid or 0, signal.SIGKILL)
    process.join()
    before = {one["number"]: one for one in records(found.folder)}
    assert 3 <= len(before) < 12
    again = prepared(tmp_path)
    explore.work(again, evaluate=evaluated)
    after = {one["number"]: one for one in records(again.folder)}
    assert all(after[number] == one for number, one in before.items())
    told = explore.progress(again)
    assert told.done == 12 and told.running == 0
    planned = {tuple(sorted(one.items())) for one in explore.planned(again)}
    tried = [values for values in values_of(after)]
    assert set(tried) == planned  # a layout whose folder was written but not told is tried twice


COMMITS = ("_create_new_trial", "_set_trial_param", "set_trial_state_values", "set_trial_user_attr")


def killed(found: explore.Exploration, monkeypatch: pytest.MonkeyPatch, commit: int) -> None:
    """Work until just before a commit to the storage."""
    commits = 0

    def dies(real: Any) -> Any:
        def called(*args: Any, **kwargs: Any) -> Any:
            nonlocal commits
            commits += 1
            if commits == commit:
                raise KeyboardInterrupt
            return real(*args, **kwargs)

        return called

    with monkeypatch.context() as patch:
        for name in COMMITS:
            patch.setattr(RDBStorage, name, dies(getattr(RDBStorage, name)))
        with pytest.raises(KeyboardInterrupt):
            explore.work(found, evaluate=evaluated)


@pytest.mark.parametrize(
    ("asking", "recovering"), [(1, None), (2, None), (3, None), (4, None), (5, None), (3, 1), (3, 2), (3, 3)]
)
def test_killed_between_any_two_commits(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asking: int, recovering: int | None
) -> None:
    """Every planned layout is tried once, wherever in asking and in recovering a process ended."""
    found = prepared(tmp_path)
    left = iter([True] * 2)
    explore.work(found, evaluate=evaluated, go_on=lambda: next(left, False))
    killed(found, monkeypatch, asking)
    if recovering is not None:
        killed(found, monkeypatch, recovering)
    explore.work(prepared(tmp_path), evaluate=evaluated)
    assert explore.progress(found).done == 12
    planned = [tuple(sorted(one.items())) for one in explore.planned(found)]
    rows = {one["number"]: one for one in records(found.folder)}
    assert sorted(values_of(rows)) == sorted(planned)


def values_of(rows: dict[int, Any]) -> list[Any]:
    return [tuple(sorted(one["values"].items())) for one in rows.values()]


def shared(found: explore.Exploration) -> None:
    """Two processes work on one study: every layout once, both had a part."""
    spawn = multiprocessing.get_context("spawn")
    crew = [spawn.Process(target=worker, args=(found.folder,)) for _ in range(2)]
    for one in crew:
        one.start()
    for one in crew:
        one.join(120)
        assert one.exitcode == 0
    done = [trial for trial in explore.opened(found).trials if trial.user_attrs.get("worker")]
    assert len(done) == len(records(found.folder)) == 12
    assert len({trial.user_attrs["worker"] for trial in done}) == 2
    assert len(set(values(found.folder))) == 12


def test_two_processes_share_one_study(tmp_path: Path) -> None:
    shared(prepared(tmp_path))


@pytest.mark.parametrize("method", [pytest.param("nsga2", marks=pytest.mark.slow), "tpe"])
def test_no_layout_is_tried_twice(tmp_path: Path, method: str) -> None:
    """Up to 3 LEDs in 2 arrangements: one LED makes one sensor twice, so 5 are tried before any repeats."""
    text = STUDY.replace("METHOD", method).replace("trials = 12", "trials = 5").replace("[1, 8]", "[1, 3]")
    text = text.replace('"layout.power_W" = [0.01, 0.07]\n"leds.*.z_mm" = [-11.0, -2.0]', ARRANGEMENTS)
    (tmp_path / "few.toml").write_text(text)
    found = explore.prepare(tmp_path / "few.toml", tmp_path / "out")
    explore.work(found, evaluate=evaluated)
    made = {
        (tmp_path / "out" / "trials" / f"{one['number']:04d}" / "design.toml")
        for one in records(found.folder)
    }
    assert len({path.read_text().split("\n", 1)[1] for path in made}) == 5
    more = explore.prepare(tmp_path / "few.toml", tmp_path / "out", trials=7)  # there are no 7
    explore.work(more, evaluate=evaluated)
    assert explore.progress(more).complete == 7


ARRANGEMENTS = '"layout.arrangement" = { choices = ["around", "one side"] }'


def test_another_study_does_not_get_the_folder(tmp_path: Path) -> None:
    prepared(tmp_path, "latin", "out")
    with pytest.raises(DesignError, match=r"--out: .*same study"):
        prepared(tmp_path, "tpe", "out")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "letter.txt").write_text("dear")
    with pytest.raises(DesignError, match="--out"):
        prepared(tmp_path, "latin", "mine")
    with pytest.raises(DesignError, match="--storage"):
        prepared(tmp_path, "latin", "stored", storage="nonsense://nowhere")


def test_an_emulator_is_refused_where_the_mechanics_change(tmp_path: Path) -> None:
    file = tmp_path / "soft.toml"
    text = STUDY.replace("METHOD", "latin").replace('"leds.*.z_mm"', '"waveguide.layers.0.modulus_kPa"')
    file.write_text(text.replace("[-11.0, -2.0]", "[10.0, 50.0]"))
    with pytest.raises(DesignError, match=r"waveguide\.layers\.0\.modulus_kPa, which changes the mechanics"):
        explore.prepare(file, tmp_path / "out", emulator=tmp_path / "some.npz")


def test_more_trials_go_on(tmp_path: Path) -> None:
    explore.work(prepared(tmp_path, "tpe", trials=4), evaluate=evaluated)
    more = prepared(tmp_path, "tpe", trials=7)
    assert explore.work(more, evaluate=evaluated) == 3


def test_a_grid_has_no_more_layouts_than_it_has(tmp_path: Path) -> None:
    assert prepared(tmp_path, "grid", trials=10_000).trials == 27


@pytest.mark.slow
def test_the_command_explores(tmp_path: Path) -> None:
    """With real light and solves: two cameras, one inclusion, two processes; the plan measures."""
    file = tmp_path / "cameras.toml"
    file.write_text(
        'kind = "layout"\nname = "cameras"\n[fields]\n"camera.bits" = { choices = [8, 12] }\n'
        '[objectives]\nbound_modulus_kPa = "minimize"\n[search]\nmethod = "grid"\n'
        "[[inclusions]]\nsize_mm = 9.0\ndepth_mm = 6.0\nmodulus_kPa = 80.0\n"
        '[[unknowns]]\nname = "modulus_kPa"\nsd = 23.0\n'
    )
    command = [sys.executable, "-m", "twin", "explore", str(file), "--workers", "2"]
    root = Path(__file__).resolve().parent.parent
    plan = subprocess.run([*command, "--plan"], capture_output=True, text=True, cwd=root)
    assert plan.returncode == 0, plan.stderr
    assert "counts alone" in plan.stdout and "measured" in plan.stdout
    done = subprocess.run(
        [*command, "--out", str(tmp_path / "out"), "--confirm", "0.01"],
        capture_output=True,
        text=True,
        cwd=root,
    )
    assert done.returncode == 0, done.stderr
    confirmed = json.loads((tmp_path / "out" / "confirmed.json").read_text())
    assert all(line in done.stdout for line in confirmed["lines"])
    assert "E at least" in confirmed["lines"][2]
    assert "followed ray by ray" in (tmp_path / "out" / "report.html").read_text()
    found = json.loads((tmp_path / "out" / "trials" / "0000" / "evaluation.json").read_text())
    assert 0 < found["objectives"]["bound_modulus_kPa"] < 23.0


def test_a_layout_is_a_sensor_that_twin_simulate_reads(tmp_path: Path) -> None:
    found = prepared(tmp_path)
    explore.work(found, evaluate=evaluated)
    import twin

    good = next(
        place for place in sorted((found.folder / "trials").iterdir()) if (place / "design.toml").exists()
    )
    design = twin.load_design(good / "design.toml")
    taken = json.loads((good / "evaluation.json").read_text())["values"]
    assert len(design.leds) == taken["layout.leds"]
    assert replace(design.leds[0]).z_mm == taken["leds.*.z_mm"]
    assert isinstance(found.study.balls()[0], fem.Inclusion)
