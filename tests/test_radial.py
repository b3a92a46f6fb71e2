"""Radial kernels from their transforms, and their sums over cells."""

import numpy as np
import pytest
from scipy.special import k0, k1

from scenes.radial import Kernel, kernel
from scenes.slab import Slab

BODIES = [Slab(0.98), Slab(0.5), Slab(0.95, 2.0), Slab(0.9, 0.3, 0.8), Slab(0.99, 0.05, 0.9)]


def of(body: Slab) -> Kernel:
    return kernel(body.reflectance, body.first, body.decay_rate, body.bend)


def test_known_pairs_come_back() -> None:
    """exp(-b r)/(2π r) <-> 1/sqrt(k² + b²), K0(b r)/2π <-> 1/(k² + b²), at rates other than the tail's."""
    mixed = kernel(lambda k: 1 / np.sqrt(k**2 + 0.3**2) + 2 / (k**2 + 0.5**2), 1.0, 0.3, 1.0)
    r = np.array([0.01, 0.1, 1.0, 5.0, 20.0])  # the taper shows where the profile has fallen by exp(-6)
    exact = np.exp(-0.3 * r) / (2 * np.pi * r) + 2 * k0(0.5 * r) / (2 * np.pi)
    np.testing.assert_allclose(mixed.profile(r[:-1]), exact[:-1], rtol=2e-5)
    np.testing.assert_allclose(mixed.profile(r[-1:]), exact[-1:], rtol=5e-4)
    inside = (1 - np.exp(-0.3 * r)) / 0.3 + 2 / 0.25 * (1 - 0.5 * r * k1(0.5 * r))
    np.testing.assert_allclose(mixed.within(r), inside, rtol=2e-5)


@pytest.mark.parametrize("body", BODIES)
def test_series_is_the_transform(body: Slab) -> None:
    k = np.array([0.0, 0.03, 0.5, 2.0, 9.0, 45.0, 200.0])
    np.testing.assert_allclose(of(body).transform(k), body.reflectance(k), rtol=1e-9)


@pytest.mark.parametrize("body", BODIES)
def test_profile_is_positive_and_its_sum_is_the_share_within(body: Slab) -> None:
    curve = of(body)
    r = np.geomspace(1e-3, 40.0, 1001)
    profile, inside = curve.profile(r), curve.within(r)
    assert np.all(profile > -1e-15)  # rounding, where nothing is left
    summed = np.trapezoid(2 * np.pi * r**2 * profile, np.log(r))
    assert summed == pytest.approx(inside[-1] - inside[0], rel=2e-4)
    assert inside[-1] == pytest.approx(curve.total, rel=5e-4)


def test_profile_rises_as_light_scattered_once_in_the_middle() -> None:
    """R -> a/(4π r): c1 = a/2."""
    r = np.array([1e-3])
    assert Slab(0.98).albedo / (4 * np.pi * r[0]) == pytest.approx(of(Slab(0.98)).profile(r)[0], rel=5e-3)


def test_cell_onto_itself_is_the_mean_inverse_distance_in_a_square() -> None:
    """∬ 1/|x - y| over two points of the unit square is 4 ln(1 + √2) - 4 (√2 - 1)/3."""
    inverse = Kernel(0.0, (1.0, 0.0, 1e-9), 1.0, np.zeros(1))  # 1/(2π r)
    exact = (4 * np.log(1 + np.sqrt(2)) - 4 * (np.sqrt(2) - 1) / 3) / (2 * np.pi)
    assert inverse.cells(1.0, 4)[0, 0] == pytest.approx(exact, rel=5e-4)


@pytest.mark.parametrize(("body", "step", "count"), [(Slab(0.98), 0.3, 200), (Slab(0.9, 0.3, 0.8), 2.0, 40)])
def test_cells_lose_no_light(body: Slab, step: float, count: int) -> None:
    curve = of(body)
    cells = curve.cells(step, count)
    everywhere = 4 * cells[1:, 1:].sum() + 2 * cells[1:, 0].sum() + 2 * cells[0, 1:].sum() + cells[0, 0]
    assert everywhere == pytest.approx(curve.total, rel=3e-5)
    np.testing.assert_allclose(cells, cells.T, rtol=1e-12)


def test_far_cells_are_the_profile_times_the_area() -> None:
    curve, step = of(Slab(0.98)), 0.1
    cells = curve.cells(step, 120)
    for i, j in ((8, 0), (11, 5), (13, 0), (12, 3), (30, 40), (100, 0)):
        assert cells[i, j] / step**2 == pytest.approx(
            curve.profile(np.array([step * np.hypot(i, j)]))[0], rel=4e-3
        )


def test_small_body_in_a_large_cell_stays_there() -> None:
    cells = of(Slab(0.9, 0.3)).cells(400.0, 5)
    assert cells[0, 0] == pytest.approx(Slab(0.9, 0.3).reflectance(np.zeros(1))[0], rel=4e-3)
