"""Bounds in followed light: the paths' noise passes neither for information nor for its lack.

Presses are made up in closed form, as in test_evaluate.py.
"""

import json
from typing import Any

import numpy as np
import pytest
from test_evaluate import BALL, FEW, Emulator, Pressed, design

import fem
from estimation.information import bound, inform
from twin import coarse as pixels
from twin import confirm, touches
from twin.bench import Bench
from twin.complaint import DesignError
from twin.confirm import Follower
from twin.evaluate import Layout, Protocol, noises_of

SMALL = fem.Inclusion(6.0, 4.0, 40.0)
LAYOUT = Layout(design(), Protocol((1.0, 2.0)), {})
BENCH = Bench(samples=2**15)


@pytest.fixture(autouse=True)
def presses(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        touches.presses, "emulated", lambda d, b, levels, e: [Pressed(d, b, lv) for lv in levels]
    )


def follower(kind: type[Follower] = Follower, **more: Any) -> Any:
    return kind(LAYOUT, (BALL, SMALL), FEW, Emulator(), bench=BENCH, **more)  # type: ignore[arg-type]


class Noisy(Follower):
    """In place of followed light the light that judged, its slopes under noise of this share of them."""

    share = 0.0

    def _light(self, press: Any, seed: int) -> Any:
        plain = not isinstance(press, tuple)
        ball, place, level = (0, (0.0, 0.0), press) if plain else press
        lit = self._work.lit(self.balls[ball], level, place)
        slopes = np.array(lit.slopes[:, int(plain)], np.float64)
        # blotches of one look in all slopes, as one set of paths has them, and a tenth of it in each alone
        rng = np.random.default_rng(seed)
        blotches = 1.0 + self.share * (
            rng.standard_normal(slopes.shape[1:]) + 0.1 * rng.standard_normal(slopes.shape)
        )
        return lit.layers[int(plain)], slopes * blotches


@pytest.mark.slow
def test_without_noise_both_lights_are_one() -> None:
    one = follower(Noisy)
    for _ in range(4):
        one.again()
    found = one.answers
    assert found.paths == 4 * 6 * confirm.PATHS * 2  # repeats, presses with those on plain tissue, LEDs
    for name in found.names:
        spread, judged = found.range_of(name), found.judged_of(name)
        assert spread.low == pytest.approx(judged, rel=2e-3)
        assert spread.high == pytest.approx(judged, rel=2e-3)
        assert spread.low_sd < 1e-6 * judged
        assert spread.high_sd < 1e-6 * judged


@pytest.mark.slow
def test_noise_does_not_pass_for_information() -> None:
    """The plain mean of the slopes claims too much, and the range does not, nor do repeats agree too well."""
    Noisy.share = 4.0
    try:
        one = follower(Noisy)
        for _ in range(16):
            one.again()
        press = 0, (0.0, 0.0), 2.0
        slopes = np.mean([one._light(press, seed)[1] for seed in range(16)], axis=0)
    finally:
        Noisy.share = 0.0
    found = one.answers
    for name in found.names:
        spread, judged = found.range_of(name), found.judged_of(name)
        print(name, "judged", judged, spread)
        assert max(spread.low_sd, spread.high_sd) < 0.3 * judged
        assert spread.low < judged + 4 * spread.low_sd
        assert spread.high > judged - 4 * spread.high_sd
        assert spread.low > judged - 4 * spread.low_sd
        assert spread.high < judged + 4 * spread.high_sd
    told = one._told.judged[0]
    counts = pixels.counted_slopes(one._small, slopes).sum(axis=1)
    jacobian = told.jacobian.copy()
    jacobian[: len(counts), 2] = counts
    noises = noises_of(one._small, one._told.block, LAYOUT.protocol)
    pictures = [(jacobian[:, k], told.mean[k], noises[k % 2]) for k in range(len(told.mean))]
    naive = bound(inform(told.names, pictures, told.information.prior), ["modulus_kPa"]).sd[0]
    assert naive < 0.9 * told.sd["modulus_kPa"]


def test_one_layout_is_compared_with_another_in_words() -> None:
    one, other = follower(Noisy), follower(Noisy)
    found = confirm.compare([one, other], 1e-9)
    lines = confirm.in_words(["the base", "layout 3"], found)
    assert lines[0].startswith("the base: bounds in light followed ray by ray")
    assert lines[2].startswith(
        "layout 3 tells more than the base: size at least 1.00 ± 0.00 times (judged 1.00)"
    )
    kept = json.loads(confirm.record(["the base", "layout 3"], found))
    assert kept["lines"] == lines
    assert kept["layouts"][0]["bounds"]["modulus_kPa"]["judged"] == found[0].judged_of("modulus_kPa")


def test_few_repeats_have_no_spread() -> None:
    one = follower(Noisy)
    one.again()
    with pytest.raises(ValueError, match="repeats: received 1; allowed 4 or more"):
        _ = one.answers


def test_something_must_be_asked_for() -> None:
    with pytest.raises(DesignError, match="unknowns: received none of size_mm"):
        Follower(LAYOUT, (BALL,), FEW[-1:], Emulator(), bench=BENCH)  # type: ignore[arg-type]


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_light_that_is_followed_bounds_alike() -> None:
    """Ray by ray: within a tenth of what the light that judges has, and what the noise leaves open."""
    one = follower(paths=2**16)
    for _ in range(6):
        one.again()
    found = one.answers
    for name in found.names:
        spread, judged = found.range_of(name), found.judged_of(name)
        print(name, "judged", judged, spread)
        assert spread.high_sd < 0.05 * judged
        assert spread.low - 3 * spread.low_sd < 1.1 * judged
        assert spread.high + 3 * spread.high_sd > 0.9 * judged
        assert spread.high - 3 * spread.high_sd < 1.15 * judged
