"""`twin replicate` from end to end: the corpus where there is none, the numbers, the files."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

from twin import learned
from twin.complaint import DesignError, shown
from twin.planned import PLAN, load_plan, sha256
from twin.stage import has_keys, staged

CORPUS = "corpus"
"""Folder under OUT that holds the corpus where none was given."""

FILES = ("report.html", "estimates.csv", "errors.csv", "replicate.json")

_FULL, _QUICK = "paper", "paper-quick"
_QUICK_REPEATS = 10


def replicate(
    out: str | Path,
    *,
    corpus: str | Path | None = None,
    quick: bool = False,
    seed: int = 0,
    emulator: str | Path | None = None,
    solve: bool = False,
    workers: int | None = None,
    repeats: int | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> str:
    """Write the replication into a folder and return what a terminal shows.

    Parameters
    ----------
    corpus : a finished corpus; without one the study ``paper`` (or ``paper-quick``) is planned and run in
        OUT/corpus, or gone on with if it is there.
    seed : of the corpus, where it is planned here, and of the networks.
    emulator : file to simulate the corpus by, or the name of a shipped one; default that of `tsis`, but with
        `quick`, which solves at small strain.
    solve : simulate by full solves, not by an emulator.
    repeats : networks per estimate, default 100, or 10 with `quick`.

    Raises
    ------
    DesignError
        In one line. `twin.run.Stopped` where the corpus cannot be made.
    """
    from twin.corpus import Corpus
    from twin.replication import replicate as compute
    from twin.replication_report import told, write

    tell = progress or (lambda stage, done: None)
    target = Path(os.path.abspath(out))
    _check(out, target)
    place = Path(corpus) if corpus is not None else target / CORPUS
    if corpus is None:
        simulate(place, _QUICK if quick else _FULL, seed, emulator, quick or solve, workers, tell)
    opened = Corpus(place)
    found = compute(opened, repeats=repeats or (_QUICK_REPEATS if quick else 100), seed=seed, progress=tell)
    with _into(out, target) as folder:
        tell("report", 0.0)
        write(found, opened, folder)
    return told(found)


def simulate(
    folder: Path,
    study: str,
    seed: int,
    emulator: str | Path | None,
    solve: bool,
    workers: int | None,
    tell: Callable[[str, float], None],
) -> None:
    """Plan the study unless the folder has its plan already, and make what is missing."""
    from twin.plan import freeze
    from twin.run import run

    usual = learned.usual_emulator("tsis")
    file = learned.emulator_file(emulator) if emulator is not None else None
    if file is None and usual.is_file() and not solve:
        file = usual
    if (folder / PLAN).is_file():
        plan = load_plan(folder)
        if (plan.name, plan.head.seed) != (study, seed):
            received = f"the corpus {shown(plan.name)} of seed {plan.head.seed}"
            raise DesignError(
                "out", received, f"{study} of seed {seed}, or another folder", source=str(folder)
            )
        planned = None if plan.head.emulator is None else plan.head.emulator.sha256
        if emulator is not None and (planned is None or file is None or sha256(file) != planned):
            there = "without it" if planned is None else "with another emulator"
            raise DesignError("--emulator", f"a corpus planned {there}", "another folder", source=str(folder))
        if solve and emulator is None and planned is not None:
            raise DesignError(
                "--solve", "a corpus planned with an emulator", "another folder", source=str(folder)
            )
    else:
        plan = freeze(
            study, folder, seed=seed, mechanics="emulator" if file else None, emulator=file, progress=tell
        )
    tell("corpus", 0.0)
    state = run(folder, workers, progress=lambda now: tell("corpus", now.done / max(now.planned, 1)))
    if state.failed:
        raise DesignError(
            "corpus",
            f"{state.failed} samples that failed",
            "none (twin corpus status says why)",
            source=str(folder),
        )


def _check(out: str | Path, target: Path) -> None:
    """Refuse a folder that holds something else than what this writes."""
    allowed = "a new or empty folder, or one that holds an earlier replication and nothing else"
    if target.is_symlink() or (target.exists() and not target.is_dir()):
        raise DesignError("--out", f"{shown(str(out))}, which is not a folder", allowed)
    inside = {entry.name for entry in target.iterdir()} if target.is_dir() else set()
    ours = has_keys(target / FILES[-1], "parameters", "paper")
    if not inside <= {*FILES, CORPUS} or (inside & set(FILES) and not ours):
        raise DesignError("--out", f"{shown(str(out))}, which holds something else", allowed)


@contextmanager
def _into(out: str | Path, target: Path) -> Iterator[Path]:
    """Yield a folder whose files get into the target when the block ends well; the corpus in it stays."""
    if not target.is_dir():
        with staged(out, lambda folder: True) as folder:
            yield folder
        return
    folder = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        folder.mkdir()
        yield folder
        for name in FILES:
            os.replace(folder / name, target / name)
    finally:
        shutil.rmtree(folder, ignore_errors=True)
