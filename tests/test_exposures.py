"""Means of rounded exposures, and what estimators think of their noise, against the camera itself."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes.camera import expose
from twin import retake
from twin.chain import BLOCK
from twin.design import Design, load_design
from twin.exposure import _received
from twin.imagined import mean_variance


def small() -> Design:
    design = load_design("tsis")
    return replace(design, camera=replace(design.camera, columns=192, rows=120))


def radiance(design: Design, top: float) -> NDArray[np.float64]:
    """A smooth ramp of light from one LED up to so many counts."""
    rows, columns = design.camera.shape
    ramp = np.linspace(0.1, 1.0, columns) * np.linspace(0.6, 1.0, rows)[:, None]
    one = retake.charges(design, np.ones((1, rows, columns), np.float32), (1, 1)).mean()
    return (top * design.camera.gain_e_per_dn / one * ramp)[None]


@pytest.mark.parametrize("top", [8.0, 150.0])
def test_mean_of_is_the_mean_of_exposures(top: float) -> None:
    """What many exposures tend to, and how far so many are from it, dim (where rounding shows) and bright."""
    design, rng, frames = small(), np.random.default_rng(0), 200
    light = radiance(design, top)
    limit = retake.mean_of(design, light, 10**9, rng)
    drawn = retake.mean_of(design, light, frames, rng)
    received = _received(design, light)
    real = expose(design.camera, received, design.light.wavelength_nm, rng, frames=frames)
    assert np.std(real - limit) == pytest.approx(np.std(drawn - limit), rel=0.03)
    assert abs(np.mean(real - limit)) < 4.0 * np.std(real - limit) / np.sqrt(real.size)


@pytest.mark.parametrize("frames", [1, 16, 100])
@pytest.mark.parametrize("top", [8.0, 150.0])
def test_noise_of_blocks_is_the_cameras(top: float, frames: int) -> None:
    """Variance of block means about the light, with what rounding leaves however many are averaged."""
    design, rng = small(), np.random.default_rng(1)
    camera, errors, expected = design.camera, [], []
    response_free = replace(design, camera=replace(camera, prnu_percent=0.0, dsnu_e=0.0))
    for scale in np.linspace(0.9, 1.1, 8):  # other phases of the rounding
        light = radiance(design, top * scale)
        pair = np.stack([light, light])
        seen = [
            retake.mean_of(response_free, one, frames if n == 0 else max(frames, 16), rng)
            for n, one in enumerate(pair)
        ]
        plain = retake.charges(response_free, light, (1, 1)).sum(axis=0)
        dark = camera.dark_current_e_s * camera.exposure_ms * 1e-3
        truth = (plain + dark) / camera.gain_e_per_dn + camera.offset_dn
        coarse = np.stack([retake.average(np.float32(one - truth), BLOCK) for one in seen])
        counts = retake.average(np.float32(truth - camera.offset_dn), BLOCK)
        told = mean_variance(
            response_free, np.stack([counts, counts])[None], np.array([camera.gain_e_per_dn]), frames
        )[0]
        errors.append(coarse**2)
        expected.append(told)
    found, told = np.mean(errors, axis=(0, 2, 3)), np.mean(expected, axis=(0, 2, 3))
    # four standard errors of 1280 blocks
    assert np.all(np.abs(np.sqrt(found / told) - 1.0) < 4.0 / np.sqrt(2.0 * 1280)), (found, told)
