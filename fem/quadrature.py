"""Quadrature of the 27-node hexahedron on curved elements: 27 Gauss points, gradients, linear pressure
modes."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHex2
from skfem.quadrature import get_quadrature

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

NODES = 27
DOFS = 81  # local dof = 3 * node + axis

_POINTS, _WEIGHTS = get_quadrature(ElementHex2.refdom, 4)
_BASIS = [ElementHex2().lbasis(_POINTS, i) for i in range(NODES)]
SHAPE = np.stack([value for value, _ in _BASIS])  # (27 nodes, 27 points)
_REFERENCE = np.stack([gradient for _, gradient in _BASIS])  # (27 nodes, 3, 27 points)
BY_REFERENCE = np.ascontiguousarray(_REFERENCE.transpose(2, 1, 0).reshape(-1, NODES))
"""Derivatives along the reference coordinates at the points, of values at the nodes: (27 points * 3, 27)."""


@dataclass(frozen=True)
class Quadrature:
    """What the elements of a mesh integrate with; kept small, gradients are made anew for each chunk.

    Attributes
    ----------
    nodes
        (m, 27) nodes of each element.
    inverse
        (m, 27 points, 3, 3): derivative of the reference coordinate b along the real one a, 1/mm, at [a, b].
    weight
        (m, 27 points): quadrature weights, mm³.
    modes
        (m, 4, 27 points): 1, x, y, z made orthonormal in the element, mm^-3/2.
    """

    nodes: Ints
    inverse: Floats
    weight: Floats
    modes: Floats

    def gradient(self, part: slice) -> Floats:
        """Gradients of the shape functions of some elements, 1/mm; shape (n, 3 axes, 27 nodes, 27 points)."""
        n = len(self.weight[part])
        reference = _REFERENCE.transpose(2, 1, 0)  # (points, 3, nodes)
        return (self.inverse[part] @ reference[None]).transpose(0, 2, 3, 1).reshape(n, 3, NODES, -1)

    def part(self, elements: Ints) -> Quadrature:
        """The same for some of the elements."""
        return Quadrature(*(getattr(self, f.name)[elements] for f in fields(self)))

    @property
    def size(self) -> int:
        """Number of elements."""
        return len(self.weight)


def quadrature(nodes: Ints, points: Floats) -> Quadrature:
    """Prepare curved hexahedra: nodes (m, 27) of each, and where they are, (nodes, 3) mm."""
    place = points[nodes]
    # jacobian[q, a, b] = d x_a / d xi_b
    jacobian = np.einsum("mia,ibq->mqab", place, _REFERENCE, optimize=True)
    determinant = np.linalg.det(jacobian)
    weight = np.abs(determinant) * _WEIGHTS
    inverse = np.linalg.inv(jacobian).transpose(0, 1, 3, 2)
    at = np.einsum("mia,iq->maq", place, SHAPE, optimize=True)
    at = at - at.mean(axis=2, keepdims=True)
    at = at / np.abs(at).max(axis=2, keepdims=True)
    monomials = np.concatenate([np.ones((len(nodes), 1, at.shape[2])), at], axis=1)
    mass = (monomials * weight[:, None]) @ monomials.transpose(0, 2, 1)
    modes = np.linalg.solve(np.linalg.cholesky(mass), monomials)
    return Quadrature(nodes, np.ascontiguousarray(inverse), weight, modes)


def join(parts: list[Quadrature]) -> Quadrature:
    """All elements of several together."""
    return Quadrature(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(Quadrature)))
