"""New pictures from stored light: other noise, other LEDs, more frames, without any simulation.

Light is linear in the LEDs, so a picture under other LED powers is a weighted sum of the stored layers, taken
by the camera again. Two ways to take it:

- exactly: pixel by pixel through `scenes.camera`, then averaged over blocks of pixels where a smaller picture
  is wanted;
- fast: charges are averaged over the blocks first, and each block gets one normal draw with the variance
  that the mean of its pixels has (EMVA 1288 release 4.0 linear, section 2, divided by the pixels; key
  ``emva1288``), plus 1/12 count² for the rounding of each. Mean and variance are the camera's own wherever no
  pixel of the block reaches the full well or an end of the converter's range; tails are normal, not
  Poisson's, and counts have fractions.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes.camera import fixed_pattern, mean_electrons
from scenes.imager import Camera
from scenes.lens import through
from twin import exposure
from twin.design import Design

Float = NDArray[np.float32]

_HARMONICS = 6  # of rounding
_SMOOTH = 0.6  # counts², variance of a pixel from which on rounding does nothing: 2e-6 counts


def average(picture: NDArray[Any], block: tuple[int, int]) -> Float:
    """Return means over blocks of so many rows and columns, (rows, columns[, 3]) float32.

    Whole counts of up to 16 bits are summed as integers: exact up to 2^24 counts a block.
    """
    high, wide = block
    if picture.dtype.kind == "u":
        picture = picture.astype(np.uint32 if picture.dtype.itemsize > 1 or high * wide > 256 else np.uint16)
    lines = picture[0::high]
    for line in range(1, high):
        lines = lines + picture[line::high]
    total = lines[:, 0::wide]
    for column in range(1, wide):
        total = total + lines[:, column::wide]
    return np.multiply(total, np.float32(1.0 / (high * wide)), dtype=np.float32)


def taken(
    design: Design, layers: NDArray[Any], weights: NDArray[np.float64] | None, seed: int, level_mm: float
) -> NDArray[Any]:
    """Return a new noisy picture of layers (n_led, rows, columns[, 3]), counts, as the camera takes it.

    ``weights`` (n_led,) multiply the LEDs' power. The same seed and level give the same picture.
    """
    return exposure.take(design, _weighted(layers, weights), seed, level_mm)


def reference_taken(
    design: Design, layers: NDArray[Any], weights: NDArray[np.float64] | None, seed: int, level_mm: float
) -> Float:
    """Return the same of a reference: the mean of so many noisy frames."""
    return exposure.take_reference(design, _weighted(layers, weights), seed, level_mm)


def _weighted(layers: NDArray[Any], weights: NDArray[np.float64] | None) -> Float:
    light = layers.astype(np.float32)
    if weights is not None:
        light *= weights.astype(np.float32).reshape(-1, *(1,) * (light.ndim - 1))
    return light


def charges(design: Design, layers: NDArray[Any], block: tuple[int, int]) -> Float:
    """Return the mean charge of a block's pixels from each LED, (n_led, rows, columns[, 3]) electrons."""
    dark = _without_ambient(design)
    return np.stack([_charge(dark, layer, block) for layer in layers.astype(np.float32)])


def charge(
    design: Design, layers: NDArray[Any], weights: NDArray[np.float64] | None, block: tuple[int, int]
) -> Float:
    """Return the same of all LEDs together, each multiplied by its weight, (rows, columns[, 3]) electrons."""
    import torch  # converts half floats four times as fast as numpy

    total = torch.zeros(layers.shape[1:])
    for number, layer in enumerate(layers):
        total.add_(torch.from_numpy(layer).float(), alpha=1.0 if weights is None else float(weights[number]))
    return _charge(_without_ambient(design), total.numpy(), block)


def _charge(design: Design, light: Float, block: tuple[int, int]) -> Float:
    response, _ = fixed_pattern(design.camera)
    seen = through(design.sensor(), np.asarray(light, np.float64))
    electrons = mean_electrons(design.camera, seen, design.light.wavelength_nm)
    electrons *= response
    return average(electrons, block)


@lru_cache(maxsize=16)
def _without_ambient(design: Design) -> Design:
    return replace(design, camera=replace(design.camera, ambient=0.0)) if design.camera.ambient else design


@lru_cache(maxsize=16)
def _always(design: Design, block: tuple[int, int]) -> tuple[Float, Float]:
    """Return the charge that needs no LED, and the dark offset: (rows, columns[, 3]) electrons each."""
    camera = design.camera
    _, offset = fixed_pattern(camera)
    dark = np.full(offset.shape, camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2)
    stray = _charge(design, np.zeros(offset.shape, np.float32), block) if camera.ambient else np.float32(0.0)
    return average(dark, block) + stray, average(offset, block)


