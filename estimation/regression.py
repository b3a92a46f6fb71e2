"""The mapping between two scalars: a straight line with its intervals, a parabola, a monotone fit.

The paper ([lee2011], section III.C, Fig. 5) maps what the camera sees to what the finite elements say by one
line per scalar. Intervals assume independent normal residuals of one variance (Draper and Smith 1998,
chapter 1; [draper1998]); leave-one-out errors of a polynomial follow in closed form from the leverages h,
e / (1 - h) (Allen 1974; [allen1974]).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import isotonic_regression
from scipy.special import ndtri, stdtrit

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Polynomial:
    """Least squares of y on 1, x, ..., x^degree.

    Attributes
    ----------
    coefficients : (degree + 1,) lowest power first, units of y over powers of those of x.
    sd : (degree + 1,) their standard errors.
    covariance : (degree + 1, degree + 1).
    residual : (n,) y minus fit.
    leverage : (n,) of each sample, 0 to 1.
    residual_sd : √(RSS / (n - degree - 1)).
    middle, scale : x = middle + scale u; u runs from -1 to 1 or less, and its powers keep the digits.
    scaled, scaled_covariance : (degree + 1,), (degree + 1, degree + 1): coefficients of the powers of u.
    """

    coefficients: Floats
    sd: Floats
    covariance: Floats
    residual: Floats
    leverage: Floats
    residual_sd: float
    middle: float
    scale: float
    scaled: Floats
    scaled_covariance: Floats

    @property
    def freedom(self) -> int:
        """Degrees of freedom of the residuals."""
        return len(self.residual) - len(self.coefficients)

    @property
    def rss(self) -> float:
        """Residual sum of squares."""
        return float(self.residual @ self.residual)

    def __call__(self, x: ArrayLike) -> Floats:
        """The fit at x (...)."""
        return np.asarray(np.polynomial.polynomial.polyval(self._scale(x), self.scaled))

    def _scale(self, x: ArrayLike) -> Floats:
        return np.asarray((np.asarray(x, np.float64) - self.middle) / self.scale)

    def left_out(self) -> Floats:
        """Leave-one-out errors (n,): each y minus the fit to all others."""
        return self.residual / np.maximum(1.0 - self.leverage, 1e-12)

    def confidence(self, x: ArrayLike, level: float = 0.95) -> tuple[Floats, Floats]:
        """Lower and upper end (...) for the mean of y at each x."""
        return self._interval(x, level, 0.0)

    def prediction(self, x: ArrayLike, level: float = 0.95) -> tuple[Floats, Floats]:
        """Lower and upper end (...) for one more y at each x."""
        return self._interval(x, level, self.residual_sd**2)

    def _interval(self, x: ArrayLike, level: float, more: float) -> tuple[Floats, Floats]:
        u = self._scale(x)
        powers = np.stack([u**k for k in range(len(self.scaled))], axis=-1)
        variance = np.einsum("...i,ij,...j->...", powers, self.scaled_covariance, powers) + more
        half = _quantile(level, self.freedom) * np.sqrt(np.maximum(variance, 0.0))
        return self(x) - half, self(x) + half


@dataclass(frozen=True)
class Line:
    """y = intercept + slope x, and how far to trust it.

    Attributes
    ----------
    slope, intercept : units of y over x, and of y.
    slope_interval, intercept_interval : (lower, upper) at `level`, Student's t.
    r2 : share of the variance of y that the line explains.
    r2_interval : at `level`, by Fisher's transform of the correlation (needs n >= 4, else 0 to 1).
    residual_sd : of y about the line, n - 2 degrees of freedom.
    left_out_rmse : root mean square of the leave-one-out errors, unit of y.
    level, count : of the intervals; number of samples.
    fit : the polynomial itself, with intervals at any x.
    """

    slope: float
    intercept: float
    slope_interval: tuple[float, float]
    intercept_interval: tuple[float, float]
    r2: float
    r2_interval: tuple[float, float]
    residual_sd: float
    left_out_rmse: float
    level: float
    count: int
    fit: Polynomial

    def __call__(self, x: ArrayLike) -> Floats:
        """y on the line at x (...)."""
        return self.fit(x)

    def inverse(self, y: ArrayLike) -> Floats:
        """x on the line at y (...)."""
        if self.slope == 0:
            raise ValueError("slope: received 0; allowed anything else, for a line to be inverted")
        return np.asarray((np.asarray(y, np.float64) - self.intercept) / self.slope)


def fit_line(x: ArrayLike, y: ArrayLike, level: float = 0.95) -> Line:
    """Regress y on x, (n,) each with n >= 3 and an x that varies; intervals at `level`, between 0 and 1."""
    fit = fit_polynomial(x, y, 1)
    heights = np.asarray(y, np.float64)
    spread = float(((heights - heights.mean()) ** 2).sum())
    r2 = 1.0 - fit.rss / spread if spread > 0 else 1.0
    half = _quantile(level, fit.freedom) * fit.sd
    intercept, slope = (float(c) for c in fit.coefficients)
    ends = [(float(c - h), float(c + h)) for c, h in zip(fit.coefficients, half, strict=True)]
    return Line(
        slope=slope,
        intercept=intercept,
        slope_interval=ends[1],
        intercept_interval=ends[0],
        r2=r2,
        r2_interval=_r2_interval(np.sign(slope) * np.sqrt(max(r2, 0.0)), len(heights), level),
        residual_sd=fit.residual_sd,
        left_out_rmse=float(np.sqrt((fit.left_out() ** 2).mean())),
        level=level,
        count=len(heights),
        fit=fit,
    )


def fit_polynomial(x: ArrayLike, y: ArrayLike, degree: int) -> Polynomial:
    """Least squares of degree 1 or more; (n,) each with n >= degree + 2 and degree + 1 different x."""
    at, heights = _samples(x, y, degree)
    middle, scale, level = float(at.mean()), float(np.abs(at - at.mean()).max()), heights.mean()
    q, r = np.linalg.qr(np.vander((at - middle) / scale, degree + 1, increasing=True))
    along = q.T @ (heights - level)
    residual = heights - level - q @ along
    residual_sd = float(np.sqrt(residual @ residual / (len(at) - degree - 1)))
    inverse = np.linalg.inv(r)
    scaled = inverse @ along + np.pad([level], (0, degree))
    scaled_covariance = residual_sd**2 * inverse @ inverse.T
    back = _change_of_variable(degree, middle, scale)
    covariance = back @ scaled_covariance @ back.T
    return Polynomial(
        coefficients=back @ scaled,
        sd=np.sqrt(np.diag(covariance)),
        covariance=covariance,
        residual=residual,
        leverage=(q**2).sum(axis=1),
        residual_sd=residual_sd,
        middle=middle,
        scale=scale,
        scaled=scaled,
        scaled_covariance=scaled_covariance,
    )


def fit_monotone(x: ArrayLike, y: ArrayLike) -> tuple[Floats, Floats]:
    """Best monotone fit, rising or falling: sorted different x (m,) and its values there (m,).

    Isotonic regression (Barlow et al. 1972; [barlow1972]); between the samples it is taken as linear, beyond
    them as constant.
    """
    at, heights = _samples(x, y, 1)
    order = np.argsort(at, kind="stable")
    knots, place, count = np.unique(at[order], return_inverse=True, return_counts=True)
    means = np.bincount(place, heights[order]) / count
    fits = [isotonic_regression(means, weights=count.astype(float), increasing=up).x for up in (True, False)]
    errors = [float((count * (fit - means) ** 2).sum()) for fit in fits]
    return knots, np.asarray(fits[int(errors[1] < errors[0])])


def monotone_left_out(x: ArrayLike, y: ArrayLike, most: int = 500) -> Floats:
    """Leave-one-out errors (m,) of the monotone fit, refitted for each; n >= 4.

    Where there are more than `most` samples, that many, evenly spread over the sorted x, are left out.
    """
    at, heights = _samples(x, y, 2)
    order = np.argsort(at, kind="stable")
    left = order[np.unique(np.rint(np.linspace(0, len(at) - 1, min(most, len(at)))).astype(int))]
    errors = np.empty(len(left))
    for n, i in enumerate(left):
        others = np.delete(at, i), np.delete(heights, i)
        errors[n] = heights[i] - np.interp(at[i], *fit_monotone(*others))
    return errors if len(left) < len(at) else errors[np.argsort(left)]


def _change_of_variable(degree: int, middle: float, scale: float) -> Floats:
    """Matrix from coefficients in u = (x - middle) / scale to those in x."""
    columns, power = [], np.ones(1)
    for _ in range(degree + 1):
        columns.append(np.pad(power, (0, degree + 1 - len(power))))
        power = np.convolve(power, [-middle / scale, 1.0 / scale])
    return np.stack(columns, axis=1)


def _r2_interval(correlation: float, count: int, level: float) -> tuple[float, float]:
    """Of the squared correlation, from tanh(artanh r ± z / √(n - 3)) (Fisher 1921; [fisher1921])."""
    if count < 4:
        return 0.0, 1.0
    if abs(correlation) >= 1.0 - 1e-15:
        return 1.0, 1.0
    half = float(ndtri(0.5 + level / 2.0)) / np.sqrt(count - 3)
    low, high = np.tanh(np.arctanh(correlation) + np.array([-half, half]))
    squares = sorted([float(low**2), float(high**2)])
    return (0.0 if low < 0 < high else squares[0]), squares[1]


def _quantile(level: float, freedom: int) -> float:
    if not 0 < level < 1:
        raise ValueError(f"level: received {level!r}; allowed a number between 0 and 1")
    return float(stdtrit(freedom, 0.5 + level / 2.0))


def _samples(x: ArrayLike, y: ArrayLike, degree: int) -> tuple[Floats, Floats]:
    at, heights = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if at.ndim != 1 or at.shape != heights.shape or len(at) < degree + 2:
        raise ValueError(
            f"x, y: received shapes {at.shape}, {heights.shape}; allowed (n,) both, n >= {degree + 2}"
        )
    if not (np.isfinite(at).all() and np.isfinite(heights).all()):
        raise ValueError("x, y: received NaN or infinity; allowed finite numbers")
    different = len(np.unique(at))
    if different < degree + 1:
        raise ValueError(f"x: received {different} different values; allowed {degree + 1} or more")
    return at, heights
