"""Diffuse reflectance of a scattering slab or half-space, over angle and over lateral wave number.

No index step: the boundary is the contact's. Lengths are in transport mean free paths 1/µt', µt' = µs' + µa,
wave numbers their inverse. Scattering is isotropic, with reduced coefficients (similarity: van de Hulst 1980,
ch. 14; key hulst1980).

Isotropic sources that vary as exp(ikx) meet the kernel of transport, ∫ dµ/(µ² q) exp(-q |z - z'|) over
0 < µ < 1 with q² = 1/µ² + k²: a problem of one dimension whose "directions" decay at q (Rybicki 1971; key
rybicki1971). On Gauss nodes µ_j with weights w_j (discrete ordinates: Chandrasekhar 1960, ch. III; key
chandrasekhar1960) its modes exp(-λ z) follow from one symmetric eigenproblem, diag(1/µ²) - a v vᵀ with
v_j = sqrt(w_j)/µ_j, and λ² = λ²(k = 0) + k² with the same vectors for every k.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_COUNT = 40
_NORMAL = 1.0 + 1e-7  # off the pole where a mode falls as fast
_STEP = 3e-3  # of it, for derivatives
_LEAST_ABSORBED = 1e-9  # per scattering: a white slab has no unique solution at k = 0


def cosines() -> tuple[Array, Array]:
    """Gauss nodes µ_j and weights w_j of the model on 0..1, (N,) each; Σ w f(µ) = ∫ f dµ."""
    x, w = np.polynomial.legendre.leggauss(_COUNT)
    return 0.5 * (1.0 + x), 0.5 * w


@dataclass(frozen=True)
class Slab:
    """A scattering layer.

    Attributes
    ----------
    albedo
        µs'/µt' of one scattering, 0..1.
    depth
        Thickness in 1/µt'; infinity for a half-space.
    backing
        Reflectance, 0..1, of the Lambertian plane behind it.
    """

    albedo: float
    depth: float = np.inf
    backing: float = 0.0

    @property
    def first(self) -> float:
        """Limit of k R^(k) at large k: light scattered once, which rises as 1/r in the middle."""
        return 0.5 * self.albedo

    @property
    def bend(self) -> float:
        """About the wave number at which R^ gets to that."""
        return 1.0 + 1.0 / self.depth

    @property
    def decay_rate(self) -> float:
        """Slowest decay λ with depth, per mean free path: that of diffuse light far from any source."""
        return float(_modes(self.albedo)[0][0])

    def reflectance(self, k: Array) -> Array:
        """Fourier transform of the radial reflectance, (n,) for wave numbers (n,).

        Lambertian light of unit flux enters at a point; what leaves is counted in all directions.
        """
        up, down = self._passes(np.atleast_1d(np.asarray(k, dtype=np.float64)))
        return np.asarray(up + self.backing * down**2 / (1.0 - self.backing * up))

    def factors(self, cosine: Array) -> Array:
        """Radiance factor π L / E, (n, N), out at cosines (n,) for light in at the N Gauss cosines; k = 0."""
        mu, weight = cosines()
        out = np.maximum(np.asarray(cosine, dtype=np.float64), 1e-12)
        falling, rising = (part[0] for part in self._amplitudes(np.zeros(1), np.diag(2.0 / weight)))
        rate, vectors = _modes(self.albedo)
        source = self.albedo / 8.0 * ((np.sqrt(weight) / mu) @ vectors)
        # ∫ S exp(-p z) p dz / 4 over modes that fall with depth, and over those that rise
        p = 1.0 / out[:, None]
        near = p * -np.expm1(-(rate + p) * self.depth) / (rate + p) * source
        if np.isinf(self.depth):
            return np.asarray(near @ falling)
        far = p * _ramp(rate, p, self.depth) * source
        above, below = near @ falling + far @ rising, near @ rising + far @ falling
        lambert = 2.0 * mu * weight
        again = self.backing / (1.0 - self.backing * self._passes(np.zeros(1))[0])
        through = below @ lambert + np.exp(-self.depth / out)
        forth, back = self._leaving(1.0 / mu[None], rate[None])
        reaching = (np.exp(-rate * self.depth) * forth[0]) @ falling + back[0] @ rising
        return np.asarray(above + again * through[:, None] * reaching)

    def plane_albedo(self, cosine: Array) -> Array:
        """Share that comes back of light entering at cosines (n,).

        By reciprocity also the radiance factor at that cosine where Lambertian light enters.
        """
        mu, weight = cosines()
        return np.asarray(self.factors(cosine) @ (2.0 * mu * weight))

    def aslant(self, k: Array, cosine: Array, azimuth: Array) -> NDArray[np.complex128]:
        """Fourier transform of where a beam comes out, (3, n_k, n_cos, n_azimuth).

        Of unit irradiance that enters at cosines (n_cos,) > 0 and azimuths (n_azimuth,), rad, to the wave
        vector of length k (n_k,): (0) of all light that leaves; its total is the plane albedo. (1) Of the
        radiance factor π L / E along the normal. (2) Of the same times the depth of the last collision. The
        place r counts as exp(-i k·r).

        The beam falls with depth as exp(-p z), p = 1/µ + i k tanθ cosφ. Where it collides, light is like that
        of an isotropic source; what such a source at z sends out is by reciprocity the field G(z) of light
        that enters as the exit looks: Lambertian, or along the normal. One solve for each k so serves all
        ways in.
        """
        inward = np.asarray(cosine, dtype=np.float64)[:, None]
        ahead = np.sqrt(1.0 - inward**2) / inward * np.cos(azimuth)
        found = np.empty((4, len(k), len(inward), len(azimuth)), dtype=np.complex128)
        falls = _NORMAL + np.array([0.0, -_STEP, _STEP])  # of light on its way out, with depth
        for number, wave in enumerate(np.asarray(k, dtype=np.float64)[:, None]):
            p = 1.0 / inward + 1j * wave * ahead
            rates, falling, rising = diffuse = self._diffuse_field(wave)
            for part, field in enumerate((diffuse, *(self._steep_field(wave, fall) for fall in falls))):
                found[part, number] = self.albedo / inward * self._overlap(p, *field)
            if self.backing > 0.0:
                up, down = self._passes(wave)
                mirrored = rates, rising, falling
                arrives = np.exp(-p * self.depth) + self.albedo / inward * self._overlap(p, *mirrored)
                steep = np.exp(-falls * self.depth) + self.albedo * self._overlap(falls, *mirrored)
                again = self.backing / (1.0 - self.backing * up) * arrives
                found[:, number] += again * np.append(down, steep)[:, None, None]
        found[2] = (found[2] - found[3]) / (2.0 * _STEP)
        return found[:3]

    def _diffuse_field(self, k: Array) -> tuple[Array, Array, Array]:
        """G(z) of all light that leaves, at one wave number (1,): rates λ of modes, and amplitudes of
        exp(-λ z) and exp(-λ (d - z)), (N,) each."""
        mu, weight = cosines()
        q, rate, vectors = self._rates(k)
        falling, rising = self._amplitudes(k, (0.5 * mu**2 * q)[..., None])
        unit = (np.sqrt(weight) / mu) @ vectors
        return rate[0], unit * falling[0, :, 0], unit * rising[0, :, 0]

    def _steep_field(self, k: Array, normal: float) -> tuple[Array, Array, Array]:
        """The same of the radiance factor along the normal, where light falls as exp(-normal z), in truth 1:
        C exp(-normal z), and modes that undo it at faces."""
        mu, weight = cosines()
        q, rate, vectors = self._rates(k)
        own = 0.25 / (1.0 - self.albedo * np.sum(weight / (mu**2 * (q**2 - normal**2)), axis=1))
        shape = (-0.5 * self.albedo * own[:, None])[..., None]
        falling, rising = self._amplitudes(k, shape / (q - normal)[..., None])
        if np.isfinite(self.depth):
            gone = np.exp(-normal * self.depth)
            up, down = self._amplitudes(k, shape * gone / (q + normal)[..., None])
            falling, rising = falling + down, rising + up
        unit = (np.sqrt(weight) / mu) @ vectors
        return (
            np.append(rate[0], normal),
            np.append(unit * falling[0, :, 0], own),
            np.append(unit * rising[0, :, 0], 0.0),
        )

    def _overlap(self, p: NDArray[np.inexact], rate: Array, falling: Array, rising: Array) -> Any:
        """∫ exp(-p z) G(z) dz over the depth, shape of p (Re p >= 1)."""
        p = p[..., None]
        if np.isinf(self.depth):
            return (falling / (rate + p)).sum(axis=-1)
        near = falling * -np.expm1(-(rate + p) * self.depth) / (rate + p)
        # ∫ exp(-p z) exp(-λ (d - z)) dz, safe where λ = p
        apart: NDArray[np.inexact] = p - rate
        falls = apart.real > 0.0
        later = np.exp(-np.where(falls, rate, p) * self.depth)
        apart = (2.0 * falls - 1.0) * apart * self.depth
        small = np.abs(apart) < 1e-8
        ratio = np.where(small, 1.0, -np.expm1(-apart) / np.where(small, 1.0, apart))
        return (near + rising * self.depth * later * ratio).sum(axis=-1)

    def _amplitudes(self, k: Array, entering: Array) -> tuple[Array, Array]:
        """Amplitudes (n, N, c) of the modes that fall with depth and of those that rise, for c ways (N, c) or
        (n, N, c) in which light enters each "direction"."""
        mu, weight = cosines()
        q, rate, vectors = self._rates(k)
        given = entering * (2.0 * np.sqrt(weight) / mu)[:, None]
        forth = vectors * (q[:, :, None] + rate[:, None, :])
        if np.isinf(self.depth):
            falling = np.asarray(np.linalg.solve(forth, np.broadcast_to(given, (k.size, *given.shape[-2:]))))
            return falling, np.zeros_like(falling)
        back = vectors * (q[:, :, None] - rate[:, None, :]) * np.exp(-rate * self.depth)[:, None, :]
        given = np.broadcast_to(given, (k.size, *given.shape[-2:]))
        even, odd = np.linalg.solve(forth + back, given), np.linalg.solve(forth - back, given)
        return 0.5 * (even + odd), 0.5 * (even - odd)

    def _passes(self, k: Array) -> tuple[Array, Array]:
        """Reflectance and transmittance (n,) of the layer alone, Lambertian point to all exits."""
        mu, weight = cosines()
        q, rate, _ = self._rates(k)
        ways = self._amplitudes(k, (4.0 * mu**2 * q)[:, :, None])
        falling, rising = (part[..., 0] for part in ways)
        forth, back = self._leaving(q, rate)
        if np.isinf(self.depth):
            return np.sum(falling * back, axis=1), np.zeros(k.size)
        fade = np.exp(-rate * self.depth)
        up = np.sum(falling * back + rising * fade * forth, axis=1)
        down = np.sum(falling * fade * forth + rising * back, axis=1)
        unscattered = 2.0 * np.sum(weight * mu**2 * q * np.exp(-q * self.depth), axis=1)
        return up, down - unscattered + _straight(k, self.depth)

    def _rates(self, k: Array) -> tuple[Array, Array, Array]:
        """q (n, N) of the "directions", λ (n, N) of the modes, and the modes' vectors (N, N)."""
        mu, _ = cosines()
        rate, vectors = _modes(self.albedo)
        return np.sqrt(mu**-2 + k[:, None] ** 2), np.sqrt(rate**2 + k[:, None] ** 2), vectors

    def _leaving(self, q: Array, rate: Array) -> tuple[Array, Array]:
        """Flux (n, N) that a mode of unit amplitude sends the way it runs, and the other way."""
        mu, weight = cosines()
        _, vectors = _modes(self.albedo)
        leaving = 0.25 * np.sqrt(weight) * mu
        along, mean = (leaving * q) @ vectors, leaving @ vectors
        return along + mean * rate, along - mean * rate


