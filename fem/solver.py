"""Direct solver for symmetric positive definite finite elements: Cholesky factor and conjugate gradients.

`fem.dissection` finds the order of elimination, `fem.fronts` works out all that depends on the topology,
`fem.elimination` does the sums. Element matrices go straight into dense fronts, no global matrix is ever
assembled. LAPACK does the work, so nothing but SciPy is needed.

Three habits make this the right solver here. The fronts are in single precision, which halves time and
memory, and conjugate gradients make up for the digits. They also let one factor serve other matrices, such as
those of another inclusion. And the order of every sum is fixed by the tree, with single-threaded BLAS inside,
so the bytes do not depend on the number of threads.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

from fem import heap
from fem.elimination import factorise, room
from fem.fronts import Tree, plan

__all__ = ["Factor", "Tree", "apply", "one_thread", "plan"]

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Array = NDArray[Any]  # of the fronts' precision
Precision = Literal["single", "double"]


@runtime_checkable
class Operator(Protocol):
    """Element matrices that also know a better way to their products."""

    def __call__(self, elements: Ints) -> NDArray[np.floating]:
        """Matrices of some elements, (n, k, k)."""

    def times(self, local: Floats) -> Floats:
        """Products of all with unknowns (elements, k)."""


Matrices = NDArray[np.floating] | Callable[[Ints], NDArray[np.floating]] | Operator

_KIND: dict[str, np.dtype[Any]] = {"single": np.dtype(np.float32), "double": np.dtype(np.float64)}
_RESTARTS, _ITERATIONS = 6, 60  # of conjugate gradients
_CHUNK = 128  # element matrices made, or made double, at a time
_controller: list[ThreadpoolController] = []


@contextmanager
def one_thread() -> Iterator[None]:
    """Hold BLAS to one thread, so that its sums are always taken in the same order."""
    heap.keep()
    if not _controller:
        _controller.append(ThreadpoolController())
    with _controller[0].limit(limits=1, user_api="blas"):
        yield


class Factor:
    """Cholesky factor of the sum of element matrices.

    Parameters
    ----------
    tree
        From `plan`.
    matrices
        Symmetric element matrices, shape (elements, k, k), of single or double precision; or a function that
        makes them for the elements asked for (n,), so that they never exist all at once.
    progress
        Called with the fraction done.
    precision
        Of the fronts. "single" takes half the time and memory, and `solve` makes up for the digits by
        conjugate gradients; a matrix that is not positive definite in single precision is factored in double.
    again
        False: such a matrix is an error.

    Attributes
    ----------
    precision
        The one that was used.

    Raises
    ------
    LinAlgError
        If the matrix is not positive definite in double precision, or not in the one asked for.
    """

    def __init__(
        self,
        tree: Tree,
        matrices: Matrices,
        progress: Callable[[float], None] | None = None,
        precision: Precision = "single",
        again: bool = True,
    ):
        self.tree = tree
        self.matrices: Any = matrices
        self.precision: Precision = precision
        broken = False
        try:
            self._factorise(progress)
        except np.linalg.LinAlgError:
            if self.precision == "double" or not again:
                raise
            broken = True
        if broken:
            self.precision = "double"
            self._factorise(progress)

    def _factorise(self, progress: Callable[[float], None] | None) -> None:
        self._panels: list[Array] = []  # lets go of those of another precision
        heap.trim()  # the factor comes in pieces of its own, not from what was freed
        self._panels = room(self.tree, _KIND[self.precision])
        with one_thread():
            factorise(self.tree, self.matrices, self._panels, progress)

    def bare(self) -> Factor:
        """Let go of the matrices, for one that is to `precondition` only."""
        self.matrices = None
        return self

    def solve(self, load: Floats, tolerance: float = 1e-13, matrices: Matrices | None = None) -> Floats:
        """Unknowns for a load, both shape (unknowns,), to a residual of `tolerance` times the load.

        Conjugate gradients in double precision, preconditioned by the factor (two or three iterations with
        double fronts, a handful with single ones). Where the factor is too coarse for them to converge, it is
        made again in double. Where rounding keeps the residual above `tolerance`, it stops at that floor.

        matrices
            Solve for these element matrices instead. A factor with an inclusion of the geometric mean of two
            moduli 20 apart serves both in a dozen iterations, which is faster than another factor. Where they
            are too different to converge, a factor of their own is made.
        """
        with one_thread():
            x = self._iterate(load, tolerance, self.matrices if matrices is None else matrices)
            if x is None and matrices is not None:
                return Factor(self.tree, matrices, precision=self.precision).solve(load, tolerance)
            if x is None:
                self.precision = "double"
                self._factorise(None)
                x = self._iterate(load, tolerance, self.matrices)
            if x is None:
                raise np.linalg.LinAlgError("stiffness is too close to singular to solve with")
            return x

    def _iterate(self, load: Floats, tolerance: float, matrices: Matrices) -> Floats | None:
        """Solve by conjugate gradients, down to rounding at most; None if they do not converge."""
        x, residual = np.zeros_like(load), load
        size = reached = float(np.linalg.norm(load))
        if not np.isfinite(size):
            return np.full_like(load, np.nan)
        for _ in range(_RESTARTS):  # the recursion drifts by rounding: only the true residual counts
            if not reached > tolerance * size:
                break
            step = self._cycle(residual, max(1e-8 * reached, tolerance * size), matrices)
            if step is None:
                return None
            residual = load - apply(self.tree, matrices, x + step)
            before, reached = reached, float(np.linalg.norm(residual))
            if reached < before:
                x = x + step
            if reached > 0.1 * before:
                break
        return x

    def _cycle(self, load: Floats, target: float, matrices: Matrices) -> Floats | None:
        """Conjugate gradients from zero to a residual of `target`; None if they do not get there."""
        x, residual = np.zeros_like(load), load.copy()
        z = direction = self.precondition(residual)
        energy = float(residual @ z)
        for _ in range(_ITERATIONS):
            push = apply(self.tree, matrices, direction)
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
        """One substitution: the unknowns for a load as good as the fronts' precision.

        Load and unknowns in double precision, shape (unknowns,), or (unknowns, n) for n loads at once.
        """
        # a power of two, so that scaling is exact and single precision neither over- nor underflows
        scale = 2.0 ** np.frexp(np.abs(load).max(axis=0))[1]
        columns = (load / scale).reshape(len(load), -1)
        x = np.zeros((self.tree.size + 1, columns.shape[1]), _KIND[self.precision])
        x[self.tree.order] = columns
        steps = list(zip(self.tree.batches, self._panels, strict=True))
        with one_thread():
            for batch, panels in steps:
                pivots, below = batch.rows[:, : batch.width], batch.rows[:, batch.width :]
                part = panels @ x[pivots]
                x[pivots] = part[:, : batch.width]
                rest = part[:, batch.width :]
                if x.shape[1] == 1:
                    np.add.at(x[:, 0], below.ravel(), rest.ravel())
                else:  # rows of one front are not the same
                    for rows, more in zip(below, rest, strict=True):
                        x[rows] += more
            for batch, panels in reversed(steps):
                x[batch.rows[:, : batch.width]] = panels.transpose(0, 2, 1) @ x[batch.rows]
        return np.asarray(x[self.tree.order].reshape(load.shape) * scale, dtype=np.float64)


def apply(tree: Tree, matrices: Matrices, x: Floats) -> Floats:
    """Product of the (never assembled) matrix and x, both shape (unknowns,); matrices as for `Factor`.

    Sums are double, also where the matrices are kept in single precision, which takes no longer.
    """
    local = np.append(x, 0.0)[tree.dofs]
    if isinstance(matrices, Operator):
        force = matrices.times(local)
    else:
        force = np.empty_like(local)
        for start in range(0, len(local), _CHUNK):
            part = slice(start, start + _CHUNK)
            some = matrices(np.arange(len(local))[part]) if callable(matrices) else matrices[part]
            np.matmul(some.astype(np.float64, copy=False), local[part, :, None], out=force[part, :, None])
    held = np.where(tree.dofs < 0, tree.size, tree.dofs)
    total = np.bincount(held.ravel(), weights=force.ravel(), minlength=tree.size + 1)
    return np.asarray(total[:-1], dtype=float)
