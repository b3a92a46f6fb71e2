"""Runs of a corpus that are cut off, killed, short of room, or spread over processes: always the same bytes."""

from __future__ import annotations

import os
import random
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from corpora import freeze_tiny, hashes, make_up_emulator
from test_run import ROOT, all_gone, cut_off, is_tidy, only_plan, start

from twin import index, run, store
from twin.plan import load_plan
from twin.verify import verify

pytestmark = [pytest.mark.slow, pytest.mark.timeout(1800)]

COUNT = 12


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Linear mechanics, two press levels, references of each sample's own; one worker."""
    corpus = freeze_tiny(tmp_path_factory.mktemp("undisturbed"), COUNT, (1.0, 2.0))
    assert run.run(corpus, 1).done == COUNT
    return corpus


def same(corpus: Path, other: Path) -> bool:
    """Every frame is there once, its bytes are the other's, the index says so, and nothing else is left."""
    plan = load_plan(corpus)
    table = index.read(corpus, plan, store.sha256(corpus / "plan.json"))
    wanted = [(sample, level) for sample in range(len(plan)) for level in range(len(plan.indentation_mm))]
    listed = list(zip(table["sample"].to_pylist(), table["level"].to_pylist(), strict=True))
    return listed == wanted and hashes(corpus) == hashes(other) and is_tidy(corpus)


def test_neither_workers_nor_order_nor_their_end_matter(undisturbed, tmp_path, monkeypatch):
    two = only_plan(undisturbed, tmp_path / "two")
    run.run(two, 2)
    assert same(two, undisturbed)
    monkeypatch.setenv("TWIN_FRAMES_PER_WORKER", "6")  # workers are replaced after three samples
    numbers = list(range(COUNT))
    random.Random(1).shuffle(numbers)
    other = only_plan(undisturbed, tmp_path / "other")
    seen: set[str] = set()
    kept = run._outcome

    def noting(future):
        outcome = kept(future)
        seen.add(outcome.process)
        return outcome

    monkeypatch.setattr(run, "_outcome", noting)
    state = run.run(other, 2, numbers=numbers)
    assert state.made == COUNT and state.failed == 0
    assert len(seen) >= 3
    assert same(other, undisturbed)


def test_the_index_is_the_same_but_for_its_timings(undisturbed, tmp_path):
    again = only_plan(undisturbed, tmp_path / "c")
    run.run(again, 2)
    plan = load_plan(again)
    one, two = (index.read(c, plan, store.sha256(c / "plan.json")) for c in (again, undisturbed))
    assert one.column_names[-2:] == list(index.TIMINGS)
    assert one.drop_columns(list(index.TIMINGS)).equals(two.drop_columns(list(index.TIMINGS)))
    before = (again / index.FILE).read_bytes()
    (again / index.FILE).unlink()
    index.build(again, plan, store.sha256(again / "plan.json"))
    assert (again / index.FILE).read_bytes() == before


def test_kill_9_at_ten_random_moments(undisturbed, tmp_path):
    """Each time on what the kill before left; the last run is let be."""
    corpus = only_plan(undisturbed, tmp_path / "c")
    moments = random.Random(5)
    left = 0
    for _ in range(10):
        # A start takes four seconds; a sample of two levels two to four.
        process, wait_s = start(corpus), moments.uniform(0.5, 12.0)
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=wait_s)
        process.send_signal(signal.SIGKILL)
        process.communicate()
        assert all_gone(process.pid)  # its workers went with it
        left += bool(list(corpus.rglob(".*.part")))
        done = len(store.finished(corpus))
        if done >= COUNT - 2:  # or there would be nothing to kill any more
            for number in list(store.finished(corpus))[:6]:
                shutil.rmtree(store.sample_folder(corpus, number))
    assert left  # some of them were in the middle of a sample
    process = start(corpus)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert out.startswith(f"{COUNT} of {COUNT} samples are there")
    assert same(corpus, undisturbed)


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and workers, started by hand as README says, on loopback; yields the address."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    dask = [sys.executable, "-m", "dask"]
    scheduler = subprocess.Popen(
        [*dask, "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard"],
        cwd=ROOT,
        env=environment,
        stderr=subprocess.PIPE,
        text=True,
    )
    started = []
    try:
        assert scheduler.stderr
        for line in scheduler.stderr:
            if match := re.search(r"tcp://127\.0\.0\.1:[0-9]+", line):
                address = match[0]
                break
        started = [
            subprocess.Popen(
                [*dask, "worker", address, "--nthreads", "1", "--no-dashboard"],
                cwd=ROOT,
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=subprocess.DEVNULL,
            )
            for _ in range(workers)
        ]
        yield address, started
    finally:
        for process in [*started, scheduler]:
            process.terminate()
        for process in [*started, scheduler]:
            process.wait(timeout=30)


