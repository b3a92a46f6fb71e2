"""The three numbers of a plane press, in the meaning of `fem.scalars`: maximum, total and area."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fem.plane import Press2D
from fem.plane_bodies import hat_means

Floats = NDArray[np.float64]

_FINE = 64  # parts of a contact element, on which its quadratic field is taken as linear


def scalars_2d(press: Press2D, threshold_um: float) -> dict[str, dict[str, float]]:
    """Maximum, total and area of what is pushed into the probe.

    Parameters
    ----------
    press
        From `press_2d`.
    threshold_um
        The k of the design, µm of displacement; the area counts where the signal exceeds it.

    Returns
    -------
    {"raw": {...}, "tared": {...}}; pushed in is positive. In axisymmetry each has `max_mm`, `total_mm3` and
    `area_mm2` of the whole disc. In plane strain a picture has no end along y, so total and area are per mm
    of width, both sides of the axis: `max_mm`, `total_mm2` (mm³ per mm) and `area_mm` (mm² per mm: the length
    where the signal exceeds the threshold).
    """
    raw = -press.displacement[:, 1]
    tared = raw + press.displacement_0[:, 1]
    return {name: _three(press, s, threshold_um * 1e-3) for name, s in (("raw", raw), ("tared", tared))}


def _three(press: Press2D, signal: Floats, threshold: float) -> dict[str, float]:
    t = np.linspace(0, 1, _FINE + 1)
    shape = np.stack([(1 - t) * (1 - 2 * t), 4 * t * (1 - t), t * (2 * t - 1)])
    x, line = press.x, signal
    fine = np.stack([line[:-2:2], line[1:-1:2], line[2::2]], axis=1) @ shape
    place = x[:-2:2, None] + t * (x[2::2] - x[:-2:2])[:, None]
    # the ends of what lies above the threshold in each part
    (f, g), (a, b) = ((v[:, :-1], v[:, 1:]) for v in (fine - threshold, place))
    with np.errstate(divide="ignore", invalid="ignore"):
        zero = a + (b - a) * f / (f - g)
    low = np.where(f > 0, a, np.where(g > 0, zero, b))
    high = np.where(g > 0, b, np.where(f > 0, zero, b))
    plane = press.kind == "plane_strain"
    whole = 2 * (high - low) if plane else np.pi * (high**2 - low**2)
    total = (2 if plane else 1) * float(hat_means(x, press.kind, 0).sum(axis=0) @ signal)
    names = ("total_mm2", "area_mm") if plane else ("total_mm3", "area_mm2")
    return {"max_mm": float(fine.max()), names[0]: total, names[1]: float(whole.sum())}
