"""The solves that an emulator learns from: what is kept of each.

Everything scales with the tissue's modulus, so the inclusion's enters as the contrast c with it. A sphere's
signal goes as s = (c - 1) / (c + 1.5) (Eshelby 1957; [eshelby1957]); what is left of c after that is a
polynomial in s through few nodes, and all of them share one factor at small strain.

Finite strain costs many times more, and adds some per cent to the signal that depend little on the mesh: it
is learned apart, as the difference that it makes on a coarse mesh, from fewer specimens with one modulus
each. All press levels lie on one way down; between them and small strain, which is level 0, the answers per
mm are a polynomial in the indentation.

What a mesh of standard quality adds to either is smoother still, and learned from a few centred specimens.

Meshes that follow the inclusion leave ripples in what it adds: a per cent or two of it, which change with its
size and depth, and tell these from its modulus better than the press itself does. So small strain is told by
multipoles in plain tissue, whose mesh stays, wherever these reach (`fem.spheres`); and since finite strain
makes of the mesh's error what it makes of the signal, so many times the error at small strain is taken from
what finite strain adds (a control variate).

Contact pressures are kept as their *rise* over the tissue without inclusion, on the same mesh and at the same
level: next to the probe's edge both follow the same singularity, and so does their discretisation error. In
the rise both cancel.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fem.ground import bare_geometry, cubic, ground
from fem.ground import lines as grid_lines
from fem.lines import lines, logical_lines
from fem.mesh import Geometry
from fem.meshed import build
from fem.model import Inclusion, Probe, Slab, check
from fem.path import path
from fem.ripples import expanded, without_ripples
from fem.sampling import Plan
from fem.solver import one_thread
from fem.spheres import Multipoles, multipoles
from fem.tared import tared, tared_at_rest
from fem.topology import Resolution
from fem.wrinkles import refuse_wrinkles

Floats = NDArray[np.float64]


def geometry_at(plan: Plan, point: Floats, modulus: float) -> Geometry:
    """Geometry of a point of the plan, with an inclusion of a modulus, kPa."""
    size, depth, x, y, thickness, tissue = (float(v) for v in point[:6])
    slab = plan.slab(thickness, tissue)
    inclusion = Inclusion(size, depth, modulus, (x, y), plan.inner_poisson)
    check(plan.probe, slab, inclusion)
    return Geometry(plan.probe, slab, inclusion)


def solve(plan: Plan, point: Floats) -> dict[str, Floats]:
    """Solve one point for all moduli at small strain.

    Returns
    -------
    `rise` (moduli, n, n): pressure over the same without inclusion, in units of the latter; `moved` (moduli,
    n, n, 3): tared displacement per mm of indentation.
    """
    if plan.degree:
        return _expanded(plan, point, plan.ratios, plan.resolution)
    geometries = [geometry_at(plan, point, float(r * point[5])) for r in plan.ratios]
    with one_thread():
        model = build(geometries[0], plan.resolution, False)
        bare = path(geometries[0], model, False)
        found = [tared_at_rest(g, path(g, model, True, bare), bare) for g in geometries]
    return {name: np.stack([f[k] for f in found]) for k, name in enumerate(("rise", "moved"))}


def refine(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What the finer mesh adds under the probe's middle, where symmetry makes it cheap.

    Returns
    -------
    `rise` (moduli, k, k) and `moved` (moduli, k, k, 3) as of `solve`, at the fine mesh's nodes, less what is
    carried there from the lean one's: what cubic splines through so few nodes are off by, three times what
    the solves are, is in it.
    """
    point = _centred(point)
    if plan.degree:  # these are fine as they are
        n = len(logical_lines(plan.fine))
        return {"rise": np.zeros((len(plan.ratios), n, n)), "moved": np.zeros((len(plan.ratios), n, n, 3))}
    meshes = plan.resolution, plan.fine
    return _gain(plan, point, meshes, [solve(replace(plan, resolution=res), point) for res in meshes])


