"""How far an emulator is off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

EDGE = 1.0
"""How wide the probe's edge is, where errors count apart, mm."""

LARGE = 4.0
"""Size from which inclusions count as large, mm: those below show little, and count apart."""

FEWEST = 10
"""Held-out samples below which nothing is said of percentiles."""


def off_the_edge(x: Floats) -> NDArray[np.bool_]:
    """Which nodes of a grid with lines x (m,), mm, lie off the probe's edge, (m, m)."""
    inner = np.abs(x) <= x[-1] - EDGE
    return np.logical_and.outer(inner, inner)


@dataclass(frozen=True)
class Errors:
    """Errors of the samples within the ranges, each left out of what was fitted, in per cent of the field's
    own maximum off the probe's edge.

    `pressure` and `displacement` are of the tared fields, the worst of all levels and moduli solved: largest
    off the probe's edge (its outermost millimetre), root mean square over the area, and largest at all
    nodes, (n, 3). At the edge the pressure is singular: what is found there depends on the mesh, and at
    finite strain scatters by some per cent. `size_mm` (n,) is the inclusion's. `finer` (p, 6),
    `finer_more` (q, 6): the same of what a finer mesh adds to the tared pressure, then to the tared
    displacement, of centred samples, and to what finite strain adds to them (q 0 for a linear one).
    `curve` (rows, 9): number of samples at small and at finite strain, core seconds they took (pairs of
    meshes apart), and of a common set of held-out samples with `size_mm` >= 4 the median and the 95th
    percentile of each of the pressure's three errors. `solves` (4, 2): of samples, of pairs of a fine and a
    lean mesh, of samples at finite strain and of pairs of those, how many were tried, and how many of them
    failed and are missing from all this.
    """

    size_mm: Floats
    pressure: Floats
    displacement: Floats
    finer: Floats
    finer_more: Floats
    curve: Floats
    solves: Floats

    @property
    def failed_percent(self) -> float:
        """Share of the solves that failed, the worst kind's."""
        return float(100 * (self.solves[:, 1] / np.maximum(self.solves[:, 0], 1)).max())

    def alike(self, size_mm: float) -> NDArray[np.bool_]:
        """Which samples tell of an inclusion of a size, (n,): those on its side of `LARGE`, or, if they are
        too few, the `FEWEST` nearest to it in size; none where there are not so many."""
        same = (self.size_mm >= LARGE) == (size_mm >= LARGE)
        if same.sum() >= FEWEST:
            return np.asarray(same)
        if len(self.size_mm) < FEWEST:
            return np.zeros(len(self.size_mm), bool)
        away = np.abs(self.size_mm - size_mm)
        return np.asarray(away <= np.partition(away, FEWEST - 1)[FEWEST - 1])

    def percentile(self, name: str, percent: float, size_mm: float = LARGE, kind: int = 0) -> float | None:
        """Of errors `name` ("pressure" or "displacement") of the samples that are `alike`; kind 0: largest
        off the edge, 1: root mean square, 2: largest. None where too few samples were held out."""
        found = getattr(self, name)[self.alike(size_mm), kind]
        return float(np.percentile(found, percent)) if len(found) else None