@lru_cache(maxsize=32)
def _modes(albedo: float) -> tuple[Array, Array]:
    """Decay rates λ (N,) at k = 0, and the modes' vectors (N, N), one in each column."""
    mu, weight = cosines()
    v = np.sqrt(weight) / mu
    square, vectors = np.linalg.eigh(np.diag(mu**-2) - min(albedo, 1.0 - _LEAST_ABSORBED) * np.outer(v, v))
    return np.sqrt(np.maximum(square, 0.0)), vectors


def _ramp(rate: Array, p: Array, depth: float) -> Array:
    """∫ exp(-λ (d - z)) exp(-p z) dz over the depth, safe where λ = p."""
    apart = np.abs(rate - p) * depth
    ratio = np.where(apart < 1e-8, 1.0, -np.expm1(-apart) / np.where(apart < 1e-8, 1.0, apart))
    return np.asarray(depth * np.exp(-np.minimum(rate, p) * depth) * ratio)


def _straight(k: Array, depth: float) -> Array:
    """Fourier transform (n,) of unscattered Lambertian light at the other face.

    That of z² exp(-r)/(π r⁴) at z = d. With exp(-r)/r³ = ∫ exp(-s r)/r² ds over s > 1 and the transform of
    z exp(-s r)/(π r³), 2s ∫ exp(-z q)/p² dp over p > s with q² = p² + k², it is
    d ∫ (1 - 1/p²) exp(-d q) dp over p > 1; 2 E3(d) at k = 0.
    """
    x, w = np.polynomial.legendre.leggauss(8)
    edges = np.concatenate([[0.0], np.geomspace(1e-7, 40.0, 40)])  # of d (q - q(p = 1))
    half = 0.5 * np.diff(edges)
    t = (edges[:-1, None] + half[:, None] * (1.0 + x)).ravel()
    first = np.sqrt(1.0 + k[:, None] ** 2)
    q = first + t / depth
    p = np.sqrt(1.0 + (q - first) * (q + first))
    inner = (1.0 - p**-2) * q / p * np.exp(-t)
    return np.asarray(np.exp(-depth * first[:, 0]) * (inner @ (half[:, None] * w).ravel()))
