"""Stiffness of all elements as the solver and Newton's method take it: matrices to factor, and products."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fem import elasticity, heap
from fem.meshed import Model
from fem.quadrature import DOFS, NODES, Quadrature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_CHUNK = 128  # element matrices made, or made double, at a time
_HALF = 41  # rows of the first block that tangents are stored by

Blocks = NDArray[np.floating]


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
class Tangent:
    """Tangent stiffness of deformed elements, in single precision.

    Stored with the first product, which comes after it was factored: the elimination has the memory alone.
    """

    quad: Quadrature
    shear: Floats
    bulk: Floats
    moved: Floats
    volume: Floats | None = None  # that pressures are taken from, instead of the displacements' own; (m, 4)
    damping: float = 0.0  # share of the stiffness at rest that is added

    @cached_property
    def stored(self) -> tuple[Blocks, Blocks, Blocks]:
        """Of all matrices, which are symmetric, the blocks A (m, h, h), B (m, 81 - h, h) and C in
        [[A, B^T], [B, C]]."""
        heap.trim()  # beside the factor, these are what a press takes most memory for
        m, h, rest = self.quad.size, _HALF, DOFS - _HALF
        shapes = (m, h, h), (m, rest, h), (m, rest, rest)
        found = tuple(np.empty(shape, np.float32) for shape in shapes)
        for part in _chunks(m):
            made = self(np.arange(m)[part])
            for kept, block in zip(found, (made[:, :h, :h], made[:, h:, :h], made[:, h:, h:]), strict=True):
                kept[part] = block
        return found  # type: ignore[return-value]

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices (n, 81, 81) of some elements."""
        moduli, volume = (self.shear[elements], self.bulk[elements]), self.volume
        volume = None if volume is None else volume[elements]
        found = elasticity.stiffness(self.quad, *moduli, self.moved, elements, np.float32, volume)
        if self.damping:
            rest = elasticity.stiffness(self.quad, *moduli, elements=elements, dtype=np.float32)
            found += np.float32(self.damping) * rest
        return found

    def times(self, local: Floats) -> Floats:
        """Products with unknowns (elements, 81); sums are double in any case."""
        force, h = np.empty((*local.shape, 1)), _HALF
        for part in _chunks(len(local)):
            a, b, c = (some[part].astype(np.float64, copy=False) for some in self.stored)
            upper, lower = local[part, :h, None], local[part, h:, None]
            force[part, :h] = a @ upper + b.transpose(0, 2, 1) @ lower
            force[part, h:] = b @ upper + c @ lower
        return force[..., 0]

    def let_go(self) -> None:
        """Keep no matrices, until the next product."""
        vars(self).pop("stored", None)

    def damped(self, share: float) -> Tangent:
        """With a share of the stiffness at rest; what is stored of this one is let go of."""
        self.let_go()
        return replace(self, damping=share)


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


Matrices = AtRest | Tangent


def _chunks(size: int) -> Iterator[slice]:
    return (slice(start, start + _CHUNK) for start in range(0, size, _CHUNK))


def product(matrices: Matrices, moved: Floats, model: Model) -> Floats:
    """Forces (m, 27, 3) of element matrices on displacements (nodes, 3)."""
    return matrices.times(moved[model.nodes.cells].reshape(-1, DOFS)).reshape(-1, NODES, 3)
