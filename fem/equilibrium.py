"""Equilibrium of probe and slab: Newton's method on the forces, conjugate gradients on the tangent, active
set.

The tangent is applied element by element and never assembled; a Cholesky factor of an earlier tangent
(`fem.solver`) preconditions it, so that most Newton steps need no factorisation at all. Its pressure is the
one that the last step foresaw: displacements that are extrapolated, or off for what is still to come, change
volumes by what nearly incompressible tissue answers with pressures that are not there. Which pairs of
contact nodes are closed is iterated around it (primal-dual active set: Hüeber and Wohlmuth 2005;
[hueber2005]): closed pairs that pull are opened, open pairs that overlap are closed, until neither is left.
At finite strain the slab's mesh and the contact's slopes are iterated with it (`fem.contact`).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, cg

from fem import elasticity, solver
from fem.anderson import Anderson
from fem.contact import Tie
from fem.elasticity import Inverted
from fem.material_forces import material_forces
from fem.meshed import Model
from fem.operators import AtRest, Matrices, Sheared, Tangent, product
from fem.system import System

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]
Ints = NDArray[np.int64]

_TOLERANCE = 1e-9  # of the residual, relative to the reaction at the chest wall
_FORCING = 1e-3  # to which conjugate gradients solve each Newton step
_HALVINGS = 8  # of a Newton step at most
_NEWTON = 20  # steps at most
_PATIENCE = 12  # steps after which the residual must have come down to a hundredth of the reaction
_DAMPING, _STRONGEST = 0.05, 0.8  # share of the stiffness at rest added where the tangent is not definite
_WORTH = 8  # iterations of conjugate gradients that are worth a new factor
_TURNS = 20  # of the slab's mesh and the slopes at most
_STRICT = 8  # turns after which the probe's edge may still want to move by more
_SLIP, _RIM_SLIP = 2e-4, 2e-3  # mm by which the mesh may still want to move: inside, and at the probe's edge
_OFF = 1e-4  # share of the largest force by which forces may still change
_LOOSE = 3e-4  # tolerance while mesh and slopes still change
_EASY, _TIGHT = 6, 3e-6  # turns so loose, and tolerance after: what they are extrapolated from is small then
_FAINT = 1e-3  # share of the largest force below which a pair does not tell its slope
_SETS = 40  # changes of the active set at most


class NotConverged(ArithmeticError):
    """Newton's method or the active set found no equilibrium in this step."""


class Indefinite(NotConverged):
    """A tangent that is not positive definite."""


@dataclass(frozen=True)
class State:
    """One equilibrium."""

    indentation: float  # mm
    moved: Floats  # displacement of the nodes in the probe's frame, (nodes, 3) mm
    closed: Bools  # pairs in contact, (nx, ny)
    force: Floats  # of the probe on the slab along z at each pair, mN, positive pressing; (nx, ny)
    chest: Floats  # of the slab on the chest wall, (3,) mN
    model: Model  # the mesh it belongs to
    tie: Tie
    volume: Floats | None = None  # change of volume that the last Newton step foresaw, (elements, 4) mm^3/2


@dataclass
class Effort:
    """What finding the equilibria took."""

    factors: int = 0
    newton: int = 0
    cg: int = 0
    sets: int = 0


