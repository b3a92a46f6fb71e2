"""The tree of fronts of a multifrontal solver: what each one eliminates, adds up and stores, and where.

Everything that depends on the topology alone is worked out here, once; `fem.solver` only moves numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from fem.dissection import Dissection, Groups, dissect, eliminate, groups_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_PANEL = 128  # pivots stored together
_BLOCK = 512  # longest run of rows that is added at once: little is wasted above the diagonal
_PADDING = 1.06  # entries of a batch over those that are used


@dataclass(frozen=True)
class Front:
    """A node of the tree: its pivots are eliminated here, its border is handed to the parent.

    Attributes
    ----------
    start, pivots
        The pivots are the numbers of elimination start ... start + pivots - 1.
    border
        Numbers of elimination of the border, rising.
    elements
        Of a leaf, else empty.
    place
        Row in this front (pivots, then border) of each local dof of a leaf's elements; the front's size where
        it is prescribed; (elements, k).
    children
        Fronts whose borders are added to this one.
    runs
        Of each child: rows of its border that stay together as (from, to, length), rising; `to` counts in
        this front.
    panels
        Where its part of the factor is stored: (batch, slot, first pivot, end).
    """

    start: int
    pivots: int
    border: Ints
    elements: Ints
    place: Ints
    children: tuple[int, ...]
    runs: tuple[tuple[tuple[int, int, int], ...], ...]
    panels: tuple[tuple[int, int, int, int], ...]

    @property
    def size(self) -> int:
        return self.pivots + len(self.border)


@dataclass(frozen=True)
class Batch:
    """Panels of the factor that are independent of each other and of nearly the same shape.

    Attributes
    ----------
    rows
        Numbers of elimination of the pivots and of the rows below, filled up with the number of unknowns;
        (panels, width + rows below).
    width
        Pivots, with filling.
    """

    rows: NDArray[np.int32]
    width: int


@dataclass(frozen=True)
class Tree:
    """Order of elimination; children come before their parents, the root last."""

    fronts: tuple[Front, ...]
    batches: tuple[Batch, ...]  # in the order of forward substitution
    order: Ints  # number of elimination of each unknown, shape (unknowns,)
    dofs: Ints  # unknown of each local dof, -1 where prescribed, shape (elements, k)

    @property
    def size(self) -> int:
        return len(self.order)


def plan(dofs: Ints, centres: Floats, like: Tree | None = None) -> Tree:
    """Find the order of elimination; depends on the topology only.

    Parameters
    ----------
    dofs
        Unknown of each local dof, 0 ... n - 1, or -1 where it is prescribed; shape (elements, k).
    centres
        Positions that tell which elements lie together; shape (elements, 3).
    like
        A tree of the same elements whose dissection is taken over, which saves most of the time; good where
        few unknowns differ.
    """
    mesh = groups_of(dofs, centres)
    if like is None:
        return _number(mesh, dofs, dissect(mesh))
    elements, children = [f.elements for f in like.fronts], [f.children for f in like.fronts]
    return _number(mesh, dofs, Dissection(elements, children, *eliminate(mesh, elements, children)))


def _spread(starts: Ints, lengths: Ints) -> Ints:
    """start, start + 1, ..., start + length - 1 of each, one after the other."""
    before = np.cumsum(lengths) - lengths
    return np.repeat(starts - before, lengths) + np.arange(int(lengths.sum()))


def _number(mesh: Groups, dofs: Ints, found: Dissection) -> Tree:
    """Give the unknowns their numbers, and the fronts their rows."""
    leaves, children, borders = found.elements, found.children, found.borders
    weight, groups, size = mesh.weight, len(mesh.weight) - 1, len(mesh.members)
    # Pivots in the order in which the leaves first touch them: what a child hands on then lies in few runs
    # of its parent.
    rank = np.empty(len(dofs), dtype=np.int64)
    for i, elements in enumerate(leaves):
        rank[elements] = i
    first, end = np.full(groups + 1, len(leaves)), np.full(groups + 1, -1)
    np.minimum.at(first, mesh.slots, rank[:, None])
    np.maximum.at(end, mesh.slots, rank[:, None])
    pivots = [g[np.lexsort((end[g], first[g]))] for g in found.pivots]
    sequence = np.concatenate(pivots)
    lengths = weight[sequence]
    begin = np.zeros(groups, dtype=np.int64)  # number of elimination of each group's first unknown
    begin[sequence] = np.cumsum(lengths) - lengths
    member = np.cumsum(weight) - weight
    order = np.empty(size, dtype=np.int64)
    order[mesh.members[_spread(member[sequence], lengths)]] = np.arange(size)

    numbered = np.append(order, -1)[dofs]
    fronts: list[Front] = []
    at = np.zeros(groups, dtype=np.int64)  # row of each group in the front at hand
    for elements, under, own, rim in zip(leaves, children, pivots, borders, strict=True):
        start, p = (int(begin[own[0]]) if len(own) else 0), int(weight[own].sum())
        rim = rim[np.argsort(begin[rim])]
        border = _spread(begin[rim], weight[rim])
        at[own] = begin[own] - start
        at[rim] = p + np.cumsum(weight[rim]) - weight[rim]
        mine = numbered[elements]
        place = np.where(
            mine < 0,
            p + len(border),
            np.where((mine >= start) & (mine < start + p), mine - start, p + np.searchsorted(border, mine)),
        )
        runs = []
        for c in under:
            handed = borders[c][np.argsort(begin[borders[c]])]
            runs.append(_runs(at[handed], weight[handed], p))
        fronts.append(Front(start, p, border, elements, place, under, tuple(runs), ()))
    return _batched(fronts, order, dofs)


def _runs(to: Ints, lengths: Ints, pivots: int) -> tuple[tuple[int, int, int], ...]:
    """Join neighbours; a run lies wholly in the pivots or in the border, and is no longer than `_BLOCK`."""
    found: list[tuple[int, int, int]] = []
    source = np.cumsum(lengths) - lengths
    cut = np.flatnonzero((to[1:] != to[:-1] + lengths[:-1]) | (to[1:] == pivots)) + 1
    for i, j in zip(np.concatenate([[0], cut]), np.concatenate([cut, [len(to)]]), strict=True):
        total = int(lengths[i:j].sum())
        for k in range(0, total, _BLOCK):
            found.append((int(source[i]) + k, int(to[i]) + k, min(_BLOCK, total - k)))
    return tuple(found)


def _batched(fronts: list[Front], order: Ints, dofs: Ints) -> Tree:
    """Decide where the factor is stored: small fronts of one height together, large ones in panels."""
    height = np.zeros(len(fronts), dtype=np.int64)
    for i, front in enumerate(fronts):
        height[i] = 1 + max((height[c] for c in front.children), default=-1)
    batches: list[Batch] = []
    panels: dict[int, tuple[tuple[int, int, int, int], ...]] = {}

    def add(chosen: list[int]) -> None:
        width = max(fronts[i].pivots for i in chosen)
        below = max(len(fronts[i].border) for i in chosen)
        rows = np.full((len(chosen), width + below), len(order), dtype=np.int32)
        for slot, i in enumerate(chosen):
            front = fronts[i]
            rows[slot, : front.pivots] = front.start + np.arange(front.pivots)
            rows[slot, width : width + len(front.border)] = front.border
            panels[i] = ((len(batches), slot, 0, front.pivots),)
        batches.append(Batch(rows, width))

    for level in range(int(height.max()) + 1):
        here = [int(i) for i in np.flatnonzero(height == level) if fronts[i].pivots]
        small = [i for i in here if fronts[i].pivots <= _PANEL]
        small.sort(key=lambda i: (fronts[i].pivots, fronts[i].size, i))
        chosen: list[int] = []
        used = below = 0
        for i in small:
            p, b = fronts[i].pivots, len(fronts[i].border)
            below = max(below, b)
            if chosen and (len(chosen) + 1) * p * (p + below) > _PADDING * (used + p * (p + b)):
                add(chosen)
                chosen, used, below = [], 0, b
            chosen.append(i)
            used += p * (p + b)
        if chosen:
            add(chosen)
        for i in here:
            front = fronts[i]
            if front.pivots > _PANEL:
                pieces = -(-front.pivots // _PANEL)
                ends = np.linspace(0, front.pivots, pieces + 1).round().astype(int)
                found = []
                for low, high in pairwise(ends):
                    inner = front.start + np.arange(low, front.pivots)
                    found.append((len(batches), 0, int(low), int(high)))
                    rows = np.concatenate([inner, front.border]).astype(np.int32)
                    batches.append(Batch(rows[None], int(high - low)))
                panels[i] = tuple(found)
    placed = tuple(replace(front, panels=panels.get(i, ())) for i, front in enumerate(fronts))
    return Tree(placed, tuple(batches), order, dofs)
