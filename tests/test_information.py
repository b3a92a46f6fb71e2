"""Fisher's information and bounds: closed forms, sampled pictures, and what must hold for any of them."""

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.special import ndtr
from scipy.stats import norm

from estimation.budget import error_budget
from estimation.detection import deflection, ideal_auc, signal_weight
from estimation.information import (
    Information,
    Noise,
    bound,
    fisher,
    inform,
    marginal,
    mean_variance,
    pixel_information,
    precision,
    van_trees,
    with_prior,
)
from estimation.quantised import outcome_probabilities
from scenes.camera import expose, mean_counts
from scenes.sensor import Camera

CAMERA = Noise(shot=1 / 176.47, read_dn=12 / 176.47)  # that of the paper's sensor: σ of 0.07 to 1 count
NAMES = ("height", "width", "column", "light")
TRUTH = np.array([9.0, 2.5, 0.4, 30.0])


def blob(theta: np.ndarray, side: int = 16) -> np.ndarray:
    """Gaussian bump on a slanted background, means of every fraction: (side, side) counts."""
    height, width, column, light = theta
    y, x = np.mgrid[:side, :side] - (side - 1) / 2
    return height * np.exp(-((x - column) ** 2 + y**2) / (2 * width**2)) + light * (1 + 0.011 * x + 0.017 * y)


def slopes(theta: np.ndarray = TRUTH, side: int = 16) -> np.ndarray:
    """Jacobian (4, side, side) by central differences."""
    steps = 1e-5 * np.eye(4)
    return np.stack([(blob(theta + h, side) - blob(theta - h, side)) / 2e-5 for h in steps])


def chances(mean: np.ndarray, noise: Noise) -> np.ndarray:
    """Chance (..., 256) of every count by scipy's normal distribution: the likelihood, written anew."""
    sd = np.sqrt(noise.read_dn**2 + noise.shot * mean)[..., None]
    edge = np.arange(255) + 0.5
    below = norm.cdf((edge - mean[..., None]) / sd)
    above = norm.sf((edge - mean[..., None]) / sd)
    zeros, ones = np.zeros((*mean.shape, 1)), np.ones((*mean.shape, 1))
    up = np.diff(np.concatenate([zeros, below, ones], axis=-1))
    down = -np.diff(np.concatenate([ones, above, zeros], axis=-1))
    return np.where(np.arange(256) > mean[..., None], down, up)


def chance_of(counts: np.ndarray, mean: np.ndarray, noise: Noise) -> np.ndarray:
    """That of one picture's counts alone."""
    sd = np.sqrt(noise.read_dn**2 + noise.shot * mean)
    far = np.abs(counts - mean) + 0.5, np.abs(counts - mean) - 0.5  # by symmetry; none is clipped here
    return np.maximum(ndtr(-far[1] / sd) - ndtr(-far[0] / sd), 1e-300)


def photograph(rng: np.random.Generator, mean: np.ndarray, noise: Noise, count: int) -> np.ndarray:
    """Sampled pictures (count, rows, columns), rounded and clipped."""
    sd = np.sqrt(noise.read_dn**2 + noise.shot * mean)
    value = mean + sd * rng.standard_normal((count, *mean.shape))
    return np.clip(np.rint(value), 0, 255).astype(np.int64)


