"""The unknowns of a press: which node moves how, what is tied, what is held; and its unit solution.

The probe and the slab are two meshes. Frictionless contact that stays closed is a tie of the normal
displacement alone: the probe's contact nodes share their z unknown with the slab's nodes under them, x and y
stay free of each other. Everything is solved in the probe's frame for one millimetre of indentation: the
glass at rest, the chest wall moving by -1 mm in z; linear elasticity scales the rest.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fem import elasticity, mesh, solver
from fem.mesh import Resolution
from fem.model import Inclusion, Probe, Slab

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class System:
    """Topology of a press; fixed by resolution and number of layers. Probe nodes follow slab nodes."""

    local: Ints  # dof 3 * node + axis of each element's local dofs; (elements, 81)
    dofs: Ints  # its unknown, -1 where held; (elements, 81)
    unknown: Ints  # unknown of each dof 3 * node + axis, -1 where held; (3 nodes,)
    chest: Ints  # slab nodes on the chest wall
    contact: Ints  # slab nodes of the footprint as a grid, (2 n + 1, 2 n + 1), x along the first axis
    tip: Ints  # the probe's nodes on them
    material: Ints  # 0 tissue, 1 inclusion, 2, 3, ... layers; (elements,)
    slab_elements: int
    slab_nodes: int
    tree: solver.Tree


@lru_cache(maxsize=8)
def system(res: Resolution, layers: int) -> System:
    """Number the unknowns and plan their elimination."""
    slab, probe = mesh.slab_topology(res), mesh.probe_topology(res, layers)
    place = np.hstack([slab.doflocs, probe.doflocs])
    split = slab.doflocs.shape[1]
    in_slab = np.arange(place.shape[1]) < split
    x, y, z = place
    chest = np.flatnonzero(in_slab & (z == z[in_slab].max()))
    glass = np.flatnonzero(~in_slab & (z == z[~in_slab].min()))
    rim = x[~in_slab].max()
    under = np.flatnonzero(in_slab & (z == z[in_slab].min()) & (x < rim + 1e-9) & (y < rim + 1e-9))
    touch = np.flatnonzero(~in_slab & (z == 0))
    contact, tip = (_as_grid(nodes, place) for nodes in (under, touch))

    held = np.zeros((place.shape[1], 3), dtype=bool)
    held[chest] = held[glass] = True
    held[np.abs(x) < 1e-9, 0] = True
    held[np.abs(y) < 1e-9, 1] = True
    master = np.arange(held.size).reshape(held.shape)
    master[tip, 2] = master[contact, 2]
    free = np.zeros(held.size, dtype=bool)
    free[master[~held]] = True
    number = np.where(free, np.cumsum(free) - 1, -1)
    unknown = number[master].ravel()

    local = np.vstack([elasticity.element_dofs(slab), elasticity.element_dofs(probe) + 3 * split])
    material = np.concatenate([mesh.slab_materials(res), mesh.probe_materials(res, layers)])
    drop = slab.p[2].min()  # hang the probe on the slab, so that neighbours are neighbours
    middles = [m.p[:, m.t].mean(axis=1) for m in (slab, probe)]
    middles[1][2] += drop
    centres = np.hstack(middles).T
    tree = solver.plan(unknown[local], centres, material == 1)
    return System(local, unknown[local], unknown, chest, contact, tip, material, slab.t.shape[1], split, tree)


def _as_grid(nodes: Ints, place: Floats) -> Ints:
    """Nodes of a plane z = constant that form a tensor grid, as an array indexed by x, then y."""
    order = np.lexsort((np.round(place[1, nodes], 6), np.round(place[0, nodes], 6)))
    side = round(len(nodes) ** 0.5)
    return nodes[order].reshape(side, side)


@dataclass(frozen=True)
class Unit:
    """Solution for one millimetre of indentation, quarter model, probe's frame."""

    displacement: Floats  # (nodes, 3), mm per mm
    reaction: Floats  # force of the probe on the slab at each node of `contact`, mN per mm, positive pressing
    chest: float  # force of the slab on the quarter of the chest wall, mN per mm, positive pressing


@dataclass(frozen=True)
class Solution:
    """Unit solutions on one mesh with and without the inclusion."""

    system: System
    place: Floats  # (nodes, 3) undeformed, mm
    with_inclusion: Unit
    without: Unit


def solve(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    res: Resolution,
    progress: Callable[[str, float], None] = lambda stage, fraction: None,
) -> Solution:
    """Solve with and without the inclusion on the mesh that fits it; call it under `solver.one_thread`."""
    progress("mesh", 0.0)
    box = mesh.box_around(inclusion, probe, slab)
    slab_mesh, probe_mesh = mesh.morph_slab(res, box, probe, slab), mesh.morph_probe(res, box, probe, slab)
    progress("plan", 0.03)
    sys = system(res, len(probe.layers))
    place = np.hstack([slab_mesh.doflocs, probe_mesh.doflocs]).T

    progress("stiffness", 0.1)
    modulus = np.array([slab.modulus_kPa, slab.modulus_kPa, *(layer.modulus_kPa for layer in probe.layers)])
    poisson = np.array([slab.poisson, slab.poisson, *(layer.poisson for layer in probe.layers)])
    cut = sys.slab_elements
    parts = ((slab_mesh, sys.material[:cut]), (probe_mesh, sys.material[cut:]))
    matrices = np.concatenate([elasticity.stiffness(m, modulus[of], poisson[of]) for m, of in parts])
    progress("factorise", 0.25)
    factor = solver.Factor(sys.tree, matrices, progress=lambda f: progress("factorise", 0.25 + 0.6 * f))
    progress("solve", 0.85)
    without = _unit(sys, factor)
    if inclusion is None:
        progress("done", 1.0)
        return Solution(sys, place, without, without)
    progress("inclusion", 0.9)
    ball = np.flatnonzero(sys.material == 1)
    stiff = np.full(len(ball), inclusion.modulus), np.full(len(ball), inclusion.poisson)
    matrices = matrices.copy()
    matrices[ball] = elasticity.stiffness(slab_mesh, *stiff, elements=ball)
    unit = _unit(sys, solver.Factor(sys.tree, matrices, base=factor))
    progress("done", 1.0)
    return Solution(sys, place, unit, without)


def _unit(sys: System, factor: solver.Factor) -> Unit:
    """Lower the chest wall by one millimetre onto the probe."""
    held = np.zeros(len(sys.unknown))
    held[3 * sys.chest + 2] = -1.0
    x = factor.solve(-_scatter(sys, factor.matrices, held)[0])
    full = np.where(sys.unknown >= 0, np.append(x, 0.0)[sys.unknown], held)
    force = _scatter(sys, factor.matrices, full)[1]
    return Unit(full.reshape(-1, 3), force[sys.contact, 2], -float(force[sys.chest, 2].sum()))


def _scatter(sys: System, matrices: Floats, full: Floats) -> tuple[Floats, Floats]:
    """Internal forces of a displacement: on the unknowns (unknowns,), of the slab on its nodes (nodes, 3)."""
    force = (matrices @ full[sys.local][:, :, None])[:, :, 0]
    free = sys.dofs >= 0
    total = np.bincount(sys.dofs[free], weights=force[free], minlength=sys.tree.size)
    cut = sys.slab_elements
    slab = np.bincount(sys.local[:cut].ravel(), weights=force[:cut].ravel(), minlength=3 * sys.slab_nodes)
    return np.asarray(total, dtype=float), np.asarray(slab, dtype=float).reshape(-1, 3)
