"""Who does the work of a corpus: worker processes of Dask on this machine, or those of a scheduler elsewhere."""

from __future__ import annotations

import logging
import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Any

from twin.complaint import DesignError, shown
from twin.labour import QUIET

if TYPE_CHECKING:
    from distributed import Client

ANSWER_S = 10.0
"""Longest wait for a scheduler that was given by its address."""

_QUIET = {
    "distributed.worker.profile.enabled": False,  # costs time and memory, and nobody looks at it
    "distributed.scheduler.allowed-failures": 3,  # workers that a task may take with it
    "distributed.scheduler.worker-ttl": None,  # a solve may hold Python for minutes
    "distributed.comm.retry.count": 3,
    "distributed.admin.low-level-log-length": 1000,
    "distributed.nanny.environ": {},
}


@contextmanager
def crew(workers: int | None, scheduler: str | None) -> Iterator[Client]:
    """Yield a client of so many one-thread processes (default: one per core), or of the scheduler's workers.

    Local ones are reachable from this machine only, ignore Ctrl-C (who asked for them ends them), and end with
    this process, however it ends.

    Raises
    ------
    DesignError
        If no scheduler answers under the address.
    """
    # Before Dask is imported, here and in its workers: it tells a terminal a lot that is no news to a user.
    os.environ[QUIET] = "CRITICAL"
    import dask

    with dask.config.set(_QUIET):
        from distributed import Client

        for name in ("distributed", "tornado.application", "asyncio"):
            logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        if scheduler is not None:
            with _elsewhere(Client, scheduler) as client:
                yield client
            return
        with _local(workers or cores()) as cluster, Client(cluster, set_as_default=False) as client:
            yield client


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@contextmanager
def _elsewhere(client_of: Any, address: str) -> Iterator[Client]:
    allowed = f"the address of a Dask scheduler that answers within {ANSWER_S:g} s, as tcp://127.0.0.1:8786"
    try:
        client = client_of(address, timeout=ANSWER_S, set_as_default=False)
    except (OSError, ValueError, TypeError, ImportError, RuntimeError):
        raise DesignError("--scheduler", shown(address), allowed) from None
    try:
        yield client
    finally:
        with suppress(Exception):
            client.close(timeout=5)


@contextmanager
def _local(count: int) -> Iterator[Any]:
    from distributed import LocalCluster

    # Threads that start here never see Ctrl-C, nor do the processes that they start, also later.
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=None,
            memory_limit=0,
            silence_logs=logging.CRITICAL,
        )
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
    try:
        yield cluster
    finally:
        _end(cluster)


def _end(cluster: Any) -> None:
    """End the workers at once: what they are at is left undone, what is on the disk is whole."""
    import psutil

    for nanny in list(cluster.workers.values()):
        with suppress(Exception):
            nanny.auto_restart = False
            psutil.Process(nanny.pid).kill()
    with suppress(Exception):
        cluster.close(timeout=10)
