"""Tissue under a bent contact: the standard light's factor against the walk, which knows nothing of it."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from scenes.bent import Bent, bent
from scenes.tissue import tissue_optics

Array = NDArray[np.float64]

LANES = 2**20


class Bowl:
    """A paraboloid with both curvatures 1/radius, mm; a positive one bulges into the tissue."""

    def __init__(self, radius_mm: float):
        self.radius = radius_mm

    def at(self, point: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        x, y = point.x / self.radius, point.y / self.radius
        normal = dr.normalize(mi.Vector3f(x, y, 1.0))
        return (point.z + 0.5 * (x * point.x + y * point.y)) * normal.z, normal


class Ripple:
    """Waves of the height along x."""

    def __init__(self, height_mm: float, length_mm: float):
        self.height, self.wave = height_mm, 2.0 * np.pi / length_mm

    def at(self, point: Any) -> Any:
        import drjit as dr
        import mitsuba as mi

        sine, cosine = dr.sincos(self.wave * point.x)
        normal = dr.normalize(mi.Vector3f(self.height * self.wave * sine, 0.0, 1.0))
        return (point.z - self.height * cosine) * normal.z, normal


def came_back(
    scattering: float,
    absorption: float,
    bowl: Bowl,
    seed: int,
    spot_mm: float = 0.0,
    *,
    upright: bool = False,
    thrown: float = 0.0,
) -> tuple[Array, Array]:
    """Shares of light that entered about the origin, and how far from it they came back, mm: Lambertian
    light, or `upright`, along the normal, under a face that throws back such a share."""
    import drjit as dr
    import mitsuba as mi

    from scenes import walk

    random = walk.generator(LANES, seed)
    way = mi.warp.square_to_cosine_hemisphere(mi.Point2f(random.next_float32(), random.next_float32()))
    if upright:
        way = mi.Vector3f(0.0, 0.0, dr.full(mi.Float, 1.0, LANES))
    body = walk.Body(walk.Medium(scattering, absorption), face=bowl)
    x, y = (
        spot_mm * part
        for part in mi.warp.square_to_std_normal(mi.Point2f(random.next_float32(), random.next_float32()))
    )
    start = mi.Point3f(x, y, -0.5 * (dr.square(x) + dr.square(y)) / bowl.radius)
    way = mi.Frame3f(bowl.at(start)[1]).to_world(way)
    where, _, left = walk.roam(body, start, way, random, lambda where, cosine: mi.Float(1.0 - thrown))[:3]
    return np.asarray(left, np.float64), np.hypot(np.asarray(where.x), np.asarray(where.y))


def lit_by(prepared: Bent, entering: Array, thrown: float) -> Array:
    """Light that goes up under a flat face."""
    given = prepared.reflectance / (1.0 - thrown * prepared.reflectance)
    box, wide = (len(given), len(given)), entering.shape[-1]
    return np.fft.irfft2(given * np.fft.rfft2(entering, box), box)[..., :wide, :wide]


def odd_part(bulging: list[Array], hollow: list[Array]) -> tuple[float, float]:
    """What a bend changes of what comes back, half the difference over the mean, and its standard error."""
    means = [np.mean(shares) for shares in (bulging, hollow)]
    errors = [np.std(shares) / np.sqrt(np.size(shares)) for shares in (bulging, hollow)]
    return float((means[0] - means[1]) / sum(means)), float(np.hypot(*errors) / sum(means))


@pytest.mark.parametrize(
    "absorption",
    [0.02, 0.2, pytest.param(0.005, marks=pytest.mark.slow), pytest.param(0.08, marks=pytest.mark.slow)],
)
def test_a_bent_face_gives_back_what_the_walk_has(variant: str, absorption: float) -> None:
    """By reciprocity what comes back of one spot, all over, is what comes back there of light all over:
    within a fiftieth of the change, and the noise."""
    shares = [
        [came_back(1.0, absorption, Bowl(radius), seed + seeds)[0] for seed in range(2)]
        for seeds, radius in ((0, 60.0), (10, -60.0))
    ]
    found, noise = odd_part(*shares)
    # a wave so long that its crest is all there is
    wave = 2.0 * np.pi / 1000.0
    height = np.cos(wave * 10.0 * np.arange(-50, 50)) / wave**2 / 60.0
    prepared, even = bent(tissue_optics(1.0, absorption), 1000.0, 100, 0, 0), np.ones((1, 100, 100))
    factor = prepared.on(height + height[:, None], 0.0).factor(even, lit_by(prepared, even, 0.0))
    foretold = factor[0, 50, 50] - 1.0
    print(f"{absorption:g}/mm: {found:+.3%} ± {noise:.3%}; {foretold:+.3%}")
    assert found < -10.0 * noise
    assert abs(found - foretold) < 0.02 * abs(foretold) + 3.0 * noise


@pytest.mark.slow
@pytest.mark.parametrize("thrown", [0.0, 0.5])
def test_light_towards_the_camera_is_bent_about_as_all_of_it(variant: str, thrown: float) -> None:
    """Along the normal more of it comes from below, which feels the bend: by up to a seventh more, and the
    noise. By reciprocity what leaves along the normal is what comes back of light that enters so."""

    def changed(upright: bool) -> tuple[float, float]:
        shares = [
            [
                came_back(1.0, 0.02, Bowl(radius), seed, upright=upright, thrown=thrown)[0]
                for seed in range(first, first + 4)
            ]
            for first, radius in ((0, 60.0), (10, -60.0))
        ]
        return odd_part(*shares)

    found, noise = np.transpose([changed(upright) for upright in (False, True)])
    ratio, error = found[1] / found[0], float(np.hypot(*(noise / found)))
    what = f"all {found[0]:+.3%}, along the normal {found[1]:+.3%}"
    print(f"thrown back {thrown:g}: {what}: {ratio:.3f} ± {error:.3f}")
    assert 1.0 - 3.0 * error < ratio < 1.14 + 3.0 * error


def test_light_from_afar_is_changed_as_the_walk_has_it(variant: str) -> None:
    """The farther the more: of a spot, in rings, within a twentieth of the change, and the noise."""
    spot, rings = 1.0, np.array([0.0, 2.0, 4.0, 7.0])
    shares = [
        [came_back(1.0, 0.02, Bowl(radius), seed + seeds, spot) for seed in range(4)]
        for seeds, radius in ((0, 60.0), (10, -60.0))
    ]
    line = (np.arange(201) - 100) * 0.25
    square = line**2 + line[:, None] ** 2
    prepared, lit = bent(tissue_optics(1.0, 0.02), 50.25, 201, 0, 0), np.exp(-0.5 * square / spot**2)[None]
    upward = lit_by(prepared, lit, 0.0)
    change = (prepared.on(-square / 120.0, 0.0).factor(lit, upward) - 1.0) * upward
    for low, high in pairwise(rings):
        found, noise = odd_part(*([s * ((away >= low) & (away < high)) for s, away in one] for one in shares))
        there = (square >= low**2) & (square < high**2)
        foretold = float(change[0, there].sum() / upward[0, there].sum())
        print(f"{low:g} to {high:g} mm: {found:+.2%} ± {noise:.2%}; {foretold:+.2%}")
        assert abs(found - foretold) < 0.05 * abs(foretold) + 3.0 * noise


@pytest.mark.parametrize(
    ("absorption", "length", "thrown"),
    [
        (0.02, 16.0, 0.0),
        (0.02, 16.0, 0.55),
        (0.02, 10.0, 0.0),
        pytest.param(0.02, 30.0, 0.0, marks=pytest.mark.slow),
        pytest.param(0.1, 20.0, 0.0, marks=pytest.mark.slow),
        pytest.param(0.02, 30.0, 0.55, marks=pytest.mark.slow),
        pytest.param(0.1, 12.0, 0.0, marks=pytest.mark.slow),
        pytest.param(0.1, 8.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_light_of_all_over_comes_out_of_waves_as_the_walk_has_it(
    variant: str, absorption: float, length: float, thrown: float
) -> None:
    """Within a twentieth of what even curvature as strong would change, and the noise."""
    import drjit as dr
    import mitsuba as mi

    from scenes import walk

    wave, found = 2.0 * np.pi / length, []
    height = min(0.04 / wave**2, 0.3)
    for seed in range(4):
        random = walk.generator(LANES, seed)
        x = random.next_float32() * length
        way = mi.warp.square_to_cosine_hemisphere(mi.Point2f(random.next_float32(), random.next_float32()))
        sine, cosine = dr.sincos(wave * x)
        normal = dr.normalize(mi.Vector3f(height * wave * sine, 0.0, 1.0))
        body = walk.Body(walk.Medium(1.0, absorption), face=Ripple(height, length))
        start, way = mi.Point3f(x, 0.0, height * cosine), mi.Frame3f(normal).to_world(way)
        where, _, left = walk.roam(body, start, way, random, lambda _, cosine: mi.Float(1.0 - thrown))[:3]
        weight = np.asarray(left, np.float64)
        found.append(2.0 * (weight * np.cos(wave * np.asarray(where.x))).sum() / weight.sum())
    mean, noise = float(np.mean(found)), float(np.std(found, ddof=1) / np.sqrt(len(found)))

    prepared, all_over = bent(tissue_optics(1.0, absorption), length, 64, 0, 0), np.ones((1, 64, 64))
    waves = np.cos(2.0 * np.pi * (np.arange(64) + 0.5) / 64)
    upward = lit_by(prepared, all_over, thrown)
    factor = prepared.on(np.tile(height * waves, (64, 1)), thrown).factor(all_over, upward)[0, 0]
    foretold = 2.0 * float(((factor - 1.0) * waves).mean())
    flat = prepared.reflectance[0, 0]
    even = -0.5 * height * wave**2 * prepared.strength[0, 0] / flat / (1.0 - thrown * flat)
    what = f"{absorption:g}/mm, {length:g} mm, {thrown:g}"
    print(f"{what}: {mean:+.3%} ± {noise:.3%}; {foretold:+.3%} of {even:+.3%}")
    assert abs(mean - foretold) < 0.05 * abs(even) + 3.0 * noise


def test_a_plane_level_or_leaning_changes_nothing() -> None:
    """But for what wraps round at the map's edges, where hardly any light is."""
    prepared, line = bent(tissue_optics(1.0, 0.2), 50.0, 100, 15, 0), (np.arange(130) - 65) * 0.5
    spot = np.exp(-0.5 * (line**2 + line[:, None] ** 2))[None]
    upward, line = lit_by(prepared, spot, 0.3), line[15:-15]
    for lean, most in (0.0, 1e-12), (0.05, 1e-3):
        plane = -0.3 + lean * line + 0.4 * lean * line[:, None]
        factor = prepared.on(plane, 0.3).factor(spot, upward)
        np.testing.assert_allclose(factor[0, 40:60, 40:60], 1.0, rtol=0, atol=most)


