"""What the comparisons with CalculiX share: finding it, running a deck, reading its answer."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Results:
    """One entry per level.

    nodes: the probe's contact nodes that CalculiX has, counted from 0, (n,); displacement: theirs, mm,
    (levels, n, 3); reaction: of the chest wall, mN, (levels, 3); seconds: wall time of the run.
    """

    nodes: Ints
    displacement: Floats
    reaction: Floats
    seconds: float


def run(deck: Path, threads: int = 1, timeout: float = 3600) -> Results:
    """Solve a deck in its own folder."""
    names = ("OMP_NUM_THREADS", "CCX_NPROC_STIFFNESS", "CCX_NPROC_RESULTS", "CCX_NPROC_EQUATION_SOLVER")
    env = os.environ | dict.fromkeys(names, str(threads))
    start = time.perf_counter()
    done = subprocess.run(
        ["ccx", "-i", deck.stem], cwd=deck.parent, env=env, capture_output=True, text=True, timeout=timeout
    )
    seconds = time.perf_counter() - start
    deck.with_suffix(".log").write_text(done.stdout + done.stderr)
    if "Job finished" not in done.stdout:
        said = [line.strip() for line in done.stdout.splitlines() if "*ERROR" in line] or ["no reason given"]
        raise RuntimeError(f"CalculiX did not finish {deck}: {said[0]}")
    return Results(*read(deck.with_suffix(".dat")), seconds)


def read(dat: Path) -> tuple[Ints, Floats, Floats]:
    blocks = re.split(r"^ *(displacements|total force).*\n", dat.read_text(), flags=re.M)
    moved, forces = [], []
    for kind, text in zip(blocks[1::2], blocks[2::2], strict=True):
        table = np.array([line.split() for line in text.splitlines() if line.strip()], dtype=float)
        if kind == "displacements":
            moved.append(table)
        else:
            forces.append(table[0])
    return moved[0][:, 0].astype(int) - 1, np.array([t[:, 1:] for t in moved]), np.array(forces)
