"""The best intensities of LEDs, and what failures and bins cost, from `lamps` alone: no light is computed.

found = optimise(lamps_of(evaluation), power_W=0.08)
found.best.intensity, found.best.worth, found.before.worth
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from twin.complaint import DesignError, shown
from twin.lamps import WANTED, Lamps, bounds, fullness, worth

Floats = NDArray[np.float64]

_SUBSETS = 6  # LEDs at most of which every combination is tried
_CLOUD, _ROUNDS = 160, 7


@dataclass(frozen=True)
class Setting:
    """Intensities and what they are worth.

    Attributes
    ----------
    intensity : (n_led,) times the design's flux.
    sd : (inclusions, w) prior-included bounds of the wanted unknowns.
    worth : geometric mean over the wanted of their bounds' root mean square over inclusions.
    power_W : of all LEDs together.
    full : the brightest pixel's mean over the greatest that is allowed; 1 is at the limit.
    """

    intensity: Floats
    sd: Floats
    worth: float
    power_W: float
    full: float


@dataclass(frozen=True)
class Optimum:
    """The best setting found, the design's own, and whether LEDs shine one after the other."""

    best: Setting
    before: Setting
    wanted: tuple[str, ...]
    sequential: bool


def setting(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    wanted: Sequence[str] = WANTED,
    *,
    sequential: bool = False,
) -> Setting:
    """Return what one setting (n_led,) is worth."""
    at = np.asarray(intensity, np.float64)
    sd = bounds(lamps, at, wanted, sequential=sequential)
    power = at * lamps[0].flux_W
    return Setting(
        at,
        sd[0],
        float(worth(sd)[0]),
        float(power.max() if sequential else power.sum()),
        float(fullness(lamps, at, sequential=sequential)[0]),
    )


def optimise(
    lamps: Sequence[Lamps],
    wanted: Sequence[str] = WANTED,
    *,
    power_W: float | None = None,
    sequential: bool = False,
    seed: int = 0,
) -> Optimum:
    """Return the intensities that tell most under a power limit and without saturation.

    More light never hurts below saturation, so only the shares are searched: every setting is as bright as
    the limits let it be. First each combination of LEDs that shine alike, then rounds of a shrinking cloud
    about the best.

    Parameters
    ----------
    power_W : of the LEDs that shine at once; that of the design where not given.
    sequential : LEDs shine one after the other; each is then as bright as it may be, and nothing is searched.
    """
    given, n_led = lamps[0], lamps[0].count
    limit = float(given.flux_W.sum()) if power_W is None else power_W
    if not 0 < limit < np.inf:
        raise DesignError("power_W", shown(power_W), "a number > 0")
    before = setting(lamps, np.ones(n_led), wanted)
    if sequential:
        alone = np.eye(n_led) * limit / given.flux_W
        each = np.diag(alone / np.maximum(fullness(lamps, alone), 1.0)[:, None])
        return Optimum(setting(lamps, each, wanted, sequential=True), before, tuple(wanted), True)

    def bright(shares: Floats) -> Floats:
        full = shares * (limit / (shares @ given.flux_W))[:, None]
        return np.asarray(full / np.maximum(fullness(lamps, full), 1.0)[:, None])

    rng = np.random.Generator(np.random.PCG64(seed))
    shares = np.concatenate([_combinations(n_led), rng.dirichlet(np.ones(n_led), _CLOUD)])
    best, least = shares[0], np.inf
    for number in range(_ROUNDS + 1):
        found = worth(bounds(lamps, bright(shares), wanted))
        if found.min() < least:
            best, least = shares[found.argmin()], float(found.min())
        width = 0.8 * 0.5**number
        # dark LEDs of the best may come back, lit ones go dark: logarithms alone never cross zero
        woken = 0.1 * best.max() * (rng.random((_CLOUD, n_led)) < 0.2)
        kept = rng.random((_CLOUD, n_led)) > 0.05
        kept[:, best.argmax()] = True
        shares = np.maximum(best, woken) * kept * np.exp(width * rng.standard_normal((_CLOUD, n_led)))
    return Optimum(setting(lamps, bright(best[None])[0], wanted), before, tuple(wanted), False)


def failures(lamps: Sequence[Lamps], intensity: ArrayLike, wanted: Sequence[str] = WANTED) -> Floats:
    """Return bounds (n_led, inclusions, w) with each LED dark in turn, the others as they were."""
    at = np.asarray(intensity, np.float64)
    return bounds(lamps, at * (1.0 - np.eye(len(at))), wanted)


def binning(
    lamps: Sequence[Lamps],
    intensity: ArrayLike,
    tolerance: float = 0.1,
    wanted: Sequence[str] = WANTED,
    *,
    draws: int = 200,
    seed: int = 0,
) -> Floats:
    """Return bounds (draws, inclusions, w) of sensors whose LEDs differ from the nominal flux.

    Fluxes are even within ± `tolerance` of their own, as in a bin of a maker's; each sensor's are known.
    """
    if not 0 <= tolerance < 1:
        raise DesignError("tolerance", shown(tolerance), "at least 0 and below 1")
    at = np.asarray(intensity, np.float64)
    rng = np.random.Generator(np.random.PCG64(seed))
    return bounds(lamps, at * rng.uniform(1 - tolerance, 1 + tolerance, (draws, len(at))), wanted)


def _combinations(count: int) -> Floats:
    """Shares (m, count) of LEDs that shine alike: all of them, each left out; every combination of few."""
    if count > _SUBSETS:
        return np.concatenate([np.ones((1, count)), 1.0 - np.eye(count), np.eye(count)])
    numbers = np.arange(2**count - 1, 0, -1)
    return ((numbers[:, None] >> np.arange(count)) & 1).astype(np.float64)
