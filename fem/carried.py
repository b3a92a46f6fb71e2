"""Where a press carries the inclusion, and what shape it gives it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fem import mesh

if TYPE_CHECKING:
    from fem.equilibrium import State
    from fem.mesh import Geometry

Floats = NDArray[np.float64]


def carried(geometry: Geometry, state: State) -> tuple[Floats, Floats]:
    """Return the deformed inclusion as an ellipsoid: its centre (3,) and axes (3, 3), mm.

    The axes stand in columns: points of the inclusion are centre + axes @ u with |u| <= 1. The frame is the
    probe's, with the glass at rest. An ellipsoid in a uniform field strains uniformly (Eshelby 1957; key
    eshelby1957): the best affine map of the inclusion's nodes leaves little out.
    """
    ball, model = geometry.inclusion, state.model
    assert ball is not None
    nodes = np.unique(model.nodes.cells[model.ball])
    before, after = model.place[nodes], (model.place + state.moved)[nodes]
    for axis, half in enumerate(model.layout.symmetric):
        if half:
            mirror = np.where(np.arange(3) == axis, -1.0, 1.0)
            before, after = (np.concatenate([part, part * mirror]) for part in (before, after))
    turn = mesh.rotation(geometry.pose.tilt_deg)
    own = before @ turn.T - np.array([*ball.offset, ball.centre_mm])
    found, *_ = np.linalg.lstsq(np.column_stack([np.ones(len(own)), own]), after, rcond=None)
    return found[0], found[1:].T * np.array(ball.radii_mm)
