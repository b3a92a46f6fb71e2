"""The law of frustrated total internal reflection: light through one plane gap between two media."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Complexes = NDArray[np.complex128]


def gap_transmittance(
    n1: ArrayLike,
    n0: ArrayLike,
    n3: ArrayLike,
    gap_um: ArrayLike,
    cos_theta: ArrayLike,
    wavelength_nm: ArrayLike,
) -> tuple[Array, Array]:
    """Power transmittance of a lossless gap, s and p polarised, all interference included.

    Light in medium `n1` (the guide) meets a gap of index `n0` and thickness `gap_um`, behind it medium `n3`
    (the tissue). Closed form of the three-layer characteristic matrix (Yeh 1988, ch. 4 and 5; key yeh1988),
    with q = n cos(theta), w = n0² - n1² sin²(theta), a = 2 pi g / lambda and S² = sin²(a sqrt(w)) / w:

        T_s = 4 q1 q3 / [(q1 + q3)² + S² (n1² - n0²)(n3² - n0²)]
        T_p = 4 y1 y3 / [(y1 + y3)² + (S² / n0⁴)(y1² w - n0⁴)(y3² w - n0⁴)],   y = n² / q

    Below the critical angle of the gap w > 0 (Fabry-Pérot fringes); beyond it w < 0 and
    S² = sinh²(a sqrt(-w)) / (-w): the evanescent wave tunnels. Where `n3`
    itself admits no propagating wave (n1 sin(theta) > n3) both are zero.

    Parameters
    ----------
    n1, n0, n3
        Refractive indices, each ≥ 1. All arguments broadcast against each other.
    gap_um
        Gap thickness, µm, ≥ 0.
    cos_theta
        Cosine of the angle of incidence inside `n1`, 0 to 1.
    wavelength_nm
        Vacuum wavelength, nm, > 0.

    Returns
    -------
    (T_s, T_p)
        Arrays of the broadcast shape, 0 to 1.

    Raises
    ------
    ValueError
        An argument outside the ranges above; the message names it.
    """
    given = (n1, n0, n3, gap_um, cos_theta, wavelength_nm)
    i1, i0, i3, gap, cos1, wavelength = _checked("gap_transmittance", given)

    k2 = i1**2 * (1.0 - cos1**2)  # squared tangential index, conserved through the stack
    w = i0**2 - k2
    q1 = i1 * cos1
    q3_squared = i3**2 - k2
    open_ = (q3_squared > 0.0) & (cos1 > 0.0)  # a wave can leave into n3
    q3 = np.sqrt(np.where(open_, q3_squared, 1.0))
    q1 = np.where(open_, q1, 1.0)

    s2 = _sine_squared_over(w, 2e3 * np.pi * gap / wavelength)
    t_s = 4.0 * q1 * q3 / ((q1 + q3) ** 2 + s2 * (i1**2 - i0**2) * (i3**2 - i0**2))

    # multiplied through by (q1 q3)², so that grazing light (q = 0) does not overflow
    i12, i32, i04 = i1**2, i3**2, i0**4
    t_p = 4.0 * i12 * i32 * q1 * q3
    t_p /= (i12 * q3 + i32 * q1) ** 2 + s2 / i04 * (i12**2 * w - i04 * q1**2) * (i32**2 * w - i04 * q3**2)
    return np.where(open_, t_s, 0.0), np.where(open_, t_p, 0.0)


def gap_reflection(
    n1: ArrayLike,
    n0: ArrayLike,
    n3: ArrayLike,
    gap_um: ArrayLike,
    cos_theta: ArrayLike,
    wavelength_nm: ArrayLike,
) -> tuple[Complexes, Complexes]:
    """Complex amplitudes r_s, r_p that the gap of `gap_transmittance` reflects, for waves exp(-i omega t).

    From the characteristic matrix of the gap (Yeh 1988, ch. 5; key yeh1988): with x = a sqrt(w),
    z_j = q_j for s and q_j / n_j² for p, q_j with a positive imaginary part beyond the critical angle,

        r = (z1 B - C) / (z1 B + C),   B = cos x - i (z3/z0) sin x,   C = z3 cos x - i z0 sin x.

    r_p is that of the magnetic field: -r_s at normal incidence. |r|² is 1 - T of `gap_transmittance`.
    Arguments and errors are those of it; complex arrays of the broadcast shape.
    """
    given = (n1, n0, n3, gap_um, cos_theta, wavelength_nm)
    i1, i0, i3, gap, cos1, wavelength = _checked("gap_reflection", given)

    k2 = i1**2 * (1.0 - cos1**2)
    w, q1, q3 = i0**2 - k2, i1 * cos1, np.sqrt((i3**2 - k2).astype(complex))
    a = 2e3 * np.pi * gap / wavelength
    x = a * np.sqrt(np.abs(w))
    x_capped = np.minimum(x, 300.0)  # nothing tunnels beyond: the ratio no longer changes
    waves, safe = w > 0.0, np.where(x > 1e-8, x, 1.0)
    cosine = np.where(waves, np.cos(x), np.cosh(x_capped))
    # sin(x) / q0 and q0 sin(x), real on both sides of the critical angle
    ratio = np.where(x > 1e-8, np.where(waves, np.sin(x) / safe, np.sinh(x_capped) / safe), 1.0)
    over, times = a * ratio, a * ratio * w

    def reflected(z1: Complexes, z3: Complexes, squared: Array | float) -> Complexes:
        b = cosine - 1j * z3 * over * squared
        c = z3 * cosine - 1j * times / squared
        return np.asarray((z1 * b - c) / (z1 * b + c))

    z1 = q1.astype(np.complex128)
    return reflected(z1, q3, 1.0), reflected(z1 / i1**2, q3 / i3**2, i0**2)


def _sine_squared_over(w: Array, a: Array) -> Array:
    """S² = sin²(a sqrt(w)) / w, continued through w = 0 (a²) into sinh²(a sqrt(-w)) / (-w)."""
    x = a * np.sqrt(np.abs(w))
    x_capped = np.minimum(x, 300.0)  # sinh² beyond this is > 1e259: the transmittance is 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.where(w > 0.0, np.sin(x), np.sinh(x_capped)) / x
    return a**2 * np.where(x > 1e-8, ratio, 1.0) ** 2


_ALLOWED = {
    "n1": (1.0, np.inf),
    "n0": (1.0, np.inf),
    "n3": (1.0, np.inf),
    "gap_um": (0.0, np.inf),
    "cos_theta": (0.0, 1.0),
    "wavelength_nm": (np.nextafter(0.0, 1.0), np.inf),
}
"""Of a gap and the light that meets it, in the order of the arguments."""


def _checked(law: str, given: Sequence[ArrayLike]) -> tuple[Array, ...]:
    """A gap and its light, each within its range and all of one shape."""
    arrays = [np.asarray(value, dtype=np.float64) for value in given]
    for array, (name, (low, high)) in zip(arrays, _ALLOWED.items(), strict=True):
        bad = ~((array >= low) & (array <= high) & np.isfinite(array))
        if np.any(bad):
            received = array[bad].flat[0]
            raise ValueError(f"{law}: {name}: received {received}; allowed {low:g} to {high:g}, finite")
    return tuple(np.asarray(array) for array in np.broadcast_arrays(*arrays))
