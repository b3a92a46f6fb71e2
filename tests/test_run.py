"""`twin corpus run`: what it makes does not depend on who makes it, in which order, or how often it was cut
off. The long ones are in test_run_long.py."""

from __future__ import annotations

import errno
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from corpora import freeze_tiny, hashes, make_up_emulator

from scenes import exr
from twin import crew, index, labour, occupied, run, store
from twin.cli import main
from twin.headway import words
from twin.labour import Corpus, Made, Pressed, Trouble
from twin.plan import load_plan

ROOT = Path(__file__).resolve().parent.parent


def copy_of(corpus: Path, place: Path) -> Path:
    shutil.copytree(corpus, place)
    return place


def only_plan(corpus: Path, place: Path) -> Path:
    """A corpus of the same plan with nothing made yet."""
    place.mkdir(parents=True)
    for name in ("plan.json", "samples.parquet", "emulator.npz"):
        if (corpus / name).exists():
            shutil.copy(corpus / name, place / name)
    return place


def is_tidy(corpus: Path) -> bool:
    """No lock and no temporary file is left."""
    return not list(corpus.rglob(".*")) and not (corpus / occupied.LOCK).exists()


@pytest.mark.slow
def test_workers_make_the_bytes_that_one_process_makes(finished_corpus, tmp_path, capfd):
    """Two processes of one thread, from the last to the first, against one process with all its threads."""
    corpus = only_plan(finished_corpus, tmp_path / "c")
    state = run.run(corpus, 2, numbers=[3, 2, 1, 0])
    assert (state.planned, state.done, state.made, state.failed) == (4, 4, 4, 0)
    assert hashes(corpus) == hashes(finished_corpus)
    assert is_tidy(corpus)
    captured = capfd.readouterr()
    assert captured.out == captured.err == ""  # Dask has nothing to tell a terminal


def test_run_continues_and_tries_failed_samples_again(finished_corpus, tmp_path, capsys):
    corpus = copy_of(finished_corpus, tmp_path / "c")
    for number in (1, 2):
        shutil.rmtree(store.sample_folder(corpus, number))
    store.sample_folder(corpus, 1).write_text("in the way")  # so it cannot take its place
    (corpus / "samples" / "000" / ".000002.1.part").mkdir()
    (corpus / "references" / ".k.exr.1.abcd.part").write_text("of a killed run")
    assert main(["corpus", "run", str(corpus), "--workers", "1"]) == 1
    told = capsys.readouterr()
    assert told.out.startswith("3 of 4 samples are there, 1 of them new")
    assert told.err.strip().splitlines()[-1].startswith("twin corpus run: 1 samples failed")
    record = json.loads(store.failure_file(corpus, 1).read_text(encoding="utf-8"))
    assert record["sample"] == 1 and record["attempts"] == 2
    assert "Not a directory" in record["error"] and "\n" not in record["error"]
    assert "Traceback" in record["traceback"]
    assert is_tidy(corpus)

    store.sample_folder(corpus, 1).unlink()
    assert main(["corpus", "run", str(corpus), "--workers", "1"]) == 0
    assert not store.failure_file(corpus, 1).exists()
    assert hashes(corpus) == hashes(finished_corpus)
    assert main(["corpus", "run", str(corpus)]) == 0
    assert capsys.readouterr().out.splitlines()[-1].startswith("4 of 4 samples are there, 0 of them new")


def test_ctrl_c_stops_the_run_and_its_workers(finished_corpus, tmp_path):
    corpus = only_plan(finished_corpus, tmp_path / "c")
    process = cut_off(corpus, signal.SIGINT, lambda: store.finished(corpus) or parts(corpus))
    _, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert err.splitlines()[-1] == "twin corpus run: interrupted; what is finished stays, run again continues"
    assert "Traceback" not in err and "distributed" not in err
    assert is_tidy(corpus)
    assert all_gone(process.pid)


def parts(corpus: Path) -> list[Path]:
    return list(corpus.glob("samples/*/.*.part"))


def cut_off(corpus: Path, how: int, when: Callable[[], Any]) -> subprocess.Popen[str]:
    """Start a run of two workers and send it a signal once ``when`` says so."""
    process = start(corpus)
    end = time.monotonic() + 60
    while not when() and process.poll() is None and time.monotonic() < end:
        time.sleep(0.05)
    process.send_signal(how)
    return process


def start(corpus: Path, *more: str) -> subprocess.Popen[str]:
    """`twin corpus run` with two workers, in a process group of its own."""
    command = [sys.executable, "-m", "twin", "corpus", "run", str(corpus), *(more or ("--workers", "2"))]
    return subprocess.Popen(
        command,
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # a shell ignores Ctrl-C for what runs in the background, and so would this process
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )


def workers_of(group: int) -> list[int]:
    """Processes of a group that are still at work."""
    import psutil

    found = []
    for process in psutil.process_iter(["pid", "status"]):
        try:
            if os.getpgid(process.pid) == group and process.info["status"] != psutil.STATUS_ZOMBIE:
                found.append(process.pid)
        except ProcessLookupError:
            continue
    return found


