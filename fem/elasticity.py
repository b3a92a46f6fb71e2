"""Forces and tangent stiffness of the 27-node hexahedron: neo-Hookean, nearly incompressible, not locking.

Stored energy per undeformed volume

    W = mu/2 (J^(-2/3) tr C - 3) + kappa/2 (J - 1)² + c/4 (J - 1)⁴,

mu = E / 2(1 + nu), kappa = E / 3(1 - 2 nu) (Bonet and Wood 2008, section 6.5; [bonet2008]), c = min(kappa, 50
mu). The quartic term is 1e-4 of the volumetric energy where J differs from 1 by 1 %; it is there for elements
at the probe's corners, whose J strays by tens of per cent round a projection that is right, until they tear.
The quadratic part is projected element by element onto 1, x, y, z: a discontinuous linear pressure p,
condensed out, which with quadratic displacements is stable up to incompressibility (Boffi, Brezzi and Fortin
2013, section 8.6; [boffi2013]) and leaves the displacements as the only unknowns. At zero displacement
the tangent is the stiffness of linear elasticity.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import DTypeLike, NDArray

from fem.quadrature import BY_REFERENCE, DOFS, NODES, Quadrature

Floats = NDArray[np.float64]

_GUARD = 50.0  # shear moduli at most
_CHUNK = 128  # elements at a time


class Inverted(ArithmeticError):
    """An element has turned inside out: the step was too long."""


def lame(modulus: Floats, poisson: Floats) -> tuple[Floats, Floats]:
    """Shear and bulk modulus from Young's modulus and Poisson's ratio; all shape (n,), kPa."""
    return modulus / (2 * (1 + poisson)), modulus / (3 * (1 - 2 * poisson))


def chunks(elements: int) -> Iterator[slice]:
    """Parts of all elements, each so few that its temporaries stay in the cache."""
    return (slice(start, min(start + _CHUNK, elements)) for start in range(0, elements, _CHUNK))


def _deform(quad: Quadrature, part: slice, moved: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Gradients (n, 3, 27, q), deformation gradient F (n, q, 3, 3), its inverse and determinant."""
    gradient = quad.gradient(part)
    local = moved[quad.nodes[part]].transpose(0, 2, 1)  # (n, 3 components, 27)
    # F[a, b] = delta + du_a / dX_b
    slope = local[:, None] @ gradient  # (n, 3 b, 3 a, q)
    f = slope.transpose(0, 3, 2, 1) + np.eye(3)
    # the inverse by cofactors: many times faster than LAPACK on 3 x 3
    inverse = np.empty_like(f)
    for i in range(3):
        for j in range(3):
            a, b, c, d = (i + 1) % 3, (i + 2) % 3, (j + 1) % 3, (j + 2) % 3
            inverse[..., j, i] = f[..., a, c] * f[..., b, d] - f[..., a, d] * f[..., b, c]
    det = (f[..., 0, :] * inverse[..., :, 0]).sum(axis=-1)
    if not det.min(initial=1.0) > 0:
        raise Inverted
    inverse /= det[..., None, None]
    return gradient, f, inverse, det


def slopes(quad: Quadrature, moved: Floats) -> Floats:
    """Displacement gradients du_a / dX_b at the quadrature points, (m, q, 3, 3)."""
    local = moved[quad.nodes].transpose(0, 2, 1)
    return np.asarray((local[:, None] @ quad.gradient(slice(None))).transpose(0, 3, 2, 1))


def _project(quad: Quadrature, part: slice, change: Floats) -> Floats:
    """Projection of a change of volume (n, q) onto the pressure's modes, (n, 4) mm^3/2."""
    return np.asarray((quad.modes[part] @ (quad.weight[part] * change)[:, :, None])[..., 0])


def _pressure(quad: Quadrature, part: slice, volume: Floats, bulk: Floats) -> Floats:
    """Volumetric stress p of a projected change of volume (n, 4), tension positive, kPa; shape (n, q)."""
    return np.asarray(bulk[:, None] * (volume[:, None] @ quad.modes[part])[:, 0])


def volumes(quad: Quadrature, moved: Floats, change: Floats) -> Floats:
    """Each element's projected change of volume J - 1 after a change of the displacements, if it were linear.

    Parameters
    ----------
    moved, change
        Displacement of the nodes, and its change, (nodes, 3) mm.

    Returns
    -------
    (m, 4) array, mm^3/2: of the modes 1, x, y, z, orthonormal in the element.
    """
    out = np.empty((quad.size, 4))
    for part in chunks(quad.size):
        gradient, _, inverse, det = _deform(quad, part, moved)
        local = change[quad.nodes[part]].transpose(0, 2, 1)
        slope = (local[:, None] @ gradient).transpose(0, 3, 1, 2)  # (n, q, b, a): of du_a along X_b
        rate = det * np.einsum("nqba,nqba->nq", inverse, slope)
        out[part] = _project(quad, part, det - 1 + rate)
    return out


