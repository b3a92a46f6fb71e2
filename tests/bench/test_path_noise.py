"""What the noise of light paths costs: one standard picture beside the noise of one exposure.

pytest -m slow -s tests/bench/test_path_noise.py, with TWIN_MODEL=models/mine for another model than the one
that ships.
"""

import os

import numpy as np
import pytest

import twin
from scenes import SpectralRenderer, backend
from twin import presses, retake
from twin.chain import BLOCK, seen_by, whole_blocks
from twin.discrepancy import shrunk
from twin.estimator_file import load_estimator
from twin.fitting import covariance, expected, limits
from twin.study import PARAMETERS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
]
SEEDS = 12
BALL = dict(zip(PARAMETERS, (10.0, 5.0, 100.0, 0.0, 0.0), strict=True))


def test_standard_lights_noise_is_far_above_an_exposures() -> None:
    """Which is why a model that renders with learned light is off by more than its bound on such pictures."""
    estimator = load_estimator(os.environ.get("TWIN_MODEL", "tsis"))
    chain, features, prior = estimator.chain, estimator.features, estimator.prior
    backend.use("cpu")
    values = {**prior.values(prior.middle), **BALL}
    design, depths = seen_by(chain.design, values)
    ball = twin.Inclusion(10.0, 5.0, 100.0)
    renderer = SpectralRenderer(design.sensor(), count=design.light.bands, at=design.sensor, device="cpu")
    found = presses.emulated(design, ball, depths, chain.emulator)

    def counts(seed: int) -> np.ndarray:
        def one(press: object, field: str) -> np.ndarray:
            layers = renderer.render(press.surface, field=field, seed=seed).radiance  # type: ignore[attr-defined]
            charge = retake.charge(design, layers, None, (1, 1)) / np.float32(design.camera.gain_e_per_dn)
            return retake.average(whole_blocks(charge), BLOCK)

        return np.array([[one(press, field) for field in ("pressure", "pressure_0")] for press in found])

    many = np.stack([counts(seed) for seed in range(1, SEEDS + 1)])
    middle = many.mean(axis=0)
    noise = (many - middle) * np.float32(np.sqrt(SEEDS / (SEEDS - 1)))
    # sensor and press are alike in their four quarters, so noise is as likely mirrored
    mirrored = [noise[..., ::up, ::along] for up in (1, -1) for along in (1, -1)]
    off = (features(middle + np.concatenate(mirrored)) - features(middle[None])).astype(np.float64)
    plain = expected(chain, prior, [prior.unknowns(values)])[0]
    exposure = covariance(chain, features, plain, chain.gain(values), 1.0)
    ratio = np.sqrt((off**2).mean(axis=0) / np.diag(exposure))
    print(
        f"noise of paths over that of one exposure, of {len(ratio)} features: median {np.median(ratio):.0f}"
    )
    paths, bounds = shrunk(off), []
    for name, error in (("one exposure alone", 0.0 * paths), ("and one standard picture's paths", paths)):
        least, _ = limits(chain, features, prior, values, 1.0, lambda pictures, error=error: error)
        bounds.append(np.sqrt(np.diag(least)[:3]))
        size, depth, modulus = bounds[-1]
        print(f"bound, {name}: {size:.3f} mm, {depth:.3f} mm, {modulus:.1f} kPa")
    assert np.median(ratio) > 10.0
    assert np.all(bounds[1][:2] > 1.5 * bounds[0][:2])  # the mismatch that was aimed at
