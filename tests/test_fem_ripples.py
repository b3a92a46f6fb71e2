"""What an inclusion adds without ripples of its mesh: the identity behind it, symmetry, meshes that agree."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from test_fem_multipoles import PROBE, SLAB

import fem
import twin
from fem import mesh, sampling, specimen
from fem.emulator import lagrange
from fem.ground import carry, cubic
from fem.ground import lines as lines_of
from fem.lines import lines
from fem.ripples import expanded, without_ripples
from twin.emulate import plan_of

Floats = NDArray[np.float64]

LINE = np.linspace(-10.0, 10.0, 9)


def test_an_error_that_finite_strain_makes_more_of_is_taken_out() -> None:
    """Of a signal t and an error e, c_l (t + e) at each level and component: c_l t is left, whatever e is."""
    random = np.random.default_rng(3)
    true, error = random.normal(size=(2, 9, 9, 3))
    times = random.uniform(1.0, 1.4, (2, 1, 1, 3))
    full = times * (true + error)
    np.testing.assert_allclose(without_ripples(full, true + error, true, (LINE, LINE)), times * true)


def test_a_press_without_error_stays_as_it_is() -> None:
    full, small = np.random.default_rng(4).normal(size=(2, 9, 9))
    np.testing.assert_array_equal(without_ripples(full[None], small, small, (LINE, LINE))[0], full)


def test_plans_take_multipoles_where_these_reach_all_specimens() -> None:
    plan = plan_of(twin.load_design("tsis"))
    assert plan.degree == 8
    for ranges in ({"depth_mm": (2.0, 12.0)}, {"offset_mm": 8.0}, {"size_mm": (2.0, 16.0)}):
        bare = replace(plan, degree=0, ranges=replace(plan.ranges, **ranges))
        assert bare.by_multipoles() is bare


def test_solves_of_a_plan_are_multipoles_at_its_nodes() -> None:
    """For all its moduli; nothing is left to a finer mesh."""
    plan = plan_of(twin.load_design("tsis"))
    point = np.array([10.0, 5.0, 0.0, 0.0, 30.0, 5.0, 0.8])
    found = specimen.solve(plan, point)
    modulus = float(plan.ratios[1] * 5.0)
    slab = plan.slab(30.0, 5.0)
    tissue = fem.multipoles(plan.probe, slab, degree=8)
    (press,) = tissue.press(fem.Inclusion(10.0, 5.0, modulus), [1.0])
    data = press.surface.point_data
    rise = np.asarray(data["pressure"]) / data["pressure_0"] - 1.0
    to = lines(specimen.geometry_at(plan, point, 50.0), plan.resolution)
    np.testing.assert_allclose(found["rise"][1].ravel(), carry(rise, lines_of(press.surface), to), atol=1e-9)
    assert not specimen.refine(plan, point)["rise"].any()


@pytest.mark.slow
def test_meshes_that_follow_the_inclusion_come_nearer_as_they_are_refined() -> None:
    """Tared pressure off the edge, of its maximum: rms, and maxima, which are slow to come down."""
    ball, off = fem.Inclusion(8.0, 4.0, 100.0), {}
    fine = mesh.QUALITIES["reference"]
    finest = replace(fine, arc=8, shell=7, above=5, edge=4)
    for name, res in (*mesh.QUALITIES.items(), ("finest", finest)):
        with pytest.MonkeyPatch.context() as patch:
            patch.setitem(mesh.QUALITIES, "reference", res)
            press = fem.press(
                PROBE, SLAB, ball, 1.0, mechanics="linear", quality="reference", estimate=False
            ).surface
        own = lines_of(press)
        plain = np.asarray(press["pressure_0"]).reshape(own[0].size, own[1].size)
        tared = np.asarray(press["pressure"]).reshape(plain.shape) - plain
        tissue = fem.multipoles(PROBE, SLAB, degree=8)
        true = expanded(tissue, ball, [ball.modulus], own)[0][0] * plain
        inner = np.logical_and.outer(*(np.abs(line) < 10.0 for line in own))
        rms = np.sqrt(np.mean((tared - true)[inner] ** 2)) / true.max()
        off[name] = 100 * rms, 100 * (tared.max() / true.max() - 1)
        print(f"{name}: {off[name][0]:.2f} % rms, maximum {off[name][1]:+.2f} %")
    rms, maxima = np.array(list(off.values())).T
    assert (np.diff(rms) < 0).all() and rms[-1] < 0.5 * rms[0]
    assert (np.diff(maxima[1:]) < 0).all() and maxima[-1] < 0.7


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("ball", [(9.0, 6.0), (11.0, 5.0)])
def test_meshes_agree_at_finite_strain_once_ripples_are_out(ball: tuple[float, float]) -> None:
    """A lean mesh against one of standard quality, at 1, 2 and 3 mm: five times as near, off the edge."""
    plan = plan_of(twin.load_design("tsis"))
    point = np.array([*ball, 0.0, 0.0, 30.0, 5.0, 0.9])
    geometry = specimen.geometry_at(plan, point, 1.0)
    to, size = lines(geometry, sampling.FINE)[0], {}
    for degree in (0, plan.degree):
        found = []
        for res in (sampling.LEAN, sampling.FINE):
            some = replace(plan, degree=degree, coarse=res, resolution=sampling.STORED if degree else res)
            own = lines(geometry, res)[0], lines(geometry, some.resolution)[0]
            onto = [cubic(line, to) for line in own]
            small = specimen.solve(some, point)["rise"]
            along = sampling.contrast(plan.ratios), point[6]
            weights = lagrange(*along)
            small = np.tensordot(weights, small, 1)
            more = specimen.stretch(some, point)["rise"]
            whole = np.einsum("ai,cij,bj->cab", onto[0], more, onto[0]) + onto[1] @ small @ onto[1].T
            found.append(whole[:, 3:-3, 3:-3])
        away = np.sqrt(((found[0] - found[1]) ** 2).mean(axis=(1, 2))) / np.abs(found[1]).max(axis=(1, 2))
        size[degree] = 100 * away
    print("off by % rms, meshes alone", size[0], "without ripples", size[plan.degree])
    assert (size[plan.degree] < 0.2).all()
    assert (size[plan.degree][:2] < 0.25 * size[0][:2]).all()
