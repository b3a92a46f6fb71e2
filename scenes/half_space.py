"""Tissue whose scatterings favour a direction: what a half-space gives back, as `slab` has it of even ones.

The phase function is Henyey and Greenstein's (1941; key henyey1941) with mean cosine g. At equal reduced
scattering µs' = µs (1 - g) less light than with even scatterings leaves within half a transport mean free
path 1/µt' of where it went in, a third less in the middle, and more of it one to three of them away.

By spherical harmonics (`harmonics`) up to an order L. A beam on its way in, or out, falls as what the
harmonics leave it, µ* = µt - µs g^(L+1), and is scattered by what they can tell, µs (g^l - g^(L+1)) (Wiscombe
1977; key wiscombe1977); where both beams are known, light scattered once is taken with the whole phase
function (Nakajima & Tanaka 1988; key nakajima1988). What leaves in one direction is by reciprocity found from
light that enters there. Lengths are in 1/µt', wave numbers in its inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from .harmonics import Basis, Waves, basis, waves
from .slab import Slab, cosines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
Directions = tuple[Array, Array]
"""Cosines and azimuths, (p,) each."""

TOP = 12.0
"""Wave number up to which harmonics tell; beyond, light scattered once does, and the rest falls as k^-2."""

_ORDER, _LEVEL_ORDER = 21, 41  # in waves, and where nothing varies along the face
_LESS = 15  # beside it, to tell what both are off: in fine waves it falls as (order + 1)^-4
_LEAST_ABSORBED = 1e-9  # per scattering, as in `slab`
_TILT = 0.12  # rad, about the camera's, of directions beside the normal
_AROUND = np.cos([0.0, _TILT, _TILT, _TILT]), np.array([0.0, 0.0, np.pi, 0.5 * np.pi])
_LEFT = np.cos([_TILT]), np.array([0.5 * np.pi])
_HALF_TURNS = np.pi * (np.arange(24) + 0.5) / 24
_TURNS = 128  # azimuths of a phase function's mean
_WAVES = 36  # nodes of the reflectance


@dataclass(frozen=True)
class HalfSpace:
    """A half-space; in the place of a `Slab`.

    Attributes
    ----------
    albedo
        µs'/µt', 0..1.
    anisotropy
        Mean cosine g of one scattering, not 0.
    """

    albedo: float
    anisotropy: float
    depth: ClassVar[float] = np.inf
    backing: ClassVar[float] = 0.0

    @property
    def first(self) -> float:
        """Limit of k R^(k): light scattered once, in the middle."""
        _, weight = _single(self.anisotropy)
        return float(2.0 * np.pi * self._scattering * weight.sum())

    @property
    def bend(self) -> float:
        """Wave number from which on `reflectance` goes over into its tail."""
        return self._fall(_ORDER)

    @property
    def decay_rate(self) -> float:
        """Slowest decay with depth: that of diffuse light far from any source."""
        return float(np.abs(np.diag(self._level.root)).min())

    def reflectance(self, k: Array) -> Array:
        """Fourier transform of the radial reflectance, as `Slab.reflectance`, (n,) for wave numbers (n,)."""
        wave = np.atleast_1d(np.asarray(k, dtype=np.float64))
        inner = np.minimum(wave, TOP)
        told = _ratio(self)(np.arcsinh(inner / 0.05)) * Slab(self.albedo).reflectance(inner)
        once = self._once(inner)
        within = np.maximum(told, once)  # of tissue that is nearly black the harmonics know less than that
        beyond = self._once(wave) + (within - once) * (inner / np.maximum(wave, TOP)) ** 2
        return np.where(wave > TOP, beyond, within)

    def factors(self, cosine: Array) -> Array:
        """Radiance factor π L / E, as `Slab.factors`, (n, N)."""
        mu, _ = cosines()
        out = np.maximum(np.asarray(cosine, dtype=np.float64), 1e-4)
        level, fall = self._level, self._fall(_LEVEL_ORDER)
        still = np.zeros(mu.size)
        field = level.beams(self._sources(level.basis), _complex(fall / mu), mu, still)
        several = level.overlap(field, self._weights(level.basis, out, 0.0 * out), _complex(fall / out)).real
        turns = np.cos(np.pi * (np.arange(_TURNS) + 0.5) / _TURNS)
        sine = np.sqrt(1.0 - out[:, None] ** 2) * np.sqrt(1.0 - mu**2)
        between = -out[:, None, None] * mu[:, None] + sine[..., None] * turns
        once = self._scattering * self._phase(between).mean(axis=-1) / (fall / out[:, None] + fall / mu)
        return np.asarray(np.pi * (several.T + once) / (out[:, None] * mu))

    def plane_albedo(self, cosine: Array) -> Array:
        """Share that comes back of light entering at cosines (n,)."""
        mu, weight = cosines()
        return np.asarray(self.factors(cosine) @ (2.0 * mu * weight))

    def aslant(self, k: Array, cosine: Array, azimuth: Array, counts: Array) -> Complex:
        """Fourier transform of where a beam comes out, (6, n_k, n_cos, n_azimuth), as `Slab.aslant`.

        (0) Of all light that leaves, and (1) of the radiance factor along the normal. Of that factor beside
        the normal, in a direction whose sine is towards the wave, the change per sine over -i, (2); where the
        sine is at right angles to the wave, to the left of it, the same (5); and the change per 1 - cosine
        (4). (3) Of what leaves where exits at the Gauss cosines count (N,), over that of Lambertian light.
        """
        upright, across = basis(_ORDER), basis(_ORDER, across=True)
        mu, weight = cosines()
        beams, lambert = _pairs(cosine, azimuth), _pairs(mu, _HALF_TURNS)
        even = np.repeat(2.0 * mu * weight, _HALF_TURNS.size) / _HALF_TURNS.size
        weights, lambert_weights = self._weights(upright, *beams), self._weights(upright, *lambert)
        across_weights = self._weights(across, *beams)
        exits = np.stack([np.ones(mu.size), counts], axis=1)
        found = np.empty((6, len(k), beams[0].size), dtype=np.complex128)
        for number, wave in enumerate(np.asarray(k, dtype=np.float64)):
            solved = self._waves(upright, wave)
            field = solved.lit(exits)
            fall, lambert_fall = self._falls(wave, *beams), self._falls(wave, *lambert)
            everything, counted = solved.overlap(field, weights, fall) / beams[0]
            of_all = solved.overlap(field, lambert_weights, lambert_fall)[1] / lambert[0]
            steep, ahead, behind, aside = self._towards(solved, _AROUND, beams, weights)
            (left,) = self._towards(self._waves(across, wave), _LEFT, beams, across_weights)
            found[:, number] = (
                everything,
                steep,
                0.5j * (ahead - behind) / np.sin(_TILT),
                counted / (of_all @ even),
                (0.25 * (ahead + behind + 2.0 * aside) - steep) / (1.0 - np.cos(_TILT)),
                1j * left / np.sin(_TILT),
            )
        return found.reshape(6, len(k), len(cosine), len(azimuth))

    def _towards(self, solved: Waves, exits: Directions, beams: Directions, weights: Complex) -> Complex:
        """Radiance factor π L / E out at the cosines and azimuths of exits, of beams: (exits, p); what of it
        is even about the wave, or odd."""
        (out, turn), (cosine, azimuth) = exits, beams
        falls, fall = self._falls(solved.wave, *exits), self._falls(solved.wave, *beams)
        several = solved.overlap(solved.beams(self._sources(solved.basis), falls, *exits), weights, fall)
        level, sines = -out[:, None] * cosine, np.sqrt((1.0 - out[:, None] ** 2) * (1.0 - cosine**2))
        one, other = (
            self._phase(level + sines * np.cos(azimuth - side * turn[:, None])) for side in (1.0, -1.0)
        )
        phase = 0.5 * (one - other if solved.basis.across else one + other)
        once = self._scattering * phase / (fall + falls[:, None])
        return np.asarray(np.pi * (several + once) / (cosine * out[:, None]))

    @property
    def _scattering(self) -> float:
        """µs, not reduced."""
        return self.albedo / (1.0 - self.anisotropy)

    @property
    def _level(self) -> Waves:
        """Where nothing varies along the face."""
        return self._waves(basis(_LEVEL_ORDER, level=True), 0.0)

    def _fall(self, order: int) -> float:
        """µ* of a beam beside harmonics up to an order."""
        ahead = self._scattering * (1.0 - self.anisotropy ** (order + 1))
        return max(1.0 - self.albedo, _LEAST_ABSORBED) + ahead

    def _falls(self, wave: float, cosine: Array, azimuth: Array, order: int = _ORDER) -> Complex:
        """p = µ*/µ + i k tanθ cosφ of beams."""
        ahead = np.sqrt(np.maximum(1.0 - cosine**2, 0.0)) / cosine * np.cos(azimuth)
        return np.asarray(self._fall(order) / cosine + 1j * wave * ahead)

    def _sources(self, harmonics: Basis) -> Array:
        """What harmonics scatter, (n,)."""
        powers = np.power(float(self.anisotropy), harmonics.degree)
        return np.asarray(self._scattering * (powers - self.anisotropy ** (harmonics.degree.max() + 1)))

    def _weights(self, harmonics: Basis, cosine: Array, azimuth: Array) -> Complex:
        """What a beam of unit radiance scatters into light that meets another beam's, (n, p)."""
        mirrored = np.where(harmonics.odd, -1.0, 1.0)
        known = 1j**harmonics.turn * mirrored * self._sources(harmonics)
        return np.asarray(known[:, None] * harmonics.values(cosine, azimuth))

    def _waves(self, harmonics: Basis, wave: float) -> Waves:
        loss = self._fall(int(harmonics.degree.max())) - self._sources(harmonics)
        return waves(harmonics, loss, wave)

    def _phase(self, cosine: Array) -> Array:
        return _phase(cosine, self.anisotropy)

    def _once(self, k: Array) -> Array:
        """Transform of light scattered once, Lambertian in, all out."""
        reach, weight = _single(self.anisotropy)
        rate = self._fall(_ORDER) * reach
        return np.asarray(2.0 * np.pi * self._scattering * (weight / np.hypot(k[:, None], rate)).sum(axis=1))


