"""The solves that an emulator learns from: which ones, and what is kept of each.

Everything scales with the tissue's modulus, so the inclusion's enters as the contrast c with it. A sphere's
signal goes as s = (c - 1) / (c + 1.5) (Eshelby 1957; [eshelby1957]); what is left of c after that is a
polynomial in s through few nodes, and all of them share one factor at small strain.

Finite strain costs many times more, and adds some per cent to the signal that depend little on the mesh: it
is learned apart, as the difference that it makes on a coarse mesh, from fewer specimens with one modulus
each. All press levels lie on one way down; between them and small strain, which is level 0, the answers per
mm are a polynomial in the indentation.

What a mesh of standard quality adds to either is smoother still, and learned from a few centred specimens.

Meshes that follow the inclusion leave ripples in what it adds: a per cent or two of it, which change with its
size and depth, and tell these from its modulus better than the press itself does. So small strain is told by
multipoles in plain tissue, whose mesh stays, wherever these reach (`fem.spheres`); and since finite strain
makes of the mesh's error what it makes of the signal, so many times the error at small strain is taken from
what finite strain adds (a control variate).

Contact pressures are kept as their *rise* over the tissue without inclusion, on the same mesh and at the same
level: next to the probe's edge both follow the same singularity, and so does their discretisation error. In
the rise both cancel.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import count, islice
from typing import Annotated, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import ConfigDict, Field, TypeAdapter
from pydantic.dataclasses import dataclass
from scipy.stats import qmc

from fem import mesh
from fem.ground import bare_geometry, cubic, ground
from fem.ground import lines as grid_lines
from fem.lines import lines, logical_lines
from fem.mesh import Geometry
from fem.meshed import build
from fem.model import Inclusion, Length, Poisson, Probe, Slab, check
from fem.path import path
from fem.ripples import DEGREE, expanded, without_ripples
from fem.solver import one_thread
from fem.spheres import refuse
from fem.tared import tared, tared_at_rest
from fem.topology import Resolution
from fem.wrinkles import refuse_wrinkles

Floats = NDArray[np.float64]
Some = TypeVar("Some", float, Floats)

_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
_BEYOND = 0.03  # by how much of a range the samples reach beyond it: at the ends, regression is worst
_OFFSETS = (1, 1), (0, 0), (1, 0), (0, 0)  # which of its offsets each point of four keeps
CLEARANCE = 4.0
"""Least distance between inclusion and chest wall, mm."""
_RAREST = 4096  # of so many specimens drawn one fits at least, or there are none to be had

LEAN = Resolution(arc=3, core=1, shell=3, above=3, below=1, edge=2, side=3, layer=1, backing=1)
"""Mesh of the samples. Its rise differs from 115 thousand unknowns in a quarter by what
`tests/bench/test_emulator.py` measures."""

COARSE = Resolution(
    arc=2, core=1, shell=2, above=2, below=1, edge=2, side=2, layer=1, backing=1, growth=(2.0, 1.6)
)
"""Mesh of what finite strain adds."""

STORED = Resolution(arc=5, core=2, shell=5, above=1, below=1, edge=3, side=1, layer=1, backing=1)
"""Nodes on the contact surface that multipoles are kept at; nothing is solved on it."""

FINE = mesh.QUALITIES["standard"]
"""Mesh of what makes up for the lean and the coarse one, and what the background goes with
(`fem.ground.fine`)."""


class NotBuilt(ValueError):
    """An emulator that cannot be built from what there is: one line says why."""


def contrast(ratio: Floats) -> Floats:
    """Signal s = (c - 1) / (c + 1.5) of a modulus c times the tissue's."""
    return np.asarray((ratio - 1) / (ratio + 1.5))


Positive = Annotated[float, Field(gt=0, le=1e7)]
Pair = tuple[Positive, Positive]


@dataclass(frozen=True, config=_CONFIG)
class Ranges:
    """What an emulator answers for: (lowest, highest)."""

    size_mm: Pair = (2.0, 13.0)
    depth_mm: Pair = (4.0, 12.0)  # to the top
    modulus_kPa: Pair = (20.0, 120.0)
    offset_mm: Annotated[float, Field(ge=0, le=500, description="largest offset along x and y")] = 6.0
    indentation_mm: Pair = (0.1, 6.0)
    tissue_kPa: Pair = (3.0, 8.0)
    thickness_mm: Pair = (24.0, 40.0)

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, tuple) and not value[0] < value[1]:
                raise ValueError(
                    f"ranges.{name}: received {value}; allowed is a lowest below a highest value"
                )
        if self.modulus_kPa[0] <= self.tissue_kPa[1]:
            raise ValueError(
                f"ranges.modulus_kPa: received {self.modulus_kPa[0]:g} as the lowest; "
                f"allowed above the stiffest tissue, {self.tissue_kPa[1]:g}"
            )


