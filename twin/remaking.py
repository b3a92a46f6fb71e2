"""Samples of a corpus made again elsewhere, and compared with it bit for bit."""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from scenes import exr
from twin import store
from twin.checking import Problem
from twin.complaint import shown
from twin.frame import versions
from twin.planned import EMULATOR, IES, PLAN, SAMPLES, TRACED

if TYPE_CHECKING:
    from twin.plan import Plan


def remade(folder: Path, plan: Plan, numbers: Sequence[int], workers: int | None) -> list[Problem]:
    """Return where these samples come out other than they lie in the corpus.

    Raises
    ------
    twin.run.Stopped
        If they cannot be made: no room for temporary files.
    """
    from twin.run import run

    with tempfile.TemporaryDirectory(prefix="twin-verify-") as scratch:
        again = Path(scratch)
        for path in folder.iterdir():
            if path.name in (PLAN, SAMPLES, EMULATOR, TRACED) or IES.fullmatch(path.name):
                shutil.copyfile(path, again / path.name)
        run(again, workers, numbers=numbers)
        return [problem for number in numbers for problem in _compared(folder, again, plan, number)]


def _compared(folder: Path, again: Path, plan: Plan, number: int) -> Iterator[Problem]:
    place = store.sample_folder(folder, number)
    name = place.relative_to(folder).as_posix()
    try:
        mine, theirs = store.read_note(again, number), store.read_note(folder, number)
    except exr.ImageError:
        with suppress(OSError, ValueError, KeyError):
            said = json.loads(store.failure_file(again, number).read_text(encoding="utf-8"))["error"]
            yield Problem(name, f"cannot be made again: {said}", number)
            return
        yield Problem(name, "cannot be made again", number)
        return
    for file in sorted(mine.sha256.keys() | theirs.sha256.keys()):
        if mine.sha256.get(file) != theirs.sha256.get(file):
            where = file if file.startswith("references/") else f"{name}/{file}"
            base = Path() if file.startswith("references/") else place.relative_to(folder)
            yield Problem(
                where, f"comes out otherwise{_difference(folder / base / file, again / base / file)}", number
            )


def _difference(old: Path, new: Path) -> str:
    """Return by how much a picture differs, where that can be said, and which versions made it."""
    text = ""
    with suppress(exr.ImageError, ValueError):
        if old.suffix == ".png":
            before, after = (exr.read_png(path).astype(np.int64) for path in (old, new))
            text = f", by up to {np.abs(before - after).max()} counts"
    with suppress(OSError, ValueError, KeyError, TypeError, AttributeError):
        made = json.loads((old.parent / store.SAMPLE).read_text(encoding="utf-8"))["versions"]
        others = [
            f"{name} {shown(made.get(name))}" for name, here in versions().items() if made.get(name) != here
        ]
        text += f" (made with {', '.join(others)[:200]})" if others else ""
    return text
