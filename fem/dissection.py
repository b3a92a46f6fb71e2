"""Nested dissection: in which order to eliminate the unknowns of finite elements.

The elements are halved again and again, each time where few unknowns cross (George 1973; [george1973]); on
the way up, each union of two halves eliminates the unknowns that no other element shares. Cuts are sought by
sweeping planes, and surfaces that were smoothed over the mesh, through the elements: all places of a cut are
weighed at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_LEAF = 6  # elements at most at the bottom
_SMOOTH = (1, 3, 10, 30)  # steps of smoothing after which a coordinate is swept again
_CURVED = 40  # smallest set of elements that is not just cut by planes
_SLIVER = 0.03  # smallest part of a set that may be cut off


@dataclass(frozen=True)
class Groups:
    """Elements and groups of unknowns; the unknowns of one group belong to the same elements.

    Attributes
    ----------
    slots
        Groups of each element, filled up with a group without weight; (elements, most groups).
    weight
        Unknowns of each group, (groups + 1,).
    shared
        Elements of each group, (groups + 1,).
    members
        Unknowns sorted by group, (unknowns,).
    centres
        Middles of the elements, scaled to a length of 1; (elements, 3).
    """

    slots: Ints
    weight: Ints
    shared: Ints
    members: Ints
    centres: Floats


@dataclass(frozen=True)
class Dissection:
    """The tree of halves, children before their parents.

    Attributes
    ----------
    elements
        Of each leaf, else empty.
    children
        Halves of each set, none of a leaf.
    pivots, borders
        Groups that each set eliminates, and those that it shares with elements outside, rising.
    """

    elements: list[Ints]
    children: list[tuple[int, ...]]
    pivots: list[Ints]
    borders: list[Ints]


def groups_of(dofs: Ints, centres: Floats) -> Groups:
    """Find the groups; `dofs` (elements, k) and `centres` (elements, 3) as for `fem.fronts.plan`."""
    element, _ = np.nonzero(dofs >= 0)
    unknown = dofs[dofs >= 0]
    # unknowns of the same elements get the same sum of the elements' random numbers
    code = np.random.default_rng(0).integers(1 << 63, size=len(dofs), dtype=np.uint64)
    name = np.zeros(unknown.max() + 1, dtype=np.uint64)
    np.add.at(name, unknown, code[element])
    _, first, group = np.unique(name, return_index=True, return_inverse=True)
    group = np.argsort(np.argsort(first))[group]  # numbered as they come: nothing depends on the names
    weight = np.append(np.bincount(group), 0)
    groups = len(weight) - 1
    owner, kind = np.divmod(np.unique(element * groups + group[unknown]), groups)
    held = np.bincount(owner, weights=weight[kind], minlength=len(dofs))
    assert np.array_equal(held, (dofs >= 0).sum(axis=1)), "two groups of unknowns got the same name"
    count = np.bincount(owner, minlength=len(dofs))
    slots = np.full((len(dofs), count.max()), groups)
    slots[owner, np.arange(len(owner)) - np.repeat(np.cumsum(count) - count, count)] = kind
    shared = np.append(np.bincount(kind), 0)
    size = np.ptp(centres, axis=0).max() or 1.0
    return Groups(
        slots, weight, shared, np.argsort(group, kind="stable"), (centres - centres.mean(axis=0)) / size
    )


def dissect(mesh: Groups) -> Dissection:
    """Halve the elements down to small sets."""
    leaves: list[Ints] = []
    children: list[tuple[int, ...]] = []

    def grow(elements: Ints) -> int:
        small = len(elements) <= _LEAF
        under = () if small else tuple(grow(half) for half in _halve(mesh, elements))
        leaves.append(elements if small else elements[:0])
        children.append(under)
        return len(leaves) - 1

    grow(np.arange(len(mesh.slots)))
    pivots, borders = eliminate(mesh, leaves, children)
    turn = _thrifty(mesh, children, pivots, borders)
    place = np.argsort(turn)
    return Dissection(
        [leaves[i] for i in turn],
        [tuple(sorted(int(place[c]) for c in children[i])) for i in turn],
        [pivots[i] for i in turn],
        [borders[i] for i in turn],
    )


def _halve(mesh: Groups, elements: Ints) -> tuple[Ints, Ints]:
    """Cut where few unknowns cross, for the size of the smaller half."""
    slots = mesh.slots[elements]
    number, each = slots.shape
    groups, local = np.unique(slots, return_inverse=True)
    local = local.reshape(-1)
    times = np.bincount(local)
    weight = mesh.weight[groups].astype(float)
    # unknowns shared with elements outside are in a border already: they only count for being in both halves
    crossing = np.where(times == mesh.shared[groups], weight, 0.5 * weight)
    by_group, start = np.argsort(local, kind="stable") // each, np.cumsum(times) - times
    part = np.arange(1, number) / number
    balance = (part * (1 - part)) ** 0.75
    balance[(part < _SLIVER) | (part > 1 - _SLIVER)] = 1e-9

    def sweep(field: Floats) -> tuple[float, Bools]:
        """Cut across a field: the elements up to some value on one side, the others on the other."""
        place = np.empty(number, dtype=np.int64)
        place[np.argsort(np.round(field, 8), kind="stable")] = np.arange(number)
        seat = place[by_group]
        first, end = np.minimum.reduceat(seat, start), np.maximum.reduceat(seat, start)
        entering = np.bincount(first, crossing, number) - np.bincount(end, crossing, number)
        cost = (np.cumsum(entering)[:-1] + 1) / balance
        best = int(cost.argmin())
        return float(cost[best]), place <= best

    field = mesh.centres[elements]
    cuts = [sweep(column) for column in field.T]
    if number >= _CURVED:
        touch = sp.csr_array(
            (np.ones(len(local)), local, np.arange(number + 1) * each), shape=(number, len(groups))
        )
        back = sp.csr_array(touch.T * weight[:, None])
        total = touch @ (back @ np.ones(number))
        field = field - field.mean(axis=0)
        for step in range(1, max(_SMOOTH) + 1):  # mean over the neighbours, by unknowns shared
            field = (touch @ (back @ field)) / total[:, None]
            if step in _SMOOTH:
                cuts += [sweep(column) for column in field.T]
    side = min(cuts, key=lambda cut: cut[0])[1]
    return elements[side], elements[~side]


def eliminate(
    mesh: Groups, leaves: list[Ints], children: list[tuple[int, ...]]
) -> tuple[list[Ints], list[Ints]]:
    """Groups that each front eliminates, and those it hands on, both rising."""
    pivots: list[Ints] = []
    borders: list[Ints] = []
    times: list[Ints] = []
    for elements, under in zip(leaves, children, strict=True):
        if under:
            known, inverse = np.unique(np.concatenate([borders[c] for c in under]), return_inverse=True)
            weights = np.concatenate([times[c] for c in under])
            count = np.bincount(inverse, weights=weights).astype(np.int64)
        else:
            known, count = np.unique(mesh.slots[elements], return_counts=True)
            real = mesh.weight[known] > 0
            known, count = known[real], count[real]
        done = count == mesh.shared[known]
        pivots.append(known[done])
        borders.append(known[~done])
        times.append(count[~done])
    return pivots, borders


def _thrifty(
    mesh: Groups, children: list[tuple[int, ...]], pivots: list[Ints], borders: list[Ints]
) -> list[int]:
    """Postorder that needs the least memory: the child with the highest peak over its remains goes first
    (Liu 1986; [liu1986])."""
    peak, remains = np.zeros(len(children)), np.zeros(len(children))
    ordered: list[list[int]] = []
    for i, under in enumerate(children):
        p, b = (float(mesh.weight[groups].sum()) for groups in (pivots[i], borders[i]))
        sequence = sorted(under, key=lambda c: remains[c] - peak[c])
        held = 0.0
        for c in sequence:
            peak[i] = max(peak[i], held + peak[c])
            held += remains[c]
        peak[i] = max(peak[i], held + (p + b) ** 2)
        freed = sum(float(mesh.weight[borders[c]].sum()) ** 2 for c in under)
        remains[i] = held - freed + p * (p + b) + b * b
        ordered.append(sequence)
    turn: list[int] = []

    def visit(i: int) -> None:
        for c in ordered[i]:
            visit(c)
        turn.append(i)

    visit(len(children) - 1)
    return turn
