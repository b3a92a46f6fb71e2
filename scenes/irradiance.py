"""Irradiance on the contact surface, spread over angles: how it is weighed, smoothed and looked up.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from .contact import ContactOptics
from .tissue import Coupling

Array = NDArray[np.float64]

_SMOOTHING_CELLS = 2.5  # standard deviation of the smoothing kernel
_RIM_CELLS = 2  # 0.5 mm


@dataclass(frozen=True)
class Carried:
    """Separable form of one moment of `tissue.carried` times T: sum_k rows[:, k](A_r) columns[k](cos)."""

    harmonic: int  # of the azimuth: 0, or 1 or 2 with a part of the cosine and one of the sine
    rows: Array  # (n_fraction, count), mm or mm²
    columns: Array  # (count, n_cos)

    @property
    def layers(self) -> int:
        return len(self.columns) * (2 if self.harmonic else 1)


@dataclass(frozen=True)
class AngularBasis:
    """Separable form of what enters the tissue: phi_i(cos) T(A_r, cos) = sum_k rows[i, :, k] columns[k](cos).

    Light arrives spread over angles, so T and the tissue's lobes phi_i cannot be taken out of the integral
    over them; with this form the integral is `count` irradiances, smooth over the surface, whatever the
    pressure does. The same holds for what enters aslant and comes out beside where it went in.
    """

    rows: Array  # (modes, n_fraction, count)
    columns: Array  # (count, n_cos)
    carried: tuple[Carried, ...] = ()
    reach_mm: float = 0.0  # of the run before light comes out, root of half its mean square
    spread_mm: float = 0.0  # `tissue.Coupling.spread_mm`

    @property
    def layers(self) -> int:
        """Maps that light is counted on."""
        return len(self.columns) + sum(moment.layers for moment in self.carried)

    def weights(self) -> Weights:
        """The columns on the device."""
        return Weights(
            _Columns.of(self.columns),
            tuple((moment.harmonic, _Columns.of(moment.columns)) for moment in self.carried),
        )


@dataclass(frozen=True)
class _Columns:
    """Functions of the cosine on uniform nodes over 0..1, on the device."""

    table: mi.Float
    count: int
    nodes: int

    @staticmethod
    def of(columns: Array) -> _Columns:
        return _Columns(mi.Float(np.ascontiguousarray(columns.T, dtype=np.float32).ravel()), *columns.shape)

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
    carried: tuple[tuple[int, _Columns], ...]

    def at(self, cosine: mi.Float, x: mi.Float, y: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Weights on the maps of light at a cosine of incidence, whose direction has the parts x and y along
        the surface, of any length."""
        unit = dr.rsqrt(dr.maximum(dr.square(x) + dr.square(y), 1e-20))
        x, y = x * unit, y * unit
        azimuth = {0: (mi.Float(1.0),), 1: (x, y), 2: (x * x - y * y, 2.0 * x * y)}
        found = self.plain.at(cosine, active)
        for harmonic, columns in self.carried:
            here = columns.at(cosine, active)
            found += [part * weight for part in azimuth[harmonic] for weight in here]
        return found


def angular_basis(
    optics: ContactOptics, coupling: Coupling, tolerance: float = 5e-5, carried: float = 1e-2
) -> AngularBasis:
    """Truncated singular value decompositions, largest errors at most `tolerance`, and of the moments
    `carried` times their largest value."""
    lobes, through = coupling.lobes, optics.transmittance
    rows, columns = _separated((lobes[:, None] * through).reshape(-1, lobes.shape[1]), tolerance)
    moments = [
        Carried(harmonic, *_separated(moment * through, carried * max(float(np.abs(moment).max()), 1e-12)))
        for harmonic, moment in zip((1, 2, 0), coupling.carried, strict=True)
    ]
    reach = float(np.sqrt(2.0 * coupling.carried[1].max()))
    return AngularBasis(
        rows.reshape(len(lobes), -1, len(columns)), columns, tuple(moments), reach, coupling.spread_mm
    )


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


