"""Tissue under a bent contact: the standard light's factor against the walk, which knows nothing of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from scenes.bent import bent
from scenes.tissue import tissue_optics

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


def given_back(scattering: float, absorption: float, face: Any, seed: int) -> tuple[float, float]:
    """Share of Lambertian light that comes back, and its standard error."""
    import drjit as dr
    import mitsuba as mi

    from scenes import walk

    random = walk.generator(LANES, seed)
    way = mi.warp.square_to_cosine_hemisphere(mi.Point2f(random.next_float32(), random.next_float32()))
    body = walk.Body(walk.Medium(scattering, absorption), face=face)
    start = dr.zeros(mi.Point3f, LANES)
    left = walk.roam(body, start, way, random, lambda where, cosine: mi.Float(1.0))[2]
    left = np.asarray(left, np.float64)
    return float(left.mean()), float(left.std(ddof=1) / np.sqrt(LANES))


@pytest.mark.parametrize(("scattering", "absorption"), [(1.0, 0.02), (1.0, 0.2)])
@pytest.mark.parametrize("radius", [60.0, -60.0])
def test_a_bent_face_gives_back_what_the_walk_has(
    variant: str, scattering: float, absorption: float, radius: float
) -> None:
    """By reciprocity what comes back of one spot, all over, is what comes back there of light all over:
    within a tenth of the change, and the noise."""
    flat, error = given_back(scattering, absorption, None, 1)
    curved, its_error = given_back(scattering, absorption, Bowl(radius), 2)
    line = (np.arange(200) + 0.5) * 0.25 - 25.0
    height = -(line**2 + line[:, None] ** 2) / (2.0 * radius)
    factor = bent(tissue_optics(scattering, absorption), 50.0, 200).on(height, 0.0)[100, 100]
    foretold, found = factor**2 - 1.0, curved / flat - 1.0
    noise = float(np.hypot(error / flat, its_error / flat))
    print(f"{radius:g} mm, {scattering:g}, {absorption:g}/mm: {found:+.3%} ± {noise:.3%}; {foretold:+.3%}")
    assert abs(found) > 5.0 * noise and np.sign(found) == -np.sign(radius)
    assert abs(found - foretold) < 0.1 * abs(foretold) + 3.0 * noise


@pytest.mark.parametrize(
    ("absorption", "length", "thrown"),
    [
        (0.02, 30.0, 0.0),
        (0.02, 16.0, 0.0),
        (0.02, 16.0, 0.55),
        (0.1, 20.0, 0.0),
        pytest.param(0.02, 30.0, 0.55, marks=pytest.mark.slow),
        pytest.param(0.02, 10.0, 0.0, marks=pytest.mark.slow),
        pytest.param(0.1, 12.0, 0.0, marks=pytest.mark.slow),
        pytest.param(0.1, 8.0, 0.0, marks=pytest.mark.slow),
    ],
)
def test_light_of_all_over_comes_out_of_waves_as_the_walk_has_it(
    variant: str, absorption: float, length: float, thrown: float
) -> None:
    """Within an eighth of what even curvature as strong would change, and the noise."""
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

    tissue, cells = tissue_optics(1.0, absorption), 400
    prepared = bent(tissue, 4.0 * length, cells)
    line = (np.arange(cells) + 0.5) / cells * 4.0 * length
    middle = slice(3 * cells // 8, 5 * cells // 8)  # of four waves the inner one, away from the map's edges

    def change(waves: np.ndarray) -> float:
        factor = prepared.on(np.tile(height * waves, (cells, 1)), thrown)[cells // 2]
        return 2.0 * float(((factor - 1.0) * waves)[middle].mean())

    again = np.ravel(tissue.slab.reflectance(np.array([1e-3, wave / tissue.transport_per_mm])))
    given = again / (1.0 - thrown * again)
    foretold = change(np.cos(wave * line)) * (1.0 + given[1] / given[0])
    even = 0.5 * height * wave**2 * prepared.answer[0, 0] / (1.0 - thrown * again[0])
    what = f"{absorption:g}/mm, {length:g} mm, {thrown:g}"
    print(f"{what}: {mean:+.3%} ± {noise:.3%}; {foretold:+.3%} of {even:+.3%}")
    assert abs(mean - foretold) < 0.125 * abs(even) + 3.0 * noise


def test_a_plane_level_or_leaning_changes_nothing() -> None:
    line = np.linspace(-12.0, 12.0, 40)
    plane = -0.3 + 0.05 * line + 0.02 * line[:, None]
    factor = bent(tissue_optics(1.0, 0.02), 25.0, 40).on(plane, 0.3)
    np.testing.assert_allclose(factor, 1.0, rtol=0, atol=1e-12)


def test_light_thrown_back_feels_the_bend_again() -> None:
    line = np.linspace(-12.0, 12.0, 40)
    hill = -(line**2 + line[:, None] ** 2) / 200.0
    tissue = bent(tissue_optics(1.0, 0.02), 25.0, 40)
    once, again = (1.0 - tissue.on(hill, thrown)[20, 20] for thrown in (0.0, 0.5))
    flat = tissue.reflectance[0, 0]
    assert once > 0.0
    assert 1.0 < again / once < 1.0 / (1.0 - 0.5 * flat)
