"""How light that enters aslant comes out, taken apart: by harmonics of the azimuth, and in each by a few
functions of the cosine, so that it becomes a few smooth maps of light, each spread by a kernel of its own.

The Fourier transform of where a beam comes out (`aslant` of `Slab` or `HalfSpace`) depends on the wave
number k, the cosine of entry µ and the azimuth φ between the beam and the wave; it is even in φ:

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

from .ftir import gap_transmittance
from .half_space import TOP, HalfSpace
from .slab import Slab, cosines

Array = NDArray[np.float64]

HARMONICS = 5
"""Of the azimuth. With three, light beside LEDs spread too little: 0.3 to 0.7 % dark at 1 to 4 mm from the
rim (`tests/test_standard_quality.py`); seven change no millimetre by more than 0.35 % from five."""

_ENOUGH = 0.005  # largest error of a harmonic, of the largest value; grazing light and fine waves count less
_FINE_PER_MM = 1.5  # wave number of what is seen about half: light on a contact changes over millimetres
_AZIMUTHS, _WAVES = 24, 60
_TOP = 25.0  # of k, 1/mean free path: beyond, all fall as 1/k
_GRAZING = 0.1  # cosine below which little gets through any contact
_THIN, _FINEST_PER_MM = 10.0, 25.0  # of a slab: k by which exp(-k depth) is gone, and what no map shows
_DARK = 1e-4  # answer whose parts do not matter
_BLACK = 1e-12  # share that comes back, below which nothing does
ALL, STEEP, DEEP, HELD = 0, 1, 2, 3
"""What is asked of the light that comes out: all of it; its radiance factor along the normal; the same times
the depth of the last collision, mm; what skin throws back of it that nothing touches."""
AHEAD, RISE, LEFT = 2, 4, 5
"""Where scatterings favour a direction, in the place of `DEEP`, of the same factor beside the normal: its
change per sine towards the wave over -i; per 1 - cosine; per sine to the left of the wave over -i, whose
harmonics go with sin mφ."""


@dataclass(frozen=True)
class Aslant:
    """The parts of the answer.

    Attributes
    ----------
    functions : by harmonic m, (r_m, n)
        h_mr on cosines in the tissue uniform on 0..1; in harmonic 0 the tissue's lobes φ_i come first.
    transforms : by harmonic m, (4 or 6, r_m, K)
        X_mr of what `ALL` leaves, over the transform of Lambertian light, of what leaves `STEEP`, and `DEEP`.
        Light that leaves not quite along the normal seems to come from behind, by that depth times the sine
        of the angle in the tissue. `HELD` as `ALL`: mostly grazing light is thrown back; it comes from less
        deep, so that what went in aslant is less far ahead. Its total is that of `ALL`: what more there is,
        local modes have. Of a `HalfSpace` `AHEAD`, `RISE` and `LEFT` in the place of `DEEP`.
    """

    transport_per_mm: float
    functions: tuple[Array, ...]
    transforms: tuple[Array, ...]
    top: float = _TOP

    def at(self, transforms: Array, wave_per_mm: Array, tail: float) -> Array:
        """Transforms (..., K) at wave numbers, 1/mm: (..., *shape); beyond the last as k^-tail."""
        scaled = np.asarray(wave_per_mm) / self.transport_per_mm
        found = CubicSpline(_stretched(_waves(self.top)), transforms, axis=-1)(
            _stretched(np.minimum(scaled, self.top))
        )
        return np.asarray(found * (self.top / np.maximum(scaled, self.top)) ** tail)


def aslant(
    body: Slab | HalfSpace, transport_per_mm: float, lobes: Array, refractive_index: float, gap_index: float
) -> Aslant:
    """Take the answer of a body apart: `lobes` (modes, n) are its φ_i on cosines uniform on 0..1, the indices
    its own and that of what fills the gaps above it."""
    if isinstance(body, HalfSpace):
        top = TOP
        beams, diffuse = _forward_beams(body, refractive_index, gap_index)
    else:
        top = max(_TOP, min(_THIN / body.depth, _FINEST_PER_MM / transport_per_mm))
        beams, diffuse = _beams(body, refractive_index, gap_index, top)
    cosine, _ = cosines()
    by_harmonic = np.fft.fft(beams, axis=3) / _AZIMUTHS
    by_harmonic[LEFT:] *= 1j  # sines
    peak = np.maximum(np.abs(beams).max(axis=(1, 2, 3)), _DARK)[:, None, None]
    seen = cosine / (cosine + _GRAZING)
    fine = 1.0 / (1.0 + (_waves(top) * transport_per_mm / _FINE_PER_MM) ** 1.5)[:, None]
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
        more = [np.linalg.lstsq(every.T, one.T, rcond=None)[0].T for one in values[DEEP:]]
        shares = np.concatenate([shares, more]) / fine * peak
        shares[[ALL, HELD]] /= np.maximum(diffuse, 1e-300)[:, None]
        if isinstance(body, Slab):
            shares[DEEP] /= transport_per_mm
        transforms.append(np.moveaxis(shares, 1, 2))
        # odd harmonics go with the sine of the angle, which no spline in the cosine follows to the normal
        sine = [np.sqrt(1.0 - values**2) if m % 2 else np.ones(values.size) for values in (cosine, grid)]
        further = CubicSpline(cosine, shapes[:count] / seen / sine[0], axis=1)(grid) * sine[1]
        functions.append(np.vstack([lobes, further]) if m == 0 else further)
    return Aslant(transport_per_mm, tuple(functions), tuple(transforms), top)


@lru_cache(maxsize=16)
def _beams(
    slab: Slab, refractive_index: float, gap_index: float, top: float
) -> tuple[NDArray[np.complex128], Array]:
    """`Slab.aslant` and `HELD` at the Gauss cosines, and the transform of Lambertian light; 1 to 2 s."""
    azimuth = 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS
    beams, diffuse = slab.aslant(_waves(top), cosines()[0], azimuth), slab.reflectance(_waves(top))
    held = beams[ALL]
    if np.isinf(slab.depth) and diffuse[0] > _BLACK and gap_index < refractive_index:
        held = _held(by_exit(beams[STEEP], _thrown_back(refractive_index, gap_index)), held, diffuse)
    return np.concatenate([beams, held[None]]), diffuse


@lru_cache(maxsize=16)
def _forward_beams(
    body: HalfSpace, refractive_index: float, gap_index: float
) -> tuple[NDArray[np.complex128], Array]:
    """The same of a `HalfSpace`, with `AHEAD`, `RISE` and `LEFT`; 6 s.

    What few harmonics are off by where nothing varies along the face, up to 0.5 % of grazing light, is put
    right by many.
    """
    mu, _ = cosines()
    side = _AZIMUTHS // 2 + 1  # the other side is like it, but for what goes to the left
    counts = _thrown_back(refractive_index, gap_index) if gap_index < refractive_index else np.ones(mu.size)
    half = body.aslant(_waves(TOP), mu, 2.0 * np.pi * np.arange(side) / _AZIMUTHS, counts)
    mirrored = half[..., -2:0:-1].copy()
    mirrored[LEFT] *= -1.0
    beams, diffuse = np.concatenate([half, mirrored], axis=-1), body.reflectance(_waves(TOP))
    for what, exact in ((ALL, body.plane_albedo(mu)), (STEEP, body.factors(np.ones(1))[0])):
        beams[what] *= (exact / beams[what, 0].mean(axis=-1).real)[None, :, None]
    beams[HELD] = _held(beams[HELD], beams[ALL], diffuse) if gap_index < refractive_index else beams[ALL]
    return beams, diffuse


def _thrown_back(refractive_index: float, gap_index: float) -> Array:
    """Share of light that skin throws back, where nothing touches it, at the Gauss cosines."""
    gap = gap_index, gap_index, 0.0  # endless: any wavelength will do
    t_s, t_p = gap_transmittance(refractive_index, *gap, cosines()[0], 550.0)
    return np.asarray(1.0 - 0.5 * (t_s + t_p))


def _held(
    counted: NDArray[np.complex128], everything: NDArray[np.complex128], diffuse: Array
) -> NDArray[np.complex128]:
    """`HELD` from what is thrown back of beams' light over that of Lambertian light; its total as `ALL`."""
    share = (diffuse / diffuse[0])[:, None, None]
    return np.asarray((counted - counted[0]) * diffuse[:, None, None] + everything[0] * share)


