"""An inclusion of other colour below the surface: seen by the reference light alone, refused by all other."""

from __future__ import annotations

import dataclasses
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensors import bump, paper_sensor

import fem
import twin
from scenes.sensor import Guide, NotModelled
from scenes.skin import Colour, Skin, Tissue
from twin.design import DesignError, load_design, parse_design
from twin.fields import tables_of

SMALL: dict[str, Any] = {"columns": 48, "rows": 31, "pixel_um": (134.4, 154.3)}
DARK = Colour(absorption_per_mm=5.0)
MIDDLE = (slice(13, 18), slice(21, 27))
"""Of the pictures: 3 mm about the middle."""

Place = tuple[np.ndarray, np.ndarray]


def ball(depth_mm: float, radius_mm: float = 2.0) -> Place:
    return np.array([0.0, 0.0, depth_mm + radius_mm]), radius_mm * np.eye(3)


@cache
def renderer(colour: Colour) -> Any:
    from scenes import Renderer

    return Renderer(dataclasses.replace(paper_sensor(**SMALL), inclusion=colour), "cpu", coloured=True)


def picture(colour: Colour, place: Place | None, paths: int, seed: int = 5) -> np.ndarray:
    found = renderer(colour).render(bump(), quality="reference", seed=seed, samples=paths, place=place)
    return np.asarray(found.radiance, np.float64)


def test_a_lump_of_the_tissues_own_optics_changes_no_bit_and_a_dark_one_darkens(variant: str) -> None:
    own, plain = (picture(Colour(), place, 2**13) for place in (ball(0.5), None))
    assert np.array_equal(own, plain)
    middle = (slice(None), *MIDDLE)
    assert picture(DARK, ball(0.5), 2**13)[middle].sum() < 0.85 * plain[middle].sum()


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_dark_lump_close_below_darkens_the_middle_and_a_deep_one_does_not(variant: str) -> None:
    """4 mm wide with its top 0.5 mm deep, and 12 mm deep, three times as far as light reaches."""
    means = {}
    for name, place in (("plain", None), ("close", ball(0.5)), ("deep", ball(12.0))):
        runs = [picture(DARK, place, 2**16, seed).sum(axis=0)[MIDDLE].mean() for seed in (1, 2, 3)]
        means[name] = np.mean(runs), np.std(runs, ddof=1) / np.sqrt(len(runs))
    print({name: f"{mean:.4g} ± {error:.2g}" for name, (mean, error) in means.items()})
    (mean, error), (close, _), (deep, other) = (means[name] for name in ("plain", "close", "deep"))
    assert close < 0.8 * mean
    assert abs(deep - mean) < 4.0 * np.hypot(error, other)


# One visit to the tissue, against the walk in its own frame

MATCHED = dataclasses.replace(
    paper_sensor(),
    guide=Guide(width_mm=25.0, thickness_mm=10.0, refractive_index=1.4),
    skin=Skin(contact="full"),
    tissue=Tissue(scattering_per_mm=1.0, absorption_per_mm=0.05),
    inclusion=Colour(scattering_per_mm=3.0, absorption_per_mm=2.0),
)
LANES, LOTS = 2**19, 16


class Above:
    """Looks along the normal of the face from far away, and sums what it sees."""

    spread_per_mm = 0.0

    def __init__(self, normal: np.ndarray) -> None:
        import drjit as dr
        import mitsuba as mi

        self._down = mi.Vector3f(*map(float, normal / -normal[2]))
        self.seen = dr.zeros(mi.Int64, LOTS)

    def towards(self, point: Any) -> Any:
        return self._down

    def add(self, number: Any, point: Any, amounts: Any, active: Any) -> None:
        import drjit as dr
        import mitsuba as mi

        dr.scatter_add(self.seen, mi.Int64(dr.round(amounts[0] * 2.0**26)), number % LOTS, active)


