"""Irradiance on the contact surface, spread over angles: how it is weighed, smoothed and looked up.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d

from .arrays import floats, tensor
from .aslant import HARMONICS, STEEP
from .contact import ContactOptics
from .tissue import Coupling

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

_SMOOTHING_CELLS = 1.75  # standard deviation of the smoothing kernel
_RIM_CELLS = 2  # 0.5 mm


@dataclass(frozen=True)
class Turning:
    """Separable form of what turns with the azimuth: h_r(cos) T(A_r, cos) = sum_k rows[r, :, k]
    columns[k](cos), a part with the cosine of the azimuth times the harmonic, and one with its sine."""

    harmonic: int
    rows: Array  # (functions, n_fraction, count)
    columns: Array  # (count, n_cos)


@dataclass(frozen=True)
class AngularBasis:
    """Separable form of what enters the tissue: h_r(cos) T(A_r, cos) = sum_k rows[r, :, k] columns[k](cos).

    Light arrives spread over angles, so T and the functions h_r of the angle of entry (`aslant`; the tissue's
    lobes phi_i are the first) cannot be taken out of the integral over them; with this form the integral is
    `layers` irradiances, smooth over the surface, whatever the pressure does.
    """

    rows: Array  # (functions, n_fraction, count)
    columns: Array  # (count, n_cos)
    turning: tuple[Turning, ...] = ()

    @property
    def layers(self) -> int:
        """Maps that light is counted on."""
        return len(self.columns) + sum(2 * len(one.columns) for one in self.turning)

    @property
    def told(self) -> int:
        """Those of which derivatives are told."""
        return self.layers

    def weights(self) -> Weights:
        """The columns on the device."""
        return Weights(
            _Columns.of(self.columns),
            tuple((one.harmonic, _Columns.of(one.columns)) for one in self.turning),
        )


class Weighing(Protocol):
    """How much arriving light counts on each map."""

    def at(self, cosine: mi.Float, x: mi.Float, y: mi.Float, active: mi.Bool) -> list[mi.Float]: ...


class Layered(Protocol):
    """Maps that light is counted on, of which derivatives of the first are told: an `AngularBasis`, or
    several."""

    @property
    def layers(self) -> int: ...

    @property
    def told(self) -> int: ...

    def weights(self) -> Weighing: ...


@dataclass(frozen=True)
class _Columns:
    """Functions of the cosine on uniform nodes over 0..1, on the device."""

    table: mi.Float
    count: int
    nodes: int

    @staticmethod
    def of(columns: Array) -> _Columns:
        return _Columns(floats(columns.T), *columns.shape)

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
    turning: tuple[tuple[int, _Columns], ...]

    def at(self, cosine: mi.Float, x: mi.Float, y: mi.Float, active: mi.Bool) -> list[mi.Float]:
        """Weights on the maps of light at a cosine of incidence, whose direction has the parts x and y along
        the surface, of any length."""
        unit = dr.rsqrt(dr.maximum(dr.square(x) + dr.square(y), 1e-20))
        x, y = x * unit, y * unit
        azimuth = [(mi.Float(1.0), mi.Float(0.0)), (x, y)]
        while len(azimuth) <= HARMONICS:
            cos, sin = azimuth[-1]
            azimuth.append((cos * x - sin * y, sin * x + cos * y))
        found = self.plain.at(cosine, active)
        for harmonic, columns in self.turning:
            here = columns.at(cosine, active)
            found += [part * weight for part in azimuth[harmonic] for weight in here]
        return found


def angular_basis(
    optics: ContactOptics, coupling: Coupling, tolerance: float = 5e-5, turning: float = 5e-3
) -> AngularBasis:
    """Truncated singular value decompositions; largest errors at most `tolerance` for the lobes, and
    `turning` of the largest answer of the tissue for all other parts."""
    modes, apart = len(coupling.lobes), coupling.aslant
    largest = max(float(np.abs(apart.transforms[0][STEEP, 0]).max()), 1e-12)
    found = []
    for m, (ways, spread) in enumerate(zip(coupling.ways, apart.transforms, strict=True)):
        if len(ways):
            counts = np.abs(spread[STEEP]).max(axis=-1) / largest / turning
            counts = np.maximum(counts, 1e-6)  # 0 in a clear sheet, whose light only its backing gives back
            if m == 0:
                counts[:modes] = 1.0 / tolerance
            products = (counts[:, None] * ways)[:, None] * optics.transmittance
            rows, columns = _separated(products.reshape(-1, ways.shape[1]), 1.0)
            rows = rows.reshape(len(ways), -1, len(columns)) / counts[:, None, None]
            found.append(Turning(m, rows, columns))
    return AngularBasis(found[0].rows, found[0].columns, tuple(found[1:]))


def _separated(products: Array, tolerance: float) -> tuple[Array, Array]:
    """Rows and columns, one or more, whose product is within a tolerance."""
    u, s, v = np.linalg.svd(products, full_matrices=False)
    for count in range(1, s.size + 1):
        rows, columns = u[:, :count] * s[:count], v[:count]
        if np.abs(rows @ columns - products).max() <= tolerance:
            break
    return rows, columns


def look_up(maps: Array, x: mi.Float, y: mi.Float) -> list[mi.Float]:
    """Values of maps (n, m, m), on cells [iy, ix] of the guide's face, at x and y in units of its width."""
    layers = np.ascontiguousarray(np.moveaxis(maps, 0, -1), dtype=np.float32)
    return list(mi.Texture2f(tensor(layers), wrap_mode=dr.WrapMode.Clamp).eval(mi.Point2f(x, y)))


