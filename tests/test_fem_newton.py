"""Newton's method with pressures that the last step foresaw."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import fem
from fem import elasticity, mesh
from fem.equilibrium import equilibrium
from fem.mesh import Geometry
from fem.meshed import Model, build, moduli
from fem.path import Path, path
from fem.solver import one_thread

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
GEOMETRY = Geometry(PROBE, fem.Slab(30, 60, 5, 0.499), fem.Inclusion(10, 5, 100))


@pytest.fixture(scope="module")
def model() -> Model:
    return build(GEOMETRY, mesh.QUALITIES["preview"], True)


@pytest.fixture(scope="module")
def pressed(model: Model) -> Iterator[Path]:
    with one_thread():
        way = path(GEOMETRY, model, False)
        way.to(1.0)
        yield way


def test_foreseen_volumes_are_right_to_first_order(model: Model) -> None:
    """What is left of a change ten times smaller is a hundred times less."""
    rng = np.random.default_rng(0)
    moved, change = 0.05 * rng.normal(size=(2, *model.place.shape))
    none = np.zeros_like(change)

    def missed(share: float) -> float:
        foreseen = elasticity.volumes(model.quad, moved, share * change)
        return float(np.abs(foreseen - elasticity.volumes(model.quad, moved + share * change, none)).max())

    assert missed(0.01) == pytest.approx(missed(0.1) / 100, rel=0.2)


def test_their_own_volumes_leave_the_tangent_as_it_is(model: Model) -> None:
    rng = np.random.default_rng(1)
    moved, some = 0.02 * rng.normal(size=model.place.shape), np.arange(5)
    shear, bulk = (each[some] for each in moduli(GEOMETRY, model, True))
    volume = elasticity.volumes(model.quad, moved, np.zeros_like(moved))
    plain = elasticity.stiffness(model.quad, shear, bulk, moved, some)
    given = elasticity.stiffness(model.quad, shear, bulk, moved, some, volume=volume[some])
    other = elasticity.stiffness(model.quad, shear, bulk, moved, some, volume=volume[some] + 1e-3)
    np.testing.assert_allclose(given, plain, rtol=0, atol=1e-12 * np.abs(plain).max())
    assert np.abs(other - plain).max() > 1e-6 * np.abs(plain).max()


def test_a_long_step_needs_no_detour(pressed: Path) -> None:
    """From 1 to 2 mm the extrapolated volumes, and so the pressures, are far off: with those pressures the
    tangent is not definite, and steps are damped, each with factors of its own. With those foreseen the same
    equilibrium takes one factor, and fewer steps."""
    body, guess = pressed.body, pressed._ahead(pressed.states[-1], 2.0)
    effort, taken, found = body.effort, [], []
    for start in (
        guess,
        replace(guess, volume=elasticity.volumes(guess.model.quad, guess.moved, 0 * guess.moved)),
    ):
        body.turns.forget()
        before = effort.factors, effort.newton
        found.append(equilibrium(body, start))
        taken.append((effort.factors - before[0], effort.newton - before[1]))
    print(taken, np.abs(found[0].force - found[1].force).max() / found[0].force.max())
    (factors, steps), (more, longer) = taken
    assert factors == 1 and more >= 4
    assert steps < 0.75 * longer
    np.testing.assert_allclose(found[0].force, found[1].force, rtol=0, atol=1e-5 * found[0].force.max())
