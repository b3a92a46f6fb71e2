"""What a layout is judged by: one number each, found for every layout, whichever a study asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import uniform_filter

from estimation.detection import deflection, signal_weight
from estimation.information import Noise, mean_variance

if TYPE_CHECKING:
    from twin.design import Design
    from twin.evaluate import Judged, Protocol

Floats = NDArray[np.float64]
Direction = Literal["minimize", "maximize"]

BOUNDS = {"bound_size_mm": "size_mm", "bound_depth_mm": "depth_mm", "bound_modulus_kPa": "modulus_kPa"}


@dataclass(frozen=True)
class Objective:
    """A number to judge by, which way is better, and what it is in words."""

    name: str
    direction: Direction
    text: str
    least: float
    most: float


OBJECTIVES: dict[str, Objective] = {
    one.name: one
    for one in (
        Objective(
            "bound_size_mm", "minimize", "bound on the diameter, mm, rms over the inclusions", 0, np.inf
        ),
        Objective("bound_depth_mm", "minimize", "bound on the depth, mm, rms over the inclusions", 0, np.inf),
        Objective("bound_modulus_kPa", "minimize", "bound on E, kPa, rms over the inclusions", 0, np.inf),
        Objective(
            "detection_depth_mm", "maximize", "depth at which the standard lump is found, mm", 0, np.inf
        ),
        Objective("snr", "maximize", "tared signal over the noise of a pixel, mean of inclusions", 0, np.inf),
        Objective("uniformity", "maximize", "dim over bright places without inclusion, 0 to 1", 0, 1),
        Objective("contrast", "maximize", "tared signal over the light there, mean of inclusions", 0, np.inf),
        Objective("led_power_W", "minimize", "flux of all LEDs, W", 0, np.inf),
        Objective("saturated_percent", "minimize", "pixels that are full, of the worst picture", 0, 100),
        Objective("presses", "minimize", "presses that the protocol takes", 1, np.inf),
        Objective(
            "exposures", "minimize", "exposures that the protocol takes, references left out", 1, np.inf
        ),
        Objective("thickness_mm", "minimize", "thickness of the waveguide, mm", 0, np.inf),
    )
}

STANDARD = (1.5, 100.0)
"""Diameter, mm, and modulus, kPa, of the lump that is looked for."""
PRESSED = (4.0, 100.0)
"""The one that is pressed in its stead, about the same middle: small lumps signal in proportion to d³."""
PRESSED_DEPTHS_MM = (4.0, 6.0, 8.0, 11.0)
FOUND = 3.29
"""Deflection d' at which it counts as found: the ideal observer's AUC is 0.99."""
PATCHY, PATCH_MM = 0.003, 1.0
"""What hides a lump beside noise: skin that gives a share of light more or less than it should, in patches
of so many mm, other ones in every press; no averaging of frames takes it away."""


def optical(design: Design, protocol: Protocol, judged: Sequence[Judged], block: float) -> dict[str, float]:
    """Return all objectives but the detection depth.

    ``design`` has the coarse camera.
    """
    from twin.coarse import noise

    spread = noise(design, block, 1)
    found = {
        name: float(np.sqrt(np.mean([one.sd[unknown] ** 2 for one in judged])))
        for name, unknown in BOUNDS.items()
        if unknown in judged[0].sd
    }
    signals = [_signal(one.mean, spread, protocol.frames) for one in judged]
    camera = design.camera
    plain = np.asarray(judged[0].mean[1::2], np.float64) - camera.offset_dn
    top = min(2**camera.bits - 1, camera.offset_dn + camera.full_well_e / camera.gain_e_per_dn)
    low, high = np.percentile(_grey(plain[0]), [1.0, 99.0])
    return {
        **found,
        "snr": float(np.mean([one[0] for one in signals])),
        "contrast": float(np.mean([one[1] for one in signals])),
        "uniformity": float(np.clip(low / high, 0.0, 1.0)) if high > 0 else 0.0,
        **beforehand(design, protocol),
        "saturated_percent": max(
            100.0 * float((picture >= top * (1 - 1e-9)).mean()) for one in judged for picture in one.mean
        ),
    }


def beforehand(design: Design, protocol: Protocol) -> dict[str, float]:
    """Return the objectives that nothing needs to be computed for."""
    presses = len(protocol.indentation_mm) * len(protocol.positions_mm)
    return {
        "led_power_W": float(sum(led.flux_W for led in design.leds)),
        "presses": float(presses),
        "exposures": float(presses * protocol.frames),
        "thickness_mm": design.waveguide.thickness_mm,
    }


def deflection_of(
    mean_0: Sequence[Floats],
    mean_1: Sequence[Floats],
    noises: Sequence[Noise],
    nuisances: Sequence[Floats],
    prior: Floats,
) -> float:
    """Deflection d' of a lump in all pictures, nuisances projected out as far as their priors leave room.

    Parameters
    ----------
    mean_0, mean_1 : counts of each picture without and with it; references have equal ones.
    nuisances : (q, ...) of each picture.
    prior : (q,) standard deviations.
    """
    signal = np.concatenate([(b - a).ravel() for a, b in zip(mean_0, mean_1, strict=True)])
    weight = np.concatenate(
        [signal_weight(a, b, n).ravel() for a, b, n in zip(mean_0, mean_1, noises, strict=True)]
    )
    if not prior.size:
        return deflection(signal, weight)
    jacobian = np.concatenate([one.reshape(len(prior), -1) for one in nuisances], axis=1)
    return deflection(signal, weight, jacobian, np.diag(1.0 / prior**2))


def reach(middles: Sequence[float], found: Sequence[float], size: float) -> float:
    """Depth at which d' falls to `FOUND`, mm, from d' of lumps whose middles are so deep.

    Between them, and beyond them, log d' is linear in the log of the centre's depth: far off it goes as its
    inverse square (see `fem.emulator.amplitudes`).
    """
    x = np.log(np.asarray(middles))
    y = np.log(np.maximum(np.asarray(found), 1e-12) / FOUND)
    if y[0] <= 0.0:  # not even the shallowest: what the last slope says, but never negative
        number = 0
    else:
        below = np.flatnonzero(y <= 0.0)
        number = len(y) - 2 if below.size == 0 else int(below[0]) - 1
    slope = min((y[number + 1] - y[number]) / (x[number + 1] - x[number]), -1e-3)
    return float(max(np.exp(min(x[number] - y[number] / slope, np.log(1e3))) - size / 2, 0.0))


def _signal(mean: NDArray[np.float32], noise: Noise, frames: int) -> tuple[float, float]:
    """Largest tared signal over a pixel's noise, and over the light there, of the best press."""
    best = (0.0, 0.0)
    for lit, unlit in zip(mean[::2], mean[1::2], strict=True):
        picture, plain = _grey(np.asarray(lit, np.float64)), _grey(np.asarray(unlit, np.float64))
        tared = uniform_filter(picture - plain, 3, mode="nearest")
        row, column = np.unravel_index(int(tared.argmax()), tared.shape)
        spread = float(mean_variance(picture[row, column], noise)) + 1.0 / 12.0  # and of rounding
        light = max(float(plain[row, column]) - noise.offset_dn, 1e-9)
        here = tared[row, column] / np.sqrt(spread / frames), tared[row, column] / light
        best = max(best, (float(here[0]), float(here[1])))
    return best


def _grey(picture: Floats) -> Floats:
    """Counts of a colour picture's brightest channel, or the picture."""
    if picture.ndim == 2:
        return picture
    return np.asarray(picture[..., int(picture.mean(axis=(0, 1)).argmax())])
