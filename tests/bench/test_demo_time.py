"""How long a newcomer waits: `make bench` prints it."""

import subprocess
import sys
import time
from pathlib import Path

import pytest

LIMIT_S = 90
"""What the demo may take on two cores, once installed."""


@pytest.mark.slow
def test_demo_is_done_in_time(tmp_path: Path) -> None:
    start = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-m", "twin", "demo", "--device", "cpu", "--out", str(tmp_path / "demo")],
        capture_output=True,
        text=True,
        timeout=4 * LIMIT_S,
    )
    seconds = time.perf_counter() - start
    assert done.returncode == 0, done.stderr
    print(f"\ntwin demo: {seconds:.1f} s (at most {LIMIT_S})")
    assert seconds <= LIMIT_S
