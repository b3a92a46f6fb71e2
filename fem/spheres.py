"""Spheres in tissue that is solved once: a linear press whose inclusion is a sum of multipoles.

Plain tissue under a probe is factored once. In it, an inclusion is known by what it answers the field around
it with (`fem.spherical`): singular fields of strengths b about its centre, each with what probe, chest wall
and free faces throw back, which is regular and takes one substitution. With a the press's own regular fields
about the centre, M those that are thrown back, and T the sphere's answer,

    b = T (a + M b)                                                                                    (1)

(images of multipoles, as in Kushch 2013, chapter 3; [kushch2013]). No mesh goes around the inclusion: all
sizes, depths and moduli share one factor, and M is the same for all moduli. What is left out are the mesh of
plain tissue and degrees beyond the last.

Plain tissue under a probe has two symmetry planes, which a sphere beside them does not share. But any field
is the sum of four that are even or odd about either, and a quarter of the tissue answers each: two or four
small factors in place of one that is ten times dearer than any.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from fem import elasticity
from fem.contact_fields import TOO_UNEVEN
from fem.emulated import Emulated
from fem.mesh import Geometry
from fem.meshed import Model, build
from fem.model import STRAIGHT, Inclusion, NotModelled, Pose, Probe, Slab, check
from fem.operators import AtRest
from fem.path import path
from fem.quarters import Quarter, character, quarter_of, signs_of, whole, whole_force
from fem.solver import apply, one_thread
from fem.spherical import Field, answer, answering, displacements, fields, gradients, tractions
from fem.surface import contact_surface, line_weights, mirror_line, pressure
from fem.system import EVEN, Parity
from fem.topology import Resolution

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Fineness:
    """Mesh of plain tissue, and degree of the last multipoles."""

    mesh: Resolution
    degree: int


# Largest error of tared maximum and total against 145 thousand unknowns, over (size, depth, modulus) =
# (10, 5, 100), (12, 7, 40), (8, 6, 110), (13, 4, 120), (4, 6, 60), 1 mm: preview 0.8 and 1.9 %, standard 0.5
# and 0.7 % (`pytest -m slow -s tests/test_fem_multipoles.py -k refined`).
QUALITIES = {
    "preview": Fineness(Resolution(3, 0, 1, 2, 2, 2, 2, 1, 1), 4),
    "standard": Fineness(Resolution(4, 0, 2, 2, 2, 5, 3, 1, 1, (0.7, 1.6)), 4),
}

WITHIN = 0.5
"""Largest offset over the probe's half width: beyond, the cells of plain tissue are too coarse."""

SHALLOW = 0.12, 0.28
"""Least depth to the top over the probe's width, and over the inclusion's size: tared maxima of (10, 3, 100)
and (13.4, 3.76, 120) are 1.1 and 0.15 % off by four degrees, 0.2 and 0.4 by six, 0.02 by eight, against
twelve in finer tissue."""

_BOX = 0.2, 0.28  # diameter and depth, in widths of the probe, of the sphere whose box the fine cells fill
_FINER = 2  # degrees by which the fit of what is thrown back goes beyond the multipoles
_NO_SIGNAL = 1e-9  # mm per mm: below, an inclusion is tissue
_ROUGH = 1e-4  # of displacements, by which one substitution may be off
_NEAR, _SPARE = 1.5, 4  # radii of the sphere in which it is fitted; nodes per field that it takes at least


