"""Real solid harmonics as polynomials of x, y, z: values, gradients and Hessians, regular and singular.

r^l cos(m a) P_lm and r^l sin(m a) P_lm in Cartesian form, which has no trouble on the axis; the singular ones
are their Kelvin transforms, divided by r^(2 l + 1) (Hobson 1931, chapter 4; [hobson1931]).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from math import comb

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Polynomial = dict[tuple[int, int, int], float]

_PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
_HESSIAN = [[0, 3, 4], [3, 1, 5], [4, 5, 2]]  # where the six second derivatives stand


@dataclass(frozen=True)
class Jet:
    """Values (n, k), gradients (n, k, 3) and, when asked for, Hessians (n, k, 3, 3) of k functions."""

    value: Floats
    slope: Floats
    second: Callable[[], Floats]


@dataclass(frozen=True)
class Harmonic:
    """One solid harmonic: degree, order, and whether of the cosine or the sine of the azimuth."""

    degree: int
    order: int
    sine: bool

    def parity(self, axis: int) -> int:
        """1 if even, -1 if odd under the mirror across x = 0 or y = 0."""
        odd = self.sine if axis == 1 else self.sine ^ bool(self.order % 2)
        return -1 if odd else 1

    @property
    def swapped(self) -> int:
        """1 if even, -1 if odd when x and y are exchanged, 0 if neither."""
        if self.order % 2:
            return 0
        sign = 1 if self.order % 4 == 0 else -1
        return -sign if self.sine else sign

    def polynomial(self) -> Polynomial:
        """Coefficients of the powers (i, j, k) of x, y, z; harmonic by the recurrence of its terms."""
        azimuth: Polynomial = {}
        for power in range(self.sine, self.order + 1, 2):  # of i y in (x + i y)^m
            azimuth[self.order - power, power, 0] = (-1.0) ** (power // 2) * comb(self.order, power)
        found: Polynomial = {}
        term, left = 1.0, self.degree - self.order
        for j in range(left // 2 + 1):  # term z^(left - 2 j) (x² + y²)^j
            for q in range(j + 1):
                for (x, y, _), value in azimuth.items():
                    key = (x + 2 * (j - q), y + 2 * q, left - 2 * j)
                    found[key] = found.get(key, 0.0) + term * comb(j, q) * value
            term *= -(left - 2 * j) * (left - 2 * j - 1) / (4 * (j + 1) * (self.order + j + 1))
        return found


def harmonics(degree: int) -> list[Harmonic]:
    """All up to a degree."""
    return [
        Harmonic(n, m, sine)
        for n in range(degree + 1)
        for m in range(n + 1)
        for sine in (False, True)
        if m or not sine
    ]


def _derived(of: Polynomial, axis: int) -> Polynomial:
    found: Polynomial = {}
    for key, value in of.items():
        if key[axis]:
            lower = tuple(power - (a == axis) for a, power in enumerate(key))
            found[lower] = value * key[axis]  # type: ignore[index]
    return found


@lru_cache(maxsize=32)
def _table(some: tuple[Harmonic, ...]) -> tuple[NDArray[np.int64], Floats]:
    """Powers (n, 3), and the coefficients (n, 10, harmonics) of value, three slopes, six second ones."""
    columns = []
    for one in some:
        value = one.polynomial()
        slopes = [_derived(value, axis) for axis in range(3)]
        columns += [value, *slopes, *(_derived(slopes[a], b) for a, b in _PAIRS)]
    powers = sorted({key for column in columns for key in column})
    table = np.array([[column.get(key, 0.0) for column in columns] for key in powers])
    return np.array(powers), np.ascontiguousarray(table.reshape(len(powers), -1, 10).swapaxes(1, 2))


def regular(some: tuple[Harmonic, ...], at: Floats) -> Jet:
    """Values (n, k), gradients (n, k, 3) and Hessians (n, k, 3, 3) of k harmonics at places (n, 3)."""
    powers, table = _table(some)
    each = at[:, None, :] ** np.arange(powers.max() + 1)[:, None]
    monomials = each[:, powers[:, 0], 0] * each[:, powers[:, 1], 1] * each[:, powers[:, 2], 2]
    value, *slopes = (monomials @ table[:, k] for k in range(4))

    def second() -> Floats:
        six = (monomials @ table[:, 4:].reshape(len(powers), -1)).reshape(len(at), 6, -1)
        return six[:, _HESSIAN].transpose(0, 3, 1, 2)

    return Jet(value, np.stack(slopes, axis=-1), second)


def singular(some: tuple[Harmonic, ...], at: Floats) -> Jet:
    """The same of those divided by r^(2 l + 1)."""
    of = regular(some, at)
    power = np.array([2 * one.degree + 1 for one in some])
    square = (at**2).sum(axis=1)[:, None]
    over = square ** (-power / 2)
    part = (power * of.value / square)[..., None]  # (n, k, 1)
    x = at[:, None, :]

    def second() -> Floats:
        near = (power / square)[..., None, None]
        twice = of.slope[..., :, None] * x[..., None, :]
        found = of.second() - near * (twice + twice.swapaxes(-1, -2))
        found += ((power + 2)[:, None] / square[..., None] * part * x)[..., None] * x[..., None, :]
        found[..., [0, 1, 2], [0, 1, 2]] -= part
        return found * over[..., None, None]

    return Jet(of.value * over, (of.slope - part * x) * over[..., None], second)