@lru_cache(maxsize=16)
def _ratio(body: HalfSpace) -> CubicSpline:
    """Reflectance over that of even scatterings, on asinh(k / 0.05); 1 s."""
    nodes = np.concatenate([[0.0], np.geomspace(0.02, TOP, _WAVES)])
    mu, weight = cosines()
    lambert = _pairs(mu, _HALF_TURNS)
    even = np.repeat(2.0 * weight, _HALF_TURNS.size) / _HALF_TURNS.size

    def by(order: int) -> Array:
        harmonics, found = basis(order), []
        weights = body._weights(harmonics, *lambert)
        for wave in nodes:
            solved = body._waves(harmonics, wave)
            field, fall = solved.lit(np.ones((mu.size, 1))), body._falls(wave, *lambert, order)
            found.append((solved.overlap(field, weights, fall)[0] @ even).real)
        return np.array(found)

    rest = ((_LESS + 1) / (_ORDER + 1)) ** 4
    found = (by(_ORDER) - rest * by(_LESS)) / (1.0 - rest)
    exact = body.plane_albedo(mu) @ (2.0 * mu * weight)
    shares = found * exact / found[0] / Slab(body.albedo).reflectance(nodes)
    return CubicSpline(np.arcsinh(nodes / 0.05), shares)


