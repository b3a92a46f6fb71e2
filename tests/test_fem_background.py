"""Presses on the background that all inclusions share: no ripples of their own mesh in what pictures see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fem
from fem import background
from fem.ground import bare_geometry, fine
from fem.lines import lines
from twin import load_design
from twin.exposure import mechanics_facts

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
LARGE, SMALL = fem.Inclusion(12, 4, 100), fem.Inclusion(4, 5, 60)


def pressed(inclusion: fem.Inclusion | None, probe: fem.Probe = PROBE) -> fem.Press:
    return fem.press(probe, SLAB, inclusion, 1.0, mechanics="linear", quality="preview", estimate=False)  # type: ignore[return-value]


@pytest.fixture(scope="module")
def large() -> fem.Press:
    return pressed(LARGE)


@pytest.fixture(scope="module")
def small() -> fem.Press:
    return pressed(SMALL)


def along(press: fem.Press, name: str, at: np.ndarray) -> np.ndarray:
    """A field on the surface's line y = 0, from the nodes there."""
    points = np.asarray(press.surface.points)
    line = np.abs(points[:, 1]) < 1e-9
    return np.interp(at, points[line, 0], np.asarray(press.surface[name])[line])


def force(press: fem.Press, suffix: str = "") -> float:
    data = press.surface.point_data
    return 1e-3 * float(np.asarray(data["pressure" + suffix]) @ np.asarray(data["area" + suffix]))


def test_plain_tissue_is_the_same_under_all_inclusions(large: fem.Press, small: fem.Press) -> None:
    """Their own meshes differ by up to four per cent."""
    at = np.linspace(-10.0, 10.0, 41)
    own = [along(one, "pressure_0", at) for one in (large, small)]
    assert np.abs(own[0] / own[1] - 1.0).max() > 0.03
    shared = [fem.on_background([one])[0] for one in (large, small)]
    for name in ("pressure_0", "displacement_0", "area_0"):
        np.testing.assert_array_equal(shared[0].surface[name], shared[1].surface[name])
    expected = lines(bare_geometry(PROBE, SLAB), fine(small._states[0].model.layout.res))[0]
    np.testing.assert_allclose(np.unique(np.round(shared[0].surface.points[:, 0], 6)), expected, atol=1e-6)


@pytest.mark.parametrize("which", ["large", "small"])
def test_what_the_inclusion_does_stays(which: str, request: pytest.FixtureRequest) -> None:
    own = request.getfixturevalue(which)
    (shared,) = fem.on_background([own])
    before, after = (fem.scalars(one.surface, 2.0)["tared"] for one in (own, shared))
    assert after["max_mm"] == pytest.approx(before["max_mm"], rel=2e-3)
    assert after["total_mm3"] == pytest.approx(before["total_mm3"], rel=0.02)
    for suffix in ("", "_0"):
        assert force(shared, suffix) == pytest.approx(force(own, suffix), rel=0.02)
    assert force(shared) / force(shared, "_0") == pytest.approx(force(own) / force(own, "_0"), rel=1e-3)
    assert (shared.force_N, shared.path) == (own.force_N, own.path)
    facts = [mechanics_facts(load_design("tsis"), one) for one in (own, shared)]
    assert [told["background"] for told in facts] == ["own", "shared"]


def test_plain_tissue_is_its_own_background() -> None:
    (shared,) = fem.on_background([pressed(None)])
    for name in ("pressure", "displacement", "area"):
        np.testing.assert_allclose(shared.surface[name], shared.surface[name + "_0"], rtol=1e-9, atol=1e-12)


def test_presses_that_open_are_returned_as_they_are(large: fem.Press) -> None:
    opened = replace(large, path="unilateral")
    assert fem.on_background([opened])[0].surface is opened.surface
    assert fem.on_background([]) == []


def test_a_press_without_the_common_background_is_told(
    large: fem.Press, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stuck(*_: object) -> None:
        raise background.NotConverged("press: no equilibrium at 1 mm")

    monkeypatch.setattr(background, "ground", stuck)
    with pytest.warns(UserWarning, match="could not be followed to 1 mm"):
        (found,) = fem.on_background([large])
    assert found.surface is large.surface
    assert mechanics_facts(load_design("tsis"), found)["background"] == "own"
