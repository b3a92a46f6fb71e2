"""Is a straight line adequate for this mapping, and in which range?

Three fits are compared by their leave-one-out errors: line, parabola and monotone fit; line and parabola also
by the F test of the quadratic term (Draper and Smith 1998, chapter 6; [draper1998]) and by AICc (Hurvich
and Tsai 1989; [hurvich1989]). Shares below are of the span of y over all samples, largest minus smallest, so
that a narrow range is not judged by its own small span.

**A line holds** in a range if

1. its leave-one-out error (root mean square, fitted within the range) is at most `tolerance` of the span, and
2. it is not bent: the quadratic term is not significant at `alpha`, or the parabola departs from the line by
   at most `negligible` of the span anywhere in the range. Without this second way out, samples enough would
   call every line bent.

It is **adequate** if it holds over all samples; `why` says what decided. The **range** is the widest run of
neighbouring samples, by its extent in x, in which it holds; runs have at least `least` samples, and begin and
end at `ends` quantiles of x where there are more samples than that. The range is the best of many that were
tried, so a p just above `alpha` at its end means little: it says where a line may be used, not where physics
changes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import fdtrc

from estimation.regression import Line, Polynomial, fit_line, fit_polynomial, monotone_left_out

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What counts as linear; shares of y's span, and a level of significance, each between 0 and 1."""

    tolerance: float = 0.05
    alpha: float = 0.05
    negligible: float = 0.01
    least: int = 8
    ends: int = 60

    def __post_init__(self) -> None:
        for name in ("tolerance", "alpha", "negligible"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name}: received {getattr(self, name)!r}; allowed between 0 and 1")
        if self.least < 5 or self.ends < 2:
            raise ValueError(f"least, ends: received {self.least}, {self.ends}; allowed >= 5, >= 2")


@dataclass(frozen=True)
class Adequacy:
    """The three fits compared, and the verdict on the line.

    Attributes
    ----------
    line, parabola : fitted to all samples.
    left_out : leave-one-out RMSE of ``linear``, ``quadratic`` and ``monotone``, unit of y.
    aicc : of ``linear`` and ``quadratic``; the lower is the better, differences below 2 mean little.
    f, p : of the F test that the quadratic term is zero.
    bow : largest departure of parabola from line within the samples, share of y's span.
    error : leave-one-out RMSE of the line, share of y's span.
    adequate : whether the line holds over all samples.
    best : which of the three has the least leave-one-out error.
    why : one sentence with the figures.
    range : (from, to) in x where a line holds, or None where no run of samples is long enough.
    range_count, range_line : samples in it, and the line fitted to them.
    """

    line: Line
    parabola: Polynomial
    left_out: dict[str, float]
    aicc: dict[str, float]
    f: float
    p: float
    bow: float
    error: float
    adequate: bool
    best: str
    why: str
    range: tuple[float, float] | None
    range_count: int
    range_line: Line | None


def judge_line(x: ArrayLike, y: ArrayLike, limits: Limits | None = None, level: float = 0.95) -> Adequacy:
    """Compare the fits of y on x, (n,) each, n >= 5 with 3 or more different x; intervals at `level`."""
    limits = limits or Limits()
    at, heights = np.asarray(x, np.float64), np.asarray(y, np.float64)
    if len(at) < 5:
        raise ValueError(f"x: received {len(at)} samples; allowed 5 or more")
    line, parabola = fit_line(at, heights, level), fit_polynomial(at, heights, 2)
    span = _span(heights)
    f, p = quadratic_test(line.fit, parabola)
    left = {
        "linear": line.left_out_rmse,
        "quadratic": _rms(parabola.left_out()),
        "monotone": _rms(monotone_left_out(at, heights)),
    }
    error, bow = line.left_out_rmse / span, _bow(at, line.fit, parabola) / span
    adequate = _holds(error, bow, p, limits)
    found = _widest(at, heights, span, limits)
    inside = None if found is None else (at >= found[0]) & (at <= found[1])
    return Adequacy(
        line=line,
        parabola=parabola,
        left_out=left,
        aicc={"linear": _aicc(line.fit), "quadratic": _aicc(parabola)},
        f=f,
        p=p,
        bow=bow,
        error=error,
        adequate=adequate,
        best=min(left, key=lambda name: left[name]),
        why=_why(error, bow, p, adequate, limits),
        range=found,
        range_count=0 if inside is None else int(inside.sum()),
        range_line=None if inside is None else fit_line(at[inside], heights[inside], level),
    )


