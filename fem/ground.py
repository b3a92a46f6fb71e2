"""Pressure of plain tissue under a probe, without the ripples that coarse cells leave beside its edge.

Towards the edge of a probe the contact pressure is singular. Cells that shrink towards it resolve that, and
at small strain they are cheap; at finite strain such a mesh gives way at the probe's corner, and costs a
minute. But what finite strain changes is smooth: on a lean mesh of such cells its share in the pressure of
small strain is a polynomial of low degree, the rest ripples of that mesh. So the pressure is that of small
strain on a fine mesh times that polynomial; likewise the displacement, plus what finite strain adds to it.
"""

from __future__ import annotations

from functools import lru_cache
from itertools import groupby

import numpy as np
import pyvista as pv
from numpy.polynomial.legendre import legvander
from numpy.typing import NDArray
from scipy.interpolate import make_interp_spline

from fem import surface
from fem.contact_fields import contact_of
from fem.equilibrium import NotConverged
from fem.mesh import Geometry
from fem.meshed import build
from fem.model import Inclusion, Pose, Probe, Slab
from fem.path import path
from fem.solver import one_thread
from fem.topology import Resolution

Floats = NDArray[np.float64]

_GROWTH = (0.7, 1.6)  # of the fine mesh's cells towards the probe's edge, and beyond it
# The lean mesh's, up to the first strain and from the second one: cells that shrink less give way later, and
# ripple more towards the edge.
_LEAN, _STRAIN = (0.6, 2.0), (0.12, 0.2)
_DEGREE = 4  # of the share of finite strain, along x and y
_WITHIN = (
    0.91  # of the probe's half width, where it is learned: beyond, cells of the lean mesh tell of themselves
)


def bare_geometry(probe: Probe, slab: Slab, pose: Pose | None = None) -> Geometry:
    """Plain tissue, meshed around a sphere of its own moduli that gives every thickness the same lines on the
    contact surface; in a thin slab around any other."""
    size, depth = 0.3 * probe.width_mm, 0.2 * slab.thickness_mm
    fits = size + 2.0 * depth <= slab.thickness_mm
    still = Inclusion(size, depth, slab.modulus_kPa, poisson=slab.poisson) if fits else None
    return Geometry(probe, slab, still, pose or Pose())


