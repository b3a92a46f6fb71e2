"""The press as one would write it with scikit-fem alone: quadratic tetrahedra and a general sparse solver.

`python tets.py METHOD ARC CORE ...` (the cells of a `Resolution`) prints one line of JSON: tared maximum (mm),
seconds with and without inclusion together, unknowns. Geometry, symmetry (a quarter), materials and the tie of
probe and slab along z are those of `fem.press(..., mechanics="linear")`; the tetrahedra are our hexahedra, each
split in six, curved alike, so that they are graded towards the inclusion as ours are.
"""

from __future__ import annotations

import json
import sys
import time
from itertools import permutations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import splu
from skfem import (
    Basis,
    BilinearForm,
    ElementHex2,
    ElementTetP0,
    ElementTetP1,
    ElementTetP2,
    ElementVector,
    MeshTet,
    MeshTet2,
    asm,
    condense,
    solve,
)
from skfem.helpers import ddot, div, sym_grad

import fem
from fem.mesh import Geometry
from fem.meshed import Model, build, moduli
from fem.topology import Resolution, materials, slab_topology

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
BALL = fem.Inclusion(10, 5, 100)
LEVEL_MM = 1.0
METHODS = ("P2", "P2 ordered", "P2/P1")


def split(model: Model) -> tuple[MeshTet2, Ints, Ints]:
    """Tetrahedra of the hexahedra: the mesh, the hexahedron of each, and the node of each of our nodes or -1.

    Each hexahedron is cut along paths from its first to its last corner (Kuhn). Our mesh mirrors left-handed
    hexahedra of the O-grid; here they go back, so that neighbours cut their common face alike.
    """
    lattice = np.round(2 * ElementHex2.doflocs).astype(int)
    number = {tuple(at): i for i, at in enumerate(lattice)}
    corners = []
    for order in permutations(range(3)):
        path = [np.zeros(3, dtype=int)]
        for axis in order:
            path.append(path[-1] + 2 * np.eye(3, dtype=int)[axis])
        corners.append(path)
    points = np.round(2 * ElementTetP2.doflocs).astype(int)  # barycentric, two halves
    share = np.hstack([2 - points.sum(axis=1, keepdims=True), points])
    places = np.einsum("pk,tkc->tpc", share, np.array(corners)) // 2
    flip = places.copy()
    flip[..., 0] = 2 - flip[..., 0]
    tables = [np.array([[number[tuple(at)] for at in tet] for tet in some]) for some in (places, flip)]

    slab, res = slab_topology(model.layout), model.layout.res
    middle = slab.p[:, slab.t].mean(axis=1)
    size = np.abs(middle)
    grid = (size.max(axis=0) > res.reach) | (size.max(axis=0) < res.arc)
    axis = size.argmax(axis=0)
    mirrored = np.zeros(len(model.nodes.cells), dtype=bool)
    sign = np.take_along_axis(middle, axis[None], axis=0)[0]
    mirrored[: len(axis)] = ~grid & ((axis == 1) ^ (sign < 0))

    cells = model.nodes.cells
    tets = np.where(mirrored[:, None, None], cells[:, tables[1]], cells[:, tables[0]]).reshape(-1, 10)
    used, t = np.unique(tets[:, :4], return_inverse=True)
    plain = MeshTet(np.ascontiguousarray(model.place[used].T), np.ascontiguousarray(t.reshape(-1, 4).T))
    plain = MeshTet(plain.p, plain.t, sort_t=False)
    mesh = MeshTet2.from_mesh(plain)
    dofs = mesh.dofs.element_dofs
    doflocs, ours = mesh.doflocs.copy(), np.full(len(model.place), -1)
    doflocs[:, dofs] = model.place[tets.T].transpose(2, 0, 1)
    ours[tets.T] = dofs
    return MeshTet2(doflocs, mesh.t, sort_t=False), np.repeat(np.arange(len(cells)), 6), ours


@BilinearForm
def shear_form(u, v, w):  # type: ignore[no-untyped-def]
    return 2 * w.mu * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def dilation_form(u, v, w):  # type: ignore[no-untyped-def]
    return w.first * div(u) * div(v)


@BilinearForm
def pressure_form(u, q, w):  # type: ignore[no-untyped-def]
    return -div(u) * q


@BilinearForm
def compliance_form(p, q, w):  # type: ignore[no-untyped-def]
    return -p * q / w.first


def once(method: str, model: Model, ball: bool) -> tuple[Floats, int]:
    """Displacements of the probe's contact nodes along z (mm), and the number of unknowns."""
    mesh, parent, ours = split(model)
    shear, bulk = moduli(model.geometry, model, ball)
    basis = Basis(mesh, ElementVector(ElementTetP2()), intorder=4)
    constant = basis.with_element(ElementTetP0())
    mu = constant.interpolate(shear[parent])
    first = constant.interpolate((bulk - 2 / 3 * shear)[parent])
    matrix = asm(shear_form, basis, mu=mu)

    # component k of our node n is unknown 3 n + k here, and so is it in scikit-fem's own numbering
    where = np.zeros((3, basis.N // 3), dtype=np.int64)
    for k in range(3):
        where[k, basis.dofs.element_dofs[k::3] // 3] = basis.dofs.element_dofs[k::3]
    element = mesh.dofs.element_dofs
    node = np.full((3, mesh.doflocs.shape[1]), -1)
    for k in range(3):
        node[k, element] = basis.dofs.element_dofs[k::3]
    of = node[:, ours]  # (3, our nodes), wrong where ours is -1
    nodes = model.nodes
    held = np.unique(np.concatenate([of[k, nodes.held[:, k] & (ours >= 0)] for k in range(3)]))

    if method == "P2/P1":
        pressures = basis.with_element(ElementTetP1())
        divergence = asm(pressure_form, basis, pressures)
        compliance = asm(compliance_form, pressures, first=first)
        matrix = sp.bmat([[matrix, divergence.T], [divergence, compliance]], format="csr")
    else:
        matrix = matrix + asm(dilation_form, basis, first=first)
    size = matrix.shape[0]

    tip, under = of[2, nodes.tip].ravel(), of[2, nodes.contact].ravel()
    there = ours[nodes.tip].ravel() >= 0
    master = np.arange(size)
    master[tip[there]] = under[there]
    tie = sp.csr_matrix((np.ones(size), (np.arange(size), master)), shape=(size, size))
    matrix = (tie.T @ matrix @ tie).tocsr()
    x = np.zeros(size)
    x[of[2, nodes.chest][ours[nodes.chest] >= 0]] = -LEVEL_MM
    fixed = np.union1d(held, np.setdiff1d(tip[there], held))
    system = condense(matrix, np.zeros(size), x=x, D=fixed)
    if method == "P2":
        solved = solve(*system)
    else:
        solved = solve(*system, solver=ordered)
    return (tie @ solved)[tip[there]], size - len(fixed)


def ordered(matrix: sp.csr_matrix, load: Floats) -> Floats:
    """SuperLU told that the matrix is symmetric."""
    factor = splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True}
    )
    return np.asarray(factor.solve(load))


def main() -> None:
    method, *cells = sys.argv[1:]
    res = Resolution(*map(int, cells))
    start = time.perf_counter()
    model = build(Geometry(PROBE, SLAB, BALL), res, finite=False)
    assert materials(model.layout).size == len(model.nodes.cells)
    (with_ball, unknowns), (without, _) = once(method, model, True), once(method, model, False)
    seconds = time.perf_counter() - start
    print(json.dumps({"max_mm": float((without - with_ball).max()), "seconds": seconds, "dof": unknowns}))


if __name__ == "__main__":
    main()