@dataclass(frozen=True)
class Entrance:
    """An `AngularBasis` where the real contact fraction is (m, m), on cells over a face of `width_mm`."""

    basis: AngularBasis
    rows: Array  # (m, m, modes, count)
    carried: tuple[Array, ...]  # (m, m, count) each
    width_mm: float

    @staticmethod
    def at(basis: AngularBasis, fraction: Array, width_mm: float) -> Entrance:
        carried = tuple(by_fraction(moment.rows, fraction) for moment in basis.carried)
        return Entrance(basis, by_fraction(np.moveaxis(basis.rows, 0, 1), fraction), carried, width_mm)


def transmitted(entrance: Entrance, irradiance: Array, margin: int) -> Array:
    """Irradiance that enters the tissue in each mode, (n, modes, m + 2 margin, m + 2 margin) W/mm².

    From maps (n, layers, m, m) on cells over the face.
    Mode 0 is carried on to where the light comes out, as `tissue.carried` tells: less div(M - div Q). What
    goes over the rim is found in the margin beside it. A kernel of another width s' differs from that of
    width s by (1 + k²s²)/(1 + k²s'²), about 1 - k²(s'² - s²)/(1 + k²s²): so the part of Q that is alike in
    all directions is smoothed before its derivatives are taken.
    """
    basis, shape = entrance.basis, irradiance.shape[-2:]
    first, step = len(basis.columns), entrance.width_mm / shape[0]
    entering = np.einsum("yxik,nkyx->niyx", entrance.rows, irradiance[:, :first], optimize=True)
    flow = np.zeros((2, len(irradiance), *shape))
    for moment, rows in zip(basis.carried, entrance.carried, strict=True):
        parts = 2 if moment.harmonic else 1
        maps = irradiance[:, first : first + moment.layers]
        maps = maps.reshape(len(maps), parts, -1, *shape)
        first += moment.layers
        found = np.einsum("yxk,nckyx->cnyx", rows, maps, optimize=True)
        if moment.harmonic == 1:
            flow += found
        else:
            if moment.harmonic == 0:
                found = _smoothed(found, basis.spread_mm / step)
            by_y, by_x = np.gradient(found, step, axis=(2, 3))
            if moment.harmonic == 2:
                flow -= np.stack([by_x[0] + by_y[1], by_x[1] - by_y[0]])
            else:
                flow -= np.stack([by_x[0], by_y[0]])
    wide = np.pad(entering, ((0, 0), (0, 0), (margin, margin), (margin, margin)))
    if basis.carried:
        fade = np.exp(-(np.arange(margin) + 0.5) * step / basis.reach_mm)
        wide[:, 0] -= _divergence(flow, step, fade / fade.sum())
    return wide


def _smoothed(fields: Array, reach: float) -> Array:
    """1/(1 + k² reach²) of fields (..., m, m), reach in cells, mirrored at the rim."""
    wave2 = (np.pi * np.arange(fields.shape[-1]) / fields.shape[-1]) ** 2
    spectrum = scipy.fft.dctn(fields, axes=(-2, -1), workers=1)
    spectrum /= 1.0 + reach**2 * (wave2[:, None] + wave2)
    return np.asarray(scipy.fft.idctn(spectrum, axes=(-2, -1), workers=1))


def _divergence(flow: Array, step: float, fade: Array) -> Array:
    """Of flows (2, n, m, m), x first, on cells of that step, with a margin (2, n, m + 2 margin, ...).

    Over the rim they go out, none come in; so many cells beside it share in what goes out as `fade` tells.
    """
    margin, cells = len(fade), flow.shape[-1]
    total = np.zeros((flow.shape[1], cells + 2 * margin, cells + 2 * margin))
    inside = slice(margin, margin + cells)
    for part, axis in ((flow[0], 2), (flow[1], 1)):
        along = np.moveaxis(part, axis, -1)
        faces = np.empty((*along.shape[:-1], cells + 1))
        faces[..., 1:-1] = 0.5 * (along[..., 1:] + along[..., :-1])
        faces[..., 0], faces[..., -1] = np.minimum(along[..., 0], 0.0), np.maximum(along[..., -1], 0.0)
        target = np.moveaxis(total, axis, -1)[:, inside]
        target[..., inside] += np.diff(faces, axis=-1) / step
        target[..., :margin] += faces[..., :1] * fade[::-1] / step
        target[..., margin + cells :] -= faces[..., -1:] * fade / step
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
