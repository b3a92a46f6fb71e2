"""Presses told over plain tissue on a mesh that is the same for every inclusion.

Towards the probe's edge the contact pressure is singular, and a mesh of a few cells there leaves ripples of
some per cent in it, other ones for every inclusion that the mesh is made around. They are the same
with the inclusion and without it: in the ratio of the two they cancel (a control variate). So the ratio is
taken from the press's own mesh, plain tissue from one common mesh, and pictures of different inclusions
differ by the inclusions alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np
import pyvista as pv
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from fem.equilibrium import NotConverged
from fem.mesh import Geometry
from fem.meshed import build
from fem.model import Inclusion, NotModelled, Pose, Probe, Slab
from fem.path import path
from fem.pressing import Press, contact_of
from fem.solver import one_thread
from fem.topology import Resolution

Floats = NDArray[np.float64]

_OWN_MESH = (
    "background: plain tissue could not be followed to {:g} mm on the mesh that all inclusions share; the "
    "surface keeps the ripples of its own mesh, some per cent beside the guide's edges"
)


def bare_geometry(probe: Probe, slab: Slab, pose: Pose | None = None) -> Geometry:
    """Plain tissue, meshed around a sphere of its own moduli that gives every thickness the same lines on the
    contact surface; in a thin slab around any other."""
    size, depth = 0.3 * probe.width_mm, 0.2 * slab.thickness_mm
    fits = size + 2.0 * depth <= slab.thickness_mm
    still = Inclusion(size, depth, slab.modulus_kPa, poisson=slab.poisson) if fits else None
    return Geometry(probe, slab, still, pose or Pose())


def on_background(presses: Sequence[Press]) -> list[Press]:
    """Return presses of one specimen, one for each level, with surfaces that stand on the common background.

    `displacement` and `pressure` of the surface become those of plain tissue on the common mesh, the former
    plus what the inclusion adds, the latter times what it multiplies it by; it has that mesh's nodes. All
    else, forces too, stays that of the press's own mesh. Where contact has opened anywhere, as it does under
    domes and most tilted probes, presses are returned as they are (`Press.path` tells it); and, with a
    warning, where plain tissue cannot be followed as deep on the common mesh.
    """
    if not presses or not all(one.path != "unilateral" and one.min_pressure_kPa > 0 for one in presses):
        return list(presses)
    first = presses[0]
    own, res = first._geometry, first._states[0].model.layout.res
    geometry = bare_geometry(own.probe, own.slab, own.pose)
    levels = tuple(sorted({one.indentation_0_mm for one in presses}))
    grounds = _grounds(geometry, res, first.mechanics == "finite", levels)
    if grounds is None:
        warnings.warn(_OWN_MESH.format(levels[-1]), stacklevel=2)
        return list(presses)
    at = dict(zip(levels, grounds, strict=True))
    return [replace(one, surface=_over(one.surface, at[one.indentation_0_mm])) for one in presses]


@lru_cache(maxsize=8)  # specimens that differ in the inclusion alone follow each other
def _grounds(
    geometry: Geometry, res: Resolution, finite: bool, levels: tuple[float, ...]
) -> tuple[pv.PolyData, ...] | None:
    """Contact surfaces of plain tissue at rising levels, mm; None where contact opens or nothing is found."""
    try:
        with one_thread():
            way = path(geometry, build(geometry, res, finite), False)
            states = [way.to(level) for level in levels]
    except (NotConverged, NotModelled, np.linalg.LinAlgError):  # what the own mesh found stays good
        return None
    if not all(state.closed.all() for state in states):
        return None
    return tuple(contact_of(geometry, (state, state))[0] for state in states)


def _over(own: pv.PolyData, ground: pv.PolyData) -> pv.PolyData:
    """What the inclusion does on its own mesh, on the surface of another of plain tissue."""
    (x, y), (to_x, to_y) = (_lines(one) for one in (own, ground))
    onto = [make_interp_spline(a, np.eye(a.size), k=3)(b) for a, b in ((x, to_x), (y, to_y))]

    def carried(values: Floats) -> Floats:
        grid = values.reshape(x.size, y.size, -1)
        found = np.einsum("ai,ijc,bj->abc", onto[0], grid, onto[1], optimize=True)
        return np.asarray(found.reshape(-1, *values.shape[1:]))

    data, found = own.point_data, ground.copy(deep=True)
    more = np.asarray(data["displacement"]) - np.asarray(data["displacement_0"])
    found.point_data["displacement"] = np.asarray(ground["displacement_0"]) + carried(more)
    for name in ("pressure", "area"):
        factor = np.asarray(data[name]) / np.asarray(data[f"{name}_0"])
        found.point_data[name] = np.maximum(np.asarray(ground[f"{name}_0"]) * carried(factor), 0.0)
    return found


def _lines(contact: pv.PolyData) -> tuple[Floats, Floats]:
    """Grid lines of a contact surface, whose points are x-major."""
    points = np.asarray(contact.points, dtype=float)
    count = int(np.flatnonzero(np.diff(points[:, 0]))[0]) + 1
    return points[::count, 0], points[:count, 1]
