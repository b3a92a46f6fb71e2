"""LEDs' light side by side: NumPy and its transforms let go of Python's lock, so threads share the work."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import drjit as dr

Found = TypeVar("Found")


def abreast(work: Callable[[int], Found], count: int) -> list[Found]:
    """`work` of 0 ... count - 1, on as many threads as Dr.Jit's kernels have (`backend.threads`).

    What is found does not depend on the number of threads.
    """
    threads = min(dr.thread_count(), count)
    if threads < 2:
        return [work(number) for number in range(count)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, range(count)))
