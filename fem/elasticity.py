"""Stiffness of the 27-node hexahedron that does not lock: quadratic displacement, discontinuous linear
pressure.

The volumetric stress is sought element by element among 1, x, y, z and condensed out, which leaves a
symmetric positive definite stiffness in the displacements alone, at any Poisson's ratio below 1/2 (the stable
Q2/P1 pair: Boffi, Brezzi and Fortin 2013, section 8.6; [boffi2013]).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from skfem import Basis, ElementHex2, MappingIsoparametric, MeshHex2

Floats = NDArray[np.float64]

NODES = 27
DOFS = 81  # local dof = 3 * node + axis
_CHUNK = 512  # elements at a time: keeps the temporaries in tens of megabytes


def basis(mesh: MeshHex2, elements: NDArray[np.int64] | None = None) -> Basis:
    """Scalar Q2 basis on curved elements with 27 quadrature points (the default would be 343)."""
    element = ElementHex2()
    return Basis(mesh, element, MappingIsoparametric(mesh, element), intorder=4, elements=elements)


def element_dofs(mesh: MeshHex2) -> NDArray[np.int64]:
    """Dofs 3 * node + axis of each element; shape (elements, 81)."""
    nodes = mesh.dofs.element_dofs.T.astype(np.int64)
    return np.asarray((3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), DOFS))


def lame(modulus: Floats, poisson: Floats) -> tuple[Floats, Floats]:
    """Shear and bulk modulus from Young's modulus and Poisson's ratio; all shape (n,), kPa."""
    return modulus / (2 * (1 + poisson)), modulus / (3 * (1 - 2 * poisson))


def stiffness(
    mesh: MeshHex2, modulus: Floats, poisson: Floats, elements: NDArray[np.int64] | None = None
) -> Floats:
    """Element stiffness matrices.

    Parameters
    ----------
    mesh
        Curved hexahedra, mm.
    modulus, poisson
        Young's modulus (kPa) and Poisson's ratio of each of the elements asked for, shape (n,).
    elements
        Which elements, shape (n,); all of them by default.

    Returns
    -------
    (n, 81, 81) array, kPa mm = mN / mm, local dof = 3 * node + axis, symmetric, positive semidefinite.
    """
    chosen = np.arange(mesh.t.shape[1]) if elements is None else elements
    shear, bulk = lame(modulus, poisson)
    out = np.empty((len(chosen), DOFS, DOFS))
    for start in range(0, len(chosen), _CHUNK):
        part = slice(start, start + _CHUNK)
        _stiffness(basis(mesh, chosen[part]), shear[part], bulk[part], out[part])
    return out


def _stiffness(q2: Basis, shear: Floats, bulk: Floats, out: Floats) -> None:
    n, points = q2.dx.shape
    gradient = np.empty((n, NODES, 3, points))  # dN_i/dx_a
    for i in range(NODES):
        gradient[:, i] = q2.basis[i][0].grad.transpose(1, 0, 2)
    flat = gradient.reshape(n, DOFS, points)

    # deviatoric part: 2 mu (e_ij e_ij - div^2 / 3), from the one Gram matrix of all derivatives
    root = np.sqrt(q2.dx * shear[:, None])[:, None, :]
    weighted = flat * root
    gram = (weighted @ weighted.transpose(0, 2, 1)).reshape(n, NODES, 3, NODES, 3)
    deviatoric = gram.transpose(0, 1, 4, 3, 2) - (2 / 3) * gram
    trace = np.einsum("niaja->nij", gram)
    for a in range(3):
        deviatoric[:, :, a, :, a] += trace

    # volumetric part: bulk * B^T M^-1 B with B = int q_k div u, M = int q_k q_l, q = (1, x, y, z) about the
    # middle
    place = np.asarray(q2.global_coordinates())  # (3, n, points)
    place = place - place.mean(axis=2, keepdims=True)
    place = place / np.abs(place).max(axis=2, keepdims=True)
    q = np.concatenate([np.ones((1, n, points)), place]).transpose(1, 0, 2)
    weighted_q = q * q2.dx[:, None, :]
    mass = weighted_q @ q.transpose(0, 2, 1)
    # B is divided by M's Cholesky factor, so that the product is symmetric to the last bit
    coupling = np.linalg.solve(np.linalg.cholesky(mass), weighted_q @ flat.transpose(0, 2, 1))
    coupling *= np.sqrt(bulk)[:, None, None]
    out[:] = deviatoric.reshape(n, DOFS, DOFS) + coupling.transpose(0, 2, 1) @ coupling