def fine(res: Resolution) -> Resolution:
    """Mesh of plain tissue at small strain that goes with a resolution of presses: as many cells along x and
    y, more of them towards the probe's edge, few where an inclusion would be."""
    return Resolution(
        res.arc,
        1,
        max(res.shell // 2, 1),
        res.above,
        1,
        max(2 * res.arc - 2, 2),
        res.side,
        res.layer,
        1,
        _GROWTH,
    )


def lean(res: Resolution, strain: float) -> Resolution:
    """Mesh of what finite strain changes, at an indentation over the slab's thickness.

    It changes with that little by little, so that pressure does not jump.
    """
    growth = (float(np.interp(strain, _STRAIN, _LEAN)), _GROWTH[1])
    return Resolution(
        min(res.arc, 2), 1, 1, min(res.above, 2), 1, min(res.arc + 1, 3), min(res.side, 2), 1, 1, growth
    )


@lru_cache(maxsize=8)  # specimens that differ in the inclusion alone follow each other
def ground(
    geometry: Geometry, res: Resolution, finite: bool, levels: tuple[float, ...]
) -> tuple[pv.PolyData, ...]:
    """Contact surfaces of plain tissue, one for each press level.

    Parameters
    ----------
    geometry
        As `bare_geometry` gives it.
    res
        Resolution of the presses that these surfaces are for.
    levels
        Indentations, rising, mm.

    Returns
    -------
    As of `fem.Press.surface`, on the lines of `fine(res)`.

    Raises
    ------
    NotConverged
        If a level is not found, or contact opens on the way.
    NotModelled, numpy.linalg.LinAlgError
        As for a press.
    """
    small = _pressed(geometry, fine(res), False, levels)
    if not finite:
        return small
    # every level on the mesh of its own depth: what is pressed beside it does not show
    meshes = [lean(res, level / geometry.slab.thickness_mm) for level in levels]
    found: list[pv.PolyData] = []
    for coarse, group in groupby(zip(meshes, levels, strict=True), key=lambda each: each[0]):
        own = tuple(level for _, level in group)
        both = (_pressed(geometry, coarse, kind, own) for kind in (False, True))
        found += map(_strained, small[len(found) :], *both)
    return tuple(found)


def _pressed(
    geometry: Geometry, res: Resolution, finite: bool, levels: tuple[float, ...]
) -> tuple[pv.PolyData, ...]:
    with one_thread():
        way = path(geometry, build(geometry, res, finite), False)
        states = [way.to(level) for level in levels]
    if not all(state.closed.all() for state in states):
        raise NotConverged(f"press: contact with plain tissue opens on the way to {levels[-1]:.3g} mm")
    return tuple(contact_of(geometry, (state, state))[0] for state in states)


def _strained(small: pv.PolyData, lean_small: pv.PolyData, lean_finite: pv.PolyData) -> pv.PolyData:
    """What finite strain changes on a lean mesh, carried to the surface of a fine one.

    At the very edge, where the probe's corner gives way, the polynomial does not hold: the outermost nodes
    take what the force, which depends little on the mesh, wants beyond it.
    """
    to, own = lines(small), lines(lean_small)
    terms = [legvander(at / at[-1], _DEGREE) for at in to]
    known = [np.abs(at) < _WITHIN * at[-1] for at in own]
    inner = [legvander(at[k] / at[-1], _DEGREE) for at, k in zip(own, known, strict=True)]
    share = np.asarray(lean_finite["pressure"]) / np.asarray(lean_small["pressure"])
    share = share.reshape(own[0].size, own[1].size)[np.ix_(*known)]
    weights = [np.linalg.pinv(w[:, None] * t) * w for w, t in zip(_roots(own, known), inner, strict=True)]
    smooth = terms[0] @ (weights[0] @ share @ weights[1].T) @ terms[1].T
    added = np.asarray(lean_finite["displacement"]) - np.asarray(lean_small["displacement"])
    moved = np.asarray(small["displacement"]) + carry(added, own, to)
    area = surface.areas(*to, moved.reshape(to[0].size, to[1].size, 3)).ravel()
    pressure = np.asarray(small["pressure"]) * smooth.ravel()
    force = _force(small) * _force(lean_finite) / _force(lean_small)
    edge = np.zeros(smooth.shape, dtype=bool)
    edge[[0, -1]] = edge[:, [0, -1]] = True
    outer = edge.ravel()
    pressure[outer] *= 1 + (force - float(pressure @ area)) / float(pressure[outer] @ area[outer])
    found = small.copy(deep=True)
    for name, values in (("displacement", moved), ("pressure", pressure), ("area", area)):
        found.point_data[name] = found.point_data[name + "_0"] = values
    return found


def _force(contact: pv.PolyData) -> float:
    """Force on a contact surface, mN."""
    return float(np.asarray(contact["pressure"]) @ np.asarray(contact["area"]))


def _roots(own: tuple[Floats, Floats], known: list[NDArray[np.bool_]]) -> list[Floats]:
    """Square roots of the nodes' weights along both axes, of those that count."""
    return [np.sqrt(surface.line_weights(at)[k]) for at, k in zip(own, known, strict=True)]


def carry(values: Floats, own: tuple[Floats, Floats], to: tuple[Floats, Floats]) -> Floats:
    """Field (n, ...) of a surface's points on its grid lines, at those of another, by cubic splines."""
    onto = [cubic(a, b) for a, b in zip(own, to, strict=True)]
    grid = values.reshape(own[0].size, own[1].size, -1)
    found = np.einsum("ai,ijc,bj->abc", onto[0], grid, onto[1], optimize=True)
    return np.asarray(found.reshape(-1, *values.shape[1:]))


def cubic(nodes: Floats, at: Floats) -> Floats:
    """Weights (m, n) of the values at the nodes of a line, (n,), at places (m,): the cubic spline through
    them, without a knot at the nodes next to the ends. Unlike the elements' own shapes, what it gives at a
    fixed place has no kinks where nodes pass it, as they do when an inclusion moves."""
    return _cubic(nodes.tobytes(), at.tobytes())


@lru_cache(maxsize=256)  # specimens whose nodes are the same follow each other when slopes are found
def _cubic(nodes: bytes, at: bytes) -> Floats:
    line = np.frombuffer(nodes)
    found = np.asarray(make_interp_spline(line, np.eye(line.size), k=3)(np.frombuffer(at)))
    found.flags.writeable = False
    return found


def lines(contact: pv.PolyData) -> tuple[Floats, Floats]:
    """Grid lines of a contact surface, whose points are x-major."""
    points = np.asarray(contact.points, dtype=float)
    count = int(np.flatnonzero(np.diff(points[:, 0]))[0]) + 1
    return points[::count, 0], points[:count, 1]
