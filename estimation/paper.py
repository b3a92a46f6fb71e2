"""The source paper's tables, and errors counted as it says and as it did ([lee2011], section IV).

Its equation (1) is a root mean square, but the figures of its Table III are mean absolute errors of Table II.
So errors are always given both ways, with the bias and beside those of a constant: the mean of the truths,
which needs no picture at all.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]

PARAMETERS = ("size_mm", "depth_mm", "modulus_kPa")
"""Columns of all tables: diameter, depth of the inclusion's top, Young's modulus."""

RANGES = {"size_mm": (2.0, 13.0), "depth_mm": (4.0, 12.0), "modulus_kPa": (40.0, 120.0)}
"""The box that the paper's 134 training inclusions were drawn from (section III.B)."""


@dataclass(frozen=True)
class Errors:
    """Errors of estimates, (k,) each in the parameters' units; bias is estimate minus truth."""

    mae: Floats
    rmse: Floats
    bias: Floats


def true_inclusions() -> Floats:
    """Table I: (9, 3) size mm, depth mm, modulus kPa of the phantom's inclusions."""
    return _table("table1.csv")


def published_estimates() -> Floats:
    """Table II: (9, 3) what the paper estimated, mm, mm, kPa."""
    return _table("table2.csv")


def published_errors() -> Floats:
    """Table III: (3,) mm, mm, kPa, printed as root mean squared errors."""
    return _table("table3.csv")[0]


def mae(truth: ArrayLike, estimate: ArrayLike) -> Floats:
    """Mean absolute error (k,) of estimates (n, k)."""
    return np.asarray(np.abs(_error(truth, estimate)).mean(axis=0))


def rmse(truth: ArrayLike, estimate: ArrayLike) -> Floats:
    """Root mean squared error (k,) of estimates (n, k): the paper's equation (1)."""
    return np.asarray(np.sqrt((_error(truth, estimate) ** 2).mean(axis=0)))


def bias(truth: ArrayLike, estimate: ArrayLike) -> Floats:
    """Mean of estimate minus truth, (k,), of estimates (n, k)."""
    return np.asarray(_error(truth, estimate).mean(axis=0))


def errors(truth: ArrayLike, estimate: ArrayLike) -> Errors:
    """All three."""
    return Errors(mae(truth, estimate), rmse(truth, estimate), bias(truth, estimate))


def constant(truth: ArrayLike, value: ArrayLike | None = None) -> Floats:
    """Estimates (n, k) that are the same (k,) always; without `value` the mean of the truths."""
    known = np.asarray(truth, np.float64)
    answer = known.mean(axis=0) if value is None else np.asarray(value, np.float64)
    return np.array(np.broadcast_to(answer, known.shape))


def prior_mean() -> Floats:
    """Middle (3,) of the box of training inclusions: the best constant that has not seen the test."""
    return np.array([sum(RANGES[name]) / 2 for name in PARAMETERS])


def _error(truth: ArrayLike, estimate: ArrayLike) -> Floats:
    known, found = np.asarray(truth, np.float64), np.asarray(estimate, np.float64)
    if known.shape != found.shape or known.ndim != 2 or not known.size:
        raise ValueError(f"estimate: received shape {found.shape}; allowed that of the truth, {known.shape}")
    return found - known


def _table(name: str) -> Floats:
    """Columns `PARAMETERS` of a table of the paper."""
    text = files("assets").joinpath("paper", name).read_text(encoding="utf-8")
    head, *rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return np.array([[float(row[head.index(key)]) for key in PARAMETERS] for row in rows])
