"""Light's first pass through the tissue, on cells: what enters at an angle comes out ahead and spread.

Each map of what enters (`irradiance.transmitted`) is spread by its own kernel (`aslant`), for all light that
leaves and for what leaves towards the camera, which comes from deeper. What the face throws back is spread as
Lambertian light is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from .aslant import ALL, STEEP
from .tissue import Coupling, TissueOptics

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Glimpse:
    """What of the first pass leaves along the normal: Fourier transforms (n, p, p // 2 + 1), and the sums of
    light times how far behind it lies, (n,) as `Aslant.behind`."""

    spectra: NDArray[np.complex64]
    behind: Array


@dataclass(frozen=True)
class Seen:
    """Light that leaves towards the camera.

    Attributes
    ----------
    maps : (n, m, m)
        π times the radiance in the tissue along the normal, W/mm², on cells [iy, ix] of the guide's face and
        a margin beside it.
    behind_mm : (n,)
        How far behind, mm per sine of the angle in the tissue, light is to be looked up that leaves aslant.
    steeper : (n,)
        Its relative rise per 1 - cosine: what leaves aslant has come from less deep.
    """

    maps: Array
    behind_mm: Array
    steeper: Array


@dataclass(frozen=True)
class Passage:
    """The kernels of one tissue on one grid of square cells; make it with `passage`.

    Attributes
    ----------
    entering, seen : (functions, p, p // 2 + 1)
        Fourier transforms of the kernels, over cells, padded so that nothing wraps round: of Lambertian light
        that comes out as all that entered does, and of the light towards the camera. Their origin is shifted
        from the guide's first cell to the margin's.
    lambertian : (p, p // 2 + 1)
        The same of Lambertian light, towards the camera.
    cells, margin
        Of the guide's face per side, and beside it.
    held : (n_fraction, modes, modes), free : (modes, modes)
        W of `tissue.Coupling`.
    local : (modes,)
        What a mode's light adds towards the camera where it entered; 0 for the first.
    transport_per_mm, behind, behind_lambertian
        Of `aslant.Aslant`.
    """

    entering: NDArray[np.complex64]
    seen: NDArray[np.complex64]
    lambertian: NDArray[np.float32]
    cells: int
    margin: int
    held: Array
    free: Array
    local: Array
    transport_per_mm: float
    behind: Array
    behind_lambertian: float

    def enter(self, maps: Array) -> tuple[Array, Glimpse]:
        """From maps (n, functions, m, m) of what enters, W/mm²: Lambertian irradiance that would come out as it
        does, (n, cells, cells) with the margin; and what of the first pass leaves along the normal."""
        entering, glimpse = [], []
        for one in maps:
            spectra = self._forth(one)
            entering.append(self._back(np.einsum("kyx,kyx->yx", spectra, self.entering)))
            glimpse.append(np.einsum("kyx,kyx->yx", spectra, self.seen))
        rings = self.behind.size
        behind = maps[:, :rings].sum(axis=(2, 3)) @ self.behind
        return np.stack(entering), Glimpse(np.stack(glimpse), behind)

    def towards_camera(self, glimpse: Glimpse, upward: Array, fraction: Array) -> Seen:
        """What leaves towards the camera.

        Parameters
        ----------
        glimpse
            From `enter`.
        upward : (n, modes, cells, cells)
            V, from `spread`.
        fraction : (cells, cells)
            Real contact fraction; not a number where there is no guide but bare skin.
        """
        bare = np.isnan(fraction)
        nodes, fraction = np.linspace(0.0, 1.0, len(self.held)), np.where(bare, 0.0, fraction)
        modes = range(len(self.free))
        thrown = np.zeros_like(upward)
        for i in modes:
            for j in modes:
                held = np.where(bare, self.free[i, j], np.interp(fraction, nodes, self.held[:, i, j]))
                thrown[:, i] += held * upward[:, j]
        seen = np.tensordot(thrown, self.local, (1, 0))
        for number, (spectrum, again) in enumerate(zip(glimpse.spectra, thrown[:, 0], strict=True)):
            seen[number] += self._back(spectrum + self.lambertian * self._forth(again))
        behind = glimpse.behind + self.behind_lambertian * thrown[:, 0].sum(axis=(1, 2))
        behind /= np.maximum(seen.sum(axis=(1, 2)), 1e-300)
        return Seen(seen, behind, 1.0 - self.transport_per_mm * behind)

    def _forth(self, maps: Array) -> NDArray[np.complex64]:
        padded = len(self.lambertian)
        rows = scipy.fft.rfft(maps.astype(np.float32), padded, axis=-1, workers=1)
        return np.asarray(scipy.fft.fft(rows, padded, axis=-2, workers=1))

    def _back(self, spectrum: NDArray[np.complex64]) -> Array:
        padded, wide = len(self.lambertian), self.cells + 2 * self.margin
        rows = scipy.fft.ifft(spectrum, axis=-2, workers=1)[..., :wide, :]
        return scipy.fft.irfft(rows, padded, axis=-1, workers=1)[..., :wide].astype(np.float64)


def passage(tissue: TissueOptics, coupling: Coupling, width_mm: float, cells: int, margin: int) -> Passage:
    """Prepare the first pass on `cells` x `cells` cells over a face of `width_mm`, and a margin beside it."""
    apart, step = coupling.aslant, width_mm / cells
    padded = int(scipy.fft.next_fast_len(2 * (cells + 2 * margin), real=True))
    kx, ky = (2.0 * np.pi * turn(padded, step) for turn in (scipy.fft.rfftfreq, scipy.fft.fftfreq))
    k, azimuth = np.hypot(kx, ky[:, None]), np.arctan2(ky[:, None], kx)
    shift = np.exp(-1j * margin * step * (kx + ky[:, None]))
    kernels: tuple[list[NDArray[np.complex64]], ...] = ([], [])
    for m, transforms in enumerate(apart.transforms):
        for turn in (np.cos, np.sin) if m else (np.cos,):
            for what, tail in ((ALL, 0.0), (STEEP, 1.0)):
                turned = turn(m * azimuth) * shift * (1j if m % 2 else 1.0)
                found = apart.at(transforms[what], k, tail) * turned
                kernels[what].extend(found.astype(np.complex64))
    lambertian = apart.at(apart.lambertian, k, 1.0).astype(np.float32)
    local = tissue.strengths * tissue.lobes[:, -1] * (np.arange(tissue.strengths.size) > 0)
    entering, seen = (np.array(one, dtype=np.complex64) for one in kernels)
    of_exit = apart.transport_per_mm, apart.behind, apart.behind_lambertian
    return Passage(entering, seen, lambertian, cells, margin, coupling.held, coupling.free, local, *of_exit)
