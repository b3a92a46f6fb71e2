"""What a rounded, clipped count tells: closed forms, its limits, and scores of sampled counts."""

import numpy as np
import pytest
from scipy.stats import norm

from estimation.quantised import count_divergence, count_information, outcome_probabilities

GRID = [(100.2, 0.01), (100.5, 0.04), (99.9, 0.3), (0.3, 0.5), (254.8, 2.0), (40.0, 9.0), (256.0, 4.0)]


def slow_chances(mean: float, variance: float, top: int = 255) -> np.ndarray:
    """Chance of each count by scipy's normal distribution; no code shared with the package."""
    edge = np.concatenate([[-np.inf], np.arange(top) + 0.5, [np.inf]])
    law = norm(mean, np.sqrt(variance))
    return np.where(
        edge[:-1] < mean, law.cdf(edge[1:]) - law.cdf(edge[:-1]), law.sf(edge[:-1]) - law.sf(edge[1:])
    )


@pytest.mark.parametrize(("mean", "variance"), GRID)
def test_chances_are_those_of_scipy(mean, variance):
    found = outcome_probabilities(mean, variance, 8)
    assert found.sum() == pytest.approx(1.0, abs=1e-14)
    assert found == pytest.approx(slow_chances(mean, variance), abs=1e-14)


@pytest.mark.parametrize(("mean", "variance"), GRID)
def test_information_is_the_covariance_of_the_scores(mean, variance):
    """Over all outcomes, with derivatives by central differences of scipy's chances."""
    step = 1e-5 * np.sqrt(variance), 1e-5 * variance
    chance = slow_chances(mean, variance)
    by_mean = (slow_chances(mean + step[0], variance) - slow_chances(mean - step[0], variance)) / (
        2 * step[0]
    )
    by_var = (slow_chances(mean, variance + step[1]) - slow_chances(mean, variance - step[1])) / (2 * step[1])
    seen = chance > 1e-13
    found = count_information(mean, variance, 8)
    scale = 1 / variance  # of the information of a normal count, which rounding cannot exceed
    for value, a, b, unit in (
        (found.mean, by_mean, by_mean, 1.0),
        (found.cross, by_mean, by_var, variance**-0.5),
        (found.variance, by_var, by_var, 1 / variance),
    ):
        assert float(value) == pytest.approx(
            (a * b / np.where(seen, chance, 1))[seen].sum(), abs=1e-6 * scale * unit
        )


def test_one_bit_is_a_coin():
    """bits = 1: a threshold at ½, information φ²/(Φ(1-Φ)) / v, 2/(π v) at the threshold."""
    mean, variance = np.linspace(-1.5, 2.5, 41), 0.3
    u = (mean - 0.5) / np.sqrt(variance)
    coin = norm.pdf(u) ** 2 / (norm.cdf(u) * norm.sf(u)) / variance
    assert count_information(mean, variance, 1).mean == pytest.approx(coin, rel=1e-9)
    assert count_information(0.5, variance, 1).mean == pytest.approx(2 / (np.pi * variance), rel=1e-12)


def test_far_below_one_count_only_thresholds_tell():
    """At σ = 0.05 a mean in the middle of a step tells nothing, one between two counts 2/π of all."""
    variance = 0.05**2
    middle, edge = count_information([100.0, 100.5], variance, 8).mean * variance
    assert middle < 1e-15
    assert edge == pytest.approx(2 / np.pi, rel=1e-9)


@pytest.mark.parametrize("sd", [1.0, 1.5, 1.99, 2.01, 4.0, 30.0])
def test_far_above_one_count_rounding_is_noise_of_a_twelfth(sd):
    """Sheppard's correction; no dependence on where the mean lies; the series joins the sum at σ = 2."""
    found = count_information(30_000 + np.linspace(0, 1, 11), sd**2, 16)
    total = sd**2 + 1 / 12
    assert found.mean == pytest.approx(1 / total, rel=2e-5 / sd**8 + 1e-9)
    assert np.ptp(found.mean) < 3e-8 * found.mean[0]
    assert found.variance == pytest.approx(0.5 / total**2, rel=0.006 / sd**4 + 1e-9)
    assert np.abs(found.cross).max() < 1e-6 / total**1.5