def quadratic_test(line: Polynomial, parabola: Polynomial) -> tuple[float, float]:
    """F of the quadratic term, with 1 and n - 3 degrees of freedom, and the chance of a larger one."""
    gain = max(line.rss - parabola.rss, 0.0)
    f = gain / (max(parabola.rss, 1e-300) / parabola.freedom)
    return f, float(fdtrc(1, parabola.freedom, f))


def _widest(x: Floats, y: Floats, span: float, limits: Limits) -> tuple[float, float] | None:
    """Ends of the widest run of neighbouring samples in which a line holds."""
    order = np.argsort(x, kind="stable")
    x, y = x[order], y[order]
    ends = np.unique(np.rint(np.linspace(0, len(x) - 1, min(limits.ends, len(x)))).astype(int))
    runs = [(i, j) for i in ends for j in ends if j - i + 1 >= limits.least and x[j] > x[i]]
    for i, j in sorted(runs, key=lambda run: (x[run[0]] - x[run[1]], run)):
        at, heights = x[i : j + 1], y[i : j + 1]
        if len(np.unique(at)) < 3:
            continue
        line, parabola = fit_polynomial(at, heights, 1), fit_polynomial(at, heights, 2)
        error, bow = _rms(line.left_out()) / span, _bow(at, line, parabola) / span
        if _holds(error, bow, quadratic_test(line, parabola)[1], limits):
            return float(x[i]), float(x[j])
    return None


def _holds(error: float, bow: float, p: float, limits: Limits) -> bool:
    return error <= limits.tolerance and (p >= limits.alpha or bow <= limits.negligible)


def _why(error: float, bow: float, p: float, adequate: bool, limits: Limits) -> str:
    """The verdict in one sentence."""
    figures = (
        f"leave-one-out error {100 * error:.2g} % of the span (allowed {100 * limits.tolerance:g} %), "
        f"bow {100 * bow:.2g} % (negligible up to {100 * limits.negligible:g} %), p of the bend {p:.2g}"
    )
    if adequate:
        return f"adequate: {figures}"
    reasons = ["scattered"] * (error > limits.tolerance)
    reasons += ["bent"] * (p < limits.alpha and bow > limits.negligible)
    return f"not adequate, {' and '.join(reasons)}: {figures}"


def _bow(x: Floats, line: Polynomial, parabola: Polynomial) -> float:
    """Largest departure between the two within the samples: at an end or where their difference turns."""
    apart = parabola.scaled - np.pad(line.scaled, (0, 1))  # both are in the same u
    u = (np.array([x.min(), x.max()]) - line.middle) / line.scale
    if apart[2] != 0:
        u = np.append(u, np.clip(-apart[1] / (2.0 * apart[2]), *u))
    return float(np.abs(np.polynomial.polynomial.polyval(u, apart)).max())


def _aicc(fit: Polynomial) -> float:
    """n ln(RSS/n) + 2k + 2k(k+1)/(n-k-1), with k counting the variance (Hurvich and Tsai 1989)."""
    n, k = len(fit.residual), len(fit.coefficients) + 1
    small = np.inf if n <= k + 1 else 2.0 * k * (k + 1) / (n - k - 1)
    return float(n * np.log(max(fit.rss, 1e-300) / n) + 2 * k + small)


def _span(y: Floats) -> float:
    span = float(np.ptp(y))
    if not span > 0:
        raise ValueError("y: received a constant; allowed values that differ")
    return span


def _rms(errors: Floats) -> float:
    return float(np.sqrt((errors**2).mean()))