@dataclass
class Body:
    """All moduli, and the factors found so far."""

    shear: Floats
    bulk: Floats
    rest: AtRest
    finite: bool
    stiff: bool  # with the inclusion
    factors: dict[bytes, Preconditioner] = field(default_factory=dict)
    effort: Effort = field(default_factory=Effort)
    turns: Anderson = field(default_factory=Anderson)  # of the slab's mesh and the contact's slopes

    @cached_property
    def floor(self) -> float:
        """Residual that is rounding, mN: what the largest entries leave after they cancel."""
        largest = elasticity.largest(self.rest.quad, self.shear, self.bulk)
        return 1e4 * float(np.finfo(np.float64).eps) * largest

    def forces(self, model: Model, moved: Floats) -> tuple[Floats, float]:
        """Internal forces (nodes, 3), mN, and stored energy, µJ."""
        if model.finite:
            found, energy = elasticity.forces(model.quad, moved, self.shear, self.bulk)
            return model.nodal(found), energy
        total = model.nodal(product(self.rest, moved, model))
        return total, 0.5 * float((total * moved).sum())

    def tangent(self, model: Model, moved: Floats, volume: Floats | None = None) -> AtRest | Tangent:
        """Tangent stiffness of the elements; with the pressures of a change of volume, if one is given."""
        if not model.finite:
            return self.rest
        return Tangent(model.quad, self.shear, self.bulk, moved, volume)

    def factor(
        self, sys: System, matrices: Matrices, slope: Floats | None = None, renew: bool = False
    ) -> Preconditioner:
        """Factor of the tied stiffness for a set of closed pairs; an old one serves unless renewed."""
        key = sys.closed.tobytes()
        if renew or key not in self.factors:
            self.factors.clear()  # before the next one: the largest of all memory
            if isinstance(matrices, Tangent):
                matrices.let_go()
            made = matrices if slope is None else Sheared(matrices, sys.nodes.cells, slope)
            # a tangent that is not definite in single precision is damped, rather than factored in double
            factor = solver.Factor(sys.tree, made, again=slope is None)
            self.factors[key] = Preconditioner(sys, factor if slope is None else factor.bare(), slope)
            self.effort.factors += 1
        return self.factors[key]


@dataclass(frozen=True)
class Preconditioner:
    """Factor of a stiffness in which closed pairs are tied across their tangent plane.

    With slopes G, the unknown that a pair shares is the height z - G . (x, y) above that plane.
    """

    sys: System
    factor: solver.Factor
    slope: Floats | None  # G of each node, (nodes, 2); zero off the contact

    def __call__(self, load: Floats) -> Floats:
        """One substitution."""
        if self.slope is None:
            return self.factor.precondition(load)
        at, unknown = self.sys.nodes.contact.ravel(), self.sys.unknown.reshape(-1, 3)
        rise = unknown[at, 2]
        pairs = [(unknown[at, a], self.slope[at, a]) for a in (0, 1)]
        turned = load.copy()
        for level, g in pairs:
            free = level >= 0
            turned[level[free]] += (g * load[rise])[free]
        found = self.factor.precondition(turned)
        lift = found[rise].copy()
        for level, g in pairs:
            free = level >= 0
            lift[free] += (g[free]) * found[level[free]]
        found[rise] = lift
        return found


def equilibrium(body: Body, guess: State) -> State:
    """Find the equilibrium at `guess.indentation`, from its displacements and its closed pairs.

    Raises
    ------
    NotConverged, Inverted
        The step was too long.
    """
    held, state = guess.model.nodes.held, replace(guess, moved=guess.moved.copy())
    state.moved[held] = np.where(held, guess.model.chest(guess.indentation), 0.0)[held]
    seen: set[bytes] = set()
    turns, settled = 0, not guess.model.finite
    body.turns.begin()
    for _ in range(_SETS):
        if not settled:
            state = _realign(body, state, turns == 0)
            turns += 1
        before = state.force
        tolerance = _TOLERANCE if settled else _LOOSE if turns <= _EASY else _TIGHT
        state = _newton(body, state, tolerance, renew=turns == 1)
        distance = state.tie.gap(state.model.place + state.moved)
        pulls = state.closed & (state.force < 0)
        overlaps = ~state.closed & (distance < 0)
        if not (pulls.any() or overlaps.any()):
            if settled:
                return replace(state, model=state.model.bare()) if state.model.finite else state
            wanted = np.abs(state.model.wanted(state.moved) - state.model.shift)
            inner = state.model.interface.inner
            change = np.abs(state.force - before) / max(float(np.abs(state.force).max()), 1e-300)
            rim = (_SLIP, _OFF) if turns <= _STRICT else (_RIM_SLIP, np.inf)
            settled = bool(
                wanted[inner].max() <= _SLIP
                and change[inner].max() <= _OFF
                and wanted.max() <= rim[0]
                and change.max() <= rim[1]
            )
            if turns > _TURNS and not settled:
                raise NotConverged("the sliding contact does not settle")
            continue
        closed = (state.closed & ~pulls) | overlaps
        key = closed.tobytes()
        if key in seen:  # going round in circles: change one pair at a time, the worst
            closed = state.closed.copy()
            worst = np.where(pulls, state.force / np.abs(state.force).max(initial=1e-300), 0.0)
            worst = np.where(overlaps, distance / np.abs(distance).max(), worst)
            at = np.unravel_index(int(worst.argmin()), worst.shape)
            closed[at] = ~closed[at]
            key = closed.tobytes()
        seen.add(key)
        body.turns.forget()
        state = replace(state, closed=closed)
        body.effort.sets += 1
    raise NotConverged("the set of closed contact pairs does not settle")


