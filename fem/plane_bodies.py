"""The two bodies of a plane press, each factored by itself, and the hat functions in which they meet.

The contact pressure is linear between the Q2 nodes of the contact line, p = sum of p_j psi_j, and the gap is
held open in the mean over each hat function psi_j (the mixed method of Hild and Laborde 2002, [hild2002],
with a finer multiplier). Nodal forces would not do: an axisymmetric quadratic element's node on the axis
carries exactly nothing of an even pressure.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from skfem import MeshQuad2

from fem import plane_mesh as mesh
from fem.model import Inclusion, NotModelled, Probe, Slab, check
from fem.plane_element import Banded, Kind, element_dofs, stiffness
from fem.plane_mesh import Cells, Section

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


def section_of(probe: Probe, slab: Slab, inclusion: Inclusion | None, kind: Kind) -> Section:
    """The half section of these nouns; refuses what two dimensions cannot hold."""
    check(probe, slab, inclusion)
    half = 0.5 if kind == "plane_strain" else np.pi**-0.5
    half_probe = half * probe.width_mm
    if inclusion is None:  # any circle will do: its moduli will be the tissue's
        radius = min(0.15 * slab.thickness_mm, 0.3 * half_probe)
        ball, centre = (radius, radius), min(0.4 * slab.thickness_mm, 0.8 * half_probe)
    else:
        if any(inclusion.offset):
            raise NotModelled(
                f"inclusion.offset: received ({inclusion.offset[0]:g}, {inclusion.offset[1]:g}) mm; "
                "not modelled in two dimensions: off-centre inclusions, allowed (0, 0)"
            )
        a, b, c = inclusion.radii_mm
        if kind == "axisymmetric" and a != b:
            raise NotModelled(
                f"inclusion.stretch: received {inclusion.stretch}; not modelled in axisymmetry: ellipsoids "
                "that are not round about z, allowed equal first and second numbers"
            )
        ball, centre = (a, c), inclusion.centre_mm
    layers = tuple(layer.thickness_mm for layer in probe.layers)
    return Section(
        half_probe, half * slab.width_mm, slab.thickness_mm, layers, probe.dome_radius_mm, ball, centre
    )


@dataclass(frozen=True)
class Body:
    """One elastic body, and how it answers to the pressure of each hat function."""

    place: Floats  # (nodes, 2) mm
    nine: Ints  # (elements, 9)
    material: Ints  # (elements,)
    unknown: Ints  # of each dof 2 * node + axis, -1 where held; (2 nodes,)
    contact: Ints  # nodes of the contact line by rising x; (n,)
    matrices: Floats  # (elements, 18, 18)
    response: Floats  # displacement for 1 kPa along +z on each hat function; (2 nodes, n) mm / kPa


@dataclass(frozen=True)
class Bodies:
    """What press levels share."""

    x: Floats
    mean: Floats  # integrals of hat function j times shape function i; (n, n), of the half section
    area: Floats  # row sums of `mean`; (n,)
    probe: Body
    slabs: tuple[Body, Body]  # with and without inclusion


@lru_cache(maxsize=4)
def bodies_of(probe: Probe, slab: Slab, inclusion: Inclusion | None, kind: Kind, res: Cells) -> Bodies:
    """Mesh and factor the bodies, the slab with and without the inclusion, under `solver.one_thread`."""
    section = section_of(probe, slab, inclusion, kind)
    if probe.width_mm == slab.width_mm:
        res = replace(res, side=0)
    tissue_mesh, probe_mesh = mesh.morph_slab(res, section), mesh.morph_probe(res, section)
    tip = _line(probe_mesh, np.isclose(mesh.probe_topology(res, len(section.layers)).doflocs[1], 0))
    x = probe_mesh.doflocs[0, tip]
    mean = hat_means(x, kind, 0 if section.dome else res.edge)

    modulus = np.array([slab.modulus_kPa, slab.modulus_kPa, *(layer.modulus_kPa for layer in probe.layers)])
    poisson = np.array([slab.poisson, slab.poisson, *(layer.poisson for layer in probe.layers)])
    x_slab, z_slab = tissue_mesh.doflocs
    under = _line(tissue_mesh, np.isclose(z_slab, 0, atol=1e-9) & (x_slab < x[-1] + 1e-9))
    glass = np.isclose(probe_mesh.doflocs[1], -probe.thickness_mm)
    chest = np.isclose(z_slab, slab.thickness_mm)
    sides = np.isclose(x_slab, section.half_slab) & (slab.sides == "symmetric")

    def tissue(modulus: Floats, poisson: Floats) -> Body:
        held = np.stack([chest | sides | (x_slab < 1e-9), chest])
        return _body(tissue_mesh, mesh.slab_materials(res), modulus, poisson, kind, held, under, mean)

    materials = mesh.probe_materials(res, len(section.layers))
    held = np.stack([glass | (probe_mesh.doflocs[0] < 1e-9), glass])
    layered = _body(probe_mesh, materials, modulus, poisson, kind, held, tip, mean)
    without = with_inclusion = tissue(modulus, poisson)
    if inclusion is not None:
        stiff = modulus.copy(), poisson.copy()
        stiff[0][1], stiff[1][1] = inclusion.modulus, inclusion.poisson
        with_inclusion = tissue(*stiff)
    return Bodies(x, mean, mean.sum(axis=1), layered, (with_inclusion, without))


def _line(body: MeshQuad2, on: NDArray[np.bool_]) -> Ints:
    """Nodes where `on` holds, by rising x."""
    nodes = np.flatnonzero(on)
    return np.asarray(nodes[np.argsort(body.doflocs[0, nodes])])


def _body(
    body: MeshQuad2,
    material: Ints,
    modulus: Floats,
    poisson: Floats,
    kind: Kind,
    held: NDArray[np.bool_],
    contact: Ints,
    mean: Floats,
) -> Body:
    """Factor one body and let each hat function press on it; `held` has shape (2, nodes)."""
    matrices = stiffness(body, modulus[material], poisson[material], kind)
    free = ~held.T.ravel()
    unknown = np.where(free, np.cumsum(free) - 1, -1)
    load = np.zeros((len(free), len(contact)))
    load[2 * contact + 1] = mean.T
    response = np.zeros_like(load)
    response[free] = Banded(matrices, unknown[element_dofs(body)]).solve(load[free])
    nine = body.dofs.element_dofs.T.astype(np.int64)
    return Body(body.doflocs.T, nine, material, unknown, contact, matrices, response)


def hat_means(x: Floats, kind: Kind, lumped: int) -> Floats:
    """Integrals over the contact line of hat function j times quadratic shape function i.

    Next to the singularity at a flat probe's edge the hats would ring (as a consistent mass does in
    `fem.surface.pressure`), so there Simpson's rule lumps them to the nodes.

    Parameters
    ----------
    x
        Nodes of a line of quadratic elements, mm, shape (n,), n odd, from the axis.
    kind
        Integrals are over the whole ring in axisymmetry, over this side of the axis in plane strain.
    lumped
        How many elements, the outermost ones, are lumped.

    Returns
    -------
    (n, n) array indexed j, i; mm² per mm or mm². Its rows sum to the hat functions' areas.
    """
    point, weight = np.polynomial.legendre.leggauss(3)  # exact to degree 5; the highest is 4
    out = np.zeros((len(x), len(x)))
    for i in range(0, len(x) - 2, 2):
        length = x[i + 2] - x[i]
        for half in (0, 1):
            s = (half + (1 + point) / 2) / 2  # along the element
            shape = np.stack([(1 - s) * (1 - 2 * s), 4 * s * (1 - s), s * (2 * s - 1)])
            hat = np.clip(1 - np.abs(2 * s - np.arange(3)[:, None]), 0, 1)
            ring = 1.0 if kind == "plane_strain" else 2 * np.pi * (x[i] + s * length)
            part = weight * ring * length / 4
            if i < len(x) - 1 - 2 * lumped:
                out[i : i + 3, i : i + 3] += (hat * part) @ shape.T
            else:
                out[range(i, i + 3), range(i, i + 3)] += shape @ part
    return out
