"""Displacement fields around a point that balance in an elastic solid, and what a sphere makes of them.

Every such field is a sum of three kinds, each made of a solid harmonic f of degree p (p = l of regular ones,
-(l + 1) of singular ones; Love 1927, sections 172 and 173; [love1927]):

    gradient     grad f,
    dilating     r² grad f + a x f,   a = -2 (3 p + 1 - 4 nu p - 2 nu) / (p + 5 - 4 nu),               (1)
    twisting     x cross grad f.

A bonded sphere of other moduli in a regular field answers with singular ones of the same kind of harmonic:
continuity of displacement and traction are four equations for each l, two of twisting fields (`answer`). A
uniform field is l = 0 and 2, and the answer Eshelby's (1957; [eshelby1957]).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from fem.harmonics import Harmonic, Jet, harmonics, regular, singular

Floats = NDArray[np.float64]
Kind = Literal["gradient", "dilating", "twisting"]
KINDS: tuple[Kind, ...] = get_args(Kind)

_CROSS = np.zeros((3, 3, 3))
for _a, _b, _c in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
    _CROSS[_a, _b, _c], _CROSS[_a, _c, _b] = 1.0, -1.0


@dataclass(frozen=True)
class Field:
    """One field: its kind, and its harmonic."""

    kind: Kind
    of: Harmonic


def fields(degree: int, symmetric: tuple[bool, bool]) -> tuple[Field, ...]:
    """Regular fields of harmonics up to a degree that have the symmetries x -> -x, y -> -y; with both, also
    x <-> y, as under a square probe. Twisting fields are of harmonics of the opposite parity."""
    found = []
    for one in harmonics(degree):
        mirrors = [one.parity(axis) for axis in (0, 1) if symmetric[axis]]
        mirrors += [one.swapped] if all(symmetric) else []
        if all(sign == 1 for sign in mirrors):
            found += [Field("gradient", one)] if one.degree else []
            found += [Field("dilating", one)]
        if all(sign == -1 for sign in mirrors) and one.degree:
            found += [Field("twisting", one)]
    return tuple(found)


def answering(degree: int, symmetric: tuple[bool, bool]) -> tuple[Field, ...]:
    """Singular fields that a sphere, which exerts neither force nor torque, answers with."""
    point = (Field("gradient", Harmonic(0, 0, False)),)
    return point + tuple(
        one
        for one in fields(degree, symmetric)
        if one.of.degree > 1 or (one.of.degree == 1 and one.kind == "gradient")
    )


def _ratio(power: NDArray[np.int64] | int, poisson: float) -> Floats:
    """a of (1)."""
    p = np.asarray(power)
    return np.asarray(-2 * (3 * p + 1 - 4 * poisson * p - 2 * poisson) / (p + 5 - 4 * poisson))


def displacements(some: tuple[Field, ...], at: Floats, poisson: float, outer: bool) -> Floats:
    """Displacements (n, k, 3) of k fields at places (n, 3); `outer`: of the singular ones."""
    found = np.empty((len(at), len(some), 3))
    for kind, mine, jet, a in _kinds(some, at, poisson, outer):
        x = at[:, None, :]
        if kind == "gradient":
            found[:, mine] = jet.slope
        elif kind == "dilating":
            found[:, mine] = (x**2).sum(axis=-1, keepdims=True) * jet.slope + (a * jet.value)[..., None] * x
        else:
            found[:, mine] = np.cross(x, jet.slope)
    return found


def gradients(some: tuple[Field, ...], at: Floats, poisson: float, outer: bool) -> Floats:
    """Gradients d u_i / d x_j of the same, (n, k, 3, 3) at [i, j]."""
    found = np.empty((len(at), len(some), 3, 3))
    for kind, mine, jet, a in _kinds(some, at, poisson, outer):
        x, second = at[:, None, :], jet.second()
        if kind == "gradient":
            found[:, mine] = second
        elif kind == "dilating":
            part = (2 * jet.slope)[..., :, None] * x[..., None, :]
            part += (x**2).sum(axis=-1)[..., None, None] * second
            part += x[..., :, None] * (a[:, None] * jet.slope)[..., None, :]
            part[..., [0, 1, 2], [0, 1, 2]] += (a * jet.value)[..., None]
            found[:, mine] = part
        else:
            found[:, mine] = np.einsum("ijb,nkb->nkij", _CROSS, jet.slope)
            found[:, mine] += np.einsum("iab,na,nkbj->nkij", _CROSS, at, second, optimize=True)
    return found


def _kinds(
    some: tuple[Field, ...], at: Floats, poisson: float, outer: bool
) -> Iterator[tuple[Kind, list[int], Jet, Floats]]:
    """Each kind that occurs: which fields, their harmonics at the places, and a of (1)."""
    for kind in KINDS:
        mine = [k for k, one in enumerate(some) if one.kind == kind]
        if mine:
            of = tuple(some[k].of for k in mine)
            degree = np.array([one.degree for one in of])
            power = -degree - 1 if outer else degree
            yield kind, mine, (singular if outer else regular)(of, at), _ratio(power, poisson)


def tractions(change: Floats, normal: Floats, shear: float, poisson: float) -> Floats:
    """Tractions (n, k, 3) on faces with normals (n, 3) of displacement gradients (n, k, 3, 3), in shear's
    unit."""
    both = np.einsum("nkij,nj->nki", change + change.swapaxes(-1, -2), normal)
    first = 2 * shear * poisson / (1 - 2 * poisson)
    dilation = np.trace(change, axis1=-2, axis2=-1)
    return np.asarray(shear * both + first * dilation[..., None] * normal[:, None, :])


def _at_rim(kind: Kind, degree: int, outer: bool, shear: float, poisson: float) -> list[float]:
    """Radial and tangential displacement and traction on the unit sphere, per harmonic and its slope along
    the sphere; of a twisting field displacement and traction across it."""
    p = -degree - 1 if outer else degree
    if kind == "twisting":
        return [1.0, shear * (p - 1)]
    a = 0.0 if kind == "gradient" else float(_ratio(p, poisson))
    q = p - 1 if kind == "gradient" else p + 1  # the power of r in the displacement
    radial, along = p + a, 1.0
    first = 2 * shear * poisson / (1 - 2 * poisson)
    dilation = q * radial + 2 * radial - degree * (degree + 1) * along
    return [radial, along, first * dilation + 2 * shear * q * radial, shear * ((q - 1) * along + radial)]


def answer(
    given: tuple[Field, ...],
    back: tuple[Field, ...],
    tissue: tuple[float, float],
    sphere: tuple[float, float],
) -> Floats:
    """What a unit sphere answers regular fields with, (len(back), len(given)).

    tissue, sphere: shear modulus and Poisson's ratio of each.
    """
    found = np.zeros((len(back), len(given)))
    places = {one: k for k, one in enumerate(back)}
    for column, one in enumerate(given):
        degree = one.of.degree
        inside: tuple[Kind, ...] = ("twisting",) if one.kind == "twisting" else ("gradient", "dilating")
        outside, rows = inside, list(range(2 * len(inside)))
        if degree == 0:  # no gradient within, no dilating field outside, nothing along the sphere
            inside, outside, rows = ("dilating",), ("gradient",), [0, 2]
        known = np.array(_at_rim(one.kind, degree, False, *tissue))
        unknown = [_at_rim(kind, degree, True, *tissue) for kind in outside]
        unknown += [[-v for v in _at_rim(kind, degree, False, *sphere)] for kind in inside]
        share = np.linalg.solve(np.array(unknown).T[rows], -known[rows])
        for kind, value in zip(outside, share, strict=False):
            place = places.get(Field(kind, one.of))
            if place is not None:
                found[place, column] = value
    return found
