"""Random numbers of a corpus: each from its own place, and each from its own distribution."""

import numpy as np
import pytest
from scipy import stats
from scipy.stats import qmc

from twin.complaint import DesignError
from twin.draws import Stream, again, blanks, check_bounds, draw, inclusions
from twin.study import PARAMETERS, Distribution, Group, Ranges

BOX = Ranges(size_mm=(2.0, 13.0), depth_mm=(4.0, 12.0), modulus_kPa=(40.0, 120.0), offset_x_mm=(-3.0, 3.0))
SPANS = {name: BOX.span(name) for name in PARAMETERS[:4]}


def group(sampler, count, blank=0.0):
    return Group(name="g", sampler=sampler, count=count, blanks=blank, inclusion=BOX)


def unit(sampler, count, seed=0):
    """Samples as points of the unit cube, (count, 4)."""
    found = inclusions(group(sampler, count), Stream(seed, "g"), count)
    assert (found["offset_y_mm"] == 0).all()
    return np.stack([(found[name] - low) / (high - low) for name, (low, high) in SPANS.items()], axis=1)


def test_a_number_stands_at_its_place():
    """One sample's number does not depend on how many there are, nor on what else is drawn."""
    stream = Stream(7, "g")
    many = stream.many("leds.0.flux_W", 1001)
    assert np.array_equal(many[:10], stream.many("leds.0.flux_W", 10))
    assert [stream.one("leds.0.flux_W", n) for n in (1000, 3, 4, 0)] == [many[n] for n in (1000, 3, 4, 0)]
    others = [
        Stream(8, "g").many("leds.0.flux_W", 1001),
        Stream(7, "h").many("leds.0.flux_W", 1001),
        stream.many("leds.1.flux_W", 1001),
        stream.many("leds.0.flux_W", 1001, attempt=1),
    ]
    for other in others:  # correlation of 1001 independent pairs: within four standard errors
        assert abs(np.corrcoef(many, other)[0, 1]) < 4 / np.sqrt(1001)
    assert stream.many("a", 1).shape == (1,) and 0 <= stream.whole("a", 5, 26) < 2**26


def test_numbers_are_those_of_philox():
    """The stream is the bit generator's own sequence (Salmon 2011), in its upper 53 bits."""
    import hashlib

    key = np.frombuffer(hashlib.sha256(b"7\0g\0a\0" + b"0").digest()[:16], "<u8")
    raw = np.random.Philox(key=key).random_raw(9)
    assert np.array_equal(Stream(7, "g").many("a", 9), ((raw >> 11) + 0.5) / 2**53)


@pytest.mark.parametrize("sampler", ["uniform", "sobol"])
def test_more_samples_leave_the_first_ones(sampler):
    assert np.array_equal(unit(sampler, 1000)[:125], unit(sampler, 125))


def test_uniform_samples_are_uniform_and_independent():
    points = unit("uniform", 4096)
    for axis in points.T:
        assert stats.kstest(axis, "uniform").pvalue > 1e-3
    cells, _ = np.histogramdd(points, bins=4, range=[(0, 1)] * 4)
    assert stats.chisquare(cells.ravel()).pvalue > 1e-3  # 256 cells of 16


def test_latin_samples_fill_every_row_once():
    for count in (7, 125):
        rows = np.floor(unit("latin", count) * count).astype(int)
        assert (np.sort(rows, axis=0) == np.arange(count)[:, None]).all()
    assert stats.kstest((unit("latin", 125)[:, 0] * 125) % 1, "uniform").pvalue > 1e-3  # within its row


def test_sobol_samples_are_more_even_than_random_ones():
    even, random = (qmc.discrepancy(unit(sampler, 256)) for sampler in ("sobol", "uniform"))
    assert even < random / 5
    assert qmc.discrepancy(unit("latin", 256)) < random


