"""An estimator that was never trained, for tests of what stands around one.

Its posterior is normal about values that the test gives, cut at the ranges, and it expects what it sees, but
for smooth differences and noise.
"""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from twin.design import Design
from twin.estimates import NAMES, Estimate
from twin.fields import tables_of
from twin.received import Received
from twin.sound import coarse

RANGES = {"size_mm": (2.0, 13.0), "depth_mm": (4.0, 12.0), "modulus_kPa": (40.0, 120.0)}


@dataclass(frozen=True)
class StandIn:
    """Answers like an estimator."""

    card: dict[str, Any]
    presence: float = 0.99
    refused: str | None = None
    mean: tuple[float, float, float] = (10.1, 5.2, 85.0)
    sd: tuple[float, float, float] = (0.2, 0.15, 22.0)

    def estimate(
        self, received: Received, *, samples: int = 4000, seed: int = 0, rendered: bool = True
    ) -> Estimate:
        """Draw from the posterior, and smooth the pictures."""
        drawn = self._drawn(samples, np.random.default_rng(seed))
        observed = np.stack([coarse(level) for level in received.tared])
        predicted = np.stack([gaussian_filter(level, 2.0) for level in observed])
        return Estimate(
            names=NAMES,
            samples=drawn,
            mean=drawn.mean(axis=0),
            covariance=np.cov(drawn.T),
            interval=np.quantile(drawn, [0.05, 0.95], axis=0).T,
            presence=self.presence,
            likeness=0.42,
            refused=self.refused,
            observed=observed,
            predicted=predicted,
            noise=np.full(observed.shape, 0.08),
            method="rendered" if rendered else "network",
            misfit=1.0,
        )

    def _drawn(self, samples: int, rng: np.random.Generator) -> NDArray[np.float64]:
        turn = np.array([[1.0, 0.5, -0.6], [0.0, 0.85, -0.3], [0.0, 0.0, 0.75]])
        low, high = np.array([RANGES[name] for name in NAMES]).T
        drawn = rng.standard_normal((20 * samples, 3)) @ turn * self.sd + self.mean
        return np.asarray(drawn[np.all((drawn > low) & (drawn < high), axis=1)][:samples])


def card_of(design: Design, levels: tuple[float, ...]) -> dict[str, Any]:
    """The card of a model of a design."""
    camera = design.camera
    return {
        "design_sha256": "0" * 64,
        "design": tables_of(design),
        "shape": list(camera.shape),
        "bits": camera.bits,
        "colour": camera.colour,
        "indentation_mm": list(levels),
        "frames": [1, 100],
        "ranges": {name: list(ends) for name, ends in RANGES.items()},
        "refuse_below": 0.01,
    }


def as_module(estimator: StandIn) -> ModuleType:
    """A module that stands for `twin.estimator_file` and knows this one estimator only."""
    module = ModuleType("twin.estimator_file")
    module.load_estimator = lambda path: estimator  # type: ignore[attr-defined]
    return module
