"""What the noise of light paths costs: one standard picture beside the noise of one exposure.

pytest -m slow -s tests/bench/test_path_noise.py, with TWIN_MODEL=models/mine for another model than the one
that ships.
"""

import os

import numpy as np
import pytest

import twin
from estimation.paper import true_inclusions
from scenes import SpectralRenderer, backend
from twin import presses, retake
from twin.chain import BLOCK, seen_by, whole_blocks
from twin.discrepancy import shrunk
from twin.estimator import Estimator
from twin.estimator_file import load_estimator
from twin.fitting import covariance, expected, limits
from twin.study import PARAMETERS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(3600),
]
SEEDS = 12
LEAST_MM = 4.0


def paths_noise(estimator: Estimator, values: dict[str, float]) -> tuple[np.ndarray, list[np.ndarray]]:
    """Ratio of noises for each feature; bounds on d, h, E without the paths' and with it."""
    chain, features, prior = estimator.chain, estimator.features, estimator.prior
    design, depths = seen_by(chain.design, values)
    ball = twin.Inclusion(values["size_mm"], values["depth_mm"], values["modulus_kPa"])
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
    paths, bounds = shrunk(off), []
    for error in (0.0 * paths, paths):
        least, _ = limits(chain, features, prior, values, 1.0, lambda pictures, error=error: error)
        bounds.append(np.sqrt(np.diag(least)[:3]))
    return np.sqrt((off**2).mean(axis=0) / np.diag(exposure)), bounds


def test_standard_lights_noise_is_far_above_an_exposures() -> None:
    """Which is why a model that renders with learned light is off by more than its bound on such pictures: no
    estimate can be nearer to the paper's phantoms than the last line."""
    estimator = load_estimator(os.environ.get("TWIN_MODEL", "tsis"))
    backend.use("cpu")
    known = estimator.prior.values(estimator.prior.middle)
    balls = [one for one in true_inclusions() if one[0] >= LEAST_MM]
    ratios, bounds = [], []
    for number, ball in enumerate(balls, 1):
        centred = (*map(float, ball), 0.0, 0.0)
        ratio, both = paths_noise(estimator, {**known, **dict(zip(PARAMETERS, centred, strict=True))})
        ratios.append(np.median(ratio))
        bounds.append(both)
        told = "; ".join("{:.3f} mm, {:.3f} mm, {:.1f} kPa".format(*one) for one in both)
        print(f"phantom {number}, {ball}: paths over exposure {ratios[-1]:.0f}; bound without, with: {told}")
    alone, paths = np.sqrt(np.mean(np.square(bounds), axis=0))
    for name, one in (("one exposure alone", alone), ("and one standard picture's paths", paths)):
        print("rms bound, {}: {:.3f} mm, {:.3f} mm, {:.1f} kPa".format(name, *one))
    assert min(ratios) > 10.0
    assert np.all(paths > 1.5 * alone)  # the mismatch that was aimed at
