"""Pictures in light of many wavelengths: one `Renderer` for each, summed against the camera's response."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .render import PATHS_PER_LED, Quality, Renderer, Rendering
from .sensor import Led, NotModelled, Sensor
from .spectrum import Band, bands

if TYPE_CHECKING:
    import pyvista as pv

    from .surface import OpticalSurface
    from .traced import TracedLight

_SEEDS = 2**26  # as many as a renderer keeps apart
_SEED_STEP = 0x9E3779B1  # bands far apart, whichever number the caller chose


class SpectralRenderer:
    """A sensor's scene at every wavelength that its LEDs and its camera ask for."""

    def __init__(
        self,
        sensor: Sensor,
        *,
        count: int = 3,
        at: Callable[[float], Sensor] | None = None,
        device: str = "auto",
        coloured: bool = False,
        like: SpectralRenderer | None = None,
    ) -> None:
        """Load the scenes on `device` ("auto", "cpu" or "cuda"; see `backend.use`).

        Parameters
        ----------
        sensor
            At the wavelength that the sum is given as; its LEDs tell their spectra.
        count
            Number of bands of a spectrum that is no line.
        at
            The sensor at another wavelength, nm; without it the indices stay the same.
        coloured, like
            As of `Renderer`.
        """
        self.sensor, self._device = sensor, device
        parts = band_sensors(sensor, count=count, at=at)
        self.bands, self._leds = [band for band, _, _ in parts], [leds for _, leds, _ in parts]
        others: list[Renderer | None] = [None] * len(parts)
        if like is not None and len(like.renderers) == len(parts):
            others = list(like.renderers)
        self.renderers: list[Renderer] = [
            Renderer(one, device=device, coloured=coloured, like=other)
            for (_, _, one), other in zip(parts, others, strict=True)
        ]

    @property
    def response(self) -> NDArray[np.float64]:
        """What the camera makes of each LED's light over what it makes of as much at the one wavelength where
        it sees best, mean of its channels, (n_led,); 0 where it is blind."""
        return np.asarray(sum(band.share.mean(axis=1) for band in self.bands))

    @cached_property
    def whole(self) -> Renderer:
        """The sensor with all its LEDs at its one wavelength."""
        alone = self.renderers[0]
        return alone if len(self.renderers) == 1 else Renderer(self.sensor, device=self._device)

    def together(self, each: list[NDArray[np.float64]]) -> NDArray[np.float64]:
        """Radiance (n_led, rows, columns[, 3]) of all bands, from each band's LEDs, (n, rows, columns)."""
        camera = self.sensor.camera
        planes = () if camera.colour == "mono" else (len(camera.channels),)
        radiance = np.zeros((len(self.sensor.leds), *camera.shape, *planes))
        for band, leds, layers in zip(self.bands, self._leds, each, strict=True):
            share = band.share[list(leds)]
            if planes:
                radiance[list(leds)] += layers[..., None] * share[:, None, None, :]
            else:
                radiance[list(leds)] += layers * share[:, :1, None]
        return radiance

    def render(
        self,
        pressed: pv.PolyData | OpticalSurface,
        *,
        quality: Quality = "standard",
        seed: int = 0,
        samples: int | None = None,
        traced: tuple[NDArray[np.float64] | TracedLight, ...] | None = None,
        progress: Callable[[float], None] | None = None,
        **options: Any,
    ) -> Rendering:
        """Return the picture of a pressed contact surface; arguments as of `Renderer.render`.

        `radiance` is (n_led, rows, columns), or (n_led, rows, columns, 3) for a camera of colour, each
        channel summed against its own response. Samples are shared out among the bands of a spectrum.
        """
        start = time.perf_counter()
        camera = self.sensor.camera
        planes = () if camera.colour == "mono" else (len(camera.channels),)
        radiance = np.zeros((len(self.sensor.leds), *camera.shape, *planes))
        sinks: NDArray[np.float64] | None = None
        trapped = np.zeros(len(self.sensor.leds))
        variance, veil, first = 0.0, 0.0, None
        walked: list[NDArray[np.floating]] = []
        for number, (band, leds, renderer) in enumerate(
            zip(self.bands, self._leds, self.renderers, strict=True)
        ):
            whole = samples or PATHS_PER_LED[quality]
            try:
                one = renderer.render(
                    pressed,
                    quality=quality,
                    seed=(seed + number * _SEED_STEP) % _SEEDS if number else seed,
                    samples=samples if band.parts == 1 else max(whole // band.parts, 2),
                    traced=traced[number : number + 1] if traced else None,
                    progress=_part(progress, number, len(self.bands)),
                    **options,
                )
            except NotModelled as refused:  # under the LEDs' numbers in the whole sensor
                text = re.sub(r"leds\.(\d+)", lambda found: f"leds.{leds[int(found[1])]}", str(refused))  # noqa: B023
                raise NotModelled(text) from None
            if len(self.bands) == 1 and not planes and np.all(band.share == 1.0):
                return one
            share = band.share[list(leds)]
            layers = one.radiance.astype(np.float64)
            if planes:
                radiance[list(leds)] += layers[..., None] * share[:, None, None, :]
            else:
                radiance[list(leds)] += layers * share[:, :1, None]
            counts = np.tensordot(share.mean(axis=1), layers, 1)
            variance += (0.01 * one.noise_percent * float(np.mean(counts))) ** 2
            if one.sinks is not None and one.trapped is not None:
                if sinks is None:
                    sinks = np.zeros((len(self.sensor.leds), one.sinks.shape[1]))
                sinks[list(leds)] += band.energy * one.sinks
                trapped[list(leds)] += band.energy * one.trapped
            veil += one.from_housing_percent * float(np.mean(counts))
            first = first or one
            walked += one.traced or ()
        assert first is not None
        noise = 100.0 * np.sqrt(variance) / max(_mean(radiance), 1e-30)
        return replace(
            first,
            radiance=radiance.astype(np.float32),
            noise_percent=float(noise),
            from_housing_percent=veil / max(_mean(radiance), 1e-30),
            sinks=sinks,
            trapped=None if sinks is None else trapped,
            traced=tuple(walked) or None,
            seconds=time.perf_counter() - start,
        )


def band_sensors(
    sensor: Sensor, *, count: int = 3, at: Callable[[float], Sensor] | None = None
) -> list[tuple[Band, tuple[int, ...], Sensor]]:
    """Return each band, the numbers of its LEDs, and the sensor as it is there; arguments as of
    `SpectralRenderer`."""
    found = []
    for band in bands(sensor.leds, sensor.camera, sensor.wavelength_nm, count):
        leds = _alight(sensor, band)
        same = band.wavelength_nm == sensor.wavelength_nm
        there = at(band.wavelength_nm) if at and not same else sensor
        chosen = tuple(_as_line(there.leds[number], number in band.leds) for number in leds)
        found.append((band, leds, replace(there, leds=chosen, wavelength_nm=band.wavelength_nm)))
    return found


def _mean(radiance: NDArray[np.float64]) -> float:
    """Mean of all LEDs together over pixels and channels."""
    return float(radiance.mean()) * radiance.shape[0]


def _alight(sensor: Sensor, band: Band) -> tuple[int, ...]:
    """The LEDs to put into a band's scene: those that shine, and those that stand in the way of light or have
    a window in painted walls."""
    clear = sensor.guide.walls == "polished"
    if clear and all(led.coupling == "air" and led.side != "below" for led in sensor.leds):
        return band.leds
    return tuple(range(len(sensor.leds)))


def _as_line(led: Led, lit: bool) -> Led:
    flux = led.flux_W if lit else 0.0
    return replace(led, flux_W=flux, flux_lm=None, spectrum="line", peak_nm=None, fwhm_nm=None)


def _part(progress: Callable[[float], None] | None, number: int, of: int) -> Callable[[float], None] | None:
    if progress is None:
        return None
    return lambda share: progress((number + share) / of)
