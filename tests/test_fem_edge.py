"""The singular pressure beside the probe's edge: recovered from its own consistent loads, and balanced."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import quad

import fem
from fem import edge, surface

LINES = np.array([0.0, 1.0, 2.0, 3.0, 4.0, 5.5, 7.0])  # a symmetric half, the edge at 7


def loads(pressure: object, lines: np.ndarray) -> np.ndarray:
    """Consistent loads of a pressure along a line, by adaptive quadrature."""
    found = np.zeros(len(lines))
    shapes = (lambda t: (1 - t) * (1 - 2 * t), lambda t: 4 * t * (1 - t), lambda t: t * (2 * t - 1))
    for i in range(0, len(lines) - 2, 2):
        size = lines[i + 2] - lines[i]
        for k, shape in enumerate(shapes):
            found[i + k] += quad(
                lambda t, f=shape, a=lines[i], h=size: f(t) * pressure(a + t * h) * h,  # type: ignore[operator]
                0,
                1,
                limit=400,
            )[0]
    return found


def test_a_rise_of_the_last_cell_is_taken_out_whole() -> None:
    """Constant plus s^-0.4 - 1 in the last cell: the regular rest is the constant, to rounding."""
    load = loads(lambda x: 0.7 + (0.3 * (((7 - x) / 3) ** -0.4 - 1) if x > 4 else 0.0), LINES)
    rest, rise = edge.split(load[:, None], LINES, (False, True))
    weights = surface.line_weights(LINES)
    np.testing.assert_allclose(rest[:, 0], 0.7 * weights, rtol=1e-6)
    assert rise[5, 0] == pytest.approx(0.3 * (0.5**-0.4 - 1), rel=1e-6)
    assert rest.sum() + (rise[:, 0] * weights).sum() == pytest.approx(load.sum(), rel=1e-12)


def test_a_smooth_pressure_is_left_alone() -> None:
    load = loads(lambda x: 1.0, LINES)
    assert np.abs(edge.split(load[:, None], LINES, (False, True))[1]).max() < 1e-12


def test_both_ends_mirror() -> None:
    lines = surface.mirror_line(LINES)
    load = np.random.default_rng(0).uniform(0.5, 1, (len(lines), 3))
    rest, rise = edge.split(load, lines, (True, True))
    other = edge.split(load[::-1], lines, (True, True))
    np.testing.assert_allclose(rest[::-1], other[0], rtol=1e-12)
    np.testing.assert_allclose(rise[::-1], other[1], rtol=1e-12)


def test_pressure_rises_towards_the_edge_without_ringing() -> None:
    layers = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
    answer = fem.press(
        fem.Probe(25, layers), fem.Slab(30, 60, 5), None, 1.0, mechanics="linear", quality="standard"
    )
    x, y = answer.surface.points[:, 0], answer.surface.points[:, 1]
    row = (np.abs(y) < 1e-9) & (x > 5)
    pressure = answer.surface["pressure"][row][np.argsort(x[row])]
    assert (np.diff(pressure) > 0).all()
    total = float((answer.surface["pressure"] * answer.surface["area"]).sum())
    assert 1e-3 * total == pytest.approx(answer.force_N, rel=1e-9)
