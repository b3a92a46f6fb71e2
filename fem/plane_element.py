"""Stiffness of the nine-node quadrilateral that does not lock, in plane strain and axisymmetry.

The plane relative of `fem.elasticity`: quadratic displacement, and the volumetric stress sought element by
element among 1, x, z and condensed out (the stable Q2/P1 pair: Boffi, Brezzi and Fortin 2013, section 8.6;
[boffi2013]). Both kinds use the three-dimensional law with the strains (xx, zz, yy, 2 xz); yy is 0 in plane
strain and the hoop strain u_x / x in axisymmetry (Hughes 2000, section 2.12; [hughes2000]).
"""

from __future__ import annotations

from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve_banded, cholesky_banded
from scipy.sparse import coo_array
from scipy.sparse.csgraph import reverse_cuthill_mckee
from skfem import Basis, ElementQuad2, MappingIsoparametric, MeshQuad2

from fem.elasticity import lame

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Kind = Literal["plane_strain", "axisymmetric"]

KINDS: tuple[Kind, ...] = get_args(Kind)
NODES = 9
DOFS = 18  # local dof = 2 * node + axis


def basis(mesh: MeshQuad2, elements: Ints | None = None) -> Basis:
    """Scalar Q2 basis on curved elements with nine quadrature points."""
    element = ElementQuad2()
    return Basis(mesh, element, MappingIsoparametric(mesh, element), intorder=5, elements=elements)


def element_dofs(mesh: MeshQuad2) -> Ints:
    """Dofs 2 * node + axis of each element; shape (elements, 18)."""
    nodes = mesh.dofs.element_dofs.T.astype(np.int64)
    return np.asarray((2 * nodes[:, :, None] + np.arange(2)).reshape(len(nodes), DOFS))


def weights(q2: Basis, kind: Kind) -> Floats:
    """Volume of each quadrature point: mm³ per mm of width, or mm³ of the whole ring; (elements, points)."""
    if kind == "plane_strain":
        return np.asarray(q2.dx)
    return np.asarray(2 * np.pi * np.asarray(q2.global_coordinates())[0] * q2.dx)


def strains(q2: Basis, kind: Kind) -> Floats:
    """Strains xx, zz, yy and 2 xz of each local dof; shape (elements, 4, 18, points), 1 / mm."""
    n, points = q2.dx.shape
    out = np.zeros((n, 4, NODES, 2, points))
    radius = np.asarray(q2.global_coordinates())[0]
    for i in range(NODES):
        out[:, 0, i, 0] = out[:, 3, i, 1] = q2.basis[i][0].grad[0]
        out[:, 1, i, 1] = out[:, 3, i, 0] = q2.basis[i][0].grad[1]
        if kind == "axisymmetric":
            out[:, 2, i, 0] = np.asarray(q2.basis[i][0]) / radius
    return out.reshape(n, 4, DOFS, points)


def stiffness(
    mesh: MeshQuad2, modulus: Floats, poisson: Floats, kind: Kind, elements: Ints | None = None
) -> Floats:
    """Element stiffness matrices.

    Parameters
    ----------
    mesh
        Curved quadrilaterals, mm; x >= 0 where axisymmetric.
    modulus, poisson
        Young's modulus (kPa) and Poisson's ratio of each of the elements asked for, shape (n,).
    kind
        "plane_strain" or "axisymmetric".
    elements
        Which elements, shape (n,); all of them by default.

    Returns
    -------
    (n, 18, 18) array, local dof = 2 * node + axis, symmetric, positive semidefinite; kPa = mN / mm per mm of
    width in plane strain, kPa mm = mN / mm of the whole ring in axisymmetry.
    """
    q2 = basis(mesh, elements)
    strain, volume = strains(q2, kind), weights(q2, kind)
    shear, bulk = lame(modulus, poisson)
    n, points = volume.shape
    trace = strain[:, 0] + strain[:, 1] + strain[:, 2]

    # deviatoric part: 2 mu (e_ij e_ij - tr² / 3), as the square of the strain's deviator
    deviator = strain.copy()
    deviator[:, :3] -= trace[:, None] / 3
    deviator[:, 3] *= np.sqrt(0.5)
    deviator *= np.sqrt(2 * shear[:, None] * volume)[:, None, None]
    flat = deviator.transpose(0, 2, 1, 3).reshape(n, DOFS, 4 * points)

    # volumetric part: bulk * B^T M^-1 B with B = int q_k div u, M = int q_k q_l, q = (1, x, z) about the
    # middle
    place = np.asarray(q2.global_coordinates())
    place = place - place.mean(axis=2, keepdims=True)
    place = place / np.abs(place).max(axis=2, keepdims=True)
    q = np.concatenate([np.ones((1, n, points)), place]).transpose(1, 0, 2)
    weighted = q * volume[:, None]
    mass = weighted @ q.transpose(0, 2, 1)
    coupling = np.linalg.solve(np.linalg.cholesky(mass), weighted @ trace.transpose(0, 2, 1))
    coupling *= np.sqrt(bulk)[:, None, None]
    return np.asarray(flat @ flat.transpose(0, 2, 1) + coupling.transpose(0, 2, 1) @ coupling)


class Banded:
    """Cholesky factor of the assembled stiffness, its unknowns in an order that keeps the band narrow.

    Parameters
    ----------
    matrices
        Element stiffness, shape (n, 18, 18).
    dofs
        Unknown 0 ... of each local dof, -1 where held; shape (n, 18).

    Raises
    ------
    numpy.linalg.LinAlgError
        If the stiffness is not positive definite.
    """

    def __init__(self, matrices: Floats, dofs: Ints) -> None:
        size = int(dofs.max()) + 1
        row = np.broadcast_to(dofs[:, :, None], matrices.shape).ravel()
        column = np.broadcast_to(dofs[:, None, :], matrices.shape).ravel()
        free = (row >= 0) & (column >= 0)
        row, column, value = row[free], column[free], matrices.ravel()[free]
        pattern = coo_array((np.ones(len(row)), (row, column)), shape=(size, size)).tocsr()
        self.order = reverse_cuthill_mckee(pattern, symmetric_mode=True)
        place = np.empty(size, dtype=np.int64)
        place[self.order] = np.arange(size)
        row, column = place[row], place[column]
        below = row >= column
        row, column, value = row[below], column[below], value[below]
        width = int((row - column).max()) + 1
        flat = np.bincount((row - column) * size + column, weights=value, minlength=width * size)
        self.factor = cholesky_banded(flat.reshape(width, size), lower=True, check_finite=False)

    def solve(self, load: Floats) -> Floats:
        """Unknowns for loads, both shape (unknowns,) or (unknowns, loads)."""
        out = np.empty_like(load)
        out[self.order] = cho_solve_banded((self.factor, True), load[self.order], check_finite=False)
        return out
