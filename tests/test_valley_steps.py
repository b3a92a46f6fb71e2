"""Steps along the valley of inclusions that look nearly the same."""

import numpy as np
import pytest

from twin.valley_steps import bent, onto

MODULI, TISSUE = np.array([40.0, 120.0]), 6.0
X = np.array([9.0, 5.5, 80.0, 0.4, -0.3, 0.7])
WAY = np.array([-0.02, 0.012, 1.0, 0.001, 0.002, 0.03])


def test_begins_straight() -> None:
    """A small step differs from a straight one by its square."""
    off = [np.abs(bent(X, share * WAY, MODULI, TISSUE) - X - share * WAY).max() for share in (0.1, 0.01)]
    assert 80.0 < off[0] / off[1] < 120.0


def test_keeps_signal_and_middle() -> None:
    """A step that keeps d³ c and the middle to first order keeps them however long it is."""
    contrast = (X[2] - TISSUE) / (X[2] + 1.5 * TISSUE)
    slope = 2.5 * TISSUE / (X[2] + 1.5 * TISSUE) ** 2
    size = -X[0] * slope / (3.0 * contrast)
    end = onto(X, np.array([size, -0.5 * size, 1.0, 0.0, 0.0, 0.0]), 110.0, MODULI, TISSUE)
    there = (end[2] - TISSUE) / (end[2] + 1.5 * TISSUE)
    assert end[2] == 110.0
    assert end[0] ** 3 * there == pytest.approx(X[0] ** 3 * contrast, rel=1e-12)
    assert end[1] + end[0] / 2.0 == pytest.approx(X[1] + X[0] / 2.0, rel=1e-12)


@pytest.mark.parametrize("modulus", [45.0, 79.0, 120.0])
def test_comes_to_a_modulus(modulus: float) -> None:
    """Exactly, as a step of so much contrast would."""
    end = onto(X, WAY, modulus, MODULI, TISSUE)
    contrast = [(e - TISSUE) / (e + 1.5 * TISSUE) for e in (X[2], modulus)]
    rise = (contrast[1] - contrast[0]) / (2.5 * TISSUE / (X[2] + 1.5 * TISSUE) ** 2)
    same = bent(X, rise * WAY, MODULI, TISSUE)
    np.testing.assert_allclose(end, same, rtol=1e-9)


def test_does_not_step_over_the_ends() -> None:
    for far in (-500.0, 1e4):
        end = bent(X, far * WAY, MODULI, TISSUE)
        assert end[2] == pytest.approx(MODULI[0] if far < 0 else MODULI[1])
        assert np.isfinite(end).all()
        assert end[0] > 0.0


def test_goes_straight_where_inclusions_may_be_as_soft_as_tissue() -> None:
    np.testing.assert_array_equal(bent(X, WAY, np.array([2.0, 120.0]), TISSUE), X + WAY)
