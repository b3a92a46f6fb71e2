"""A quarter of plain tissue for fields that are even or odd about its symmetry planes.

Any field is the sum of four such; the quarter answers each with unknowns and a factor of its own, and what it
does on all four quarters follows by mirrors.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from fem.meshed import Model
from fem.operators import AtRest
from fem.slab_faces import Free, Given, free_of, given_of, reaction_of
from fem.solver import Factor
from fem.surface import mirror_grid
from fem.system import Parity, System, system

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Quarter:
    """What a quarter of plain tissue, tied all over, answers loads of one parity with."""

    system: System
    factor: Factor = field(repr=False)
    given: Given = field(repr=False)
    free: Free = field(repr=False)
    reaction: csr_matrix = field(repr=False)

    def at(self, nodes: NDArray[np.int64], values: Floats) -> Floats:
        """Displacements (..., 3, k) of nodes (...), for k columns of unknowns (unknowns, k)."""
        unknown = self.system.unknown.reshape(-1, 3)[nodes]
        return np.concatenate([values, np.zeros((1, values.shape[1]))])[unknown]


def quarter_of(model: Model, rest: AtRest, odd: Parity, factor: Factor | None = None) -> Quarter:
    """Factor a quarter for fields of a parity, unless its factor is there."""
    closed = np.ones(model.nodes.tip.shape, dtype=bool)
    sys = system(model.layout, model.geometry.slab.sides, closed, odd)
    return Quarter(
        sys,
        factor or Factor(sys.tree, rest),
        given_of(model, sys, rest),
        free_of(model, sys),
        reaction_of(model, sys, rest),
    )


def signs_of(turn: Parity) -> Floats:
    """Signs (3,) of coordinates and vectors that are mirrored across x or y, or not."""
    return np.array([-1.0 if mirrored else 1.0 for mirrored in (*turn, False)])


def character(odd: Parity, turn: Parity) -> float:
    """What mirrors make of a field of a parity: 1 or -1 times itself."""
    return -1.0 if (odd[0] and turn[0]) != (odd[1] and turn[1]) else 1.0


def whole(values: Floats, odd: Parity, axis: int) -> Floats:
    """A component (nx, ny, ...) of vectors of a parity on the quarter of the face, on all of it."""
    along_x, along_y = (-1.0 if odd[a] != (a == axis) else 1.0 for a in (0, 1))
    return mirror_grid(values, along_x, along_y)


def whole_force(force: Floats, odd: Parity) -> Floats:
    """Forces along z at nodes (nx, ny, ...) of a quarter, on all of the face: on a plane cells of both sides
    work."""
    found = force.copy()
    for axis in (0, 1):
        np.moveaxis(found, axis, 0)[0] *= 0.0 if odd[axis] else 2.0
    return whole(found, odd, 2)
