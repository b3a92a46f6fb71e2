"""Contact that has wrinkled is told from contact that is merely steep, and refused."""

from dataclasses import replace

import numpy as np
import pytest

import twin
from fem.model import NotConverged
from fem.specimen import stretch
from fem.wrinkles import refuse_wrinkles, wrinkle
from twin.emulate import plan_of

X = np.linspace(-1.0, 1.0, 17)
HUMP = np.exp(-4.0 * (X[:, None] ** 2 + X**2))
SAWTOOTH = np.zeros((17, 17))
SAWTOOTH[10:15, 1] = (0.1, -0.1, 0.1, -0.1, 0.1)

# size, depth, offsets, thickness, mm, tissue, kPa, and s: of 800 specimens the one whose contact wrinkled
WRINKLED = np.array([6.0863, 11.5979, 5.8487, 3.1259, 24.6917, 3.3898, 0.5010])


def test_a_wrinkle_is_measured_along_either_line() -> None:
    assert wrinkle(SAWTOOTH) == wrinkle(SAWTOOTH.T) == pytest.approx(0.2)
    assert wrinkle(np.add.outer(X, 3 * X)) == pytest.approx(0.0, abs=1e-15)  # a slope is none


def test_only_what_is_much_of_the_signal_and_shows_is_refused() -> None:
    refuse_wrinkles(0.6 * HUMP, 0.5 * HUMP, 2.0)
    refuse_wrinkles(HUMP + SAWTOOTH, HUMP, 2.0)
    refuse_wrinkles(0.01 * SAWTOOTH, 0.0 * HUMP, 2.0)  # an inclusion as stiff as the tissue
    with pytest.raises(NotConverged, match=r"received 2 mm, at which the contact wrinkles: .* by 20.0%"):
        refuse_wrinkles(0.3 * HUMP + SAWTOOTH, 0.3 * HUMP, 2.0)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_a_press_that_wrinkles_on_its_way_down_is_no_sample() -> None:
    plan = plan_of(twin.load_design("tsis"))
    with pytest.raises(NotConverged, match=" 3 mm, at which the contact wrinkles"):
        stretch(plan, WRINKLED)
    shallower = replace(plan, ranges=replace(plan.ranges, indentation_mm=(0.1, 2.0)))
    assert wrinkle(stretch(shallower, WRINKLED)["rise"][-1]) < 0.005
