"""What a worker of a corpus does: one function each for mechanics, light and a shared reference.

They are the tasks that Dask runs, named by corpus, plan and sample, so nothing large is sent to a worker, and
one that joins late needs no preparation. They raise nothing: what goes wrong is their answer (`Trouble`),
since it is the run that counts, retries and records it, not Dask.
"""

from __future__ import annotations

import errno
import gc
import logging
import os
import socket
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, TypeVar

from twin import store
from twin.planned import PLAN

if TYPE_CHECKING:
    from twin.plan import Plan
    from twin.sample import Contact

FULL = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG})
"""Errors of a disk with no room left."""
_UNWRITABLE = FULL | {errno.EROFS, errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.ENOTCONN}

QUIET = "DASK_LOGGING__DISTRIBUTED"
"""Environment variable: the level from which Dask logs, when set before Dask is imported."""
FRAMES_PER_LIFE = 6000
"""Frames after which a worker is replaced, whatever it holds; TWIN_FRAMES_PER_WORKER in its environment is
another number."""
TRIM_FRAMES = 25
"""Frames between two times that freed memory goes back to the system: it gets into ever smaller pieces."""
YOUNG_FRAMES, MOST_GROWTH, SPARE_B = 50, 1.5, 256 * 2**20
"""A worker is replaced too when it holds so many times what it held after its first frames, and some."""

T = TypeVar("T")

# Renderers and their scene belong to the process: with more threads than one, they light by turns.
_LIGHT = threading.Lock()


@dataclass(frozen=True)
class Pressed:
    """A sample's contact surfaces, one for each press level, and the seconds that they took."""

    contacts: list[Contact]
    seconds: float


@dataclass(frozen=True)
class Made:
    """A sample that is on the disk."""

    sample: int
    frames: int
    memory_B: int
    """Of the worker's process, when it was done."""
    process: str
    """Which worker: host and process number."""


@dataclass(frozen=True)
class Trouble:
    """Why there is no sample."""

    error: str
    """One line."""
    traceback: str = ""
    stops: bool = False
    """Whether no other sample would fare better: a full disk, a worker that sees another corpus."""


@dataclass(frozen=True)
class Corpus:
    """Which corpus: its folder, and the SHA-256 of its plan.json, which every worker must find there."""

    folder: str
    plan: str


def press(corpus: Corpus, number: int) -> Pressed | Trouble:
    """Do a sample's mechanics."""
    return _answered(lambda: _press(corpus, number))


def light(corpus: Corpus, number: int, found: Pressed | Trouble) -> Made | Trouble:
    """Light what `press` found, and write the sample's folder."""
    return found if isinstance(found, Trouble) else _answered(lambda: _light(corpus, number, found))


def refer(corpus: Corpus, number: int, level: int, found: Pressed | Trouble) -> Trouble | None:
    """Make the reference of one level, which a sample shares with others."""
    return found if isinstance(found, Trouble) else _answered(lambda: _refer(corpus, number, level, found))


def _press(corpus: Corpus, number: int) -> Pressed:
    plan = _ready(corpus)
    if _there(corpus, number):
        return Pressed([], 0.0)
    from twin import sample

    start = perf_counter()
    contacts = sample.pressed(plan, number)
    return Pressed(contacts, perf_counter() - start)


def _light(corpus: Corpus, number: int, found: Pressed) -> Made:
    plan = _ready(corpus)
    from twin import sample

    with _LIGHT:
        if not _there(corpus, number):  # else a worker finished it, and was gone before it could say so
            contacts = found.contacts or sample.pressed(plan, number)
            sample.lit(plan, number, contacts, found.seconds, Path(corpus.folder))
    sweep()
    held = _LIFE.lived(len(plan.indentation_mm))
    return Made(number, len(plan.indentation_mm), held, f"{socket.gethostname()}:{os.getpid()}")


def _refer(corpus: Corpus, number: int, level: int, found: Pressed) -> None:
    plan = _ready(corpus)
    from twin import sample

    if found.contacts:
        with _LIGHT:
            sample.refer(plan, number, level, found.contacts[level], Path(corpus.folder))


def _there(corpus: Corpus, number: int) -> bool:
    return (store.sample_folder(Path(corpus.folder), number) / store.SAMPLE).exists()


def _ready(corpus: Corpus) -> Plan:
    prepare()
    return _plan(corpus)


