"""Stiffness of all elements as the solver and Newton's method take it: matrices to factor, and products."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fem import elasticity, heap
from fem.meshed import Model
from fem.quadrature import DOFS, NODES, Quadrature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CHUNK = 128  # element matrices made double at a time


@dataclass(frozen=True)
class AtRest:
    """Stiffness of undeformed elements, never stored: made where it is factored, else known by its forces."""

    quad: Quadrature
    shear: Floats
    bulk: Floats
    kind: type[np.floating]

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices (n, 81, 81) of some elements."""
        moduli = self.shear[elements], self.bulk[elements]
        return elasticity.stiffness(self.quad, *moduli, elements=elements, dtype=self.kind)

    def times(self, local: Floats) -> Floats:
        """Products with unknowns (elements, 81)."""
        nodal = local.reshape(-1, NODES, 3)
        return elasticity.linear_forces(self.quad, nodal, self.shear, self.bulk).reshape(local.shape)


@dataclass(frozen=True)
class Stiffness:
    """Element matrices (m, 81, 81)."""

    matrices: NDArray[np.floating]

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices of some elements."""
        return self.matrices[elements]

    def times(self, local: Floats) -> Floats:
        """Products with unknowns (elements, 81); sums are double in any case."""
        force = np.empty((*local.shape, 1))
        for start in range(0, len(local), _CHUNK):
            part = slice(start, start + _CHUNK)
            some = self.matrices[part].astype(np.float64, copy=False)
            np.matmul(some, local[part, :, None], out=force[part])
        return force[..., 0]

    def plus(self, share: float, other: AtRest) -> Stiffness:
        """The sum with a share of others."""
        found = self.matrices.copy()
        for start in range(0, len(found), _CHUNK):
            part = np.arange(start, min(start + _CHUNK, len(found)))
            found[part] += np.float32(share) * other(part)
        return Stiffness(found)


@dataclass(frozen=True)
class Tangent:
    """Tangent stiffness of deformed elements, in single precision.

    Stored with the first product, which comes after it was factored: the elimination has the memory alone.
    """

    quad: Quadrature
    shear: Floats
    bulk: Floats
    moved: Floats
    volume: Floats | None = None  # that pressures are taken from, instead of the displacements' own; (m, 4)

    @cached_property
    def stored(self) -> Stiffness:
        """All of them."""
        heap.trim()  # beside the factor, these are what a press takes most memory for
        return Stiffness(self._made(None))

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices (n, 81, 81) of some elements."""
        return self.stored(elements) if "stored" in vars(self) else self._made(elements)

    def times(self, local: Floats) -> Floats:
        """Products with unknowns (elements, 81)."""
        return self.stored.times(local)

    def let_go(self) -> None:
        """Keep no matrices, until the next product."""
        vars(self).pop("stored", None)

    def _made(self, elements: Ints | None) -> NDArray[np.floating]:
        shear, bulk, volume = self.shear, self.bulk, self.volume
        if elements is not None:
            shear, bulk = shear[elements], bulk[elements]
            volume = None if volume is None else volume[elements]
        return elasticity.stiffness(self.quad, shear, bulk, self.moved, elements, np.float32, volume)


@dataclass(frozen=True)
class Sheared:
    """Matrices in the unknowns x, y and z - G . (x, y) at each node; slope G (nodes, 2)."""

    matrices: Matrices
    cells: Ints
    slope: Floats

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices of some elements."""
        found = self.matrices(elements)
        slope = self.slope[self.cells[elements]]  # (n, 27, 2)
        touched = np.flatnonzero(np.abs(slope).max(axis=(1, 2)) > 0)
        if touched.size:
            some, g = found[touched], slope[touched].astype(found.dtype)
            for a in (0, 1):
                some[:, :, a::3] += some[:, :, 2::3] * g[:, None, :, a]
                some[:, a::3] += some[:, 2::3] * g[:, :, a, None]
            found[touched] = some
        return found


Matrices = AtRest | Tangent | Stiffness


def product(matrices: Matrices, moved: Floats, model: Model) -> Floats:
    """Forces (m, 27, 3) of element matrices on displacements (nodes, 3)."""
    return matrices.times(moved[model.nodes.cells].reshape(-1, DOFS)).reshape(-1, NODES, 3)
