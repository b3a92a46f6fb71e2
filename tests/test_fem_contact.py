"""Contact that opens, and presses off the centre: complementarity, symmetry, smoothness."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

import fem
from fem.equilibrium import equilibrium
from fem.mesh import QUALITIES, Geometry
from fem.meshed import build
from fem.path import path
from fem.pressing import Mechanics
from fem.solver import one_thread

Floats = NDArray[np.float64]

LAYERS = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
PROBE = fem.Probe(25, LAYERS)
DOMED = fem.Probe(25, LAYERS, dome_radius_mm=150)
SLAB = fem.Slab(30, 60, 5)


def press(size: float = 10, depth: float = 5, offset: tuple[float, float] = (0.0, 0.0)) -> fem.Press:
    """1 mm, small strain, preview."""
    ball = fem.Inclusion(size, depth, 100, offset=offset)
    return fem.press(PROBE, SLAB, ball, 1.0, mechanics="linear", quality="preview", estimate=False)


def tared(answer: fem.Press) -> Floats:
    """Tared displacement into the probe on the grid (nx, ny), mm."""
    x = np.unique(answer.surface.points[:, 0].round(9))
    signal = (answer.surface["displacement_0"] - answer.surface["displacement"])[:, 2]
    return np.asarray(signal).reshape(len(x), -1)


def largest(answer: fem.Press) -> float:
    return float(fem.scalars(answer.surface, 2.0)["tared"]["max_mm"])


@pytest.mark.parametrize("mechanics", ["linear", "finite"])
def test_a_dome_opens_at_its_corners(mechanics: Mechanics) -> None:
    """Signorini's conditions: force >= 0, gap >= 0, and never both."""
    ball = fem.Inclusion(10, 5, 100)
    answer = fem.press(DOMED, SLAB, ball, 1.0, mechanics=mechanics, quality="preview", estimate=False)
    assert answer.path == "unilateral"
    assert answer.min_pressure_kPa == 0
    corner = np.abs(answer.surface.points[:, :2]).min(axis=1) > 12.5 - 1e-9
    assert (answer.surface["pressure"][corner] == 0).all()
    for state in answer._states:
        gap = state.tie.gap(state.model.place + state.moved)
        assert state.force.min() >= 0
        assert gap.min() >= -1e-9
        assert np.abs(state.force * gap).max() <= 1e-10 * state.force.max()
        assert not state.closed[-1, -1] and state.closed[0, 0]


@pytest.mark.parametrize("rise", [0.4, -0.4])
def test_a_pair_that_is_pushed_far_in_comes_back(rise: float) -> None:
    """As pairs that have just closed are: volumes beside them are so far off that no tangent is definite."""
    geometry = Geometry(PROBE, SLAB)
    with one_thread():
        way = path(geometry, build(geometry, QUALITIES["preview"], True), False)
        state = way.to(1.0)
        moved = state.moved.copy()
        moved[state.model.interface.slab[5, 5], 2] += rise
        back = equilibrium(way.body, replace(state, moved=moved))
    np.testing.assert_allclose(back.moved, state.moved, atol=1e-4)
    assert back.force.sum() == pytest.approx(state.force.sum(), rel=1e-4)  # as far as turns settle


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_dome_closes_on_its_way_down() -> None:
    """The probe's corners come down between 2 and 3 mm; the answer does not depend on the way there, and what
    presses on the probe presses on the chest wall."""
    dome, slab = fem.Probe(25, LAYERS, dome_radius_mm=100), fem.Slab(60, 60, 5)
    ball = fem.Inclusion(10, 5, 100)
    several = fem.press(dome, slab, ball, [2.0, 3.0], estimate=False)
    (once,) = fem.press(dome, slab, ball, [3.0], estimate=False)
    assert [one.path for one in several] == ["unilateral", "sliding"]
    for name in ("displacement", "displacement_0"):
        np.testing.assert_allclose(once.surface[name], several[1].surface[name], atol=5e-4)
    assert once.force_N == pytest.approx(several[1].force_N, rel=1e-5)
    for one in several:
        assert one.chest_force_N == pytest.approx(one.force_N, rel=1e-6)


@pytest.mark.slow
def test_symmetric_parts_stand_for_the_whole() -> None:
    """Quarter, half and full mesh (forced by an offset of a nanometre or less) give one answer."""
    quarter, half, full = (press(offset=o) for o in ((0.0, 0.0), (1e-9, 0.0), (1e-9, 1e-9)))
    assert quarter.dof < half.dof < full.dof
    for other in (half, full):
        assert largest(other) == pytest.approx(largest(quarter), rel=1e-4)
        assert other.force_N == pytest.approx(quarter.force_N, rel=1e-6)
        assert other.chest_force_N == pytest.approx(other.force_N, rel=1e-6)


@pytest.mark.slow
def test_offsets_mirror() -> None:
    """The inclusion on the other side, or along the other axis, mirrors or swaps the fields."""
    right, left, up = (press(offset=o) for o in ((3.0, 0.0), (-3.0, 0.0), (0.0, 3.0)))
    assert right.dof > press().dof
    field = tared(right)
    tolerance = 1e-6 * np.abs(field).max()
    np.testing.assert_allclose(tared(left), field[::-1], atol=tolerance)
    np.testing.assert_allclose(tared(up), field.T, atol=tolerance)
    at = right.surface.points[np.argmax(field.ravel()), 0]
    assert 1.0 < at < 5.0


def roughness(values: list[float]) -> float:
    """Largest second difference, over the largest value."""
    return float(np.abs(np.diff(values, 2)).max() / max(values))


@pytest.mark.slow
def test_answers_are_smooth_in_the_offset() -> None:
    assert roughness([largest(press(offset=(float(o), 0.0))) for o in np.linspace(-0.8, 0.8, 9)]) < 2e-3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["size", "depth", "offset"])
def test_answers_are_smooth(name: str) -> None:
    """Fifty steps of size, depth and offset: no jitter from meshing."""
    if name == "size":
        answers = [press(size=float(v)) for v in np.linspace(5, 10, 50)]
    elif name == "depth":
        answers = [press(depth=float(v)) for v in np.linspace(4, 9, 50)]
    else:
        answers = [press(offset=(float(v), 0.0)) for v in np.linspace(-2.5, 2.5, 50)]
    found = roughness([largest(a) for a in answers])
    print(f"{name}: largest second difference {found:.1e} of the largest value")
    assert found < 2e-3