def at(table: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """Entries of a table (rows, columns, 256) at counts (n, rows, columns)."""
    return np.take_along_axis(table[None], counts[..., None], axis=-1)[..., 0]


def test_scores_of_sampled_pictures_have_the_information_as_covariance():
    """10 000 rounded pictures, scores by differences of the likelihood: within 4.5 standard errors."""
    rng, count = np.random.default_rng(3), 10_000
    step, table = 1e-4, []
    for h in step * np.eye(4):
        high, low = (np.log(np.maximum(chances(blob(TRUTH + s * h), CAMERA), 1e-300)) for s in (1, -1))
        table.append((high - low) / (2 * step))
    score = np.empty((count, 4))
    for part in np.split(np.arange(count), 20):
        seen = photograph(rng, blob(TRUTH), CAMERA, part.size)
        score[part] = np.stack([at(t, seen).sum(axis=(1, 2)) for t in table], axis=1)
    told = fisher(slopes(), pixel_information(blob(TRUTH), CAMERA))
    unit = np.sqrt(np.diag(told))
    assert np.abs(score.mean(axis=0) / unit).max() < 4.5 / np.sqrt(count)
    found = (score.T @ score / count) / np.outer(unit, unit)
    wanted = told / np.outer(unit, unit)
    error = np.sqrt((1 + wanted**2) / count)
    assert (np.abs(found - wanted) < 4.5 * error).all()
    classical = fisher(slopes(), 1 / mean_variance(blob(TRUTH), CAMERA))
    assert (np.diag(classical) > 1.15 * np.diag(told)).all()  # rounding costs, and the test can tell


def test_maximum_likelihood_reaches_the_bound():
    """600 rounded pictures, fitted by scoring on the exact likelihood: spread within 4.5 errors."""
    rng, count = np.random.default_rng(5), 600
    seen = photograph(rng, blob(TRUTH), CAMERA, count)
    least = bound(inform(NAMES, [(slopes(), blob(TRUTH), CAMERA)]))
    found = np.empty((count, 4))
    for i, picture in enumerate(seen):
        theta = TRUTH.copy()
        for _ in range(6):
            mean, jacobian = blob(theta), slopes(theta)
            sides = [np.log(chance_of(picture, mean + s, CAMERA)) for s in (1e-4, -1e-4)]
            score = (jacobian * (sides[0] - sides[1]) / 2e-4).sum(axis=(1, 2))
            told = fisher(jacobian, pixel_information(mean, CAMERA))
            theta = theta + np.linalg.solve(told, score)
        found[i] = theta
    ratio = found.std(axis=0, ddof=1) / least.sd
    assert np.abs(ratio - 1).max() < 4.5 / np.sqrt(2 * count)
    assert np.abs((found.mean(axis=0) - TRUTH) / least.sd).max() < 4.5 / np.sqrt(count) + 0.05


def test_linear_model_with_normal_noise_is_least_squares():
    """Closed form σ² (J Jᵀ)⁻¹, and with a prior that of ridge regression."""
    rng = np.random.default_rng(0)
    jacobian, sd = rng.normal(size=(3, 40)), 0.7
    plain = Noise(shot=0.0, read_dn=sd, bits=None)
    told = inform("abc", [(jacobian, np.full(40, 50.0), plain)], [0.3, 2.0, np.inf])
    assert bound(told, prior=False).covariance == pytest.approx(sd**2 * np.linalg.inv(jacobian @ jacobian.T))
    ridge = np.linalg.inv(jacobian @ jacobian.T / sd**2 + np.diag([1 / 0.09, 0.25, 0.0]))
    assert bound(told).covariance == pytest.approx(ridge)
    assert bound(told, ["c", "a"]).covariance == pytest.approx(ridge[np.ix_([2, 0], [2, 0])])


@pytest.mark.parametrize("counts", [2.3, 10.5, 60.2, 254.7])
def test_counts_are_spread_as_the_simulated_camera_spreads_them(counts):
    """Even light on the 378 000 pixels of `scenes.expose`, with Poisson's law: every chance within 0.004.

    The standard error is 0.0008; the rest is the skewness of a few hundred electrons.
    """
    camera = Camera(columns=768, rows=492, pixel_um=(8.4, 9.8), field_of_view_mm=25.0)
    camera = dataclasses.replace(
        camera,
        gain_e_per_dn=176.47,
        read_noise_e=12.0,
        full_well_e=60e3,
        prnu_percent=0.0,
        dsnu_e=0.0,
        offset_dn=0,
    )
    light = np.ones(camera.shape)
    light *= counts / mean_counts(camera, light, 550.0).mean()
    mean = mean_counts(camera, light, 550.0).mean()
    rng = np.random.Generator(np.random.Philox(1))
    seen = np.bincount(expose(camera, light, 550.0, rng).ravel(), minlength=256) / light.size
    chance = outcome_probabilities(mean, float(mean_variance(mean, CAMERA)), 8)
    assert np.abs(seen - chance).max() < 0.004


def test_a_correlated_prior_is_taken_as_its_precision():
    """Two parameters whose sum alone is seen: the bound is that of the conditioned normal distribution."""
    covariance, sd = np.array([[4.0, 1.5], [1.5, 1.0]]), 0.5
    jacobian = np.ones((2, 1))
    told = inform("ab", [(jacobian, [50.0], Noise(0.0, sd, bits=None))], np.linalg.inv(covariance))
    gain = covariance.sum(axis=1) / (covariance.sum() + sd**2)
    assert bound(told).covariance == pytest.approx(covariance - np.outer(gain, covariance.sum(axis=0)))
    tighter = with_prior(told, "a", 0.1)
    scaled = covariance * np.outer([0.1, 1], [0.1, 1])
    assert tighter.prior == pytest.approx(np.linalg.inv(scaled))


def test_shot_noise_tells_about_its_mean():
    """Kay 1993, equation 3.31 for one mean: 1/v + K²/(2 v²)."""
    noise = Noise(shot=0.5, read_dn=0.2, offset_dn=3.0, bits=None)
    v = 0.04 + 0.5 * 7.0
    assert pixel_information(10.0, noise) == pytest.approx(1 / v + 0.25 / (2 * v**2))
    assert pixel_information(1.0, noise) == pytest.approx(1 / 0.04)  # below the offset: no light, no slope


def test_frames_and_pictures_add():
    told, mean = slopes(), blob(TRUTH)
    one = inform(NAMES, [(told, mean, CAMERA)])
    nine = Noise(CAMERA.shot, CAMERA.read_dn, frames=9)
    together = inform(NAMES, [(told, mean, CAMERA), (told, mean, nine)])
    assert together.fisher == pytest.approx(10 * one.fisher, rel=1e-12)
    halves = inform(NAMES, [(told[:, :8], mean[:8], CAMERA), (told[:, 8:], mean[8:], CAMERA)])
    assert halves.fisher == pytest.approx(one.fisher, rel=1e-12)


def test_fixed_errors_limit_what_frames_can_tell():
    """Without them the information grows without end; with them it stops at one over their variance."""
    many = Noise(1 / 176, 0.07, frames=10**9, fixed_dn=0.3, fixed_share=0.01)
    assert pixel_information(40.25, many) == pytest.approx(1 / (0.09 + 0.4025**2), rel=1e-6)
    assert pixel_information(40.25, Noise(1 / 176, 0.07, fixed_dn=0.3)) == pytest.approx(
        1 / (1 / pixel_information(40.25, CAMERA) + 0.09), rel=5e-3
    )


def test_fixed_errors_may_differ_from_pixel_to_pixel():
    """As what a pixel's own response does to a tared signal: its share of the signal."""
    signal = np.array([0.0, 5.0, 20.0])
    found = pixel_information(40 + signal, Noise(0.0, 0.5, bits=None, fixed_dn=0.01 * signal))
    assert found == pytest.approx(1 / (0.25 + (0.01 * signal) ** 2))


def test_a_nuisance_never_lowers_a_bound():
    rng = np.random.default_rng(8)
    for _ in range(50):
        jacobian, mean = rng.normal(size=(6, 30)) * rng.uniform(0, 3, (6, 1)), rng.uniform(5, 200, 30)
        told = inform("abcdef", [(jacobian, mean, CAMERA)], rng.uniform(0.1, 5, 6))
        known = ["c", "d", "e", "f"]
        before = np.zeros(2)
        while known:
            now = bound(told, "ab", known=known).sd
            assert (now >= before * (1 - 1e-12)).all()
            before, known = now, known[1:]
        assert (bound(told, "ab").sd <= bound(told, "ab", prior=False).sd).all()


def test_a_weak_prior_gives_cramer_rao_and_an_empty_picture_the_prior():
    told = slopes(), blob(TRUTH), CAMERA
    free = bound(inform(NAMES, [told]))
    assert bound(inform(NAMES, [told], [1e6] * 4)).sd == pytest.approx(free.sd, rel=1e-9)
    assert bound(inform(NAMES, [told], [np.inf] * 4)).sd == pytest.approx(free.sd, rel=1e-12)
    blind = (np.zeros((4, 16, 16)), blob(TRUTH), CAMERA)
    assert bound(inform(NAMES, [blind], [1.0, 2.0, 3.0, 4.0])).sd == pytest.approx([1, 2, 3, 4])


def test_units_do_not_matter():
    """mm or m, kPa or Pa: every bound scales with its own unit, also where units differ by 1e9."""
    scale = np.array([1e-6, 1e3, 1.0, 1e-3])
    prior = np.array([3.0, 1.0, 0.2, 0.5])
    one = inform(NAMES, [(slopes(), blob(TRUTH), CAMERA)], prior)
    other = inform(NAMES, [(slopes() / scale[:, None, None], blob(TRUTH), CAMERA)], prior * scale)
    assert bound(other).sd == pytest.approx(bound(one).sd * scale, rel=1e-9)
    share = [[c.name for c in error_budget(x, ["height", "width"]).costs] for x in (one, other)]
    assert share[0] == share[1]


def test_what_cannot_be_told_apart_has_no_bound():
    jacobian = np.array([[1.0, 2.0, 0.0], [2.0, 4.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])
    told = inform("abcd", [(jacobian, np.full(3, 50.0), CAMERA)])
    sd = bound(told).sd
    assert np.isinf(sd[[0, 1, 3]]).all() and np.isfinite(sd[2])
    assert np.isfinite(bound(told, "a", known="b").sd).all()
    with pytest.raises(ValueError, match="wanted"):
        error_budget(told, ["a"])


def test_the_inverse_of_schurs_complement_is_the_block_of_the_inverse():
    told = inform(NAMES, [(slopes(), blob(TRUTH), CAMERA)])
    complement = marginal(told.fisher, [0, 2])
    assert np.linalg.inv(complement) == pytest.approx(bound(told, ["height", "column"]).covariance, rel=1e-9)


def test_van_trees_in_closed_form():
    """Two-point prior information: (mean F + P)⁻¹, below the mean of the local bounds."""
    fishers = np.array([np.diag([4.0, 1.0]), np.diag([0.0, 9.0])])
    found = van_trees(fishers, precision([1.0, 2.0]))
    assert found == pytest.approx(np.diag([1 / 3, 1 / 5.25]))
    local = np.mean([np.linalg.inv(f + precision([1.0, 2.0])) for f in fishers], axis=0)
    assert (np.diag(found) <= np.diag(local)).all()


def test_the_mean_of_the_posterior_reaches_the_bound_with_prior():
    """θ drawn from the prior, estimated by its posterior mean: 20 000 draws, 4.5 errors."""
    rng, count = np.random.default_rng(2), 20_000
    jacobian, sd, prior = rng.normal(size=(3, 12)), 1.3, np.array([0.5, 1.0, 2.0])
    told = inform("abc", [(jacobian, np.zeros(12), Noise(0.0, sd, bits=None))], prior)
    theta = prior * rng.standard_normal((count, 3))
    seen = theta @ jacobian + sd * rng.standard_normal((count, 12))
    error = seen @ jacobian.T / sd**2 @ bound(told).covariance - theta
    assert np.abs(np.sqrt((error**2).mean(axis=0)) / bound(told).sd - 1).max() < 4.5 / np.sqrt(2 * count)


def test_budget_in_closed_form():
    """One wanted, one nuisance, unit Jacobians with correlation ρ: variances 1/(1 - ρ² P-shrunk)."""
    rho, prior = 0.8, 0.7
    told = Information(("x", "n"), 100 * np.array([[1, rho], [rho, 1]]), np.diag([0, prior**-2]))
    budget = error_budget(told, ["x"])
    shrunk = [100 - (100 * rho) ** 2 / (100 + (f / prior) ** 2) for f in (1, 2)]
    assert budget.sd[0] ** -2 == pytest.approx(shrunk[0])
    assert budget.best[0] == pytest.approx(0.1)
    nuisance = next(c for c in budget.costs if c.name == "n")
    assert nuisance.known[0] == pytest.approx(0.1)
    assert nuisance.halved[0] ** -2 == pytest.approx(shrunk[1])
    assert nuisance.cost[0] == pytest.approx(budget.sd[0] - 0.1)
    assert nuisance.alone[0] == pytest.approx(budget.sd[0])


def test_budget_names_the_best_buy():
    """A nuisance that looks like the signal costs; one that does not, or is known well, costs nothing."""
    x = np.linspace(-1, 1, 400)
    jacobian = np.stack([np.exp(-8 * x**2), np.exp(-7 * x**2), x, np.exp(-9 * x**2)])
    prior = [np.inf, 5.0, 5.0, 1e-4]
    told = inform(("d", "alike", "odd", "known"), [(jacobian, 100 + 0 * x, Noise(0, 0.1, bits=None))], prior)
    budget = error_budget(told, ["d"])
    cost = {c.name: c.cost[0] for c in budget.costs}
    assert cost["alike"] > 0.5 * budget.sd[0]
    assert cost["odd"] < 1e-6 * budget.sd[0] and cost["known"] < 0.01 * budget.sd[0]
    assert all(c.cost[0] >= 0 and c.alone[0] >= budget.best[0] * (1 - 1e-12) for c in budget.costs)
    assert bound(with_prior(told, "alike", 0.5), ["d"]).sd[0] < budget.sd[0]


def test_deflection_in_closed_form():
    """|s|/σ for a known signal; what lies along a free nuisance is lost, a prior gives part of it back."""
    signal, flat, sd = np.array([3.0, 0.0, 0.0, 0.0]), np.ones(4), 2.0
    weight = np.full(4, 1 / sd**2)
    assert deflection(signal, weight) == pytest.approx(1.5)
    assert deflection(signal, weight, flat[None]) == pytest.approx(np.sqrt(9 * 3 / 4) / sd)
    assert deflection(flat, weight, flat[None]) == pytest.approx(0, abs=1e-7)
    variance = 0.5**2
    total = np.linalg.inv(
        sd**2 * np.eye(4) + variance * np.outer(flat, flat)
    )  # the nuisance as coloured noise
    found = deflection(signal, weight, flat[None], precision([0.5]))
    assert found == pytest.approx(np.sqrt(signal @ total @ signal))


@pytest.mark.parametrize("height", [0.12, 0.3])
def test_likelihood_ratio_of_sampled_pictures_has_the_ideal_area(height):
    """Rounded pictures with and without a faint bump: area under the ROC within 4 standard errors (0.012)."""
    rng, count = np.random.default_rng(11), 3000
    cases = [blob(np.array([h, 3.0, 0.0, 12.0])) for h in (0.0, height)]
    ratio = np.log(np.maximum(chances(cases[1], CAMERA), 1e-300)) - np.log(
        np.maximum(chances(cases[0], CAMERA), 1e-300)
    )
    told = [at(ratio, photograph(rng, mean, CAMERA, count)).sum(axis=(1, 2)) for mean in cases]
    area = (told[1][:, None] > told[0]).mean() + 0.5 * (told[1][:, None] == told[0]).mean()
    d_prime = deflection(cases[1] - cases[0], signal_weight(*cases, CAMERA))
    assert 0.55 < area < 0.999
    assert ideal_auc(d_prime) == pytest.approx(area, abs=4 * np.sqrt(area * (1 - area) / count) + 0.003)


def test_signal_weight_of_normal_counts_is_one_over_the_variance():
    noise = Noise(0.0, 0.3, bits=None, frames=4)
    assert signal_weight([5.0, 5.0], [5.0, 9.0], noise) == pytest.approx(4 / 0.09)
    fixed = dataclasses.replace(noise, fixed_dn=np.array([0.2, 0.1]))
    assert signal_weight([5.0, 5.0], [5.0, 9.0], fixed) == pytest.approx(
        1 / (0.09 / 4 + np.array([0.04, 0.01]))
    )


def test_area_of_the_ideal_observer():
    assert ideal_auc([0.0, np.sqrt(2), 20.0]) == pytest.approx([0.5, norm.cdf(1), 1.0])


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: Noise(shot=-1.0, read_dn=0.1), "shot"),
        (lambda: Noise(shot=0.1, read_dn=0.1, frames=0), "frames"),
        (lambda: fisher(np.ones((2, 5)), np.ones(4)), "jacobian"),
        (lambda: precision([1.0, 0.0]), "prior"),
        (lambda: precision([[1.0, 2.0], [2.0, 1.0]]), "prior"),
        (lambda: inform("ab", [], [1.0]), "prior"),
        (lambda: bound(Information(("a",), np.eye(1), np.eye(1)), ["b"]), "wanted"),
        (lambda: with_prior(Information(("a",), np.eye(1), np.eye(1)), "a", 0.0), "factor"),
    ],
)
def test_mistakes_are_refused_in_one_line(call, word):
    with pytest.raises(ValueError, match=word) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_the_room_is_light():
    """`import estimation` loads neither torch nor scipy; every public name is found without torch."""
    code = (
        "import sys, estimation as e; assert not {'torch', 'scipy'} & set(sys.modules); "
        "[getattr(e, n) for n in e.__all__]; assert 'torch' not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True, cwd=Path(__file__).parent.parent)


def test_budget_of_what_cannot_be_told_apart() -> None:
    """A gain and a flux that do the same: without noise they keep their priors, and the wanted is exact."""
    x = np.linspace(-1, 1, 200)
    jacobian = np.stack([np.exp(-8 * x**2), 50 + 10 * x, 50 + 10 * x])
    told = inform(("d", "gain", "flux"), [(jacobian, 50 + 10 * x, CAMERA)], [3.0, 0.01, 0.05])
    noise = next(cost for cost in error_budget(told, ["d"]).costs if cost.name == "noise")
    free = bound(told, ["d"], known=["gain"], prior=False).sd[0]  # the sum of both comes from the pictures
    assert noise.known[0] == pytest.approx(1e-3 * free, rel=1e-3)
    both = next(cost for cost in error_budget(told, ["flux"]).costs if cost.name == "noise")
    assert both.known[0] == pytest.approx(1 / np.hypot(1 / 0.01, 1 / 0.05), rel=1e-3)
