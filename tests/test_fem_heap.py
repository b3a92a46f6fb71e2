"""Freed memory that is kept, told by the page faults of a process of its own."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="told by glibc's malloc and Linux's books")

WORK = """
import resource
import numpy as np
from fem import heap
{first}
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(20):
        arrays = [np.ones(2**18) for _ in range(12)]  # 2 MiB each, 24 in all
        del arrays
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
faults()
print(faults())
"""


def faults(first: str) -> int:
    """Pages that the system had to clear for arrays that were there before."""
    env = {name: value for name, value in os.environ.items() if not name.startswith("MALLOC_")}
    done = subprocess.run(
        [sys.executable, "-c", WORK.format(first=first)], env=env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return int(done.stdout)


def test_arrays_come_back_without_the_system() -> None:
    """The first call counts, as a corpus's worker asks for more than its presses do."""
    plain = faults("")
    assert faults("heap.keep()") < 0.01 * plain
    assert faults("heap.keep(1, 1)\nheap.keep()") > 0.5 * plain
