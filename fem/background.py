"""Presses told over plain tissue on a mesh that is the same for every inclusion.

Towards the probe's edge the contact pressure is singular, and a mesh of a few cells there leaves ripples of
some per cent in it, other ones for every inclusion that the mesh is made around. They are the same
with the inclusion and without it: in the ratio of the two they cancel (a control variate). So the ratio is
taken from the press's own mesh, plain tissue from `fem.ground`, and pictures of different inclusions
differ by the inclusions alone.

What is left in the ratio are ripples of a per cent or two of what the inclusion adds. Of spheres in the reach
of multipoles these can be taken out, too (`fem.ripples`).
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
from fem.mesh import QUALITIES, Geometry
from fem.model import NotModelled, Probe, Slab
from fem.pressing import Press
from fem.ripples import DEGREE, expanded, without_ripples
from fem.spheres import multipoles, refuse
from fem.tared import added, tared
from fem.topology import Resolution

Floats = NDArray[np.float64]

_OWN_MESH = (
    "background: plain tissue could not be followed to {:g} mm on the mesh that all inclusions share; the "
    "surface keeps the ripples of its own mesh, some per cent beside the guide's edges"
)


def on_background(presses: Sequence[Press], smooth: bool = False) -> list[Press]:
    """Return presses of one specimen, one for each level, with surfaces that stand on the common background.

    `displacement` and `pressure` of the surface become those of plain tissue on the common mesh, the former
    plus what the inclusion adds, the latter times what it multiplies it by; it has that mesh's nodes. All
    else, forces too, stays that of the press's own mesh. Where contact has opened anywhere, as it does under
    domes and most tilted probes, presses are returned as they are; and, with a warning, where plain tissue
    cannot be followed as deep on the common mesh. `Press.background` and `Press.signal` tell which.

    Parameters
    ----------
    smooth
        Take the ripples of its mesh out of what a sphere within the reach of multipoles adds.
    """
    if not presses or not all(one.path != "unilateral" and one.min_pressure_kPa > 0 for one in presses):
        return list(presses)
    first = presses[0]
    own, res = first._geometry, first._states[0].model.layout.res
    geometry = bare_geometry(own.probe, own.slab, own.pose)
    smooth = smooth and _within_reach(own)
    try:
        found = _on_ground(presses, geometry, res, first.mechanics == "finite", smooth)
        return [replace(one, signal="smooth") for one in found] if smooth else found
    except (NotConverged, NotModelled, np.linalg.LinAlgError):  # what the own mesh found stays good
        deepest = max(one.indentation_0_mm for one in presses)
        warnings.warn(_OWN_MESH.format(deepest), stacklevel=2)
        return list(presses)


def spheres_on_background(
    presses: Sequence[Emulated], probe: Probe, slab: Slab, res: Resolution
) -> list[Emulated]:
    """The same of presses by multipoles, on the background of presses of a resolution."""
    return _on_ground(presses, bare_geometry(probe, slab), res, False, False)


Added = tuple[Floats, Floats]  # as `tared.added`
AnyPress = TypeVar("AnyPress", Press, Emulated)


def _on_ground(
    presses: Sequence[AnyPress], geometry: Geometry, res: Resolution, finite: bool, smooth: bool
) -> list[AnyPress]:
    levels = tuple(sorted({one.indentation_0_mm for one in presses}))
    at = dict(zip(levels, ground(geometry, res, finite, levels), strict=True))
    to = lines(at[levels[0]])
    signals = [
        _carried(added(one.surface, one.indentation_mm, one.indentation_0_mm), lines(one.surface), to)
        for one in presses
    ]
    if smooth:
        signals = _smooth(presses[0], signals, res, to)
    surfaces = [_over(one, s, at[one.indentation_0_mm]) for one, s in zip(presses, signals, strict=True)]
    return [replace(one, surface=s, background="shared") for one, s in zip(presses, surfaces, strict=True)]


def _carried(signal: Added, own: tuple[Floats, Floats], to: tuple[Floats, Floats]) -> Added:
    rise, moved = signal
    shape = to[0].size, to[1].size
    return (
        carry(rise.ravel(), own, to).reshape(shape),
        carry(moved.reshape(-1, 3), own, to).reshape(*shape, 3),
    )


def _within_reach(geometry: Geometry) -> bool:
    """Whether multipoles can tell the mesh's ripples from what the inclusion adds; plain tissue has none."""
    try:
        refuse(geometry.probe, geometry.slab, geometry.inclusion, geometry.pose)
    except ValueError:
        return False
    return True


def _smooth(
    first: Press | Emulated, signals: Sequence[Added], res: Resolution, to: tuple[Floats, Floats]
) -> list[Added]:
    """What a sphere adds at each level, on lines x and y, without the ripples of its mesh."""
    assert isinstance(first, Press)
    geometry, small = first._geometry, first._small
    ball = geometry.inclusion
    if ball is None:
        return list(signals)
    assert small is not None  # of all flat probes
    quality = "preview" if res == QUALITIES["preview"] else "standard"
    tissue = multipoles(geometry.probe, geometry.slab, quality, degree=DEGREE)
    true = expanded(tissue, ball, [ball.modulus], to)
    rough = _carried(tared(geometry, small), lines(first.surface), to)
    whole = [
        without_ripples(np.stack(levels), near, fine[0], to)
        for levels, near, fine in zip(zip(*signals, strict=True), rough, true, strict=True)
    ]
    return list(zip(*whole, strict=True))


def _over(one: AnyPress, signal: Added, plain: pv.PolyData) -> pv.PolyData:
    """What the inclusion adds, on the surface of plain tissue."""
    own, found, (rise, moved) = one.surface.point_data, plain.copy(deep=True), signal
    to, depth = (lines(one.surface), lines(plain)), one.indentation_mm
    times = depth / one.indentation_0_mm  # other than 1 where both are pressed by one force
    more = depth * moved.reshape(-1, 3)
    found.point_data["displacement"] = times * np.asarray(plain["displacement_0"]) + more
    factors = {
        "pressure": times * (1.0 + rise.ravel()),
        "area": carry(np.asarray(own["area"]) / np.asarray(own["area_0"]), *to),
    }
    for name, factor in factors.items():
        found.point_data[name] = np.maximum(np.asarray(plain[f"{name}_0"]) * factor, 0.0)
    return found