@dataclass(frozen=True)
class Multipoles:
    """Plain tissue under a probe, ready for spheres; made by `multipoles`.

    Attributes
    ----------
    rate
        Displacements per mm of a press of plain tissue, (nodes, 3) mm / mm, of the quarter x, y >= 0.
    force
        Of the probe on the slab along z at each pair of contact nodes per mm of it, whole, (nx, ny) mN / mm.
    """

    probe: Probe
    slab: Slab
    degree: int
    rate: Floats = field(repr=False)
    force: Floats = field(repr=False)
    _model: Model = field(repr=False)
    _rest: AtRest = field(repr=False)
    _quarters: dict[Parity, Quarter] = field(repr=False)
    _exact: bool = field(repr=False)  # whether one substitution with a factor is good enough

    @property
    def dof(self) -> int:
        """Unknowns of a quarter of plain tissue."""
        return self._quarters[EVEN].system.tree.size

    def press(
        self, inclusion: Inclusion | None, levels: Sequence[float], by_force: bool = False
    ) -> list[Emulated]:
        """Press on one sphere, or on plain tissue; see `press_moduli`."""
        if inclusion is not None:
            return self.press_moduli(inclusion, [inclusion.modulus], levels, by_force)[0]
        still = np.zeros((*self.force.shape, 3))
        return self._pressed(still, 0 * self.force, levels, by_force, 0.0, time.perf_counter())

    def press_moduli(
        self, inclusion: Inclusion, moduli: Sequence[float], levels: Sequence[float], by_force: bool = False
    ) -> list[list[Emulated]]:
        """Press on spheres that differ in their modulus (kPa) only: more of them cost next to nothing.

        Parameters
        ----------
        inclusion
            Its modulus is left out of account.
        levels
            Indentations, mm, or forces, N.

        Returns
        -------
        For each modulus the list of levels, as of an emulator; `error_percent` is what the multipoles of the
        last degree change, in per cent of the largest tared displacement.

        Raises
        ------
        NotModelled
            For ellipsoids, spheres far from the probe's middle, and contact that opens, in one line.
        ValueError
            For inclusions that do not fit.
        """
        start = time.perf_counter()
        refuse(self.probe, self.slab, inclusion)
        radius, centre = inclusion.size / 2, np.array([*inclusion.offset, inclusion.centre_mm])
        tissue = _shear(self.slab.modulus_kPa, self.slab.poisson), self.slab.poisson
        symmetric = on_x, on_y = inclusion.offset[0] == 0.0, inclusion.offset[1] == 0.0
        regular, back = fields(self.degree + _FINER, symmetric), answering(self.degree, symmetric)
        turns: list[Parity] = [
            (x, y) for x, y in product((False, True), repeat=2) if not ((x and on_x) or (y and on_y))
        ]
        with one_thread():
            moved = self._answers(turns, back, centre, radius, tissue[0])
            press, images = self._around(turns, regular, moved, centre, radius)
            tip, push = self._seen(moved)
        lower = np.array([one.of.degree < self.degree for one in back])
        found = []
        for modulus in moduli:
            sent = answer(regular, back, tissue, (_shear(modulus, inclusion.poisson), inclusion.poisson))
            source, matrix = sent @ press, np.eye(len(back)) - sent @ images
            strengths = np.linalg.solve(matrix, source)
            fewer = np.zeros_like(strengths)
            fewer[lower] = np.linalg.solve(matrix[np.ix_(lower, lower)], source[lower])
            rise, less = tip @ strengths, tip[..., 2, :] @ fewer
            signal = max(float(np.abs(rise[..., 2]).max()), _NO_SIGNAL)
            error = 100 * float(np.abs(rise[..., 2] - less).max()) / signal
            found.append(self._pressed(rise, push @ strengths, levels, by_force, error, start))
        return found

    def _answers(
        self, turns: list[Parity], back: tuple[Field, ...], centre: Floats, radius: float, shear: float
    ) -> dict[Parity, Floats]:
        """For each parity the unknowns (unknowns, k) that make up for what k singular fields do at the faces;
        the parities are the turns, mirrored across x or y or not, that the fields do not have by themselves.
        """
        given, free, poisson = self._quarters[EVEN].given, self._quarters[EVEN].free, self.slab.poisson
        shifts, pulls = [], []
        for turn in turns:
            signs = signs_of(turn)
            at, normal = (signs * given.place - centre) / radius, signs * free.normal
            shifts.append(signs * radius * displacements(back, at, poisson, outer=True))
            change = gradients(back, (signs * free.place - centre) / radius, poisson, outer=True)
            pulls.append(signs * tractions(change, normal, shear, poisson))
        found = {}
        for odd in turns:
            mine, shares = self._quarter(odd), [character(odd, turn) / len(turns) for turn in turns]
            shift, pull = (np.tensordot(shares, np.stack(every), 1) for every in (shifts, pulls))
            loads = np.asarray(mine.given.stiffness @ _columns(shift) - mine.free.weights @ _columns(pull))
            if self._exact:
                found[odd] = mine.factor.precondition(loads)
            else:
                found[odd] = np.stack([mine.factor.solve(one) for one in loads.T], axis=1)
        return found

    def _quarter(self, odd: Parity) -> Quarter:
        if odd not in self._quarters:
            self._quarters[odd] = quarter_of(self._model, self._rest, odd)
        return self._quarters[odd]

    def _seen(self, moved: dict[Parity, Floats]) -> tuple[Floats, Floats]:
        """Displacement (nx, ny, 3, k) and force along z (nx, ny, k) of the whole face, of unknowns."""
        tip, seen, push = self._model.nodes.tip, [], []
        for odd, values in moved.items():
            part = self._quarters[odd].at(tip, values)
            seen.append(np.stack([whole(part[:, :, a], odd, a) for a in range(3)], axis=2))
            force = -(self._quarters[odd].reaction @ values)
            push.append(whole_force(force.reshape(*tip.shape, -1), odd))
        return np.asarray(sum(seen)), np.asarray(sum(push))

    def _around(
        self,
        turns: list[Parity],
        regular: tuple[Field, ...],
        moved: dict[Parity, Floats],
        centre: Floats,
        radius: float,
    ) -> tuple[Floats, Floats]:
        """Strengths of the regular fields about the centre: of the press per mm, (k,), and of what is thrown
        back of each singular field, (k, m)."""
        quarter = self._model.place[: self._model.nodes.slab]
        inner = (quarter[:, 2] > 0) & (quarter[:, 2] < self.slab.thickness_mm)
        inner &= (np.abs(quarter[:, :2]) < self.slab.width_mm / 2 * (1 - 1e-9)).all(axis=1)
        places, nodes = [], []
        for turn in turns:  # nodes on a plane are their own images
            own = np.flatnonzero(inner & (quarter[:, :2][:, list(turn)] > 1e-9).all(axis=1))
            places.append(signs_of(turn) * quarter[own])
            nodes.append(own)
        away = [np.linalg.norm(place - centre, axis=1) for place in places]
        least = _SPARE * len(regular)
        reach = max(_NEAR * radius, np.partition(np.concatenate(away), least)[least])
        known, at, weights = [], [], []
        for turn, place, own, far in zip(turns, places, nodes, away, strict=True):
            near, signs = far < reach, signs_of(turn)[:, None]
            parts = [
                character(odd, turn) * signs * self._quarters[odd].at(own[near], moved[odd]) for odd in turns
            ]
            known.append(np.concatenate([signs * self.rate[own[near], :, None], sum(parts)], axis=2))
            at.append((place[near] - centre) / radius)
            # nodes come in without a jump as the sphere moves
            weights.append((1 - (far[near] / reach) ** 2) ** 2)
        basis = radius * _columns(displacements(regular, np.concatenate(at), self.slab.poisson, outer=False))
        weight = np.repeat(np.concatenate(weights), 3)[:, None]
        target = np.concatenate(known).reshape(len(basis), -1)
        strengths = np.asarray(np.linalg.lstsq(weight * basis, weight * target, rcond=None)[0], dtype=float)
        return strengths[:, 0], strengths[:, 1:]

    def _pressed(
        self, rise: Floats, force: Floats, levels: Sequence[float], by_force: bool, error: float, start: float
    ) -> list[Emulated]:
        """Answers of what an inclusion adds per mm to the whole face: displacement (nx, ny, 3), force."""
        nodes, place = self._model.nodes, self._model.place
        x, y = mirror_line(place[nodes.tip[:, 0], 0]), mirror_line(place[nodes.tip[0], 1])
        still = self.rate[nodes.tip]
        still = np.stack([whole(still[:, :, a], EVEN, a) for a in range(3)], axis=2)
        both = [(still + rise, self.force + force), (still, self.force)]
        if any((push < 0).any() for _, push in both):
            raise NotModelled(
                "press: received a specimen on which contact opens; not modelled by multipoles: allowed are "
                "presses that stay closed all over"
            )
        pressures = [pressure(push, x, y) for _, push in both]
        if not np.isfinite(pressures).all():
            raise NotModelled(TOO_UNEVEN)
        area = np.outer(line_weights(x), line_weights(y)).ravel()
        stiffness = [1e-3 * float(push.sum()) for _, push in both]  # N / mm
        found = []
        for level in levels:
            deep, deep_0 = (level / each if by_force else level for each in stiffness)
            contact = contact_surface(x, y)
            depths = (deep, deep_0)
            for suffix, d, (moved, _), p in zip(("", "_0"), depths, both, pressures, strict=True):
                contact.point_data["displacement" + suffix] = (d * moved).reshape(-1, 3)
                contact.point_data["pressure" + suffix] = (d * p).ravel()
                contact.point_data["area" + suffix] = area
            found.append(
                Emulated(
                    contact,
                    indentation_mm=deep,
                    indentation_0_mm=deep_0,
                    force_N=deep * stiffness[0],
                    force_0_N=deep_0 * stiffness[1],
                    min_pressure_kPa=min(
                        d * float(p.min()) for d, p in zip((deep, deep_0), pressures, strict=True)
                    ),
                    seconds=time.perf_counter() - start,
                    mechanics="linear",
                    error_percent=error,
                    path="multipoles",
                    background="own",
                    dof=self.dof,
                )
            )
        return found


