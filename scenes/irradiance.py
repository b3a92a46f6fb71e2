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
from .tissue import Coupling

Array = NDArray[np.float64]

_SMOOTHING_CELLS = 2.5  # standard deviation of the smoothing kernel
_RIM_CELLS = 2  # 0.5 mm


@dataclass(frozen=True)
class AngularBasis:
    """Separable form of what enters the tissue: phi_i(cos) T(A_r, cos) = sum_k rows[i, :, k] columns[k](cos).

    Light arrives spread over angles, so T and the tissue's lobes phi_i cannot be taken out of the integral
    over them; with this form the integral is `count` irradiances, smooth over the surface, whatever the
    pressure does. The same holds for what enters aslant and comes out ahead: skew(cos) T = sum_k
    skew_rows[:, k] skew_columns[k](cos), counted for each of the two directions along the surface.
    """

    rows: Array  # (modes, n_fraction, count)
    columns: Array  # (count, n_cos)
    skew_rows: Array  # (n_fraction, skews), mm
    skew_columns: Array  # (skews, n_cos)

    @property
    def layers(self) -> int:
        """Maps that light is counted on: `count` plain ones, `skews` along x and as many along y."""
        return len(self.columns) + 2 * len(self.skew_columns)

    def weights(self) -> Weights:
        """The columns on the device."""
        return Weights(*(_Columns.of(columns) for columns in (self.columns, self.skew_columns)))


@dataclass(frozen=True)
class _Columns:
    """Functions of the cosine on uniform nodes over 0..1, on the device."""

    table: mi.Float
    count: int
    nodes: int

    @staticmethod
    def of(columns: Array) -> _Columns:
        table = np.ascontiguousarray(columns.T, dtype=np.float32).ravel()
        return _Columns(mi.Float(table if table.size else np.zeros(1, dtype=np.float32)), *columns.shape)

    def at(self, cosine: mi.Float, active: mi.Bool) -> list[mi.Float]:
        at = dr.clip(cosine, 0.0, 1.0) * (self.nodes - 1)
        node = dr.minimum(mi.UInt32(at), self.nodes - 2)
        share = at - mi.Float(node)
        start = node * self.count
        low = [dr.gather(mi.Float, self.table, start + k, active) for k in range(self.count)]
        high = [dr.gather(mi.Float, self.table, start + self.count + k, active) for k in range(self.count)]
        return [dr.lerp(a, b, share) for a, b in zip(low, high, strict=True)]


@dataclass(frozen=True)
class Weights:
    """How much arriving light counts on each map of an `AngularBasis`."""

    plain: _Columns
    skew: _Columns

    def at(self, cosine: mi.Float, x: mi.Float, y: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Weights on the maps of light at a cosine of incidence, whose direction has the parts x and y along
        the surface, of any length."""
        skew = self.skew.at(cosine, active)
        unit = dr.rsqrt(dr.maximum(dr.square(x) + dr.square(y), 1e-20))
        return [*self.plain.at(cosine, active), *(w * x * unit for w in skew), *(w * y * unit for w in skew)]


def angular_basis(
    optics: ContactOptics, coupling: Coupling, tolerance: float = 5e-5, skew_tolerance: float = 2e-3
) -> AngularBasis:
    """Truncated singular value decompositions, largest errors at most `tolerance`; `skew_tolerance` is
    relative to the largest skew."""
    lobes = coupling.lobes
    rows, columns = _separated((lobes[:, None] * optics.transmittance).reshape(-1, lobes.shape[1]), tolerance)
    largest = max(float(np.abs(coupling.skew).max()), 1e-12)
    skews = _separated(coupling.skew * optics.transmittance, skew_tolerance * largest)
    return AngularBasis(rows.reshape(len(lobes), -1, len(columns)), columns, *skews)


def _separated(products: Array, tolerance: float) -> tuple[Array, Array]:
    u, s, v = np.linalg.svd(products, full_matrices=False)
    for count in range(1, s.size + 1):
        rows, columns = u[:, :count] * s[:count], v[:count]
        if np.abs(rows @ columns - products).max() <= tolerance:
            break
    return rows, columns


def look_up(maps: Array, x: mi.Float, y: mi.Float) -> list[mi.Float]:
    """Values of maps (n, m, m), on cells [iy, ix] of the guide's face, at x and y in units of its width."""
    layers = np.ascontiguousarray(np.moveaxis(maps, 0, -1), dtype=np.float32)
    return list(mi.Texture2f(mi.TensorXf(layers), wrap_mode=dr.WrapMode.Clamp).eval(mi.Point2f(x, y)))


def transmitted(basis: AngularBasis, irradiance: Array, fraction: Array, width_mm: float) -> Array:
    """Irradiance that enters the tissue in each mode, (n, modes, m, m) W/mm², of maps (n, layers, m, m) where
    the real contact fraction is (m, m), on cells over a face of `width_mm`.

    Light that enters aslant is carried ahead to where it will come out, to first order: E_0 - div(skewed
    light).
    """
    count, skews = len(basis.columns), len(basis.skew_columns)
    rows = by_fraction(np.moveaxis(basis.rows, 0, 1), fraction)
    entering = np.einsum("yxik,nkyx->niyx", rows, irradiance[:, :count], optimize=True)
    ahead = by_fraction(basis.skew_rows, fraction)
    parts = irradiance[:, count:].reshape(len(irradiance), 2, skews, *fraction.shape)
    carried = np.einsum("yxk,nckyx->ncyx", ahead, parts, optimize=True)
    entering[:, 0] -= _divergence(carried, width_mm / fraction.shape[0])
    return np.asarray(entering)


def _divergence(flow: Array, step: float) -> Array:
    """Of flows (n, 2, m, m), x first, on cells of that step; over the rim they go out, none come in."""
    total = np.zeros((flow.shape[0], *flow.shape[2:]))
    for part, axis in ((flow[:, 0], 2), (flow[:, 1], 1)):
        along = np.moveaxis(part, axis, -1)
        faces = np.empty((*along.shape[:-1], along.shape[-1] + 1))
        faces[..., 1:-1] = 0.5 * (along[..., 1:] + along[..., :-1])
        faces[..., 0], faces[..., -1] = np.minimum(along[..., 0], 0.0), np.maximum(along[..., -1], 0.0)
        total += np.moveaxis(np.diff(faces, axis=-1), -1, axis) / step
    return total


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
