"""`twin corpus status` says what is there, what is missing, and why."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import pytest

from twin import occupied, store
from twin.cli import main
from twin.status import in_words, status


@pytest.fixture
def corpus(finished_corpus: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_corpus, tmp_path / "c"))


def fail(corpus: Path, number: int, text: str) -> None:
    place = store.failure_file(corpus, number)
    place.parent.mkdir(exist_ok=True)
    shutil.rmtree(store.sample_folder(corpus, number), ignore_errors=True)
    place.write_text(text)


def because(why: str) -> str:
    return json.dumps({"sample": 0, "error": why, "attempts": 2, "traceback": "..."})


def test_a_whole_corpus(corpus, capsys):
    note = store.sample_folder(corpus, 0) / store.SAMPLE
    said = json.loads(note.read_text())  # the first was begun half a minute before it was done
    note.write_text(json.dumps({**said, "seconds": {"mechanics": 10.0, "light": 15.0, "write": 5.0}}))
    for number in range(4):  # one every thirty seconds
        moment = 1e9 + 30 * number
        os.utime(store.sample_folder(corpus, number) / store.SAMPLE, (moment, moment))
    assert main(["corpus", "status", str(corpus), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["planned"], found["done"], found["missing"], found["failed"]) == (4, 4, 0, 0)
    assert found["frames"] == 8 and found["indexed"] and found["per_minute"] == pytest.approx(2.0)
    assert found["bytes"] == sum(path.stat().st_size for path in corpus.rglob("*") if path.is_file())
    assert found["leftovers"] == [] and found["running"] is None
    assert main(["corpus", "status", str(corpus)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "tiny: 4 of 4 samples done, 0 missing, 0 failed"
    assert lines[2] == "rate: 2 samples a minute"


def test_reasons_that_differ_in_numbers_are_one(corpus):
    fail(corpus, 0, because("NotConverged: residual 1.5e-3 after 20 steps"))
    fail(corpus, 3, because("NotConverged: residual 2e-4 after 30 steps"))
    fail(corpus, 1, because("ValueError: size"))
    (corpus / "samples/000/.000000.77.part").mkdir()
    found = status(corpus)
    assert (found.done, found.failed, found.missing) == (1, 3, 0)
    assert [(reason.count, reason.samples) for reason in found.reasons] == [(2, [0, 3]), (1, [1])]
    assert found.leftovers == ["samples/000/.000000.77.part"]
    words = in_words(found).splitlines()
    assert "failed (2; 0, 3): NotConverged: residual 1.5e-3 after 20 steps" in words
    assert "temporary: 1, of a run that was killed; run removes them" in words
    assert words[-1] == f"next: twin corpus run {corpus}"
    with occupied.locked(corpus):
        assert "temporary: 1, of the run that is going on" in in_words(status(corpus))


@pytest.mark.parametrize("text", ["", "[]", "{", '{"error": 5}', '{"error": ""}', "[" * 100_000, "\x00"])
def test_a_failure_that_cannot_be_read_is_one_all_the_same(corpus, text):
    fail(corpus, 2, text)
    (reason,) = status(corpus).reasons
    assert reason.samples == [2] and "cannot be read" in reason.error


def test_a_reason_cannot_steer_the_terminal(corpus):
    fail(corpus, 2, json.dumps({"error": "a\x1b[2Jb\nc\u202e"}))
    assert status(corpus).reasons[0].error == "a?[2Jb c?"


def test_what_is_no_sample_of_the_plan_does_not_count(corpus):
    shutil.copytree(store.sample_folder(corpus, 1), corpus / "samples/000/000009")
    (corpus / "samples/000/0000x").mkdir()
    (corpus / "failed").mkdir()
    (corpus / "failed/99999999999999999999.json").touch()
    (corpus / "failed/000001.json").write_text(
        because("made later")
    )  # a run was killed before it removed this
    found = status(corpus)
    assert (found.done, found.failed, found.missing) == (4, 0, 0)


def test_a_lock_that_is_hostile(corpus):
    (corpus / occupied.LOCK).symlink_to("/etc/passwd")
    assert status(corpus).running is None
    assert main(["corpus", "run", str(corpus)]) == 1
    assert Path("/etc/passwd").read_text()
