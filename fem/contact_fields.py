"""What two states of a press, with and without the inclusion, do at the contact surface."""

from __future__ import annotations

import numpy as np
import pyvista as pv

from fem import surface
from fem.equilibrium import State
from fem.mesh import Geometry
from fem.model import NotModelled

TOO_UNEVEN = (
    "press: received moduli or lengths so far apart that the equations cannot be solved; "
    "not modelled: allowed are moduli and lengths closer to each other"
)


def contact_of(geometry: Geometry, states: tuple[State, State]) -> tuple[pv.PolyData, float]:
    """The contact surface with its fields, and the smallest pressure on it, kPa."""
    nodes, half = states[0].model.nodes, states[0].model.layout.symmetric
    at = states[0].model.place[nodes.tip]
    x, y = at[:, 0, 0], at[0, :, 1]
    whole_x, whole_y = surface.mirror_line(x, half[0]), surface.mirror_line(y, half[1])
    contact = surface.contact_surface(whole_x, whole_y, surface.mirror_grid(at[..., 2], symmetric=half))
    lumped = np.outer(surface.line_weights(whole_x), surface.line_weights(whole_y)).ravel()
    lowest = np.inf
    for suffix, state in zip(("", "_0"), states, strict=True):
        moved = state.moved[nodes.tip]
        pressure = surface.pressure(np.maximum(state.force, 0.0), x, y, state.closed)
        stretch = np.ones(pressure.shape)
        if state.model.finite:  # area that the deformed surface covers, seen along z
            stretch = np.linalg.det(state.model.interface.derivatives(at + moved)[..., :2])
        if not np.isfinite(pressure).all():
            raise NotModelled(TOO_UNEVEN)
        pressure = pressure / stretch
        lowest = min(lowest, float(pressure.min()))
        signs = ((-1, 1), (1, -1), (1, 1))
        whole = [surface.mirror_grid(moved[..., a], *signs[a], half) for a in range(3)]
        contact.point_data["displacement" + suffix] = np.stack(whole, axis=-1).reshape(-1, 3)
        contact.point_data["pressure" + suffix] = surface.mirror_grid(pressure, symmetric=half).ravel()
        contact.point_data["area" + suffix] = lumped * surface.mirror_grid(stretch, symmetric=half).ravel()
    return contact, lowest
