"""Contact pressure beside the probe's edge, where it is singular.

Towards the edge of a flat punch the pressure rises as distance^(-g), g = 1/2 for a rigid one (Johnson 1985,
section 5.1; [johnson1985]) and less for a soft one. Quadratic loads of such a rise are negative on the inner
side of the last cell, so that a pressure recovered from them alone rings through the outer millimetres. Here
the rise is taken out of the loads first, line by line, and put back as its own values at the nodes.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_POWER = 0.4  # g; between 0.3 and 0.5 the recovered pressure changes by 1 %
_REGULAR = np.array([1.0, 4.0, 1.0]) / 6  # loads of a constant pressure on the nodes of a cell of length 1
_MIDDLE = (
    0.5**-_POWER - 1
)  # the rise s^-g - 1 at the cell's middle, s the distance from the edge over its length


def _moments() -> Floats:
    """Loads of s^-g - 1 on the three nodes of a cell of length 1, the edge's last."""
    powers = 1 / (1 + np.arange(3) - _POWER) - 1 / (1 + np.arange(3))
    # the quadratic functions in powers of s
    return np.asarray(np.array([[0.0, -1.0, 2.0], [0.0, 4.0, -4.0], [1.0, -3.0, 2.0]]) @ powers)


_SINGULAR = _moments()
_EDGE = (_SINGULAR.sum() - _REGULAR[1] * _MIDDLE) / _REGULAR[
    2
]  # at the edge, so that lumped areas carry it all


def split(load: Floats, lines: Floats, ends: tuple[bool, bool]) -> tuple[Floats, Floats]:
    """Loads along the first axis as regular ones and the singular pressure's values at the nodes.

    Parameters
    ----------
    load
        Consistent nodal loads, (n, m).
    lines
        Nodes of the first axis, (n,) mm, n odd.
    ends
        Whether the first and the last node are on the probe's edge.

    Returns
    -------
    Loads without the singular part (n, m), and the singular pressure (n, m), load / mm; its lumped sum along
    the axis is what was taken out.
    """
    load, rise = load.copy(), np.zeros_like(load)
    for end, wanted in zip((slice(2, None, -1), slice(-3, None)), ends, strict=True):
        if not wanted:
            continue
        size = abs(float(lines[end][-1] - lines[end][0]))
        # the two outer nodes have this cell only: a constant and a rise explain their loads
        both = size * np.stack([_REGULAR, _SINGULAR], axis=1)[1:]
        strength = np.linalg.solve(both, load[end][1:])[1]
        load[end] -= size * _SINGULAR[:, None] * strength
        rise[end] += np.array([0.0, _MIDDLE, _EDGE])[:, None] * strength
    return load, rise
