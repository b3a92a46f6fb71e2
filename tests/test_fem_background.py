"""Presses on the background that all inclusions share: no ripples of their own mesh in what pictures see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import fem
from fem import background
from fem.ground import bare_geometry, carry, fine
from fem.ground import lines as lines_of
from fem.lines import lines
from fem.mesh import QUALITIES
from fem.ripples import DEGREE
from fem.tared import added
from twin import load_design
from twin.exposure import mechanics_facts

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
ZERO, AT = np.zeros(1), np.linspace(-10.0, 10.0, 41)
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


@pytest.mark.parametrize("sphere", [LARGE, SMALL])
def test_what_an_ellipsoid_does_stays(sphere: fem.Inclusion) -> None:
    own = pressed(replace(sphere, stretch=(1.0, 1.0, 0.99)))
    (shared,) = fem.on_background([own], smooth=True)
    assert (shared.background, shared.signal) == ("shared", "meshed")
    before, after = (fem.scalars(one.surface, 2.0)["tared"] for one in (own, shared))
    assert after["max_mm"] == pytest.approx(before["max_mm"], rel=2e-3)
    assert after["total_mm3"] == pytest.approx(before["total_mm3"], rel=0.02)
    for suffix in ("", "_0"):
        assert force(shared, suffix) == pytest.approx(force(own, suffix), rel=0.02)
    assert force(shared) / force(shared, "_0") == pytest.approx(force(own) / force(own, "_0"), rel=1e-3)
    assert (shared.force_N, shared.path) == (own.force_N, own.path)
    facts = [mechanics_facts(load_design("tsis"), one) for one in (own, shared)]
    assert [told["background"] for told in facts] == ["own", "shared"]
    assert [told["signal"] for told in facts] == ["meshed", "meshed"]


@pytest.mark.parametrize("by", ["indentation", "force"])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (2.0, 0.0)])
def test_a_sphere_does_what_its_multipoles_do(by: str, offset: tuple[float, float]) -> None:
    """At small strain; its mesh is up to two per cent beside that."""
    ball, level = replace(LARGE, offset=offset), 1.0 if by == "indentation" else 3.0
    how = {"mechanics": "linear", "quality": "preview", "estimate": False}
    (own,) = fem.press(PROBE, SLAB, ball, **{by: [level]}, **how)  # type: ignore[call-overload]
    (shared,) = fem.on_background([own], smooth=True)
    assert mechanics_facts(load_design("tsis"), shared)["signal"] == "smooth"
    tissue = fem.multipoles(PROBE, SLAB, "preview", degree=DEGREE)
    spheres = tissue.press(ball, [own.indentation_mm])
    (other,) = background.spheres_on_background(spheres, PROBE, SLAB, QUALITIES["preview"])
    depths = own.indentation_0_mm / own.indentation_mm  # of the background, other than 1 by force
    scale = {"pressure_0": depths, "displacement_0": depths}
    for name in ("pressure_0", "displacement_0", "pressure", "displacement"):
        expected = scale.get(name, 1.0) * np.asarray(other.surface[name])
        top = np.abs(expected).max()
        np.testing.assert_allclose(shared.surface[name], expected, rtol=0, atol=1e-4 * top)
    meshed, smooth = (fem.scalars(one.surface, 2.0)["tared"]["max_mm"] for one in (own, shared))
    assert abs(meshed / smooth - 1) > 5e-3


def test_finite_strain_keeps_what_it_adds(small: fem.Press) -> None:
    """Over small strain, at the middle, as on the sphere's own mesh."""
    (finite,) = fem.press(PROBE, SLAB, SMALL, [1.0], quality="preview", estimate=False)
    times = []
    for pair in ((finite, small), [fem.on_background([one], smooth=True)[0] for one in (finite, small)]):
        rise = [along(one, "pressure", ZERO) / along(one, "pressure_0", ZERO) - 1 for one in pair]
        times.append(float((rise[0] / rise[1])[0]))
    assert times[0] > 1.01
    assert times[1] == pytest.approx(times[0], rel=2e-3)


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


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_standard_quality_is_reference_quality_to_pictures() -> None:
    """Tared pressure of a meshed sphere at 1, 2 and 2.9 mm, 2.5 mm off the edge, rms over its maximum: less
    than half as far apart without the ripples of either mesh. What finite strain adds keeps errors of its
    own, which grow with the depth."""
    ball, levels, fields = fem.Inclusion(8.0, 4.0, 100.0), [1.0, 2.0, 2.9], []
    for quality in ("standard", "reference"):
        own = fem.press(PROBE, SLAB, ball, levels, quality=quality, estimate=False)
        both = []
        for presses in (own, fem.on_background(own, smooth=True)):
            assert presses[0].signal == ("meshed" if presses is own else "smooth")
            surfaces = [one.surface for one in presses]
            rises = [added(s, 1.0, 1.0)[0] for s in surfaces]
            line = lines_of(surfaces[0])
            both.append([carry(rise.ravel(), line, (AT, AT)) for rise in rises])
        fields.append(np.array(both))
    apart = np.sqrt(((fields[0] - fields[1]) ** 2).mean(axis=-1)) / np.abs(fields[1]).max(axis=-1)
    print("per cent apart, meshed", 100 * apart[0], "smooth", 100 * apart[1])
    assert (apart[1] < 0.5 * apart[0]).all() and apart[1].max() < 1.5e-3
