"""Refractive index over wavelength, of the guide's elastomer and of common glass."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

Glassware = Literal["N-BK7", "soda-lime"]


def pdms(wavelength_nm: float) -> float:
    """Index of Sylgard 184 at room temperature (Schneider 2009; key schneider2009), measured 350 to 700 nm.

    n² = 1 + 1.0093 L²/(L² - 0.013185), L the wavelength in µm; beyond, the same law is taken on.
    """
    square = (wavelength_nm * 1e-3) ** 2
    return float((1.0 + 1.0093 * square / (square - 0.013185)) ** 0.5)


def n_bk7(wavelength_nm: float) -> float:
    """Index of N-BK7 by its three-term Sellmeier formula (key schott2023), 310 to 2325 nm."""
    square = (wavelength_nm * 1e-3) ** 2
    terms = ((1.03961212, 0.00600069867), (0.231792344, 0.0200179144), (1.01046945, 103.560653))
    return float((1.0 + sum(b * square / (square - c) for b, c in terms)) ** 0.5)


def soda_lime(wavelength_nm: float) -> float:
    """Index of clear soda-lime glass (Rubin 1985; key rubin1985): 1.5130 - 0.003169 L² + 0.003962/L²."""
    square = (wavelength_nm * 1e-3) ** 2
    return float(1.5130 - 0.003169 * square + 0.003962 / square)


GLASS: dict[Glassware, Callable[[float], float]] = {"N-BK7": n_bk7, "soda-lime": soda_lime}
"""Glasses whose index over wavelength is known, by name."""
