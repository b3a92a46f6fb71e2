"""What colour light has: spectra of LEDs, lumens, and the few wavelengths that stand for a spectrum.

A picture in light of many wavelengths is a sum of pictures in one. What the camera makes of them is summed
against its response, electrons per joule: quantum efficiency times wavelength. The sum is given as the
radiance of light at the design's one wavelength that would leave as many electrons at the channel's best
quantum efficiency, so that a line at that wavelength, best seen, is its own radiance.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.resources import files
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from .imager import Camera
    from .led import Led

Array = NDArray[np.float64]

Illuminant = Literal[
    "LED-B1", "LED-B2", "LED-B3", "LED-B4", "LED-B5", "LED-BH1", "LED-RGB1", "LED-V1", "LED-V2"
]
SpectrumName = Literal["line", "gaussian", Illuminant]
ILLUMINANTS: frozenset[str] = frozenset(get_args(Illuminant))

LUMENS_PER_WATT = 683.002
"""Luminous efficacy of light at 555 nm: K_m of CIE 018:2019 (key cie2019), for the air wavelength's V = 1."""

SHORTEST_NM, LONGEST_NM = 350.0, 1100.0
_STEP_NM = 0.5
_GAUSS_REACH = 2.5  # full widths at half maximum on each side; 3e-8 of the peak is left there


@dataclass(frozen=True)
class Band:
    """One wavelength that is rendered, and what its picture counts for.

    Attributes
    ----------
    wavelength_nm : float
    share : (n_led, channels)
        Weight of each LED's radiance, computed with its whole flux at this wavelength; 0 for LEDs whose
        spectrum has other wavelengths.
    parts : int
        Number of bands that share the spectrum of the LEDs lit here.
    energy : float
        Share of those LEDs' flux that the band stands for.
    leds : tuple of int
        Numbers of the LEDs that shine in this band, whether the camera sees them or not.
    """

    wavelength_nm: float
    share: Array
    parts: int
    energy: float
    leds: tuple[int, ...] = ()


def luminous_efficiency(wavelength_nm: ArrayLike) -> Array:
    """V(lambda) of photopic vision (CIE 018:2019; key cie2019), linear over 5 nm, 0 beyond 380..780."""
    table, at = _cie(), np.asarray(wavelength_nm, np.float64)
    return np.asarray(np.interp(at, table["wavelength_nm"], table["V"], left=0.0, right=0.0))


def longest(leds: Sequence[Led], wavelength_nm: float) -> float:
    """The longest wavelength that any of the LEDs has light of, nm; lines of their own say `peak_nm`."""
    found = [wavelength_nm]
    for led in leds:
        if led.spectrum in ILLUMINANTS:
            found.append(780.0)
        elif led.peak_nm is not None:
            found.append(min(led.peak_nm + _GAUSS_REACH * (led.fwhm_nm or 0.0), LONGEST_NM))
    return max(found)


def efficacy(spectrum: str, peak_nm: float | None, fwhm_nm: float | None) -> float:
    """Lumens per watt of a spectrum, K_m ∫ S V / ∫ S (CIE 018:2019; key cie2019); `line` needs `peak_nm`."""
    wavelength, density = shape(spectrum, peak_nm, fwhm_nm)
    return float(LUMENS_PER_WATT * np.sum(density * luminous_efficiency(wavelength)))


def shape(spectrum: str, peak_nm: float | None, fwhm_nm: float | None) -> tuple[Array, Array]:
    """Wavelengths (n,) nm and the share of the flux at each, (n,), summing to 1: cells of even width.

    A Gaussian of full width at half maximum w is exp(-4 ln 2 (lambda - peak)²/w²). The CIE's LEDs
    (CIE 015:2018; key cie2018) are linear between their 5 nm steps.
    """
    if spectrum == "line":
        if peak_nm is None:
            raise ValueError("peak_nm: received none; allowed is the wavelength of the line, nm")
        return np.array([float(peak_nm)]), np.ones(1)
    if spectrum == "gaussian":
        if peak_nm is None or fwhm_nm is None:
            raise ValueError("peak_nm, fwhm_nm: received none; allowed are both, for a gaussian spectrum")
        low = max(peak_nm - _GAUSS_REACH * fwhm_nm, SHORTEST_NM)
        high = min(peak_nm + _GAUSS_REACH * fwhm_nm, LONGEST_NM)
        wavelength = _middles(low, high, min(_STEP_NM, fwhm_nm / 50.0))
        density = np.exp(-4.0 * np.log(2.0) * ((wavelength - peak_nm) / fwhm_nm) ** 2)
    else:
        table = _cie()
        wavelength = _middles(380.0, 780.0, _STEP_NM)
        density = np.interp(wavelength, table["wavelength_nm"], table[spectrum])
    return wavelength, density / density.sum()