def all_gone(group: int, within_s: float = 10.0) -> bool:
    """Whether a group has no process at work, or none in a moment."""
    end = time.monotonic() + within_s
    while workers_of(group) and time.monotonic() < end:
        time.sleep(0.1)
    return not workers_of(group)


def test_one_run_at_a_time(finished_corpus, tmp_path, capsys):
    corpus = copy_of(finished_corpus, tmp_path / "c")
    assert occupied.holder(corpus) is None
    with occupied.locked(corpus):
        assert occupied.holder(corpus) == f"process {os.getpid()} on {os.uname().nodename}"
        for action in ("run", "verify"):
            assert main(["corpus", action, str(corpus)]) == 2
            (line,) = capsys.readouterr().err.splitlines()
            assert f"which process {os.getpid()} on" in line
    assert occupied.holder(corpus) is None
    (corpus / occupied.LOCK).write_text("left by a run that was killed")
    with occupied.locked(corpus):
        pass
    assert is_tidy(corpus)


@pytest.mark.parametrize("name", ["samples", "samples/000", "references", "failed"])
def test_a_corpus_that_leads_elsewhere_is_refused(finished_corpus, tmp_path, name, capsys):
    corpus, elsewhere = copy_of(finished_corpus, tmp_path / "c"), tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / ".precious.part").touch()
    shutil.rmtree(corpus / name, ignore_errors=True)
    (corpus / name).symlink_to(elsewhere)
    for action in (["run"], ["verify", "--repair"]):
        assert main(["corpus", *action, str(corpus)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert f"DIR: received '{name}', which is a link" in line
    assert [path.name for path in elsewhere.iterdir()] == [".precious.part"]


def test_a_scheduler_that_does_not_answer_is_refused(finished_corpus, tmp_path, monkeypatch, capsys):
    corpus = only_plan(finished_corpus, tmp_path / "c")
    monkeypatch.setattr(crew, "ANSWER_S", 1.0)
    for address in ("tcp://127.0.0.1:9", "nonsense", "http://127.0.0.1:9", "tcp://127.0.0.1"):
        began = time.monotonic()
        assert main(["corpus", "run", str(corpus), "--scheduler", address]) == 2
        assert time.monotonic() - began < 5
        (line,) = capsys.readouterr().err.splitlines()
        assert line.startswith(f"twin corpus run: --scheduler: received '{address}'; allowed the address of")
    assert is_tidy(corpus)


@pytest.mark.parametrize(
    ("flags", "start_of_line"),
    [
        (["--workers", "0"], "--workers: received 0; allowed an integer > 0"),
        (["--workers", "-1"], "--workers: received"),
        (["--scheduler", ""], "--scheduler: received ''"),
        (["--workers", "1", "--scheduler", "tcp://127.0.0.1:9"], "--workers: received it with --scheduler"),
    ],
)
def test_bad_flags(finished_corpus, flags, start_of_line, capsys):
    assert main(["corpus", "run", str(finished_corpus), *flags]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"twin corpus run: {start_of_line}")


def test_no_corpus(tmp_path, capsys):
    for action in ("run", "status", "verify"):
        assert main(["corpus", action, str(tmp_path)]) == 2
        (line,) = capsys.readouterr().err.splitlines()
        assert "plan.json" in line and "allowed a folder that `twin corpus plan` wrote" in line


def test_a_full_disk_is_trouble_for_all(tmp_path):
    """However it comes: from a write of ours, wrapped, or from the system."""
    for number in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.ENOTDIR):
        plain = OSError(number, os.strerror(number), "file")
        wrapped = exr.ImageError(f"file: cannot be written ({os.strerror(number)})")
        wrapped.__cause__ = plain
        for error in (plain, wrapped):
            found = labour.trouble(error)
            assert found.stops == (number != errno.ENOTDIR)
            assert found.error.startswith("the disk is full: ") == (number in labour.FULL)
    assert not labour.trouble(RuntimeError("one\ntwo")).stops
    assert labour.trouble(RuntimeError("one\ntwo")).error == "RuntimeError: one two"


def test_a_worker_that_sees_another_corpus_stops_the_run(finished_corpus, tmp_path):
    plan = store.sha256(finished_corpus / "plan.json")
    for corpus in (Corpus(str(tmp_path), plan), Corpus(str(finished_corpus), "0" * 64)):
        found = labour.press(corpus, 0)
        assert isinstance(found, Trouble) and found.stops and "plan.json" in found.error
        assert labour.light(corpus, 0, found) is found  # and is not tried


def test_a_sample_that_is_there_is_not_made_again(finished_corpus, tmp_path):
    """As when a worker dies between finishing it and saying so."""
    corpus = copy_of(finished_corpus, tmp_path / "c")
    key = Corpus(str(corpus), store.sha256(corpus / "plan.json"))
    before = {path: path.stat().st_mtime_ns for path in corpus.rglob("*")}
    pressed = labour.press(key, 2)
    assert pressed == Pressed([], 0.0)
    made = labour.light(key, 2, pressed)
    assert isinstance(made, Made) and made.sample == 2 and made.frames == 2
    assert {path: path.stat().st_mtime_ns for path in corpus.rglob("*")} == before


class Scheduler:
    """Dask's client, as far as a run knows it; tasks are answered one by one, the last ones first."""

    status = "running"

    def __init__(self, workers: int, answer: Callable[[int, int], Any]) -> None:
        self.workers, self.answer = workers, answer
        self.waiting: list[Any] = []
        self.most, self.tried = 0, []

    def nthreads(self) -> dict[str, int]:
        if self.waiting:
            self.most = max(self.most, len(self.waiting))
            self.waiting.pop().finish()
        return {f"tcp://{worker}": 1 for worker in range(self.workers)}

    def submit(self, task: Any, *arguments: Any, key: str, **more: Any) -> Any:
        return Task(self, key)


class Task:
    def __init__(self, scheduler: Scheduler, key: str) -> None:
        self.scheduler, self.key = scheduler, key

    def add_done_callback(self, call: Callable[[Any], None]) -> None:
        self.call = call
        self.scheduler.waiting.append(self)

    def finish(self) -> None:
        self.call(self)

    def result(self) -> Any:
        _, _, number, attempt = self.key.split("-")
        self.scheduler.tried.append(int(number))
        return self.scheduler.answer(int(number), int(attempt))


def test_few_samples_are_on_their_way_and_failures_are_tried_again(tmp_path, monkeypatch):
    """400 samples on 3 workers; every seventh fails at first, one always."""
    monkeypatch.setattr(run, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(run, "_TICK_S", 0.001)

    def answer(number: int, attempt: int) -> Any:
        if number == 5 or (number % 7 == 0 and attempt == 0):
            return Trouble("ValueError: 5", "Traceback")
        return Made(number, 1, 0, "here:1")

    scheduler = Scheduler(3, answer)
    plan = load_plan(freeze_tiny(tmp_path))
    state = run.Progress(400, 0)
    corpus = Corpus(str(tmp_path), "")
    table = index.Table(tmp_path, plan, "")
    job = run._Run(scheduler, plan, corpus, state, 2, lambda state: None, table)
    job.make(iter(range(400)))
    assert scheduler.most == run.WINDOW * 3
    assert (state.done, state.failed, state.made) == (399, 1, 399)
    assert scheduler.tried.count(5) == 3
    assert len(scheduler.tried) == 400 + 58 + 2
    assert json.loads(store.failure_file(tmp_path, 5).read_text())["attempts"] == 3

    scheduler = Scheduler(3, lambda number, attempt: Trouble("the disk is full: x", "", stops=number == 9))
    job = run._Run(scheduler, plan, corpus, run.Progress(400, 0), 1, lambda state: None, table)
    with pytest.raises(run.Stopped, match="the disk is full: x"):
        job.make(iter(range(400)))


def test_rate_and_time_left(monkeypatch):
    now = [100.0]
    monkeypatch.setattr(run.time, "monotonic", lambda: now[0])
    state = run.Progress(planned=1000, done=100, workers=2, started=100.0)
    assert state.left_s is None and words(state) == "100 of 1000 samples"
    for _ in range(10):
        now[0] += 6.0
        state.count()
    assert state.per_minute == pytest.approx(10.0)
    assert state.left_s == pytest.approx(890 * 6.0)
    for _ in range(300):  # faster of late: the slow start is forgotten
        now[0] += 0.6
        state.count()
    assert state.per_minute == pytest.approx(100.0)
    state.failed, state.workers = 2, 0
    assert words(state) == "410 of 1000 samples, 2 failed, waiting for workers, 100 a minute, 0:05:53 left"


def test_shared_references_are_made_before_the_samples(tmp_path, monkeypatch):
    """One task for each level, and only then the samples: else every worker would make all of them."""
    order: list[str] = []

    class Noting(Scheduler):
        def submit(self, task: Any, *arguments: Any, key: str, **more: Any) -> Any:
            order.append(key.split("-")[0])
            found = super().submit(task, *arguments, key=key)
            if task is labour.refer:
                found.key = f"light-x-{arguments[1]}-0"
            return found

    monkeypatch.setattr(run, "_LOOK_EVERY_S", 0.0)
    monkeypatch.setattr(run, "_TICK_S", 0.001)
    emulator = make_up_emulator(tmp_path / "made-up.npz")
    plan = load_plan(freeze_tiny(tmp_path / "c", 3, (1.0, 2.0), emulator=emulator))
    assert plan.shares_references
    client = Noting(1, lambda number, attempt: Made(number, 2, 0, "here:1"))
    table = index.Table(tmp_path, plan, "")
    state = run.Progress(3, 0)
    run._Run(client, plan, Corpus(str(tmp_path), ""), state, 1, lambda state: None, table).make(
        iter(range(3))
    )
    assert order == ["press", "refer", "refer", *3 * ["press", "light"]]
    assert state.made == 3