def counts(
    design: Design,
    light_e: Float,
    block: tuple[int, int],
    frames: int,
    rng: np.random.Generator | None,
) -> Float:
    """Return counts of blocks, float32 with fractions, of LEDs' charge (rows, columns[, 3]) electrons.

    The mean of so many frames, each with its noise; without a generator, what it tends to.
    """
    camera = design.camera
    always, offset = _always(design, block)
    well = np.float32(camera.full_well_e * camera.binning**2)
    held = light_e + always
    variance = np.where(held < well, held, np.float32(0.0))  # a full pixel is always as full
    np.minimum(held, well, out=held)
    gain = np.float32(camera.gain_e_per_dn)
    found = (held + offset) / gain + np.float32(camera.offset_dn)
    if rng is not None:
        scale = np.float32(1.0 / (block[0] * block[1] * frames))
        variance += np.float32(camera.read_noise_e**2)
        variance *= scale / gain**2
        variance += scale / np.float32(12.0)
        np.sqrt(variance, out=variance)
        variance *= rng.standard_normal(variance.shape, dtype=np.float32)
        found += variance
    return np.clip(found, 0.0, 2.0**camera.bits - 1, out=found)


def mean_of(
    design: Design, layers: NDArray[Any], frames: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Return the mean of many exposures of layers (n_led, rows, columns[, 3]), counts, in one draw.

    What the mean of a pixel's rounded counts tends to is µ + Σ (-1)^k sin(2πkµ) exp(-2π²k²s²)/(πk), at its
    mean µ and noise s before rounding (Widrow and Kollár 2008, chapter 4; [widrow2008]); about that it is
    normal. Where no pixel reaches the full well or an end of the range.
    """
    camera = design.camera
    response, offset = fixed_pattern(camera)
    seen = through(design.sensor(), np.asarray(layers, np.float64).sum(axis=0))
    charge = mean_electrons(camera, seen, design.light.wavelength_nm) * response
    charge += camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2
    found = (charge + offset) / camera.gain_e_per_dn + camera.offset_dn
    variance = (charge + camera.read_noise_e**2) / camera.gain_e_per_dn**2
    shift, spread = _rounded(found, variance)
    found = found + shift
    return np.asarray(found + np.sqrt(np.maximum(spread, 0.0) / frames) * rng.standard_normal(found.shape))


def _rounded(mean: NDArray[np.float64], variance: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
    """How far a rounded count's mean is above that before rounding, and its variance, of a count's mean and
    variance before; see `mean_of`."""
    turn, blur, spread = 2.0 * np.pi * mean, np.exp(-2.0 * np.pi**2 * variance), variance + 1.0 / 12.0
    shift = np.zeros_like(mean)
    for k, part in enumerate(squares(blur), start=1):
        shift += (-1) ** k / (np.pi * k) * np.sin(k * turn) * part
        spread = spread - part**2 / (2.0 * np.pi**2 * k * k)
    return shift, spread


def rounding(design: Design, counts: Float, gain: float) -> Float:
    """Return how far above the light the mean of many exposures is, counts, of each pixel of a picture
    (rows, columns) of so many counts above black; gain in electrons per count.

    The camera's own pattern is known. It leaves the pixels of a block in no common phase: what their mean is
    off from one that they would share is as large as the noise of 100 exposures where light is dim.
    """
    camera = design.camera
    dark = camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2
    found, light = np.zeros_like(counts), np.maximum(counts, 0.0)
    variance = (light * gain + dark + camera.read_noise_e**2) / gain**2
    waves = variance < _SMOOTH
    mean = light + (dark + fixed_pattern(camera)[1]) / gain + camera.offset_dn
    found[waves] = _rounded(mean[waves], variance[waves].astype(np.float64))[0]
    return found


def squares(blur: NDArray[Any]) -> Iterator[NDArray[Any]]:
    """Yield blur^(k²) for k of 1 to `_HARMONICS`, new arrays each."""
    power, odd, twice = blur.copy(), blur, blur * blur
    for _ in range(_HARMONICS):
        yield power.copy()
        odd = odd * twice
        power *= odd


def averaging(design: Design, frames: int) -> Design:
    """Return the design with a camera that averages so many frames."""
    camera: Camera = replace(design.camera, frames=frames)
    return replace(design, camera=camera)
