"""Whether a corpus is what its plan says, byte for byte: hashes, records, index, and samples made again.

Nothing in the folder is trusted, so a damaged or hostile one gives lines, not failures. A picture is known by
its hash twice, in the sample's `sample.json` and in the index: who changes a frame has to change all three,
and is found out when it is simulated again.
"""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from twin import index, occupied, store
from twin.checking import Problem, Shared, check_index, check_places, check_sample
from twin.complaint import DesignError, shown
from twin.crew import cores
from twin.planned import PLAN, load_plan
from twin.remaking import remade

if TYPE_CHECKING:
    from twin.plan import Plan

_NAMED = 100
"""Lines of one report; beyond it they are counted."""


@dataclass
class Report:
    """What `verify` found."""

    planned: int = 0
    samples: int = 0
    """Those that are there."""
    files: int = 0
    """Those whose hash was taken."""
    problems: list[Problem] = field(default_factory=list)
    remade: list[int] = field(default_factory=list)
    """Samples that were simulated again."""
    removed: list[int] = field(default_factory=list)

    @property
    def good(self) -> bool:
        """Whether nothing is wrong or missing."""
        return not self.problems

    @property
    def lines(self) -> list[str]:
        """One line for each problem, the first hundred of them."""
        found = [str(problem) for problem in self.problems[:_NAMED]]
        if len(self.problems) > _NAMED:
            found.append(f"... and {len(self.problems) - _NAMED} more")
        return found

    @property
    def summary(self) -> str:
        """The result in one line."""
        again = f", {len(self.remade)} samples made again bit for bit" if self.remade and self.good else ""
        what = "all good" if self.good else f"{len(self.problems)} problems"
        text = f"{what}: {self.samples} of {self.planned} samples, {self.files} files hashed{again}"
        if self.removed:
            text += f"; {len(self.removed)} samples removed, twin corpus run makes them again"
        return text


def verify(
    directory: str | Path,
    *,
    resimulate: int = 2,
    seed: int = 0,
    workers: int | None = None,
    repair: bool = False,
    progress: Callable[[str, float], None] | None = None,
) -> Report:
    """Check every file of a corpus, and simulate some random samples again into a folder that is thrown away.

    Parameters
    ----------
    resimulate : how many samples to make again, ``seed`` says which.
    workers : processes for them, and threads that hash.
    repair : remove samples with damaged files, so that `twin.run.run` makes them again, and renew the index.

    Raises
    ------
    DesignError
        In one line, if there is no plan.json, or a run has the corpus.
    twin.run.Stopped
        If samples cannot be made again for want of room.
    """
    folder, tell = Path(directory).resolve(), progress or (lambda stage, done: None)
    report = Report()
    if occupied.holder(folder):
        received = f"{shown(str(folder))}, which {occupied.holder(folder)} is running"
        raise DesignError("DIR", received, "a corpus that no run has")
    with ExitStack() as stack:
        if repair:
            stack.enter_context(occupied.locked(folder))
        try:
            plan = load_plan(folder)
        except DesignError as error:
            if not (folder / PLAN).is_file():
                raise
            report.problems.append(Problem(error.source or PLAN, str(error)))
            return report
        report.planned = len(plan)
        _check(folder, plan, report, workers or cores(), tell)
        damaged = {problem.sample for problem in report.problems if problem.sample is not None}
        there = sorted(
            number for number in store.finished(folder) if number < len(plan) and number not in damaged
        )
        chosen = sorted(random.Random(seed).sample(there, min(resimulate, len(there))))
        if chosen:
            tell("samples made again", 0.9)
            report.problems += remade(folder, plan, chosen, workers)
            report.remade = chosen
        if repair:
            report.removed = _repair(folder, plan, report.problems)
    return report


def _check(
    folder: Path, plan: Plan, report: Report, threads: int, tell: Callable[[str, float], None]
) -> None:
    sha256 = store.sha256(folder / PLAN)
    there = index.folders(folder)
    report.problems += check_places(folder, plan)
    shared = Shared(folder)
    try:
        table = index.read(folder, plan, sha256)
    except ValueError as error:
        table = None
        if any(there.values()):
            report.problems.append(Problem(index.FILE, str(error).removeprefix(f"{index.FILE}: ")))
    listed = set() if table is None else set(table["sample"].to_pylist())
    done, unmade = 0, list[int]()
    with ThreadPoolExecutor(threads) as pool:
        for numbers in _portions(len(plan)):
            tell("hashes", 0.9 * done / len(plan))
            present = {number for number in numbers if _there(folder, number)}
            unmade += [number for number in numbers if number not in present and number not in listed]
            looked = [number for number in numbers if number in present or number in listed]
            report.samples += len(present)
            for problems, files in pool.map(partial(check_sample, folder, plan, shared), looked):
                report.problems += problems
                report.files += files
            if table is not None:
                rows, _ = index.table_of(folder, plan, sorted(present), sha256)
                report.problems += check_index(table, rows, numbers, present)
            done += len(numbers)
    if unmade:
        failed = sum(store.failure_file(folder, number).exists() for number in unmade)
        what = f"{len(unmade)} of {len(plan)} are not made, {failed} of them failed; the first is {unmade[0]}"
        report.problems.append(Problem("samples", what))
    report.files += len(shared.known)
    report.problems += shared.problems(complete=report.samples == len(plan))


def _there(folder: Path, number: int) -> bool:
    return store.sample_folder(folder, number).is_dir()


def _portions(count: int) -> Iterator[range]:
    for first in range(0, count, store.PER_FOLDER):
        yield range(first, min(first + store.PER_FOLDER, count))


def _repair(folder: Path, plan: Plan, problems: Iterable[Problem]) -> list[int]:
    """Remove what is damaged and can be made again; return the samples that are gone."""
    gone: set[int] = set()
    for problem in problems:
        if problem.reference is not None:  # made again with a sample that needs it
            for suffix in (".exr", ".png"):
                (folder / "references" / f"{problem.reference}{suffix}").unlink(missing_ok=True)
        if problem.sample is not None and problem.sample not in gone:
            place = store.sample_folder(folder, problem.sample)
            if place.is_symlink():
                place.unlink()
            elif place.exists():
                aside = place.with_name(
                    f".{place.name}.removed.part"
                )  # a run sweeps it, should this be cut off
                place.rename(aside)
                shutil.rmtree(aside, ignore_errors=True)
            else:
                continue
            gone.add(problem.sample)
    index.build(folder, plan, store.sha256(folder / PLAN))
    return sorted(gone)