@cache
def prepare() -> None:
    """Make this process fit to work: one thread, Mitsuba on the CPU. Once per process, whoever started it."""
    if os.environ.get(QUIET) == "CRITICAL":  # a run's own worker, which shares its terminal
        logging.disable(logging.CRITICAL)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    from threadpoolctl import threadpool_limits

    from fem import heap
    from scenes import backend

    threadpool_limits(1)  # of libraries that are loaded already
    # Dask starts workers with MALLOC_TRIM_THRESHOLD_=65536: whatever a solve frees would go back to the
    # system at once and come again page by page, which takes as long as the solve
    heap.keep(32, 256, arenas=1)
    backend.use("cpu")
    backend.threads(1)


def sweep() -> None:
    """Free what refers to itself, megabytes a picture: left until Python minds, it lies among what lives on,
    and the process grows by a tenth. What is loaded by the first call is not looked through again."""
    gc.collect()
    _settle()


@cache
def _settle() -> None:
    gc.freeze()


@lru_cache(maxsize=2)
def _plan(corpus: Corpus) -> Plan:
    from twin.plan import load_plan

    folder = Path(corpus.folder)
    try:
        found = store.sha256(folder / PLAN)
    except OSError as error:
        raise WrongCorpus(
            f"{socket.gethostname()}: {folder / PLAN}: cannot be read ({error.strerror})"
        ) from None
    if found != corpus.plan:
        raise WrongCorpus(f"{socket.gethostname()}: {folder / PLAN}: is not the plan that is being run")
    return load_plan(folder)


class WrongCorpus(ValueError):
    """A worker that sees no corpus under the run's path, or another one; one line."""


def give_back() -> None:
    """Return memory that nobody uses to the system: Python's, Dr.Jit's and the C library's.

    Dr.Jit keeps all kernels that it ever compiled, a fifth of a MiB each; they are on the disk in any case.
    """
    from fem import heap

    gc.collect()  # cycles of arrays, some tens of MiB between two collections of Python's own
    if drjit := sys.modules.get("drjit"):
        drjit.flush_kernel_cache()
        drjit.flush_malloc_cache()
    heap.trim()


class _Life:
    """How long a worker has worked and how much it has grown; one that has seen enough is replaced."""

    def __init__(self) -> None:
        self.frames, self.young_B, self.over = 0, 0, False

    def lived(self, frames: int) -> int:
        """Count some more frames, and return the memory that the process holds, bytes."""
        if (self.frames + frames) // TRIM_FRAMES > self.frames // TRIM_FRAMES:
            give_back()
        self.frames += frames
        held_B = memory_B()
        if self.frames <= YOUNG_FRAMES or not self.young_B:
            self.young_B = held_B
        grown = held_B > MOST_GROWTH * self.young_B + SPARE_B
        if not self.over and (
            grown or self.frames >= int(os.environ.get("TWIN_FRAMES_PER_WORKER", FRAMES_PER_LIFE))
        ):
            self.over = _retire()
        return held_B


_LIFE = _Life()


def _retire() -> bool:
    """Have this worker replaced after its task: its nanny starts a new process, its queue goes to others."""
    from distributed import get_worker

    try:
        worker = get_worker()
    except ValueError:  # no worker of Dask: a test that calls the function itself
        return True
    if worker.nanny is not None:  # else nobody would start it again
        worker.loop.add_callback(worker.close_gracefully, restart=True, reason="has worked long enough")
    return True


def _answered(work: Callable[[], T]) -> T | Trouble:
    try:
        return work()
    except Exception as error:
        return trouble(error)


def trouble(error: BaseException) -> Trouble:
    """Return what is wrong, in one line and in full."""
    from scenes.backend import BackendError

    line = " ".join(str(error).split())[:2000]
    if not isinstance(error, ValueError | OSError) or not line:
        line = f"{type(error).__name__}: {line}".rstrip(": ")
    cause = error if isinstance(error, OSError) else error.__cause__
    number = cause.errno if isinstance(cause, OSError) else None
    if number in FULL:
        line = f"the disk is full: {line}"
    stops = isinstance(error, BackendError | WrongCorpus) or number in _UNWRITABLE
    return Trouble(line, "".join(traceback.format_exception(error)), stops)


def memory_B() -> int:
    """Return the memory that this process holds, bytes."""
    import psutil

    return int(psutil.Process().memory_info().rss)
