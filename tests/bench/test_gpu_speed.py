"""A CUDA GPU beside the processor of the same machine, in one run: `make bench`."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from scenes import backend

GOALS = {"standard": 1.0, "100 steps": 1.0}
"""Least ratio of times. The reference has none: walks in tissue are of very unequal length, and threads of a
GPU that go together wait for the longest."""

PROGRAM = Path(__file__).parents[1] / "light_process.py"


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.skipif(backend._cuda_fault() != "", reason="this machine has no CUDA GPU that traces rays")
def test_a_gpu_is_sooner() -> None:
    found = {}
    for device in ("cuda", "cpu"):
        path = os.pathsep.join(map(str, (PROGRAM.parent, PROGRAM.parents[1])))
        environment = {**os.environ, "PYTHONPATH": path + os.pathsep + os.environ.get("PYTHONPATH", "")}
        done = subprocess.run(
            [sys.executable, PROGRAM, device], env=environment, check=True, capture_output=True, text=True
        )
        found[device] = json.loads(done.stdout.splitlines()[-1])
    for what, seconds in found["cuda"].items():
        ratio = found["cpu"][what] / seconds
        print(
            f"\n{what}: CUDA {seconds:.2f} s, {os.cpu_count()} cores {found['cpu'][what]:.2f} s, "
            f"ratio {ratio:.2f} (goal {GOALS.get(what, 'none')})"
        )
    for what, goal in GOALS.items():
        assert found["cpu"][what] / found["cuda"][what] > goal
