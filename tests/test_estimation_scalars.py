"""The image scalars against closed forms: a Gaussian and discs have known maximum, total and area."""

import numpy as np
import pytest

from estimation import scalars

SHAPE = (201, 301)
K = 10.0


def gaussian(height=200.0, sigma=12.0, row=100.0, column=150.0):
    rows, columns = np.indices(SHAPE)
    return height * np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / (2 * sigma**2))


def disc(radius, row, column, counts):
    rows, columns = np.indices(SHAPE)
    return np.where((rows - row) ** 2 + (columns - column) ** 2 <= radius**2, counts, 0.0)


@pytest.mark.parametrize("sigma", [6.0, 12.0, 20.0])
def test_gaussian_has_its_closed_forms(sigma):
    found = scalars(gaussian(sigma=sigma), K)
    window = (
        (1 + 2 * np.exp(-1 / (2 * sigma**2))) / 3
    ) ** 2  # the 3 x 3 mean of a sampled Gaussian separates
    assert found["max_dn"] == pytest.approx(200 * window, rel=1e-12)
    assert found["total_dn"] == pytest.approx(
        2 * np.pi * sigma**2 * 200, rel=1e-4
    )  # Poisson summation, tails cut
    assert found["area_px"] == pytest.approx(
        2 * np.pi * sigma**2 * np.log(200 / K), rel=0.02
    )  # pixels on its rim


def test_disc_counts_exactly_and_area_is_strictly_above_k():
    picture = disc(9, 40, 60, 50)
    pixels = int((picture > 0).sum())
    assert scalars(picture, K) == {"max_dn": 50.0, "total_dn": 50.0 * pixels, "area_px": pixels}
    assert scalars(picture, 50.0) == {"max_dn": 0.0, "total_dn": 50.0 * pixels, "area_px": 0}


def test_centroid_is_weighted_with_counts_above_k_only():
    """Two discs balance at a point between them; a broad background below k does not move it."""
    picture = disc(5, 100, 100, 100) + disc(5, 100, 200, 300)
    balance = 100 + 100 * 300 / 400
    picture[99:102, 174:177] = 7.0  # below k: seen by the window at the balance point, not by the centroid
    picture[:, :30] = 9.0
    assert balance == 175
    assert scalars(picture, K)["max_dn"] == 7.0


def test_maximum_at_a_corner_uses_the_pixels_that_exist():
    picture = np.zeros(SHAPE)
    picture[0, 0], picture[0, 1], picture[1, 0], picture[1, 1] = 100.0, 40.0, 40.0, 20.0
    assert scalars(picture, 50.0) == {"max_dn": 50.0, "total_dn": 200.0, "area_px": 1}


def test_no_signal_is_zero_but_the_total_keeps_its_sign():
    assert scalars(np.full(SHAPE, -1.5), K) == {
        "max_dn": 0.0,
        "total_dn": -1.5 * SHAPE[0] * SHAPE[1],
        "area_px": 0,
    }


def test_scalars_move_and_scale_with_the_picture():
    here, there = gaussian(), gaussian(row=80.0, column=170.0)
    for key, value in scalars(here, K).items():
        assert scalars(there, K)[key] == pytest.approx(value, rel=1e-6)
        assert scalars(here[::-1, ::-1].T, K)[key] == pytest.approx(value, rel=1e-12)
    double = scalars(2 * here, 2 * K)
    assert double["max_dn"] == pytest.approx(2 * scalars(here, K)["max_dn"])
    assert double["area_px"] == scalars(here, K)["area_px"]


def test_one_hot_pixel_moves_the_maximum_by_a_ninth():
    picture = disc(20, 100, 150, 100.0)
    picture[100, 150] += 90.0
    assert scalars(picture, K)["max_dn"] == pytest.approx(110.0)


def test_eight_bit_pictures_do_not_overflow():
    assert scalars(np.full(SHAPE, 255, dtype=np.uint8), K)["total_dn"] == 255 * SHAPE[0] * SHAPE[1]


@pytest.mark.parametrize(
    ("picture", "threshold", "word"),
    [
        (np.zeros(5), K, "shape"),
        (np.zeros((0, 4)), K, "shape"),
        (np.full((3, 3), np.nan), K, "NaN"),
        (np.zeros((3, 3)), 0.0, "threshold_dn"),
        (np.zeros((3, 3)), float("nan"), "threshold_dn"),
    ],
)
def test_impossible_pictures_are_refused_in_one_line(picture, threshold, word):
    with pytest.raises(ValueError, match=word) as caught:
        scalars(picture, threshold)
    assert "\n" not in str(caught.value)
