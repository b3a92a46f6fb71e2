"""What the comparisons with CalculiX share: running a deck, reading its answer, taring it."""

from __future__ import annotations

import os
import re
import subprocess
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pyvista as pv
from debian_fetch import CCX
from numpy.typing import NDArray

import fem
from fem import ccx, surface
from fem.mesh import QUALITIES, Geometry
from fem.meshed import build
from fem.path import path
from fem.solver import one_thread
from fem.topology import Resolution

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class Results:
    """One entry per step.

    nodes: the probe's contact nodes that CalculiX has, counted from 0, (n,); displacement: theirs, mm,
    (steps, n, 3); reaction: of the chest wall, mN, (steps, 3); seconds: wall time of the run.
    """

    nodes: Ints
    displacement: Floats
    reaction: Floats
    seconds: float


@dataclass(frozen=True)
class Tared:
    """One level: largest tared displacement over the middle of the probe (µm), its integral over the whole
    and up to `inner_mm` from the middle, without the outermost row of cells (mm³), force with and without
    inclusion (N), seconds of both runs. Each is the mean of the last two settling steps; `scatter` is half
    their difference, relative, of maximum, total, force and inner total."""

    max_um: float
    total_mm3: float
    inner_mm3: float
    inner_mm: float
    force_N: float
    force_0_N: float
    scatter: tuple[float, float, float, float]
    seconds: float


def run(deck: Path, timeout: float = 3600) -> Results:
    """Solve a deck in its own folder, in one thread."""
    names = ("OMP_NUM_THREADS", "CCX_NPROC_STIFFNESS", "CCX_NPROC_RESULTS", "CCX_NPROC_EQUATION_SOLVER")
    env = os.environ | dict.fromkeys(names, "1")
    program = CCX.find()
    assert program is not None
    start = time.perf_counter()
    done = subprocess.run(
        [str(program), "-i", deck.stem],
        cwd=deck.parent,
        env=env,
        capture_output=True,
        text=True,
        timeout=timeout,
    )
    seconds = time.perf_counter() - start
    if "Job finished" not in done.stdout:
        said = [line.strip() for line in done.stdout.splitlines() if "*ERROR" in line] or ["no reason given"]
        raise RuntimeError(f"CalculiX did not finish {deck}: {said[0]}")
    return Results(*read(deck.with_suffix(".dat")), seconds)


def read(dat: Path) -> tuple[Ints, Floats, Floats]:
    """Contact nodes, displacements and reactions that a deck of `fem.ccx` prints."""
    blocks = re.split(r"^ *(displacements|total force).*\n", dat.read_text(), flags=re.M)
    moved, forces = [], []
    for kind, text in zip(blocks[1::2], blocks[2::2], strict=True):
        table = np.array([line.split() for line in text.splitlines() if line.strip()], dtype=float)
        if kind == "displacements":
            moved.append(table)
        else:
            forces.append(table[0])
    return moved[0][:, 0].astype(int) - 1, np.array([t[:, 1:] for t in moved]), np.array(forces)


def press(
    folder: Path, geometry: Geometry, levels: list[float], mechanics: ccx.Mechanics, res: Resolution | str
) -> list[Tared]:
    """Tared answers of CalculiX on the mesh of a resolution, or of a quality by name."""
    model = ccx.bodies(geometry, QUALITIES[res] if isinstance(res, str) else res)
    both = []
    for name, body in (("with", model), ("without", model.without_inclusion())):
        both.append(run(ccx.write(folder / f"{name}.inp", body, levels, mechanics)))
    return _compared(geometry, model, both, levels, mechanics)


def press_slid(folder: Path, geometry: Geometry, level: float, res: Resolution) -> Tared:
    """The same at one level of finite strain, on the slab's mesh as it has slid in our answer.

    CalculiX's nodes stay with the tissue, so that those that begin at the probe's edge end beside it, and the
    kink of the face there within an element, which cannot bend so: totals come out 3 to 8 % low, on smaller
    elements, too. On a mesh that begins as much further in, they end under the edge.
    """
    start = ccx.bodies(geometry, res)
    with one_thread():
        model = build(geometry, res, True)
        bare = path(geometry, model, False)
        places = [p.to(level).model.place - model.place for p in (path(geometry, model, True, bare), bare)]
    both = []
    for name, body, slid in zip(("with", "without"), (start, start.without_inclusion()), places, strict=True):
        deck = ccx.write(folder / f"{name}.inp", replace(body, place=body.place + slid), [level])
        both.append(run(deck))
    return _compared(geometry, start, both, [level], "finite")[0]