def _guard(shear: Floats, bulk: Floats) -> Floats:
    """c of the quartic volumetric energy, kPa."""
    return np.minimum(bulk, _GUARD * shear)


def _deviator(f: Floats, det: Floats, shear: Floats) -> tuple[Floats, Floats]:
    """Deviatoric Kirchhoff stress mu J^(-2/3) dev b (n, q, 3, 3) and mu J^(-2/3) tr b / 3 (n, q), kPa."""
    scale = shear[:, None] * det ** (-2 / 3)
    b = (f @ f.transpose(0, 1, 3, 2)) * scale[..., None, None]
    mean = np.trace(b, axis1=2, axis2=3) / 3
    b -= mean[..., None, None] * np.eye(3)
    return b, mean


def forces(quad: Quadrature, moved: Floats, shear: Floats, bulk: Floats) -> tuple[Floats, float]:
    """Internal forces of each element, and the energy that all store.

    Parameters
    ----------
    moved
        Displacement of the nodes, (nodes, 3) mm.
    shear, bulk
        Moduli of each element, (m,) kPa.

    Returns
    -------
    (m, 27, 3) array, mN, the derivative of the energy, µJ.

    Raises
    ------
    Inverted
        Where a volume is not positive.
    """
    out, energy = np.empty((quad.size, NODES, 3)), 0.0
    for part in chunks(quad.size):
        at = points(quad, moved, shear[part], bulk[part], part)
        energy += float((quad.weight[part] * at.stored).sum())
        # first Piola-Kirchhoff stress, weighted
        piola = at.piola * quad.weight[part][..., None, None]
        n, q = at.det.shape
        flat = at.gradient.transpose(0, 2, 1, 3).reshape(n, NODES, 3 * q)
        out[part] = flat @ piola.transpose(0, 3, 1, 2).reshape(n, 3 * q, 3)
    return out, energy


@dataclass(frozen=True)
class Points:
    """At the quadrature points of n elements: gradients of the shape functions (n, 3, 27, q), F (n, q, 3, 3)
    and its determinant (n, q), projected pressure (n, q) kPa, first Piola-Kirchhoff stress P = tau F^-T (n,
    q, 3, 3) kPa, energy per undeformed volume (n, q) kPa."""

    gradient: Floats
    f: Floats
    det: Floats
    pressure: Floats
    piola: Floats
    stored: Floats


def points(quad: Quadrature, moved: Floats, shear: Floats, bulk: Floats, part: slice = slice(None)) -> Points:
    """State of a part of the elements, of few; `shear` and `bulk` (n,) are theirs, kPa."""
    gradient, f, inverse, det = _deform(quad, part, moved)
    stress, mean = _deviator(f, det, shear)
    pressure = _pressure(quad, part, _project(quad, part, det - 1), bulk)
    guard = _guard(shear, bulk)[:, None] * (det - 1) ** 3
    # half p (J - 1) integrates to the projected energy, since p is in the space projected onto
    stored = 1.5 * (mean - shear[:, None]) + (0.5 * pressure + 0.25 * guard) * (det - 1)
    stress += ((pressure + guard) * det)[..., None, None] * np.eye(3)
    return Points(gradient, f, det, pressure, stress @ inverse.transpose(0, 1, 3, 2), stored)


def linear_forces(quad: Quadrature, local: Floats, shear: Floats, bulk: Floats) -> Floats:
    """Forces at small strain: the product of the stiffness at rest with displacements, without the former.

    Parameters
    ----------
    local
        Displacements of each element's nodes, (m, 27, 3) mm.
    shear, bulk
        Moduli of each element, (m,) kPa.

    Returns
    -------
    (m, 27, 3) array, mN.
    """
    out = np.empty_like(local)
    for part in chunks(quad.size):
        inverse, weight, modes = quad.inverse[part], quad.weight[part], quad.modes[part]
        n, q = weight.shape
        slope = inverse @ (BY_REFERENCE @ local[part]).reshape(n, q, 3, 3)  # du_b / dx_a at [a, b]
        volume = np.trace(slope, axis1=2, axis2=3)
        share = (modes @ (weight * volume)[:, :, None]).transpose(0, 2, 1)
        pressure = bulk[part][:, None] * (share @ modes)[:, 0]
        mu = shear[part][:, None]
        stress = mu[..., None, None] * (slope + slope.swapaxes(2, 3))
        for a in range(3):
            stress[..., a, a] += pressure - (2 / 3) * mu * volume
        stress *= weight[..., None, None]
        back = (inverse.swapaxes(2, 3) @ stress).reshape(n, 3 * q, 3)
        out[part] = BY_REFERENCE.T @ back
    return out


