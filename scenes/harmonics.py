"""Light in a half-space whose scatterings are not even, at one lateral wave number, by spherical harmonics.

Lengths are in transport mean free paths, light varies as exp(ikx) along the face. On real spherical harmonics
y_lm = N P_l^m(µ) cos mφ (or sin mφ), with i^m taken out of the amplitudes, transport is

    Z dc/dz = -(e_l + k X) c,    e_l = µa + µs (1 - g^l)

(Davison 1957; key davison1957), Z the cosine µ and X the cosine with x between harmonics. Under µ -> -µ a
harmonic is even or odd; Z leads from one kind to the other, X stays within it, so that the even ones can be
taken out: o'' = Γ o, and what falls with depth is exp(-√Γ z) o(0). The root is taken by Schur's form: the
modes of Γ are nearly parallel in fine waves. At the face the odd harmonics of what enters, over half of all
directions, are given (Marshak 1947; key marshak1947).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy.linalg
from numpy.typing import NDArray
from scipy.special import sph_harm_y

from .slab import cosines

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]


@dataclass(frozen=True)
class Basis:
    """Spherical harmonics up to an order, those of one symmetry in y; make it with `basis`.

    Attributes
    ----------
    degree, turn : (n,)
        l and m.
    odd : (n,)
        Which are odd under µ -> -µ.
    climb, half : (n_odd, n_even)
        ∫ µ y y' over all directions, and ∫ y y' over those into the body.
    along_even, along_odd
        ∫ sinθ cosφ y y', with i^m taken out.
    onto : (n_odd, N)
        ∫ y f over the directions into the body of light f(µ) on the Gauss cosines: onto @ f.
    across
        Whether they go with sin mφ.
    """

    degree: NDArray[np.int64]
    turn: NDArray[np.int64]
    odd: NDArray[np.bool_]
    climb: Array
    half: Array
    along_even: Array
    along_odd: Array
    onto: Array
    across: bool

    def values(self, cosine: Array, azimuth: Array) -> Array:
        """y at directions (p,): (n, p)."""
        return _values(self.degree, self.turn, self.across, cosine, azimuth)


@lru_cache(maxsize=8)
def basis(order: int, *, across: bool = False, level: bool = False) -> Basis:
    """Prepare harmonics up to an odd order: those with cos mφ, or with sin mφ (`across`), or those with m = 0
    alone (`level`)."""
    pairs = [
        (degree, turn) for degree in range(order + 1) for turn in range(across, (0 if level else degree) + 1)
    ]
    degree, turn = np.array(pairs, dtype=np.int64).T
    odd = (degree + turn) % 2 == 1
    x, w = np.polynomial.legendre.leggauss(order + 2)
    azimuth = 2.0 * np.pi * (np.arange(2 * order + 4) + 0.5) / (2 * order + 4)
    cosine, around = (part.ravel() for part in np.meshgrid(0.5 * (1.0 + x), azimuth, indexing="ij"))
    weight = np.repeat(0.5 * w, azimuth.size) * 2.0 * np.pi / azimuth.size
    y = _values(degree, turn, across, cosine, around)
    sideways = np.sqrt(1.0 - cosine**2) * np.cos(around)

    def along(kind: NDArray[np.bool_]) -> Array:
        step = turn[kind] - turn[kind][:, None]
        sign = np.where(step == -1, 1.0, 0.0) - np.where(step == 1, 1.0, 0.0)
        return np.asarray(2.0 * (y[kind] * (weight * sideways)) @ y[kind].T * sign)

    mu, gauss = cosines()
    onto = _values(degree, turn, across, mu, np.zeros(mu.size))[odd] * (2.0 * np.pi * gauss)
    onto[turn[odd] > 0] = 0.0
    climb, half = 2.0 * (y[odd] * (weight * cosine)) @ y[~odd].T, (y[odd] * weight) @ y[~odd].T
    return Basis(degree, turn, odd, climb, half, along(~odd), along(odd), onto, across)


def _values(
    degree: NDArray[np.int64], turn: NDArray[np.int64], across: bool, cosine: Array, azimuth: Array
) -> Array:
    lm = degree[:, None], turn[:, None]
    upright = sph_harm_y(*lm, np.arccos(np.clip(cosine, -1.0, 1.0)), np.zeros_like(cosine)).real
    around = (np.sin if across else np.cos)(lm[1] * azimuth)
    return np.asarray(upright * around * np.where(lm[1] > 0, np.sqrt(2.0), 1.0))


@dataclass(frozen=True)
class Field:
    """Light that has entered in several ways, on harmonics.

    Attributes
    ----------
    start : (n_odd, ways)
        Amplitudes at the face, of what falls by √Γ, on the vectors of its Schur form.
    kept : (n, ways)
        Of beams, what goes with the beam itself and falls as fast.
    fall : (ways,)
        How fast, 1/transport mean free path; what has no beam has nothing `kept`.
    """

    start: Complex
    kept: Complex
    fall: Complex


@dataclass(frozen=True)
class Waves:
    """What falls with depth at one wave number; make it with `waves`.

    Attributes
    ----------
    root, vectors
        √Γ = vectors root vectors^H, root upper triangular.
    even
        Amplitudes of even harmonics of those of odd ones, (n_even, n_odd).
    """

    basis: Basis
    loss: Array
    wave: float
    root: Complex
    vectors: Complex
    even: Array

    def lit(self, radiance: Array) -> Field:
        """Of light (N, ways) on the Gauss cosines, the same from all sides."""
        start = self._at_face(self.basis.onto @ radiance)
        nothing = np.zeros((self.basis.odd.size, radiance.shape[1]), dtype=np.complex128)
        return Field(start, nothing, np.ones(radiance.shape[1], dtype=np.complex128))

    def beams(self, source: Array, fall: Complex, cosine: Array, azimuth: Array) -> Field:
        """Of beams (ways,) that fall at complex rates and are scattered by `source` (n,) of each harmonic."""
        odd, climb = self.basis.odd, self.basis.climb
        given = ((-1j) ** self.basis.turn * source)[:, None] * self.basis.values(cosine, azimuth)
        even_loss, odd_loss = self._losses()
        rise = np.linalg.solve(even_loss, climb.T)
        lifted = np.linalg.solve(even_loss, given[~odd])
        kept = np.empty_like(given)
        for way, q in enumerate(fall):
            right = given[odd, way] + q * climb @ lifted[:, way]
            kept[odd, way] = np.linalg.solve(odd_loss - q**2 * climb @ rise, right)
            kept[~odd, way] = lifted[:, way] + q * rise @ kept[odd, way]
        start = self._at_face(-(0.5 * kept[odd] + self.basis.half @ kept[~odd]))
        return Field(start, kept, fall)

    def overlap(self, field: Field, weights: Complex, fall: Complex) -> Complex:
        """∫ exp(-p z) Σ weights c dz of rates p (p,) and weights (n, p): (ways, p)."""
        odd = self.basis.odd
        size, (lanes,) = len(self.root), fall.shape
        found = np.empty((size, field.start.shape[1], lanes), dtype=np.complex128)
        for i in range(size - 1, -1, -1):
            done = np.tensordot(self.root[i, i + 1 :], found[i + 1 :], 1)
            found[i] = (field.start[i, :, None] - done) / (fall + self.root[i, i])
        each = weights[~odd].T @ (self.even @ self.vectors) + weights[odd].T @ self.vectors
        modes = np.einsum("pi,iwp->wp", each, found, optimize=True)
        return np.asarray(modes + field.kept.T @ weights / (fall + field.fall[:, None]))

    def _at_face(self, entering: NDArray[np.inexact]) -> Complex:
        """Amplitudes where the odd harmonics of what enters, over half of all directions, are given."""
        face = 0.5 * np.eye(len(self.vectors)) + self.basis.half @ self.even
        return np.asarray(self.vectors.conj().T @ np.linalg.solve(face, entering))

    def _losses(self) -> tuple[Array, Array]:
        return _losses(self.basis, self.loss, self.wave)


def waves(harmonics: Basis, loss: Array, wave: float) -> Waves:
    """Solve a half-space whose harmonics lose e_l, (n,), at a wave number k, both per mean free path."""
    even_loss, odd_loss = _losses(harmonics, loss, wave)
    rise = np.linalg.solve(even_loss, harmonics.climb.T)
    falls = scipy.linalg.sqrtm(np.linalg.solve(harmonics.climb @ rise, odd_loss)).real
    root, vectors = scipy.linalg.schur(falls, output="complex")
    return Waves(harmonics, loss, wave, root, vectors, rise @ falls)


def _losses(harmonics: Basis, loss: Array, wave: float) -> tuple[Array, Array]:
    """e_l + k X among even, and among odd harmonics."""
    odd = harmonics.odd
    even_loss = np.diag(loss[~odd]) + wave * harmonics.along_even
    return even_loss, np.diag(loss[odd]) + wave * harmonics.along_odd