@pytest.mark.parametrize("tilt_deg", [0.0, 20.0])
def test_a_pencil_beam_over_a_lump_comes_back_as_the_walk_has_it(variant: str, tilt_deg: float) -> None:
    """Straight in through a face that lets all light pass, level or tilted: what leaves, and what is seen
    along the normal, over a ball beside the beam; `walk` knows neither sensor nor frame."""
    import drjit as dr
    import mitsuba as mi

    from scenes import build, walk, wander
    from scenes.bsdf import Table

    optics = build.optics_of(MATCHED)
    table = Table(Table.pack(optics, build.coupling_of(MATCHED, optics)))
    angle = np.deg2rad(tilt_deg)
    normal = np.array([np.sin(angle), 0.0, -np.cos(angle)])  # out of the tissue
    entry = np.array([1.0, -2.0, -0.3])
    frame = mi.Frame3f(mi.Vector3f(*map(float, normal)))
    side, down = (
        np.array(frame.to_world(mi.Vector3f(*v))).ravel() for v in ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
    )
    radius, aside, deep = 1.2, 0.4, 1.7
    place = entry + aside * side + deep * down, radius * np.eye(3)

    spots = wander.Spots.of(MATCHED, np.ones((8, 8)), None)
    lanes = dr.zeros(mi.Float, LANES)
    met = SimpleNamespace(
        p=mi.Point3f(*map(float, entry)) + mi.Vector3f(lanes, lanes, lanes),
        d=mi.Vector3f(*map(float, -normal)) + mi.Vector3f(lanes, lanes, lanes),
    )
    line = (np.arange(8) + 0.5) / 8 * 25.0 - 12.5
    plane = entry[2] - (line - entry[0]) * normal[0] / normal[2] + 0.0 * line[:, None]
    relief = wander.Relief.on(plane, 25.0)
    above, lump = Above(normal), wander.Lump.of(MATCHED, place)
    _, left, _, _ = wander.wander(
        MATCHED, table, spots, relief, [above], met, dr.arange(mi.UInt32, LANES), dr.ones(mi.Float, LANES),
        mi.Bool(True), walk.generator(LANES, 3), (), lump,
    )  # fmt: skip
    back = np.asarray(left, np.float64).reshape(-1, LOTS).mean(axis=0)
    # views count light per level area
    along = above.seen.numpy() / 2.0**26 / (LANES / LOTS) * np.cos(angle)

    medium = wander.medium_of(MATCHED.tissue)
    inside = wander.medium_of(MATCHED.inclusion.of(MATCHED.tissue))
    body = walk.Body(medium, ball=walk.Ball((aside, 0.0, deep), radius, inside))
    walked = walk.walk(body, 4 * LANES, 4, entry=1.0, bins=16)
    plain = walk.walk(walk.Body(medium), LANES, 4, entry=1.0).reflectance[0]
    share, error = back.mean(), back.std(ddof=1) / np.sqrt(LOTS)
    assert walked.reflectance[0] < 0.9 * plain  # the ball is felt
    assert abs(share - walked.reflectance[0]) < 4.0 * np.hypot(error, walked.reflectance[1])
    # radiance along the normal: light in steps of the squared cosine, straight on to 1
    steepest = 1.5 * walked.lobe[-1] - 0.5 * walked.lobe[-2]
    its_error = np.hypot(1.5 * walked.lobe_error[-1], 0.5 * walked.lobe_error[-2])
    seen, off = along.mean(), along.std(ddof=1) / np.sqrt(LOTS)
    print(f"back {share:.5f}, walk {walked.reflectance[0]:.5f}; {np.pi * seen:.5f}, {16 * steepest:.5f}")
    assert abs(np.pi * seen - 16 * steepest) < 4.0 * np.hypot(np.pi * off, 16 * its_error)


def test_energy_closes_with_a_lump(variant: str) -> None:
    """What leaves and what both media absorb is all that entered."""
    import drjit as dr
    import mitsuba as mi

    from scenes import walk, wander

    medium = wander.medium_of(MATCHED.tissue)
    lump = wander.Lump.of(MATCHED, ball(0.3, 1.0))
    assert lump is not None
    total = dr.zeros(mi.Int64, 2)
    losses = [one.absorption_per_mm / one.scattering_per_mm for one in (lump.medium, medium)]

    def witness(where: Any, way: Any, share: Any, g: Any, collides: Any, backed: Any, scores: Any) -> None:
        inside = body.ball.holds(where)
        lost = share * dr.select(inside, *losses)
        place = dr.select(inside, mi.UInt32(0), mi.UInt32(1))
        dr.scatter_add(total, mi.Int64(dr.round(lost * 2.0**20)), place, collides)

    way = mi.Vector3f(0.0, 0.0, 1.0) + dr.zeros(mi.Vector3f, LANES)
    body = walk.Body(medium, ball=lump)
    _, _, left, _, _, _ = walk.roam(
        body,
        dr.zeros(mi.Point3f, LANES),
        way,
        walk.generator(LANES, 6),
        walk.fresnel(1.4, 1.0),
        True,
        witness,
    )
    back = float(np.asarray(left, np.float64).mean())
    kept, absorbed = total.numpy() / 2.0**20 / LANES
    print(f"back {back:.4f}, in the lump {kept:.4f}, in the tissue {absorbed:.4f}")
    assert kept > 0.1
    assert back + kept + absorbed == pytest.approx(1.0, abs=2e-3)


