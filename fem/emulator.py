"""A press without a solve: the whole contact field as a smooth function of specimen and indentation.

An emulator knows one probe. It answers in a few milliseconds for the specimens within its ranges, refuses all
others, and says how far held-out solves were from it. `fem.emulating` builds one, `fem.emulator_file` keeps
it.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy.optimize import brentq

from fem import surface
from fem.emulated import Emulated
from fem.emulator_errors import Errors
from fem.emulator_limits import check, within
from fem.ground import cubic
from fem.lines import lines, lines_of
from fem.mesh import Geometry
from fem.model import Inclusion, Probe, Slab
from fem.regression import Regression
from fem.sampling import CLEARANCE, Plan, contrast
from fem.solving import knots
from fem.symmetry import Image, images, unfold
from fem.topology import Resolution

Floats = NDArray[np.float64]


CENTRED = [0, 1, 4, 5, 6, 7]
"""The inputs that are no offsets: all that the gain from a finer mesh depends on, in the mesh's coordinates;
the last one at finite strain only."""


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
        Background at the knots (i, j) of thickness and tissue, as `specimen.background` gives it; (i, j,
        ...).
    rise, tared
        What the inclusion adds, as `specimen.solve` gives it, over `amplitudes`.
    finer, finer_tared
        What a finer mesh adds to both, as `specimen.refine` gives it, over `amplitudes`.
    rise_more, tared_more, finer_more, finer_tared_more
        What finite strain adds, as `specimen.stretch` gives it, and what the finer mesh adds to that, as
        `specimen.refine_stretch` does, over `amplitudes`; None for a linear one.
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
            signal="smooth" if self.plan.degree else "meshed",
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

    Specimens are worked out all together, and those that are alike once: where slopes are found, most differ
    in their indentations alone, or in what does not bear on the press.
    """
    specimens = list(dict.fromkeys((slab, some) for slab, some, _ in cases if some is not None))
    added = dict(zip(specimens, _signals(emulator, specimens), strict=True))
    plain = {slab: _plain(emulator, slab) for slab in dict.fromkeys(slab for slab, _, _ in cases)}
    return [
        [
            _pressed(
                plain[slab],
                None if inclusion is None else added[slab, inclusion],
                depth,
                lagrange(emulator.plan.levels, depth),
            )
            for depth in depths
        ]
        for slab, inclusion, depths in cases
    ]


def _plain(emulator: Emulator, slab: Slab) -> tuple[Floats, Floats]:
    """Pressure (l, m, m) and displacement (l, m, m, 3) of plain tissue at each level, per mm."""
    at, tissue = knots(emulator.plan), slab.modulus_kPa
    weights = np.multiply.outer(
        lagrange(at[0], 1 / slab.thickness_mm), lagrange(at[1], float(np.log(tissue)))
    )
    pressure, moved = (np.tensordot(weights, values, 2) for values in (emulator.pressure, emulator.moved))
    return np.asarray(tissue * pressure), np.asarray(moved)


def _pressed(
    plain: tuple[Floats, Floats], added: Floats | None, depth: float, level: Floats
) -> dict[str, Floats]:
    """`fields` at one indentation, of plain tissue and what an inclusion adds to it (`_signals`)."""
    pressure_0, displacement_0 = (depth * np.tensordot(level, values, 1) for values in plain)
    pressure, displacement = pressure_0, displacement_0
    if added is not None:
        rise, tared = _at_level(added, level)
        pressure = pressure_0 * (1 + rise)
        displacement = displacement_0 + depth * tared
    found = {}
    for suffix, p, u in (("", pressure, displacement), ("_0", pressure_0, displacement_0)):
        found["displacement" + suffix], found["pressure" + suffix] = u, np.maximum(p, 0.0)
    return found


def _at_level(added: Floats, level: Floats) -> tuple[Floats, Floats]:
    """Rise (m, m) and tared displacement per mm (m, m, 3) of `_signals` at weights (l,) of the levels."""
    whole = added[0] + np.tensordot(level[1 : len(added)], added[1:], 1)
    return whole[0], np.moveaxis(whole[1:], 0, -1)


def signals(
    emulator: Emulator, slab: Slab, inclusion: Inclusion, levels: Sequence[Floats]
) -> list[tuple[Floats, Floats]]:
    """Rise (m, m) and tared displacement per mm (m, m, 3) on the grid, for weights (l,) of levels each."""
    added = _signals(emulator, [(slab, inclusion)])[0]
    return [_at_level(added, level) for level in levels]