@dataclass(frozen=True, config=_CONFIG)
class Plan:
    """Which sensor and which specimens to learn, and from what kind of solves."""

    probe: Probe
    width_mm: Length  # of the slab
    poisson: Poisson = 0.49  # of the tissue
    sides: Literal["free", "symmetric"] = "free"
    inner_poisson: Poisson = 0.49  # of the inclusion
    ranges: Ranges = Ranges()
    mechanics: Literal["linear", "finite"] = "linear"
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    resolution: Resolution = LEAN
    fine: Resolution = FINE
    coarse: Resolution = COARSE
    degree: Annotated[int, Field(ge=0, le=12)] = 0  # of the multipoles of small strain; 0: it is meshed

    def __post_init__(self) -> None:
        if self.probe.dome_radius_mm is not None:
            raise ValueError(
                f"probe.dome_radius_mm: received {self.probe.dome_radius_mm:g}; "
                "allowed is none: the emulator learns flat probes only"
            )

        for name, res in (("resolution", self.resolution), ("fine", self.fine), ("coarse", self.coarse)):
            cells = [number for part, number in vars(res).items() if part != "growth"]
            if not all(1 <= number <= 32 for number in cells):
                raise ValueError(f"{name}: received {res}; allowed are 1 to 32 cells along each part")
            if not all(0.2 <= ratio <= 5 for ratio in res.growth):
                raise ValueError(f"{name}: received {res}; allowed are cells that grow 0.2 to 5 times")

        r = self.ranges
        if clearance(r.size_mm[0], r.depth_mm[0], r.thickness_mm[1]) < 0:
            least = CLEARANCE + r.size_mm[0] + r.depth_mm[0]
            raise ValueError(
                f"ranges.thickness_mm: received up to {r.thickness_mm[1]:g} mm; allowed well over {least:g} "
                f"mm, so that inclusions of these ranges keep {CLEARANCE:g} mm from the chest wall"
            )

    def slab(self, thickness: float, modulus: float) -> Slab:
        return Slab(thickness, self.width_mm, modulus, self.poisson, self.sides)

    @property
    def finite(self) -> bool:
        return self.mechanics == "finite"

    @property
    def levels(self) -> Floats:
        """Indentations between which the answers per mm are a polynomial, mm; 0 is small strain, which needs
        no other."""
        return self.ranges.indentation_mm[1] * np.arange(4.0) / 3 if self.finite else np.zeros(1)

    @property
    def ratios(self) -> Floats:
        """Moduli of the inclusion over the tissue's, evenly spaced in s."""
        s = np.linspace(*self.signals, 3)
        return np.asarray((1 + 1.5 * s) / (1 - s))

    @property
    def signals(self) -> tuple[float, float]:
        """Lowest and highest s of the ranges."""
        soft, stiff = self.ranges.tissue_kPa
        return (
            float(contrast(np.array(self.ranges.modulus_kPa[0] / stiff))),
            float(contrast(np.array(self.ranges.modulus_kPa[1] / soft))),
        )

    def points(self) -> Iterator[Floats]:
        """Scrambled Sobol sequence of (size, depth, offsets x >= y >= 0, thickness, tissue, s), those that
        fit; s is that of the inclusion where one modulus is solved. Of four points one keeps its offsets, one
        keeps x, and two lie under the probe's middle: symmetry makes these two and five times cheaper.

        Raises `NotBuilt` where hardly any specimen of the ranges fits.
        """
        r = self.ranges
        low, high = (
            np.array(side) for side in zip(r.size_mm, r.depth_mm, r.thickness_mm, r.tissue_kPa, strict=True)
        )
        beyond = _BEYOND * (high - low)
        sobol = qmc.Sobol(7, scramble=True, rng=np.random.default_rng(self.seed))
        number = 0
        for drawn in count(0, 64):
            if drawn > _RAREST * (number + 4):
                raise NotBuilt(
                    f"ranges: received {r}, of which hardly a specimen fits; allowed are inclusions that "
                    f"keep {CLEARANCE:g} mm from the chest wall and stay within {self.width_mm:g} mm of width"
                )
            drawings = sobol.random(64)
            specimens = low - beyond + drawings[:, :4] * (high - low + 2 * beyond)
            offsets = np.sort(drawings[:, 4:6])[:, ::-1] * r.offset_mm * (1 + _BEYOND)
            fit = clearance(*specimens[:, :3].T) >= 0
            fit &= offsets[:, 0] + specimens[:, 0] / 2 < self.width_mm / 2
            for u, specimen, (x, y) in zip(drawings[fit], specimens[fit], offsets[fit], strict=True):
                size, depth, thickness, tissue = specimen
                s = self.signals[0] + u[6] * (self.signals[1] - self.signals[0])
                keep_x, keep_y = _OFFSETS[number % len(_OFFSETS)]
                yield np.array([size, depth, keep_x * x, keep_y * y, thickness, tissue, s])
                number += 1

    def inside(self, points: Floats) -> NDArray[np.bool_]:
        """Which of the points (n, 7) lie within the ranges, (n,)."""
        r = self.ranges
        pairs = (r.size_mm, r.depth_mm, (0.0, r.offset_mm), (0.0, r.offset_mm), r.thickness_mm, r.tissue_kPa)
        low, high = np.array(pairs).T
        specimen = points[:, :6]
        return np.asarray(((specimen >= low) & (specimen <= high)).all(axis=1))

    def by_multipoles(self) -> Plan:
        """The plan with small strain by multipoles, if all its specimens are within reach, or itself."""
        r, beyond = self.ranges, 1 + _BEYOND
        size, depth = r.size_mm[1] * beyond, r.depth_mm[0] - _BEYOND * (r.depth_mm[1] - r.depth_mm[0])
        worst = Inclusion(size, depth, r.modulus_kPa[1], (r.offset_mm * beyond, 0.0))
        slab = self.slab(r.thickness_mm[1] + size, r.tissue_kPa[0])
        try:
            refuse(self.probe, slab, worst)
        except ValueError:
            return self
        return replace(self, degree=DEGREE, resolution=STORED)

    def point(self, number: int) -> Floats:
        return next(islice(self.points(), number, None))


