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
from fem.model import Inclusion
from fem.spheres import Multipoles
from fem.tared import added

Floats = NDArray[np.float64]

DEGREE = 8
"""Of multipoles: tared maxima are converged to 0.03 %."""

_INNER = 0.9  # of the probe's half width, where it is learned how many times finite strain makes a signal


def expanded(
    tissue: Multipoles, ball: Inclusion, moduli: Sequence[float], to: tuple[Floats, Floats]
) -> tuple[Floats, Floats]:
    """Spheres that differ in their modulus (kPa) at small strain, in plain tissue that is solved.

    Returns
    -------
    Pressure over that without inclusion, less 1, (moduli, n, m), and tared displacement per mm of
    indentation, (moduli, n, m, 3), at the crossings of lines x (n,) and y (m,), mm.

    Raises
    ------
    NotModelled, ValueError
        For what multipoles do not press, in one line.
    """
    rises, moves, shape = [], [], (to[0].size, to[1].size)
    for (one,) in tissue.press_moduli(ball, moduli, [1.0]):
        own, (rise, moved) = lines_of(one.surface), added(one.surface, 1.0, 1.0)
        rises.append(carry(rise.ravel(), own, to).reshape(shape))
        moves.append(carry(moved.reshape(-1, 3), own, to).reshape(*shape, 3))
    return np.stack(rises), np.stack(moves)


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
