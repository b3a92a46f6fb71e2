"""The methods before the paper: a fitted bump gives back what made it, and a table what it was asked."""

import numpy as np
import pytest

from estimation.baselines import fit_bump, fit_profile, invert_table

PIXEL = 25 / 768, 18.7 / 492


def scene(rows: int = 123, columns: int = 192, **changed: float) -> np.ndarray:
    """A bump over a slanted background, (rows, columns) counts over 25 x 18.7 mm."""
    p = {"a": 20.0, "s": 3.0, "x0": 2.0, "y0": -1.5, "level": 1.0, "sx": 0.2, "sy": -0.1} | changed
    x = (np.arange(columns) + 0.5 - columns / 2) * 25 / columns
    y = (rows / 2 - np.arange(rows) - 0.5)[:, None] * 18.7 / rows
    bump = p["a"] * np.exp(-((x - p["x0"]) ** 2 + (y - p["y0"]) ** 2) / (2 * p["s"] ** 2))
    return bump + p["level"] + p["sx"] * x + p["sy"] * y


@pytest.mark.parametrize("s", [0.8, 3.0, 6.0])
@pytest.mark.parametrize(("rows", "columns"), [(123, 192), (492, 768)])
def test_a_bump_gives_back_what_made_it(rows, columns, s):
    """Within what the blur of a bin, 2 x 2 or 5 x 5 pixels, does to it."""
    found = fit_bump(scene(rows, columns, s=s), (25 / columns, 18.7 / rows))
    rel = 0.01 if s < 1 else 1e-3
    assert (found.amplitude, found.sigma_mm) == pytest.approx((20.0, s), rel=rel)
    assert (found.x_mm, found.y_mm) == pytest.approx((2.0, -1.5), abs=1e-3)
    assert (found.slope_x, found.slope_y) == pytest.approx((0.2, -0.1), abs=1e-3)
    assert found.volume == pytest.approx(2 * np.pi * s**2 * 20, rel=3 * rel)


def test_a_small_picture_is_fitted_exactly():
    found = fit_bump(scene(60, 80), (25 / 80, 18.7 / 60))
    assert (found.amplitude, found.sigma_mm, found.level) == pytest.approx((20.0, 3.0, 1.0), rel=1e-6)
    assert found.residual_rms < 1e-6


def test_noise_moves_the_fit_as_the_bound_says():
    """200 noisy pictures: amplitude and sigma spread as the Cramér-Rao bound says, within 4 errors."""
    from estimation.information import Noise, bound, inform

    rng, count, noise = np.random.default_rng(0), 200, 0.8
    names = {"a": 20.0, "s": 3.0, "x0": 2.0, "y0": -1.5, "level": 1.0, "sx": 0.2, "sy": -0.1}
    slopes = [
        (scene(60, 80, **{k: v + 1e-4}) - scene(60, 80, **{k: v - 1e-4})) / 2e-4 for k, v in names.items()
    ]
    told = inform(list(names), [(np.stack(slopes), scene(60, 80), Noise(0.0, noise, bits=None))])
    least = bound(told, ["a", "s"]).sd
    fits = [
        fit_bump(scene(60, 80) + noise * rng.standard_normal((60, 80)), (25 / 80, 18.7 / 60))
        for _ in range(count)
    ]
    spread = np.std([(f.amplitude, f.sigma_mm) for f in fits], axis=0, ddof=1)
    assert np.abs(spread / least - 1).max() < 4 / np.sqrt(2 * count)


def test_profile_gives_back_what_made_it():
    x = np.linspace(0, 12.5, 40)
    assert fit_profile(x, 0.012 * np.exp(-(x**2) / 18) - 0.001) == pytest.approx(
        (0.012, 3.0, -0.001), rel=1e-5
    )


def test_table_is_inverted_between_its_entries():
    """A smooth made-up law of d and h: amplitudes d³/(h + d/2)³, widths (h + d/2)/2; 12 x 9 entries."""

    def law(d, h):
        return np.stack([d**3 / (h + d / 2) ** 3, (h + d / 2) / 2], axis=-1)

    d, h = (v.ravel() for v in np.meshgrid(np.linspace(2, 13, 12), np.linspace(4, 12, 9)))
    rng = np.random.default_rng(1)
    truth = rng.uniform([3, 4.5], [12.5, 11.5], (20, 2))
    found, misfit = invert_table(np.stack([d, h], axis=1), law(d, h), law(*truth.T), [0.05, 0.2])
    assert np.abs(found - truth).max() < 0.15
    assert misfit.max() < 0.05


def test_what_the_table_cannot_give_ends_at_its_border_with_a_misfit():
    table = np.array([[1.0], [2.0], [3.0], [4.0]])
    found, misfit = invert_table(table, 2 * table, [[11.0], [5.0]], [1.0])
    assert found[:, 0] == pytest.approx([4.0, 2.5], abs=1e-3)
    assert misfit == pytest.approx([3.0, 0.0], abs=1e-3)


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: fit_bump(np.ones((3, 50)), PIXEL), "picture"),
        (lambda: fit_bump(np.ones((30, 50)), (0.0, 1.0)), "pixel_mm"),
        (lambda: fit_profile([0.0, 1.0], [1.0, 0.0]), "x, values"),
        (lambda: invert_table(np.ones((4, 2)), np.ones((3, 2)), np.ones((1, 2)), [1.0, 1.0]), "answers"),
        (lambda: invert_table(np.ones((4, 2)), np.ones((4, 2)), np.ones((1, 3)), [1.0, 1.0]), "observed"),
        (lambda: invert_table(np.eye(4), np.eye(4), np.eye(4), [1.0, 1.0, 0.0, 1.0]), "sd"),
    ],
)
def test_mistakes_are_refused_in_one_line(call, word):
    with pytest.raises(ValueError, match=word) as caught:
        call()
    assert "\n" not in str(caught.value)
