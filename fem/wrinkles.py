"""Contact that has wrinkled: an equilibrium of the mesh, not of the tissue.

Deep beside the probe's edge Newton's method may settle where the pressure goes up and down from node to
node. What finite strain truly adds to an inclusion's signal is smooth.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fem.model import NotConverged

Floats = NDArray[np.float64]

_SHARE = 0.25  # of the signal: of 267 presses to 3 mm a wrinkled one has 0.9, the next 0.1
_LEAST = 0.01  # of the pressure; below it, nothing shows


def wrinkle(field: Floats) -> float:
    """Largest difference of a node, along either line, from the mean of its two neighbours, of (n, m)."""
    along = (field, field.T)
    return float(max(np.abs(f[1:-1] - (f[:-2] + f[2:]) / 2).max(initial=0.0) for f in along))


def refuse_wrinkles(rise: Floats, small: Floats, indentation: float) -> None:
    """Refuse a press at finite strain of closed contact whose pressure alternates from node to node.

    Parameters
    ----------
    rise, small : (n, m), pressure over that without inclusion, less 1, at finite and at small strain.

    Raises
    ------
    NotConverged
        In one line.
    """
    found = wrinkle(rise - small)
    if found > max(_LEAST, _SHARE * np.abs(small).max()):
        raise NotConverged(
            f"indentation: received {indentation:g} mm, at which the contact wrinkles: its pressure goes up "
            f"and down from node to node by {found:.1%}; allowed are presses that this mesh can follow"
        )
