"""Spheres as multipoles in tissue that is solved once: closed forms, balance, presses meshed around them."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from numpy.typing import NDArray

import fem
from fem import mesh
from fem.ground import carry, lines
from fem.harmonics import Harmonic, harmonics, regular, singular
from fem.ripples import DEGREE, expanded
from fem.spheres import QUALITIES, Fineness
from fem.spherical import Field, answer, answering, displacements, fields, gradients, tractions
from fem.topology import Resolution

Floats = NDArray[np.float64]

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
TISSUE, STIFF = (1.7, 0.49), (34.0, 0.45)  # shear modulus, Poisson's ratio
NOWHERE = (False, False)


@pytest.fixture(scope="module")
def tissue() -> fem.Multipoles:
    return fem.multipoles(PROBE, SLAB, "preview")


def places(count: int, away: float = 1.0) -> Floats:
    at = np.random.default_rng(5).normal(size=(count, 3))
    return np.asarray(away * at / np.linalg.norm(at, axis=1)[:, None])


@pytest.mark.parametrize("outer", [False, True], ids=["regular", "singular"])
def test_harmonics_are_harmonic(outer: bool) -> None:
    some, at = tuple(harmonics(5)), places(7, 1.3)
    jet, step = (singular if outer else regular)(some, at), 1e-5
    assert len(some) == 36
    second = jet.second()
    np.testing.assert_allclose(np.trace(second, axis1=-2, axis2=-1), 0, atol=1e-10 * np.abs(second).max())
    for axis in range(3):
        ends = [(singular if outer else regular)(some, at + s * step * np.eye(3)[axis]) for s in (-1, 1)]
        for name, derived in (("value", jet.slope[..., axis]), ("slope", second[..., axis])):
            low, high = (getattr(end, name) for end in ends)
            np.testing.assert_allclose((high - low) / (2 * step), derived, atol=1e-7 * np.abs(derived).max())


@pytest.mark.parametrize("outer", [False, True], ids=["regular", "singular"])
def test_fields_balance(outer: bool) -> None:
    """Divergence of the stress, by differences: all fields, all directions."""
    some, at, step = fields(4, NOWHERE), places(5, 1.2), 1e-5
    if outer:
        some = answering(4, NOWHERE)
    size = np.abs(gradients(some, at, 0.47, outer)).max()
    total = 0.0
    for axis in range(3):
        normal = np.tile(np.eye(3)[axis], (len(at), 1))
        ends = [
            tractions(gradients(some, at + s * step * np.eye(3)[axis], 0.47, outer), normal, 1.0, 0.47)
            for s in (-1, 1)
        ]
        total = total + (ends[1] - ends[0]) / (2 * step)
    assert np.abs(total).max() < 1e-5 * size


def test_a_sphere_answers_so_that_nothing_jumps_on_it() -> None:
    """Displacement and traction on both sides, whatever the field: answer and what is within are found by
    least squares on the sphere, where `answer` solves four equations."""
    some, back, at = fields(4, NOWHERE), answering(4, NOWHERE), places(60)

    def rim(of: tuple[Field, ...], solid: tuple[float, float], outer: bool) -> Floats:
        pull = tractions(gradients(of, at, solid[1], outer), at, *solid)
        both = np.concatenate([displacements(of, at, solid[1], outer), pull], axis=-1)
        return np.asarray(both.transpose(0, 2, 1).reshape(-1, len(of)))

    matrix = np.hstack([rim(back, TISSUE, True), -rim(some, STIFF, False)])
    found = np.linalg.lstsq(matrix, -rim(some, TISSUE, False), rcond=None)[0]
    np.testing.assert_allclose(answer(some, back, TISSUE, STIFF), found[: len(back)], atol=1e-11)
    assert np.abs(matrix @ found + rim(some, TISSUE, False)).max() < 1e-10
    np.testing.assert_allclose(answer(some, back, TISSUE, TISSUE), 0, atol=1e-12)


@pytest.mark.parametrize("poisson", [0.45, 0.49, 0.4999])
def test_a_uniform_shear_is_answered_as_eshelby_has_it(poisson: float) -> None:
    """Far away the answer is a double force in proportion to what the sphere's stress is beyond the tissue's:
    the shear moduli's difference times Eshelby's strain within (1957, equation 3.5); in a rigid sphere, that
    over his beta."""
    shear = Field("gradient", Harmonic(2, 1, False))  # u = (z, 0, x)
    back = answering(2, NOWHERE)
    double = back.index(replace(shear, kind="dilating"))
    sent, rigid = (answer((shear,), back, (1.0, poisson), (s, 0.45))[double, 0] for s in (STIFF[0], 1e10))
    beta = 2 * (4 - 5 * poisson) / (15 * (1 - poisson))
    strain = 1 / (1 + beta * (STIFF[0] - 1))
    assert sent / rigid == pytest.approx((STIFF[0] - 1) * strain * beta, rel=1e-6)


def test_symmetric_fields_are_those_of_a_square() -> None:
    at = places(9)
    for some, outer in ((fields(5, (True, True)), False), (answering(5, (True, True)), True)):
        moved = displacements(some, at, 0.49, outer)
        for turn in (np.diag([-1.0, 1, 1]), np.diag([1.0, -1, 1]), np.eye(3)[[1, 0, 2]]):
            np.testing.assert_allclose(displacements(some, at @ turn, 0.49, outer), moved @ turn, atol=1e-12)
        more = fields(5, (True, False)) if not outer else answering(5, (True, False))
        assert len(some) < len(more) < len(fields(5, NOWHERE))


def test_own_moduli_leave_plain_tissue(tissue: fem.Multipoles) -> None:
    (same,), (plain,) = (tissue.press(ball, [1.0]) for ball in (fem.Inclusion(10, 5, SLAB.modulus_kPa), None))
    for name in ("displacement", "pressure"):
        np.testing.assert_allclose(same.surface[name], plain.surface[name], rtol=0, atol=1e-9)
    assert same.force_N == pytest.approx(plain.force_N, rel=1e-9)
    linear = fem.press(PROBE, SLAB, None, 1.0, mechanics="linear", quality="preview", estimate=False)
    assert plain.force_N == pytest.approx(linear.force_N, rel=0.01)


@pytest.mark.parametrize("case", ["centred", "beside", "mirrored tissue"])
def test_like_a_press_that_is_meshed_around_the_sphere(case: str, tissue: fem.Multipoles) -> None:
    ball = fem.Inclusion(10, 5, 100, offset=(3.0, 1.0) if case == "beside" else (0.0, 0.0))
    slab = replace(SLAB, width_mm=36.0, sides="symmetric") if case == "mirrored tissue" else SLAB
    made = tissue if slab is SLAB else fem.multipoles(PROBE, slab, "preview")
    (found,) = made.press(ball, [1.0])
    meshed = fem.press(PROBE, slab, ball, 1.0, mechanics="linear", quality="preview", estimate=False)
    ours, theirs = (fem.scalars(one.surface, 2.0)["tared"] for one in (found, meshed))
    more = (found.force_N - found.force_0_N) / (meshed.force_N - meshed.force_0_N) - 1
    maximum, total = (100 * (ours[name] / theirs[name] - 1) for name in ("max_mm", "total_mm3"))
    print(f"\nmaximum {maximum:+.2f} %, total {total:+.2f} %, force {100 * more:+.2f} %")
    assert abs(maximum) < 2.5 and abs(total) < 3.0 and abs(more) < 0.02
    inner = np.abs(np.asarray(found.surface.points)[:, :2]).max(axis=1) < 10.0
    tared = [np.asarray(one.surface["pressure"]) - one.surface["pressure_0"] for one in (found, meshed)]
    onto = carry(tared[1], lines(meshed.surface), lines(found.surface))
    off = np.sqrt(np.mean((tared[0] - onto)[inner] ** 2)) / onto[inner].max()
    print(f"tared pressure: {100 * off:.2f} % rms of its maximum")
    assert off < 0.02


def test_a_mirrored_offset_mirrors_the_answer(tissue: fem.Multipoles) -> None:
    ball = fem.Inclusion(8, 4.5, 60, offset=(2.0, -1.0))
    (one,), (other,) = (tissue.press(replace(ball, offset=o), [1.0]) for o in ((2.0, -1.0), (-2.0, -1.0)))
    count = lines(one.surface)[0].size
    grids = [np.asarray(each.surface["pressure"]).reshape(count, -1) for each in (one, other)]
    np.testing.assert_allclose(grids[0], grids[1][::-1], rtol=5e-5)
    assert one.force_N == pytest.approx(other.force_N, rel=1e-5)


def test_moduli_share_all_but_a_small_system(tissue: fem.Multipoles) -> None:
    ball, moduli = fem.Inclusion(10, 5, 100), [20.0, 60.0, 100.0, 200.0]
    together = tissue.press_moduli(ball, moduli, [1.0, 2.0])
    for modulus, levels in zip(moduli, together, strict=True):
        alone = tissue.press(replace(ball, modulus=modulus), [1.0, 2.0])
        for a, b in zip(levels, alone, strict=True):
            np.testing.assert_array_equal(a.surface["pressure"], b.surface["pressure"])
        assert levels[1].force_N == pytest.approx(2 * levels[0].force_N)
    tops = [fem.scalars(levels[0].surface, 2.0)["tared"]["max_mm"] for levels in together]
    assert all(a < b for a, b in pairwise(tops))


def test_by_force(tissue: fem.Multipoles) -> None:
    (found,) = tissue.press(fem.Inclusion(10, 5, 100), [0.5], by_force=True)
    assert found.force_N == pytest.approx(0.5) and found.force_0_N == pytest.approx(0.5)
    assert found.indentation_mm < found.indentation_0_mm


def test_answers_change_smoothly_with_depth(tissue: fem.Multipoles) -> None:
    """No mesh is made anew: third differences over 21 depths."""
    tops = [
        fem.scalars(tissue.press(fem.Inclusion(10, depth, 100), [1.0])[0].surface, 2.0)["tared"]["max_mm"]
        for depth in np.linspace(4.5, 5.5, 21)
    ]
    jumps = np.diff(tops, 3)
    assert np.abs(jumps).max() < 2e-4 * tops[0]


@pytest.mark.parametrize(
    ("inclusion", "word"),
    [
        (fem.Inclusion(10, 5, 100, stretch=(1.0, 1.0, 1.2)), "inclusion.stretch: received"),
        (fem.Inclusion(10, 5, 100, offset=(6.3, 0.0)), "inclusion.offset: received"),
        (fem.Inclusion(20, 12, 100), "inclusion.depth \\+ inclusion.size: received 32"),
        (fem.Inclusion(10, 2, 100), "inclusion.depth: received 2; .* allowed from 3 mm"),
    ],
)
def test_refused(tissue: fem.Multipoles, inclusion: fem.Inclusion, word: str) -> None:
    with pytest.raises(ValueError, match=word) as told:
        tissue.press(inclusion, [1.0])
    assert "\n" not in str(told.value)


def test_refused_probes() -> None:
    with pytest.raises(fem.NotModelled, match=r"probe\.dome_radius_mm: received 150"):
        fem.multipoles(replace(PROBE, dome_radius_mm=150.0), SLAB)
    with pytest.raises(fem.NotModelled, match="tilt: received"):
        fem.multipoles(PROBE, SLAB, pose=fem.Pose((1.0, 0.0)))
    with pytest.raises(ValueError, match="quality: received 'fine'"):
        fem.multipoles(PROBE, SLAB, "fine")


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("quality", "limits"), [("preview", (1.5, 3.0)), ("standard", (0.5, 0.7))])
def test_against_a_refined_mesh(
    quality: str, limits: tuple[float, float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The table of `fem.spheres.QUALITIES`: tared maximum and total, 1 mm, d >= 8 mm."""
    from test_fem_convergence import REFINED

    monkeypatch.setitem(mesh.QUALITIES, "refined", REFINED)
    made = fem.multipoles(PROBE, SLAB, quality)
    for size, depth, modulus in ((10, 5, 100), (12, 7, 40), (8, 6, 110), (13, 4, 120), (4, 6, 60)):
        ball = fem.Inclusion(size, depth, modulus)
        (found,) = made.press(ball, [1.0])
        fine = fem.press(PROBE, SLAB, ball, 1.0, mechanics="linear", quality="refined", estimate=False)
        ours, theirs = (fem.scalars(one.surface, 2.0)["tared"] for one in (found, fine))
        maximum, total = (100 * (ours[name] / theirs[name] - 1) for name in ("max_mm", "total_mm3"))
        force = 100 * ((found.force_N - found.force_0_N) / (fine.force_N - fine.force_0_N) - 1)
        print(f"\n{size, depth, modulus}: maximum {maximum:+.2f}, total {total:+.2f}, force {force:+.2f} %")
        assert abs(maximum) < limits[0]
        if size >= 8:
            assert abs(total) < limits[1]


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_plain_tissue_is_fine_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    """What spheres add to the pressure off the outermost mm, against finer tissue, eight degrees, over its
    maximum: deep ones and ones beside the middle feel the cells at the probe's edge most."""
    at, found = np.linspace(-11.4, 11.4, 77), {}
    finest = Fineness(Resolution(6, 0, 2, 2, 3, 9, 4, 1, 1, (0.8, 1.6)), 4)
    balls = (9, 6, 80, 0), (10, 11, 80, 0), (13, 4, 120, 0), (9, 6, 80, 5), (6, 11.6, 60, 5.8)
    for name, fineness in (("finest", finest), *QUALITIES.items()):
        monkeypatch.setitem(QUALITIES, name, fineness)
        some = (fem.Inclusion(size, depth, e, offset=(aside, 0)) for size, depth, e, aside in balls)
        tissue = fem.multipoles(PROBE, SLAB, name, degree=DEGREE)
        rises = [expanded(tissue, ball, [ball.modulus], (at, at))[0][0] for ball in some]
        found[name] = np.stack(rises)
    top = found["finest"].max(axis=(1, 2))
    for name, limits in (("preview", (0.8, 4.5)), ("standard", (0.13, 0.85))):
        off = found[name] - found["finest"]
        rms, most = 100 * np.sqrt((off**2).mean(axis=(1, 2))) / top, 100 * np.abs(off).max(axis=(1, 2)) / top
        print(f"\n{name}: {rms.round(2)} % rms, {most.round(2)} % at most")
        assert (rms < limits[0]).all() and (most < limits[1]).all()
