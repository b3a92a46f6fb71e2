"""Where the uncertainty comes from: what each nuisance costs, and which calibration buys most.

Three figures for every nuisance and every wanted parameter, all standard deviations of the prior-included
bound: with that nuisance known exactly, with its prior twice as tight, and with it as the only unknown
beside the wanted ones. Nuisances share what they cost, so the costs do not add up to the whole.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from estimation.information import Information, bound, with_prior

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Cost:
    """What one source of uncertainty costs; arrays (k,) in the unit of each wanted parameter.

    Attributes
    ----------
    name : the nuisance, or ``noise`` for that of the pictures.
    known : bound with it known exactly; for the noise, without noise.
    halved : bound with its standard deviation halved: by calibration, or with 4 times the frames.
    alone : bound with no other nuisance unknown.
    cost : bound with it unknown minus with it known, never negative.
    """

    name: str
    known: Floats
    halved: Floats
    alone: Floats
    cost: Floats


@dataclass(frozen=True)
class Budget:
    """Bound `sd` (k,) of the wanted parameters with all nuisances, `best` with none, and who costs what.

    Costs come with the largest saving by `halved` first, summed over the wanted as shares of their sd.
    """

    wanted: tuple[str, ...]
    sd: Floats
    best: Floats
    costs: tuple[Cost, ...]


def error_budget(information: Information, wanted: Sequence[str]) -> Budget:
    """Return the budget of the wanted parameters; all others are nuisances, with priors or without.

    Raises ValueError where even all that is known leaves a wanted parameter without a bound.
    """
    wanted = tuple(wanted)
    nuisances = [name for name in information.names if name not in wanted]
    sd = bound(information, wanted).sd
    if not np.isfinite(sd).all():
        open_ = [name for name, value in zip(wanted, sd, strict=True) if not np.isfinite(value)]
        raise ValueError(f"wanted: received {open_}, which nothing bounds; allowed parameters with a bound")
    best = bound(information, wanted, known=nuisances).sd
    costs = [_noise(information, wanted, sd, best)]
    for name in nuisances:
        known = bound(information, wanted, known=[name]).sd
        halved = bound(with_prior(information, name, 0.5), wanted).sd
        alone = bound(information, wanted, known=[other for other in nuisances if other != name]).sd
        costs.append(Cost(name, known, halved, alone, sd - known))
    costs.sort(key=lambda cost: float(-((sd - cost.halved) / sd).sum()))
    return Budget(wanted, sd, best, tuple(costs))


def _noise(information: Information, wanted: tuple[str, ...], sd: Floats, best: Floats) -> Cost:
    """That of the pictures' noise: with half of it, four times the information."""
    halved = bound(replace(information, fisher=4.0 * information.fisher), wanted).sd
    known = np.minimum(_without_noise(information, wanted), sd)
    return Cost("noise", known, halved, best, sd - known)


def _without_noise(information: Information, wanted: tuple[str, ...]) -> Floats:
    """Bound with a millionth of the noise's variance: a limit, so that everything can be inverted.

    In units of the prior, where there is one for all: what pictures cannot tell apart, as a gain and the flux
    of all LEDs, is then left at the prior instead of lost in rounding.
    """
    prior, more = information.prior, 1e6
    scale = np.sqrt(np.diag(prior))
    if not (scale > 0).all():
        return bound(replace(information, fisher=more * information.fisher), wanted).sd
    unit = np.outer(scale, scale)
    root = np.linalg.cholesky(prior / unit)
    told = np.linalg.solve(root, np.linalg.solve(root, information.fisher / unit).T)
    value, vector = np.linalg.eigh(0.5 * (told + told.T))
    value[value < 1e-14 * len(value) * value[-1]] = 0.0
    back = np.linalg.solve(root.T, vector) / scale[:, None]
    at = information.index(wanted)
    return np.asarray(np.sqrt((back[at] ** 2 / (1.0 + more * value)).sum(axis=1)))
