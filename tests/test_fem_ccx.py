"""Independent code: presses of CalculiX on the decks of `fem.ccx`, in linear and in finite strain."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import ccx_runner
import numpy as np
import pytest
from debian_fetch import CCX

import fem
from fem import ccx
from fem.mesh import QUALITIES, Geometry
from fem.model import Pose
from fem.topology import Resolution

needs_ccx = pytest.mark.skipif(
    CCX.find() is None, reason="CalculiX (ccx) is neither installed nor in .ccx: make setup"
)

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
# Few cells at the probe's edge: CalculiX loses equilibrium at finer ones, whose corners fold up. They move
# the tared maximum of a linear press by 0.2 %.
COARSE_EDGE = Resolution(arc=3, core=1, shell=3, above=3, below=2, edge=2, side=2, layer=2, backing=1)
GRADED_EDGE = replace(COARSE_EDGE, edge=3, growth=(0.5, 1.6))
# What its totals and its force at finite strain need besides: at 3 mm they come nearer by 1.2 and 0.7 %.
COARSE_EDGE_ALONE = replace(COARSE_EDGE, above=4, side=3, backing=2)
# Its totals of a linear press need fine ones.
FINE_EDGE = Resolution(4, 1, 4, 3, 2, edge=3, side=4, layer=3, backing=1, growth=(1 / 1.7, 2.2))
# On those its force under an inclusion off the middle is 0.3 % higher than on these.
FINER = Resolution(5, 1, 4, 3, 3, edge=4, side=5, layer=4, backing=2, growth=(1 / 1.7, 2.0))
INCLUSIONS = [
    fem.Inclusion(10, 5, 100),
    fem.Inclusion(13, 6, 40),
    fem.Inclusion(8, 4, 120, (3, 0)),
    fem.Inclusion(10, 7, 60, (2, -3)),
]


def compared(
    folder: Path,
    geometry: Geometry,
    levels: list[float],
    mechanics: ccx.Mechanics,
    quality: str,
    res: Resolution | str,
) -> list[tuple[float, float, float, float]]:
    """Relative differences of tared maximum, total, force, and total without the outermost row of
    CalculiX's cells at each level, printed with both values."""
    ours = fem.press(
        geometry.probe,
        geometry.slab,
        geometry.inclusion,
        levels,
        mechanics=mechanics,
        quality=quality,
        tilt=geometry.pose.tilt_deg,
        position=geometry.pose.position_mm,
        estimate=False,
    )
    theirs = ccx_runner.press(folder, geometry, levels, mechanics, res)
    print(mechanics, geometry.inclusion)
    return differences(levels, ours, theirs)


def differences(
    levels: list[float], ours: list[fem.Press], theirs: list[ccx_runner.Tared]
) -> list[tuple[float, float, float, float]]:
    """Of each level, as of `compared`."""
    found = []
    for level, we, they in zip(levels, ours, theirs, strict=True):
        top = 1e3 * ccx_runner.tared(we.surface, True)["max_mm"]
        total = ccx_runner.tared(we.surface, False)["total_mm3"]
        inner = ccx_runner.total_within(we.surface, they.inner_mm)
        pairs = (
            ("max um", top, they.max_um),
            ("total mm3", total, they.total_mm3),
            ("force N", we.force_N, they.force_N),
            (f"total of {2 * they.inner_mm:.1f} mm", inner, they.inner_mm3),
        )
        for (name, a, b), swing in zip(pairs, they.scatter, strict=True):
            print(f"{level:g} mm, {name}: ", end="")
            print(f"{a:.4f} / {b:.4f} (± {swing:.2%} of settling): {a / b - 1:+.2%}")
        print(f"   CalculiX: {they.seconds:.0f} s; ours: {we.seconds:.0f} s")
        found.append(tuple(a / b - 1 for _, a, b in pairs))
    return found  # type: ignore[return-value]


@needs_ccx
def test_linear_at_a_glance(tmp_path: Path) -> None:
    geometry = Geometry(PROBE, SLAB, INCLUSIONS[0])
    ((top, total, force, _),) = compared(tmp_path, geometry, [1.0], "linear", "standard", FINE_EDGE)
    assert abs(top) < 5e-3 and abs(total) < 5e-3 and abs(force) < 5e-3


@needs_ccx
@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("inclusion", INCLUSIONS, ids=str)
def test_linear(tmp_path: Path, inclusion: fem.Inclusion) -> None:
    geometry = Geometry(PROBE, SLAB, inclusion)
    ((top, total, force, _),) = compared(tmp_path, geometry, [1.0], "linear", "standard", FINER)
    assert abs(top) < 5e-3 and abs(total) < 5e-3 and abs(force) < 5e-3


