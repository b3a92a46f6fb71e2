"""Presses told over plain tissue on a mesh that is the same for every inclusion.

Towards the probe's edge the contact pressure is singular, and a mesh of a few cells there leaves ripples of
some per cent in it, other ones for every inclusion that the mesh is made around. They are the same
with the inclusion and without it: in the ratio of the two they cancel (a control variate). So the ratio is
taken from the press's own mesh, plain tissue from `fem.ground`, and pictures of different inclusions
differ by the inclusions alone.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from fem.emulated import Emulated
from fem.equilibrium import NotConverged
from fem.ground import bare_geometry, carry, ground, lines
from fem.mesh import Geometry
from fem.model import NotModelled, Probe, Slab
from fem.pressing import Press
from fem.topology import Resolution

Floats = NDArray[np.float64]

_OWN_MESH = (
    "background: plain tissue could not be followed to {:g} mm on the mesh that all inclusions share; the "
    "surface keeps the ripples of its own mesh, some per cent beside the guide's edges"
)


def on_background(presses: Sequence[Press]) -> list[Press]:
    """Return presses of one specimen, one for each level, with surfaces that stand on the common background.

    `displacement` and `pressure` of the surface become those of plain tissue on the common mesh, the former
    plus what the inclusion adds, the latter times what it multiplies it by; it has that mesh's nodes. All
    else, forces too, stays that of the press's own mesh. Where contact has opened anywhere, as it does under
    domes and most tilted probes, presses are returned as they are; and, with a warning, where plain tissue
    cannot be followed as deep on the common mesh. `Press.background` tells which.
    """
    if not presses or not all(one.path != "unilateral" and one.min_pressure_kPa > 0 for one in presses):
        return list(presses)
    first = presses[0]
    own, res = first._geometry, first._states[0].model.layout.res
    geometry = bare_geometry(own.probe, own.slab, own.pose)
    try:
        return _on_ground(presses, geometry, res, first.mechanics == "finite")
    except (NotConverged, NotModelled, np.linalg.LinAlgError):  # what the own mesh found stays good
        deepest = max(one.indentation_0_mm for one in presses)
        warnings.warn(_OWN_MESH.format(deepest), stacklevel=2)
        return list(presses)


def spheres_on_background(
    presses: Sequence[Emulated], probe: Probe, slab: Slab, res: Resolution
) -> list[Emulated]:
    """The same of presses by multipoles, on the background of presses of a resolution."""
    return _on_ground(presses, bare_geometry(probe, slab), res, False)


AnyPress = TypeVar("AnyPress", Press, Emulated)


def _on_ground(
    presses: Sequence[AnyPress], geometry: Geometry, res: Resolution, finite: bool
) -> list[AnyPress]:
    levels = tuple(sorted({one.indentation_0_mm for one in presses}))
    at = dict(zip(levels, ground(geometry, res, finite, levels), strict=True))
    surfaces = [_over(one.surface, at[one.indentation_0_mm]) for one in presses]
    return [replace(one, surface=s, background="shared") for one, s in zip(presses, surfaces, strict=True)]


def _over(own: pv.PolyData, plain: pv.PolyData) -> pv.PolyData:
    """What the inclusion does on its own mesh, on the surface of another of plain tissue."""
    to, data, found = (lines(own), lines(plain)), own.point_data, plain.copy(deep=True)
    more = np.asarray(data["displacement"]) - np.asarray(data["displacement_0"])
    found.point_data["displacement"] = np.asarray(plain["displacement_0"]) + carry(more, *to)
    for name in ("pressure", "area"):
        factor = np.asarray(data[name]) / np.asarray(data[f"{name}_0"])
        found.point_data[name] = np.maximum(np.asarray(plain[f"{name}_0"]) * carry(factor, *to), 0.0)
    return found
