"""The unknowns of a press: which node moves how, which pairs are in contact, what is held.

The probe and the slab are two meshes side by side. Where a pair of contact nodes is closed, the probe's node
takes its z unknown from the slab's, x and y stay free of each other (`fem.contact` adds what sliding
changes). All is solved in the probe's frame: the glass at rest, the chest wall moving against it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fem import solver
from fem.quadrature import DOFS
from fem.topology import Layout, probe_topology, slab_topology

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Nodes:
    """Nodes of both bodies, the slab's first."""

    cells: Ints  # (m, 27)
    contact: Ints  # the slab's nodes of the footprint, (nx, ny), x along the first axis
    tip: Ints  # the probe's nodes on them
    chest: Ints  # the slab's nodes on the chest wall
    held: Bools  # (nodes, 3)
    slab: int  # number of the slab's nodes
    slab_cells: int
    under: Ints  # the slab's elements that the footprint's nodes belong to
    centres: Floats  # logical middles of the elements, the probe hung on the slab, (m, 3)


Parity = tuple[bool, bool]
"""Whether fields are odd about the symmetry planes across x and y: the negative of their mirror images."""
EVEN: Parity = (False, False)


@lru_cache(maxsize=16)
def nodes(layout: Layout, sides: str, odd: Parity = EVEN) -> Nodes:
    """Find the nodes that touch and those that are held; on symmetry planes, fields of a parity are."""
    slab, probe = slab_topology(layout), probe_topology(layout)
    place = np.hstack([slab.doflocs, probe.doflocs])
    split = slab.doflocs.shape[1]
    in_slab = np.arange(place.shape[1]) < split
    x, y, z = place
    chest = np.flatnonzero(in_slab & (z == z[in_slab].max()))
    glass = np.flatnonzero(~in_slab & (z == z[~in_slab].min()))
    rim = x[~in_slab].max()
    under = np.flatnonzero(
        in_slab & (z == z[in_slab].min()) & (np.abs(x) < rim + 1e-9) & (np.abs(y) < rim + 1e-9)
    )
    touch = np.flatnonzero(~in_slab & (z == 0))
    held = np.zeros((place.shape[1], 3), dtype=bool)
    held[chest] = held[glass] = True
    for axis, symmetric in enumerate(layout.symmetric):
        if symmetric:
            across = np.arange(3) == axis
            held |= (np.abs(place[axis]) < 1e-9)[:, None] & (~across if odd[axis] else across)
        if sides == "symmetric":
            held[in_slab & (np.abs(place[axis]) > place[axis, in_slab].max() - 1e-9), axis] = True
    cells = [m.dofs.element_dofs.T.astype(np.int64) for m in (slab, probe)]
    middles = [m.p[:, m.t].mean(axis=1) for m in (slab, probe)]
    middles[1][2] += slab.p[2].min()  # hang the probe on the slab, so that neighbours are neighbours
    footprint = np.isin(cells[0], under).any(axis=1)
    return Nodes(
        np.vstack([cells[0], cells[1] + split]),
        _as_grid(under, place),
        _as_grid(touch, place),
        chest,
        held,
        split,
        len(cells[0]),
        np.flatnonzero(footprint),
        np.hstack(middles).T,
    )


def _as_grid(found: Ints, place: Floats) -> Ints:
    """Nodes of a plane z = constant that form a tensor grid, as an array indexed by x, then y."""
    order = np.lexsort((np.round(place[1, found], 6), np.round(place[0, found], 6)))
    columns = len(np.unique(np.round(place[0, found], 6)))
    return found[order].reshape(columns, -1)


@dataclass(frozen=True)
class System:
    """Numbered unknowns for one set of closed pairs."""

    nodes: Nodes
    closed: Bools  # pairs in contact, (nx, ny)
    unknown: Ints  # unknown of each dof 3 * node + axis, -1 where held; (3 nodes,)
    tree: solver.Tree

    def expand(self, values: Floats) -> Floats:
        """Displacements (nodes, 3) of values of the unknowns; held ones are 0."""
        return np.append(values, 0.0)[self.unknown].reshape(-1, 3)

    def gather(self, forces: Floats) -> Floats:
        """Forces on the unknowns, the transpose of `expand`."""
        free = self.unknown >= 0
        found = np.bincount(self.unknown[free], weights=forces.ravel()[free], minlength=self.tree.size)
        return np.asarray(found, dtype=float)


@lru_cache(maxsize=8)
def _system(layout: Layout, sides: str, key: bytes, odd: Parity = EVEN) -> System:
    found = nodes(layout, sides, odd)
    closed = np.frombuffer(key, dtype=bool).reshape(found.contact.shape)
    master = np.arange(found.held.size).reshape(found.held.shape)
    master[found.tip[closed], 2] = master[found.contact[closed], 2]
    free = np.zeros(found.held.size, dtype=bool)
    free[master[~found.held]] = True
    number = np.where(free, np.cumsum(free) - 1, -1)
    unknown = number[master].ravel()
    local = (3 * found.cells[:, :, None] + np.arange(3)).reshape(-1, DOFS)
    # sets of closed pairs, and parities, differ in few unknowns: one dissection is good for all
    first = closed.all() and odd == EVEN
    like = None if first else _system(layout, sides, np.ones_like(closed).tobytes()).tree
    tree = solver.plan(unknown[local], found.centres, like)
    return System(found, closed, unknown, tree)


def system(layout: Layout, sides: str, closed: Bools, odd: Parity = EVEN) -> System:
    """Number the unknowns and plan their elimination; closed pairs (nx, ny) share their z unknown."""
    return _system(layout, sides, np.ascontiguousarray(closed, dtype=bool).tobytes(), odd)
