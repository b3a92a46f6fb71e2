"""One linear press in a process of its own, by ours or as one would write it with scikit-fem alone.

`python lone_press.py METHOD CELLS` (the fields of a `Resolution` as JSON) prints one line of JSON: tared
maximum (mm), seconds with and without inclusion together, unknowns, and peak memory (GiB). METHOD is `ours`,
or one of scikit-fem with quadratic tetrahedra and SciPy's sparse LU (SuperLU):

    P2           displacements alone, scikit-fem's default solver
    P2 ordered   the same, SuperLU told that the matrix is symmetric
    P2/P1        Taylor and Hood's displacements and pressures, SuperLU told so too

Geometry, symmetry (a quarter), materials and the tie of probe and slab along z are those of `fem.press(...,
mechanics="linear")`; the tetrahedra are our hexahedra, each split in six, curved alike, so that they are
graded towards the inclusion as ours are.
"""

from __future__ import annotations

import json
import resource
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
from fem.mesh import QUALITIES, Geometry
from fem.meshed import Model, build, moduli
from fem.topology import Resolution, slab_topology

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
BALL = fem.Inclusion(10, 5, 100)
LEVEL_MM = 1.0
MEMORY_GIB = 12
"""What a press may take."""


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
def elastic(u, v, w):  # type: ignore[no-untyped-def]
    strain = sym_grad(u)
    return 2 * w.mu * ddot(strain, sym_grad(v)) + w.first * div(u) * div(v)


@BilinearForm
def shearing(u, v, w):  # type: ignore[no-untyped-def]
    return 2 * w.mu * ddot(sym_grad(u), sym_grad(v))


@BilinearForm
def coupling(u, q, w):  # type: ignore[no-untyped-def]
    return -div(u) * q


@BilinearForm
def compliance(p, q, w):  # type: ignore[no-untyped-def]
    return -p * q / w.first


class Peer:
    """All that does not depend on the inclusion's modulus; pressures (P2/P1) are continuous in each body."""

    def __init__(self, method: str, model: Model):
        self.method, self.model = method, model
        mesh, self.parent, ours = split(model)
        # order 2 is exact for straight tetrahedra; displacements alone lose 3 % more by it
        order = 2 if method == "P2/P1" else 4
        self.basis = Basis(mesh, ElementVector(ElementTetP2()), intorder=order)
        self.constant = self.basis.with_element(ElementTetP0())
        self.size = self.basis.N
        if method == "P2/P1":
            self.pressures = self.basis.with_element(ElementTetP1())
            self.divergence = asm(coupling, self.basis, self.pressures)
            self.size += self.pressures.N
        unknown = np.full((3, mesh.doflocs.shape[1]), -1)
        for k in range(3):
            unknown[k, mesh.dofs.element_dofs] = self.basis.dofs.element_dofs[k::3]
        assert (ours >= 0).all()  # every node of ours is one of theirs
        nodes, of = model.nodes, unknown[:, ours]
        self.tip, under = of[2, nodes.tip].ravel(), of[2, nodes.contact].ravel()
        master = np.arange(self.size)
        master[self.tip] = under
        ones = np.ones(self.size)
        self.tie = sp.csr_matrix((ones, (np.arange(self.size), master)), shape=(self.size, self.size))
        self.held = np.unique(np.concatenate([self.tip, *(of[k, nodes.held[:, k]] for k in range(3))]))
        self.moved = np.zeros(self.size)
        self.moved[of[2, nodes.chest]] = -LEVEL_MM

    def press(self, ball: bool) -> Floats:
        """Displacements of the probe's contact nodes along z, mm."""
        shear, bulk = moduli(self.model.geometry, self.model, ball)
        mu = self.constant.interpolate(shear[self.parent])
        first = self.constant.interpolate((bulk - 2 / 3 * shear)[self.parent])
        if self.method == "P2/P1":
            stiff, soft = asm(shearing, self.basis, mu=mu), asm(compliance, self.pressures, first=first)
            matrix = sp.bmat([[stiff, self.divergence.T], [self.divergence, soft]], format="csr")
        else:
            matrix = asm(elastic, self.basis, mu=mu, first=first)
        matrix = (self.tie.T @ matrix @ self.tie).tocsr()
        system = condense(matrix, np.zeros(self.size), x=self.moved, D=self.held)
        solved = solve(*system) if self.method == "P2" else solve(*system, solver=ordered)
        return np.asarray((self.tie @ solved)[self.tip])


def ordered(matrix: sp.csr_matrix, load: Floats) -> Floats:
    """SuperLU told that the matrix is symmetric."""
    factor = splu(
        matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=1e-3, options={"SymmetricMode": True}
    )
    return np.asarray(factor.solve(load))


def by_tetrahedra(method: str, res: Resolution) -> tuple[float, int]:
    """Tared maximum, mm, and unknowns."""
    model = build(Geometry(PROBE, SLAB, BALL), res, finite=False)
    peer = Peer(method, model)
    tared = peer.press(False) - peer.press(True)
    return float(tared.max()), int(peer.size) - len(peer.held)


def by_ours(res: Resolution) -> tuple[float, int]:
    """Tared maximum, mm, and unknowns."""
    QUALITIES["this"] = res
    answer = fem.press(PROBE, SLAB, BALL, LEVEL_MM, mechanics="linear", quality="this", estimate=False)
    return fem.scalars(answer.surface, 2.0)["tared"]["max_mm"], answer.dof


def main() -> None:
    method, cells = sys.argv[1:]
    told = json.loads(cells)
    res = Resolution(**told | {"growth": tuple(told["growth"])})
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_GIB << 30, MEMORY_GIB << 30))
    import fem.pressing  # noqa: F401  neither side's imports count

    start = time.perf_counter()
    found, unknowns = by_ours(res) if method == "ours" else by_tetrahedra(method, res)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(json.dumps({"max_mm": found, "seconds": seconds, "dof": unknowns, "GiB": peak}))


if __name__ == "__main__":
    main()
