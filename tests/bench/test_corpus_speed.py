"""How a corpus scales with workers, and whether a worker's memory stays: `make bench`."""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from corpora import freeze_tiny, make_up_emulator

from twin import crew, labour, run
from twin.labour import Made

SPEED_UP, GROWTH_PERCENT = 1.8, 10.0
SAMPLES, ROUNDS = 12, 3
YOUNG, OLD = 50, 500  # frames


def samples_per_minute(corpus: Path, workers: int) -> float:
    """From the first finished sample to the last one: neither start nor warming up counts."""
    shutil.rmtree(corpus / "samples", ignore_errors=True)
    state = run.run(corpus, workers)
    assert state.made == SAMPLES
    warm = list(state.recent)[2 * workers - 1 :]
    return 60.0 * (len(warm) - 1) / (warm[-1] - warm[0])


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.skipif(crew.cores() < 2, reason="needs two cores")
def test_two_workers_are_twice_as_fast(tmp_path):
    """Of one thread each, interleaved with one such worker; the median of three rounds."""
    corpus = freeze_tiny(tmp_path, SAMPLES, (1.0, 2.0), leds=4, rows=240)  # smaller ones weigh less than Dask
    ratios = []
    for _ in range(ROUNDS):
        one, two = (samples_per_minute(corpus, workers) for workers in (1, 2))
        ratios.append(two / one)
        print(f"one worker {one:.1f} samples/min, two {two:.1f}: {two / one:.2f}x")
    assert sorted(ratios)[ROUNDS // 2] >= SPEED_UP


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_workers_memory_stays(tmp_path, monkeypatch):
    """After 500 frames within 10 % of that after 50, of a worker that is never replaced; emulated."""
    monkeypatch.setenv("TWIN_FRAMES_PER_WORKER", str(10 * OLD))
    levels = (0.5, 1.0, 1.5, 2.0, 2.5)
    emulator = make_up_emulator(tmp_path / "made-up.npz")
    corpus = freeze_tiny(tmp_path / "c", OLD // len(levels), levels, emulator=emulator)
    made: list[Made] = []
    kept = run._outcome

    def noting(future: object) -> object:
        outcome = kept(future)
        made.extend([outcome] if isinstance(outcome, Made) else [])  # not those of shared references
        return outcome

    monkeypatch.setattr(run, "_outcome", noting)
    began = time.perf_counter()
    run.run(corpus, 1)
    assert len({one.process for one in made}) == 1
    frames = [len(levels) * (count + 1) for count in range(len(made))]
    held = {count: one.memory_B for count, one in zip(frames, made, strict=True)}
    growth = 100.0 * (held[OLD] / held[YOUNG] - 1.0)
    print(
        f"{held[YOUNG] / 2**20:.0f} MiB after {YOUNG} frames, {held[OLD] / 2**20:.0f} after {OLD}: "
        f"{growth:+.1f} % ({time.perf_counter() - began:.0f} s)"
    )
    assert growth < GROWTH_PERCENT
    assert labour.FRAMES_PER_LIFE >= OLD