def test_series_and_sum_agree():
    below, above = (count_information(1000.3, sd**2, 12) for sd in (2.0, np.nextafter(2.0, 3)))
    assert float(above.mean) == pytest.approx(float(below.mean), rel=1e-6)
    assert float(above.variance) == pytest.approx(float(below.variance), rel=1e-6)


def test_full_pixels_tell_as_a_censored_normal_does():
    """σ = 20 counts at 16 bits, within reach of the end: Tobit's information (Amemiya 1973, for one mean)."""
    top, sd = 2**16 - 1, 20.0
    mean = top + np.array([-60.0, -20.0, 0.0, 15.0, 40.0])
    a = (top - 0.5 - mean) / sd
    tobit = (norm.cdf(a) - a * norm.pdf(a) + norm.pdf(a) ** 2 / norm.sf(a)) / sd**2
    assert count_information(mean, sd**2, 16).mean == pytest.approx(tobit, rel=5e-4)


def test_pixels_beyond_the_range_tell_nothing():
    found = count_information([-30.0, 300.0, 1e6], 1.0, 8)
    assert found.mean == pytest.approx(0, abs=1e-100) and found.variance == pytest.approx(0, abs=1e-100)


def test_rounding_never_adds_information():
    rng = np.random.default_rng(1)
    mean, variance = rng.uniform(-1, 256, 5000), np.exp(rng.uniform(np.log(1e-3), np.log(30), 5000))
    for slope in (0.0, 0.006, 0.5):
        rounded = count_information(mean, variance, 8).along(slope)
        normal = count_information(mean, variance, None).along(slope)
        assert (rounded <= normal * (1 + 1e-9)).all() and (rounded >= 0).all()


@pytest.mark.parametrize("sd", [0.1, 0.15, 0.22, 0.3, 0.4, 0.6])
def test_the_mean_of_frames_keeps_what_frames_tell_about_the_mean(sd):
    """Information of the sum of 16 rounded frames, by convolving their chances, over 16 times that of one.

    At σ = 0.15 a count is a coin and the sum keeps all; at 0.3 counts take three values and 0.6 % are lost.
    """
    ratio = []
    for mean in (20.0, 20.1, 20.25, 20.4, 20.5):
        chances = []
        for shift in (-1e-5, 0.0, 1e-5):
            one = outcome_probabilities(mean + shift, sd**2, 6)
            total = one
            for _ in range(15):
                total = np.convolve(total, one)
            chances.append(total)
        low, here, high = chances
        seen = here > 1e-13
        slope = (high - low) / 2e-5
        told = (slope[seen] ** 2 / here[seen]).sum()
        ratio.append(told / (16 * float(count_information(mean, sd**2, 6).mean)))
    assert max(ratio) <= 1 + 1e-6
    assert min(ratio) > 0.99


def test_divergence_of_normal_counts_is_the_squared_deflection():
    assert count_divergence(10.0, 4.0, 13.0, 4.0, None) == pytest.approx(9 / 4)
    assert count_divergence(1000.0, 36.0, 1003.0, 36.0, 12) == pytest.approx(9 / (36 + 1 / 12), rel=1e-4)
    assert count_divergence(5.0, 0.2, 5.0, 0.2, 8) == 0.0
    p, q = slow_chances(7.3, 0.3), slow_chances(9.1, 0.4)
    seen = (p > 1e-250) & (q > 1e-250)
    direct = ((p - q) * np.log(np.where(seen, p, 1) / np.where(seen, q, 1)))[seen].sum()
    assert count_divergence(7.3, 0.3, 9.1, 0.4, 8) == pytest.approx(direct, rel=1e-6)


def test_a_small_step_diverges_by_its_information():
    mean, step, variance = np.linspace(50, 51, 21), 1e-3, 0.09
    found = count_divergence(mean, variance, mean + step, variance, 8) / step**2
    assert found == pytest.approx(count_information(mean + step / 2, variance, 8).mean, rel=1e-3)


@pytest.mark.parametrize(
    ("mean", "variance", "bits", "word"),
    [
        (np.nan, 1.0, 8, "mean"),
        (3.0, 0.0, 8, "variance"),
        (3.0, 1.0, 0, "bits"),
        (3.0, np.inf, 8, "variance"),
    ],
)
def test_impossible_counts_are_refused(mean, variance, bits, word):
    with pytest.raises(ValueError, match=word):
        count_information(mean, variance, bits)