# Where the mechanics put it


LAYERS = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))


def still(tilt_deg: tuple[float, float], inclusion: fem.Inclusion, moves: Any) -> Place:
    """The place of an inclusion whose nodes, (n, 3) in the probe's frame, move as a function says."""
    from fem.carried import carried
    from fem.mesh import QUALITIES, Geometry
    from fem.meshed import build

    geometry = Geometry(fem.Probe(25, LAYERS), fem.Slab(30, 60, 5), inclusion, fem.Pose(tilt_deg))
    model = build(geometry, QUALITIES["preview"], True)
    return carried(geometry, SimpleNamespace(model=model, moved=moves(model.place)))


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (4.0, -3.0)])
@pytest.mark.parametrize("offset", [(0.0, 0.0), (3.0, -1.0)])
def test_an_inclusion_is_found_where_a_uniform_strain_takes_it(
    tilt_deg: tuple[float, float], offset: tuple[float, float]
) -> None:
    """To the last digits; the specimen lies turned the other way before a tilted probe."""
    from fem.mesh import rotation

    inclusion = fem.Inclusion(8.0, 5.0, 50.0, offset, stretch=(1.2, 1.0, 0.8))
    turn = rotation(tilt_deg).T
    strain = np.diag([0.03, -0.02, -0.05])
    if any(offset):
        strain += 0.01 * np.arange(9.0).reshape(3, 3)
    push = np.array([0.0, 0.0, -1.5])
    before = turn @ [*offset, inclusion.centre_mm], turn @ np.diag(inclusion.radii_mm)
    centre, axes = still(tilt_deg, inclusion, lambda place: 0.0 * place)
    np.testing.assert_allclose(centre, before[0], atol=1e-9)
    np.testing.assert_allclose(axes, before[1], atol=1e-9)
    centre, axes = still(tilt_deg, inclusion, lambda place: place @ strain.T + push)
    np.testing.assert_allclose(centre, (np.eye(3) + strain) @ before[0] + push, atol=1e-9)
    np.testing.assert_allclose(axes, (np.eye(3) + strain) @ before[1], atol=1e-9)


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_a_press_carries_the_inclusion_as_its_own_nodes_say() -> None:
    """At 3 mm, by the cut: volume stays, a stiff one keeps its shape and comes near, a soft one gives way."""
    gaps, stretches = [], []
    for modulus in (100.0, 1.0):
        inclusion = fem.Inclusion(8.0, 4.0, modulus, (2.0, 0.0))
        probe, slab = fem.Probe(25, LAYERS), fem.Slab(30, 60, 5)
        press = fem.press(probe, slab, inclusion, 3.0, quality="preview", estimate=False)
        found = press.inclusion()
        assert found is not None
        (centre, axes), cut = found, press.cut
        cells = np.flatnonzero(cut["material"] == 1)
        nodes = np.unique(np.concatenate([cut.get_cell(k).point_ids for k in cells]))
        place = cut.points[nodes] + cut["displacement"][nodes]
        far = np.linalg.norm((place - centre) @ np.linalg.inv(axes).T, axis=1)
        assert far.max() == pytest.approx(1.0, abs=0.03)  # of the radius
        assert np.linalg.det(axes) == pytest.approx(4.0**3, rel=0.03)
        top = np.argmin(np.linalg.norm(press.surface.points - [2.0, 0.0, 0.0], axis=1))
        gaps.append(centre[2] - np.linalg.norm(axes[2]) - press.surface["displacement"][top, 2])
        stretches.append(np.linalg.svd(axes, compute_uv=False) / 4.0)
        print(f"{modulus:g} kPa: {gaps[-1]:.3f} mm of 4 left above, stretch {stretches[-1].round(3)}")
    assert 3.0 < gaps[0] < gaps[1] < 4.0
    assert abs(stretches[0] - 1.0).max() < 0.02 < abs(stretches[1] - 1.0).max()


def test_no_inclusion_no_place() -> None:
    press = fem.press(
        fem.Probe(25, (fem.Layer(10, 100),)), fem.Slab(30, 60, 5), None, 0.5,
        quality="preview", mechanics="linear", estimate=False,
    )  # fmt: skip
    assert press.inclusion() is None


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_frames_show_a_dark_inclusion_and_their_reference_does_not(variant: str) -> None:
    """From design to frame, to its record."""
    from test_simulate import small

    plain, inclusion = small(), twin.Inclusion(size=8, depth=1, modulus=20)
    dark = dataclasses.replace(plain, specimen=dataclasses.replace(plain.specimen, inclusion=DARK))
    frames = [
        twin.simulate(one, inclusion, 1.0, quality="reference", noise=1e3, seed=1, device="cpu")
        for one in (plain, dark)
    ]
    middle, rim = (slice(26, 35), slice(43, 53)), (slice(None), slice(0, 12))
    for where, low, high in ((middle, 0.2, 0.8), (rim, 0.85, 1.15)):
        before, after = (frame.radiance[(slice(None), *where)].sum() for frame in frames)
        print(f"dark over plain: {after / before:.3f}")
        assert low < after / before < high
    assert np.array_equal(frames[0].reference, frames[1].reference)
    assert "optics" not in frames[0].record()["inclusion"]
    assert frames[1].record()["inclusion"]["optics"]["absorption_per_mm"] == 5.0


