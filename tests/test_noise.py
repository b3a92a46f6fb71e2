"""What a gathered picture says of its noise, against the spread of pictures of other seeds."""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest
from sensors import bump, paper_sensor

SEEDS = 16
ALLOWED = 0.15


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_noise_percent_is_the_spread_of_seeds(variant: str, coupling: Literal["air", "embedded"]) -> None:
    """Root mean square over pixels, of the mean. Passes are compared by the light's main way through the
    tissue alone (`transport.Under.glanced`), which is a little smoother and brighter than what is seen: the
    figure is some 5 % low, and one picture's, of two passes, itself scatters by 12 %."""
    from scenes import Renderer

    camera = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
    renderer, press = Renderer(paper_sensor(coupling, **camera), "cpu"), bump()  # type: ignore[arg-type]
    runs = [renderer.render(press, quality="preview", seed=seed, samples=2**15) for seed in range(SEEDS)]
    pictures = np.array([run.radiance.sum(axis=0, dtype=np.float64) for run in runs])
    spread = 100 * np.sqrt(pictures.var(axis=0, ddof=1).mean()) / pictures.mean()
    said = np.array([run.noise_percent for run in runs])
    claimed = np.sqrt(np.mean(said**2))
    scatter = said.std(ddof=1) / claimed
    # the spread is found no better than the figures are: each is of as many degrees of freedom
    error = np.sqrt(2.0) * scatter / np.sqrt(SEEDS)
    print(
        f"{coupling}: said {claimed:.3f} %, spread {spread:.3f} %: {100 * (claimed / spread - 1):+.1f} "
        f"± {100 * error:.1f} %; one figure scatters by {100 * scatter:.0f} %"
    )
    assert error < 0.08
    assert abs(claimed / spread - 1) < ALLOWED


def test_leds_have_noise_of_their_own(variant: str) -> None:
    """LEDs that stand alike are not off alike: the variance of their sum is that of all of them, no more."""
    from scenes import Renderer

    camera = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
    renderer, press = Renderer(paper_sensor("air", **camera), "cpu"), bump()
    runs = [renderer.render(press, quality="preview", seed=seed, samples=2**13) for seed in range(SEEDS)]
    layers = np.array([run.radiance for run in runs], dtype=np.float64)
    together, apart = layers.sum(axis=1).var(axis=0, ddof=1).mean(), layers.var(axis=0, ddof=1).sum(axis=0)
    print(f"variance of the sum over the sum of variances: {together / apart.mean():.2f}")
    assert together < 1.35 * apart.mean()
