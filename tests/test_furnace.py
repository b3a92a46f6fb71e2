"""A white furnace: where nothing absorbs and all light is alike, the contact surface cannot be seen."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sensors import contact_bsdf


@pytest.fixture(scope="module")
def mi(variant: str) -> ModuleType:
    import mitsuba

    from scenes import bsdf  # noqa: F401  registers the plugin

    return mitsuba


def furnace(mi: ModuleType, fraction: float, albedo: float, lid_of_light: bool) -> dict[str, Any]:
    """A contact surface as floor, four walls of radiance 1, and a lid: one more, or the floor's twin."""
    t = mi.ScalarTransform4f
    black = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}}
    light = {"bsdf": black, "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1.0}}}
    contact = {"bsdf": contact_bsdf(fraction, albedo)}
    lid = t().translate([0, 0, 1]).rotate([1, 0, 0], 180)
    scene: dict[str, Any] = {"type": "scene"}
    scene["floor"] = {"type": "rectangle", **contact}  # looks up, +z
    scene["lid"] = {"type": "rectangle", "to_world": lid, **(light if lid_of_light else contact)}
    for k, (x, y) in enumerate([(1, 0), (-1, 0), (0, 1), (0, -1)]):
        place = t().look_at(origin=[x, y, 0.5], target=[0, 0, 0.5], up=[0, 0, 1]).scale([1, 0.5, 1])
        scene[f"wall_{k}"] = {"type": "rectangle", "to_world": place, **light}
    return scene


def furnace_radiance(mi: ModuleType, description: dict[str, Any], count: int = 2**22) -> tuple[float, float]:
    """Mean radiance that the floor sends up to many points of view in the chamber, and its standard error."""
    scene = mi.load_dict(description)
    integrator = mi.load_dict({"type": "path", "max_depth": 200, "rr_depth": 100})
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(3, count)
    spot, tilt = sampler.next_2d(), sampler.next_2d()
    up = mi.warp.square_to_cosine_hemisphere(tilt)
    foot = mi.Point3f(1.98 * (spot.x - 0.5), 1.98 * (spot.y - 0.5), 0.0)
    ray = mi.RayDifferential3f(mi.Ray3f(foot + 1e-3 * up, -up))
    radiance = np.asarray(integrator.sample(scene, sampler, ray)[0][0])
    mean, spread = radiance.mean(dtype=np.float64), radiance.std(dtype=np.float64)
    return float(mean), float(spread / np.sqrt(count))


@pytest.mark.parametrize(
    ("fraction", "lid_of_light"),
    [(0.0, True), (0.003, True), (0.13, True), (1.0, True), (0.5, False), (1.0, False)],
)
def test_white_furnace_stays_white(mi: ModuleType, fraction: float, lid_of_light: bool) -> None:
    """No absorption anywhere and radiance 1 from all walls: everything in the chamber has radiance 1.

    Twin surfaces, which see each other many times, need good contact: without it, light leaves the tissue
    in a narrow cone, the weights of cosine-distributed samples multiply from bounce to bounce, and the noise
    has no end.
    """
    mean, error = furnace_radiance(mi, furnace(mi, fraction, 1.0, lid_of_light))
    print(f"A_r {fraction}, lid of light {lid_of_light}: radiance {mean:.5f} ± {error:.5f}")
    assert error < 5e-4
    assert mean == pytest.approx(1.0, abs=1e-3)


def test_furnace_with_a_black_tissue_does_not(mi: ModuleType) -> None:
    """The furnace can fail: with an absorbing tissue the floor is darker than its surroundings."""
    mean, _ = furnace_radiance(mi, furnace(mi, 0.5, 0.0, True), 2**16)
    assert mean < 0.8