def test_light_thrown_back_feels_the_bend_again() -> None:
    """What comes up once is bent once; with a share w thrown back, 1 / (1 - w R) times as much."""
    line = np.cos(2.0 * np.pi * (np.arange(100) + 0.5) / 100)
    hill = 0.05 * (line + line[:, None])
    prepared, even = bent(tissue_optics(1.0, 0.02), 200.0, 100, 0, 0), np.ones((1, 100, 100))
    once, again = (
        1.0 - prepared.on(hill, thrown).factor(even, lit_by(prepared, even, thrown))[0, 0, 0]
        for thrown in (0.0, 0.5)
    )
    flat = prepared.reflectance[0, 0]
    assert once > 0.0
    assert 1.0 < again / once < 1.0 / (1.0 - 0.5 * flat)


@pytest.mark.slow
def test_a_press_of_the_sensor_gives_back_what_the_walk_has(variant: str) -> None:
    """The shipped sensor at 2.9 mm, whose face curves towards its rim, evenly lit: within 0.15 % by
    millimetres from the rim, and the noise."""
    import mitsuba as mi

    import twin
    from scenes import surface, walk, wander
    from twin import presses

    design, thrown = twin.load_design("tsis"), 0.5
    width, cells = design.waveguide.width_mm, 100
    (press,) = presses.emulated(design, None, [2.9], presses.emulator_of(design, "tsis"))
    line = (np.arange(200) + 0.5) / 200 * width - width / 2
    height = surface.heights(surface.resample(press.surface, width), line)
    height -= height.mean()
    sums = np.zeros((2, 10, cells, cells))
    for half, face in enumerate((None, wander.Relief.on(height, width))):
        body = walk.Body(walk.Medium(1.0, 0.02), face=face)
        for lot, into in enumerate(sums[half]):
            random = walk.generator(LANES, 10 * lot + half)
            x, y = ((random.next_float32() - 0.5) * width for _ in range(2))
            start, normal = mi.Point3f(x, y, 0.0), mi.Vector3f(0.0, 0.0, 1.0)
            if face is not None:
                start, normal = face.onto(start)
            u = mi.Point2f(random.next_float32(), random.next_float32())
            way = mi.Frame3f(normal).to_world(mi.warp.square_to_cosine_hemisphere(u))
            where, _, left = walk.roam(body, start, way, random, lambda _, cosine: mi.Float(1.0 - thrown))[:3]
            column, row = (np.floor((np.asarray(at) / width + 0.5) * cells) for at in (where.x, where.y))
            here = (np.minimum(column, row) >= 0) & (np.maximum(column, row) < cells)
            cell = (row * cells + column)[here].astype(int)
            into += np.bincount(cell, np.asarray(left, np.float64)[here], cells**2).reshape(cells, cells)
    prepared, even = bent(tissue_optics(1.0, 0.02), width, cells, 15, 50), np.zeros((1, 130, 130))
    even[:, 15:-15, 15:-15] = 1.0
    upward = lit_by(prepared, even, thrown)
    factor = prepared.on(height, thrown).factor(even, upward)[0]
    light = upward[0, 15:-15, 15:-15]
    inward = np.minimum(np.arange(cells), np.arange(cells)[::-1])
    away = np.minimum(inward, inward[:, None])
    for mm in range(12):
        there = away // 4 == mm
        ratios = sums[1][:, there].sum(axis=1) / sums[0][:, there].sum(axis=1)
        found, noise = ratios.mean() - 1.0, ratios.std(ddof=1) / np.sqrt(len(ratios))
        foretold = (factor * light)[there].sum() / light[there].sum() - 1.0
        print(f"{mm} to {mm + 1} mm: {found:+.2%} ± {noise:.2%}; {foretold:+.2%}")
        assert abs(found - foretold) < 0.15e-2 + 3.0 * noise
