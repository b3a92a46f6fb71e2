"""Followed light against the light that judged: the same light answers the same, and repeats tell the noise.

Presses are made up in closed form, as in test_evaluate.py.
"""

from typing import Any

import numpy as np
import pytest
from test_evaluate import BALL, FEW, Emulator, Pressed, design

import fem
from estimation.information import bound
from twin import confirm, touches
from twin.bench import Bench
from twin.complaint import DesignError
from twin.confirm import Answers, Follower
from twin.evaluate import Layout, Protocol, evaluate

SMALL = fem.Inclusion(6.0, 4.0, 40.0)
LAYOUT = Layout(design(), Protocol((2.0,)), {})
BENCH = Bench(samples=2**15)


@pytest.fixture(autouse=True)
def presses(variant: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(
        touches.presses, "emulated", lambda d, b, levels, e: [Pressed(d, b, lv) for lv in levels]
    )


def follower(**more: Any) -> Follower:
    return Follower(LAYOUT, (BALL, SMALL), FEW, Emulator(), bench=BENCH, **more)  # type: ignore[arg-type]


def test_the_same_light_answers_the_same() -> None:
    """Whole pictures in the light that judged answer as their slopes said, and all else known is a bound."""
    one = follower(follow="preview", paths=2**15)
    for _ in range(3):
        one.again()
    found = one.answers
    share, sd = found.share
    print(f"answers {share:.4f} ± {sd:.4f} times as judged")
    assert sd < 0.01
    assert share == pytest.approx(1.0, abs=0.03)  # slopes hold the light that walked
    judged = evaluate(LAYOUT, (BALL, SMALL), FEW, emulator=Emulator(), detection=False, bench=BENCH).judged  # type: ignore
    for response, alone, told in zip(found.judged, found.judged_alone, judged, strict=True):
        others = [name for name in told.names if name != "modulus_kPa"]
        least = bound(told.information, ["modulus_kPa"], prior=False, known=others).sd[0]
        assert response == pytest.approx(1.0 / least, rel=1e-6)
        assert alone < response
    assert found.paths == 3 * 2 * 2 * 2 * 2**15  # repeats, inclusions, ends, LEDs


@pytest.mark.slow
def test_light_that_is_followed_answers_alike_within_its_noise() -> None:
    """Ray by ray, with few paths: what noise the repeats show is what stands between the two."""
    one = follower(paths=2**14)
    for _ in range(4):
        one.again()
    share, sd = one.answers.share
    print(f"answers {share:.3f} ± {sd:.3f} times as judged")
    assert 0.0 < sd < 0.2
    assert abs(share - 1.0) < 3.0 * sd + 0.05


def test_one_repeat_has_no_spread() -> None:
    one = follower(paths=2**8)
    one.again()
    with pytest.raises(ValueError, match="repeats: received 1; allowed 3 or more"):
        _ = one.answers


def test_the_noise_of_paths_is_not_cut_off() -> None:
    """Pixels over the full well count in full: cut off on one side, noise would pass for a weaker answer."""
    one = follower()
    camera = one._small.camera
    bright = np.full((2, *camera.shape), 1e3)
    counts = one._counts(bright)
    assert counts.min() > camera.full_well_e / camera.gain_e_per_dn
    assert one._counts(2.0 * bright) == pytest.approx(2.0 * counts, rel=1e-9)


def test_paths_that_it_takes() -> None:
    """Ten times the noise that is asked for takes a hundred times the paths; words hold the ratio."""
    followed = np.array([[1.0], [3.0], [2.0]])
    one = Answers(np.ones(1), np.full(1, 2.0), followed, np.full(1, 2.0), followed, 300)
    assert one.share == pytest.approx((1.0, 0.5 / 3**0.5))
    assert one.paths_for(0.5) == pytest.approx(100)  # one repeat's spread is a half, of 100 paths
    assert one.paths_for(0.05) == pytest.approx(1e4)
    twice = Answers(np.ones(1), np.full(1, 4.0), 2.0 * followed, np.full(1, 2.0), followed, 300)
    assert (
        "2.00 times as much as base, followed 2.00 ± 0.82"
        in confirm.in_words(["base", "best"], [one, twice])[1]
    )


def test_needs_the_modulus() -> None:
    with pytest.raises(DesignError, match="unknowns: received them without modulus_kPa"):
        Follower(LAYOUT, (BALL,), FEW[:1], Emulator())  # type: ignore[arg-type]
