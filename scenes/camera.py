"""The camera: radiance at the lens becomes counts, after the linear camera model of EMVA 1288.

    radiance -> irradiance on the pixel -> electrons -> charge (shot, dark, well) -> counts (read, gain, ADC)

Every noise draw comes from the caller's generator: a picture is a function of radiance and seed.
What does not change from frame to frame (PRNU, DSNU) comes from the camera's own ``pattern_seed``.
Pictures are (rows, columns) of `Camera.shape`, and (rows, columns, 3) for a camera of colour; radiance is
that of one wavelength at each channel's best quantum efficiency (`spectrum` turns other light into such).
`lens.through` comes before, for blur, vignetting and ambient light. Left out: lens transmission, dead
pixels, the mosaic of colour filters, ADC non-linearity.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from scenes.imager import Camera

PLANCK_J_S = 6.62607015e-34  # exact since the SI of 2019
LIGHT_SPEED_M_S = 299_792_458.0  # exact

Float = NDArray[np.float64]


class CameraError(ValueError):
    """Radiance, counts or frames that the camera cannot take; one line naming what, received and allowed."""


def irradiance(camera: Camera, radiance: ArrayLike) -> Float:
    """Irradiance on the pixels, W m-2.

    A thin lens of f-number N that images a plane of radiance L at magnification m puts
    E = pi L / (4 N^2 (1 + m)^2) on the axis (Horn 1986, section 10.3, with image distance f (1 + m); key
    ``horn1986``). m is the width of the pixel array over the width of the field of view.

    Parameters
    ----------
    radiance : (rows, columns[, 3]) float
        W m-2 sr-1 in air at the lens, summed over the LEDs.
    """
    per_radiance = np.pi / (4.0 * camera.f_number**2 * (1.0 + camera.magnification) ** 2)
    return per_radiance * _radiance(camera, radiance)


def mean_electrons(camera: Camera, radiance: ArrayLike, wavelength_nm: float) -> Float:
    """Mean photoelectrons in one exposure, (rows, columns[, 3]): linear, no dark current, no full well.

    mu_e = eta mu_p with mu_p = A E t / (h c / lambda) photons on the pixel area A (EMVA 1288 release 4.0
    linear, section 2.1; key ``emva1288``); eta is the channel's best quantum efficiency. A is that of all
    pixels that are binned.
    """
    if not wavelength_nm > 0:
        raise CameraError(f"wavelength_nm: received {wavelength_nm!r}, allowed: > 0")
    area_m2 = camera.pixel_um[0] * camera.pixel_um[1] * 1e-12 * camera.binning**2
    photon_J = PLANCK_J_S * LIGHT_SPEED_M_S / (wavelength_nm * 1e-9)
    seconds = camera.exposure_ms * 1e-3
    best = camera.best_efficiency[0] if camera.colour == "mono" else camera.best_efficiency
    return irradiance(camera, radiance) * (area_m2 * seconds * best / photon_J)


def mean_counts(camera: Camera, radiance: ArrayLike, wavelength_nm: float) -> Float:
    """Counts of an ideal specimen of this camera, (rows, columns[, 3]) float.

    Without noise, fixed pattern, rounding or the converter's range: offset + charge / gain, with the charge
    (light and dark current) stopped at the full well. To choose an exposure, scale ``mean_electrons``, which
    never saturates.
    """
    charge = mean_electrons(camera, radiance, wavelength_nm) + _dark_electrons(camera)
    return np.minimum(charge, _full_well(camera)) / camera.gain_e_per_dn + camera.offset_dn


def expose(
    camera: Camera, radiance: ArrayLike, wavelength_nm: float, rng: np.random.Generator, *, frames: int = 1
) -> NDArray[Any]:
    """Counts that the camera delivers, from one noisy exposure or as the mean of several.

    Charge is Poisson about light times the pixel's own response (PRNU) plus dark current, and stops at the
    full well; read noise (normal) and the pixel's dark offset (DSNU) follow, then gain, offset, rounding and
    the converter's range: y = K (mu_e + n_d) + quantisation with K = 1 / gain (EMVA 1288 release 4.0 linear,
    section 2; key ``emva1288``). Several exposures are averaged after they were rounded, as a real camera's
    are. Binned pixels share their charge before it is read: light, dark current and full well add, the read
    noise comes once.

    Parameters
    ----------
    radiance : (rows, columns[, 3]) float
        W m-2 sr-1 in air at the lens, summed over the LEDs.
    rng : numpy.random.Generator
        Advanced by this call. The same state gives the same bytes.
    frames : int
        How many exposures to average.

    Returns
    -------
    (rows, columns[, 3]) uint8, or uint16 above 8 bits; with ``frames`` > 1 the mean of so many as float32.
    """
    if isinstance(frames, bool) or not isinstance(frames, (int, np.integer)) or frames < 1:
        raise CameraError(f"frames: received {frames!r}, allowed: a whole number of at least 1")
    response, dark_offset_e = fixed_pattern(camera)
    expected = mean_electrons(camera, radiance, wavelength_nm) * response + _dark_electrons(camera)
    # Far above the full well the draw no longer matters, but numpy refuses means beyond 9e18.
    well = _full_well(camera)
    np.minimum(expected, 100.0 * well + 1e6, out=expected)
    top = 2**camera.bits - 1
    total = np.zeros(expected.shape, np.int64)  # whole numbers: exact in any order
    for _ in range(frames):
        charge = np.minimum(rng.poisson(expected), well)
        volts_e = charge + dark_offset_e + camera.read_noise_e * rng.standard_normal(charge.shape)
        counts = np.rint(volts_e / camera.gain_e_per_dn + camera.offset_dn)
        total += np.clip(counts, 0, top).astype(np.int64)
    if frames == 1:
        return total.astype(count_dtype(camera.bits))
    return (total / frames).astype(np.float32)


def tare(image: ArrayLike, reference: ArrayLike, bits: int) -> NDArray[Any]:
    """Picture minus reference about the middle of the range: 128 + counts at 8 bits, rounded and clipped.

    Parameters
    ----------
    image, reference : (rows, columns) counts
        The reference may be a mean of frames, with fractions.
    bits : int
        Above 8 the middle is 2**(bits - 1) and the result uint16.
    """
    difference = np.asarray(image, np.float64) - np.asarray(reference, np.float64)
    return np.clip(np.rint(difference + 2 ** (bits - 1)), 0, 2**bits - 1).astype(count_dtype(bits))


def count_dtype(bits: int) -> type[np.uint8] | type[np.uint16]:
    """The smallest unsigned type that holds counts of so many bits."""
    if not 1 <= bits <= 16:
        raise CameraError(f"bits: received {bits!r}, allowed: 1 to 16")
    return np.uint8 if bits <= 8 else np.uint16


def fixed_pattern(camera: Camera) -> tuple[Float, Float]:
    """The pixels' own response (mean 1) and dark offset in electrons (mean 0), (rows, columns[, 3]).

    Normal maps of standard deviation PRNU and DSNU (EMVA 1288 release 4.0 linear, section 4; key
    ``emva1288``). They belong to the one camera, hence to ``camera.pattern_seed``,
    and are the same in every frame. Binned pixels respond with the mean, and add their offsets.
    Read-only.
    """
    planes = () if camera.colour == "mono" else (len(camera.channels),)
    array = (camera.rows, camera.columns, *planes)
    return _pattern(array, camera.binning, camera.prnu_percent, camera.dsnu_e, camera.pattern_seed)


@lru_cache(maxsize=4)
def _pattern(
    array: tuple[int, ...], binning: int, prnu_percent: float, dsnu_e: float, seed: int
) -> tuple[Float, Float]:
    rng = np.random.Generator(np.random.Philox(seed))
    unit_response, unit_offset = rng.standard_normal((2, *array))
    response = np.maximum(1.0 + 0.01 * prnu_percent * unit_response, 0.0)  # light never takes charge away
    offset = dsnu_e * unit_offset
    if binning > 1:
        response, offset = _binned(response, binning) / binning**2, _binned(offset, binning)
    response.flags.writeable = offset.flags.writeable = False
    return response, offset


def _binned(pixels: Float, binning: int) -> Float:
    """Sums over squares of so many pixels a side."""
    rows, columns, *planes = pixels.shape
    squares = pixels.reshape(rows // binning, binning, columns // binning, binning, *planes)
    return np.asarray(squares.sum(axis=(1, 3)))


def _dark_electrons(camera: Camera) -> float:
    return camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2


def _full_well(camera: Camera) -> float:
    return camera.full_well_e * camera.binning**2


def _radiance(camera: Camera, radiance: ArrayLike) -> Float:
    field = np.asarray(radiance, np.float64)
    wanted = camera.shape if camera.colour == "mono" else (*camera.shape, len(camera.channels))
    if field.shape != wanted:
        raise CameraError(f"radiance: received shape {field.shape}, allowed: {wanted}")
    lowest = field.min()  # NaN passes through min, so one look finds both
    if not (lowest >= 0 and np.isfinite(field.max())):
        span = f"{lowest:g} to {field.max():g} W m-2 sr-1"
        raise CameraError(f"radiance: received {span}, allowed: finite and >= 0")
    return field
