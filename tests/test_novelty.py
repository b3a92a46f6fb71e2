"""How strange a picture is: the laws of its statistics, the promise of its share, what misalignment does."""

import numpy as np
import pytest
from scipy import stats

from estimation import novelty

LENGTH, RANK = 300, 4


@pytest.fixture(scope="module")
def world():
    """Pictures on a plane of four directions, of spread 200, 50, 20 and 5, with noise of one."""
    rng = np.random.default_rng(5)
    directions, _ = np.linalg.qr(rng.standard_normal((LENGTH, RANK)))
    middle = 100 * rng.standard_normal(LENGTH)

    def draw(count, noise=1.0):
        along = rng.standard_normal((count, RANK)) * [200.0, 50.0, 20.0, 5.0]
        return middle + along @ directions.T + noise * rng.standard_normal((count, LENGTH))

    return draw, directions, middle


@pytest.fixture(scope="module")
def stored(world):
    draw, _, _ = world
    return novelty.fit(draw(400), draw(1000), components=RANK, tolerance=0.0)


def test_outside_follows_chi_square(stored, world):
    """Noise across a known plane is chi-square of m - k degrees of freedom over them."""
    found = novelty._statistics(stored, world[0](4000))[:, 0]
    # The mean and the plane of 400 noisy pictures err by 1/400 of the noise's variance along each direction.
    assert found.mean() == pytest.approx(1 + (1 + RANK) / 400, abs=0.005)
    assert found.var() * (LENGTH - RANK) == pytest.approx(2.0, rel=0.1)
    law = stats.chi2(LENGTH - RANK)
    assert stats.kstest(found / found.mean() * (LENGTH - RANK), law.cdf).pvalue > 1e-3


def test_inside_follows_mahalanobis(stored, world):
    """Normal draws have squared distances of chi-square law, over k; noise adds one to each variance."""
    found = novelty._statistics(stored, world[0](4000))[:, 1]
    assert found.mean() * RANK == pytest.approx(RANK, rel=0.1)
    assert np.quantile(found * RANK, 0.95) == pytest.approx(stats.chi2(RANK).ppf(0.95), rel=0.1)


def test_the_likeness_of_valid_pictures_is_uniform(stored, world):
    """A share a of valid pictures lies below a: the promise of ranks."""
    found = novelty.score(stored, world[0](4000))
    for share in (0.01, 0.05, 0.5, 0.9):
        spread = np.sqrt(share * (1 - share) * (1 / 4000 + 1 / 1000))  # of the sample, and of the ranks
        assert abs(np.mean(found < share) - share) < 4 * spread + 1 / 1000


def test_strange_pictures_are_unlike(stored, world):
    draw, directions, middle = world
    valid = draw(1)[0]
    strange = {
        "beside the plane": valid + 20 * np.eye(LENGTH)[7],
        "far along the plane": middle + directions @ [1200.0, 0.0, 0.0, 0.0],
        "too noisy": valid + 0.6 * np.random.default_rng(1).standard_normal(LENGTH),
        "nothing": np.zeros(LENGTH),
        "no number": np.full(LENGTH, np.nan),
        "huge": np.full(LENGTH, 1e200),
    }
    for name, picture in strange.items():
        assert novelty.score(stored, picture)[0] <= 0.002, name
    assert novelty.strangeness(stored, strange["beside the plane"])[0, 0] > 2
    assert novelty.strangeness(stored, strange["far along the plane"])[0, 1] > 5


def test_an_extra_statistic_counts(world):
    draw, _, _ = world
    rng = np.random.default_rng(2)
    stored = novelty.fit(draw(400), draw(500), extra=rng.chisquare(10, 500), components=RANK)
    picture = draw(1)
    assert novelty.score(stored, picture, extra=[[9.0]])[0] > 0.002
    assert novelty.score(stored, picture, extra=[[60.0]])[0] <= 0.002
    with pytest.raises(ValueError, match="extra: received 0 statistics, allowed: 1"):
        novelty.score(stored, picture)


def test_a_share_of_what_is_seen_may_be_missing(world):
    """A strong picture whose model errs by 1 % of it is no stranger than a faint one with noise."""
    draw, directions, middle = world
    beside = np.linalg.qr(np.column_stack([directions, np.eye(LENGTH)[3]]))[0][:, -1]
    strong = middle + directions @ [5e3, 0, 0, 0] + 50.0 * beside
    valid, held_out = draw(400), draw(500)
    strict, lenient = (novelty.fit(valid, held_out, components=RANK, tolerance=t) for t in (0.0, 0.01))
    assert novelty._statistics(strict, strong[None])[0, 0] > 5
    assert novelty._statistics(lenient, strong[None])[0, 0] < 1.1


def test_arrays_go_through_a_file(stored, world, tmp_path):
    from safetensors.numpy import load_file, save_file

    save_file(stored, tmp_path / "novelty.safetensors")
    pictures = world[0](50)
    np.testing.assert_array_equal(
        novelty.score(load_file(tmp_path / "novelty.safetensors"), pictures), novelty.score(stored, pictures)
    )


def test_wrong_arrays_are_one_line(stored, world):
    draw, _, _ = world
    for given in ((draw(2), draw(50)), (draw(50), draw(19)), (draw(50), draw(50)[:, 1:])):
        with pytest.raises(ValueError, match=r"received shape .* allowed"):
            novelty.fit(*given)
    with pytest.raises(ValueError, match="held_out: received NaN"):
        novelty.fit(draw(50), np.full((50, LENGTH), np.nan))
    with pytest.raises(ValueError, match="features: received shape"):
        novelty.score(stored, np.zeros(7))
    with pytest.raises(ValueError, match="components"):
        novelty.fit(np.ones((5, 3)), np.ones((20, 3)))


def test_misalignment_moves_pictures_and_nothing_else():
    """A blob's centre moves by the draws' spread, its light stays; no misalignment changes nothing."""
    rng = np.random.default_rng(3)
    y, x = np.indices((41, 64))
    blob = np.exp(-((x - 31.5) ** 2 + (y - 20) ** 2) / 2 / 4**2)
    pictures = np.repeat(np.stack([blob, 2 * blob])[None], 400, axis=0)
    np.testing.assert_allclose(novelty.misaligned(pictures, rng, 0.0), pictures, atol=1e-12)
    moved = novelty.misaligned(pictures, rng, 1.0)
    total = moved.sum(axis=(2, 3))
    centre = (moved * x).sum(axis=(2, 3)) / total
    assert centre.std(axis=0) == pytest.approx(0.64, rel=0.15)  # 1 % of 64 columns
    np.testing.assert_allclose(moved[:, 1], 2 * moved[:, 0])
    assert (total[:, 0] / blob.sum()).std() == pytest.approx(0.02, rel=0.2)  # 1 % along both axes
