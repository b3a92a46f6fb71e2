"""From the light of a press to what the camera delivers, and what is told of both.

Every random number is a child of one seed: of its purpose and, for the camera, of the press level, so that
one more draw for one leaves the others alone.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation import scalars
from twin.design import Design
from twin.frame import grey

if TYPE_CHECKING:
    from fem import Emulated, Press
    from scenes import Rendering

REFERENCE_FRAMES = 16
"""Noisy frames whose mean is the camera's reference."""

_LIGHT, _PICTURE, _REFERENCE = range(3)


def light_seed(seed: int) -> int:
    """Return the light's seed; 26 bits leave room for LEDs and passes."""
    return int(_random(seed, _LIGHT).generate_state(1)[0]) >> 6


def take(design: Design, radiance: NDArray[np.floating], seed: int, level: float) -> NDArray[Any]:
    """Return the picture, (rows, columns[, 3]) counts, of radiance (n_led, rows, columns[, 3]), W m⁻² sr⁻¹.

    ``level`` is the press level, mm or N.
    """
    return _expose(design, radiance, seed, _PICTURE, level, design.camera.frames)


def expected_counts(design: Design, radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the mean of `take` without rounding, (rows, columns[, 3]) counts."""
    from scenes.camera import mean_counts

    return mean_counts(design.camera, _received(design, radiance), design.light.wavelength_nm)


def take_reference(
    design: Design, radiance: NDArray[np.floating], seed: int, level: float
) -> NDArray[np.float32]:
    """Return the mean of so many noisy pictures of the press without inclusion; arguments as of `take`."""
    frames = reference_frames(design)
    return _expose(design, radiance, seed, _REFERENCE, level, frames).astype(np.float32)


def reference_frames(design: Design) -> int:
    """Return of how many exposures the camera's reference is the mean."""
    return max(REFERENCE_FRAMES, design.camera.frames)


def _expose(
    design: Design, radiance: NDArray[np.floating], seed: int, purpose: int, level: float, frames: int
) -> NDArray[Any]:
    from scenes.camera import expose

    rng = np.random.Generator(np.random.PCG64(_random(seed, purpose, round(level * 1e6))))
    return expose(design.camera, _received(design, radiance), design.light.wavelength_nm, rng, frames=frames)


def _received(design: Design, radiance: NDArray[np.floating]) -> NDArray[np.float64]:
    from scenes.lens import through

    return through(design.sensor(), radiance.sum(axis=0, dtype=np.float64))


def seen_pressure(rendering: Rendering) -> NDArray[np.float32]:
    """Return the contact pressure that each pixel looks at, kPa.

    Between nodes with and without contact the optics' spline swings below zero: not here.
    """
    return np.maximum(rendering.pressure, 0.0)


def how_pressed(design: Design, press: Press | Emulated) -> dict[str, Any]:
    """Return depth, force and pose, as `frame.json` names them."""
    return {
        "indentation_mm": press.indentation_mm,
        "force_N": press.force_N,
        "position_mm": list(design.press.position_mm),
        "tilt_deg": list(design.press.tilt_deg),
    }


def mechanics_facts(design: Design, press: Press | Emulated) -> dict[str, Any]:
    """Return the scalars of the surface and how far they can be trusted; no timings.

    An emulator is named besides what it learned.
    """
    emulated = press.path == "emulated"
    return {
        **fem.scalars(press.surface, design.signal.displacement_um),
        "min_pressure_kPa": press.min_pressure_kPa,
        "path": press.path,
        "background": press.background,
        "signal": press.signal,
        "mechanics": "emulator" if emulated else press.mechanics,
        **({"emulated": press.mechanics} if emulated else {}),
        "error_percent": _known(press.error_percent),
    }


def _known(percent: float | None) -> float | None:
    """A number that JSON can hold, or None."""
    return percent if percent is not None and np.isfinite(percent) else None


def picture_facts(
    design: Design, image: NDArray[Any], reference: NDArray[np.float32], radiance: NDArray[np.floating]
) -> dict[str, Any]:
    """Return the scalars of a picture, raw and tared, and its share of saturated pixels, per cent."""
    k = design.signal.counts
    return {
        "raw": scalars(grey(image), k),
        "tared": scalars(grey(image) - grey(reference), k),
        "saturated_percent": saturated_percent(design, image, _received(design, radiance)),
    }


def saturated_percent(design: Design, image: np.ndarray, radiance: np.ndarray) -> float:
    """Return the share of pixels at the converter's last count or at the full well, per cent.

    ``image`` is (rows, columns[, 3]) counts, ``radiance`` the same of what the lens lets through, W m⁻² sr⁻¹.
    """
    from scenes.camera import mean_counts

    camera = design.camera
    well = camera.offset_dn + camera.full_well_e * camera.binning**2 / camera.gain_e_per_dn
    mean = mean_counts(camera, radiance, design.light.wavelength_nm)
    full = (image >= 2**camera.bits - 1) | (mean >= well * (1 - 1e-12))
    return 100.0 * float((full if full.ndim == 2 else full.any(axis=2)).mean())


def _random(seed: int, *purpose: int) -> np.random.SeedSequence:
    """Return the child of the seed for one purpose, and for one press level where it is named (nm or µN)."""
    return np.random.SeedSequence(seed, spawn_key=purpose)
