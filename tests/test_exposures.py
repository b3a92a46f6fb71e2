"""Means of rounded exposures, and what estimators think of their noise, against the camera itself."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes.camera import expose, fixed_pattern
from twin import retake
from twin.block_noise import mean_variance, rounding
from twin.chain import BLOCK
from twin.design import Design, load_design
from twin.exposure import _received

Floats = NDArray[np.float64]


def small() -> Design:
    design = load_design("tsis")
    return replace(design, camera=replace(design.camera, columns=192, rows=120))


def radiance(design: Design, top: float) -> Floats:
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


def blocks(design: Design, top: float, frames: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
    """What blocks of a picture and its reference are above the light, and the light, counts (1, 2, r, c)."""
    camera, light = design.camera, radiance(design, top)
    _, offset = fixed_pattern(camera)
    dark = offset + camera.dark_current_e_s * camera.exposure_ms * 1e-3
    charge = retake.charges(design, light, (1, 1)).sum(axis=0)
    truth = (charge + dark) / camera.gain_e_per_dn + camera.offset_dn
    pair = [retake.mean_of(design, light, count, rng) for count in (frames, max(frames, 16))]
    off = [retake.average(np.float32(one - truth), BLOCK) for one in pair]
    counts = retake.average(charge / np.float32(camera.gain_e_per_dn), BLOCK)
    return np.stack(off)[None], np.stack([counts, counts])[None]


def free_of_pattern(design: Design) -> Design:
    return replace(design, camera=replace(design.camera, prnu_percent=0.0, dsnu_e=0.0))


@pytest.mark.parametrize("frames", [1, 16, 100])
@pytest.mark.parametrize("top", [8.0, 150.0])
def test_noise_of_blocks_is_the_cameras(top: float, frames: int) -> None:
    """Variance of block means about the light, with what rounding leaves however many are averaged; and about
    the light as it is rounded."""
    design, rng = small(), np.random.default_rng(1)
    gain = np.array([design.camera.gain_e_per_dn])
    errors, expected = [], []
    for scale in np.linspace(0.9, 1.1, 8):  # other phases of the rounding
        off, counts = blocks(design, top * scale, frames, rng)
        rounded = off - rounding(design, counts, gain)
        errors.append(np.stack([off, rounded]) ** 2)
        expected.append(
            [mean_variance(design, counts, gain, frames, rounded=known) for known in (False, True)]
        )
    found, told = np.mean(errors, axis=(0, 2, 4, 5)), np.mean(expected, axis=(0, 2, 4, 5))
    # four standard errors of 1280 blocks
    assert np.all(np.abs(np.sqrt(found / told) - 1.0) < 4.0 / np.sqrt(2.0 * 1280)), (found, told)


def test_rounding_is_known() -> None:
    """Of what the mean of endless exposures is off by where light is dim, all is known but for the camera's
    pattern: a picture and its reference are off by the same, which two noises are not."""
    rng = np.random.default_rng(2)
    for design, left in ((free_of_pattern(small()), 0.02), (small(), 0.1)):
        off, counts = blocks(design, 8.0, 10**9, rng)
        known = rounding(design, counts, np.array([design.camera.gain_e_per_dn]))
        assert np.allclose(off[0, 0], off[0, 1], atol=1e-5)
        assert np.std(off - known) < left * np.std(off)


@pytest.mark.parametrize("top", [8.0, 25.0, 150.0])
def test_rounding_of_pixels_is_known_with_their_pattern(top: float) -> None:
    """What the mean of endless exposures of each pixel is off by, and of blocks: to single precision."""
    design = small()
    camera, light, gain = design.camera, radiance(design, top), design.camera.gain_e_per_dn
    charge = retake.charges(design, light, (1, 1)).sum(axis=0)
    dark = fixed_pattern(camera)[1] + camera.dark_current_e_s * camera.exposure_ms * 1e-3
    truth = (charge.astype(float) + dark) / gain + camera.offset_dn
    off = retake.mean_of(design, light, 10**16, np.random.default_rng(3)) - truth
    left = off - retake.rounding(design, charge / np.float32(gain), gain)
    assert np.abs(left).max() < 1e-4
    in_blocks = [np.std(retake.average(np.float32(one), BLOCK)) for one in (left, off)]
    assert in_blocks[0] < 1e-2 * in_blocks[1] or in_blocks[1] < 1e-5