@lru_cache(maxsize=16)
def _single(anisotropy: float) -> tuple[Array, Array]:
    """Light scattered once: path over the distance between in and out, ξ, and weights w (n,).

    R(r) = µs / r Σ w exp(-µt ξ r): the place of the scattering in prolate spheroidal coordinates about the
    two spots, ξ and η, where the paths to them are r (ξ ± η) / 2 and Lambert's cosines z / path; the volume's
    turn about the axis gives π/2. 2π µs Σ w / sqrt(k² + (µt ξ)²) is its transform.
    """
    x, w = np.polynomial.legendre.leggauss(80)
    inner, weight = 0.5 * (1.0 + x), 1.5 * w * (0.5 * (1.0 + x)) ** 2  # of u³, crowded at the spots
    reach, eta = 1.0 / (1.0 - inner**3)[:, None], 1.0 - inner**3
    apart = reach**2 - eta**2
    phase = _phase((2.0 - reach**2 - eta**2) / apart, anisotropy)
    rings = (reach**2 - 1.0) * (1.0 - eta**2) / apart**2 * phase @ (2.0 * weight)
    return reach[:, 0], np.asarray(rings * weight * reach[:, 0] ** 2)


def _pairs(cosine: Array, azimuth: Array) -> Directions:
    """Every cosine with every azimuth."""
    one, other = np.meshgrid(cosine, azimuth, indexing="ij")
    return one.ravel(), other.ravel()


def _complex(values: Array) -> Complex:
    return np.asarray(values, dtype=np.complex128)


def _phase(cosine: Array, g: float) -> Array:
    """Henyey and Greenstein's phase function, 1/sr."""
    return np.asarray((1.0 - g**2) / (4.0 * np.pi) / (1.0 + g**2 - 2.0 * g * cosine) ** 1.5)
