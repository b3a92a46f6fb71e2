"""Pictures moved, and a camera that stands a little off found from its pictures."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.alignment import moved
from twin import fitting
from twin.fitting import ALIGNMENT, Prior

RANGES = np.array([[2.0, 13.0], [4.0, 12.0], [40.0, 120.0], [-2.0, 2.0], [-2.0, 2.0]])
ROWS, COLUMNS = 24, 40
Y, X = np.mgrid[0:ROWS, 0:COLUMNS]


def test_a_ramp_is_shifted_turned_and_magnified() -> None:
    """Of a linear picture every move is known; borders, which a spline feels from afar, left out."""
    x, y = X - (COLUMNS - 1) / 2, Y - (ROWS - 1) / 2
    inner = (slice(10, -10), slice(10, -10))
    given = np.stack([x, y])

    def seen(*how: float) -> NDArray[np.float64]:
        return moved(given, *how)[(slice(None), *inner)]

    assert seen(0.05, 0.0, 0.0, 0.0)[0] == pytest.approx((x + 0.05 * COLUMNS)[inner], abs=1e-5)
    assert seen(0.0, -0.02, 0.0, 0.0)[1] == pytest.approx((y - 0.02 * COLUMNS)[inner], abs=1e-5)
    assert seen(0.0, 0.0, 0.1, 0.0)[0] == pytest.approx((x / 1.1)[inner], abs=1e-5)
    turned = seen(0.0, 0.0, 0.0, 0.1)
    assert turned[1] == pytest.approx((np.cos(0.1) * y + np.sin(0.1) * x)[inner], abs=1e-5)


def blob(values: Mapping[str, float]) -> NDArray[np.float64]:
    """(1, 2, rows, columns): an inclusion's light over the pattern that four LEDs leave."""
    x, y = X - 19.5 - 4.0 * values["offset_x_mm"], Y - 11.5 - 4.0 * values["offset_y_mm"]
    light = values["size_mm"] * np.exp(-(x**2 + y**2) / (2.0 * values["depth_mm"] ** 2))
    lamps = 30.0 + 5.0 * np.cos(0.3 * X) * np.cos(0.25 * Y) + 0.2 * X
    return np.stack([lamps + light * (1.0 + 0.002 * values["modulus_kPa"]), lamps])[None]


def test_where_the_camera_stands_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The fit that knows of it finds shift, scale, turn and inclusion; the fit that does not is far off."""
    prior = Prior(RANGES, (), np.zeros(0), np.zeros((0, 0)))
    monkeypatch.setattr(fitting, "_inputs", lambda c, p, many: (np.zeros(0), [p.values(x) for x in many]))
    monkeypatch.setattr(fitting, "pictures", lambda c, i, values: np.float32([blob(one) for one in values]))
    monkeypatch.setattr(fitting, "Brightness", SimpleNamespace(of=lambda chain, values: values))
    monkeypatch.setattr(fitting, "covariance", lambda *a: np.eye(2 * ROWS * COLUMNS) * 0.05**2)
    chain: Any = SimpleNamespace(gain=lambda values: 1.0)

    class Features:
        spread = np.ones(2 * ROWS * COLUMNS)

        def __call__(self, pictures: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(pictures).reshape(len(pictures), -1)

    features: Any = Features()
    truth = {"size_mm": 8.0, "depth_mm": 6.0, "modulus_kPa": 80.0, "offset_x_mm": 0.5, "offset_y_mm": -0.3}
    off = (0.012, -0.008, 0.015, 0.02)
    pixels = moved(blob(truth)[0], *off)
    told = pixels.ravel() + 0.05 * np.random.default_rng(0).standard_normal(pixels.size)
    start = np.array([7.0, 7.0, 80.0, 0.0, 0.0])
    plain = fitting.fit(chain, features, prior, told, 1.0, start)
    wide = prior.of_another_camera(0.0)
    found = fitting.fit(chain, features, wide, told, 1.0, np.concatenate([start, np.zeros(4)]))
    assert plain.chi_square > 20.0 * found.chi_square
    assert found.chi_square == pytest.approx(len(told), rel=0.1)
    values = wide.values(found.x)
    assert [values[name] for name in ALIGNMENT] == pytest.approx(off, abs=1e-3)
    assert values["offset_x_mm"] == pytest.approx(0.5, abs=0.02) and abs(values["depth_mm"] - 6.0) < 0.05
