"""The press: closed form, balance, linearity, symmetry, and refusal of what is not modelled."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import fem

LAYERS = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
PROBE = fem.Probe(25, LAYERS)
SLAB = fem.Slab(30, 60, 5)
BALL = fem.Inclusion(10, 5, 100)
# small strain, which has closed forms; tests/test_fem_finite.py presses at finite strain
press = partial(fem.press, mechanics="linear")
FIELDS = ("displacement", "pressure", "displacement_0", "pressure_0")


@pytest.fixture(scope="module")
def pressed() -> fem.Press:
    return press(PROBE, SLAB, BALL, 1.0, quality="preview")


def test_column_is_springs_in_series() -> None:
    """With Poisson's ratio 0 and the slab as wide as the probe, F = indentation * area / sum(t / E)."""
    layers = tuple(fem.Layer(layer.thickness_mm, layer.modulus_kPa, 0.0) for layer in LAYERS)
    answer = press(fem.Probe(25, layers), fem.Slab(30, 25, 5, 0.0), None, 1.5, quality="preview")
    stress = 1.5 / (2 / 27 + 3 / 61 + 5 / 156 + 30 / 5)
    assert answer.force_N == pytest.approx(1e-3 * stress * 625, rel=1e-12)
    np.testing.assert_allclose(answer.surface["pressure"], stress, rtol=1e-10)
    pushed = stress * (2 / 27 + 3 / 61 + 5 / 156)
    np.testing.assert_allclose(answer.surface["displacement"][:, 2], -pushed, rtol=1e-10)


def test_force_balances(pressed: fem.Press) -> None:
    """Newton's third law: contact force = chest wall's reaction, and pressure * area sums to it."""
    assert pressed.chest_force_N == pytest.approx(pressed.force_N, rel=1e-10)
    surface = pressed.surface
    assert 1e-3 * surface["pressure"] @ surface["area"] == pytest.approx(pressed.force_N, rel=1e-12)
    assert 1e-3 * surface["pressure_0"] @ surface["area"] == pytest.approx(pressed.force_0_N, rel=1e-12)
    assert surface["area"].sum() == pytest.approx(625, rel=1e-12)


def test_pressures_are_positive_and_rise_over_the_inclusion(pressed: fem.Press) -> None:
    surface = pressed.surface
    assert pressed.min_pressure_kPa == min(surface["pressure"].min(), surface["pressure_0"].min()) > 0
    middle = np.linalg.norm(surface.points, axis=1).argmin()
    assert 1.1 < surface["pressure"][middle] / surface["pressure_0"][middle] < 2
    assert pressed.force_N > pressed.force_0_N


def test_stiffness_is_plausible(pressed: fem.Press) -> None:
    """About 0.28 N per mm; below that of the confined column, above that of a bare column."""
    assert 0.625 * 5 / 31 < pressed.force_0_N < 0.625 * 5 * 0.51 / (1.49 * 0.02) / 30
    assert pressed.force_0_N == pytest.approx(0.275, rel=0.02)


def test_frames(pressed: fem.Press) -> None:
    """Glass at rest, chest wall at -indentation, surface pushed in (negative z) from its points at z = 0."""
    cut = pressed.cut
    assert cut.points[:, 2].min() == pytest.approx(-10)
    assert np.all(cut["displacement"][cut.points[:, 2] < -10 + 1e-9] == 0)
    wall = cut["displacement"][cut.points[:, 2] > 30 - 1e-9]
    np.testing.assert_allclose(wall, np.tile([0, 0, -1.0], (len(wall), 1)), atol=1e-12)
    assert np.all(pressed.surface["displacement"][:, 2] < 0)
    assert np.all(pressed.surface.points[:, 2] == 0)
    assert set(np.unique(cut["material"])) == {0, 1, 2, 3, 4}