def bands(leds: Sequence[Led], camera: Camera, wavelength_nm: float, count: int) -> list[Band]:
    """The wavelengths to render, in the order of the LEDs that they are for.

    A line is one band. Any other spectrum is cut into `count` stretches of equal spectrum times response;
    each is rendered at its mean wavelength under that weight and counts for what it holds, so that every
    channel's electrons are exact where the picture does not depend on wavelength, and right to second order
    where it does.

    Parameters
    ----------
    wavelength_nm
        Of LEDs that are a line without `peak_nm`, and of the light that the sum is given as.
    """
    found: dict[tuple[str, float | None, float | None], list[Band]] = {}
    members: dict[tuple[str, float | None, float | None], tuple[int, ...]] = {}
    for number, led in enumerate(leds):
        peak = wavelength_nm if led.spectrum == "line" and led.peak_nm is None else led.peak_nm
        key = (led.spectrum, peak, led.fwhm_nm)
        if key not in found:
            found[key] = _cut(key, camera, wavelength_nm, count, len(leds))
            members[key] = ()
        members[key] += (number,)
        for band in found[key]:
            band.share[number] = band.share[-1]
    return [
        replace(band, share=band.share[:-1], leds=members[key])
        for key, group in found.items()
        for band in group
    ]


def _cut(
    key: tuple[str, float | None, float | None], camera: Camera, reference_nm: float, count: int, leds: int
) -> list[Band]:
    """Bands of one spectrum, none of whose LEDs are lit yet; the last row of `share` is what they get."""
    wavelength, density = shape(*key)
    relative = camera.efficiency(wavelength) / camera.best_efficiency[:, None]  # (channels, n)
    response = density * (wavelength / reference_nm) * relative
    weight = response.sum(axis=0)
    if not weight.any():  # the camera is blind to it: dark, and where it would be
        middle = float(np.sum(density * wavelength))
        return [Band(middle, np.zeros((leds + 1, len(response))), 1, 1.0)]
    parts = 1 if wavelength.size == 1 else count
    cuts = np.linspace(0.0, weight.sum(), parts + 1)
    summed = np.concatenate([[0.0], np.cumsum(weight)])
    cells = np.interp(cuts, summed, np.arange(summed.size))
    cells[0], cells[-1] = 0.0, wavelength.size

    def between(values: Array) -> Array:
        total = np.concatenate([[0.0], np.cumsum(values)])
        return np.diff(np.interp(cells, np.arange(total.size), total))

    means = between(weight * wavelength) / between(weight)
    held = np.stack([between(channel) for channel in response])  # (channels, parts)
    energy = between(density)
    made = []
    for part in range(parts):
        share = np.zeros((leds + 1, len(response)))
        share[-1] = held[:, part]
        made.append(Band(float(means[part]), share, parts, float(energy[part])))
    return made


def _middles(low: float, high: float, step: float) -> Array:
    cells = max(int(np.ceil((high - low) / step)), 1)
    return np.asarray(low + (np.arange(cells) + 0.5) * ((high - low) / cells))


@lru_cache(maxsize=1)
def _cie() -> dict[str, Array]:
    text = files("assets").joinpath("cie.csv").read_text(encoding="utf-8")
    rows = [line.split(",") for line in text.splitlines() if not line.startswith("#")]
    return {name: np.array(column, np.float64) for name, *column in zip(*rows, strict=True)}
