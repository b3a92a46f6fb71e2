"""What an inclusion adds to a press on one mesh."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fem.contact_fields import contact_of
from fem.equilibrium import State
from fem.mesh import Geometry
from fem.path import Path

Floats = NDArray[np.float64]


def tared(geometry: Geometry, full: Path, bare: Path, level: float) -> tuple[Floats, Floats]:
    """Rise (n, n) and tared displacement (n, n, 3) per mm of the level, mm."""
    pressure, moved, pressure_0, moved_0 = _fields(geometry, (full.to(level), bare.to(level)))
    return (pressure - pressure_0) / pressure_0, (moved - moved_0) / level


def _fields(geometry: Geometry, states: tuple[State, State]) -> tuple[Floats, Floats, Floats, Floats]:
    """Pressure (n, n) and displacement (n, n, 3) on the whole footprint, of both states; kPa, mm."""
    contact, _ = contact_of(geometry, states)
    n = round(contact.n_points**0.5)
    data = contact.point_data
    return (
        np.asarray(data["pressure"], dtype=float).reshape(n, n),
        np.asarray(data["displacement"], dtype=float).reshape(n, n, 3),
        np.asarray(data["pressure_0"], dtype=float).reshape(n, n),
        np.asarray(data["displacement_0"], dtype=float).reshape(n, n, 3),
    )