def test_a_scheduler_and_workers_started_by_hand(undisturbed, tmp_path):
    corpus = only_plan(undisturbed, tmp_path / "c")
    with cluster(2) as (address, _):
        process = start(corpus, "--scheduler", address)
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert same(corpus, undisturbed)


def test_one_of_two_workers_is_killed_in_the_middle(undisturbed, tmp_path):
    corpus = only_plan(undisturbed, tmp_path / "c")
    with cluster(2) as (address, workers):
        process = start(corpus, "--scheduler", address)
        while len(store.finished(corpus)) < 3 and process.poll() is None:
            time.sleep(0.1)
        workers[0].kill()
        _, err = process.communicate(timeout=300)
        assert process.returncode == 0, err
        assert same(corpus, undisturbed)


def test_a_local_worker_is_killed_in_the_middle(undisturbed, tmp_path):
    import psutil

    corpus = only_plan(undisturbed, tmp_path / "c")
    process = cut_off(corpus, 0, lambda: len(store.finished(corpus)) >= 3)
    children = [
        child for child in psutil.Process(process.pid).children() if "spawn_main" in str(child.cmdline())
    ]
    children[0].kill()
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert same(corpus, undisturbed)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 600 kB."""
    place = tmp_path / "disk"
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", str(place)], capture_output=True, text=True
    )
    if done.returncode:
        pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
    yield place
    subprocess.run(["umount", str(place)], check=True)


def test_a_full_disk_stops_the_run_and_nothing_is_lost(undisturbed, small_disk):
    corpus = only_plan(undisturbed, small_disk / "c")
    process = start(corpus)
    out, err = process.communicate(timeout=300)
    assert process.returncode == 1
    line = err.splitlines()[-1]
    assert line.startswith("twin corpus run: the disk is full: ") and line.endswith(
        "(No space left on device)"
    )
    assert "Traceback" not in err and not out
    assert is_tidy(corpus)
    done = store.finished(corpus)
    assert 0 < len(done) < COUNT
    for number in done:  # nothing is corrupt
        for path in store.sample_folder(corpus, number).glob("*.*g"):
            assert store.sha256(path) == store.sha256(undisturbed / path.relative_to(corpus))
    assert not (corpus / "failed").exists()
    subprocess.run(["mount", "-o", "remount,size=20m", str(small_disk)], check=True)
    process = start(corpus)
    _, err = process.communicate(timeout=300)
    assert process.returncode == 0, err
    assert same(corpus, undisturbed)


def test_shared_references_of_many_workers(tmp_path):
    """Emulated samples share the picture without inclusion: one file, whoever made it."""
    emulator = make_up_emulator(tmp_path / "made-up.npz")
    corpora = [freeze_tiny(tmp_path / str(n), 6, (1.0, 2.0), emulator=emulator) for n in (1, 2)]
    for corpus, workers in zip(corpora, (1, 2), strict=True):
        run.run(corpus, workers)
        assert len(list((corpus / "references").iterdir())) == 4
        assert verify(corpus, resimulate=1, workers=1).good
    assert same(*corpora)
