"""Light with a state of polarisation at plane faces: Stokes vectors (I, Q, U, V) on the device.

Q is s less p of the basis whose first axis is the unit vector `side`, at right angles to the ray; with the
conventions of `mi.mueller`, whose matrices of plane faces have the four numbers that `mueller` explains.

Import only after a variant is set (`scenes.backend.use` or `use_polarised`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np

from .arrays import floats
from .mueller import ContactMueller

_ALONG = 1e-10  # squared sine to the normal below which all planes of incidence are alike


@dataclass(frozen=True)
class Face:
    """Mueller matrix of a plane face in the basis of s and p."""

    a: mi.Float
    b: mi.Float
    c: mi.Float
    s: mi.Float

    def acts(self, stokes: mi.Vector4f) -> mi.Vector4f:
        """The state after the face, s and p before and after being those of the face."""
        return mi.Vector4f(
            self.a * stokes.x + self.b * stokes.y,
            self.b * stokes.x + self.a * stokes.y,
            self.c * stokes.z - self.s * stokes.w,
            self.s * stokes.z + self.c * stokes.w,
        )


def across(d: mi.Vector3f, normal: mi.Vector3f, otherwise: mi.Vector3f) -> mi.Vector3f:
    """Unit vector of s: across the plane of incidence. Light along the normal has none and takes another."""
    side = dr.cross(normal, d)
    square = dr.squared_norm(side)
    return dr.select(square > _ALONG, side * dr.rsqrt(dr.maximum(square, _ALONG)), otherwise)


def turned(stokes: mi.Vector4f, d: mi.Vector3f, side: mi.Vector3f, new: mi.Vector3f) -> mi.Vector4f:
    """The same light along d in the basis of another side."""
    cos, sin = dr.dot(side, new), dr.dot(d, dr.cross(side, new))
    scale = dr.rcp(dr.maximum(dr.square(cos) + dr.square(sin), 1e-12))
    cos2, sin2 = (dr.square(cos) - dr.square(sin)) * scale, 2.0 * cos * sin * scale
    return mi.Vector4f(
        stokes.x, cos2 * stokes.y + sin2 * stokes.z, cos2 * stokes.z - sin2 * stokes.y, stokes.w
    )


def unpolarised(amount: mi.Float) -> mi.Vector4f:
    """Light that has no state, or has lost it."""
    return mi.Vector4f(amount, 0.0, 0.0, 0.0)


def fresnel(cosine: mi.Float, eta: mi.Float) -> tuple[Face, Face]:
    """What a dielectric face reflects and lets through, arguments as those of `mi.fresnel`; the retardance of
    total reflection is in the first."""
    r_s, r_p, _, _, _ = mi.fresnel_polarized(cosine, mi.Complex2f(eta, 0.0))
    s, p = dr.squared_norm(r_s), dr.squared_norm(r_p)
    mean, half = 0.5 * (s + p), 0.5 * (s - p)
    real, imaginary = r_s.real * r_p.real + r_s.imag * r_p.imag, r_s.real * r_p.imag - r_s.imag * r_p.real
    through = dr.safe_sqrt((1.0 - s) * (1.0 - p))
    return Face(mean, half, real, imaginary), Face(1.0 - mean, -half, through, mi.Float(0.0))


class Contact:
    """A `ContactMueller` on the device, looked up as `bsdf.Table` is."""

    def __init__(self, mueller: ContactMueller) -> None:
        self.rows, self.columns = mueller.real.shape
        parts = (mueller.diattenuation, mueller.real, mueller.imaginary, np.zeros_like(mueller.real))
        self._data = floats(np.stack(parts, axis=-1))

    def at(
        self, fraction: mi.Float, cosine: mi.Float, transmittance: mi.Float, active: mi.Bool
    ) -> tuple[mi.Float, Face]:
        """(T_s - T_p)/2, and what is mirrored where the mean T is this."""
        i, u = _cell(fraction, self.rows)
        j, v = _cell(cosine, self.columns)
        corner = i * self.columns + j
        low, high = (
            dr.lerp(*(dr.gather(mi.Vector4f, self._data, corner + row + k, active) for k in (0, 1)), v)
            for row in (0, self.columns)
        )
        x, y, z, _ = dr.lerp(low, high, u)
        return x, Face(1.0 - transmittance, -x, y, z)


def _cell(x: mi.Float, nodes: int) -> tuple[mi.UInt32, mi.Float]:
    scaled = dr.clip(x, 0.0, 1.0) * (nodes - 1)
    index = dr.minimum(mi.UInt32(scaled), nodes - 2)
    return index, scaled - mi.Float(index)