PLAN: TypeAdapter[Plan] = TypeAdapter(Plan)


def clearance(size: Some, depth: Some, thickness: Some) -> Some:
    """Room left between an inclusion and the chest wall, less what an emulator wants there, mm."""
    return thickness - CLEARANCE - size - depth


def geometry_at(plan: Plan, point: Floats, modulus: float) -> Geometry:
    """Geometry of a point of the plan, with an inclusion of a modulus, kPa."""
    size, depth, x, y, thickness, tissue = (float(v) for v in point[:6])
    slab = plan.slab(thickness, tissue)
    inclusion = Inclusion(size, depth, modulus, (x, y), plan.inner_poisson)
    check(plan.probe, slab, inclusion)
    return Geometry(plan.probe, slab, inclusion)


def solve(plan: Plan, point: Floats) -> dict[str, Floats]:
    """Solve one point for all moduli at small strain.

    Returns
    -------
    `rise` (moduli, n, n): pressure over the same without inclusion, in units of the latter; `moved` (moduli,
    n, n, 3): tared displacement per mm of indentation.
    """
    if plan.degree:
        return _expanded(plan, point, plan.ratios, plan.resolution)
    geometries = [geometry_at(plan, point, float(r * point[5])) for r in plan.ratios]
    with one_thread():
        model = build(geometries[0], plan.resolution, False)
        bare = path(geometries[0], model, False)
        found = [tared_at_rest(g, path(g, model, True, bare), bare) for g in geometries]
    return {name: np.stack([f[k] for f in found]) for k, name in enumerate(("rise", "moved"))}