def multipoles(
    probe: Probe,
    slab: Slab,
    quality: str = "standard",
    pose: Pose = STRAIGHT,
    degree: int | None = None,
) -> Multipoles:
    """Solve plain tissue under a flat probe that presses straight down on the slab's middle.

    Parameters
    ----------
    quality
        "preview" or "standard".
    pose
        To be refused if it is another.
    degree
        Of the last multipoles, 1 or more, by default the quality's.

    Raises
    ------
    NotModelled
        For domes, tilted probes and other places, in one line.
    """
    if quality not in QUALITIES:
        raise ValueError(f"quality: received {quality!r}; allowed {', '.join(QUALITIES)} by multipoles")
    refuse(probe, slab, None, pose)
    fineness, geometry = QUALITIES[quality], _bare(probe, slab)
    layout = replace(geometry.layout(fineness.mesh), symmetric=(True, True))
    with one_thread():
        model = build(geometry, fineness.mesh, False, layout)
        way = path(geometry, model, False)
        rate, rest = way.rate(), way.body.rest
        sys = model.system(np.ones(model.nodes.tip.shape, dtype=bool))
        even = quarter_of(model, rest, EVEN, way.body.factor(sys, rest).factor)
        values, own = np.zeros(sys.tree.size), np.zeros(sys.tree.size)
        free, of_probe = sys.unknown >= 0, np.arange(rate.size) >= 3 * model.nodes.slab
        values[sys.unknown[free]] = rate.ravel()[free]
        own[sys.unknown[free & of_probe]] = rate.ravel()[free & of_probe]  # in its frame the glass is at rest
        again = even.factor.precondition(apply(sys.tree, rest, values))
        return Multipoles(
            probe,
            slab,
            degree or fineness.degree,
            rate,
            whole_force(-(even.reaction @ own).reshape(model.nodes.tip.shape), EVEN),
            model,
            rest,
            {EVEN: even},
            bool(np.linalg.norm(again - values) <= _ROUGH * np.linalg.norm(values)),
        )