def by_exit(steep: NDArray[np.complex128], counts: Array) -> NDArray[np.complex128]:
    """What comes out of a half-space where each exit cosine (N,) counts so much, over the same of Lambertian
    light, (K, N, azimuths), from what leaves along the normal, of like shape.

    With p = 1/µ + i k tanθ cosφ the radiance factor is h(p) h(p') / (µ µ' (p + p')) in and out, as at k = 0
    (Chandrasekhar 1960, ch. IV; key chandrasekhar1960), because what an entering beam excites is one function
    of p (`Slab.aslant`); p = 1 along the normal tells h.
    """
    mu, weight = cosines()
    side = _AZIMUTHS // 2 + 1  # azimuths 0..π: the other side is like it
    turns, ends = np.cos(np.pi * np.arange(side) / (side - 1)), np.full(side, 2.0 / _AZIMUTHS)
    ends[[0, -1]] /= 2.0
    even, tangent = 2.0 * mu * weight, np.sqrt(1.0 - mu**2) / mu
    out = ((even * counts / mu)[:, None] * ends).ravel()
    found = np.empty_like(steep)
    for number, wave in enumerate(_waves()):
        p = (1.0 / mu[:, None] + 1j * wave * tangent[:, None] * turns).ravel()
        own = (steep[number, :, :side] * mu[:, None]).ravel() * (p + 1.0)
        given = (own * ((1.0 / (p[:, None] + p)) @ (own * out))).reshape(mu.size, side) / mu[:, None]
        found[number] = np.hstack([given, given[:, -2:0:-1]]) / (even @ given @ ends)
    return found


def _waves(top: float = _TOP) -> Array:
    """Wave numbers of the transforms, 1/mean free path."""
    count = round(_WAVES * np.log(top / 0.02) / np.log(_TOP / 0.02))
    return np.concatenate([[0.0], np.geomspace(0.02, top, count)])


def _stretched(k: Array) -> Array:
    return np.asarray(np.arcsinh(k / 0.05))