@dataclass(frozen=True)
class Entrance:
    """An `AngularBasis` where the real contact fraction is (m, m), on cells over the guide's face."""

    basis: AngularBasis
    rows: Singles  # (functions, count, m, m)
    turning: tuple[Singles, ...]  # (functions, count, m, m) each

    @staticmethod
    def at(basis: AngularBasis, fraction: Array) -> Entrance:
        rows = [by_fraction(one, fraction) for one in (basis.rows, *(part.rows for part in basis.turning))]
        return Entrance(basis, rows[0], tuple(rows[1:]))


def transmitted(entrance: Entrance, irradiance: NDArray[np.floating], only: int | None = None) -> Singles:
    """Irradiance that enters the tissue, weighed with each function of the angle of entry, W/mm².

    From maps (n, layers, m, m) on cells over the face; (n, functions, m, m): those of harmonic 0, and of each
    harmonic after it its functions with the cosine of the azimuth, and again with the sine; or the first
    `only`.
    """
    basis = entrance.basis
    maps = np.moveaxis(irradiance, 1, 0).astype(np.float32, copy=False)
    found, first = [], len(basis.columns)

    def summed(rows: Singles, begin: int) -> None:
        for row in rows[:only]:
            total = row[0] * maps[begin]
            for k in range(1, len(row)):
                total += row[k] * maps[begin + k]
            found.append(total)

    summed(entrance.rows, 0)
    for rows in () if only else entrance.turning:
        for _ in ("cosine", "sine"):
            summed(rows, first)
            first += rows.shape[1]
    return np.stack(found, axis=1)


def by_fraction(rows: Array, fraction: Array) -> Singles:
    """Rows (functions, n_fraction, count), uniform on 0..1, at fractions (m, m): (functions, count, m, m)."""
    last = rows.shape[1] - 1
    at = np.clip(fraction, 0.0, 1.0) * last
    node = np.minimum(at.astype(np.int64), last - 1)
    share = (at - node).astype(np.float32)
    table = np.moveaxis(rows, 1, 2).astype(np.float32)
    return np.asarray(table[..., node] * (1.0 - share) + table[..., node + 1] * share)


def smooth(irradiance: Singles, factor: int = 4) -> Singles:
    """Smoothed irradiance on a grid `factor` times finer over the last two axes.

    The kernel 2 G - G * G has no second moment, so the curvature of the irradiance survives. It is mirrored
    at the rim, where the surface bends and light changes from cell to cell: those cells keep their values.
    """
    step = _smoothing_matrix(irradiance.shape[-1], factor, _SMOOTHING_CELLS).astype(irradiance.dtype)
    return np.asarray(step @ irradiance @ step.T)


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
