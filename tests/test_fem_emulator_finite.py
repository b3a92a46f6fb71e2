"""The emulator at finite strain: what it adds to small strain, and presses that it has not seen."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_fem_emulator import COARSE, FINER, INCLUSION, PLAN, PROBE, RANGES, SLAB, grids, silent

import fem
from fem.emulating import build_emulator
from fem.emulator import Emulator, lagrange, resample, signals
from fem.emulator_errors import off_the_edge
from fem.emulator_file import NotAnEmulator, load_emulator, save_emulator
from fem.mesh import Geometry
from fem.pressing import _presses
from fem.sampling import Plan, contrast
from fem.solving import file_of, solved, tally
from fem.specimen import geometry_at, solve, stretch

FINITE = replace(PLAN, mechanics="finite", coarse=COARSE, fine=FINER)
SAMPLES = 40


def deepest(depth: float) -> Plan:
    return replace(FINITE, ranges=replace(RANGES, indentation_mm=(depth / 30, depth)))


def presses(geometry: Geometry, levels: Sequence[float], mechanics: str) -> list[dict[str, np.ndarray]]:
    """Fields of presses on the coarse mesh, on its grid."""
    (found,) = _presses([geometry], levels, False, mechanics, COARSE, False, None)  # type: ignore[arg-type]
    return [grids(press) for press in found]


def test_what_finite_strain_adds_is_of_second_order() -> None:
    """Per mm of indentation it is proportional to the indentation, and vanishes with it: 15 times shallower,
    a fifteenth is added."""
    point = FINITE.point(1)
    deep, flat = (stretch(deepest(depth), point) for depth in (0.3, 0.02))
    for name in ("rise", "moved"):
        assert flat[name][1] == pytest.approx(2 * flat[name][0], abs=0.02 * np.abs(flat[name][1]).max())
        assert deep[name][2] == pytest.approx(15 * flat[name][2], abs=0.1 * np.abs(deep[name][2]).max())


def test_small_strain_and_what_is_added_are_the_finite_press() -> None:
    plan = deepest(1.5)
    point = plan.point(3)
    ratio = (1 + 1.5 * point[6]) / (1 - point[6])
    geometry = geometry_at(plan, point, float(ratio * point[5]))
    found, more = solve(plan, point), stretch(plan, point)
    along = lagrange(contrast(plan.ratios), float(point[6]))
    (press,) = presses(geometry, [1.0], "finite")
    rise = (along @ found["rise"].reshape(3, -1)).reshape(more["rise"][1].shape) + more["rise"][1]
    true = press["pressure"] - press["pressure_0"]
    assert rise * press["pressure_0"] == pytest.approx(true, abs=2e-3 * np.abs(true).max())
    moved = (along @ found["moved"].reshape(3, -1)).reshape(more["moved"][1].shape) + more["moved"][1]
    true = press["displacement"] - press["displacement_0"]
    assert moved == pytest.approx(true, abs=2e-3 * np.abs(true).max())


def test_solves_that_fail_are_kept_as_gaps_and_counted(tmp_path: Path) -> None:
    for number in range(4):
        place, values = file_of(tmp_path, "stretch", number), {} if number == 2 else {"rise": np.ones(3)}
        np.savez(place, point=np.zeros(7), seconds=1.0, **values)
    assert tally(tmp_path, "stretch") == (4, 1) and tally(tmp_path, "stretch", 2) == (2, 0)
    assert [int(f["number"]) for f in solved(tmp_path, "stretch")] == [0, 1, 3]


@pytest.fixture(scope="module")
def emulator(tmp_path_factory: pytest.TempPathFactory) -> Emulator:
    return build_emulator(FINITE, tmp_path_factory.mktemp("finite"), samples=SAMPLES, workers=2)


def without_gains(emulator: Emulator) -> Emulator:
    """What its samples say, on their own mesh."""
    gains = ("finer", "finer_tared", "finer_more", "finer_tared_more")
    return replace(emulator, **{name: silent(getattr(emulator, name)) for name in gains})


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_what_a_finer_mesh_adds_to_finite_strain_makes_up_for_the_coarse_one(emulator: Emulator) -> None:
    """What finite strain adds under the middle is the finer mesh's, of a press that no sample has."""
    s = float(np.mean(FINITE.signals))
    point = np.array([8.2, 5.4, 0.0, 0.0, 28.3, 5.1, s])
    geometry = geometry_at(FINITE, point, float((1 + 1.5 * s) / (1 - s) * point[5]))
    assert geometry.inclusion is not None
    onto = resample(geometry, FINER, emulator.x)
    solved = stretch(replace(FINITE, coarse=FINER), point)
    level, still = lagrange(FINITE.levels, float(FINITE.levels[2])), np.eye(4)[0]
    plain = without_gains(emulator)
    coarse = replace(emulator, finer_more=plain.finer_more, finer_tared_more=plain.finer_tared_more)
    for k, name in enumerate(("rise", "moved")):
        true = np.einsum("ai,ij...,bj->ab...", onto[0], solved[name][1], onto[1])
        off = []
        for one in (emulator, coarse):
            guess, small = signals(one, geometry.slab, geometry.inclusion, [level, still])
            off.append(np.abs(guess[k] - small[k] - true)[off_the_edge(emulator.x)].max())
        assert off[0] < 0.2 * off[1] and off[0] < 0.03 * np.abs(true).max()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_presses_between_the_levels_are_met(emulator: Emulator) -> None:
    """Finite presses of specimens and depths that no sample has, as far away as cross-validation says."""
    other, errors = replace(FINITE, seed=99), []
    lean = without_gains(emulator)  # on the samples' own mesh
    for number in (0, 4, 8):
        point = other.point(number)
        geometry = geometry_at(FINITE, point, float(FINITE.ratios[1] * point[5]))
        assert geometry.inclusion is not None
        onto = resample(geometry, COARSE, emulator.x)
        for level, press in zip((0.7, 2.4), presses(geometry, [0.7, 2.4], "finite"), strict=True):
            guess = signals(lean, geometry.slab, geometry.inclusion, [lagrange(FINITE.levels, level)])[0][0]
            # so few cells cannot interpolate the singular pressure itself, but what it rises by
            rise = (press["pressure"] - press["pressure_0"]) / press["pressure_0"]
            true = onto[0] @ rise @ onto[1].T
            errors.append(100 * np.abs(guess - true)[1:-1, 1:-1].max() / np.abs(true).max())
    assert max(errors) < 2 * np.percentile(emulator.errors.pressure[:, 0], 95) < 12.0


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_finite_answers_hold_together(emulator: Emulator) -> None:
    """The force is the pressure's integral over the deformed surface, grows faster than the depth, and is
    inverted; the file gives the same answers."""
    answer = emulator(PROBE, SLAB, INCLUSION, 2.5)
    data = answer.surface.point_data
    assert answer.mechanics == "finite"
    assert 1e-3 * (data["pressure"] * data["area"]).sum() == pytest.approx(answer.force_N)
    assert answer.force_N > 2.5 * emulator(PROBE, SLAB, INCLUSION, 1.0).force_N
    back = emulator(PROBE, SLAB, INCLUSION, force=answer.force_N)
    assert back.indentation_mm == pytest.approx(2.5, rel=1e-6)
    assert back.force_0_N == pytest.approx(answer.force_N, rel=1e-6) and back.indentation_0_mm > 2.5


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_finite_file(emulator: Emulator, tmp_path: Path) -> None:
    save_emulator(emulator, tmp_path / "a.npz")
    loaded = load_emulator(tmp_path / "a.npz")
    mine, theirs = (grids(e(PROBE, SLAB, INCLUSION, 2.0)) for e in (emulator, loaded))
    assert all(np.array_equal(mine[name], theirs[name]) for name in mine)
    wrong = replace(emulator, plan=replace(emulator.plan, mechanics="linear"))
    save_emulator(wrong, tmp_path / "b.npz")
    with pytest.raises(NotAnEmulator):
        load_emulator(tmp_path / "b.npz")
    with pytest.raises(fem.NotModelled, match="mechanics: received linear"):
        emulator(PROBE, SLAB, INCLUSION, 2.0, mechanics="linear")
