"""Which specimens an emulator learns from: its ranges, and points within them that come in an order.

What is solved of each, and kept, is in `fem.specimen`.
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
from fem.model import Inclusion, Length, Poisson, Probe, Slab
from fem.ripples import DEGREE
from fem.spheres import refuse
from fem.topology import Resolution

Floats = NDArray[np.float64]
Some = TypeVar("Some", float, Floats)

_CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)
_BEYOND = 0.03  # by how much of a range the samples reach beyond it: at the ends, regression is worst
_OFFSETS = (1, 1), (0, 0), (1, 0), (0, 0)  # which of its offsets each point of four keeps
CLEARANCE = 4.0
"""Least distance between inclusion and chest wall, mm."""
_RAREST = 4096  # of so many specimens drawn one fits at least, or there are none to be had
_MISSED = 256  # drawings none of which fits into a tissue, after which another one is taken
_SHARED = 12  # specimens in a row in one plain tissue, which multipoles solve once for all
_STRETCHED = 3  # samples for each one that is solved at finite strain, too

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

    @property
    def shared(self) -> int:
        """How many points in a row differ in their inclusion alone. Signals depend on thickness and tissue
        so smoothly that few of these tell as much as one of each for every inclusion."""
        return _SHARED if self.degree else 1

    def stretched(self, number: int) -> bool:
        """Whether a point is solved at finite strain, too: of a tissue's the first ones, of each kind of
        offsets one."""
        turn = number % self.shared
        return turn < _SHARED // _STRETCHED if self.degree else number % _STRETCHED == 0

    def points(self) -> Iterator[Floats]:
        """Scrambled Sobol sequence of (size, depth, offsets x >= y >= 0, thickness, tissue, s), those that
        fit; s is that of the inclusion where one modulus is solved. Of four points one keeps its offsets, one
        keeps x, and two lie under the probe's middle: symmetry makes these two and five times cheaper.
        So many in a row as are `shared` lie in one tissue.

        Raises `NotBuilt` where hardly any specimen of the ranges fits.
        """
        r = self.ranges
        low, high = (
            np.array(side) for side in zip(r.size_mm, r.depth_mm, r.thickness_mm, r.tissue_kPa, strict=True)
        )
        beyond = _BEYOND * (high - low)
        sobol = qmc.Sobol(7, scramble=True, rng=np.random.default_rng(self.seed))
        tissues = self._tissues(low[2:] - beyond[2:], high[2:] + beyond[2:])
        number, until, missed, shared = 0, 0, 0, np.empty(2)
        for drawn in count(0, 64):
            if drawn > _RAREST * (number + 4):
                raise NotBuilt(
                    f"ranges: received {r}, of which hardly a specimen fits; allowed are inclusions that "
                    f"keep {CLEARANCE:g} mm from the chest wall and stay within {self.width_mm:g} mm of width"
                )
            drawings = sobol.random(64)
            specimens = low - beyond + drawings[:, :4] * (high - low + 2 * beyond)
            offsets = np.sort(drawings[:, 4:6])[:, ::-1] * r.offset_mm * (1 + _BEYOND)
            for u, (size, depth, *rest), (x, y) in zip(drawings, specimens, offsets, strict=True):
                if number == until or missed > _MISSED:
                    shared, missed, until = next(tissues), 0, (number // self.shared + 1) * self.shared
                thickness, tissue = rest if self.shared == 1 else shared
                if clearance(size, depth, thickness) < 0 or x + size / 2 >= self.width_mm / 2:
                    missed += 1
                    continue
                missed = 0
                s = self.signals[0] + u[6] * (self.signals[1] - self.signals[0])
                keep_x, keep_y = _OFFSETS[number % len(_OFFSETS)]
                yield np.array([size, depth, keep_x * x, keep_y * y, thickness, tissue, s])
                number += 1

    def _tissues(self, low: Floats, high: Floats) -> Iterator[Floats]:
        """Scrambled Sobol sequence of thickness and tissue, for specimens that share them."""
        sobol = qmc.Sobol(2, scramble=True, rng=np.random.default_rng([self.seed, 1]))
        while True:
            yield from low + sobol.random(64) * (high - low)

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