def largest(quad: Quadrature, shear: Floats, bulk: Floats) -> float:
    """The largest entry of all elements' stiffness at rest, kPa mm: one of a diagonal, as it is definite."""
    found = 0.0
    for part in chunks(quad.size):
        gradient, weight = quad.gradient(part), quad.weight[part]  # (n, 3, 27, q)
        square = (gradient**2 * (shear[part][:, None] * weight)[:, None, None]).sum(axis=3)
        change = gradient @ (weight[:, None] * quad.modes[part])[:, None].swapaxes(2, 3)
        volume = bulk[part][:, None, None] * (change**2).sum(axis=3)
        found = max(found, float((square.sum(axis=1, keepdims=True) + square / 3 + volume).max()))
    return found


def stiffness(
    quad: Quadrature,
    shear: Floats,
    bulk: Floats,
    moved: Floats | None = None,
    elements: NDArray[np.int64] | None = None,
    dtype: DTypeLike = np.float64,
    volume: Floats | None = None,
) -> NDArray[np.floating]:
    """Tangent stiffness of each element, the derivative of `forces`.

    With `volume`, its pressure is that of another change of volume than the displacements': so the tangent of
    the mixed form, in which the pressure is an unknown of its own, is had without one (Magisano, Leonetti and
    Garcea 2017; [magisano2017]).

    Parameters
    ----------
    shear, bulk
        Moduli of each of the elements asked for, (n,) kPa.
    moved
        Displacement of the nodes, (nodes, 3) mm; at rest by default.
    elements
        Which elements, (n,); all of them by default.
    dtype
        Of the result and of most of the work.
    volume
        Projected change of volume of each of the elements asked for, (n, 4) mm^3/2, as of `volumes`.

    Returns
    -------
    (n, 81, 81) array, kPa mm = mN / mm, local dof = 3 * node + axis, symmetric.
    """
    if elements is not None:
        quad = quad.part(elements)
    out = np.empty((quad.size, DOFS, DOFS), dtype)
    still = np.zeros((int(quad.nodes.max()) + 1, 3)) if moved is None else moved
    for part in chunks(quad.size):
        some = None if volume is None else volume[part]
        _stiffness(quad, part, still, shear[part], bulk[part], some, out[part])
    return out


def _stiffness(
    quad: Quadrature,
    part: slice,
    moved: Floats,
    shear: Floats,
    bulk: Floats,
    volume: Floats | None,
    out: NDArray[np.floating],
) -> None:
    gradient, f, inverse, det = _deform(quad, part, moved)
    n, q = det.shape
    weight = quad.weight[part]
    stress, mean = _deviator(f, det, shear)
    if volume is None:
        volume = _project(quad, part, det - 1)
    pressure = (_pressure(quad, part, volume, bulk) + _guard(shear, bulk)[:, None] * (det - 1) ** 3) * det
    guard = 3 * _guard(shear, bulk)[:, None] * ((det - 1) * det) ** 2
    kind = out.dtype
    # spatial gradients g = F^-T grad N: (n, 27, 3, q), then flat as (n, 81, q), dof = 3 * node + axis
    spatial = np.einsum("nqba,nbiq->niaq", inverse, gradient, optimize=True)
    flat = spatial.reshape(n, DOFS, q).astype(kind)

    # delta_ab g_i . b g_j equals delta_ab grad N_i . grad N_j: material and geometric part in one
    root = np.sqrt(weight * shear[:, None] * det ** (-2 / 3))
    plain = (gradient * root[:, None, None]).transpose(0, 2, 1, 3).reshape(n, NODES, 3 * q).astype(kind)
    trace = plain @ plain.transpose(0, 2, 1)

    # (mean - pJ) g_ib g_ja
    crossed = (flat * (weight * (mean - pressure))[:, None].astype(kind)) @ flat.transpose(0, 2, 1)
    k = crossed.reshape(n, NODES, 3, NODES, 3).transpose(0, 1, 4, 3, 2).reshape(n, DOFS, DOFS)
    # h_ia g_jb + g_ia h_jb with h = (-2/3 tau_dev + (pJ - 2/3 mean + J² dq/dJ)/2) g
    tensor = (-2 / 3) * stress + (0.5 * (pressure - (2 / 3) * mean + guard))[..., None, None] * np.eye(3)
    h = np.einsum("nqab,nibq->niaq", tensor * weight[..., None, None], spatial, optimize=True)
    mixed = h.reshape(n, DOFS, q).astype(kind) @ flat.transpose(0, 2, 1)
    k = k + mixed + mixed.transpose(0, 2, 1)
    # kappa B^T B with B the projected change of volume
    coupling = (quad.modes[part] * (weight * det)[:, None]).astype(kind) @ flat.transpose(0, 2, 1)
    coupling *= np.sqrt(bulk)[:, None, None].astype(kind)
    k += coupling.transpose(0, 2, 1) @ coupling
    for a in range(3):
        k[:, a::3, a::3] += trace
    out[:] = 0.5 * (k + k.transpose(0, 2, 1))
