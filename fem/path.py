"""Follow a press: from the first touch through all press levels, with steps that cut themselves back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fem.contact import level
from fem.elasticity import Inverted
from fem.equilibrium import Body, NotConverged, State, equilibrium
from fem.mesh import Geometry
from fem.meshed import Model, moduli
from fem.operators import AtRest, product

Floats = NDArray[np.float64]

_LONGEST = 1.0  # mm of indentation in one step at finite strain
_SECANT, _FORCE = 25, 1e-6  # steps to find a force, and how well to meet it
_CUTS = 6  # halvings of a step at most
_GROWTH = 1.5  # of a step after one that held
_DEAR = 8  # factors after which the next step is half as long: its tangents were hardly ever definite


@dataclass
class Path:
    """Equilibria of one body, found one after the other."""

    geometry: Geometry
    body: Body
    states: list[State]
    beside: Path | None = None
    """The same press without inclusion: its states are where to begin, and give the mesh."""
    _linear: Path | None = None
    _rate: Floats | None = None

    def to(self, indentation: float) -> State:
        """Equilibrium at an indentation, mm.

        Raises
        ------
        NotConverged
            If even the shortest step fails.
        """
        near = min(self.states, key=lambda s: abs(s.indentation - indentation))
        way = indentation - near.indentation
        longest = _LONGEST if near.model.finite else np.inf  # small strain does not depend on its way
        # what an inclusion adds to a press without hardly does either
        step = way if self.beside is not None else float(np.clip(way, -longest, longest))
        while near.indentation != indentation:
            left = indentation - near.indentation
            target = indentation if abs(step) >= abs(left) * (1 - 1e-9) else near.indentation + step
            spent = self.body.effort.factors
            found = self._next(near, target)
            if found is not None:
                near = found
                self.states.append(near)
                step *= _GROWTH if self.body.effort.factors - spent <= _DEAR else 0.5
            elif abs(step) / 2 >= max(abs(way), 1e-3) / 2**_CUTS:
                step /= 2
            else:
                raise NotConverged(
                    f"press: no equilibrium found beyond {near.indentation:.3g} mm on the way to "
                    f"{indentation:.3g} mm"
                )
            step = float(np.clip(step, -longest, longest))
        return near

    def _next(self, near: State, indentation: float) -> State | None:
        """Equilibrium at an indentation beyond `near`, by the first guess that leads to one."""
        guesses: list[Callable[[], State]] = []
        if self.beside is not None:
            other = self.beside.to(indentation)
            guesses.append(lambda: self._aside(other))
        if not near.model.finite or abs(indentation - near.indentation) <= _LONGEST:
            guesses.append(lambda: self._ahead(near, indentation))
        for guess in guesses:
            try:
                return equilibrium(self.body, guess())
            except (NotConverged, Inverted, np.linalg.LinAlgError):
                continue
        return None

    def _ahead(self, near: State, indentation: float) -> State:
        """Extrapolate the path to an indentation, on the mesh that follows the slip expected there."""
        known = self._line(near, indentation)
        if len(known) == 1 and near.closed.all():
            way = indentation - near.indentation
            moved = near.moved + self.rate() * way
            shift = near.model.wanted(moved)
        elif near.model.finite and not all(s.closed.all() for s in known):  # it spreads as at small strain
            here, there = (self.small().to(each) for each in (near.indentation, indentation))
            moved, closed = near.moved + there.moved - here.moved, near.closed | there.closed
            shift = near.model.wanted(moved) if near.closed.any() else near.model.shift
            near = replace(near, closed=closed)
        elif len(known) == 1:  # the slab comes nearer as a whole
            moved = near.moved - (indentation - near.indentation) * near.model.normal * near.model.slab
            shift = near.model.shift
        else:
            x = np.array([s.indentation for s in known])
            weights = [
                np.prod([(indentation - x[j]) / (x[i] - x[j]) for j in range(len(x)) if j != i])
                for i in range(len(x))
            ]

            def between(fields: list[Floats]) -> Floats:
                return np.asarray(sum(w * field for w, field in zip(weights, fields, strict=True)))

            moved, shift = between([s.moved for s in known]), between([s.model.shift for s in known])
            near = replace(near, tie=replace(near.tie, slope=between([s.tie.slope for s in known])))
        guess = replace(near, indentation=indentation, moved=moved)
        return replace(guess, model=near.model.follow(shift)) if near.model.finite else guess

    def by_force(self, force: float) -> State:
        """Equilibrium under a force along z on the part that is meshed, mN.

        Raises
        ------
        NotConverged
            If no indentation gives that force.
        """
        first = self.states[0]

        def error(state: State) -> float:
            return float(state.force.sum()) - force

        known = [s for s in self.states if s is not first]
        if known:
            state = min(known, key=lambda s: abs(error(s)))
        elif first.model.finite:
            state = self.to(self.small().by_force(force).indentation)
        else:
            state = self.to(first.indentation + 0.5)
        before = first
        for _ in range(_SECANT):
            if abs(error(state)) <= _FORCE * force:
                return state
            slope = (error(state) - error(before)) / (state.indentation - before.indentation)
            if not slope > 0:
                break
            wish = state.indentation - error(state) / slope
            wish = max(wish, 0.5 * (first.indentation + state.indentation))
            before, state = state, self.to(wish)
        raise NotConverged("press: no indentation found that gives the force")

    def _line(self, near: State, indentation: float) -> list[State]:
        """Up to three states to extrapolate from, none of them nearer to the next than the way to go."""
        known, way = [near], abs(indentation - near.indentation)
        behind = [
            s
            for s in self.states
            if (s.indentation - near.indentation) * (indentation - near.indentation) < 0
        ]
        for state in sorted(behind, key=lambda s: abs(s.indentation - near.indentation)):
            if abs(state.indentation - known[-1].indentation) >= 0.99 * way and len(known) < 3:
                known.append(state)
        return known if len(known) > 1 else [near, *behind[:1]]

    def _aside(self, other: State) -> State:
        """Guess from the state without inclusion and the difference that the inclusion made before."""
        assert self.beside is not None
        pairs = [
            (s, o)
            for s in self.states
            for o in self.beside.states
            if s.indentation == o.indentation and s.indentation != self.states[0].indentation
        ]
        if pairs:
            s, o = min(pairs, key=lambda pair: abs(pair[0].indentation - other.indentation))
            scale = (other.indentation - self.states[0].indentation) / (
                s.indentation - self.states[0].indentation
            )
            difference, slip = scale * (s.moved - o.moved), scale * (s.model.shift - o.model.shift)
            turned = scale * (s.tie.slope - o.tie.slope)
            other = replace(other, tie=replace(other.tie, slope=other.tie.slope + turned))
        elif other.closed.all() and self.states[0].closed.all():
            rates = [p.rate() for p in (self, self.beside)]
            difference = (rates[0] - rates[1]) * other.indentation
            slip = other.model.interface.slip(difference)
        elif other.model.finite:
            own, theirs = (p.small().to(other.indentation) for p in (self, self.beside))
            difference = own.moved - theirs.moved
            slip = other.model.interface.slip(difference)
        else:
            difference, slip = np.zeros_like(other.moved), np.zeros_like(other.model.shift)
        guess = replace(other, moved=other.moved + difference)
        return (
            replace(guess, model=other.model.follow(other.model.shift + slip))
            if other.model.finite
            else guess
        )

    def small(self) -> Path:
        """The same press in small strain."""
        if self._linear is None:
            model = replace(self.states[0].model, finite=False)
            beside = None if self.beside is None else self.beside.small()
            self._linear = path(self.geometry, model, self.body.stiff, beside)
        return self._linear

    def per_mm(self) -> State:
        """Equilibrium of a linear press of 1 mm with all pairs closed, on the undeformed mesh; cheap when
        `rate` is."""
        first = self.states[0]
        model = replace(first.model, finite=False)
        rate = self.rate()
        forces = model.nodal(product(self.body.rest, rate, model))
        nodes, closed = model.nodes, np.ones(first.closed.shape, dtype=bool)
        chest = -forces[nodes.chest].sum(axis=0)
        return State(1.0, rate, closed, -forces[nodes.tip, 2], chest, model, first.tie)

    def rate(self) -> Floats:
        """Displacements per mm of a linear press with all pairs closed, (nodes, 3) mm / mm.

        Cheap as long as the factor is that of the bodies at rest: ask before a finite press begins.
        """
        if self._rate is None:
            model = self.states[0].model
            sys = model.system(np.ones(model.nodes.tip.shape, dtype=bool))
            held = model.chest(1.0)
            load = -sys.gather(model.nodal(product(self.body.rest, held, model)))
            factor = self.body.factor(sys, self.body.rest)
            self._rate = sys.expand(factor.factor.solve(load, matrices=self.body.rest)) + held
        return self._rate


def path(geometry: Geometry, model: Model, inclusion: bool, beside: Path | None = None) -> Path:
    """Start at first touch. `beside`: the path without inclusion, whose factor is shared."""
    shear, bulk = moduli(geometry, model, inclusion)
    rest = AtRest(model.quad, shear, bulk, np.float32 if model.finite else np.float64)
    body = Body(shear, bulk, rest, model.finite, inclusion, {} if beside is None else beside.body.factors)
    still = np.zeros_like(model.place)
    bond = level(model.interface)
    clearance = bond.gap(model.place)
    flat = bool(np.abs(clearance).max() < 1e-9)
    start = 0.0 if flat else float(clearance.min() / model.normal[2])
    closed = np.full(clearance.shape, flat)
    apart = still - start * model.normal * model.slab
    nothing = State(start, apart, closed, np.zeros(closed.shape), np.zeros(3), model, bond)
    return Path(geometry, body, [nothing], beside)