def test_cut_shows_the_sphere(pressed: fem.Press) -> None:
    """The inclusion's cells on the cut fill a disc of the right area, centre and top."""
    cut = pressed.cut.compute_cell_sizes(length=False, volume=False)
    ball = cut.extract_cells(cut["material"] == 1)
    assert ball["Area"].sum() == pytest.approx(np.pi * 25, rel=0.01)
    assert ball.bounds[4] == pytest.approx(5.0) and ball.bounds[5] == pytest.approx(15.0)
    assert cut["Area"].sum() == pytest.approx(30 * 60 + 10 * 25, rel=1e-6)


def test_plain_tissue_holds_no_inclusion(pressed: fem.Press) -> None:
    """Its mesh keeps the cells for one, but their material is tissue, in the cut and in the volume."""
    plain = press(PROBE, SLAB, None, 1.0, quality="preview")
    for with_one, without in ((pressed.cut, plain.cut), (pressed.volume(), plain.volume())):
        assert 1 in with_one.cell_data["material"]
        assert 1 not in without.cell_data["material"] and {0, 2, 3, 4} == {*without.cell_data["material"]}


def test_twice_the_press_twice_the_answer(pressed: fem.Press) -> None:
    twice = press(PROBE, SLAB, BALL, 2.0, quality="preview")
    for name in FIELDS:
        np.testing.assert_allclose(twice.surface[name], 2 * pressed.surface[name], rtol=1e-12, atol=1e-15)
    assert twice.force_N == pytest.approx(2 * pressed.force_N, rel=1e-12)


def test_press_by_force(pressed: fem.Press) -> None:
    """Both states carry the force; its indentation gives the force back."""
    answer = press(PROBE, SLAB, BALL, force=1.0, quality="preview")
    assert answer.force_N == pytest.approx(1.0, rel=1e-12)
    assert answer.force_0_N == pytest.approx(1.0, rel=1e-12)
    assert answer.indentation_mm == pytest.approx(1 / pressed.force_N, rel=1e-12)
    assert answer.indentation_0_mm == pytest.approx(1 / pressed.force_0_N, rel=1e-12)


def test_symmetry(pressed: fem.Press) -> None:
    """Swapping x and y, or mirroring either, swaps or mirrors the fields."""
    surface = pressed.surface
    n = round(surface.n_points**0.5)
    pressure = surface["pressure"].reshape(n, n)
    moved = surface["displacement"].reshape(n, n, 3)
    np.testing.assert_allclose(pressure, pressure.T, rtol=1e-9)
    np.testing.assert_allclose(moved, moved.transpose(1, 0, 2)[:, :, [1, 0, 2]], atol=1e-12)
    np.testing.assert_array_equal(pressure, pressure[::-1])
    np.testing.assert_array_equal(moved[..., 0], -moved[::-1, :, 0])


def test_inclusion_of_tissue_is_invisible() -> None:
    answer = press(PROBE, SLAB, fem.Inclusion(10, 5, SLAB.modulus_kPa), 1.0, quality="preview")
    tared = answer.surface["displacement"] - answer.surface["displacement_0"]
    assert np.abs(tared).max() < 1e-10
    assert fem.scalars(answer.surface, 2.0)["tared"]["area_mm2"] == 0


def test_stiffer_larger_and_shallower_show_more() -> None:
    def signal(size: float, depth: float, modulus: float) -> dict[str, float]:
        answer = press(PROBE, SLAB, fem.Inclusion(size, depth, modulus), 1.0, quality="preview")
        return fem.scalars(answer.surface, 2.0)["tared"]

    base = signal(8, 6, 40)
    assert signal(8, 6, 120)["max_mm"] > 1.05 * base["max_mm"]
    assert signal(10, 6, 40)["max_mm"] > 1.3 * base["max_mm"]
    assert signal(8, 5, 40)["max_mm"] > 1.1 * base["max_mm"]
    assert signal(8, 6, 2)["total_mm3"] < 0  # softer than tissue: gives way


