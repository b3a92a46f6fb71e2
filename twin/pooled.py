"""The same work on many tasks in processes that end with the one that began them."""

from __future__ import annotations

import multiprocessing
import os
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

Task = TypeVar("Task")

ENDED = "a worker process was ended from outside, perhaps for memory"
_ORPHAN_S = 1.0


def each(
    work: Callable[[Task], Any],
    tasks: Sequence[Task],
    workers: int,
    begin: Callable[[], None],
    tell: Callable[[int], None],
) -> None:
    """Call ``work`` with every task, in so many processes, and ``tell`` how many are done.

    ``begin`` is called in every process first. Where something is raised, an interruption too, the processes
    are ended at once: ``work`` leaves nothing half-written. Raises ChildProcessError where one is killed.
    """
    pool = ProcessPoolExecutor(
        max(workers, 1), multiprocessing.get_context("spawn"), _begin, (os.getpid(), begin)
    )
    with pool:
        try:
            for count, one in enumerate(as_completed([pool.submit(work, task) for task in tasks]), start=1):
                one.result()
                tell(count)
        except BrokenProcessPool:
            raise ChildProcessError(ENDED) from None
        except BaseException:
            processes = list((pool._processes or {}).values())  # Python 3.14 has terminate_workers
            pool.shutdown(wait=False, cancel_futures=True)
            for process in processes:
                process.terminate()
            raise


def end_with(parent: int) -> None:
    """End this process soon after the one that began it has gone, however that went."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(_ORPHAN_S)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _begin(parent: int, begin: Callable[[], None]) -> None:
    end_with(parent)
    begin()
