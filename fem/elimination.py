"""Elimination in the fronts of a multifrontal solver: the numbers of `fem.fronts`.

On the way up the tree, each front sums its element matrices or what its children left, eliminates its pivots,
stores its panels of the factor and leaves the rest to its parent (Duff and Reid 1983; [duff1983]). Only lower
halves are right. Of each panel of pivots are stored W = L11^-1 and -L21 W, one below the other, so that each
substitution is one product.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import blas, lapack

from fem.fronts import Front, Tree

Ints = NDArray[np.int64]
Array = NDArray[Any]  # single or double
Blocks = tuple[Array, Array, Array]  # A11 (p, p), A21 (b, p), A22 (b, b), in Fortran's order

_LAPACK = {
    np.dtype(np.float32): (lapack.spotrf, lapack.strtri, blas.strsm, blas.ssyrk),
    np.dtype(np.float64): (lapack.dpotrf, lapack.dtrtri, blas.dtrsm, blas.dsyrk),
}
_CHUNK = 128  # element matrices made at a time
_LARGE = 1 << 19  # entries of what is worth its own memory


def factorise(
    tree: Tree,
    matrices: Array | Callable[[Ints], Array],
    panels: list[Array],
    progress: Callable[[float], None] | None = None,
) -> None:
    """Fill the panels of the factor.

    Parameters
    ----------
    matrices
        Symmetric element matrices (elements, k, k), or a function that makes some of them.
    panels
        From `room`: zeros to be filled.

    Raises
    ------
    LinAlgError
        If the matrix is not positive definite.
    """
    work = np.cumsum([1.0 + float(front.size) ** 2 * front.pivots for front in tree.fronts])
    leaves = _leaves(matrices, [front.elements for front in tree.fronts if len(front.elements)])
    memory = _Memory(tree, panels[0].dtype)
    for i, (front, done) in enumerate(zip(tree.fronts, work / work[-1:], strict=True)):
        blocks = memory.front(i)
        if len(front.elements):
            _assemble(front, next(leaves), *blocks)
        for c, runs in zip(front.children, front.runs, strict=True):
            _add(memory.left[c], runs, front.pivots, *blocks)
        memory.drop(front.children)
        rest = _eliminate(front, panels, *blocks)
        memory.left[i] = rest
        del blocks, rest  # before the next front asks for room
        if progress is not None:
            progress(float(done))


def room(tree: Tree, kind: np.dtype[Any]) -> list[Array]:
    """Zeros for the panels of each batch, (panels, rows, width), all of a piece."""
    shapes = [(*batch.rows.shape, batch.width) for batch in tree.batches]
    ends = np.cumsum([int(np.prod(shape)) for shape in shapes])
    parts = np.split(np.zeros(ends[-1], kind), ends[:-1])
    return [part.reshape(shape) for part, shape in zip(parts, shapes, strict=True)]


def _leaves(matrices: Array | Callable[[Ints], Array], leaves: list[Ints]) -> Iterator[Array]:
    """Element matrices of each leaf."""
    if not callable(matrices):
        for elements in leaves:
            yield matrices[elements]
        return
    ends = np.cumsum([len(e) for e in leaves])
    for turn in np.split(np.arange(len(leaves)), np.flatnonzero(np.diff(ends // _CHUNK)) + 1):
        made = matrices(np.concatenate([leaves[i] for i in turn]))
        yield from np.split(made, np.cumsum([len(leaves[i]) for i in turn])[:-1])


def _assemble(front: Front, blocks: Array, a11: Array, a21: Array, a22: Array) -> None:
    """Sum the element matrices of a leaf."""
    p, side = front.pivots, front.size + 1  # one more row for prescribed dofs
    whole = np.zeros(side * side, a11.dtype)
    where = front.place[:, :, None] * side + front.place[:, None, :]
    np.add.at(whole, where.ravel(), blocks.astype(a11.dtype, copy=False).ravel())
    whole = whole.reshape(side, side)[:-1, :-1].T
    a11[...], a21[...], a22[...] = whole[:p, :p], whole[p:, :p], whole[p:, p:]


def _add(
    block: Array, runs: tuple[tuple[int, int, int], ...], p: int, a11: Array, a21: Array, a22: Array
) -> None:
    """Add the lower half of what a child left to a front of p pivots."""
    for j, (sj, tj, nj) in enumerate(runs):
        for si, ti, ni in runs[j:]:
            if tj >= p:
                target = a22[ti - p : ti - p + ni, tj - p : tj - p + nj]
            elif ti >= p:
                target = a21[ti - p : ti - p + ni, tj : tj + nj]
            else:
                target = a11[ti : ti + ni, tj : tj + nj]
            target += block[si : si + ni, sj : sj + nj]


def _eliminate(front: Front, panels: list[Array], a11: Array, a21: Array, a22: Array) -> Array:
    """Store the front's panels; return what is left for its parent."""
    potrf, trtri, trsm, syrk = _LAPACK[a11.dtype]
    p, b = front.pivots, len(front.border)
    if p == 0:
        return a22
    l11, info = potrf(a11, lower=1, clean=1, overwrite_a=1)
    if info != 0:
        raise np.linalg.LinAlgError(f"stiffness is not positive definite (pivot {info} of a front of {p})")
    l21, rest = a21, a22
    if b:
        l21 = trsm(1.0, l11, a21, side=1, lower=1, trans_a=1, overwrite_b=1)
        rest = syrk(-1.0, l21, beta=1.0, c=a22, lower=1, overwrite_c=1)
    for batch, slot, low, high in front.panels:
        panel, n = panels[batch][slot], high - low
        inverse = trtri(l11[low:high, low:high], lower=1)[0]
        panel[:n, :n] = inverse
        np.negative(inverse, out=inverse)
        top = panel.shape[1]  # where the filling of the pivots ends
        if high < p:
            top = n + p - high
            np.matmul(l11[high:, low:high], inverse, out=panel[n:top, :n])
        np.matmul(l21[:, low:high], inverse, out=panel[top : top + b, :n])
    return np.asarray(rest)


