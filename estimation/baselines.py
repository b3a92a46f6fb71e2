"""The methods before the paper: a Gaussian fitted to the picture, inverted through a table of 2-D solutions.

The paper's introduction ([lee2011]) names them: "2-dimensional finite element method based forward
algorithm and Gaussian fitting model-based inversion algorithms" (its reference 9), extended to more
inclusions (10), for inclusions at least 100 times as stiff as the tissue, and a network trained on few 2-D
solutions (11), which is `estimation.ann` with another table. It gives no details; what stands here is the
plainest reading:

- a bump A exp(-r²/2s²) over a slanted background is fitted to the tared picture (`fit_bump`), or to a line
  of displacements (`fit_profile`);
- its amplitude and width are looked for among those of the table, interpolated between its entries, by
  least squares (`invert_table`). Two numbers give two unknowns, d and h, and E is not estimated.

Amplitudes of pictures are counts, those of the mechanics mm: a line (`estimation.regression`) joins them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.interpolate import RBFInterpolator
from scipy.optimize import least_squares

Floats = NDArray[np.float64]

_ENOUGH = 20_000  # pixels that a bump of a few parameters is fitted to; larger pictures are binned


@dataclass(frozen=True)
class Bump:
    """A exp(-((x - x0)² + (y - y0)²) / 2s²) + level + slope_x x + slope_y y, in the picture's unit.

    Attributes
    ----------
    amplitude, level : counts, or the unit of what was fitted.
    sigma_mm : s.
    x_mm, y_mm : the centre, from the picture's; +x along columns, +y against rows.
    slope_x, slope_y : per mm.
    residual_rms : of what the fit leaves (of bins, where the picture was binned).
    """

    amplitude: float
    sigma_mm: float
    x_mm: float
    y_mm: float
    level: float
    slope_x: float
    slope_y: float
    residual_rms: float

    @property
    def volume(self) -> float:
        """2 π s² A, unit times mm²."""
        return 2.0 * np.pi * self.sigma_mm**2 * self.amplitude


def fit_bump(picture: ArrayLike, pixel_mm: tuple[float, float]) -> Bump:
    """Least squares of a round bump over a slanted background.

    Parameters
    ----------
    picture : (rows, columns) tared counts, 6 x 6 or more.
    pixel_mm : width (along x) and height of a pixel on the contact surface.
    """
    whole = np.asarray(picture, np.float64)
    if whole.ndim != 2 or min(whole.shape) < 6 or not np.isfinite(whole).all():
        raise ValueError(f"picture: received shape {whole.shape}; allowed (rows, columns), 6 or more, finite")
    if not min(pixel_mm) > 0:
        raise ValueError(f"pixel_mm: received {pixel_mm!r}; allowed two numbers > 0")
    values, x, y = _binned(whole, pixel_mm)
    ground = np.stack([np.ones(values.size), x, y], axis=1)
    widest = float(np.hypot(np.ptp(x), np.ptp(y)))
    least = np.array([x.min(), y.min(), 0.5 * min(_step(x), _step(y))])
    most = np.array([x.max(), y.max(), widest])
    begin = np.clip(_first_guess(values, x, y, ground, widest), least, most)

    def solved(theta: Floats) -> tuple[Floats, Floats]:
        """Linear parameters, and what they leave (Golub and Pereyra's separation)."""
        shape = np.exp(-((x - theta[0]) ** 2 + (y - theta[1]) ** 2) / (2.0 * theta[2] ** 2))
        design = np.column_stack([shape, ground])
        found = np.linalg.lstsq(design, values, rcond=None)[0]
        return found, values - design @ found

    fit = least_squares(lambda theta: solved(theta)[1], begin, bounds=(least, most), x_scale=widest / 10)
    (amplitude, level, slope_x, slope_y), left = solved(fit.x)
    at_x, at_y, sigma = (float(v) for v in fit.x)
    rms = float(np.sqrt((left**2).mean()))
    return Bump(float(amplitude), sigma, at_x, at_y, float(level), float(slope_x), float(slope_y), rms)


def fit_profile(x: ArrayLike, values: ArrayLike) -> tuple[float, float, float]:
    """Amplitude, sigma (unit of x) and level of A exp(-x²/2s²) + level along a line through the centre.

    Parameters
    ----------
    x : (n,) distances from the axis, of any sign, n >= 4.
    values : (n,) such as a 2-D solution's tared displacement.
    """
    at, heights = np.asarray(x, np.float64), np.asarray(values, np.float64)
    if at.ndim != 1 or at.shape != heights.shape or len(at) < 4:
        raise ValueError(f"x, values: received shapes {at.shape}, {heights.shape}; allowed (n,) both, n >= 4")
    reach = float(np.abs(at).max())

    def solved(sigma: Floats) -> tuple[Floats, Floats]:
        design = np.column_stack([np.exp(-(at**2) / (2.0 * sigma**2)), np.ones(len(at))])
        found = np.linalg.lstsq(design, heights, rcond=None)[0]
        return found, heights - design @ found

    starts = reach * np.array([0.05, 0.15, 0.4, 1.0])
    tried = [least_squares(lambda s: solved(s)[1], [s], bounds=(1e-3 * reach, 5 * reach)) for s in starts]
    best = min(tried, key=lambda fit: fit.cost)
    amplitude, level = solved(best.x)[0]
    return float(amplitude), float(best.x[0]), float(level)


def invert_table(
    parameters: ArrayLike, answers: ArrayLike, observed: ArrayLike, sd: ArrayLike, starts: int = 5
) -> tuple[Floats, Floats]:
    """Parameters whose answers come nearest to what was observed, and the misfits.

    Between its entries the table is interpolated with thin plate splines; the search stays within the box of
    its parameters and begins at the nearest entries.

    Parameters
    ----------
    parameters : (m, p) of the table, such as d and h.
    answers : (m, k) what each gives, such as a bump's amplitude and width.
    observed : (n, k).
    sd : (k,) what a misfit of one in each answer is, > 0.
    starts : nearest entries that the search begins from.

    Returns
    -------
    (n, p) estimates, and (n,) root mean squared misfits in units of sd.
    """
    table, given = np.asarray(parameters, np.float64), np.asarray(answers, np.float64)
    seen, unit = np.asarray(observed, np.float64), np.asarray(sd, np.float64)
    if table.ndim != 2 or given.ndim != 2 or len(table) != len(given):
        raise ValueError(f"answers: received shape {given.shape}; allowed (m, k) with m of {table.shape}")
    if seen.ndim != 2 or seen.shape[1] != given.shape[1] or unit.shape != given.shape[1:]:
        raise ValueError(
            f"observed, sd: received {seen.shape}, {unit.shape}; allowed (n, k), (k,) as the answers"
        )
    if not (unit > 0).all():
        raise ValueError(f"sd: received {unit.tolist()}; allowed numbers > 0")
    low, high = table.min(axis=0), table.max(axis=0)
    wide = np.where(high > low, high - low, 1.0)
    spline = RBFInterpolator((table - low) / wide, given / unit, kernel="thin_plate_spline")
    box = np.zeros(table.shape[1]), np.where(high > low, 1.0, 1e-9)
    estimates, misfits = [], []
    for target in seen / unit:
        near = np.argsort(((given / unit - target) ** 2).sum(axis=1))[:starts]
        tried = [
            least_squares(lambda u, goal=target: spline(u[None])[0] - goal, np.clip(u, *box), bounds=box)
            for u in (table[near] - low) / wide
        ]
        best = min(tried, key=lambda fit: fit.cost)
        estimates.append(low + wide * best.x)
        misfits.append(np.sqrt(2.0 * best.cost / len(target)))
    return np.array(estimates), np.array(misfits)


def _binned(whole: Floats, pixel_mm: tuple[float, float]) -> tuple[Floats, Floats, Floats]:
    """Means over square blocks of pixels and their centres in mm from the picture's, (n,) each."""
    rows, columns = whole.shape
    block = max(1, int(np.ceil(np.sqrt(whole.size / _ENOUGH))))
    block = min(block, rows // 6, columns // 6)
    down, across = rows // block, columns // block
    means = whole[: down * block, : across * block].reshape(down, block, across, block).mean(axis=(1, 3))
    x = (block * (np.arange(across) + 0.5) - columns / 2) * pixel_mm[0]
    y = (rows / 2 - block * (np.arange(down) + 0.5)) * pixel_mm[1]
    at_x, at_y = np.meshgrid(x, y)
    return means.ravel(), at_x.ravel(), at_y.ravel()


def _first_guess(values: Floats, x: Floats, y: Floats, ground: Floats, widest: float) -> Floats:
    """Centre and sigma of what stands out over the plane through the picture's median."""
    rest = values - ground @ np.linalg.lstsq(ground, values, rcond=None)[0]
    weight = np.maximum(rest - 0.5 * np.quantile(rest, 0.999), 0.0)
    if not weight.sum() > 0:
        return np.array([0.0, 0.0, widest / 10])
    x0, y0 = (weight @ x) / weight.sum(), (weight @ y) / weight.sum()
    spread = weight @ ((x - x0) ** 2 + (y - y0) ** 2) / weight.sum() / 2.0
    return np.array([x0, y0, max(np.sqrt(2.0 * spread), widest / 100)])


def _step(places: Floats) -> float:
    return float(np.diff(np.unique(places)).max())
