"""Spheres in tissue that is solved once: a linear press whose inclusion is a sum of multipoles.

Plain tissue under a probe is factored once. In it, an inclusion is known by what it answers the field around
it with (`fem.spherical`): singular fields of strengths b about its centre, each with what probe, chest wall
and free faces throw back, which is regular and takes one substitution. With a the press's own regular fields
about the centre, M those that are thrown back, and T the sphere's answer,

    b = T (a + M b)                                                                                    (1)

(images of multipoles, as in Kushch 2013, chapter 3; [kushch2013]). No mesh goes around the inclusion: all
sizes, depths and moduli share one factor, and M is the same for all moduli. What is left out are the mesh of
plain tissue and degrees beyond the last.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix

from fem import elasticity
from fem.contact import level as level_tie
from fem.contact_fields import contact_of
from fem.emulated import Emulated
from fem.equilibrium import State
from fem.mesh import Geometry
from fem.meshed import Model, build
from fem.model import STRAIGHT, Inclusion, NotModelled, Pose, Probe, Slab, check
from fem.path import path
from fem.slab_faces import Free, Given, free_of, given_of, reaction_of
from fem.solver import Factor, apply, one_thread
from fem.spherical import Field, answer, answering, displacements, fields, gradients, tractions
from fem.system import System
from fem.topology import Resolution

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Fineness:
    """Mesh of plain tissue, and degree of the last multipoles."""

    mesh: Resolution
    degree: int


# Largest error of tared maximum and total against 145 thousand unknowns, over (size, depth, modulus) =
# (10, 5, 100), (12, 7, 40), (8, 6, 110), (13, 4, 120), (4, 6, 60), 1 mm: preview 0.8 and 1.9 %, standard 0.5
# and 0.6 % (`pytest -m slow -s tests/test_fem_multipoles.py -k refined`).
QUALITIES = {
    "preview": Fineness(Resolution(3, 0, 1, 2, 2, 2, 2, 1, 1), 4),
    "standard": Fineness(Resolution(4, 0, 2, 2, 2, 4, 3, 1, 1), 4),
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
        Displacements per mm of a press of plain tissue, (nodes, 3) mm / mm.
    force
        Of the probe on the slab along z at each pair of contact nodes per mm of it, (nx, ny) mN / mm.
    """

    probe: Probe
    slab: Slab
    degree: int
    rate: Floats = field(repr=False)
    force: Floats = field(repr=False)
    _model: Model = field(repr=False)
    _system: System = field(repr=False)
    _factor: Factor = field(repr=False)
    _given: Given = field(repr=False)
    _free: Free = field(repr=False)
    _reaction: csr_matrix = field(repr=False)
    _exact: bool = field(repr=False)  # whether one substitution with the factor is good enough

    @property
    def dof(self) -> int:
        """Unknowns."""
        return self._system.tree.size

    def press(
        self, inclusion: Inclusion | None, levels: Sequence[float], by_force: bool = False
    ) -> list[Emulated]:
        """Press on one sphere, or on plain tissue; see `press_moduli`."""
        if inclusion is not None:
            return self.press_moduli(inclusion, [inclusion.modulus], levels, by_force)[0]
        return self._pressed(0 * self.rate, 0 * self.force, levels, by_force, 0.0, time.perf_counter())

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
            For ellipsoids, offsets that this object was not made for, and contact that opens, in one line.
        ValueError
            For inclusions that do not fit.
        """
        start = time.perf_counter()
        symmetric = self._model.layout.symmetric
        refuse(self.probe, self.slab, inclusion, centred=symmetric)
        radius, centre = inclusion.size / 2, np.array([*inclusion.offset, inclusion.centre_mm])
        tissue = _shear(self.slab.modulus_kPa, self.slab.poisson), self.slab.poisson
        regular, back = fields(self.degree + _FINER, symmetric), answering(self.degree, symmetric)
        with one_thread():
            moved = self._moved(self._loads(back, centre, radius, tissue[0]))
            press, images = self._around(regular, moved, centre, radius)
        lower = np.array([one.of.degree < self.degree for one in back])
        found = []
        for modulus in moduli:
            sent = answer(regular, back, tissue, (_shear(modulus, inclusion.poisson), inclusion.poisson))
            source, matrix = sent @ press, np.eye(len(back)) - sent @ images
            strengths = np.linalg.solve(matrix, source)
            fewer = np.zeros_like(strengths)
            fewer[lower] = np.linalg.solve(matrix[np.ix_(lower, lower)], source[lower])
            tip = self._model.nodes.tip
            rise, less = (self._system.expand(moved @ part) for part in (strengths, fewer))
            signal = max(float(np.abs(rise)[tip, 2].max()), _NO_SIGNAL)
            error = 100 * float(np.abs(rise - less)[tip, 2].max()) / signal
            force = -(self._reaction @ (moved @ strengths)).reshape(tip.shape)
            found.append(self._pressed(rise, force, levels, by_force, error, start))
        return found

    def _moved(self, loads: Floats) -> Floats:
        """Unknowns for loads, (unknowns, k)."""
        if self._exact:
            return self._factor.precondition(loads)
        return np.stack([self._factor.solve(one) for one in loads.T], axis=1)

    def _loads(self, back: tuple[Field, ...], centre: Floats, radius: float, shear: float) -> Floats:
        """Loads on the unknowns, (unknowns, k), that make up for what k singular fields do at the faces."""
        given, free, poisson = self._given, self._free, self.slab.poisson
        moved = radius * displacements(back, (given.place - centre) / radius, poisson, outer=True)
        change = gradients(back, (free.place - centre) / radius, poisson, outer=True)
        pull = tractions(change, free.normal, shear, poisson)
        return np.asarray(given.stiffness @ _columns(moved) - free.weights @ _columns(pull))

    def _around(
        self, regular: tuple[Field, ...], moved: Floats, centre: Floats, radius: float
    ) -> tuple[Floats, Floats]:
        """Strengths of the regular fields about the centre: of the press per mm, (k,), and of what is thrown
        back of each singular field, (k, m)."""
        place = self._model.place[: self._model.nodes.slab]
        inner = (place[:, 2] > 0) & (place[:, 2] < self.slab.thickness_mm)
        away = np.where(inner, np.linalg.norm(place - centre, axis=1), np.inf)
        least = _SPARE * len(regular)
        reach = max(_NEAR * radius, np.partition(away, least)[least])
        near = np.flatnonzero(away < reach)
        at = (place[near] - centre) / radius
        basis = radius * _columns(displacements(regular, at, self.slab.poisson, outer=False))
        # nodes come in without a jump as the sphere moves
        weight = np.repeat((1 - (away[near] / reach) ** 2) ** 2, 3)[:, None]
        unknown = self._system.unknown.reshape(-1, 3)[near].ravel()
        free = unknown >= 0
        known = np.column_stack([self.rate[near].ravel()[free], moved[unknown[free]]])
        found = np.linalg.lstsq(weight[free] * basis[free], weight[free] * known, rcond=None)
        strengths = np.asarray(found[0], dtype=float)
        return strengths[:, 0], strengths[:, 1:]

    def _pressed(
        self, rise: Floats, force: Floats, levels: Sequence[float], by_force: bool, error: float, start: float
    ) -> list[Emulated]:
        """Answers of what an inclusion adds per mm."""
        model, closed = self._model, np.ones(self.force.shape, dtype=bool)
        both = [(self.rate + rise, self.force + force), (self.rate, self.force)]
        if any((push < 0).any() for _, push in both):
            raise NotModelled(
                "press: received a specimen on which contact opens; not modelled by multipoles: allowed are "
                "presses that stay closed all over"
            )
        stiffness = [1e-3 * model.share * float(push.sum()) for _, push in both]  # N / mm
        found = []
        for level in levels:
            deep, deep_0 = (level / each if by_force else level for each in stiffness)
            states = [
                State(d, d * moved, closed, d * push, np.zeros(3), model, level_tie(model.interface))
                for d, (moved, push) in zip((deep, deep_0), both, strict=True)
            ]
            contact, lowest = contact_of(model.geometry, (states[0], states[1]))
            found.append(
                Emulated(
                    contact,
                    indentation_mm=deep,
                    indentation_0_mm=deep_0,
                    force_N=deep * stiffness[0],
                    force_0_N=deep_0 * stiffness[1],
                    min_pressure_kPa=lowest,
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
    centred: bool | tuple[bool, bool] = False,
    pose: Pose = STRAIGHT,
    degree: int | None = None,
) -> Multipoles:
    """Solve plain tissue under a flat probe that presses straight down on the slab's middle.

    Parameters
    ----------
    quality
        "preview" or "standard".
    centred
        For inclusions below the probe's middle alone: a quarter of the unknowns; along x and y each: half.
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
    symmetric = (centred, centred) if isinstance(centred, bool) else centred
    layout = replace(geometry.layout(fineness.mesh), symmetric=symmetric)
    with one_thread():
        model = build(geometry, fineness.mesh, False, layout)
        way = path(geometry, model, False)
        rate, rest = way.rate(), way.body.rest
        sys = model.system(np.ones(model.nodes.tip.shape, dtype=bool))
        factor, reaction = way.body.factor(sys, rest).factor, reaction_of(model, sys, rest)
        values, own = np.zeros(sys.tree.size), np.zeros(sys.tree.size)
        free, of_probe = sys.unknown >= 0, np.arange(rate.size) >= 3 * model.nodes.slab
        values[sys.unknown[free]] = rate.ravel()[free]
        own[sys.unknown[free & of_probe]] = rate.ravel()[free & of_probe]  # in its frame the glass is at rest
        again = factor.precondition(apply(sys.tree, rest, values))
        return Multipoles(
            probe,
            slab,
            degree or fineness.degree,
            rate,
            -(reaction @ own).reshape(model.nodes.tip.shape),
            model,
            sys,
            factor,
            given_of(model, sys, rest),
            free_of(model, sys),
            reaction,
            bool(np.linalg.norm(again - values) <= _ROUGH * np.linalg.norm(values)),
        )


def refuse(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    pose: Pose = STRAIGHT,
    centred: tuple[bool, bool] = (False, False),
) -> None:
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
    limits = tuple(0.0 if middle else WITHIN * probe.width_mm / 2 for middle in centred)
    if any(abs(o) > limit for o, limit in zip(inclusion.offset, limits, strict=True)):
        raise NotModelled(
            f"inclusion.offset: received {inclusion.offset}; not modelled by multipoles: inclusions so far "
            f"from the probe's middle, allowed up to {limits[0]:g} mm along x and {limits[1]:g} along y"
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
