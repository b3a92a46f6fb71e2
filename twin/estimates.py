"""What is known of an inclusion after its pictures were seen: a posterior, never a bare point."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

NAMES = ("size_mm", "depth_mm", "modulus_kPa")
"""Parameters of an inclusion, in the order of every array here; the depth is that of its top."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """Posterior of an inclusion's (size, depth, modulus), given pictures; mm, mm, kPa.

    Attributes
    ----------
    names : of the parameters, `NAMES`.
    samples : (n, 3) float64 of the posterior, given that there is an inclusion.
    mean : (3,) of the posterior.
    covariance : (3, 3) of the posterior.
    interval : (3, 2) lower and upper end of the central 90 %.
    presence : probability that there is an inclusion, 0 to 1.
    likeness : share of valid pictures that are less like the model's own than these, 0 to 1.
    refused : why the pictures are not answered, in one line; None where they are.
    observed : (levels, r, c) tared counts of the coarse picture that was seen.
    predicted : (levels, r, c) the same as expected at the posterior mean.
    noise : (levels, r, c) standard deviation of observed minus predicted, counts.
    method : where the samples come from: "rendered" (`twin.refining`), "fitted" where learned light does as
        well; where nothing was rendered, or nothing rendered explains the pictures, "network", or in a
        calibrated model, of whose calibration the network does not know, "unrendered", a fit by learned
        light.
    misfit : chi-square of the predicted pictures over its number of features; near 1 where the model can make
        these pictures.
    """

    names: tuple[str, ...]
    samples: NDArray[np.float64]
    mean: NDArray[np.float64]
    covariance: NDArray[np.float64]
    interval: NDArray[np.float64]
    presence: float
    likeness: float
    refused: str | None
    observed: NDArray[np.float64]
    predicted: NDArray[np.float64]
    noise: NDArray[np.float64]
    method: str
    misfit: float


def probability(value: float) -> str:
    """Return a probability in three figures, never as a certainty that no posterior has."""
    return "> 0.999" if value > 0.9995 else "< 0.001" if value < 0.0005 else f"{value:.3f}"


def decimals(sd: float) -> int:
    """Return how many decimals give two figures of a standard deviation, 0 to 3."""
    return 3 if sd <= 1e-3 else min(max(1 - math.floor(math.log10(sd)), 0), 3)
