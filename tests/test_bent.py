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