# What is refused


def coloured(**colour: float) -> twin.Design:
    tables = tables_of(load_design("tsis"))
    tables["specimen"]["inclusion"] = colour
    return parse_design(tables)


def test_what_is_left_out_is_the_tissues() -> None:
    tissue = Tissue(scattering_per_mm=2.0, absorption_per_mm=0.1, anisotropy=0.5)
    assert Colour().of(tissue) == tissue
    assert Colour(absorption_per_mm=0.4).of(tissue) == dataclasses.replace(tissue, absorption_per_mm=0.4)
    design = coloured(scattering_per_mm=3.0)
    assert parse_design(tables_of(design)) == design


@pytest.mark.parametrize(
    ("colour", "says"),
    [
        ({"absorption_per_mm": 25.0}, "specimen.inclusion: received 26 per mm"),
        ({"scattering_per_mm": 5.0, "anisotropy": 0.9}, "allowed µs"),
        ({"absorption_per_mm": -1.0}, "specimen.inclusion.absorption_per_mm: received -1.0"),
        ({"index": 1.5}, "specimen.inclusion.index"),
    ],
)
def test_optics_that_cannot_be_walked_in_are_refused(colour: dict[str, float], says: str) -> None:
    with pytest.raises(DesignError, match=says) as refused:
        coloured(**colour)
    assert "\n" not in str(refused.value)


def test_a_sheet_before_it_is_refused() -> None:
    tables = tables_of(coloured(absorption_per_mm=1.0))
    tables["surface"]["sheet"] = {"thickness_mm": 0.3, "modulus_kPa": 100.0}
    with pytest.raises(DesignError, match=r"specimen.inclusion: received it behind a contact sheet"):
        parse_design(tables)


def test_other_light_refuses(variant: str) -> None:
    from scenes import Renderer, SpectralRenderer

    sensor = dataclasses.replace(paper_sensor(**SMALL), inclusion=DARK)
    for make in (Renderer, SpectralRenderer):
        with pytest.raises(NotModelled, match="inclusion: received optics of its own"):
            make(sensor, device="cpu")
    renderer = Renderer(sensor, "cpu", coloured=True)
    for quality in ("preview", "standard"):
        with pytest.raises(NotModelled, match="inclusion: received optics of its own"):
            renderer.render(bump(), quality=quality, place=ball(1.0))


VERBS = {
    "standard": "simulate {design} --size 10 --depth 5 --modulus 100 --out {out}",
    "preview": "simulate {design} --size 10 --depth 5 --modulus 100 --quality preview --out {out}",
    "emulator": "simulate {design} --size 10 --depth 5 --modulus 100 --quality reference "
    "--mechanics emulator --out {out}",
    "check": "check {design}",
    "learned light": "emulate {design} --light --out {out}.npz",
    "mitsuba": "export {design} --size 10 --depth 5 --modulus 100 --mitsuba {out}",
    "corpus": "corpus plan {corpus} --out {out}",
    "explore": "explore {layouts} --out {out}",
}


@pytest.mark.parametrize("verb", VERBS)
def test_verbs_refuse_in_one_line_before_any_work(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from importlib.resources import files

    from twin.cli import main

    text = files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8")
    design = tmp_path / "dark.toml"
    design.write_text(text.replace("[press]", "[specimen.inclusion]\nabsorption_per_mm = 1.0\n\n[press]"))
    names = {"design": design, "out": tmp_path / "out"}
    for name, shipped in (("corpus", "quick"), ("layouts", "surface")):
        study = files("assets").joinpath("studies", f"{shipped}.toml").read_text(encoding="utf-8")
        names[name] = tmp_path / f"{name}.toml"
        names[name].write_text(study.replace('design = "tsis"', 'design = "dark.toml"'))
    assert main(VERBS[verb].format(**names).split()) == 2
    line = capsys.readouterr().err
    assert line.count("\n") == 1 and "specimen.inclusion: received optics of its own; allowed none in" in line
    assert not (tmp_path / "out").exists()
