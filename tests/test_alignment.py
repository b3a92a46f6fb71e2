"""Pictures moved, and a camera that stands a little off found from its pictures."""

from collections.abc import Mapping
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.alignment import covered, moved, placement
from twin import fitting
from twin.chain import BLOCK
from twin.fitting import ALIGNMENT, Prior
from twin.put_back import put_back, where
from twin.received import Received
from twin.retake import average

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


def blob(
    values: Mapping[str, float], x: NDArray[np.floating] = X, y: NDArray[np.floating] = Y
) -> NDArray[np.float64]:
    """(1, 2, rows, columns): an inclusion's light over the pattern that four LEDs leave."""
    aside, up = x - 19.5 - 4.0 * values["offset_x_mm"], y - 11.5 - 4.0 * values["offset_y_mm"]
    light = values["size_mm"] * np.exp(-(aside**2 + up**2) / (2.0 * values["depth_mm"] ** 2))
    lamps = 30.0 + 5.0 * np.cos(0.3 * x) * np.cos(0.25 * y) + 0.2 * x
    return np.stack([lamps + light * (1.0 + 0.002 * values["modulus_kPa"]), lamps])[None]


TRUTH = {"size_mm": 8.0, "depth_mm": 6.0, "modulus_kPa": 80.0, "offset_x_mm": 0.5, "offset_y_mm": -0.3}
OFF = (0.012, -0.008, 0.015, 0.02)


class Features:
    """Pictures are features."""

    spread = np.ones(2 * ROWS * COLUMNS)

    def __init__(self, blocks: NDArray[np.bool_] | None = None) -> None:
        self.blocks = np.ones((ROWS, COLUMNS), np.bool_) if blocks is None else blocks

    def __call__(self, pictures: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(pictures * self.blocks).reshape(len(pictures), -1)

    def only(self, blocks: NDArray[np.bool_]) -> "Features":
        return Features(blocks)


@pytest.fixture
def chain(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(fitting, "_inputs", lambda c, p, many: (np.zeros(0), [p.values(x) for x in many]))
    monkeypatch.setattr(fitting, "pictures", lambda c, i, values: np.float32([blob(one) for one in values]))
    monkeypatch.setattr(fitting, "Brightness", SimpleNamespace(of=lambda chain, values: values))
    monkeypatch.setattr(fitting, "covariance", lambda *a, **b: np.eye(2 * ROWS * COLUMNS) * 0.05**2)
    specimen = SimpleNamespace(modulus_kPa=6.0)
    return SimpleNamespace(gain=lambda values: 1.0, design=SimpleNamespace(specimen=specimen))


def test_where_the_camera_stands_is_found(chain: Any) -> None:
    """The fit that knows of it finds shift, scale, turn and inclusion; the fit that does not is far off."""
    prior = Prior(RANGES, (), np.zeros(0), np.zeros((0, 0)))
    features: Any = Features()
    truth, off = TRUTH, OFF
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


def test_pixels_are_put_back(chain: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Found to a twentieth of a pixel though the inclusion is only roughly known, and told which blocks were
    seen. With the inclusion held the camera would be a pixel off.
    """
    prior = Prior(RANGES, (), np.zeros(0), np.zeros((0, 0))).of_another_camera(0.0, 2.0)
    high, wide = BLOCK
    shape = (high * ROWS, wide * COLUMNS)
    y, x = np.mgrid[0 : shape[0], 0 : shape[1]]
    fine_x, fine_y = (x - (wide - 1) / 2) / wide, (y - (high - 1) / 2) / high

    def averaged(pictures: NDArray[np.floating]) -> NDArray[np.float32]:
        return np.stack([average(one.astype(np.float32), BLOCK) for one in pictures])

    def expected(chain: Any, inputs: Any, many: Any) -> NDArray[np.float32]:
        return np.stack([averaged(blob(values, fine_x, fine_y)[0])[None] for values in many])

    monkeypatch.setattr(fitting, "pictures", expected)
    fine = blob(TRUTH, fine_x, fine_y)[0]
    pictures = moved(fine, *OFF).astype(np.float32)
    received = Received(pictures[:1], pictures[1:], 1, 16, 8, ("a",))

    def coarse(now: Received) -> NDArray[np.float32]:
        return averaged(np.concatenate([now.images, now.references]))[None]

    features: Any = Features()
    start = np.array([8.2, 6.2, 80.0, 0.45, -0.25])
    matrix = where(chain, features, np.zeros(1), coarse, prior, received, start)
    corners = np.array([[0, 0, 1], [shape[0] - 1, shape[1] - 1, 1], [0, shape[1] - 1, 1]]).T
    true = np.linalg.inv(placement(shape, *OFF))
    assert np.abs((matrix - true) @ corners).max() < 0.05
    now, blocks = put_back(received, matrix)
    rest = np.abs(coarse(now)[0] - averaged(fine))
    assert rest[:, blocks].max() < 0.02 < 0.2 < rest[:, ~blocks].max()


def test_what_a_camera_has_seen() -> None:
    assert covered((3, 4), np.eye(3)).all()
    seen = covered((10, 20), placement((10, 20), 0.1, 0.0, 0.0, 0.0))  # two columns to the right
    assert seen[:, :18].all() and not seen[:, 18:].any()