def _compared(
    geometry: Geometry, model: ccx.Bodies, both: list[Results], levels: list[float], mechanics: ccx.Mechanics
) -> list[Tared]:
    """What a press with and one without inclusion say, at each level."""
    every = 1 if mechanics == "linear" else 1 + ccx.SETTLE
    grids = [_grid(model, r) for r in both]
    share = 2 ** sum(_symmetric(geometry))
    found = []
    for step in range(every - 1, every * len(levels), every):
        last = (step,) if every == 1 else (step - 1, step)
        faces = [_surface(geometry, model, *(g[s] for g in grids)) for s in last]
        scalars = [[tared(face, m) for m in (True, False)] for face in faces]
        inner_mm = float(np.unique(np.round(faces[0].points[:, 0], 6))[-3])  # nodes in the middles of sides
        force, force_0 = (1e-3 * share * -(r.reaction[list(last)] @ model.normal) for r in both)
        steps = np.array(
            [
                [1e3 * middle["max_mm"] for middle, _ in scalars],
                [whole["total_mm3"] for _, whole in scalars],
                force,
                [total_within(face, inner_mm) for face in faces],
            ]
        )
        top, total, pushed, inner = steps.mean(axis=1)
        scatter = np.ptp(steps, axis=1) / 2 / np.abs(steps.mean(axis=1))
        seconds = sum(r.seconds for r in both)
        found.append(
            Tared(top, total, inner, inner_mm, pushed, float(force_0.mean()), tuple(scatter), seconds)
        )
    return found


def tared(contact: pv.PolyData, middle: bool) -> dict[str, float]:
    """Scalars of the tared displacement, everywhere or where the probe's edges, which are singular, are more
    than a fifth of the width away."""
    found = contact.copy()
    if middle:
        x, y = found.points[:, 0], found.points[:, 1]
        away = np.maximum(np.abs(x), np.abs(y)) > 0.3 * np.ptp(x)
        moved = np.array(found["displacement"])
        moved[away] = found["displacement_0"][away]
        found["displacement"] = moved
    return fem.scalars(found, 2.0)["tared"]


def total_within(contact: pv.PolyData, half_mm: float) -> float:
    """Integral of the tared displacement up to so far from the middle in x and y, mm³.

    Exact for quadratic cells. A spline through their nodes would carry swings of the outermost ones inwards:
    by 4 % of the total, where CalculiX's corners fold.
    """
    tared = np.asarray(contact["displacement_0"])[:, 2] - np.asarray(contact["displacement"])[:, 2]
    x, y = (np.unique(np.round(contact.points[:, k], 6)) for k in (0, 1))
    order = np.lexsort((np.round(contact.points[:, 1], 6), np.round(contact.points[:, 0], 6)))
    return float(_weights(x, half_mm) @ tared[order].reshape(len(x), len(y)) @ _weights(y, half_mm))


def _weights(at: Floats, half: float) -> Floats:
    """Of the nodes of quadratic cells in a line, two apart each, in the integral from -half to half."""
    weights = np.zeros(len(at))
    for i in range(0, len(at) - 2, 2):
        nodes = at[i : i + 3]
        ends = np.clip(nodes[[0, 2]], -half, half)
        powers = np.array([np.diff(ends ** (k + 1))[0] / (k + 1) for k in range(3)])
        weights[i : i + 3] += np.linalg.solve(np.vander(nodes, increasing=True).T, powers)
    return weights


def _symmetric(geometry: Geometry) -> tuple[bool, bool]:
    return geometry.layout(QUALITIES["preview"]).symmetric


def _grid(model: ccx.Bodies, results: Results) -> Floats:
    """Displacements on the Q2 grid of the contact surface, (steps, nx, ny, 3) mm; the middles of faces, which
    CalculiX has not, by the serendipity shape functions."""
    whole = np.full((len(results.displacement), len(model.place), 3), np.nan)
    whole[:, results.nodes] = results.displacement
    rows = len(np.unique(np.round(model.place[model.tip, 0], 6)))
    g = whole[:, model.tip].reshape(len(whole), rows, -1, 3)
    corners = g[:, :-2:2, :-2:2] + g[:, 2::2, :-2:2] + g[:, :-2:2, 2::2] + g[:, 2::2, 2::2]
    sides = g[:, 1::2, :-2:2] + g[:, 1::2, 2::2] + g[:, :-2:2, 1::2] + g[:, 2::2, 1::2]
    g[:, 1::2, 1::2] = sides / 2 - corners / 4
    return g


def _surface(geometry: Geometry, model: ccx.Bodies, moved: Floats, moved_0: Floats) -> pv.PolyData:
    half, at = _symmetric(geometry), model.place[model.tip].reshape(moved.shape)
    lines = (surface.mirror_line(at[:, 0, 0], half[0]), surface.mirror_line(at[0, :, 1], half[1]))
    contact = surface.contact_surface(*lines)
    for name, field in (("displacement", moved), ("displacement_0", moved_0)):
        z = surface.mirror_grid(field[..., 2], symmetric=half).ravel()
        contact.point_data[name] = np.stack([0 * z, 0 * z, z], axis=1)
    return contact
