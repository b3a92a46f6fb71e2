"""From the lateral Fourier transform of a kernel back to its radial profile, and to sums over square cells.

Lengths in any one unit, wave numbers in its inverse.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from scipy.special import j0, j1, k0e, k1e

Array = NDArray[np.float64]

_TERMS = 110
_TOP = 500.0  # of k/b: beyond, the transform is its tail
_CUT = 60.0  # of k r, where the taper takes hold
_NEAR_CELLS = 12  # within this many cells a kernel is spread by rings, beyond by its values


@dataclass(frozen=True)
class Kernel:
    """An even, rotationally symmetric kernel R(r), given by its transform R^(k) = ∫ R J0(kr) 2πr dr.

    At large k the transform falls as c1/k + c2/k², so that the kernel rises as 1/r in the middle. Both
    parts are split off, c1/sqrt(k² + b²) and c2/(k² + b²), whose profiles are known; the rest is a
    Chebyshev series.

    Attributes
    ----------
    total
        R^(0).
    tail
        c1, c2 and b.
    scale
        Wave number s of the variable asinh(k/s) of the series: where R^ starts to bend.
    series
        Coefficients of the rest in T_n(2 (asinh(k/s)/asinh(top/s))² - 1), where top is 500 b.
    """

    total: float
    tail: tuple[float, float, float]
    scale: float
    series: Array

    def rest(self, k: Array) -> Array:
        """The transform less its tail, same shape as k >= 0."""
        y = np.arcsinh(k / self.scale) / np.arcsinh(_TOP * self.tail[2] / self.scale)
        inside = y <= 1.0
        return np.asarray(
            np.where(inside, chebyshev.chebval(2.0 * np.minimum(y, 1.0) ** 2 - 1.0, self.series), 0.0)
        )

    def transform(self, k: Array) -> Array:
        """R^(k), same shape as k >= 0."""
        c1, c2, b = self.tail
        return np.asarray(self.rest(k) + c1 / np.sqrt(k**2 + b**2) + c2 / (k**2 + b**2))

    def profile(self, r: Array) -> Array:
        """R(r), same shape as r > 0; per area."""
        (c1, c2, b), r = self.tail, np.asarray(r, dtype=np.float64)
        x, w = _hankel_nodes()
        rest = (self.rest(x / r[..., None]) * j0(x) * x) @ w / r**2
        fade = np.exp(-b * r)
        return np.asarray((c1 * fade / r + c2 * fade * k0e(b * r) + rest) / (2.0 * np.pi))

    def within(self, r: Array) -> Array:
        """∫ R 2πr dr up to r, same shape as r > 0."""
        (c1, c2, b), r = self.tail, np.asarray(r, dtype=np.float64)
        x, w = _hankel_nodes()
        rest = (self.rest(x / r[..., None]) * j1(x)) @ w
        fade = np.exp(-b * r)
        return np.asarray(c1 / b * -np.expm1(-b * r) + c2 / b**2 * (1.0 - b * r * fade * k1e(b * r)) + rest)

    def cells(self, step: float, count: int) -> Array:
        """Share (count, count) of a cell's light that comes back in the cell i, j cells away, both from 0.

        Averaged over both cells exactly: over the offset it is the integral of R times two tents of width
        2 `step`. Near the middle, where R rises as 1/r, rings of the kernel are dealt out to the cells by
        these tents, so that no light is lost; beyond, R is smooth in a cell.
        """
        reach = _NEAR_CELLS * step
        far = step * np.hypot(*np.meshgrid(np.arange(count), np.arange(count)))
        result = np.zeros((count, count))
        radius = np.geomspace(0.5 * reach, np.sqrt(2.0) * step * (count + 1), 400)
        log_profile = np.log(np.maximum(self.profile(radius), 1e-300))
        x, w = np.polynomial.legendre.leggauss(3)
        for dx, wx in zip(*_tent(x, w), strict=True):
            for dy, wy in zip(*_tent(x, w), strict=True):
                r = np.hypot((np.arange(count)[:, None] + dx) * step, (np.arange(count)[None, :] + dy) * step)
                value = np.exp(np.interp(np.log(np.maximum(r, radius[0])), np.log(radius), log_profile))
                result += wx * wy * step**2 * np.where(far > reach, value, 0.0)
        return result + self._rings(step, count, far)

    def _rings(self, step: float, count: int, far: Array) -> Array:
        """What the near cells get, by rings of equal logarithmic width."""
        near = int(_NEAR_CELLS) + 2
        edges = np.concatenate(
            [np.geomspace(1e-4 * step, 0.5 * step, 60), np.arange(0.55, near + 1.0, 0.05) * step]
        )
        inside = np.concatenate([[0.0], self.within(edges)])
        middle = np.concatenate([[0.5 * edges[0]], 0.5 * (edges[1:] + edges[:-1])]) / step
        grid = np.zeros((near + 3, near + 3))
        angle = (np.arange(90) + 0.5) / 90 * 0.5 * np.pi
        x, y = (np.abs(part(angle) * middle[:, None]).ravel() for part in (np.cos, np.sin))
        mass = np.repeat(np.diff(inside) / 90, 90)
        i, j = np.floor(x).astype(int), np.floor(y).astype(int)
        u, v = x - i, y - j
        for ii, jj, share in (
            (i, j, (1 - u) * (1 - v)),
            (i + 1, j, u * (1 - v)),
            (i, j + 1, (1 - u) * v),
            (i + 1, j + 1, u * v),
        ):
            np.add.at(grid, (ii, jj), mass * share)
        # a quarter turn holds the light of four quadrants, of which two or four share the cells on an axis
        grid[1:, 0] *= 0.5
        grid[0, 1:] *= 0.5
        grid[1:, 1:] *= 0.25
        shown = min(count, near)
        result = np.zeros((count, count))
        grid = 0.5 * (grid + grid.T)
        result[:shown, :shown] = np.where(
            far[:shown, :shown] <= _NEAR_CELLS * step, grid[:shown, :shown], 0.0
        )
        return result


def kernel(hat: Callable[[Array], Array], first: float, scale: float, decay: float) -> Kernel:
    """Make the kernel of a transform.

    Parameters
    ----------
    hat
        R^(k), vectorised over k >= 0.
    first
        c1, the limit of k R^(k).
    scale
        Where R^ starts to bend: about its nearest singularity on the imaginary axis.
    decay
        b of the tail's parts: about where R^ gets to its tail.
    """
    scale, top = max(scale, 1e-4), _TOP * decay
    y = np.cos(np.pi * (np.arange(_TERMS) + 0.5) / _TERMS)
    k = scale * np.sinh(np.sqrt(0.5 * (1.0 + y)) * np.arcsinh(top / scale))
    values = hat(np.concatenate([[0.0, 0.5 * top], k]))
    middle = 0.5 * top
    second = (values[1] - first / np.hypot(middle, decay)) * (middle**2 + decay**2)
    rest = values[2:] - first / np.sqrt(k**2 + decay**2) - second / (k**2 + decay**2)
    series = chebyshev.chebfit(y, rest, _TERMS - 1)
    return Kernel(float(values[0]), (first, float(second), decay), scale, series)


@lru_cache(maxsize=1)
def _hankel_nodes() -> tuple[Array, Array]:
    """Nodes x = k r and tapered weights of the Hankel integrals.

    The taper exp(-(x/cut)^4) blurs the profile by a kernel without second moment, relative to r.
    """
    edges = np.concatenate([[0.0], np.geomspace(1e-6, 1.0, 28), np.arange(2.5, 2.5 * _CUT, 1.5)])
    x, w = np.polynomial.legendre.leggauss(8)
    half = 0.5 * np.diff(edges)
    nodes = (edges[:-1, None] + half[:, None] * (1.0 + x)).ravel()
    return nodes, (half[:, None] * w).ravel() * np.exp(-((nodes / _CUT) ** 4))


def _tent(x: Array, w: Array) -> tuple[Array, Array]:
    """Offsets and weights of the integral of a tent on -1..1 times a smooth function."""
    t = 0.5 * (1.0 + x)
    return np.concatenate([-t, t]), np.concatenate([0.5 * w * (1.0 - t)] * 2)
