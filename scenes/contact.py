"""From contact pressure to light: real contact of a rough skin, and transmittance averaged over its gaps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import erf

from .ftir import gap_transmittance
from .skin import Skin

Array = NDArray[np.float64]

# u0 / h_rms (Persson 2007, fig. 2: 0.4 to 0.5 for measured and self-affine surfaces)
_DECAY_PER_RMS_HEIGHT = 0.5
_LEAST_FRACTION = 1e-5  # below this the mean gap (11 u0 and more) no longer changes the mean transmittance


def contact_fraction(pressure_kPa: Array, modulus_kPa: float, rms_slope: float, kappa: float) -> Array:
    """Real over apparent contact area, A_r = erf((sqrt(pi)/2) kappa p / (E* h')), same shape as the pressure.

    Persson (2001; key persson2001) for the shape; kappa = 1.6 (Persson) to 2.5 (Bush, Gibson & Thomas 1975;
    key bush1975). `modulus_kPa` is E*, 1/E* = sum of (1 - nu²)/E of both bodies; `rms_slope` is h'.
    Tension or no load: 0.
    """
    load = np.maximum(np.asarray(pressure_kPa, dtype=np.float64), 0.0)
    return np.asarray(erf(0.5 * np.sqrt(np.pi) * kappa * load / (modulus_kPa * rms_slope)))


def real_contact(pressure_kPa: Array, skin: Skin, modulus_kPa: float) -> Array:
    """Real over apparent contact area of what can touch (the dust's share left out), shape of the pressure.

    "rough" is `contact_fraction`; "full" is 1 wherever there is pressure: adhesion or gel closes all gaps.
    """
    if skin.contact == "full":
        return np.where(np.asarray(pressure_kPa) > 0.0, 1.0, 0.0)
    return contact_fraction(pressure_kPa, modulus_kPa, skin.rms_slope, skin.kappa)


def mean_gap_um(fraction: Array, rms_height_um: float) -> Array:
    """Mean gap, µm, over the area that is *not* in real contact, for real contact fraction A_r.

    The interfacial separation averaged over the whole area falls as p ∝ exp(-u/u0), u0 ≈ 0.5 h_rms (Persson
    2007; key persson2007). With A_r ∝ p at light load this is u = -u0 ln(A_r), which also closes at full
    contact as it must; divided by the open share 1 - A_r. The prefactor of Persson's law depends on the
    roll-off of the roughness spectrum, which nobody measured here; the closure fixes it at h'/kappa.
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
        Mean of T over polarisation and gap distribution; rows are A_r uniform on 0..1, columns cos(theta) in
        the guide uniform on 0..1. Between nodes it is *defined* as the bilinear interpolant, so that energy
        balances exactly.
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
    dust: float = 0.0,
    n_fraction: int = 129,
    n_cos: int = 1025,
) -> ContactOptics:
    """Tabulate the optics of a rough contact between guide and a diffusing tissue.

    Real contact (gap 0) takes the share A_r, gaps distributed exponentially about `mean_gap_um` the rest; T
    is averaged over them (T of the mean gap would be wrong: T falls within 100 to 300 nm). The share `dust`
    of the area stays apart by far more than a wavelength, at any pressure: its T is the mean over all
    fringes, and nothing tunnels. What is transmitted is made isotropic in the tissue, of which the share
    `albedo` comes back to the surface per pass; the surface sends part of it back down. With T_in the
    hemispherical transmittance from the tissue side, (n1/n3)² times the guide side's by reciprocity, the
    passes sum to

        K = (n1/n3)² albedo / (1 - albedo (1 - T_in)).

    That is the local limit, with Lambertian light in the tissue; `tissue` has depth and angles. Scattering
    of the mirror reflection by the roughness is left out.
    """
    fraction = np.linspace(0.0, 1.0, n_fraction)
    cosine = np.linspace(0.0, 1.0, n_cos)
    touching = _unpolarised(n_guide, n_gap, n_tissue, np.zeros(1), cosine, wavelength_nm)[0]
    gaps = mean_gap_um(fraction, rms_height_um)
    apart = _mean_over_gaps(n_guide, n_gap, n_tissue, gaps, cosine, wavelength_nm)
    table = fraction[:, None] * touching + (1.0 - fraction[:, None]) * apart
    if dust > 0.0:
        table = (1.0 - dust) * table + dust * _far_apart(n_guide, n_gap, n_tissue, cosine, wavelength_nm)

    hemispherical = 2.0 * table @ moment_weights(cosine)
    inside = (n_guide / n_tissue) ** 2 * hemispherical
    gain = (n_guide / n_tissue) ** 2 * albedo / (1.0 - albedo * (1.0 - inside))
    return ContactOptics(table, hemispherical, gain)


def _unpolarised(n1: float, n0: float, n3: float, gap: Array, cosine: Array, wavelength_nm: float) -> Array:
    t_s, t_p = gap_transmittance(n1, n0, n3, gap[:, None], cosine[None, :], wavelength_nm)
    return 0.5 * (t_s + t_p)


def _mean_over_gaps(
    n1: float, n0: float, n3: float, mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """∫ T(g) exp(-g/m)/m dg for each mean gap m (rows) and cosine (columns)."""
    k2 = n1**2 * (1.0 - cosine**2)
    open_ = k2 < n3**2
    fringes, tunnels = open_ & (k2 < n0**2), open_ & (k2 >= n0**2)
    result = np.zeros((mean_um.size, cosine.size))
    result[:, fringes] = _fringe_mean(n1, n0, n3, mean_um, cosine[fringes], wavelength_nm)
    result[:, tunnels] = _tunnel_mean(n1, n0, n3, mean_um, cosine[tunnels], wavelength_nm)
    return result


def _far_apart(n1: float, n0: float, n3: float, cosine: Array, wavelength_nm: float) -> Array:
    """T over gaps so wide that nothing tunnels and the fringes are washed out, (n_cos,)."""
    k2 = n1**2 * (1.0 - cosine**2)
    fringes = (k2 < n3**2) & (k2 < n0**2)
    result = np.zeros(cosine.size)
    result[fringes] = _fringe_mean(n1, n0, n3, np.array([1e6]), cosine[fringes], wavelength_nm)[0]
    return result


def _tunnel_mean(
    n1: float, n0: float, n3: float, mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """The mean beyond the critical angle, where T falls steadily."""
    gap, width = tunnel_nodes(mean_um)
    density = np.exp(-gap / mean_um[:, None]) / mean_um[:, None] * width
    return np.asarray(density @ _unpolarised(n1, n0, n3, gap, cosine, wavelength_nm))


def tunnel_nodes(mean_um: Array) -> tuple[Array, Array]:
    """Gaps, µm, and their weights for means over all of `mean_um`: Gauss-Legendre panels, wider with g."""
    first = min(0.01, 0.02 * mean_um.min())  # µm; T itself falls within 0.1 µm
    edges = np.concatenate([[0.0], np.geomspace(first, 40.0 * mean_um.max(), 140)])
    node, weight = np.polynomial.legendre.leggauss(5)
    half = 0.5 * np.diff(edges)
    return (edges[:-1, None] + half[:, None] * (1.0 + node)).ravel(), (half[:, None] * weight).ravel()


def _fringe_mean(
    n1: float, n0: float, n3: float, mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """The mean below the critical angle, where T = N / (C + D sin²x), x = k g, repeats for ever.

    The weights of all periods sum to a geometric series, so one period 0..pi does. On it the substitution
    tan(phi) = sqrt(1 + D/C) tan(x) makes dx / (C + D sin²x) = dphi / sqrt(C (C + D)): that flattens the
    fringes, however sharp. What is left is exp(-x/(k m)), smooth but for the ends of each quarter turn, where
    double-exponential nodes crowd.
    """
    k2 = n1**2 * (1.0 - cosine**2)
    w, q1, q3 = n0**2 - k2, n1 * cosine, np.sqrt(n3**2 - k2)
    s_wave = (4.0 * q1 * q3, (q1 + q3) ** 2, (n1**2 - n0**2) * (n3**2 - n0**2))
    p_wave = (
        4.0 * n1**2 * n3**2 * q1 * q3,
        (n1**2 * q3 + n3**2 * q1) ** 2,
        (n1**4 * w - n0**4 * q1**2) * (n3**4 * w - n0**4 * q3**2) / n0**4,
    )
    phase = 2e3 * np.pi * np.sqrt(w) / wavelength_nm * mean_um[:, None]  # k m
    phi, weight = quarter_turn()
    total = np.zeros(phase.shape)
    for numerator, c, d_times_w in (s_wave, p_wave):
        c_plus_d = c + d_times_w / w
        means = np.zeros(phase.shape)
        for angle, share in zip(phi, weight, strict=True):
            x = np.arctan2(np.sqrt(c) * np.sin(angle), np.sqrt(c_plus_d) * np.cos(angle))
            means += share * (np.exp(-x / phase) + np.exp((x - np.pi) / phase))
        total += 0.5 * numerator / np.sqrt(c * c_plus_d) * means
    return np.asarray(total / phase / -np.expm1(-np.pi / phase))


def quarter_turn(half_count: int = 30, reach: float = 3.2) -> tuple[Array, Array]:
    """Double-exponential nodes and weights on 0..pi/2 (Takahasi & Mori 1974; key takahasi1974)."""
    t = np.linspace(-reach, reach, 2 * half_count + 1)
    u = 0.5 * np.pi * np.sinh(t)
    weight = 0.5 * np.pi * np.cosh(t) / np.cosh(u) ** 2 * 0.5 * (t[1] - t[0])
    return 0.25 * np.pi * (1.0 + np.tanh(u)), 0.5 * np.pi * weight


def moment_weights(cosine: Array) -> Array:
    """Weights w: sum(w f) = ∫ f(x) x dx over 0..1, exact for f piecewise linear on the uniform nodes."""
    step = cosine[1] - cosine[0]
    weights = step * cosine
    weights[0] = step**2 / 6.0
    weights[-1] = step * (0.5 - step / 6.0)
    return weights
