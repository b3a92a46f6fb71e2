"""How light that enters aslant comes out, taken apart: by harmonics of the azimuth, and in each by a few
functions of the cosine, so that it becomes a few smooth maps of light, each spread by a kernel of its own.

The Fourier transform of where a beam comes out (`Slab.aslant`) depends on the wave number k, the cosine of
entry µ and the azimuth φ between the beam and the wave; it is even in φ:

    F(k, µ, φ) = Σ_m i^(m odd) cos mφ Σ_r X_mr(k) h_mr(µ).

With cos m(φ_k - φ_beam) = cos mφ_k cos mφ_beam + sin mφ_k sin mφ_beam every h_mr asks for two maps, one of
light weighed by h cos mφ_beam and one by h sin mφ_beam.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .slab import Slab, cosines

Array = NDArray[np.float64]

HARMONICS = 3
_ENOUGH = 0.005  # largest error of a harmonic, of the largest value; grazing light and fine waves count less
_FINE_PER_MM = 1.5  # wave number of what is seen about half: light on a contact changes over millimetres
_AZIMUTHS, _WAVES = 24, 60
_TOP = 25.0  # of k, 1/mean free path: beyond, all fall as 1/k
_GRAZING = 0.1  # cosine below which little gets through any contact
_DARK = 1e-4  # answer whose parts do not matter
ALL, STEEP, DEEP = 0, 1, 2
"""What is asked of the light that comes out: all of it; its radiance factor along the normal; the same times
the depth of the last collision, mm."""


@dataclass(frozen=True)
class Aslant:
    """The parts of `Slab.aslant`.

    Attributes
    ----------
    functions : by harmonic m, (r_m, n)
        h_mr on cosines in the tissue uniform on 0..1; in harmonic 0 the tissue's lobes φ_i come first.
    transforms : by harmonic m, (3, r_m, K)
        X_mr of what `ALL` leaves, over the transform of Lambertian light, of what leaves `STEEP`, and `DEEP`.
        Light that leaves not quite along the normal seems to come from behind, by that depth times the sine
        of the angle in the tissue.
    """

    transport_per_mm: float
    functions: tuple[Array, ...]
    transforms: tuple[Array, ...]

    def at(self, transforms: Array, wave_per_mm: Array, tail: float) -> Array:
        """Transforms (..., K) at wave numbers, 1/mm: (..., *shape); beyond the last as k^-tail."""
        scaled = np.asarray(wave_per_mm) / self.transport_per_mm
        found = CubicSpline(_stretched(_waves()), transforms, axis=-1)(_stretched(np.minimum(scaled, _TOP)))
        return np.asarray(found * (_TOP / np.maximum(scaled, _TOP)) ** tail)


def aslant(body: Slab, transport_per_mm: float, lobes: Array) -> Aslant:
    """Take the answer of a body apart: `lobes` (modes, n) are its φ_i on cosines uniform on 0..1."""
    beams, diffuse = _beams(body)
    cosine, _ = cosines()
    by_harmonic = np.fft.fft(beams, axis=3) / _AZIMUTHS
    peak = np.maximum(np.abs(beams).max(axis=(1, 2, 3)), _DARK)[:, None, None]
    seen = cosine / (cosine + _GRAZING)
    fine = 1.0 / (1.0 + (_waves() * transport_per_mm / _FINE_PER_MM) ** 1.5)[:, None]
    grid = np.linspace(0.0, 1.0, lobes.shape[1])
    there = np.stack([np.interp(cosine, grid, lobe) for lobe in lobes])
    functions, transforms = [], []
    for m in range(HARMONICS + 1):
        part = by_harmonic[..., m] * (2.0 if m else 1.0)
        values = (part.imag if m % 2 else part.real) / peak * seen * fine
        flat = values[:DEEP].reshape(-1, cosine.size)  # a row for each exit and wave number
        known = there * seen if m == 0 else np.empty((0, cosine.size))
        share = np.linalg.lstsq(known.T, flat.T, rcond=None)[0].T
        left, sizes, shapes = np.linalg.svd(flat - share @ known, full_matrices=False)
        rest = [np.abs((left[:, n:] * sizes[n:]) @ shapes[n:]).max() for n in range(sizes.size + 1)]
        count = int(np.argmax(np.array(rest) <= _ENOUGH))
        shares = np.hstack([share, left[:, :count] * sizes[:count]]).reshape(DEEP, diffuse.size, -1)
        every = np.vstack([known, shapes[:count]])  # enough for depths, too: they are asked for a small part
        deep = np.linalg.lstsq(every.T, values[DEEP].T, rcond=None)[0].T
        shares = np.concatenate([shares, deep[None]]) / fine * peak
        shares[ALL] /= np.maximum(diffuse, 1e-300)[:, None]
        shares[DEEP] /= transport_per_mm
        transforms.append(np.moveaxis(shares, 1, 2))
        more = CubicSpline(cosine, shapes[:count] / seen, axis=1)(grid)
        functions.append(np.vstack([lobes, more]) if m == 0 else more)
    return Aslant(transport_per_mm, tuple(functions), tuple(transforms))


@lru_cache(maxsize=16)
def _beams(slab: Slab) -> tuple[NDArray[np.complex128], Array]:
    """`Slab.aslant` at the Gauss cosines, and the transform of Lambertian light; 0.2 s."""
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    return slab.aslant(_waves(), cosines()[0], azimuth), slab.reflectance(_waves())


def _waves() -> Array:
    """Wave numbers of the transforms, 1/mean free path."""
    return np.concatenate([[0.0], np.geomspace(0.02, _TOP, _WAVES)])


def _stretched(k: Array) -> Array:
    return np.asarray(np.arcsinh(k / 0.05))