class _Memory:
    """Room for the fronts at hand. What small ones use is used again: fresh memory from the system costs more
    than the sums in it. Large ones get their own, and give it back.

    What small children leave lies on two stacks in turn, by depth, which grow from the two ends of one array:
    a front takes its room on one while its children are on top of the other.
    """

    def __init__(self, tree: Tree, kind: np.dtype[Any]):
        self.tree = tree
        self.left: dict[int, Array] = {}
        depth = np.zeros(len(tree.fronts), dtype=np.int64)
        for i in range(len(tree.fronts) - 1, -1, -1):
            for c in tree.fronts[i].children:
                depth[c] = depth[i] + 1
        self.side = depth % 2
        self.top, most, panel = [0, 0], 0, 0
        for i, front in enumerate(tree.fronts):
            p, f = front.pivots, front.size
            panel = max(panel, p * f if p * f <= _LARGE else 0)
            self.top[self.side[i]] += self._need(i)
            most = max(most, sum(self.top))
            self.drop(front.children)
        self.stack: Array = np.empty(most, kind)
        self.panel: Array = np.empty(panel, kind)

    def _need(self, i: int) -> int:
        """Room on the stacks for what a front leaves."""
        square = len(self.tree.fronts[i].border) ** 2
        return square if square <= _LARGE else 0

    def front(self, i: int) -> Blocks:
        """A11 (p, p), A21 (b, p), A22 (b, b) of a front, zero."""
        p, b, need = self.tree.fronts[i].pivots, len(self.tree.fronts[i].border), self._need(i)
        large = p * (p + b) > _LARGE
        panel = np.empty(p * (p + b), self.panel.dtype) if large else self.panel[: p * (p + b)]
        panel[:] = 0
        if need or not b:
            low = self.top[0] if self.side[i] == 0 else len(self.stack) - self.top[1] - need
            rest = self.stack[low : low + need]
            rest[:] = 0
        else:
            rest = np.zeros(b * b, self.panel.dtype)
        self.top[self.side[i]] += need
        a11, a21 = panel[: p * p], panel[p * p :]
        return a11.reshape(p, p, order="F"), a21.reshape(b, p, order="F"), rest.reshape(b, b, order="F")

    def drop(self, fronts: tuple[int, ...]) -> None:
        """Give back the room of what fronts left, those on top of their stack first."""
        for i in fronts:
            self.top[self.side[i]] -= self._need(i)
            self.left.pop(i, None)