def refine(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What the finer mesh adds under the probe's middle, where symmetry makes it cheap.

    Returns
    -------
    `rise` (moduli, k, k) and `moved` (moduli, k, k, 3) as of `solve`, at the fine mesh's nodes, less what is
    carried there from the lean one's: what cubic splines through so few nodes are off by, three times what
    the solves are, is in it.
    """
    point = _centred(point)
    if plan.degree:  # these are fine as they are
        n = len(logical_lines(plan.fine))
        return {"rise": np.zeros((len(plan.ratios), n, n)), "moved": np.zeros((len(plan.ratios), n, n, 3))}
    meshes = plan.resolution, plan.fine
    return _gain(plan, point, meshes, [solve(replace(plan, resolution=res), point) for res in meshes])


def stretch(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What finite strain adds on the coarse mesh, for the point's own s, to small strain.

    Returns
    -------
    `rise` (levels, k, k) and `moved` (levels, k, k, 3) as of `solve`, finite minus small strain, for the
    levels but 0.

    Raises
    ------
    NotConverged, NotModelled
        If no equilibrium is found at one of the levels, or only one whose contact has wrinkled.
    """
    ratio = (1 + 1.5 * point[6]) / (1 - point[6])
    geometry, res = geometry_at(plan, point, float(ratio * point[5])), plan.coarse
    with one_thread():
        model = build(geometry, res, True)
        bare = path(geometry, model, False)
        full = path(geometry, model, True, bare)
        small = tared_at_rest(geometry, full, bare)
        found = [tared(geometry, (full.to(level), bare.to(level))) for level in plan.levels[1:].tolist()]
    for level, (rise, _) in zip(plan.levels[1:].tolist(), found, strict=True):
        refuse_wrinkles(rise, small[0], level)
    whole, true = [np.stack([f[k] for f in found]) for k in range(2)], small
    if plan.degree:
        smooth = _expanded(plan, point, np.array([ratio]), res)
        true = smooth["rise"][0], smooth["moved"][0]
        x = lines(geometry, res)
        whole = [without_ripples(*fields, x) for fields in zip(whole, small, true, strict=True)]
    return {name: whole[k] - true[k] for k, name in enumerate(("rise", "moved"))}


def refine_stretch(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What the fine mesh adds to what finite strain adds, as `refine` says it.

    Returns
    -------
    `rise` (levels, k, k) and `moved` (levels, k, k, 3) as of `stretch`, at the fine mesh's nodes.
    """
    point = _centred(point)
    meshes = plan.coarse, plan.fine
    return _gain(plan, point, meshes, [stretch(replace(plan, coarse=res), point) for res in meshes])


def _expanded(plan: Plan, point: Floats, ratios: Floats, res: Resolution) -> dict[str, Floats]:
    """`solve` by multipoles, for inclusions of so many times the tissue's modulus, at the nodes of a mesh."""
    geometry = geometry_at(plan, point, 1.0)
    moduli = [float(ratio * point[5]) for ratio in ratios]
    assert geometry.inclusion is not None
    rise, moved = expanded(
        plan.probe, geometry.slab, geometry.inclusion, moduli, plan.degree, lines(geometry, res)
    )
    return {"rise": rise, "moved": moved}


def _centred(point: Floats) -> Floats:
    return np.array([*point[:2], 0.0, 0.0, *point[4:]])


def _gain(
    plan: Plan, point: Floats, meshes: tuple[Resolution, Resolution], found: list[dict[str, Floats]]
) -> dict[str, Floats]:
    """Fields of the second mesh at its nodes, less those of the first one carried there."""
    geometry = geometry_at(plan, point, 1.0)
    nodes = [lines(geometry, res)[0] for res in meshes]
    onto, (less, more) = cubic(*nodes), found

    def gain(name: str) -> Floats:
        carried = np.einsum("ai,cij...,bj->cab...", onto, less[name], onto, optimize=True)
        return np.asarray(more[name] - carried)

    return {name: gain(name) for name in ("rise", "moved")}


def background(plan: Plan, thickness: float, tissue: float) -> dict[str, Floats]:
    """Press on plain tissue, on the grid that answers are given on.

    Returns
    -------
    Lines `x` (m,); `pressure` (levels, m, m) per kPa of the tissue and mm of indentation; `moved` (levels, m,
    m, 3), displacement per mm of indentation.
    """
    geometry, levels = (
        bare_geometry(plan.probe, plan.slab(thickness, tissue)),
        tuple(plan.levels[1:].tolist()),
    )
    found = [(1.0, *ground(geometry, plan.fine, False, (1.0,)))]
    if plan.finite:
        found += zip(levels, ground(geometry, plan.fine, True, levels), strict=True)
    x = grid_lines(found[0][1])[0]
    pressure, moved = (
        np.stack([np.asarray(surface[name], dtype=float) / level for level, surface in found])
        for name in ("pressure", "displacement")
    )
    shape = (len(found), x.size, x.size)
    return {"x": x, "pressure": pressure.reshape(shape) / tissue, "moved": moved.reshape(*shape, 3)}