def stretch(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What finite strain adds on the coarse mesh, for the point's own s, to small strain.

    Returns
    -------
    `rise` (levels, k, k) and `moved` (levels, k, k, 3) as of `solve`, finite minus small strain, for the
    levels but 0.

    Raises
    ------
    NotConverged, NotModelled
        If no equilibrium is found at one of the levels, or only one whose contact has wrinkled.
    """
    ratio = (1 + 1.5 * point[6]) / (1 - point[6])
    geometry, res = geometry_at(plan, point, float(ratio * point[5])), plan.coarse
    with one_thread():
        model = build(geometry, res, True)
        bare = path(geometry, model, False)
        full = path(geometry, model, True, bare)
        small = tared_at_rest(geometry, full, bare)
        found = [tared(geometry, (full.to(level), bare.to(level))) for level in plan.levels[1:].tolist()]
    for level, (rise, _) in zip(plan.levels[1:].tolist(), found, strict=True):
        refuse_wrinkles(rise, small[0], level)
    whole, true = [np.stack([f[k] for f in found]) for k in range(2)], small
    if plan.degree:
        smooth = _expanded(plan, point, np.array([ratio]), res)
        true = smooth["rise"][0], smooth["moved"][0]
        x = lines(geometry, res)
        whole = [without_ripples(*fields, x) for fields in zip(whole, small, true, strict=True)]
    return {name: whole[k] - true[k] for k, name in enumerate(("rise", "moved"))}


def refine_stretch(plan: Plan, point: Floats) -> dict[str, Floats]:
    """What the fine mesh adds to what finite strain adds, as `refine` says it.

    Returns
    -------
    `rise` (levels, k, k) and `moved` (levels, k, k, 3) as of `stretch`, at the fine mesh's nodes.
    """
    point = _centred(point)
    meshes = plan.coarse, plan.fine
    return _gain(plan, point, meshes, [stretch(replace(plan, coarse=res), point) for res in meshes])


def _expanded(plan: Plan, point: Floats, ratios: Floats, res: Resolution) -> dict[str, Floats]:
    """`solve` by multipoles, for inclusions of so many times the tissue's modulus, at the nodes of a mesh."""
    geometry = geometry_at(plan, point, 1.0)
    moduli = [float(ratio * point[5]) for ratio in ratios]
    assert geometry.inclusion is not None
    tissue = _tissue(plan.probe, geometry.slab, plan.degree)
    rise, moved = expanded(tissue, geometry.inclusion, moduli, lines(geometry, res))
    return {"rise": rise, "moved": moved}


@lru_cache(maxsize=1)
def _tissue(probe: Probe, slab: Slab, degree: int) -> Multipoles:
    """Plain tissue, kept for the specimens that share it."""
    return multipoles(probe, slab, degree=degree)


def _centred(point: Floats) -> Floats:
    return np.array([*point[:2], 0.0, 0.0, *point[4:]])


def _gain(
    plan: Plan, point: Floats, meshes: tuple[Resolution, Resolution], found: list[dict[str, Floats]]
) -> dict[str, Floats]:
    """Fields of the second mesh at its nodes, less those of the first one carried there."""
    geometry = geometry_at(plan, point, 1.0)
    nodes = [lines(geometry, res)[0] for res in meshes]
    onto, (less, more) = cubic(*nodes), found

    def gain(name: str) -> Floats:
        carried = np.einsum("ai,cij...,bj->cab...", onto, less[name], onto, optimize=True)
        return np.asarray(more[name] - carried)

    return {name: gain(name) for name in ("rise", "moved")}


def background(plan: Plan, thickness: float, tissue: float) -> dict[str, Floats]:
    """Press on plain tissue, on the grid that answers are given on.

    Returns
    -------
    Lines `x` (m,); `pressure` (levels, m, m) per kPa of the tissue and mm of indentation; `moved` (levels, m,
    m, 3), displacement per mm of indentation.
    """
    geometry, levels = (
        bare_geometry(plan.probe, plan.slab(thickness, tissue)),
        tuple(plan.levels[1:].tolist()),
    )
    found = [(1.0, *ground(geometry, plan.fine, False, (1.0,)))]
    if plan.finite:
        found += zip(levels, ground(geometry, plan.fine, True, levels), strict=True)
    x = grid_lines(found[0][1])[0]
    pressure, moved = (
        np.stack([np.asarray(surface[name], dtype=float) / level for level, surface in found])
        for name in ("pressure", "displacement")
    )
    shape = (len(found), x.size, x.size)
    return {"x": x, "pressure": pressure.reshape(shape) / tissue, "moved": moved.reshape(*shape, 3)}
