"""Irradiance on the contact surface, spread over angles: how it is weighed, smoothed and looked up.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from .contact import ContactOptics

Array = NDArray[np.float64]

_SMOOTHING_CELLS = 2.5  # standard deviation of the smoothing kernel
_RIM_CELLS = 2  # 0.5 mm


@dataclass(frozen=True)
class AngularBasis:
    """Separable form of what enters the tissue: phi_i(cos) T(A_r, cos) = sum_k rows[i, :, k] columns[k](cos).

    Light arrives spread over angles, so T and the tissue's lobes phi_i cannot be taken out of the integral
    over them; with this form the integral is `count` irradiances, smooth over the surface, whatever the
    pressure does.
    """

    rows: Array  # (modes, n_fraction, count)
    columns: Array  # (count, n_cos)

    @property
    def count(self) -> int:
        return self.columns.shape[0]


def angular_basis(optics: ContactOptics, lobes: Array, tolerance: float = 5e-5) -> AngularBasis:
    """Truncated singular value decomposition, largest error at most `tolerance`; lobes (modes, n_cos) on the
    table's cosines."""
    products = (lobes[:, None] * optics.transmittance).reshape(-1, lobes.shape[1])
    u, s, v = np.linalg.svd(products, full_matrices=False)
    for count in range(1, s.size + 1):
        rows, columns = u[:, :count] * s[:count], v[:count]
        if np.abs(rows @ columns - products).max() <= tolerance:
            break
    return AngularBasis(rows.reshape(len(lobes), -1, count), columns)


def weigh(weights: mi.Float, count: int, n_cos: int, cosine: mi.Float, active: mi.Bool) -> list[mi.Float]:
    """The basis' columns at a cosine; `weights` is their (n_cos, count) table, flattened."""
    at = dr.clip(cosine, 0.0, 1.0) * (n_cos - 1)
    node = dr.minimum(mi.UInt32(at), n_cos - 2)
    share = at - mi.Float(node)
    low = [dr.gather(mi.Float, weights, node * count + k, active) for k in range(count)]
    high = [dr.gather(mi.Float, weights, (node + 1) * count + k, active) for k in range(count)]
    return [dr.lerp(a, b, share) for a, b in zip(low, high, strict=True)]


def look_up(maps: Array, x: mi.Float, y: mi.Float) -> list[mi.Float]:
    """Values of maps (n, m, m), on cells [iy, ix] of the guide's face, at x and y in units of its width."""
    layers = np.ascontiguousarray(np.moveaxis(maps, 0, -1), dtype=np.float32)
    return list(mi.Texture2f(mi.TensorXf(layers), wrap_mode=dr.WrapMode.Clamp).eval(mi.Point2f(x, y)))


def transmitted(basis: AngularBasis, irradiance: Array, fraction: Array) -> Array:
    """Irradiance that enters the tissue in each mode, (n, modes, m, m) W/mm², of (n, count, m, m), where the
    real contact fraction is (m, m)."""
    rows = np.moveaxis(basis.rows, 0, 1)
    return np.einsum("yxik,nkyx->niyx", by_fraction(rows, fraction), irradiance, optimize=True)


def by_fraction(rows: Array, fraction: Array) -> Array:
    """Rows (n_fraction, ...) of a table, uniform on 0..1, at fractions (m, m): (m, m, ...)."""
    last = len(rows) - 1
    at = np.clip(fraction, 0.0, 1.0) * last
    node = np.minimum(at.astype(np.int64), last - 1)
    share = (at - node).reshape(*fraction.shape, *(1,) * (rows.ndim - 1))
    return np.asarray(rows[node] * (1.0 - share) + rows[node + 1] * share)


def smooth(irradiance: Array, factor: int = 4) -> Array:
    """Smoothed irradiance on a grid `factor` times finer over the last two axes.

    The kernel 2 G - G * G has no second moment, so the curvature of the irradiance survives. It is mirrored
    at the rim, where the surface bends and light changes from cell to cell: those cells keep their values.
    """
    return _along_both(_smoothing_matrix(irradiance.shape[-1], factor, _SMOOTHING_CELLS), irradiance)


def _along_both(step: Array, irradiance: Array) -> Array:
    return np.einsum("yi,...ij,xj->...yx", step, irradiance, step, optimize=["einsum_path", (0, 1), (0, 1)])


@lru_cache(maxsize=8)
def _smoothing_matrix(cells: int, factor: int, sigma: float) -> Array:
    """(factor * cells, cells): smooth along one axis, then interpolate at the finer cells' middles."""
    smoothed = np.eye(cells)
    if sigma > 0.0:
        reach = int(np.ceil(6 * sigma))
        gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / sigma) ** 2)
        gauss /= gauss.sum()
        kernel = -np.convolve(gauss, gauss)
        kernel[reach:-reach] += 2.0 * gauss
        inner = slice(_RIM_CELLS, cells - _RIM_CELLS)
        smoothed[inner, inner] = correlate1d(smoothed[inner, inner], kernel, axis=0, mode="reflect")
    middles, finer = np.arange(cells) + 0.5, (np.arange(factor * cells) + 0.5) / factor
    return np.stack([np.interp(finer, middles, column) for column in smoothed.T], axis=1)
