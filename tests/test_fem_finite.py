"""Finite strain: forces of an energy, objectivity, the closed form of uniaxial stress, and whole presses."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from skfem import MeshHex2
from test_fem_element import curved_cube, integrals

import fem
from fem import elasticity, equilibrium
from fem.quadrature import Quadrature

Floats = NDArray[np.float64]

LAYERS = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
PROBE = fem.Probe(25, LAYERS)
SLAB = fem.Slab(30, 60, 5)
BALL = fem.Inclusion(10, 5, 100)


def block() -> tuple[MeshHex2, Quadrature, Floats, Floats]:
    """Curved mesh of eight elements, its moduli (E = 5 kPa, nu = 0.49)."""
    mesh = curved_cube(2)
    shear, bulk = elasticity.lame(np.full(8, 5.0), np.full(8, 0.49))
    return mesh, integrals(mesh), shear, bulk


def nodal(quad: Quadrature, forces: Floats) -> Floats:
    """Sum of element forces (m, 27, 3) at the nodes, (nodes, 3)."""
    total = np.zeros((int(quad.nodes.max()) + 1, 3))
    np.add.at(total, quad.nodes, forces)
    return total


def random_motion(mesh: MeshHex2, seed: int) -> Floats:
    """A large smooth deformation with some noise, (nodes, 3)."""
    rng = np.random.default_rng(seed)
    place = mesh.doflocs.T
    return np.asarray(place @ (0.2 * rng.normal(size=(3, 3))) + 0.005 * rng.normal(size=place.shape))


def test_forces_are_the_derivative_of_the_energy() -> None:
    mesh, quad, shear, bulk = block()
    moved, way = random_motion(mesh, 1), np.random.default_rng(2).normal(size=(mesh.doflocs.shape[1], 3))
    found = float((nodal(quad, elasticity.forces(quad, moved, shear, bulk)[0]) * way).sum())
    h = 1e-6
    energy = [elasticity.forces(quad, moved + s * h * way, shear, bulk)[1] for s in (1, -1)]
    assert found == pytest.approx((energy[0] - energy[1]) / (2 * h), rel=1e-7)


def test_tangent_is_the_derivative_of_the_forces() -> None:
    mesh, quad, shear, bulk = block()
    moved, way = random_motion(mesh, 1), np.random.default_rng(2).normal(size=(mesh.doflocs.shape[1], 3))
    matrices = elasticity.stiffness(quad, shear, bulk, moved)
    found = (matrices @ way[quad.nodes].reshape(8, 81, 1)).reshape(8, 27, 3)
    h = 1e-6
    force = [elasticity.forces(quad, moved + s * h * way, shear, bulk)[0] for s in (1, -1)]
    expected = (force[0] - force[1]) / (2 * h)
    np.testing.assert_allclose(found, expected, atol=1e-7 * np.abs(expected).max())


def test_rotation_turns_forces_and_keeps_the_energy() -> None:
    mesh, quad, shear, bulk = block()
    moved, place = random_motion(mesh, 3), mesh.doflocs.T
    turn = np.linalg.qr(np.random.default_rng(4).normal(size=(3, 3)))[0]
    turn *= np.sign(np.linalg.det(turn))
    force, energy = elasticity.forces(quad, moved, shear, bulk)
    turned, same = elasticity.forces(quad, (place + moved) @ turn.T - place, shear, bulk)
    assert same == pytest.approx(energy, rel=1e-10)
    np.testing.assert_allclose(turned, force @ turn.T, atol=1e-10 * np.abs(force).max())


@pytest.mark.parametrize("stretch", [0.7, 0.9, 1.4])
def test_uniaxial_stress(stretch: float) -> None:
    """P = dW/d(lambda) with the lateral stretch b of no lateral stress; J = lambda b², I = lambda² + 2 b²:

    P = mu J^(-2/3) (lambda - I / (3 lambda)) + (kappa (J - 1) + c (J - 1)³) J / lambda, and in b it is 0; c
    is the modulus of the energy's quartic term.
    """
    mesh, quad, shear, bulk = block()
    mu, kappa = float(shear[0]), float(bulk[0])

    def piola(along: float, b: float) -> float:
        volume, trace = stretch * b**2, stretch**2 + 2 * b**2
        pressure = kappa * (volume - 1) + min(kappa, 50 * mu) * (volume - 1) ** 3
        return mu * volume ** (-2 / 3) * (along - trace / (3 * along)) + pressure * volume / along

    b = brentq(lambda b: piola(b, b), 0.5, 1.5, xtol=1e-15, rtol=1e-14)
    place = mesh.doflocs.T
    moved = place * (np.array([b, b, stretch]) - 1)
    force = nodal(quad, elasticity.forces(quad, moved, shear, bulk)[0])
    expected = piola(stretch, b)
    top = place[:, 2] > 1 - 1e-9
    assert force[top].sum(axis=0) == pytest.approx([0, 0, expected], abs=1e-8 * abs(expected))
    free = (place[:, 2] > 1e-9) & ~top
    assert np.abs(force[free]).max() < 1e-8 * abs(expected)  # no load inside or on the sides


def tared(answer: fem.Press) -> Floats:
    return np.asarray(answer.surface["displacement_0"] - answer.surface["displacement"])[:, 2]


def test_a_shallow_press_is_linear() -> None:
    finite, linear = (
        tared(
            fem.press(PROBE, SLAB, BALL, 0.01, mechanics=mechanics, quality="preview", estimate=False)  # type: ignore[call-overload]
        )
        for mechanics in ("finite", "linear")
    )
    assert np.abs(finite - linear).max() < 3e-3 * np.abs(linear).max()


@pytest.fixture(scope="module")
def levels() -> list[fem.Press]:
    return fem.press(PROBE, SLAB, BALL, [1.0, 2.0], quality="preview", estimate=False)


def test_a_press_balances(levels: list[fem.Press]) -> None:
    for answer in levels:
        surface = answer.surface
        assert answer.chest_force_N == pytest.approx(answer.force_N, rel=1e-8)
        for suffix, force in (("", answer.force_N), ("_0", answer.force_0_N)):
            total = 1e-3 * surface[f"pressure{suffix}"] @ surface[f"area{suffix}"]
            assert total == pytest.approx(force, rel=1e-10)
            assert surface[f"pressure{suffix}"].min() >= 0
        assert answer.path == ("unilateral" if answer.min_pressure_kPa == 0 else "sliding")
        assert answer.mechanics == "finite"


@pytest.mark.slow
@pytest.mark.parametrize("share, apart", [(1.0, 3e-4), (0.05, 5e-5)])
def test_levels_on_the_way_are_single_presses(
    share: float, apart: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """But for what turns of mesh and slopes stop at: where that is less, so is the difference."""
    for name in ("_SLIP", "_OFF", "_TIGHT"):
        monkeypatch.setattr(equilibrium, name, share * getattr(equilibrium, name))
    way, alone = (
        tared(fem.press(PROBE, SLAB, BALL, levels, quality="preview", estimate=False)[-1])
        for levels in ([1.0, 2.0], [2.0])
    )
    assert np.abs(way - alone).max() < apart * np.abs(alone).max()


def test_press_by_force() -> None:
    answer = fem.press(PROBE, SLAB, BALL, force=0.2, quality="preview", estimate=False)
    assert answer.force_N == pytest.approx(0.2, rel=2e-6)
    assert answer.force_0_N == pytest.approx(0.2, rel=2e-6)
    assert answer.indentation_mm < answer.indentation_0_mm


@pytest.mark.slow
def test_nearly_incompressible_tissue_does_not_lock() -> None:
    """To first order in 1 - 2 nu what compressibility changes is proportional to it: signal and force go to
    those of incompressible tissue. Elements that lock would be stiffer the nearer nu is to a half."""
    found = []
    for poisson in (0.49, 0.499, 0.4999):
        slab = fem.Slab(30, 60, 5, poisson=poisson)
        answer = fem.press(PROBE, slab, BALL, 1.0, quality="preview", estimate=False)
        found.append((1e3 * tared(answer).max(), answer.force_N))
        print(f"Poisson {poisson:g}: tared maximum {found[-1][0]:.3f} µm, force {found[-1][1]:.4f} N")
    values = np.array(found)
    limit = values[2] + (values[2] - values[1]) / 9  # 1 - 2 nu falls by ten from one to the next
    np.testing.assert_allclose((limit - values[0]) / (limit - values[1]), 10.0, rtol=0.15)