@needs_ccx
@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(
    "level",
    [
        1.0,
        3.0,
        pytest.param(
            6.0,
            marks=pytest.mark.xfail(
                raises=fem.NotConverged,
                strict=True,
                reason="the corner gives way: test_fem_corner.py",
            ),
        ),
    ],
)
@pytest.mark.parametrize("inclusion", INCLUSIONS, ids=str)
def test_finite(tmp_path: Path, inclusion: fem.Inclusion, level: float) -> None:
    """On a mesh of CalculiX's whose nodes end under the probe's edge. Totals are held without the outermost
    row, where one of its cells is as wide as the edge's rise."""
    geometry = Geometry(PROBE, SLAB, inclusion)
    ours = fem.press(PROBE, SLAB, inclusion, [level], estimate=False)
    theirs = ccx_runner.press_slid(tmp_path, geometry, level, COARSE_EDGE_ALONE)
    ((top, _, force, inner),) = differences([level], ours, [theirs])
    assert abs(top) < 0.02 and abs(force) < 0.02 and abs(inner) < 0.02


@needs_ccx
@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("inclusion", INCLUSIONS, ids=str)
@pytest.mark.parametrize(
    "probe, tilt",
    [(fem.Probe(25, PROBE.layers, dome_radius_mm=150), (0.0, 0.0)), (PROBE, (0.0, 2.0))],
    ids=["dome", "tilt"],
)
def test_finite_where_contact_spreads(
    tmp_path: Path, probe: fem.Probe, tilt: tuple[float, float], inclusion: fem.Inclusion
) -> None:
    geometry = Geometry(probe, SLAB, inclusion, Pose(tilt))
    levels = [1.0, 2.0] if inclusion == INCLUSIONS[0] else [1.0]
    for top, _, *others in compared(tmp_path, geometry, levels, "finite", "standard", COARSE_EDGE):
        assert max(map(abs, (top, *others))) < 0.03


