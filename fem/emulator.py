"""A press without a solve: the whole contact field as a smooth function of specimen and indentation.

An emulator knows one probe. It answers in a few milliseconds for the specimens within its ranges, refuses all
others, and says how far held-out solves were from it. `fem.emulating` builds one, `fem.emulator_file` keeps
it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy.optimize import brentq

from fem import surface
from fem.emulator_errors import Errors
from fem.emulator_limits import check, within
from fem.ground import cubic
from fem.mesh import Geometry
from fem.model import Inclusion, Probe, Slab
from fem.regression import Regression
from fem.sampling import CLEARANCE, Plan, contrast, lines
from fem.solving import knots
from fem.symmetry import Image, images, unfold
from fem.topology import Resolution

Floats = NDArray[np.float64]


CENTRED = [0, 1, 4, 5, 6, 7]
"""The inputs that are no offsets: all that the gain from a finer mesh depends on, in the mesh's coordinates;
the last one at finite strain only."""


@dataclass(frozen=True)
class Emulated:
    """Answer of an emulator; fields as those of `fem.Press`, which it can stand in for where no cut is drawn.

    Attributes
    ----------
    surface
        The contact surface with `displacement`, `pressure`, `area` and, without inclusion, `displacement_0`,
        `pressure_0`, `area_0`.
    error_percent
        95th percentile of what held-out solves of inclusions of this kind (`Errors.alike`: of 4 mm and more,
        or not; or nearest in size) were off by: largest error of the tared displacement off the probe's
        edge, in per cent of its maximum. None where too few were held out to tell.
    dof
        Unknowns of plain tissue, where spheres in it are multipoles (`fem.Multipoles`, whose answers these
        are, too).
    """

    surface: pv.PolyData
    indentation_mm: float
    indentation_0_mm: float
    force_N: float
    force_0_N: float
    min_pressure_kPa: float
    seconds: float
    mechanics: str
    error_percent: float | None
    path: str = "emulated"
    background: str = "shared"
    dof: int | None = None


@dataclass(frozen=True)
class Emulator:
    """The contact field of one probe.

    Attributes
    ----------
    plan
        What was learned, and from which solves.
    x
        Lines of the answers' grid along x and y, (m,) mm.
    pressure, moved
        Background at the knots (i, j) of thickness and tissue, as `sampling.background` gives it; (i, j,
        ...).
    rise, tared
        What the inclusion adds, as `sampling.solve` gives it, over `amplitudes`.
    finer, finer_tared
        What a finer mesh adds to both, as `sampling.refine` gives it, over `amplitudes`.
    rise_more, tared_more, finer_more, finer_tared_more
        What finite strain adds, as `sampling.stretch` gives it, and what the finer mesh adds to that, as
        `sampling.refine_stretch` does, over `amplitudes`; None for a linear one.
    errors
        From cross-validation.
    """

    plan: Plan
    x: Floats
    pressure: Floats
    moved: Floats
    rise: Regression
    tared: Regression
    finer: Regression
    finer_tared: Regression
    rise_more: Regression | None
    tared_more: Regression | None
    finer_more: Regression | None
    finer_tared_more: Regression | None
    errors: Errors

    def __call__(
        self,
        probe: Probe,
        slab: Slab,
        inclusion: Inclusion | None,
        indentation: float | None = None,
        *,
        force: float | None = None,
        mechanics: str | None = None,
        tilt: tuple[float, float] = (0.0, 0.0),
        position: tuple[float, float] = (0.0, 0.0),
    ) -> Emulated:
        """Press; parameters as of `fem.press`.

        Raises
        ------
        ValueError
            Outside of the emulator's ranges, in one line: field, what was received, what is allowed.
        NotModelled
            For what it was not built for.
        """
        start = time.perf_counter()
        if (indentation is None) == (force is None):
            raise ValueError(
                f"indentation, force: received {indentation} and {force}; allowed exactly one of the two"
            )
        check(self.plan, probe, slab, inclusion, mechanics or self.plan.mechanics, tilt, position)
        depths = [self._depth(slab, some, indentation, force) for some in (inclusion, None)]
        found = fields(self, slab, inclusion, depths[0])
        if depths[1] != depths[0]:
            found = {
                **found,
                **{k: v for k, v in fields(self, slab, None, depths[1]).items() if k.endswith("_0")},
            }
        contact = _grid(tuple(self.x)).copy(deep=True)
        for name, values in found.items():
            contact.point_data[name] = values.reshape(-1, 3) if values.ndim == 3 else values.ravel()
        size = 4.0 if inclusion is None else inclusion.size
        return Emulated(
            contact,
            depths[0],
            depths[1],
            1e-3 * float((found["pressure"] * found["area"]).sum()),
            1e-3 * float((found["pressure_0"] * found["area_0"]).sum()),
            float(min(found["pressure"].min(), found["pressure_0"].min())),
            time.perf_counter() - start,
            self.plan.mechanics,
            self.errors.percentile("displacement", 95, size) if inclusion else 0.0,
        )

    def _depth(
        self, slab: Slab, inclusion: Inclusion | None, indentation: float | None, force: float | None
    ) -> float:
        """The indentation asked for, or the one that takes the force, mm."""
        low, high = self.plan.ranges.indentation_mm
        if indentation is not None:
            within("indentation", indentation, (low, high), "mm")
            return float(indentation)
        assert force is not None

        def push(depth: float) -> float:
            found = fields(self, slab, inclusion, depth)
            return 1e-3 * float((found["pressure"] * found["area"]).sum())

        ends = push(low), push(high)
        within("force", force, ends, "N")
        if self.plan.mechanics == "linear":
            return force / ends[1] * high
        return float(brentq(lambda depth: push(depth) - force, low, high, xtol=1e-9))


def fields(emulator: Emulator, slab: Slab, inclusion: Inclusion | None, depth: float) -> dict[str, Floats]:
    """The fields of `Emulated.surface` on the grid, (m, m) and (m, m, 3), at an indentation in mm."""
    found = fields_of(emulator, [(slab, inclusion, (depth,))])[0][0]
    x, still = emulator.x, np.zeros_like(found["displacement"])
    areas = {
        f"area{suffix}": surface.areas(
            x, x, found["displacement" + suffix] if emulator.plan.finite else still
        )
        for suffix in ("", "_0")
    }
    return {**found, **areas}


def fields_of(
    emulator: Emulator, cases: Sequence[tuple[Slab, Inclusion | None, Sequence[float]]]
) -> list[list[dict[str, Floats]]]:
    """`fields` but for the areas, of many specimens at several indentations each, in mm.

    Regressions are worked out for all together, a specimen's share of its presses once.
    """
    there = [(slab, inclusion) for slab, inclusion, _ in cases if inclusion is not None]
    learned = iter(_learned(emulator, there))
    found = []
    for slab, inclusion, depths in cases:
        levels = [lagrange(emulator.plan.levels, depth) for depth in depths]
        added: Sequence[tuple[Floats, Floats] | None] = [None for _ in levels]
        if inclusion is not None:
            added = signals(emulator, slab, inclusion, levels, next(learned))
        found.append(
            [
                _pressed(emulator, slab, depth, level, more)
                for depth, level, more in zip(depths, levels, added, strict=True)
            ]
        )
    return found


def _pressed(
    emulator: Emulator, slab: Slab, depth: float, level: Floats, added: tuple[Floats, Floats] | None
) -> dict[str, Floats]:
    """`fields` at one indentation, with what the inclusion adds to it."""
    tissue = slab.modulus_kPa
    at = knots(emulator.plan)
    weights = np.multiply.outer(
        lagrange(at[0], 1 / slab.thickness_mm), lagrange(at[1], float(np.log(tissue)))
    )

    def background(values: Floats, level: Floats) -> Floats:
        return np.asarray(np.tensordot(np.multiply.outer(weights, level), values, 3))

    pressure_0 = depth * tissue * background(emulator.pressure, level)
    displacement_0 = depth * background(emulator.moved, level)
    pressure, displacement = pressure_0, displacement_0
    if added is not None:
        rise, tared = added
        pressure = pressure_0 * (1 + rise)
        displacement = displacement_0 + depth * tared
    found = {}
    for suffix, p, u in (("", pressure, displacement), ("_0", pressure_0, displacement_0)):
        found["displacement" + suffix], found["pressure" + suffix] = u, np.maximum(p, 0.0)
    return found


@dataclass(frozen=True)
class _Learned:
    """What the regressions say of a specimen, flat fields on a mesh: rise, tared displacement and what a
    finer mesh adds to each, for each ratio of moduli; and what finite strain adds, for each level."""

    point: Floats
    first: tuple[Floats, Floats, Floats, Floats]
    more: tuple[Floats, Floats, Floats, Floats] | None


def _learned(emulator: Emulator, specimens: Sequence[tuple[Slab, Inclusion]]) -> list[_Learned]:
    """Work the regressions out for all specimens at once."""
    if not specimens:
        return []
    plan, seen, points = emulator.plan, [], []
    for number, (slab, inclusion) in enumerate(specimens):
        s = float(contrast(np.array(inclusion.modulus / slab.modulus_kPa)))
        for image in images(inclusion.offset, plan.ranges.offset_mm):
            seen.append((number, image))
            points.append(
                [inclusion.size, inclusion.depth, *image.offset, slab.thickness_mm, slab.modulus_kPa, s]
            )
    rows = np.array(points)
    inputs = features(plan, rows)
    linear = inputs[:, :-1]
    first = np.unique([number for number, _ in seen], return_index=True)[1]
    centred = inputs[first][:, CENTRED]  # of no image: it is symmetric
    ratios, levels = len(plan.ratios), len(plan.levels) - 1
    small = _blended(seen, emulator.rise(linear), emulator.tared(linear), ratios)
    gains = emulator.finer, emulator.finer_tared
    finer = [gain(centred[:, :-1]).reshape(len(first), ratios, -1) for gain in gains]
    found = [
        _Learned(point, (*two, *gain), None)
        for point, two, *gain in zip(rows[first], small, *finer, strict=True)
    ]
    if not emulator.plan.finite:
        return found
    assert emulator.rise_more and emulator.tared_more and emulator.finer_more and emulator.finer_tared_more
    more = _blended(seen, emulator.rise_more(inputs), emulator.tared_more(inputs), levels)
    gains = emulator.finer_more, emulator.finer_tared_more
    finer = [gain(centred).reshape(len(first), levels, -1) for gain in gains]
    return [replace(one, more=(*two, *gain)) for one, two, *gain in zip(found, more, *finer, strict=True)]


def _blended(
    seen: Sequence[tuple[int, Image]], rise: Floats, tared: Floats, cases: int
) -> list[tuple[Floats, Floats]]:
    """Rise and tared displacement of each specimen (cases, ...) from those of its images, (n, ...)."""
    side = round((rise.shape[1] / cases) ** 0.5)
    found: dict[int, list[Floats | float]] = {}
    for (number, image), one, other in zip(seen, rise, tared, strict=True):
        parts = unfold(one.reshape(cases, side, side), other.reshape(cases, side, side, 3), image.turn)
        total = found.setdefault(number, [0.0, 0.0])
        total[:] = [before + image.share * part for before, part in zip(total, parts, strict=True)]
    return [(np.reshape(r, (cases, -1)), np.reshape(t, (cases, -1))) for r, t in found.values()]


def signals(
    emulator: Emulator,
    slab: Slab,
    inclusion: Inclusion,
    levels: Sequence[Floats],
    learned: _Learned | None = None,
) -> list[tuple[Floats, Floats]]:
    """Rise (m, m) and tared displacement per mm (m, m, 3) on the grid, for weights (l,) of levels each."""
    learned = learned or _learned(emulator, [(slab, inclusion)])[0]
    plan, s = emulator.plan, float(learned.point[-1])
    geometry = Geometry(plan.probe, slab, inclusion)
    along = lagrange(contrast(plan.ratios), s)
    lean, fine = (resample(geometry, res, emulator.x) for res in (plan.resolution, plan.fine))
    coarse = lean if learned.more is None else resample(geometry, plan.coarse, emulator.x)
    first = _on_grid(lean, fine, *(along @ part for part in learned.first))
    scales, found = amplitudes(learned.point, s), []
    for level in levels:
        parts = [first]
        if learned.more is not None:
            parts.append(_on_grid(coarse, fine, *(level[1:] @ part for part in learned.more)))
        whole = (sum(part) for part in zip(*parts, strict=True))
        rise, tared = (scale * part for scale, part in zip(scales, whole, strict=True))
        found.append((rise, tared))
    return found


def _on_grid(
    onto: tuple[Floats, Floats],
    fine: tuple[Floats, Floats],
    rise: Floats,
    tared: Floats,
    finer: Floats,
    finer_tared: Floats,
) -> tuple[Floats, Floats]:
    """Carry fields from a mesh's nodes, flat, to the grid, (m, m) and (m, m, 3), and what a finer mesh adds
    to each from its nodes; see `resample`."""
    moved = [
        _carried(onto, less) + _carried(fine, more)
        for less, more in zip(tared.reshape(-1, 3).T, finer_tared.reshape(-1, 3).T, strict=True)
    ]
    return _carried(onto, rise) + _carried(fine, finer), np.stack(moved, axis=-1)


def _carried(onto: tuple[Floats, Floats], values: Floats) -> Floats:
    return np.asarray(onto[0] @ values.reshape(onto[0].shape[1], -1) @ onto[1].T)


def amplitudes(points: Floats, s: Floats | float) -> tuple[Floats, Floats]:
    """What the rise and the tared displacement per mm are divided by: s d³ / z², a sphere's far field with
    z its centre's depth, times one length; the latter also times the tissue's modulus over its thickness,
    the pressure that a millimetre of indentation makes."""
    size, depth, thickness, tissue = (points[..., k] for k in (0, 1, 4, 5))
    rise = np.asarray(s * size**3 / (depth + size / 2) ** 2)
    return rise, rise * tissue / thickness


def features(plan: Plan, points: Floats) -> Floats:
    """Inputs of the regressions (n, 8), each about -1 to 1: size, depth of the centre, offsets, thickness,
    tissue, nearness of the chest wall, and s, which only what finite strain adds depends on; points (n, 7) as
    of `Plan.points`."""
    r = plan.ranges
    size, depth, x, y, thickness, tissue, s = points.T
    middle = (r.depth_mm[0] + r.size_mm[0] / 2, r.depth_mm[1] + r.size_mm[1] / 2)

    def even(values: Floats, ends: tuple[float, float]) -> Floats:
        low, high = np.log(ends)
        return np.asarray((2 * np.log(values) - low - high) / (high - low))

    columns = [even(size, r.size_mm), even(depth + size / 2, middle)]
    columns += [2 * offset / max(r.offset_mm, 1e-9) - 1 for offset in (x, y)]
    columns += [even(thickness, r.thickness_mm), even(tissue, r.tissue_kPa)]
    columns.append(1.5 * np.log(2 * CLEARANCE / (thickness - size - depth)))
    columns.append((2 * s - sum(plan.signals)) / (plan.signals[1] - plan.signals[0]))
    return np.stack(columns, axis=1)


def resample(geometry: Geometry, res: Resolution, x: Floats) -> tuple[Floats, Floats]:
    """Matrices (m, n) that carry a field from a mesh's nodes to the grid, along x and along y."""
    along = lines(geometry, res)
    return cubic(along[0], x), cubic(along[1], x)


def lagrange(nodes: Floats, at: float) -> Floats:
    """Weights (n,) of the polynomial through n nodes."""
    apart = nodes[:, None] - nodes + np.eye(len(nodes))
    shares = np.where(np.eye(len(nodes), dtype=bool), 1.0, (at - nodes) / apart)
    return np.asarray(shares.prod(axis=1))


@lru_cache(maxsize=4)
def _grid(x: tuple[float, ...]) -> pv.PolyData:
    return surface.contact_surface(np.array(x), np.array(x))
