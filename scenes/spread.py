"""How light that enters the tissue spreads sideways under the contact before it leaves.

Solves V = R (*) [E + w V] for the light that goes up inside the tissue: what enters (E) and what the face
throws back (w V; w falls with the real contact) comes up again beside. Where the guide ends, the tissue
goes on with bare skin.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .half_space import HalfSpace
from .radial import kernel
from .slab import Slab
from .tissue import Coupling, TissueOptics

Array = NDArray[np.float64]

_MOST_ROUNDS = 60
_BLACK = 1e-12  # share that comes back, below which nothing does
_NONE = 1e-300  # in place of 0 below a fraction bar


@dataclass(frozen=True)
class Spread:
    """The solver for one tissue on one grid of square cells over the guide's face; make it with `spreader`.

    Attributes
    ----------
    transform : (p, p // 2 + 1)
        Real Fourier transform of the kernel R / (1 - w0 R) over cells, padded so that nothing wraps round;
        w0 is w of bare skin, which all of the tissue has in this kernel.
    cells
        m, per side.
    free
        w0.
    held, feed, local, back
        On nodes of A_r: w (n,), and with the local modes taken out, what they feed to mode 0 (n, l), their
        own answer (n, l, l), and what mode 0 sends them (n, l).
    """

    transform: NDArray[np.float32]
    cells: int
    free: float
    held: Array
    feed: Array
    local: Array
    back: Array

    def solve(self, entering: Array, fraction: Array, tolerance: float = 1e-6) -> Array:
        """Light that goes up under the face: `Bed.solve` of `on`."""
        return self.on(fraction).solve(entering, tolerance)

    def on(self, fraction: Array) -> Bed:
        """Under a face whose real contact fraction is (m, m); not a number where there is no guide but bare
        skin."""
        nodes, bare = np.linspace(0.0, 1.0, self.held.size), np.isnan(fraction)
        known = np.where(bare, 0.0, fraction)

        def at(table: Array) -> Array:
            flat = table.reshape(len(nodes), -1)
            found = np.stack([np.interp(known, nodes, column) for column in flat.T])
            return found.reshape(*table.shape[1:], *known.shape)

        excess = np.where(bare, 0.0, at(self.held) - self.free)
        return Bed(self, excess, at(self.feed), at(self.local), at(self.back))

    def convolve(self, light: Array) -> Array:
        """M applied to (n, m, m)."""
        padded = self.transform.shape[0]
        rows = scipy.fft.rfft(light.astype(np.float32), padded, axis=2, workers=1)
        both = scipy.fft.fft(rows, padded, axis=1, workers=1, overwrite_x=True)
        both *= self.transform
        rows = scipy.fft.ifft(both, axis=1, workers=1, overwrite_x=True)[:, : self.cells]
        return scipy.fft.irfft(rows, padded, axis=2, workers=1)[..., : self.cells].astype(np.float64)


@dataclass(frozen=True)
class Bed:
    """A `Spread` under one face; make it with `Spread.on`.

    Attributes
    ----------
    excess : (m, m)
        w - w0 on cells.
    feed, local, back : (l, m, m), (l, l, m, m), (l, m, m)
        As of `Spread`.
    """

    spread: Spread
    excess: Array
    feed: Array
    local: Array
    back: Array

    def solve(self, entering: Array, tolerance: float = 1e-6) -> Array:
        """Light that goes up under the face.

        Parameters
        ----------
        entering : (n_led, modes, m, m)
            E_i, W/mm²: irradiance that enters the tissue, weighted with the lobes φ_i; cells [iy, ix].
        tolerance
            Of the largest residual, relative to what enters.

        Returns
        -------
        (n_led, modes, m, m)
            V_i, W/mm²; the guide sees the radiance (n1/n3)² T(A_r, cos) Σ φ_i V_i / π.
        """
        modes = range(1, entering.shape[1])
        source = entering[:, 0]
        for i in modes:
            source = source + self.feed[i - 1] * entering[:, i]
        result = np.empty(entering.shape)
        result[:, 0] = self._conjugate(source, tolerance)
        for i in modes:
            sent = entering[:, i] + self.back[i - 1] * result[:, 0]
            for k in modes:
                part = self.local[k - 1, i - 1] * sent
                result[:, k] = part if i == 1 else result[:, k] + part
        return result

    def _conjugate(self, source: Array, tolerance: float) -> Array:
        """V = M [E + (w - w0) V] by conjugate gradients for x, V = M x, in the inner product of M.

        There I - (w - w0) M is self-adjoint and positive, and a round costs one M (Hestenes & Stiefel 1952;
        key hestenes1952). M is applied in single precision, always to a residual: the error shrinks with it.
        """
        residual, found = source, np.zeros_like(source)
        if np.abs(self.spread.transform).max() < _BLACK:  # a black sheet: no round would get nearer
            return found
        spread = self.spread.convolve(residual)
        way, spread_way = residual, spread
        power = _dot(residual, spread)
        limit = tolerance * np.abs(source).max(axis=(1, 2))
        for _ in range(_MOST_ROUNDS):
            image = way - self.excess * spread_way
            step = (power / np.maximum(_dot(image, spread_way), _NONE))[:, None, None]
            found = found + step * spread_way
            residual = residual - step * image
            if np.all(np.abs(residual).max(axis=(1, 2)) <= limit):
                break
            spread = self.spread.convolve(residual)
            before, power = power, _dot(residual, spread)
            turn = (power / np.maximum(before, _NONE))[:, None, None]
            way, spread_way = residual + turn * way, spread + turn * spread_way
        return found


def spreader(tissue: TissueOptics, coupling: Coupling, width_mm: float, cells: int) -> Spread:
    """Prepare the spread of light on `cells` x `cells` cells over a face of `width_mm`; some 0.1 s."""
    held, feed, local, back = _without_local(tissue.strengths, coupling.held)
    free = float(_without_local(tissue.strengths, coupling.free[None])[0][0])
    transform = _transform(tissue.slab, free, tissue.transport_per_mm * width_mm / cells, cells)
    return Spread(transform, cells, free, held, feed, local, back)


@lru_cache(maxsize=16)
def _transform(body: Slab | HalfSpace, free: float, step: float, cells: int) -> NDArray[np.float32]:
    """`Spread.transform` on cells so many transport lengths wide; the sensors of a layout study share it."""

    def under_bare_skin(k: Array) -> Array:
        reflectance = body.reflectance(k)
        return np.asarray(reflectance / (1.0 - free * reflectance))

    shares = kernel(under_bare_skin, body.first, body.decay_rate, body.bend).cells(step, cells)
    padded = int(scipy.fft.next_fast_len(2 * cells, real=True))
    away = np.minimum(np.arange(padded), padded - np.arange(padded))
    around = np.where(away < cells, shares[:, np.minimum(away, cells - 1)], 0.0)
    around = np.where((away < cells)[:, None], around[np.minimum(away, cells - 1)], 0.0)
    transform = scipy.fft.rfft2(around, workers=1).real.astype(np.float32)
    transform.setflags(write=False)
    return transform


def _without_local(strengths: Array, held: Array) -> tuple[Array, Array, Array, Array]:
    """Take the local modes i > 0 out of V_i = ρ_i [E_i + Σ W_ij V_j]: w, feed, local, back of `Spread`."""
    rho = np.diag(strengths[1:])
    inner, back = held[:, 1:, 1:], held[:, 1:, 0]
    local = np.asarray(np.linalg.solve(np.eye(len(rho)) - rho @ inner, np.broadcast_to(rho, inner.shape)))
    feed = np.einsum("ak,akl->al", held[:, 0, 1:], local)
    return np.asarray(held[:, 0, 0] + np.einsum("al,al->a", feed, back)), feed, local, back


def _dot(one: Array, other: Array) -> Array:
    """Products summed over the cells of each LED, (n,)."""
    return np.asarray((one * other).sum(axis=(1, 2)))
