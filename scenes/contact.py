"""From contact pressure to light: real contact of a rough skin, and the transmittance averaged over its gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from .ftir import gap_transmittance

Array = NDArray[np.float64]

_DECAY_PER_RMS_HEIGHT = 0.5  # u0 / h_rms (Persson 2007, fig. 2: 0.4 to 0.5 for measured and self-affine surfaces)
_LEAST_FRACTION = 1e-5  # below this the mean gap (11 u0 and more) no longer changes the mean transmittance


def contact_fraction(pressure_kPa: Array, modulus_kPa: float, rms_slope: float, kappa: float) -> Array:
    """Real over apparent contact area, A_r = erf((sqrt(pi)/2) kappa p / (E* h')), same shape as the pressure.

    Persson (2001; key persson2001) for the shape; kappa = 1.6 (Persson) to 2.5 (Bush, Gibson & Thomas 1975; key bush1975).
    `modulus_kPa` is E*, 1/E* = sum of (1 - nu²)/E of both bodies; `rms_slope` is h'. Tension or no load: 0.
    """
    load = np.maximum(np.asarray(pressure_kPa, dtype=np.float64), 0.0)
    return np.asarray(erf(0.5 * np.sqrt(np.pi) * kappa * load / (modulus_kPa * rms_slope)))


def mean_gap_um(fraction: Array, rms_height_um: float) -> Array:
    """Mean gap, µm, over the area that is *not* in real contact, for real contact fraction A_r.

    The interfacial separation averaged over the whole area falls as p ∝ exp(-u/u0), u0 ≈ 0.5 h_rms (Persson 2007; key persson2007).
    With A_r ∝ p at light load this is u = -u0 ln(A_r), which also closes at full contact as it must; divided by the open
    share 1 - A_r. The prefactor of Persson's law depends on the roll-off of the roughness spectrum, which nobody measured
    here; the closure fixes it at h'/kappa.
    """
    a = np.clip(np.asarray(fraction, dtype=np.float64), _LEAST_FRACTION, 1.0)
    open_share = 1.0 - a
    series = 1.0 + open_share / 2.0 + open_share**2 / 3.0  # -ln(1 - x)/x near x = 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(open_share > 1e-4, -np.log(a) / open_share, series)
    return _DECAY_PER_RMS_HEIGHT * rms_height_um * ratio


@dataclass(frozen=True)
class ContactOptics:
    """What a rough contact does to unpolarised light, tabulated on real contact fraction and angle.

    Attributes
    ----------
    transmittance : (n_fraction, n_cos)
        Mean of T over polarisation and gap distribution; rows are A_r uniform on 0..1, columns cos(theta) in the guide
        uniform on 0..1. Between nodes it is *defined* as the bilinear interpolant, so that energy balances exactly.
    hemispherical : (n_fraction,)
        Cosine-weighted hemispherical mean of `transmittance`, guide side.
    diffuse_gain : (n_fraction,)
        K of the diffuse lobe f = T(cos_i) T(cos_o) K / pi, 1/sr.
    """

    transmittance: Array
    hemispherical: Array
    diffuse_gain: Array


def contact_optics(
    n_guide: float,
    n_gap: float,
    n_tissue: float,
    albedo: float,
    rms_height_um: float,
    wavelength_nm: float,
    *,
    n_fraction: int = 129,
    n_cos: int = 1025,
) -> ContactOptics:
    """Tabulate the optics of a rough contact between guide and a diffusing tissue.

    Real contact (gap 0) takes the share A_r, gaps distributed exponentially about `mean_gap_um` the rest; T is averaged over
    them (T of the mean gap would be wrong: T falls within 100 to 300 nm). What is transmitted is made isotropic in the tissue,
    of which the share `albedo` comes back to the surface per pass; the surface sends part of it back down. With T_in the
    hemispherical transmittance from the tissue side, (n1/n3)² times the guide side's by reciprocity, the passes sum to

        K = (n1/n3)² albedo / (1 - albedo (1 - T_in)).

    Lateral spread in the tissue, and scattering of the mirror reflection by the roughness, are left out.
    """
    fraction = np.linspace(0.0, 1.0, n_fraction)
    cosine = np.linspace(0.0, 1.0, n_cos)
    touching = _unpolarised(n_guide, n_gap, n_tissue, np.zeros(1), cosine, wavelength_nm)[0]
    apart = _mean_over_gaps(n_guide, n_gap, n_tissue, mean_gap_um(fraction, rms_height_um), cosine, wavelength_nm)
    table = fraction[:, None] * touching + (1.0 - fraction[:, None]) * apart

    hemispherical = 2.0 * table @ _moment_weights(cosine)
    inside = (n_guide / n_tissue) ** 2 * hemispherical
    gain = (n_guide / n_tissue) ** 2 * albedo / (1.0 - albedo * (1.0 - inside))
    return ContactOptics(table, hemispherical, gain)


def _unpolarised(n1: float, n0: float, n3: float, gap: Array, cosine: Array, wavelength_nm: float) -> Array:
    t_s, t_p = gap_transmittance(n1, n0, n3, gap[:, None], cosine[None, :], wavelength_nm)
    return 0.5 * (t_s + t_p)


def _mean_over_gaps(n1: float, n0: float, n3: float, mean_um: Array, cosine: Array, wavelength_nm: float) -> Array:
    """∫ T(g) exp(-g/m)/m dg for each mean gap m (rows) and cosine (columns).

    Where fringes are fast (w well above 0) the integral is summed in closed form; elsewhere by Gauss-Legendre panels on a gap
    grid that all means share.
    """
    w = n0**2 - n1**2 * (1.0 - cosine**2)
    propagating = (w > 0.02) & (n3**2 - n1**2 * (1.0 - cosine**2) > 0.0)
    result = np.empty((mean_um.size, cosine.size))
    result[:, propagating] = _fringe_mean(n1, n0, n3, mean_um, cosine[propagating], wavelength_nm)

    edges = np.concatenate([np.linspace(0.0, 2.0, 41), np.linspace(2.0, 14.0 * mean_um.max(), 480)[1:]])
    node, weight = np.polynomial.legendre.leggauss(4)
    half = 0.5 * np.diff(edges)
    gap = (edges[:-1, None] + half[:, None] * (1.0 + node)).ravel()
    weight = (half[:, None] * weight).ravel()
    density = np.exp(-gap / mean_um[:, None]) / mean_um[:, None] * weight
    density /= density.sum(axis=1, keepdims=True)
    tunnelling = cosine[~propagating]
    result[:, ~propagating] = density @ _unpolarised(n1, n0, n3, gap, tunnelling, wavelength_nm)
    return result


def _fringe_mean(n1: float, n0: float, n3: float, mean_um: Array, cosine: Array, wavelength_nm: float) -> Array:
    """Mean over exponential gaps of N / (C + D sin²(k g)), by its Fourier series.

    1/(A - B cos 2x) = (1 + 2 sum r^j cos 2jx) / sqrt(A² - B²) with r = (A - sqrt(A² - B²))/B, and the mean of
    cos(2 j k g) over exp(-g/m)/m is 1/(1 + (2 j k m)²).
    """
    k2 = n1**2 * (1.0 - cosine**2)
    w = n0**2 - k2
    q1, q3 = n1 * cosine, np.sqrt(n3**2 - k2)
    y1, y3 = n1**2 / q1, n3**2 / q3
    wave = 2e3 * np.pi * np.sqrt(w) / wavelength_nm  # rad per µm
    order = np.arange(1, 40)
    total = np.zeros((mean_um.size, cosine.size))
    s_wave = (4.0 * q1 * q3, (q1 + q3) ** 2, (n1**2 - n0**2) * (n3**2 - n0**2) / w)
    p_wave = (4.0 * y1 * y3, (y1 + y3) ** 2, (y1**2 * w - n0**4) * (y3**2 * w - n0**4) / (w * n0**4))
    damping = 1.0 / (1.0 + (2.0 * mean_um[:, None, None] * wave[:, None] * order) ** 2)  # (mean, cos, order)
    for numerator, c, d in (s_wave, p_wave):
        a, b = c + 0.5 * d, 0.5 * d
        root = np.sqrt(a**2 - b**2)
        r = b / (a + root)
        harmonics = np.einsum("mcj,cj->mc", damping, r[:, None] ** order)
        total += 0.5 * numerator / root * (1.0 + 2.0 * harmonics)
    return total


def _moment_weights(cosine: Array) -> Array:
    """Weights w such that sum(w f) = ∫ f(x) x dx over 0..1, exact for f piecewise linear on the uniform nodes."""
    step = cosine[1] - cosine[0]
    weights = step * cosine
    weights[0] = step**2 / 6.0
    weights[-1] = step * (0.5 - step / 6.0)
    return weights