def refuse(probe: Probe, slab: Slab, inclusion: Inclusion | None, pose: Pose = STRAIGHT) -> None:
    """Raise `NotModelled` for what multipoles do not press, ValueError for the impossible, in one line."""
    check(probe, slab, inclusion, pose)
    if probe.dome_radius_mm is not None:
        raise NotModelled(
            f"probe.dome_radius_mm: received {probe.dome_radius_mm:g}; not modelled by multipoles: domes, "
            "allowed none"
        )
    for name, value in (("tilt", pose.tilt_deg), ("position", pose.position_mm)):
        if any(value):
            raise NotModelled(f"{name}: received {value}; not modelled by multipoles, allowed (0, 0)")
    if inclusion is None:
        return
    if inclusion.stretch != (1.0, 1.0, 1.0):
        raise NotModelled(
            f"inclusion.stretch: received {inclusion.stretch}; not modelled by multipoles: ellipsoids, "
            "allowed are spheres"
        )
    limit = WITHIN * probe.width_mm / 2
    if any(abs(offset) > limit for offset in inclusion.offset):
        raise NotModelled(
            f"inclusion.offset: received {inclusion.offset}; not modelled by multipoles: inclusions so far "
            f"from the probe's middle, allowed up to {limit:g} mm along x and y"
        )
    least = max(SHALLOW[0] * probe.width_mm, SHALLOW[1] * inclusion.size)
    if inclusion.depth < least:
        raise NotModelled(
            f"inclusion.depth: received {inclusion.depth:g}; not modelled by multipoles: inclusions so near "
            f"the contact, allowed from {least:.3g} mm"
        )


def _bare(probe: Probe, slab: Slab) -> Geometry:
    """Plain tissue, its cells laid around a small sphere where inclusions may be."""
    size, depth = (share * probe.width_mm for share in _BOX)
    fits = size + 1.5 * depth <= slab.thickness_mm
    still = Inclusion(size, depth, slab.modulus_kPa, poisson=slab.poisson) if fits else None
    return Geometry(probe, slab, still)


def _shear(modulus: float, poisson: float) -> float:
    """Shear modulus, kPa."""
    return float(elasticity.lame(np.array(float(modulus)), np.array(poisson))[0])


def _columns(vectors: Floats) -> Floats:
    """Vectors (n, k, 3) of k fields as columns (3 n, k)."""
    return vectors.transpose(0, 2, 1).reshape(-1, vectors.shape[1])
