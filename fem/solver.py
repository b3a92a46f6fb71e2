"""Direct solver for symmetric positive definite finite elements: nested dissection over the element tree.

The elements are halved again and again; on the way up, each union of two halves eliminates the unknowns that
no other element shares (multifrontal Cholesky: Duff and Reid 1983; [duff1983]). Element matrices go straight
into dense fronts, no global matrix is ever assembled. LAPACK does the work, so nothing but SciPy is needed.

Two habits make this the right solver here. A set of elements may be kept for the very top of the tree (the
inclusion): nothing below depends on their stiffness, so it is factored once for all moduli. And the order of
every sum is fixed by the tree, with single-threaded BLAS inside, so the bytes do not depend on the number of
threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack
from threadpoolctl import ThreadpoolController

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Array = NDArray[Any]  # of the fronts' precision
Precision = Literal["single", "double"]

_LAPACK = {
    "single": (lapack.spotrf, blas.strsm, blas.ssyrk),
    "double": (lapack.dpotrf, blas.dtrsm, blas.dsyrk),
}
_RESTARTS, _ITERATIONS = 6, 60  # of conjugate gradients
_LEAF = 6  # elements assembled into one front at the bottom of the tree
_controller: list[ThreadpoolController] = []


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold BLAS to one thread, so that its sums are always taken in the same order."""
    if not _controller:
        _controller.append(ThreadpoolController())
    with _controller[0].limit(limits=1, user_api="blas"):
        yield


@dataclass(frozen=True)
class Front:
    """A node of the tree: its pivots are eliminated here, its border is handed to the parent."""

    dofs: Ints  # numbers of elimination, rising: pivots first, then border
    pivots: int
    elements: Ints  # of a leaf, else empty
    local: tuple[Ints, ...]  # of a leaf: which local dofs of each element are unknowns
    children: tuple[int, ...]
    where: tuple[Ints, ...]  # position in `dofs` of each child's border, or of each element's unknowns
    volatile: bool  # depends on the elements kept for last


@dataclass(frozen=True)
class Tree:
    """Order of elimination; children come before their parents, the root last."""

    fronts: tuple[Front, ...]
    order: Ints  # number of elimination of each unknown, shape (unknowns,)
    dofs: Ints  # unknown of each local dof, -1 where prescribed, shape (elements, k)

    @property
    def size(self) -> int:
        return len(self.order)


def plan(dofs: Ints, centres: Floats, last: NDArray[np.bool_]) -> Tree:
    """Find the order of elimination; depends on the topology only.

    Parameters
    ----------
    dofs
        Unknown of each local dof, 0 ... n - 1, or -1 where it is prescribed; shape (elements, k).
    centres
        Positions that tell which elements lie together; shape (elements, 3).
    last
        True for the elements whose stiffness will change; shape (elements,).
    """
    total = np.bincount(dofs[dofs >= 0])
    sets: list[tuple[Ints, Ints]] = []  # elements, children of each front
    pivots: list[Ints] = []
    borders: list[Ints] = []

    def add(elements: Ints, children: tuple[int, ...]) -> tuple[int, Ints, Ints]:
        if children:
            known = np.concatenate([seen[c][0] for c in children])
            times = np.concatenate([seen[c][1] for c in children])
            unique, inverse = np.unique(known, return_inverse=True)
            count = np.bincount(inverse, weights=times).astype(np.int64)
        else:
            mine = dofs[elements]
            unique, count = np.unique(mine[mine >= 0], return_counts=True)
        done = count == total[unique]
        sets.append((elements, np.array(children, dtype=np.int64)))
        pivots.append(unique[done])
        borders.append(unique[~done])
        seen.append((unique[~done], count[~done]))
        return len(sets) - 1, unique, count

    seen: list[tuple[Ints, Ints]] = []

    def grow(elements: Ints) -> int:
        if len(elements) <= _LEAF:
            return add(elements, ())[0]
        halves = [grow(half) for half in _halve(elements, dofs, centres)]
        return add(elements[:0], tuple(halves))[0]

    parts = [np.flatnonzero(~last), np.flatnonzero(last)]
    trunks = [grow(part) for part in parts if len(part)]
    if len(trunks) > 1:
        add(np.empty(0, dtype=np.int64), tuple(trunks))

    order = np.empty(len(total), dtype=np.int64)
    order[np.concatenate(pivots)] = np.arange(len(total))
    fronts: list[Front] = []
    for (elements, children), own, border in zip(sets, pivots, borders, strict=True):
        numbers = np.concatenate([np.sort(order[own]), np.sort(order[border])])
        local = tuple(np.flatnonzero(dofs[e] >= 0) for e in elements)
        inner = [order[dofs[e][k]] for e, k in zip(elements, local, strict=True)]
        inner += [fronts[c].dofs[fronts[c].pivots :] for c in children]
        changing = bool(last[elements].any()) or any(fronts[c].volatile for c in children)
        where = tuple(np.searchsorted(numbers, i) for i in inner)
        fronts.append(Front(numbers, len(own), elements, local, tuple(children), where, changing))
    return Tree(tuple(fronts), order, dofs)


