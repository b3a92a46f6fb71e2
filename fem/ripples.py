"""What an inclusion adds to a press, without the ripples of the mesh that follows it.

A mesh that goes with the inclusion is off by a per cent or two of what the inclusion adds, in a pattern of
its cells that goes with size and depth: it tells these from the modulus better than the press itself does.
Spheres in plain tissue whose mesh stays leave none (`fem.spheres`), but at small strain alone. What finite
strain makes of the signal it makes of the mesh's error, too: so many times the error at small strain is taken
from a press at finite strain on the same mesh, a control variate (Owen 2013, section 8.9; [owen2013]).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fem.ground import carry
from fem.ground import lines as lines_of
from fem.model import Inclusion, Probe, Slab
from fem.spheres import multipoles

Floats = NDArray[np.float64]

_INNER = 0.9  # of the probe's half width, where it is learned how many times finite strain makes a signal


def expanded(
    probe: Probe,
    slab: Slab,
    ball: Inclusion,
    moduli: Sequence[float],
    degree: int,
    to: tuple[Floats, Floats],
) -> tuple[Floats, Floats]:
    """Spheres that differ in their modulus (kPa) at small strain, by multipoles of standard quality.

    Returns
    -------
    Pressure over that without inclusion, less 1, (moduli, n, m), and tared displacement per mm of
    indentation, (moduli, n, m, 3), at the crossings of lines x (n,) and y (m,), mm.

    Raises
    ------
    NotModelled, ValueError
        For what multipoles do not press, in one line.
    """
    centred = ball.offset[0] == 0.0, ball.offset[1] == 0.0
    tissue = multipoles(probe, slab, centred=centred, degree=degree)
    found, shape = [], (to[0].size, to[1].size)
    for (one,) in tissue.press_moduli(ball, moduli, [1.0]):
        own = lines_of(one.surface)
        pressure, plain, moved, still = (
            np.asarray(one.surface.point_data[name], dtype=float)
            for name in ("pressure", "pressure_0", "displacement", "displacement_0")
        )
        parts = np.column_stack([pressure / plain - 1.0, moved - still])
        found.append(carry(parts, own, to).reshape(*shape, 4))
    every = np.stack(found)
    return every[..., 0], every[..., 1:]


def without_ripples(full: Floats, small: Floats, true: Floats, lines: tuple[Floats, Floats]) -> Floats:
    """What an inclusion adds at finite strain, less the error of its mesh.

    Parameters
    ----------
    full : (levels, n, m[, 3]), at finite strain on a mesh.
    small, true : (n, m[, 3]), the same at small strain on that mesh, and without a mesh's error.
    lines : x (n,) and y (m,) of the nodes, mm.
    """
    inner = np.logical_and.outer(*(np.abs(line) <= _INNER * line[-1] for line in lines))
    few = small[inner]
    times = (full[:, inner] * few).sum(axis=1) / (few**2).sum(axis=0)  # (levels[, 3])
    times = times.reshape(len(full), 1, 1, *small.shape[2:])
    return np.asarray(full - times * (small - true))