def _realign(body: Body, state: State, guessed: bool) -> State:
    """Move the slab's mesh to where the probe's nodes stand now, and take their slopes.

    The turns are accelerated (Anderson 1965; [anderson1965]): from 4 mm on, where the pressure is no longer
    small against the tissue's modulus, plain ones would drift off to both sides of the answer.
    """
    model = state.model
    if not state.tie.slope.any():  # the first of all
        slope = model.interface.slope(model.place + state.moved)
        return replace(state, tie=replace(state.tie, slope=slope))
    if guessed:  # out of equilibrium forces say nothing: the slope is a guess, too
        return replace(state, model=model.follow(model.wanted(state.moved)))
    slope = _slope(body, state)
    now = np.concatenate([model.shift, state.tie.slope]).ravel()
    asked = np.concatenate([model.wanted(state.moved), slope]).ravel() - now
    shift, slope = body.turns.next(now, asked).reshape(2, *slope.shape)
    return replace(state, model=model.follow(shift), tie=replace(state.tie, slope=slope))


def _slope(body: Body, state: State) -> Floats:
    """Slopes of the face by which the slab's material gains no energy by sliding along it, (nx, ny, 2).

    The slab's force f there asks for the slope of f + T^-T c, c its material force and T the stretch of the
    face: where it is free to slide, c along the face is nothing. Pairs that carry next to nothing keep the
    slope of the probe's face, and so do those at its corners, which would fold from 3 mm on.
    """
    model, now = state.model, state.model.place + state.moved
    face, under = model.interface, model.nodes.under
    slope, at = face.slope(now), face.slab
    quad, shear, bulk = model.quad.part(under), body.shear[under], body.bulk[under]
    force = model.gather(quad.nodes, elasticity.forces(quad, state.moved, shear, bulk)[0])[at]
    drive = model.gather(quad.nodes, material_forces(quad, model.place, state.moved, shear, bulk))[at]
    before, after = (face.derivatives(place[at])[..., :2] for place in (model.place, now))
    back = np.linalg.solve(after, before)  # T^-T, by derivatives along the undeformed face
    along = force[..., :2] + (back @ drive[..., :2, None])[..., 0]
    for axis, symmetric in enumerate(model.layout.symmetric):
        if symmetric:
            np.moveaxis(along, axis, 0)[0, :, axis] = 0.0
    up = force[..., 2]
    told = state.closed & ~face.corners & (up > 0)
    trust = np.where(told, up / (up**2 + (_FAINT * up.max()) ** 2), 0.0)[..., None]
    return np.asarray(slope - trust * (along + up[..., None] * slope))


