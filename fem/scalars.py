"""The three numbers of a contact surface: maximum, total and area, raw and tared."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    import pyvista as pv

Floats = NDArray[np.float64]

_FINE = 16  # cells of the subgrid along each side of a nine-node face


def scalars(surface: pv.PolyData, threshold_um: float) -> dict[str, dict[str, float]]:
    """Maximum, total and area of what is pushed into the probe.

    Parameters
    ----------
    surface
        From `press`: quads four to a nine-node face, `displacement` and `displacement_0` (n, 3) mm.
    threshold_um
        The k of the design, µm of displacement; `area` counts where the signal exceeds it.

    Returns
    -------
    {"raw": {...}, "tared": {...}}, each with `max_mm`, the largest displacement; `total_mm3`, its integral
    over the whole surface; `area_mm2`, where it exceeds the threshold. Pushed in is positive.
    """
    raw = -np.asarray(surface.point_data["displacement"])[:, 2]
    tared = raw + np.asarray(surface.point_data["displacement_0"])[:, 2]
    return {
        name: _three(surface, signal, threshold_um * 1e-3)
        for name, signal in (("raw", raw), ("tared", tared))
    }


def _three(surface: pv.PolyData, signal: Floats, threshold: float) -> dict[str, float]:
    nine = _nine(surface)
    x, y = np.asarray(surface.points)[:, 0], np.asarray(surface.points)[:, 1]
    size = (x[nine[:, 8]] - x[nine[:, 0]]) * (y[nine[:, 8]] - y[nine[:, 0]])
    fine = _refine(signal[nine].reshape(-1, 3, 3))
    simpson = np.outer([1, 4, 1], [1, 4, 1]).ravel() / 36  # exact for a biquadratic field
    share = _above(fine, threshold).mean(axis=(1, 2))
    return {
        "max_mm": float(fine.max()),
        "total_mm3": float(size @ (signal[nine] @ simpson)),
        "area_mm2": float((size * share).sum()),
    }


def _nine(surface: pv.PolyData) -> NDArray[np.int64]:
    """Nodes of the nine-node faces, (m, 9), x-major, from the order of their four quads."""
    quads = np.asarray(surface.faces).reshape(-1, 4, 5)[:, :, 1:]
    a, b, c, d = (quads[:, i] for i in range(4))
    return np.stack([a[:, 0], a[:, 3], c[:, 3], a[:, 1], a[:, 2], c[:, 2], b[:, 1], b[:, 2], d[:, 2]], axis=1)


def _refine(nodal: Floats) -> Floats:
    """Quadratic fields (m, 3, 3) on the corners of a fine subgrid (m, fine + 1, fine + 1)."""
    t = np.linspace(0, 1, _FINE + 1)
    shape = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)], axis=1)
    return np.asarray(shape @ nodal @ shape.T)


def _above(corners: Floats, threshold: float) -> Floats:
    """Share of each small cell above the threshold, linear on its two triangles; (m, fine, fine)."""
    f = corners - threshold
    a, b, c, d = f[:, :-1, :-1], f[:, 1:, :-1], f[:, :-1, 1:], f[:, 1:, 1:]
    return 0.5 * (_share(a, b, d) + _share(a, c, d))


def _share(a: Floats, b: Floats, c: Floats) -> Floats:
    """Share of a triangle on which the linear field with these corner values is positive."""
    low, middle, high = np.sort(np.stack([a, b, c]), axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        one_up = high**2 / ((high - low) * (high - middle))
        one_down = low**2 / ((low - high) * (low - middle))
    share = np.where(middle <= 0, one_up, 1 - one_down)
    return np.where(low >= 0, np.where(high > 0, 1.0, 0.0), np.where(high <= 0, 0.0, share))
