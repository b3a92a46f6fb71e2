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
    """

    entering: NDArray[np.complex64]
    seen: NDArray[np.complex64]
    lambertian: NDArray[np.float32]
    cells: int
    margin: int
    held: Array
    free: Array
    local: Array

    def enter(self, maps: Array) -> Array:
        """Lambertian irradiance that would come out as what enters does, (n, cells, cells) with the margin,
        from maps (n, functions, m, m), W/mm²."""
        return np.stack([self._back((self._forth(one) * self.entering).sum(axis=0)) for one in maps])

    def towards_camera(self, maps: Array, upward: Array, fraction: Array) -> Array:
        """Light that goes up along the normal, π L, (n, cells, cells) W/mm² with the margin.

        Parameters
        ----------
        maps
            All that has entered, as for `enter`.
        upward : (n, modes, cells, cells)
            V, from `spread`.
        fraction : (cells, cells)
            Real contact fraction; not a number where there is no guide but bare skin.
        """
        bare = np.isnan(fraction)
        nodes, fraction = np.linspace(0.0, 1.0, len(self.held)), np.where(bare, 0.0, fraction)
        found = np.empty((len(maps), *fraction.shape))
        held = np.stack(
            [
                [np.where(bare, self.free[i, j], np.interp(fraction, nodes, self.held[:, i, j])) for j in row]
                for i, row in enumerate(np.indices(self.free.shape)[1])
            ]
        )
        for number, one in enumerate(maps):
            thrown = np.einsum("ijyx,jyx->iyx", held, upward[number])
            spectrum = (self._forth(one) * self.seen).sum(axis=0) + self.lambertian * self._forth(thrown[0])
            found[number] = self._back(spectrum) + np.tensordot(self.local, thrown, 1)
        return found

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
    return Passage(entering, seen, lambertian, cells, margin, coupling.held, coupling.free, local)