def test_no_inclusion() -> None:
    answer = press(PROBE, SLAB, None, 1.0, quality="preview")
    np.testing.assert_array_equal(answer.surface["pressure"], answer.surface["pressure_0"])
    assert fem.scalars(answer.surface, 2.0)["tared"] == {"max_mm": 0, "total_mm3": 0, "area_mm2": 0}


@pytest.mark.parametrize(
    ("inclusion", "kind", "says"),
    [
        (fem.Inclusion(10, 5, 100, offset=(13.0, 0.0)), fem.NotModelled, "inclusion.offset"),
        (fem.Inclusion(24, 3, 100), fem.NotModelled, "inclusion.size"),
        (fem.Inclusion(13, 17.5, 100), ValueError, "inclusion.depth"),
        (fem.Inclusion(13, 5, 100, offset=(24.0, 0.0)), ValueError, "inclusion.offset"),
    ],
)
def test_refused_inclusions(inclusion: fem.Inclusion, kind: type[ValueError], says: str) -> None:
    with pytest.raises(kind, match=says) as caught:
        press(PROBE, SLAB, inclusion, 1.0, quality="preview")
    assert (
        "received" in str(caught.value) and "allowed" in str(caught.value) and "\n" not in str(caught.value)
    )


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({}, "indentation"),
        ({"indentation": 1.0, "force": 1.0}, "indentation"),
        ({"indentation": -1.0}, "indentation"),
        ({"indentation": float("nan")}, "indentation"),
        ({"force": 0.0}, "force"),
        ({"indentation": 1.0, "quality": "best"}, "quality"),
    ],
)
def test_refused_presses(given: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says) as caught:
        press(PROBE, SLAB, BALL, **given)  # type: ignore[arg-type]
    assert (
        "received" in str(caught.value) and "allowed" in str(caught.value) and "\n" not in str(caught.value)
    )


def test_overhanging_probe_is_refused() -> None:
    with pytest.raises(fem.NotModelled, match=r"probe\.width_mm.*overhangs"):
        press(PROBE, fem.Slab(30, 20, 5), None, 1.0)


@pytest.mark.parametrize(
    "build",
    [
        lambda: fem.Layer(-1, 27),
        lambda: fem.Layer(1, 27, 0.5),
        lambda: fem.Probe(25, ()),
        lambda: fem.Slab(30, 60, 0),
        lambda: fem.Inclusion(0, 5, 100),
        lambda: fem.Inclusion(10, float("inf"), 100),
    ],
)
def test_impossible_nouns_are_refused(build: object) -> None:
    with pytest.raises(ValueError):
        build()  # type: ignore[operator]


def test_progress_rises_to_one() -> None:
    seen: list[float] = []
    press(PROBE, SLAB, fem.Inclusion(6, 6, 60), 1.0, quality="preview", progress=lambda _, f: seen.append(f))
    assert seen == sorted(seen) and seen[-1] == 1.0


_HASH = """
import hashlib, fem, numpy as np
layers = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
probe, slab = fem.Probe(25, layers), fem.Slab(30, 60, 5)
answer = fem.press(probe, slab, fem.Inclusion(10, 5, 100), 1.0, mechanics="linear", quality="preview")
names = ("displacement", "pressure", "displacement_0", "pressure_0")
print(hashlib.sha256(b"".join(np.asarray(answer.surface[n]).tobytes() for n in names)).hexdigest())
"""


def test_same_bytes_with_one_thread_and_two(pressed: fem.Press) -> None:
    """The sums are taken in an order that the number of threads does not touch."""
    here = hashlib.sha256(b"".join(np.asarray(pressed.surface[n]).tobytes() for n in FIELDS)).hexdigest()
    root = str(Path(fem.__file__).parent.parent)
    for threads in ("1", "2"):
        names = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
        env = {**os.environ, **dict.fromkeys(names, threads), "PYTHONPATH": root}
        run = subprocess.run(
            [sys.executable, "-c", _HASH], env=env, capture_output=True, text=True, check=True
        )
        assert run.stdout.strip() == here
