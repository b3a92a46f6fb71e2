"""What an inclusion adds to a press on one mesh."""

from __future__ import annotations

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from fem.contact_fields import contact_of
from fem.equilibrium import State
from fem.ground import lines
from fem.mesh import Geometry
from fem.path import Path

Floats = NDArray[np.float64]


def tared(geometry: Geometry, states: tuple[State, State]) -> tuple[Floats, Floats]:
    """Of states with and without inclusion, as `added`."""
    return added(contact_of(geometry, states)[0], states[0].indentation, states[1].indentation)


def tared_at_rest(geometry: Geometry, full: Path, bare: Path) -> tuple[Floats, Floats]:
    """The same at small strain, of paths that are not yet used."""
    return tared(geometry, (full.per_mm(), bare.per_mm()))


def added(surface: pv.PolyData, depth: float, depth_0: float) -> tuple[Floats, Floats]:
    """Pressure per mm over that without inclusion, less 1, (n, m), and tared displacement per mm, (n, m, 3),
    on a contact surface; each state is taken per mm of its own indentation, mm."""
    x, y = lines(surface)
    pressure, plain, moved, still = (
        np.asarray(surface.point_data[name], dtype=float).reshape(x.size, y.size, -1)
        for name in ("pressure", "pressure_0", "displacement", "displacement_0")
    )
    return (pressure / depth / (plain / depth_0) - 1.0)[..., 0], moved / depth - still / depth_0