def test_blanks_have_their_share_in_every_beginning():
    for share in (0.0, 0.15, 0.25, 1.0):
        found = np.cumsum(blanks(group("uniform", 1000, share), 1000))
        assert np.abs(found - share * np.arange(1, 1001)).max() < 1
    found = inclusions(group("latin", 20, 0.25), Stream(0, "g"), 20)
    empty = np.isnan(found["size_mm"])
    assert empty.sum() == 5 and np.isnan(found["offset_y_mm"][empty]).all()
    rows = np.floor((found["depth_mm"][~empty] - 4) / 8 * 15)
    assert sorted(rows) == list(range(15))  # the others are a whole Latin square


def test_a_latin_sample_is_drawn_again_in_its_row_and_later_anywhere():
    latin, stream = group("latin", 50), Stream(0, "g")
    first = {name: float(values[9]) for name, values in inclusions(latin, stream, 50).items()}
    row = np.floor((first["size_mm"] - 2) / 11 * 50)
    near = [again(latin, stream, 9, attempt, first)["size_mm"] for attempt in range(1, 9)]
    assert len(set(near)) == 8 and {np.floor((size - 2) / 11 * 50) for size in near} == {row}
    far = [again(latin, stream, 9, attempt, first)["size_mm"] for attempt in range(9, 300)]
    assert stats.kstest(far, stats.uniform(2, 11).cdf).pvalue > 1e-3


# A distribution, what the design says, and what its draws follow.
CONTINUOUS = {
    "uniform": (Distribution("uniform", low=2.0, high=5.0), 9.0, stats.uniform(2, 3)),
    "a factor": (Distribution("uniform", low=0.5, high=1.5, relative=True), 4.0, stats.uniform(2, 4)),
    "normal": (Distribution("normal", sd=0.5), 3.0, stats.norm(3, 0.5)),
    "about another mean": (Distribution("normal", sd=0.5, mean=-1.0), 3.0, stats.norm(-1, 0.5)),
    "a normal factor": (Distribution("normal", sd=0.05, relative=True), 0.01, stats.norm(0.01, 0.0005)),
    "between bounds": (
        Distribution("normal", sd=2.0, low=2.0, high=4.0),
        3.0,
        stats.truncnorm(-0.5, 0.5, 3, 2),
    ),
    "lognormal": (Distribution("lognormal", sd=0.3), 5.0, stats.lognorm(0.3, scale=5)),
}


@pytest.mark.parametrize("case", CONTINUOUS)
def test_draws_follow_their_distribution(case):
    about, base, expected = CONTINUOUS[case]
    drawn = draw(about, base, Stream(1, "g").many("x", 5000))
    assert stats.kstest(drawn, expected.cdf).pvalue > 1e-3
    quantiles = np.array([1e-4, 0.3, 0.5, 0.999])
    assert draw(about, base, quantiles) == pytest.approx(expected.ppf(quantiles), rel=1e-9)


def test_draws_of_few_values_are_equally_frequent():
    numbers = Stream(1, "g").many("x", 6000)
    whole = draw(Distribution("integer", low=-1.0, high=4.0), None, numbers)
    assert set(whole) == {-1, 0, 1, 2, 3, 4}
    assert stats.chisquare(np.unique(whole, return_counts=True)[1]).pvalue > 1e-3
    some = draw(Distribution("choice", of=(1.0, 2.5, 7.0)), None, numbers)
    values, counts = np.unique(some, return_counts=True)
    assert list(values) == [1, 2.5, 7] and stats.chisquare(counts).pvalue > 1e-3
    assert draw(Distribution("normal", sd=0.0), 3.0, numbers[:2]).tolist() == [3, 3]


def test_bounds_that_leave_next_to_nothing_are_refused():
    for about in (
        Distribution("normal", sd=1.0, low=6.0),
        Distribution("normal", sd=0.0, high=2.0),
        Distribution("normal", sd=1.0, relative=True, low=4.0),
    ):
        with pytest.raises(DesignError, match=r"here\.low: received .* at least 1% of the distribution"):
            check_bounds("here", about, 3.0)
    check_bounds("here", Distribution("normal", sd=1.0, low=4.0), 3.0)
