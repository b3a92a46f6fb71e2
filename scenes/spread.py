"""How light that enters the tissue spreads sideways under the contact before it leaves.

Solves V = R (*) [E + w V] for the light that goes up inside the tissue: what enters (E) and what the face throws
back (w V, w falls with the real contact) comes up again beside. Where the guide ends the tissue goes on with bare
skin.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .radial import kernel
from .slab import decay_rate
from .tissue import Coupling, TissueOptics

Array = NDArray[np.float64]

_MOST_ROUNDS = 60


@dataclass(frozen=True)
class Spread:
    """The solver for one tissue on one grid of square cells over the guide's face; make it with `spreader`.

    Attributes
    ----------
    transform : (p, p // 2 + 1)
        Real Fourier transform of the kernel R / (1 - w0 R) over cells, padded so that nothing wraps round;
        w0 is w of bare skin, which all of the tissue has in this kernel.
    cells, padded
        m and p, per side.
    free
        w0.
    held, feed, local, back
        On nodes of A_r: w (n,), and with the local modes taken out, what they feed to mode 0 (n, l), their
        own answer (n, l, l), and what mode 0 sends them (n, l).
    """

    transform: Array
    cells: int
    padded: int
    free: float
    held: Array
    feed: Array
    local: Array
    back: Array

    def solve(self, entering: Array, fraction: Array, tolerance: float = 1e-6) -> Array:
        """Light that goes up under the face.

        Parameters
        ----------
        entering : (n_led, modes, m, m)
            E_i, W/mm²: irradiance that enters the tissue, weighted with the lobes φ_i.
        fraction : (m, m)
            Real contact fraction.
        tolerance
            Of the largest residual, relative to what enters.

        Returns
        -------
        (n_led, modes, m, m)
            V_i, W/mm²; the guide sees the radiance (n1/n3)² T(A_r, cos) Σ φ_i V_i / π.
        """
        node, share = _node(fraction, self.held.shape[0])

        def at(table: Array) -> Array:
            low = (1.0 - share).reshape(share.shape + (1,) * (table.ndim - 1)) * table[node]
            return np.asarray(low + share.reshape(share.shape + (1,) * (table.ndim - 1)) * table[node + 1])

        feed, local, back = at(self.feed), at(self.local), at(self.back)
        source = entering[:, 0] + np.einsum("yxl,nlyx->nyx", feed, entering[:, 1:])
        first = self._conjugate(source, at(self.held) - self.free, tolerance)
        sent = entering[:, 1:] + np.einsum("yxl,nyx->nlyx", back, first)
        rest = np.einsum("yxkl,nlyx->nkyx", local, sent)
        return np.concatenate([first[:, None], rest], axis=1)

    def _conjugate(self, source: Array, excess: Array, tolerance: float) -> Array:
        """V = M [E + (w - w0) V] by conjugate gradients for x, V = M x, in the product of M (Hestenes & Stiefel
        1952; key hestenes1952): I - (w - w0) M is self-adjoint and positive there, and one round costs one M.
        """
        residual, found = source, np.zeros_like(source)
        spread = self.convolve(residual)
        way, spread_way = residual, spread
        power = _dot(residual, spread)
        limit = tolerance * np.abs(source).max(axis=(1, 2), initial=1e-300)
        for _ in range(_MOST_ROUNDS):
            image = way - excess * spread_way
            step = power / np.maximum(_dot(image, spread_way), 1e-300)
            found = found + step[:, None, None] * spread_way
            residual = residual - step[:, None, None] * image
            if np.all(np.abs(residual).max(axis=(1, 2)) <= limit):
                break
            spread = self.convolve(residual)
            power, before = _dot(residual, spread), power
            turn = (power / np.maximum(before, 1e-300))[:, None, None]
            way, spread_way = residual + turn * way, spread + turn * spread_way
        return found

    def convolve(self, light: Array) -> Array:
        """M applied to (n, m, m)."""
        shape = (self.padded, self.padded)
        wide = scipy.fft.rfft2(light, shape, workers=1)
        wide *= self.transform
        return np.asarray(scipy.fft.irfft2(wide, shape, workers=1)[:, : self.cells, : self.cells])


def spreader(tissue: TissueOptics, coupling: Coupling, width_mm: float, cells: int) -> Spread:
    """Prepare the spread of light on `cells` x `cells` cells over a face of `width_mm`; 0.2 s."""
    held, feed, local, back = _without_local(tissue.strengths, coupling.held)
    (free,), _, _, _ = _without_local(tissue.strengths, coupling.free[None])
    body = tissue.slab

    def under_bare_skin(k: Array) -> Array:
        reflectance = body.reflectance(k)
        return np.asarray(reflectance / (1.0 - free * reflectance))

    scale, tail = decay_rate(body.albedo), 1.0 + 1.0 / body.depth
    curve = kernel(under_bare_skin, 0.5 * body.albedo, scale, tail)
    shares = curve.cells(tissue.transport_per_mm * width_mm / cells, cells)
    padded = int(scipy.fft.next_fast_len(2 * cells - 1, real=True))
    around = np.zeros((padded, padded))
    index = np.minimum(np.arange(padded), padded - np.arange(padded))
    inside = index < cells
    around[np.ix_(inside, inside)] = shares[np.ix_(index[inside], index[inside])]
    transform = scipy.fft.rfft2(around, workers=1).real
    return Spread(transform, cells, padded, float(free), held, feed, local, back)


def _without_local(strengths: Array, held: Array) -> tuple[Array, Array, Array, Array]:
    """Take the local modes out of V_i = ρ_i [E_i + Σ W_ij V_j], i > 0: w, feed, local and back of `Spread`."""
    rho = np.diag(strengths[1:])
    inner, back = held[:, 1:, 1:], held[:, 1:, 0]
    local = np.linalg.solve(np.eye(rho.shape[0]) - rho @ inner, np.broadcast_to(rho, inner.shape))
    feed = np.einsum("ak,akl->al", held[:, 0, 1:], local)
    return held[:, 0, 0] + np.einsum("al,al->a", feed, back), feed, local, back


def _node(fraction: Array, count: int) -> tuple[NDArray[np.intp], Array]:
    scaled = np.clip(fraction, 0.0, 1.0) * (count - 1)
    node = np.minimum(scaled.astype(np.intp), count - 2)
    return node, scaled - node


def _dot(one: Array, other: Array) -> Array:
    """Products summed over the cells of each LED, (n,)."""
    return np.asarray((one * other).sum(axis=(1, 2)))
