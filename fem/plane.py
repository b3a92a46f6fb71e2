"""Press in two dimensions: plane strain or axisymmetric, linear elasticity, contact that may open.

The forward models of the source paper's predecessors were plane; these are their counterparts of
`fem.press`, to be compared with. In plane strain, probe, slab and inclusion are infinite along y: the sphere
becomes a cylinder. In axisymmetry the sphere stays a sphere, and the squares of probe and slab become the
discs of equal area, of radius width / sqrt(pi).

Contact is frictionless. Pressure acts along z and the gap is measured along z, for domes of small slope.
Since the two bodies meet only in the hat functions of the contact line, all that a press level has to solve
is a dense complementarity problem as large as that line.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from fem import surface
from fem.complementarity import complementary
from fem.model import Inclusion, NotModelled, Probe, Slab
from fem.plane_bodies import Bodies, Body, bodies_of, section_of
from fem.plane_element import KINDS, Kind
from fem.plane_mesh import QUALITIES, Section
from fem.solver import one_thread

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

_GRID = [0, 7, 3, 4, 8, 6, 1, 5, 2]  # scikit-fem's nine nodes as a 3 x 3 grid, x-major


@dataclass(frozen=True)
class Press2D:
    """What a plane press does; names ending in `_0` are the same press without the inclusion, same mesh.

    Forces are N per mm of width in plane strain, N in axisymmetry. All is the half x >= 0 of the section, the
    contact line from the axis to the probe's edge.

    Attributes
    ----------
    kind
        "plane_strain" or "axisymmetric".
    x
        Undeformed nodes of the contact line: distance from the axis, mm, shape (n,), every second one between
        two elements.
    displacement
        Of the probe's surface, along x and z, in its frame, +z into the specimen, so that pushed in is
        negative; mm, (n, 2).
    pressure
        Contact pressure, kPa, (n,), linear between the nodes; never negative.
    gap
        Mean opening between probe and slab in the neighbourhood of each node (its hat function), mm, (n,);
        zero where `pressure` is not.
    area
        Of each node's hat function: mm² of the whole ring in axisymmetry, mm² per mm of width in plane
        strain, both sides of the axis; (n,). `pressure * area` sums to 1000 times the force.
    cut
        The plane y = 0 of probe and slab as `fem.Press.cut` has it.
    indentation_mm
        Travel of the glass against the chest wall, from the first touch.
    force, force_0, chest_force
        On the contact, the same without inclusion, and the chest wall's reaction; compression positive.
    contact_mm, contact_0_mm
        Half width or radius of the contact: the outermost node with pressure.
    path
        How contact was found: "tied" if all of the line is pressed in both states, else "unilateral".
    dof, seconds
        Unknowns and time taken.
    """

    kind: Kind
    x: Floats
    displacement: Floats
    displacement_0: Floats
    pressure: Floats
    pressure_0: Floats
    gap: Floats
    gap_0: Floats
    area: Floats
    cut: pv.PolyData
    indentation_mm: float
    force: float
    force_0: float
    chest_force: float
    contact_mm: float
    contact_0_mm: float
    path: str
    dof: int
    seconds: float


def press_2d(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    indentation: float,
    kind: Kind = "plane_strain",
    quality: str = "standard",
) -> Press2D:
    """Press the probe straight down on the slab, above the inclusion, in two dimensions.

    Parameters
    ----------
    probe, slab, inclusion
        As for `fem.press`. In plane strain widths are taken as they are and the inclusion is a cylinder along
        y; in axisymmetry squares become discs of equal area. A dome is a cylinder's or a sphere's cap.
    indentation
        Travel of the glass towards the chest wall after the first touch, mm.
    kind
        "plane_strain" or "axisymmetric".
    quality
        "preview", "standard" or "reference".

    Raises
    ------
    ValueError
        On impossible input, in one line.
    NotModelled
        On possible input that is not modelled: off-centre inclusions, an ellipsoid that is not round about z.

    Example
    -------
    >>> layers = (Layer(2, 27), Layer(3, 61), Layer(5, 156))
    >>> press_2d(Probe(25, layers), Slab(30, 60, 5), Inclusion(10, 5, 100), 2.0).force  # doctest: +SKIP
    """
    start = time.perf_counter()
    if kind not in KINDS:
        raise ValueError(f"kind: received {kind!r}; allowed {', '.join(KINDS)}")
    if not (np.isfinite(indentation) and indentation > 0):
        raise ValueError(f"indentation: received {indentation}; allowed are positive finite numbers")
    if quality not in QUALITIES:
        raise ValueError(f"quality: received {quality!r}; allowed {', '.join(QUALITIES)}")
    section = section_of(probe, slab, inclusion, kind)
    with one_thread():
        try:
            bodies = bodies_of(probe, slab, inclusion, kind, QUALITIES[quality])
            states = [_touch(bodies, tissue, section, indentation) for tissue in bodies.slabs]
        except np.linalg.LinAlgError:
            raise NotModelled(
                "press_2d: received moduli or lengths so far apart that the equations cannot be solved; "
                "not modelled: allowed are moduli and lengths closer to each other"
            ) from None
        chest = _chest_force(bodies.slabs[0], states[0].slab)
    one, other = states
    sides = 2.0 if kind == "plane_strain" else 1.0  # the half section's forces to the whole's
    tip = bodies.probe.contact
    return Press2D(
        kind=kind,
        x=bodies.x,
        displacement=one.probe[tip],
        displacement_0=other.probe[tip],
        pressure=one.pressure,
        pressure_0=other.pressure,
        gap=one.gap,
        gap_0=other.gap,
        area=sides * bodies.area,
        cut=_cut(bodies, one, other),
        indentation_mm=float(indentation),
        force=1e-3 * sides * float(bodies.area @ one.pressure),
        force_0=1e-3 * sides * float(bodies.area @ other.pressure),
        chest_force=1e-3 * sides * chest,
        contact_mm=float(bodies.x[one.pressure > 0].max(initial=0.0)),
        contact_0_mm=float(bodies.x[other.pressure > 0].max(initial=0.0)),
        path="tied" if all((state.pressure > 0).all() for state in states) else "unilateral",
        dof=sum(int(body.unknown.max()) + 1 for body in (bodies.slabs[0], bodies.probe)),
        seconds=time.perf_counter() - start,
    )


@dataclass(frozen=True)
class _State:
    pressure: Floats
    gap: Floats
    slab: Floats  # displacement of its nodes, (nodes, 2) mm, probe's frame
    probe: Floats


def _touch(bodies: Bodies, slab: Body, section: Section, indentation: float) -> _State:
    """Find the contact pressure of an indentation and what it does."""
    first = (
        section.sag(bodies.x) - indentation
    )  # nodal gap before any pressure: chest wall lowered, slab with it
    compliance = bodies.mean @ (
        slab.response[2 * slab.contact + 1] + bodies.probe.response[2 * bodies.probe.contact + 1]
    )
    compliance = (compliance + compliance.T) / 2
    pressure = complementary(compliance, bodies.mean @ first)
    gap = (compliance @ pressure + bodies.mean @ first) / bodies.area
    moved = (slab.response @ pressure).reshape(-1, 2)
    moved[:, 1] -= indentation
    return _State(pressure, gap, moved, -(bodies.probe.response @ pressure).reshape(-1, 2))


def _chest_force(slab: Body, moved: Floats) -> float:
    """Force of the half section on the chest wall, pressing positive, mN (per mm in plane strain)."""
    local = (2 * slab.nine[:, :, None] + np.arange(2)).reshape(len(slab.nine), -1)
    force = (slab.matrices @ moved.ravel()[local][:, :, None])[:, :, 0]
    total = np.bincount(local.ravel(), weights=force.ravel(), minlength=moved.size).reshape(-1, 2)
    z = slab.place[:, 1]
    return -float(total[np.isclose(z, z.max()), 1].sum())


def _cut(bodies: Bodies, one: _State, other: _State) -> pv.PolyData:
    """The section mirrored to both sides, as a plane y = 0 in three dimensions."""
    slab, probe = bodies.slabs[0], bodies.probe

    def solid(tissue: Floats, layered: Floats) -> Floats:
        both = np.vstack([tissue, layered])
        return np.stack([both[:, 0], np.zeros(len(both)), both[:, 1]], axis=1)

    return surface.cut_plane(
        solid(slab.place, probe.place),
        np.vstack([slab.nine[:, _GRID], probe.nine[:, _GRID] + len(slab.place)]),
        np.concatenate([slab.material, probe.material]),
        {"displacement": solid(one.slab, one.probe), "displacement_0": solid(other.slab, other.probe)},
    )