def _newton(body: Body, start: State, tolerance: float, renew: bool) -> State:
    """Equilibrium for a given set of closed pairs, mesh and slopes."""
    model, closed, moved, bond, volume = start.model, start.closed, start.moved, start.tie, start.volume
    sys = model.system(closed)
    tip, at_chest = model.nodes.tip, model.nodes.chest
    model.settle(moved, closed, bond)
    forces, energy = body.forces(model, moved)
    damping = 0.0
    for turn in range(_NEWTON):
        normal = np.where(closed, forces[tip, 2], 0.0)
        residual = sys.gather(bond.hand_on(forces, normal))
        size, scale = float(np.linalg.norm(residual)), float(np.linalg.norm(forces[at_chest]))
        if size <= max(tolerance * scale, body.floor):
            chest = -forces[at_chest].sum(axis=0)
            return replace(start, moved=moved, force=-normal, chest=chest, volume=volume)
        if turn >= _PATIENCE and damping == 0 and size > 1e-2 * scale:
            raise NotConverged("Newton's method does not come down")
        tangent = body.tangent(model, moved, volume)
        (change, steps, downhill), damping = _step(body, start, sys, tangent, -residual, renew, damping)
        renew = model.finite and (steps > _WORTH or damping > 0)
        damping = damping / 4 if damping > _DAMPING else 0.0
        body.effort.newton += 1
        # far from equilibrium, no step may raise the energy (Armijo's rule); near it rounding would decide
        for cut in range(_HALVINGS):
            trial = moved + 0.5**cut * change
            try:
                forces_t, energy_t = body.forces(model, trial)
            except Inverted:
                continue
            if not model.finite or size < 1e-3 * scale or energy_t <= energy - 1e-4 * 0.5**cut * downhill:
                break
        else:
            raise NotConverged("no step lowers the energy")
        if model.finite:
            volume = elasticity.volumes(model.quad, moved, trial - moved)
        moved, forces, energy = trial, forces_t, energy_t
    raise NotConverged("Newton's method does not converge")


def _step(
    body: Body,
    start: State,
    sys: System,
    tangent: AtRest | Tangent,
    load: Floats,
    renew: bool,
    damping: float,
) -> tuple[tuple[Floats, int, float], float]:
    """Newton's step as `_solve` gives it, with at least so much damping, and the damping it took.

    Where no damping makes the tangent definite, the stiffness at rest takes its place: a pair that has just
    closed leaves volumes beside it that are far off, and their pressure says nothing yet.
    """
    while True:
        matrices: Matrices = tangent
        if damping > 0 and isinstance(tangent, Tangent):
            matrices = tangent.damped(damping)
        if damping > _STRONGEST:
            matrices, renew = body.rest, True
        try:
            found = _solve(body, start.model, sys, start.tie, matrices, load, renew)
            return found, min(damping, _STRONGEST)
        except (Indefinite, np.linalg.LinAlgError):
            if not start.model.finite or damping > _STRONGEST:
                raise
            damping, renew = max(4 * damping, _DAMPING), True


def _solve(
    body: Body,
    model: Model,
    sys: System,
    bond: Tie,
    matrices: Matrices,
    load: Floats,
    renew: bool,
) -> tuple[Floats, int, float]:
    """Change of the displacements (nodes, 3) that a load on the unknowns makes, the iterations taken, and
    the work of the load."""
    tip, slopes = model.nodes.tip, bond.slopes(len(model.place)) if model.finite else None
    factor = body.factor(sys, matrices, slopes, renew)

    def expand(values: Floats) -> Floats:
        change = sys.expand(values)
        change[tip, 2] = np.where(sys.closed, bond.height(change), change[tip, 2])
        return change

    if not model.finite:
        answer = factor.factor.solve(load, matrices=matrices)
        return expand(answer), 1, float(load @ answer)

    def apply(values: Floats) -> Floats:
        force = model.nodal(product(matrices, expand(values), model))
        found = sys.gather(bond.hand_on(force, np.where(sys.closed, force[tip, 2], 0.0)))
        if values @ found <= 0 < values @ values:
            raise Indefinite("the tangent is not positive definite")
        return found

    count = [0]

    def tick(_: Floats) -> None:
        count[0] += 1

    shape = (len(load), len(load))
    answer, failed = cg(
        LinearOperator(shape, matvec=apply, dtype=float),
        load,
        rtol=_FORCING,
        maxiter=200,
        M=LinearOperator(shape, matvec=factor, dtype=float),
        callback=tick,
    )
    body.effort.cg += count[0]
    if failed:
        raise Indefinite("the tangent is not positive definite")
    return expand(answer), count[0], float(load @ answer)
