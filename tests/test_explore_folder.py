"""Folders of explorations: whose they are, what is refused in one line, and that nothing half-made stays."""

import json
import os
import shutil
import stat
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_explore import STUDY, evaluated, prepared
from test_lamp import file_of

import twin
from twin import explore, explore_crew, explore_folder
from twin.cli import main
from twin.complaint import DesignError
from twin.explored import design_toml

EMULATOR = Path(twin.__file__).parent.parent / "assets" / "emulators" / "tsis.npz"


def written(tmp_path: Path, text: str = STUDY.replace("METHOD", "latin")) -> Path:
    file = tmp_path / "mine.toml"
    file.write_text(text)
    return file


def refused(words: list[str], capsys: pytest.CaptureFixture[str], *arguments: object) -> None:
    """The command ends with status 2 and one line that holds these words."""
    assert main(["explore", *map(str, arguments)]) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and line.startswith("twin explore: "), line
    assert all(word in line for word in words), line


def all_of(folder: Path) -> dict[str, bytes]:
    return {str(place): place.read_bytes() for place in sorted(folder.rglob("*.[tj]*")) if place.is_file()}


def test_another_sensor_does_not_get_the_folder(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The study's text is the same, the design's file beside it is not."""
    text = design_toml(twin.load_design("tsis"))
    assert "read_noise_e = 12" in text
    (tmp_path / "own.toml").write_text(text)
    study = STUDY.replace("METHOD", "latin").replace("[fields]", 'design = "own.toml"\n[fields]', 1)
    file, out = written(tmp_path, study), tmp_path / "out"
    explore.prepare(file, out)
    explore.prepare(file, out)
    (tmp_path / "own.toml").write_text(text.replace("read_noise_e = 12", "read_noise_e = 13"))
    before = all_of(out)
    refused(["--out", "another sensor", "camera.read_noise_e"], capsys, file, "--out", out)
    assert all_of(out) == before


def test_luminaires_are_known_by_what_they_say(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Named from the folder of the design, which the study names from where the designer stands."""
    angles = np.array([0.0, 45.0, 90.0])
    lamp = tmp_path / "d" / "lamp.ies"
    lamp.parent.mkdir()
    lamp.write_text(file_of(angles, np.zeros(1), np.array([100.0, 70.0, 0.0])))
    text = design_toml(twin.load_design("tsis")).replace('"lambertian"', '"ies"\nies = "lamp.ies"')
    (tmp_path / "d" / "own.toml").write_text(text)
    study = STUDY.replace("METHOD", "latin").replace("[fields]", 'design = "d/own.toml"\n[fields]', 1)
    monkeypatch.chdir(tmp_path)
    file = Path(written(tmp_path, study).name)
    found = explore.prepare(file, "out")
    assert [led.ies for led in explore.reopened(Path("out")).design.leds] == [str(lamp)] * 4
    explore.prepare(file, "out")
    shutil.copytree("d", "e")
    file.write_text(study.replace("d/own", "e/own"))
    (found.folder / explore_folder.STUDY).write_text(file.read_text())
    explore.prepare(file, "out")  # the same, elsewhere
    lamp.with_name("lamp.ies").write_text(file_of(angles, np.zeros(1), np.array([100.0, 5.0, 0.0])))
    file.write_text(study)
    (found.folder / explore_folder.STUDY).write_text(study)
    with pytest.raises(DesignError, match=r"--out: .*another sensor \(leds\.0\.ies"):
        explore.prepare(file, "out")


def test_another_emulator_does_not_get_the_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    mine, other = tmp_path / "a.npz", tmp_path / "b.npz"
    shutil.copy(EMULATOR, mine)
    shutil.copy(EMULATOR, other)
    prepared(tmp_path, emulator=mine)
    assert prepared(tmp_path, emulator=other).emulator == other  # the same, elsewhere
    found = prepared(tmp_path, emulator=mine)
    with monkeypatch.context() as patch:
        patch.setattr(explore, "_emulator", lambda *asked: None)
        with pytest.raises(DesignError, match=r"--out: .*another emulator"):
            prepared(tmp_path)
    with mine.open("ab") as file:
        file.write(b"\0")
    with monkeypatch.context() as patch:
        patch.setattr(explore, "_emulator", lambda *asked: mine)
        with pytest.raises(DesignError, match=r"--out: .*another emulator"):
            prepared(tmp_path)
    assert json.loads((found.folder / explore.HEAD).read_text())["emulator"] == str(mine)


def test_an_emulator_that_came_since_is_not_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was begun with solved mechanics goes on so."""
    with monkeypatch.context() as patch:
        patch.setattr(explore, "_emulator", lambda *asked: None)
        prepared(tmp_path)
    assert prepared(tmp_path).emulator is None
    with pytest.raises(DesignError, match=r"--out: .*another emulator.*no emulator"):
        prepared(tmp_path, emulator=EMULATOR)


def test_folders_without_hashes_go_on(tmp_path: Path) -> None:
    """Those that say no more than whose they are and how they were judged."""
    found = prepared(tmp_path)
    head = json.loads((found.folder / explore.HEAD).read_text())
    old = {name: head[name] for name in ("storage", "trials", "emulator", "judged")}
    (found.folder / explore.HEAD).write_text(json.dumps(old))
    assert explore.reopened(found.folder) == found
    assert prepared(tmp_path) == found
    assert json.loads((found.folder / explore.HEAD).read_text()) == head
    (found.folder / explore.HEAD).write_text(json.dumps(old))
    other = tmp_path / "other.npz"
    other.write_bytes(EMULATOR.read_bytes() + b"\0")
    with pytest.raises(DesignError, match=r"--out: .*another emulator"):
        prepared(tmp_path, emulator=other)


def test_places_that_are_no_folder_for_it(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path)
    (tmp_path / "afile").write_text("mine")
    for out in ("afile", "afile/deeper"):
        refused(["--out", "a folder that can be made"], capsys, file, "--out", tmp_path / out)
    (tmp_path / "a").mkdir()
    shutil.copy(file, tmp_path / "a" / "study.toml")
    refused(["--out", "no explore.json"], capsys, tmp_path / "a" / "study.toml", "--out", tmp_path / "a")
    (tmp_path / "b").mkdir()
    (tmp_path / "b" / "study.toml").write_bytes(b"\xff\xfe")
    refused(["--out", "same study file"], capsys, file, "--out", tmp_path / "b")
    found = explore.prepare(file, tmp_path / "c")
    for broken in (b"{", b"\xff", b"[]", b'{"storage": 3, "trials": 4, "emulator": null}'):
        (found.folder / explore.HEAD).write_bytes(broken)
        refused(["--out", "explore.json"], capsys, file, "--out", found.folder)
        assert (found.folder / explore.HEAD).read_bytes() == broken


def test_a_storage_that_does_not_open_leaves_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file, out = written(tmp_path), tmp_path / "new" / "x1"
    for url in ("bogus://u:s3cret@h/db", "postgresql://u@127.0.0.1:1/db?password=s3cret", "s3cret"):
        assert main(["explore", str(file), "--out", str(out), "--storage", url]) == 2
        line = capsys.readouterr().err
        assert "--storage: received" in line and ("s3cret" in line) == (url == "s3cret")
        assert not out.parent.exists()
    found = explore.prepare(file, out)
    before = all_of(out)
    refused(["--storage"], capsys, file, "--out", out, "--storage", "bogus://u:p@h/db")
    assert all_of(out) == before and explore.prepare(file, out) == found
    (out / explore.DATABASE).write_bytes(b"no database at all, but a text of some length")
    refused(["--out", "study.db"], capsys, file, "--out", out)


def test_a_password_is_kept_for_its_owner_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    empty = SimpleNamespace(get_trials=lambda deepcopy: [])
    monkeypatch.setattr(explore, "opened", lambda made: empty)
    monkeypatch.setattr(explore, "_enqueue", lambda made, study: None)
    for url, mode in (("postgresql://u:p@h/db", 0o600), ("postgresql://u@h/db", 0o666 & ~umask())):
        found = prepared(tmp_path, storage=url)
        assert stat.S_IMODE((found.folder / explore.HEAD).stat().st_mode) == mode
        assert explore.reopened(found.folder).url == url


def umask() -> int:
    now = os.umask(0o022)
    os.umask(now)
    return now


@pytest.mark.parametrize("name", ["a?b", "c%20d", "e{f}", "g h#i", "ü"])
def test_the_database_lies_in_the_folder_whatever_its_name(tmp_path: Path, name: str) -> None:
    found = prepared(tmp_path, name=f"q/{name}")
    assert (found.folder / explore.DATABASE).is_file()
    assert [place.name for place in (tmp_path / "q").iterdir()] == [name]
    assert prepared(tmp_path, name=f"q/{name}") == found == explore.reopened(found.folder)


def test_one_that_was_cut_off_before_it_had_begun_goes_on(tmp_path: Path) -> None:
    """What a kill leaves between the first folder and the study's file."""
    found = prepared(tmp_path)
    for name in (explore_folder.STUDY, explore_folder.HEAD):
        (found.folder / name).unlink()
    assert prepared(tmp_path) == found


def test_processes_may_begin_one_folder_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One comes while the other is opening the storage."""
    opened, both = explore.opened, []

    def late(made: explore.Exploration) -> object:
        if not both:
            both.append(made)
            both.append(prepared(tmp_path))
        return opened(made)

    monkeypatch.setattr(explore, "opened", late)
    assert prepared(tmp_path) == both[1]


def test_workers_run_nothing_of_the_current_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A stranger's study may come with a file called like a module; the worker gets to its empty DIR."""
    (tmp_path / "tomllib.py").write_text("open('ran', 'w').close()\nraise SystemExit(3)\n")
    (tmp_path / "out" / "workers").mkdir(parents=True)
    monkeypatch.chdir(tmp_path)
    assert explore_crew._start(Path("out"), 0).wait(60) == 1
    assert not (tmp_path / "ran").exists()
    assert "FileNotFoundError" in (tmp_path / "out" / "workers" / "0.log").read_text()


def test_a_folder_with_luminaires_may_be_moved(tmp_path: Path) -> None:
    angles, here = np.array([0.0, 45.0, 90.0]), tmp_path / "a"
    here.mkdir()
    (here / "lamp.ies").write_text(file_of(angles, np.zeros(1), np.array([100.0, 70.0, 0.0])))
    text = design_toml(twin.load_design("tsis")).replace('"lambertian"', '"ies"\nies = "lamp.ies"')
    (here / "own.toml").write_text(text)
    study = STUDY.replace("METHOD", "latin").replace("[fields]", 'design = "own.toml"\n[fields]', 1)
    explore.prepare(written(here, study), here / "out")
    there = here.rename(tmp_path / "b")
    explore.prepare(there / "mine.toml", there / "out")
    (there / "lamp.ies").write_text(file_of(angles, np.zeros(1), np.array([100.0, 5.0, 0.0])))
    with pytest.raises(DesignError, match=r"another sensor \(leds\.0\.ies"):
        explore.prepare(there / "mine.toml", there / "out")


@pytest.mark.parametrize("version", ["LIGHT", "SIGHT", "JUDGED"])
def test_layouts_judged_otherwise_are_not_gone_on_with(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, version: str
) -> None:
    prepared(tmp_path)
    monkeypatch.setattr(explore_folder, version, getattr(explore_folder, version) + 1)
    with pytest.raises(DesignError, match=r"--out: .*judged by another version"):
        prepared(tmp_path)


def test_layouts_judged_before_that_was_said_are_not_gone_on_with(tmp_path: Path) -> None:
    found = prepared(tmp_path)
    head = json.loads((found.folder / explore.HEAD).read_text())
    del head["judged"]
    (found.folder / explore.HEAD).write_text(json.dumps(head))
    with pytest.raises(DesignError, match=r"--out: .*judged by another version"):
        prepared(tmp_path)


def test_a_storage_that_knows_nothing_of_the_folder_does_not_overwrite_it(tmp_path: Path) -> None:
    explore.work(prepared(tmp_path, trials=3), evaluate=evaluated)
    before = all_of(tmp_path / "out")
    other = f"sqlite:///{tmp_path / 'other.db'}"
    with pytest.raises(DesignError, match=r"--storage: .*which knows the layouts of that folder"):
        prepared(tmp_path, trials=3, storage=other)
    assert all_of(tmp_path / "out") == before
    prepared(tmp_path, name="new", trials=3, storage=other)


def test_an_emulator_that_nobody_asked_for_must_know_every_place(tmp_path: Path) -> None:
    """The ball lies 8 mm beside the middle there; it knows 6."""
    study = STUDY.replace("METHOD", "latin")
    for number, (at, taken) in enumerate((("[[5.0, 0.0], [0.0, 0.0]]", True), ("[[8.0, 0.0]]", False))):
        file = tmp_path / f"{number}.toml"
        file.write_text(study.replace("[fields]", f"[protocol]\npositions_mm = {at}\n[fields]", 1))
        assert (explore.prepare(file, tmp_path / str(number)).emulator is not None) == taken
