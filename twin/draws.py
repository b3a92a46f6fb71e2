"""Random numbers of a corpus: counter-based, so that a sample's draws depend on nothing but its place.

Every purpose (an inclusion's parameter, a field of the design, the light) has its own stream: Philox (Salmon
et al. 2011; [salmon2011]) under a key of seed, group, purpose and attempt. A sample's number is the one that
stands at its place in the stream, so no count, order or other purpose moves it. Only the generator's raw
integers are used, whose sequence numpy keeps for good; distributions are their own quantile functions. Latin
and Sobol sequences are of a group as a whole.
"""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri
from scipy.stats import qmc

from twin.complaint import DesignError, shown
from twin.study import PARAMETERS, Distribution, Group, Ranges

Floats = NDArray[np.float64]

LEAST_SHARE = 0.01
"""Least share of a normal distribution between its bounds."""
_IN_CELL = 8
"""Attempts that a Latin sample makes in its own cell."""


@dataclass(frozen=True)
class Stream:
    """The random numbers of one group of samples."""

    seed: int
    group: str

    def _key(self, purpose: str, attempt: int) -> NDArray[np.uint64]:
        text = f"{self.seed}\0{self.group}\0{purpose}\0{attempt}".encode()
        return np.frombuffer(hashlib.sha256(text).digest()[:16], "<u8").astype(np.uint64)

    def _philox(self, purpose: str, attempt: int, block: int = 0) -> np.random.Philox:
        return np.random.Philox(key=self._key(purpose, attempt), counter=block)

    def generator(self, purpose: str) -> np.random.Generator:
        """Return a generator for what the group draws as a whole."""
        return np.random.default_rng(np.random.SeedSequence(self._key(purpose, 0).tolist()))

    def many(self, purpose: str, count: int, attempt: int = 0) -> Floats:
        """Return the numbers of samples 0 to count - 1, (count,), uniform between 0 and 1, ends left out."""
        return _open(np.atleast_1d(self._philox(purpose, attempt).random_raw(count)))

    def one(self, purpose: str, sample: int, attempt: int = 0) -> float:
        """Return the number of one sample, the same as among `many`."""
        block = self._philox(purpose, attempt, sample // 4).random_raw(4)  # four numbers to a block
        return float(_open(np.asarray(block))[sample % 4])

    def whole(self, purpose: str, sample: int, bits: int) -> int:
        """Return an integer of so many bits for one sample."""
        return int(self._philox(purpose, 0, sample // 4).random_raw(4)[sample % 4]) >> (64 - bits)


def _open(raw: NDArray[np.uint64]) -> Floats:
    """Middle of each of 2^53 equal parts of the unit interval."""
    return np.asarray(((raw >> np.uint64(11)).astype(np.float64) + 0.5) * 2.0**-53)


def blanks(group: Group, count: int) -> NDArray[np.bool_]:
    """Return which of the first samples have no inclusion, (count,): evenly spread, so that every beginning
    holds the share."""
    steps = np.floor(np.arange(count + 1) * group.blanks + 1e-9)
    return np.asarray(np.diff(steps) > 0)


def inclusions(group: Group, stream: Stream, count: int) -> dict[str, Floats]:
    """Return the `PARAMETERS` of the first samples of a random group, (count,) each; NaN for blanks."""
    assert group.inclusion is not None and group.count is not None
    empty = blanks(group, group.count)
    unit = np.full((group.count, len(PARAMETERS)), np.nan)
    unit[~empty] = _unit(group, stream, empty)
    return {
        name: _within(group.inclusion, name, unit[:count, number]) for number, name in enumerate(PARAMETERS)
    }


def _unit(group: Group, stream: Stream, empty: NDArray[np.bool_]) -> Floats:
    """Points of the unit cube for the samples that have an inclusion, (n, parameters)."""
    assert group.inclusion is not None
    n = int((~empty).sum())
    own = np.stack([stream.many(name, len(empty))[~empty] for name in PARAMETERS], axis=1)
    free = [k for k, name in enumerate(PARAMETERS) if len(set(group.inclusion.span(name))) == 2]
    if group.sampler == "uniform" or not free or n == 0:
        return own
    rng = stream.generator("sequence")
    if group.sampler == "latin":
        cells = qmc.LatinHypercube(len(free), scramble=False, rng=rng).random(n)
        own[:, free] = cells + (own[:, free] - 0.5) / n
    else:
        sobol = qmc.Sobol(len(free), scramble=True, rng=rng)
        own[:, free] = sobol.random_base2(max(n - 1, 0).bit_length())[:n]
    return own


def again(
    group: Group, stream: Stream, sample: int, attempt: int, first: dict[str, float]
) -> dict[str, float]:
    """Return the parameters of one sample's later attempt, instead of its ``first`` ones.

    A Latin sample stays in its cell for some attempts; all others are drawn uniformly from the whole ranges.
    """
    assert group.inclusion is not None and group.count is not None
    found = {}
    n = group.count - int(blanks(group, group.count).sum())
    for name in PARAMETERS:
        low, high = group.inclusion.span(name)
        unit = stream.one(name, sample, attempt)
        if group.sampler == "latin" and attempt <= _IN_CELL and high > low:
            cell = min(math.floor((first[name] - low) / (high - low) * n), n - 1)
            unit = (cell + unit) / n
        found[name] = float(_within(group.inclusion, name, np.array(unit)))
    return found


def _within(ranges: Ranges, name: str, unit: Floats) -> Floats:
    low, high = ranges.span(name)
    return np.asarray(low + (high - low) * unit if high > low else np.where(np.isnan(unit), np.nan, low))


def draw(found: Distribution, base: float | None, unit: Floats) -> Floats:
    """Return a distribution's quantiles at numbers between 0 and 1, of the same shape; ``base`` is what the
    design says, which relative draws multiply."""
    name = found.distribution
    if name == "uniform":
        assert found.low is not None and found.high is not None
        values = found.low + (found.high - found.low) * unit
    elif name == "integer":
        assert found.low is not None and found.high is not None
        values = found.low + np.floor(unit * (found.high - found.low + 1))
    elif name == "choice":
        assert found.of is not None
        values = np.asarray(found.of)[np.floor(unit * len(found.of)).astype(int)]
    else:
        assert found.sd is not None
        if name == "lognormal":
            assert base is not None
            return np.asarray(base * np.exp(found.sd * ndtri(unit)), np.float64)
        low, high, mean = _bounds(found, base)
        if found.sd == 0.0:
            values = np.full_like(unit, mean)
        else:
            ends = ndtr((np.array([low, high]) - mean) / found.sd)
            values = mean + found.sd * ndtri(ends[0] + (ends[1] - ends[0]) * unit)
            values = np.clip(values, low, high)
    if found.relative:
        assert base is not None
        values = values * base
    return np.asarray(values, np.float64)


def _bounds(found: Distribution, base: float | None) -> tuple[float, float, float]:
    """Lowest, highest and mean of a normal distribution."""
    mean = found.mean
    if mean is None:
        mean = 1.0 if found.relative else base
    assert mean is not None
    low = -math.inf if found.low is None else found.low
    return low, math.inf if found.high is None else found.high, mean


def check_bounds(where: str, found: Distribution, base: float | None) -> None:
    """Raise `DesignError` if next to nothing of a normal distribution lies between its bounds."""
    if found.distribution != "normal" or (found.low is None and found.high is None):
        return
    assert found.sd is not None
    low, high, mean = _bounds(found, base)
    if found.sd == 0.0:
        share = float(low <= mean <= high)
    else:
        share = float(ndtr((high - mean) / found.sd) - ndtr((low - mean) / found.sd))
    if share < LEAST_SHARE:
        received = shown([found.low, found.high])
        allowed = f"bounds around {mean:g} with at least {LEAST_SHARE:.0%} of the distribution between them"
        raise DesignError(f"{where}.low", received, allowed)
