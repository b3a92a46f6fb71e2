"""Run a plan's solves in worker processes: one small file each, so that a build can be cut off and goes
on."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import count
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fem.model import NotConverged, NotModelled
from fem.sampling import PLAN, NotBuilt, Plan
from fem.specimen import background, refine, refine_stretch, solve, stretch

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]


_DEAD = (
    "workers: received one that ended by itself, killed or out of memory; allowed are as many as the memory "
    "holds (what is solved is kept: the same call goes on)"
)
_FORMAT = 10  # of a folder: its files, and the mechanics they are solved by (10: points share tissues)
_SHARE = {"pair": 8, "stretched_pair": 24}  # samples for each pair of a fine and a lean or coarse mesh
_FIRST = 16  # pairs of each kind that come with one sample each
KNOTS = (4, 4)  # Chebyshev nodes of the background along thickness and tissue: 0.01 % off between them


def chebyshev(low: float, high: float, nodes: int) -> Floats:
    """Chebyshev nodes (nodes,) of a range."""
    at = np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
    return np.asarray(0.5 * (low + high) - 0.5 * (high - low) * at)


def knots(plan: Plan) -> tuple[Floats, Floats]:
    """Where the background is solved: 1/thickness, 1/mm, and the logarithm of the tissue's modulus in kPa."""
    thick, tissue = plan.ranges.thickness_mm, plan.ranges.tissue_kPa
    return (
        chebyshev(1 / thick[1], 1 / thick[0], KNOTS[0]),
        chebyshev(float(np.log(tissue[0])), float(np.log(tissue[1])), KNOTS[1]),
    )


def file_of(folder: Path, kind: str, number: int) -> Path:
    """Where a solve is kept: kind "background" or one of `_SOLVES`."""
    return folder / f"{kind}-{number:05d}.npz"


def run(
    plan: Plan,
    folder: Path,
    samples: int | None,
    seconds: float | None,
    workers: int,
    progress: Progress,
) -> None:
    """Do the solves that are not yet in the folder, until there are so many samples or the time is up.

    Raises
    ------
    NotBuilt
        If the folder belongs to another plan, plain tissue cannot be followed, or a worker ends by itself.
    """
    start = time.monotonic()
    claim(plan, folder)
    listed = None if samples is None else list(_tasks(plan, folder, samples))
    context = multiprocessing.get_context("spawn")
    done, running = 0, set[Future[None]]()
    with ProcessPoolExecutor(workers, context, initializer=_alone) as pool:
        try:
            for kind, numbers in listed or _tasks(plan, folder, samples):
                spent = time.monotonic() - start
                if seconds is not None and spent > seconds and kind != "background":
                    break
                end = None if seconds is None else time.time() + seconds - spent
                running.add(pool.submit(_work, PLAN.dump_json(plan), str(folder), kind, numbers, end))
                if len(running) > workers:
                    ready, running = wait(running, return_when=FIRST_COMPLETED)
                    done += len(ready)
                    for future in ready:
                        future.result()
                by_time = 0.0 if seconds is None else spent / seconds
                by_count = 0.0 if listed is None else done / len(listed)
                progress(f"{kind} {numbers[-1] + 1}", min(1.0, max(by_time, by_count)))
            for future in running:
                future.result()
        except BaseException as error:
            pool.shutdown(wait=False, cancel_futures=True)
            for worker in multiprocessing.active_children():  # what they are at is left undone
                worker.terminate()
            if isinstance(error, BrokenProcessPool):
                raise NotBuilt(_DEAD) from ChildProcessError(str(error))
            raise


def claim(plan: Plan, folder: Path) -> None:
    """Write the plan into an empty folder, or check that it is the folder's own."""
    folder.mkdir(parents=True, exist_ok=True)
    head, place = {"format": _FORMAT, "plan": PLAN.dump_python(plan, mode="json")}, folder / "plan.json"
    if place.exists():
        try:
            same = json.loads(place.read_bytes()) == json.loads(json.dumps(head))
        except ValueError:
            same = False
        if not same:
            raise NotBuilt(
                f"folder: received {folder}, which holds the samples of another plan, or of another version; "
                "allowed an empty one"
            )
    else:
        _write(place, json.dumps(head, indent=1).encode())