def _halve(elements: Ints, dofs: Ints, centres: Floats) -> list[Ints]:
    """Cut at the plane near the middle that the fewest unknowns cross."""
    best: tuple[float, list[Ints]] | None = None
    for axis in range(3):
        place = centres[elements, axis]
        rising = np.argsort(place, kind="stable")
        steps = np.flatnonzero(np.diff(place[rising]) > 1e-6) + 1
        if not len(steps):
            continue
        cut = steps[np.argmin(np.abs(steps - len(elements) / 2))]
        halves = [elements[rising[:cut]], elements[rising[cut:]]]
        shared = np.intersect1d(dofs[halves[0]], dofs[halves[1]]).size
        skew = max(cut, len(elements) - cut) / len(elements)
        cost = shared * (0.5 + skew)
        if best is None or cost < best[0]:
            best = cost, halves
    if best is None:  # all in one place: any cut will do
        return [elements[: len(elements) // 2], elements[len(elements) // 2 :]]
    return best[1]


class Factor:
    """Cholesky factor of the sum of element matrices.

    Parameters
    ----------
    tree
        From `plan`.
    matrices
        Symmetric element matrices, shape (elements, k, k).
    base
        A factor of the same tree whose matrices differ only in the elements kept for last: all the rest is
        shared.
    progress
        Called with the fraction done.
    precision
        Of the fronts. "single" takes half the time and memory, and `solve` makes up for the digits by
        conjugate gradients; a matrix that is not positive definite in single precision is factored in double.

    Attributes
    ----------
    precision
        The one that was used.

    Raises
    ------
    LinAlgError
        If the matrix is not positive definite in double precision.
    """

    def __init__(
        self,
        tree: Tree,
        matrices: Floats,
        base: Factor | None = None,
        progress: Callable[[float], None] | None = None,
        precision: Precision = "single",
    ):
        self.tree, self.matrices = tree, matrices
        self.precision: Precision = precision if base is None else base.precision
        try:
            self._factorise(base, progress)
        except np.linalg.LinAlgError:
            if self.precision == "double":
                raise
            self.precision = "double"
            self._factorise(None, progress)

    def _factorise(self, base: Factor | None, progress: Callable[[float], None] | None) -> None:
        tree = self.tree
        self._lower: list[tuple[Array, Array]] = []  # L11 (p, p) and L21 (b, p) of each front
        self._stay: dict[int, Array] = {}  # what unchanging fronts hand to changing ones
        pending: dict[int, Array] = {}
        work = np.cumsum([float(len(f.dofs)) ** 2 * f.pivots for f in tree.fronts])
        parent_changes = {c for f in tree.fronts if f.volatile for c in f.children}
        with one_thread():
            for i, front in enumerate(tree.fronts):
                if base is not None and not front.volatile:
                    self._lower.append(base._lower[i])
                    if i in parent_changes:
                        self._stay[i] = base._stay[i]
                    continue
                rest = self._eliminate(front, pending)
                if i in parent_changes and not front.volatile:
                    self._stay[i] = rest
                else:
                    pending[i] = rest
                if progress is not None:
                    progress(float(work[i] / work[-1]))

    def _eliminate(self, front: Front, pending: dict[int, Array]) -> Array:
        kind = np.dtype(np.float32 if self.precision == "single" else np.float64)
        potrf, trsm, syrk = _LAPACK[self.precision]
        p, b = front.pivots, len(front.dofs) - front.pivots
        a11, a21, a22 = (np.zeros(shape, kind, order="F") for shape in ((p, p), (b, p), (b, b)))
        if len(front.elements):
            blocks = [
                self.matrices[e][np.ix_(k, k)] for e, k in zip(front.elements, front.local, strict=True)
            ]
        else:
            blocks = [self._stay[c] if c in self._stay else pending.pop(c) for c in front.children]
        for block, where in zip(blocks, front.where, strict=True):
            if len(front.elements):  # an element's unknowns come in any order
                rank = np.argsort(where)
                block, where = block[np.ix_(rank, rank)], where[rank]
            cut = int(np.searchsorted(where, p))
            low, high = where[:cut], where[cut:] - p
            # transposed views are C-contiguous, which is what fancy indexing likes
            a11.T[np.ix_(low, low)] += block[:cut, :cut].T
            a21.T[np.ix_(low, high)] += block[cut:, :cut].T
            a22.T[np.ix_(high, high)] += block[cut:, cut:].T
        if p == 0:
            self._lower.append((a11, a21))
            return a22
        l11, info = potrf(a11, lower=1, clean=0, overwrite_a=1)
        if info != 0:
            raise np.linalg.LinAlgError(
                f"stiffness is not positive definite (pivot {info} of a front of {p})"
            )
        if b == 0:
            self._lower.append((l11, a21))
            return a22
        l21 = trsm(1.0, l11, a21, side=1, lower=1, trans_a=1, overwrite_b=1)
        self._lower.append((l11, l21))
        return np.asarray(syrk(-1.0, l21, beta=1.0, c=a22, lower=1, overwrite_c=1))

    def solve(self, load: Floats, tolerance: float = 1e-13) -> Floats:
        """Unknowns for a load, both shape (unknowns,), to a residual of `tolerance` times the load.

        Conjugate gradients in double precision, preconditioned by the factor (two or three iterations with
        double fronts, a handful with single ones). Where single fronts are too coarse to converge, the factor
        is made again in double. Where rounding keeps the residual above `tolerance`, it stops at that floor.
        """
        with one_thread():
            x, good = self._iterate(load, tolerance)
            if not good and self.precision == "single":
                self.precision = "double"
                self._factorise(None, None)
                x, good = self._iterate(load, tolerance)
            return x

    def _iterate(self, load: Floats, tolerance: float) -> tuple[Floats, bool]:
        """Conjugate gradients, and whether they converged (or came to rest at rounding)."""
        x, residual = np.zeros_like(load), load
        size = reached = float(np.linalg.norm(load))
        for _ in range(_RESTARTS):  # the recursion drifts by rounding: only the true residual counts
            if not reached > tolerance * size:
                break
            step = self._cycle(residual, max(1e-8 * reached, tolerance * size))
            if step is None:
                return x, False
            residual = load - apply(self.tree, self.matrices, x + step)
            before, reached = reached, float(np.linalg.norm(residual))
            if reached < before:
                x = x + step
            if reached > 0.1 * before:
                break
        return x, True

    def _cycle(self, load: Floats, target: float) -> Floats | None:
        """Conjugate gradients from zero to a residual of `target`; None if they do not get there."""
        x, residual = np.zeros_like(load), load.copy()
        z = direction = self.precondition(residual)
        energy = float(residual @ z)
        for _ in range(_ITERATIONS):
            push = apply(self.tree, self.matrices, direction)
            length = energy / float(direction @ push)
            x += length * direction
            residual -= length * push
            if np.linalg.norm(residual) <= target:
                return x
            z = self.precondition(residual)
            energy, before = float(residual @ z), energy
            direction = z + (energy / before) * direction
        return None

    def precondition(self, load: Floats) -> Floats:
        """One substitution: the unknowns for a load as good as the fronts' precision; both (unknowns,)."""
        kind = np.float32 if self.precision == "single" else np.float64
        trsv = blas.strsv if self.precision == "single" else blas.dtrsv
        # a power of two, so that scaling is exact and single precision neither over- nor underflows
        scale = 2.0 ** np.frexp(np.abs(load).max())[1]
        x = np.empty(self.tree.size, kind)
        x[self.tree.order] = load / scale
        for front, (l11, l21) in zip(self.tree.fronts, self._lower, strict=True):
            p = front.pivots
            if p:
                x[front.dofs[:p]] = y = trsv(l11, x[front.dofs[:p]], lower=1)
                x[front.dofs[p:]] = x[front.dofs[p:]] - l21 @ y
        for front, (l11, l21) in zip(reversed(self.tree.fronts), reversed(self._lower), strict=True):
            p = front.pivots
            if p:
                y = x[front.dofs[:p]] - l21.T @ x[front.dofs[p:]]
                x[front.dofs[:p]] = trsv(l11, y, lower=1, trans=1)
        return x[self.tree.order].astype(np.float64) * scale


def apply(tree: Tree, matrices: Floats, x: Floats) -> Floats:
    """Product of the (never assembled) matrix and x; both shape (unknowns,)."""
    local = np.append(x, 0.0)[tree.dofs]
    force = (matrices @ local[:, :, None])[:, :, 0]
    free = tree.dofs >= 0
    return np.asarray(np.bincount(tree.dofs[free], weights=force[free], minlength=tree.size), dtype=float)