def _signals(emulator: Emulator, specimens: Sequence[tuple[Slab, Inclusion]]) -> Floats:
    """What each inclusion adds on the grid, (n, 1, 4, m, m): the rise and the tared displacement per mm along
    x, y, z, at small strain; at finite strain (n, l, 4, m, m): behind it what that adds at each level but 0.
    """
    if not specimens:
        return np.zeros((0, 1, 4, 0, 0))
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
    first = np.unique([number for number, _ in seen], return_index=True)[1]
    own = rows[first]
    centred = inputs[first][:, CENTRED]  # of no image: it is symmetric
    along = np.stack([lagrange(contrast(plan.ratios), float(s)) for s in own[:, -1]])
    onto = [_onto(plan, emulator.x, slab, inclusion) for slab, inclusion in specimens]
    lean, fine, coarse = (
        (np.stack([one[mesh][0] for one in onto]), np.stack([one[mesh][1] for one in onto]))
        for mesh in range(3)
    )

    ratios = len(plan.ratios)
    linear, even = inputs[:, :-1], centred[:, :-1]
    small = _blended(seen, emulator.rise(linear), emulator.tared(linear), ratios)
    gain = _stacked(*_unravelled(emulator.finer(even), emulator.finer_tared(even), ratios))
    small, gain = (np.einsum("nr,nr...->n...", along, one)[:, None] for one in (small, gain))
    parts = [_carried(lean, small) + _carried(fine, gain)]
    if plan.finite:
        assert emulator.rise_more and emulator.tared_more
        assert emulator.finer_more and emulator.finer_tared_more
        levels = len(plan.levels) - 1
        more = _blended(seen, emulator.rise_more(inputs), emulator.tared_more(inputs), levels)
        gains = emulator.finer_more(centred), emulator.finer_tared_more(centred)
        gain = _stacked(*_unravelled(*gains, levels))
        parts.append(_carried(coarse, more) + _carried(fine, gain))
    found = np.concatenate(parts, axis=1)
    rise, tared = amplitudes(own, own[:, -1])
    found[:, :, 0] *= rise[:, None, None, None]
    found[:, :, 1:] *= tared[:, None, None, None, None]
    return found


def _stacked(rise: Floats, tared: Floats) -> Floats:
    """Rise (..., k, k) and displacement (..., k, k, 3) as fields (..., 4, k, k)."""
    return np.concatenate([rise[..., None, :, :], np.moveaxis(tared, -1, -3)], axis=-3)


def _blended(seen: Sequence[tuple[int, Image]], rise: Floats, tared: Floats, cases: int) -> Floats:
    """Fields of each specimen (n, cases, 4, k, k) from those of its images, flat."""
    rise, tared = _unravelled(rise, tared, cases)
    found = np.zeros((seen[-1][0] + 1, cases, 4, *rise.shape[-2:]))
    turns: dict[tuple[float, float], list[int]] = {}
    for row, (_, image) in enumerate(seen):
        turns.setdefault(image.turn, []).append(row)
    for turn, chosen in turns.items():  # no specimen has two images of one turn
        shares = np.array([seen[row][1].share for row in chosen])
        turned = _stacked(*unfold(rise[chosen], tared[chosen], turn))
        found[[seen[row][0] for row in chosen]] += shares[:, None, None, None, None] * turned
    return found


def _unravelled(rise: Floats, tared: Floats, cases: int) -> tuple[Floats, Floats]:
    """Fields of regressions, flat, as (n, cases, k, k) and (n, cases, k, k, 3)."""
    side = round((rise.shape[1] / cases) ** 0.5)
    return rise.reshape(-1, cases, side, side), tared.reshape(-1, cases, side, side, 3)


def _onto(plan: Plan, x: Floats, slab: Slab, inclusion: Inclusion) -> list[tuple[Floats, Floats]]:
    """`resample` from the lean mesh, the fine one, and the one that finite strain was solved on."""
    meshes = [plan.resolution, plan.fine, plan.coarse if plan.finite else plan.resolution]
    geometry = Geometry(plan.probe, slab, inclusion)
    return [(cubic(u, x), cubic(v, x)) for u, v in lines_of(geometry, meshes)]


def _carried(onto: tuple[Floats, Floats], values: Floats) -> Floats:
    """Fields (n, cases, 4, k, k) at the nodes of n specimens' meshes on the grid, by matrices (n, m, k)."""
    left, right = onto
    return np.asarray(left[:, None, None] @ values @ np.swapaxes(right, 1, 2)[:, None, None])


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