def _tasks(plan: Plan, folder: Path, samples: int | None) -> Iterator[tuple[str, list[int]]]:
    """What is still to solve, in order: kind and numbers, those of samples that share a tissue together;
    pairs are spread evenly among them."""

    def order() -> Iterator[tuple[str, list[int]]]:
        pairs = dict.fromkeys(("pair", "stretched_pair") if plan.finite else ("pair",), 0)
        for number in range(KNOTS[0] * KNOTS[1]):
            yield "background", [number]
        for first in count(0, plan.shared):
            numbers = range(
                first, first + plan.shared if samples is None else min(first + plan.shared, samples)
            )
            if not numbers:
                return
            for kind, share in _SHARE.items():
                while kind in pairs and pairs[kind] <= max(min(first, _FIRST - 1), first // share):
                    yield kind, [pairs[kind]]
                    pairs[kind] += 1
            yield "sample", list(numbers)

    for kind, numbers in order():
        left = [
            n for n in numbers if any(not file_of(folder, *one).exists() for one in _asked(plan, kind, n))
        ]
        if left:
            yield kind, left


def _asked(plan: Plan, kind: str, number: int) -> list[tuple[str, int]]:
    """The solves of a task's number: some samples are solved at finite strain, too."""
    more = kind == "sample" and plan.finite and plan.stretched(number)
    return [(kind, number), ("stretch", number)] if more else [(kind, number)]


def _alone() -> None:
    """Ctrl-C ends a worker at once and without a word, and so does the end of its parent."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


# what a solve that finds no equilibrium ends in
_UNSOLVED = (NotConverged, NotModelled, ArithmeticError, np.linalg.LinAlgError)
_SOLVES = {"sample": solve, "pair": refine, "stretch": stretch, "stretched_pair": refine_stretch}


def _work(plan_json: bytes, folder: str, kind: str, numbers: list[int], end: float | None) -> None:
    """Solve and keep what is not kept yet; samples until the time `end`."""
    plan = PLAN.validate_json(plan_json)
    for number in numbers:
        for one in _asked(plan, kind, number):
            if kind == "sample" and end is not None and time.time() > end:
                return
            if not file_of(Path(folder), *one).exists():
                _solve(plan, Path(folder), *one)


def _solve(plan: Plan, folder: Path, kind: str, number: int) -> None:
    start = time.process_time()
    if kind == "background":
        thick, tissue = knots(plan)
        i, j = divmod(number, KNOTS[1])
        specimen = float(1 / thick[i]), float(np.exp(tissue[j]))
        try:
            found = background(plan, *specimen)
        except _UNSOLVED as error:  # no answer goes without it
            raise NotBuilt(
                f"specimen: received plain tissue of {specimen[0]:.3g} mm and {specimen[1]:.3g} kPa, which "
                f"cannot be pressed by {plan.ranges.indentation_mm[1]:g} mm ({error}); allowed are specimens "
                "that can, or small strain"
            ) from None
    else:
        point = plan.point(number * plan.shared if kind.endswith("pair") else number)
        try:
            found = _SOLVES[kind](plan, point)
        except _UNSOLVED:
            found = {}  # kept as a gap, so that a build that goes on does not try it again
        found["point"] = point
    found["seconds"] = np.array(time.process_time() - start)
    place = file_of(folder, kind, number)
    rough = place.with_name(f".{place.name}.{os.getpid()}")
    with open(rough, "wb") as stream:
        kept = {name: np.asarray(value, np.float64) for name, value in found.items()}
        np.savez(stream, **kept)  # type: ignore[arg-type]
    os.replace(rough, place)


def _write(place: Path, text: bytes) -> None:
    rough = place.with_name(f".{place.name}.{os.getpid()}")
    rough.write_bytes(text)
    os.replace(rough, place)


def solved(folder: Path, kind: str, first: int | None = None) -> Iterator[dict[str, Floats]]:
    """The finished solves of a kind in their order, of the `first` ones; those that failed are left out."""
    for place in _kept(folder, kind, first):
        with np.load(place, allow_pickle=False) as data:
            if len(data.files) > 2:
                yield {name: data[name] for name in data.files} | {"number": np.array(_number(place))}


def tally(folder: Path, kind: str, first: int | None = None) -> tuple[int, int]:
    """How many solves of a kind were tried, and how many of them failed."""
    return len(_kept(folder, kind, first)), len(_kept(folder, kind, first)) - len(
        list(solved(folder, kind, first))
    )


def _kept(folder: Path, kind: str, first: int | None) -> list[Path]:
    found = sorted(folder.glob(f"{kind}-*.npz"))
    return [place for place in found if first is None or _number(place) < first]


def _number(place: Path) -> int:
    return int(place.stem.rpartition("-")[2])
