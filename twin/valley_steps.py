"""Steps of a fit that stay in the valley of inclusions which look nearly the same.

A stiffer inclusion that is a little smaller, with its middle as deep, shows as much. In size d, depth h of
its top and modulus E that valley is bent, and where pictures tell much it is so thin that a straight step
leaves it at once. It is nearly straight in log(d³|c|)/3, h + d/2 and c, the contrast (E - E₀)/(E + 3/2 E₀) of
an incompressible sphere in tissue of modulus E₀ (Eshelby 1957; [eshelby1957]): steps go straight in these.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def bent(x: Floats, step: Floats, moduli_kPa: Floats, tissue_kPa: float) -> Floats:
    """Return where a step (n,) from unknowns (n,) ends that begins straight and goes along the valley.

    Parameters
    ----------
    x, step : size and depth in mm, modulus in kPa, and others, which go straight.
    moduli_kPa : (2,) ends of the modulus, which is not stepped over. Where they are on both sides of the
        tissue's, there is no such valley, and all go straight.
    """
    end, ends = x + step, np.asarray(_contrast(moduli_kPa, tissue_kPa))
    if ends[0] * ends[1] <= 0.0:
        return end
    here = _contrast(x[2], tissue_kPa)
    further = step[2] * 2.5 * tissue_kPa / (x[2] + 1.5 * tissue_kPa) ** 2
    there = float(np.clip(here + further, *ends))
    signal = step[0] / x[0] + further / (3.0 * here)
    end[0] = x[0] * np.exp(signal) * np.cbrt(here / there)
    end[1] = x[1] + step[1] + 0.5 * (step[0] + x[0] - end[0])
    end[2] = tissue_kPa * (1.0 + 1.5 * there) / (1.0 - there)
    return np.asarray(end)


def onto(x: Floats, way: Floats, modulus_kPa: float, moduli_kPa: Floats, tissue_kPa: float) -> Floats:
    """Return where the valley along a ``way`` (n,) from unknowns (n,) comes to a modulus."""
    share = (modulus_kPa - x[2]) / way[2]
    if np.prod(_contrast(moduli_kPa, tissue_kPa)) > 0.0:  # as far as contrast, not modulus, is to go
        share *= (x[2] + 1.5 * tissue_kPa) / (modulus_kPa + 1.5 * tissue_kPa)
    end = bent(x, share * way, moduli_kPa, tissue_kPa)
    end[2] = modulus_kPa
    return end


def _contrast(modulus_kPa: Floats | float, tissue_kPa: float) -> Floats:
    return np.asarray((modulus_kPa - tissue_kPa) / (modulus_kPa + 1.5 * tissue_kPa))