@needs_ccx
@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_flat_press_where_the_mesh_slid(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """2 mm on the same mesh, of half a millimetre at the probe's edge, whose nodes end under it: the whole
    total, too. On nodes that end beside it CalculiX's whole total is 5 % lower."""
    monkeypatch.setitem(QUALITIES, "standard", GRADED_EDGE)
    geometry = Geometry(PROBE, SLAB, INCLUSIONS[0])
    ours = fem.press(PROBE, SLAB, INCLUSIONS[0], [2.0], estimate=False)
    theirs = ccx_runner.press_slid(tmp_path, geometry, 2.0, GRADED_EDGE)
    (found,) = differences([2.0], ours, [theirs])
    assert max(map(abs, found)) < 0.02


@needs_ccx
@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.parametrize("inclusion", INCLUSIONS, ids=str)
def test_finite_deep_under_a_dome(tmp_path: Path, inclusion: fem.Inclusion) -> None:
    """6 mm, all closed: a dome spares the corners that end flat presses, and a thick slab the tissue between
    inclusion and chest wall. Totals of a wide, soft inclusion are apart, by half of it since CalculiX's nodes
    slide out from under the probe's edge: on a mesh that ends under it they are 3.8 % on the same cells."""
    geometry = Geometry(fem.Probe(25, PROBE.layers, dome_radius_mm=100), fem.Slab(60, 60, 5), inclusion)
    ((top, _, force, inner),) = compared(tmp_path, geometry, [6.0], "finite", "standard", COARSE_EDGE)
    assert abs(top) < 0.03 and abs(force) < 0.03
    assert abs(inner) < 0.1  # 0.084 was the worst of two
    if abs(inner) >= 0.03:
        pytest.xfail(f"total without the outermost row {inner:+.1%} apart, goal 3 %")


@pytest.mark.parametrize(
    "change, words",
    [
        ({"levels": [2.0, 1.0]}, "rising"),
        ({"levels": []}, "rising"),
        ({"quality": "fine"}, "quality: received 'fine'"),
        ({"mechanics": "plastic"}, "mechanics: received 'plastic'"),
        ({"mechanics": "linear", "tilt": (1.0, 0.0)}, "a tilt or a dome"),
        ({"position": (17.5, 0.0)}, "position"),
    ],
)
def test_bad_input(tmp_path: Path, change: dict[str, object], words: str) -> None:
    given: dict[str, object] = {"levels": [1.0], "quality": "preview"} | change
    levels = given.pop("levels")
    with pytest.raises(ValueError, match=words) as caught:
        fem.deck(tmp_path / "a.inp", PROBE, SLAB, INCLUSIONS[0], levels, **given)  # type: ignore[arg-type]
    assert "\n" not in str(caught.value) and not (tmp_path / "a.inp").exists()


def test_decks_differ_in_the_inclusion_alone(tmp_path: Path) -> None:
    """The one to tare with has the same mesh, the tissue's modulus in the inclusion, and every step twice."""
    texts = [
        fem.deck(
            tmp_path / "a.inp", PROBE, SLAB, INCLUSIONS[0], [1, 2], quality="preview", without_inclusion=bare
        ).read_text()
        for bare in (False, True)
    ]
    lines = [text.splitlines() for text in texts]
    differ = [i for i, (a, b) in enumerate(zip(*lines, strict=True)) if a != b]
    assert [lines[0][i - 2] for i in differ] == ["*MATERIAL, NAME=INCLUSION"]
    assert texts[0].count("*STEP") == 2 * (1 + ccx.SETTLE)


def test_chest_wall_moves_along_the_tilted_axis(tmp_path: Path) -> None:
    """In the probe's frame; before the first step nothing overlaps, and a level counts from first contact of
    the middle."""
    tilted = Geometry(PROBE, SLAB, None, Pose((0.0, 2.0)))
    found = ccx.bodies(tilted, COARSE_EDGE)
    np.testing.assert_allclose(np.abs(found.normal), [np.sin(np.radians(2)), 0, np.cos(np.radians(2))])
    assert found.start == pytest.approx(-12.5 * np.tan(np.radians(2)), abs=0.02)
    assert (found.place[found.skin] @ found.normal).min() > (
        found.place[found.tip] @ found.normal
    ).max() - 1e-2
    text = ccx.write(tmp_path / "a.inp", found, [1.0]).read_text()
    moved = [float(line.split(",")[3]) for line in text.splitlines() if line.startswith("CHEST, ")][:3]
    np.testing.assert_allclose(moved, (found.start - 1) * found.normal)


def test_increments_are_short(tmp_path: Path) -> None:
    """A level is reached by steps of one length, none longer than it may be, from where the bodies stand."""
    model = ccx.bodies(Geometry(PROBE, SLAB, INCLUSIONS[0], Pose((0.0, 2.0))), COARSE_EDGE)
    levels = [0.1, 1.0, 3.0]
    text = ccx.write(tmp_path / "a.inp", model, levels, settle=0).read_text()
    rows = [line.split("\n", 1)[0].split(",") for line in text.split("*STATIC\n")[1:]]
    ways = np.diff([model.start, *levels])
    assert model.start < 0
    for row, way in zip(rows, ways, strict=True):
        first, whole, least, longest = map(float, row)
        assert first == longest <= whole == 1 and least < first / 100
        assert longest * way == pytest.approx(min(way, ccx.STRIDE))


def test_numbers_are_short_enough_for_calculix(tmp_path: Path) -> None:
    """It reads twenty characters of each: what is beyond, an exponent too, would be lost."""
    found = ccx.bodies(Geometry(PROBE, SLAB, INCLUSIONS[0], Pose((0.0, 2.0))), COARSE_EDGE)
    lines = ccx.write(tmp_path / "a.inp", found, [1.0]).read_text().splitlines()
    fields = [field for line in lines if line[0] not in "*" for field in line.split(",")]
    assert max(map(len, fields)) <= 20
    start = next(i for i, line in enumerate(lines) if line.startswith("*NODE"))
    end = next(i for i, line in enumerate(lines) if line.startswith("*ELEMENT"))
    table = np.array([[float(field[:20]) for field in line.split(",")] for line in lines[start + 1 : end]])
    np.testing.assert_allclose(table[:, 1:], found.place[table[:, 0].astype(int) - 1], rtol=0, atol=1e-9)


def test_totals_are_those_of_quadratic_cells() -> None:
    """Exact for polynomials in a cell, cut cells too; what a node at the rim does stays in its cell."""
    line = np.array([-3, -2.5, -2, 0, 2, 2.5, 3])
    contact = fem.surface.contact_surface(line, line)
    x, y = contact.points[:, 0], contact.points[:, 1]
    z = (1 + x + x**2) * (2 - y**2)
    contact["displacement_0"] = np.stack([0 * z, 0 * z, z], axis=1)
    contact["displacement"] = np.zeros((len(z), 3))
    expected = (5 + 2 * 2.5**3 / 3) * (10 - 2 * 2.5**3 / 3)
    assert ccx_runner.total_within(contact, 2.5) == pytest.approx(expected, rel=1e-12)
    inner = ccx_runner.total_within(contact, 2.0)
    contact["displacement_0"][np.abs(x) == 3] += 100
    assert ccx_runner.total_within(contact, 2.0) == pytest.approx(inner, rel=1e-12)
