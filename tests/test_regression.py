"""The mapping's fits: numpy's and scipy's answers, closed forms, and intervals that cover what they say."""

import numpy as np
import pytest
from scipy.stats import linregress

from estimation.adequacy import Limits, judge_line, quadratic_test
from estimation.regression import fit_line, fit_monotone, fit_polynomial, monotone_left_out


def noisy(count: int, seed: int, bend: float = 0.0, sd: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """y = 3 + 2 x + bend x² + noise over x of 0 to 10."""
    rng = np.random.default_rng(seed)
    x = rng.uniform(0, 10, count)
    return x, 3 + 2 * x + bend * x**2 + sd * rng.standard_normal(count)


def test_line_is_scipys():
    x, y = noisy(12, 0)
    line, theirs = fit_line(x, y), linregress(x, y)
    assert (line.slope, line.intercept) == pytest.approx((theirs.slope, theirs.intercept), rel=1e-12)
    assert line.r2 == pytest.approx(theirs.rvalue**2, rel=1e-12)
    assert line.fit.sd == pytest.approx([theirs.intercept_stderr, theirs.stderr], rel=1e-10)
    t = 2.2281388519649385  # Student's 97.5 % point with 10 degrees of freedom
    assert line.slope_interval == pytest.approx(
        (theirs.slope - t * theirs.stderr, theirs.slope + t * theirs.stderr)
    )
    assert line.inverse(line(x)) == pytest.approx(x)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_polynomials_are_numpys(degree):
    """Coefficients and covariance of polyfit, also far from the origin and in other units."""
    x, y = noisy(20, 1, bend=0.3)
    for shift, scale in ((0.0, 1.0), (200.0, 1.0), (-3.0, 1e-4)):
        at = shift + scale * x
        found = fit_polynomial(at, y, degree)
        theirs = np.polynomial.Polynomial.fit(at, y, degree)
        assert found(at) == pytest.approx(theirs(at), rel=1e-8)
        assert found.residual == pytest.approx(y - theirs(at), abs=1e-8)
    theirs, covariance = np.polyfit(x, y, degree, cov=True)
    assert fit_polynomial(x, y, degree).coefficients == pytest.approx(theirs[::-1], rel=1e-8)
    assert fit_polynomial(x, y, degree).covariance == pytest.approx(covariance[::-1, ::-1], rel=1e-7)


@pytest.mark.parametrize("degree", [1, 2])
def test_left_out_errors_are_those_of_refits(degree):
    x, y = noisy(15, 2, bend=0.1)
    refits = [
        y[i] - np.polyval(np.polyfit(np.delete(x, i), np.delete(y, i), degree), x[i]) for i in range(15)
    ]
    assert fit_polynomial(x, y, degree).left_out() == pytest.approx(refits, rel=1e-8)


def test_intervals_in_closed_form():
    """s √(1/n + (x - x̄)²/Sxx), and with 1 more under the root for one more sample."""
    x, y = noisy(9, 3)
    line, at = fit_line(x, y, level=0.9), np.array([-2.0, 5.0, 30.0])
    half = (
        1.894578605061305
        * line.residual_sd
        * np.sqrt(1 / 9 + (at - x.mean()) ** 2 / ((x - x.mean()) ** 2).sum())
    )
    low, high = line.fit.confidence(at, 0.9)
    assert high - line(at) == pytest.approx(half) and line(at) - low == pytest.approx(half)
    low, high = line.fit.prediction(at, 0.9)
    assert (high - low) / 2 == pytest.approx(np.sqrt(half**2 + (1.894578605061305 * line.residual_sd) ** 2))


def test_intervals_cover_what_they_say():
    """3000 data sets of 9 samples: 90 % intervals cover slope, intercept, mean and one more y (4 errors)."""
    rng, count, level = np.random.default_rng(4), 3000, 0.9
    x = np.linspace(0, 4, 9)
    hits = np.zeros(4)
    for y in 1.5 - 0.7 * x + 0.3 * rng.standard_normal((count, 9)):
        line = fit_line(x, y, level)
        more = 1.5 - 0.7 * 5 + 0.3 * rng.standard_normal()
        for i, (low, high, truth) in enumerate(
            [
                (*line.slope_interval, -0.7),
                (*line.intercept_interval, 1.5),
                (*line.fit.confidence(5.0, level), 1.5 - 0.7 * 5),
                (*line.fit.prediction(5.0, level), more),
            ]
        ):
            hits[i] += low <= truth <= high
    assert np.abs(hits / count - level).max() < 4 * np.sqrt(0.9 * 0.1 / count)


def test_the_interval_of_r2_covers():
    """Bivariate normal with ρ² = 0.64, 2000 sets of 20: within 4 standard errors and 1 % of approximation."""
    rng, count = np.random.default_rng(5), 2000
    hits = 0
    for _ in range(count):
        x = rng.standard_normal(20)
        low, high = fit_line(x, 0.8 * x + 0.6 * rng.standard_normal(20)).r2_interval
        hits += low <= 0.64 <= high
    assert hits / count == pytest.approx(0.95, abs=4 * np.sqrt(0.95 * 0.05 / count) + 0.01)
    assert fit_line([0.0, 1, 2, 3], [0.0, 1, 2, 3]).r2_interval == (1.0, 1.0)


def test_test_of_the_bend_is_right_as_often_as_it_says():
    """On straight data p is uniform: 5 % of 2000 sets below 0.05, within 4 standard errors."""
    rng, count = np.random.default_rng(6), 2000
    x = np.linspace(0, 1, 12)
    below = 0
    for y in x + 0.1 * rng.standard_normal((count, 12)):
        below += quadratic_test(fit_polynomial(x, y, 1), fit_polynomial(x, y, 2))[1] < 0.05
    assert below / count == pytest.approx(0.05, abs=4 * np.sqrt(0.05 * 0.95 / count))


def test_f_is_the_square_of_the_quadratic_terms_t():
    x, y = noisy(14, 7, bend=0.1)
    parabola = fit_polynomial(x, y, 2)
    f, _ = quadratic_test(fit_polynomial(x, y, 1), parabola)
    assert f == pytest.approx((parabola.coefficients[2] / parabola.sd[2]) ** 2, rel=1e-9)


def test_monotone_fit_pools_what_falls():
    """The classic example by hand, with a tie in x, and the same turned round."""
    x, y = np.array([1.0, 2, 3, 4, 4]), np.array([1.0, 4, 2, 6, 8])
    knots, values = fit_monotone(x, y)
    assert knots.tolist() == [1, 2, 3, 4] and values.tolist() == [1, 3, 3, 7]
    assert fit_monotone(x, -y)[1].tolist() == [-1, -3, -3, -7]


def test_monotone_left_out_by_hand():
    """Straight points: inner ones are interpolated without error, end ones take their neighbour's value."""
    x = np.arange(6.0)
    assert monotone_left_out(x, 2 * x) == pytest.approx([-2, 0, 0, 0, 0, 2])


def test_straight_data_are_called_straight():
    found = judge_line(*noisy(134, 8, sd=0.3))
    assert found.adequate and found.why.startswith("adequate")
    assert found.range_count == 134 and found.best != "monotone"
    assert found.error == pytest.approx(0.3 / 20, rel=0.2)
    assert found.line.slope_interval[0] < 2 < found.line.slope_interval[1]


def test_bent_data_are_called_bent_and_their_straight_part_is_found():
    """Straight to x = 6, then level, as a saturating picture: the range ends near the knee."""
    rng = np.random.default_rng(9)
    x = np.sort(rng.uniform(0, 10, 120))
    found = judge_line(x, 2 * np.minimum(x, 6.0) + 0.1 * rng.standard_normal(120))
    assert not found.adequate and "bent" in found.why
    assert found.best == "monotone" and found.aicc["quadratic"] < found.aicc["linear"] - 10
    low, high = found.range
    assert low < 0.6 and 5.5 < high < 7.5
    assert found.range_line.slope == pytest.approx(2.0, rel=0.08)


def test_scattered_data_are_called_scattered():
    found = judge_line(*noisy(60, 10, sd=6.0))
    assert not found.adequate and "scattered" in found.why and "bent" not in found.why
    assert found.range is None or found.range_count < 60


def test_a_bend_that_is_certain_but_small_does_no_harm():
    """1500 samples make a bow of half a per cent significant; it is still negligible."""
    found = judge_line(*noisy(1500, 11, 0.008, 0.2))
    assert found.p < 1e-6 and found.bow < 0.01 and found.adequate


def test_an_exact_line_is_adequate_everywhere():
    x = np.linspace(0, 1, 9)
    found = judge_line(x, 5 * x - 1)
    assert found.adequate and found.range == (0.0, 1.0) and found.line.r2 == pytest.approx(1.0)


def test_units_do_not_change_the_verdict():
    x, y = noisy(40, 12, bend=0.15, sd=0.4)
    one, other = judge_line(x, y), judge_line(1e5 * x, 1e-6 * y)
    assert other.range == pytest.approx([1e5 * end for end in one.range])
    assert (other.p, other.bow, other.error) == pytest.approx((one.p, one.bow, one.error), rel=1e-6)
    assert other.why == one.why


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: fit_line([1.0, 2.0], [1.0, 2.0]), "x, y"),
        (lambda: fit_line([1.0, 1.0, 1.0], [1.0, 2.0, 3.0]), "different"),
        (lambda: fit_line([1.0, 2.0, np.nan], [1.0, 2.0, 3.0]), "NaN"),
        (lambda: fit_line([1.0, 2.0, 3.0], [1.0, 2.0, 3.5], level=95.0), "level"),
        (lambda: fit_line([1.0, 2.0, 3.0], [2.0, 2.0, 2.0]).inverse(2.0), "slope"),
        (lambda: judge_line(np.arange(6.0), np.ones(6)), "constant"),
        (lambda: judge_line([1.0, 2.0, 3.0, 4.0], [1.0, 2.0, 3.0, 4.0]), "5 or more"),
        (lambda: Limits(tolerance=5.0), "tolerance"),
    ],
)
def test_mistakes_are_refused_in_one_line(call, word):
    with pytest.raises(ValueError, match=word) as caught:
        call()
    assert "\n" not in str(caught.value)
