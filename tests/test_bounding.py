"""The bound of rendered pictures, on a sensor so simple that its derivatives are known."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from test_refining import CHAIN, NOISE, PRIOR, RANGES, Features, K, light_map, truth

from twin import bounding, fitting
from twin.study import PARAMETERS


def pair(seen: NDArray[np.float64]) -> NDArray[np.float32]:
    """Pictures (..., K, 2, 1, 1) beside references that nothing shows in."""
    return np.stack([seen, np.ones_like(seen)], axis=-1)[..., None, None].astype(np.float32)


class Pressed(Features):
    """Features are the pictures alone."""

    def __call__(self, pictures: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(pictures).reshape(-1, K, 2)[..., 0]


FEATURES: Any = Pressed()


@pytest.fixture(autouse=True)
def simple(monkeypatch: pytest.MonkeyPatch) -> None:
    def expected(chain: Any, prior: Any, many: Any, near: Any = None) -> NDArray[Any]:
        return pair(light_map(np.array(many)))

    def covariance(chain: Any, features: Any, seen: Any, gain: Any, frames: float, rounded: bool) -> Any:
        return np.eye(K) * NOISE**2 / frames

    for module in (bounding, fitting):
        monkeypatch.setattr(module, "expected", expected)
    monkeypatch.setattr(bounding, "covariance", covariance)


def unknowns(values: Mapping[str, float]) -> NDArray[np.float64]:
    return np.array([*(values[name] for name in PARAMETERS), values["gain"] / 0.02])


def render(values: Mapping[str, float]) -> NDArray[np.float32]:
    return pair(truth(unknowns(values)))[:, :1]


def by_hand(x: NDArray[np.float64], frames: float) -> NDArray[np.float64]:
    """Standard deviations (6,) of the bound in true pictures, by central differences."""
    steps = 1e-4 * np.eye(6)
    slopes = np.array([(truth(x + step) - truth(x - step)) / 2e-4 for step in steps])
    least = np.linalg.inv(slopes @ slopes.T * frames / NOISE**2 + PRIOR.precision)
    return np.asarray(np.sqrt(np.diag(least)))


@pytest.mark.parametrize(("modulus", "within"), [(50.0, 0.04), (75.0, 0.04), (95.0, 0.04), (120.0, 0.15)])
def test_two_rendered_pictures_make_the_bound_right(modulus: float, within: float) -> None:
    """Where the map's error changes along the valley by ten times the noise; on one side at the end of the
    modulus's range. Without them the bound is far off."""
    x = np.array([7.0, 6.0, modulus, 0.3, -0.2, 0.4])
    right = by_hand(x, 100.0)
    parts = (CHAIN, FEATURES, PRIOR, PRIOR.values(x))
    more = bounding.more_along_valley(*parts, render)
    mapped, made = (
        np.sqrt(np.diag(bounding.limits(*parts, 100.0, more=one)[0])) / right for one in (0.0, more)
    )
    print(modulus, mapped[:3].round(3), made[:3].round(3))
    assert np.all(np.abs(made[:3] - 1.0) < within)
    assert np.all(np.abs(mapped[:3] - 1.0) > 0.1)


@pytest.mark.filterwarnings("ignore:invalid value")  # the chain's derivative by it
def test_a_modulus_that_is_known_is_left_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    ranges = RANGES.copy()
    ranges[2] = 60.0
    x = np.array([7.0, 6.0, 60.0, 0.3, -0.2, 0.4])
    prior = fitting.Prior(ranges, PRIOR.names, PRIOR.mean, PRIOR.basis)
    monkeypatch.setitem(globals(), "render", None)
    more = bounding.more_along_valley(CHAIN, FEATURES, prior, prior.values(x), render)
    assert not more.any()
