"""What a rough contact does to polarised light: its Mueller matrix, averaged over its gaps (no Mitsuba here).

The matrix of a plane, isotropic face has four numbers in the basis of s and p (I, Q = s - p, U, V; as
Mitsuba has them, key jakob2022):

    [a  b  0  0]
    [b  a  0  0]     reflected:   a = 1 - mean T,  b = -(T_s - T_p)/2,  c + i s = r_s r_p*
    [0  0  c -s]     transmitted: a = mean T,      b = (T_s - T_p)/2,   c, s not needed before tissue
    [0  0  s  c]

Gaps differ over much more than a wavelength, so that what is averaged over them is the matrix: the phase
between s and p differs from gap to gap, and their mean depolarises.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .contact import mean_gap_um, quarter_turn, tunnel_nodes
from .ftir import gap_reflection

Array = NDArray[np.float64]

_WIDE_UM = 1e6  # mean gap at which the fringes are washed out
_APART_UM = 1e3  # gap through which nothing tunnels


@dataclass(frozen=True)
class ContactMueller:
    """Means over the gap distribution, on the nodes of `contact.ContactOptics`, (n_fraction, n_cos).

    Attributes
    ----------
    diattenuation
        (T_s - T_p) / 2.
    real, imaginary
        r_s r_p*, for waves exp(-i omega t).
    """

    diattenuation: Array
    real: Array
    imaginary: Array


def contact_mueller(
    n_guide: float,
    n_gap: float,
    n_tissue: float,
    rms_height_um: float,
    wavelength_nm: float,
    *,
    dust: float = 0.0,
    n_fraction: int = 129,
    n_cos: int = 1025,
) -> ContactMueller:
    """Tabulate what `contact.contact_optics` leaves out, for the same contact, gaps and nodes."""
    fraction, cosine = np.linspace(0.0, 1.0, n_fraction), np.linspace(0.0, 1.0, n_cos)
    indices = (n_guide, n_gap, n_tissue)
    touching = _parts(*gap_reflection(*indices, 0.0, cosine, wavelength_nm))
    apart = mean_over_gaps(indices, mean_gap_um(fraction, rms_height_um), cosine, wavelength_nm)
    table = fraction[:, None] * touching[:, None] + (1.0 - fraction[:, None]) * apart
    if dust > 0.0:
        far = mean_over_gaps(indices, np.array([_WIDE_UM]), cosine, wavelength_nm)
        table = (1.0 - dust) * table + dust * far
    return ContactMueller(table[1], table[2], table[3])


def mean_over_gaps(
    indices: tuple[float, float, float], mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """Means of T, (T_s - T_p)/2 and r_s r_p* over gaps spread as exp(-g/m)/m, (4, m, n_cos)."""
    fringes = indices[0] ** 2 * (1.0 - cosine**2) < indices[1] ** 2
    found = np.empty((4, mean_um.size, cosine.size))
    for part, mean in ((fringes, _over_fringes), (~fringes, _over_tunnels)):
        found[..., part] = mean(indices, mean_um, cosine[part], wavelength_nm)
    return found


def _parts(r_s: NDArray[np.complex128], r_p: NDArray[np.complex128]) -> Array:
    both = r_s * r_p.conj()
    s, p = np.abs(r_s) ** 2, np.abs(r_p) ** 2
    return np.stack([1.0 - 0.5 * (s + p), 0.5 * (p - s), both.real, both.imag])


def _over_tunnels(
    indices: tuple[float, float, float], mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """Beyond the critical angle, as `contact` has it; the parts change steadily with the gap."""
    gap, width = tunnel_nodes(mean_um)
    values = _parts(*gap_reflection(*indices, np.minimum(gap, _APART_UM)[:, None], cosine, wavelength_nm))
    density = np.exp(-gap / mean_um[:, None]) / mean_um[:, None] * width
    beyond = np.exp(-gap[-1] / mean_um)[:, None]  # the last gaps, as if all were the widest
    return np.einsum("mg,kgc->kmc", density, values, optimize=True) + beyond * values[:, -1:]


def _over_fringes(
    indices: tuple[float, float, float], mean_um: Array, cosine: Array, wavelength_nm: float
) -> Array:
    """Below it the parts repeat with every half wave in the gap: one period, as in `contact`.

    Of the two substitutions there, for s and p, the one between them flattens both.
    """
    n1, n0, n3 = indices
    k2 = n1**2 * (1.0 - cosine**2)
    w, q1, q3 = n0**2 - k2, n1 * cosine, np.sqrt(np.abs(n3**2 - k2))
    s_wave = (q1**2 + 2.0 * q1 * q3 + q3**2, (n1**2 - n0**2) * (n3**2 - n0**2) / w)
    p_wave = (
        (n1**2 * q3 + n3**2 * q1) ** 2,
        (n1**4 * w - n0**4 * q1**2) * (n3**4 * w - n0**4 * q3**2) / n0**4 / w,
    )
    steep = [np.sqrt(np.maximum(1.0 + d / c, 1e-6)) for c, d in (s_wave, p_wave)]
    flat = np.sqrt(steep[0] * steep[1])
    wave = 2e3 * np.pi * np.sqrt(w) / wavelength_nm  # x per µm of gap
    phase = wave * mean_um[:, None]
    total = np.zeros((4, mean_um.size, cosine.size))
    for angle, share in zip(*quarter_turn(), strict=True):
        x = np.arctan2(np.sin(angle), flat * np.cos(angle))
        width = share * flat / ((flat * np.cos(angle)) ** 2 + np.sin(angle) ** 2)
        for at in (x, np.pi - x):
            values = _parts(*gap_reflection(n1, n0, n3, at / wave, cosine, wavelength_nm))
            total += values[:, None] * (width * np.exp(-at / phase))
    return np.asarray(total / phase / -np.expm1(-np.pi / phase))
