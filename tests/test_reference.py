"""The reference picture: honest mean, honest error, same bytes however many threads share the work."""

from __future__ import annotations

from collections.abc import Iterator
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sensors import bump, paper_sensor

from scenes.sensor import Sensor

SMALL = paper_sensor(columns=48, rows=32)


@pytest.fixture(scope="module")
def mi(variant: str) -> ModuleType:
    import mitsuba

    return mitsuba


@pytest.fixture(scope="module")
def scene(mi: ModuleType) -> Any:
    """The paper's sensor under a bump, all LEDs on."""
    from scenes import build, surface
    from scenes.bsdf import Table

    loaded = build.load_scene(SMALL, Table.pack(build.optics_of(SMALL)))
    build.put_surface(loaded, SMALL, surface.resample(bump(), SMALL.guide.width_mm))
    return loaded


@pytest.fixture
def threads(mi: ModuleType) -> Iterator[Any]:
    import drjit as dr

    before = dr.thread_count()
    yield dr.set_thread_count
    dr.set_thread_count(before)


def open_scene(mi: ModuleType, **shapes: Any) -> Any:
    """The camera alone, looking at what is given."""
    from scenes import pinhole

    return mi.load_dict({"type": "scene", "camera": pinhole.describe(SMALL), **shapes})


def facing_plane(mi: ModuleType, reflectance: float) -> dict[str, Any]:
    """A matt plane above, far wider than the picture, that faces down."""
    turn = mi.ScalarTransform4f().rotate([1, 0, 0], 180).scale([5e3, 5e3, 1])
    grey = {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    return {"type": "rectangle", "to_world": turn, "bsdf": grey}


def constant(value: float) -> dict[str, Any]:
    return {"type": "constant", "radiance": {"type": "uniform", "value": value}}


# Closed cases


def test_uniform_surroundings_look_uniform(mi: ModuleType) -> None:
    """Radiance comes out in W/(m² sr) from W/(mm² sr), without error."""
    from scenes.reference import path_trace

    mean, error = path_trace(open_scene(mi, sky=constant(2.5e-6)), SMALL, 16, 0)
    assert mean.shape == error.shape == (32, 48)
    np.testing.assert_allclose(mean, 2.5, rtol=1e-6)
    np.testing.assert_allclose(error, 0.0, atol=1e-6)


def test_matt_plane_under_a_wide_lamp_has_its_known_radiance_and_an_honest_error(
    mi: ModuleType,
) -> None:
    """A lamp fills a known cone: the mean is known, and deviations are one standard error in size."""
    from scenes.reference import path_trace

    lamp = {  # a disc of radiance 1 around the axis, 45 degrees wide from the plane
        "type": "disk",
        "to_world": mi.ScalarTransform4f().translate([0, 0, -5e3]).scale(5e3),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1e-6}},
        "bsdf": {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.0}},
    }
    scene = open_scene(mi, plane=facing_plane(mi, 0.6), lamp=lamp)
    mean, error = path_trace(scene, SMALL, 512, 1)
    expected = 0.6 * np.sin(np.pi / 4) ** 2  # irradiance pi L sin², radiance reflectance x E / pi
    score = (mean - expected) / error
    assert abs(score.mean()) < 0.1  # 1536 pixels: 4 standard errors
    assert 0.9 < score.std() < 1.1
    assert mean.mean() == pytest.approx(expected, rel=2e-3)


def test_error_is_the_spread_between_seeds_and_falls_with_the_root_of_samples(
    mi: ModuleType, scene: Any
) -> None:
    """In the real scene, pixel by pixel: 20 seeds scatter as the error of each says."""
    from scenes.reference import path_trace

    crop = (12, 20, 20, 28)
    runs = [path_trace(scene, SMALL, 1024, seed, crop=crop) for seed in range(20)]
    means, errors = (np.array(part) for part in zip(*runs, strict=True))
    claimed = np.sqrt(np.mean(errors**2))
    scatter = np.sqrt(np.mean(means.var(axis=0, ddof=1)))
    assert scatter == pytest.approx(claimed, rel=0.25)
    _, finer = path_trace(scene, SMALL, 16 * 1024, 99, crop=crop)
    assert np.sqrt(np.mean(finer**2)) == pytest.approx(claimed / 4, rel=0.25)


def test_light_of_leds_adds_up(mi: ModuleType, scene: Any) -> None:
    """Radiance is linear in the LEDs: one layer per LED, summed, is the picture of all."""
    from scenes import build
    from scenes.reference import path_trace

    crop = (10, 22, 14, 34)
    try:
        layers = []
        for led in range(4):
            build.light_only(scene, SMALL, led)
            layers.append(path_trace(scene, SMALL, 2048, 10 + led, crop=crop))
        build.light_only(scene, SMALL, -1)
        dark, _ = path_trace(scene, SMALL, 16, 0, crop=crop)
    finally:
        build.light_only(scene, SMALL, None)
    together, error = path_trace(scene, SMALL, 2048, 20, crop=crop)
    assert np.all(dark == 0.0)
    total = sum(float(mean.mean()) for mean, _ in layers)
    spread = np.sqrt(sum(float(np.sum(e**2)) for _, e in (*layers, (together, error)))) / together.size
    assert abs(total - together.mean()) < 4 * spread
    assert spread < 0.05 * together.mean()


# Crop and orientation


def test_crop_is_a_part_of_the_picture(mi: ModuleType) -> None:
    """A lamp over the quadrant x > 0, y > 0 fills the picture's upper right, in a crop as in the whole."""
    from scenes.reference import path_trace

    quadrant = {
        "type": "rectangle",  # faces down
        "to_world": mi.ScalarTransform4f()
        .translate([500, 500, 0])
        .rotate([1, 0, 0], 180)
        .scale([500, 500, 1]),
        "emitter": {"type": "area", "radiance": {"type": "uniform", "value": 1e-6}},
    }
    scene = open_scene(mi, lamp=quadrant)
    whole, _ = path_trace(scene, SMALL, 4, 0)
    expected = np.zeros((32, 48))
    expected[:16, 24:] = 1.0
    np.testing.assert_allclose(whole, expected, atol=1e-6)
    part, _ = path_trace(scene, SMALL, 4, 0, crop=(10, 20, 20, 41))
    np.testing.assert_allclose(part, expected[10:20, 20:41], atol=1e-6)


def test_progress_ends_at_one(mi: ModuleType) -> None:
    from scenes import reference

    told: list[float] = []
    samples = 3 * reference._WAVEFRONT // (32 * 48)
    reference.path_trace(open_scene(mi, sky=constant(1e-6)), SMALL, samples, 0, progress=told.append)
    assert told == sorted(told) and told[-1] == 1.0 and len(told) >= 3


# Same bytes


def test_path_gives_the_same_bytes_on_one_thread_and_on_two(mi: ModuleType, scene: Any, threads: Any) -> None:
    from scenes.reference import path_trace

    pictures = []
    for count in (1, 2, 2):
        threads(count)
        pictures.append(path_trace(scene, SMALL, 3000, 5, crop=(12, 20, 20, 28)))
    for mean, error in pictures[1:]:
        assert mean.tobytes() == pictures[0][0].tobytes()
        assert error.tobytes() == pictures[0][1].tobytes()
    other, _ = path_trace(scene, SMALL, 3000, 6, crop=(12, 20, 20, 28))
    assert np.mean(other != pictures[0][0]) > 0.9


def test_traced_light_is_the_same_bytes_on_one_thread_and_on_two(
    mi: ModuleType, scene: Any, threads: Any
) -> None:
    from scenes import Renderer, direct, surface, transport

    light = Renderer(SMALL, "cpu")
    shape = surface.resample(bump(), SMALL.guide.width_mm)

    def upward(seed: int) -> np.ndarray:
        straight = direct.direct(SMALL, light.basis, shape)
        ground = transport.survey(scene, SMALL)
        under = transport.Under.at(light.basis, light.behind, ground)
        parts = (scene, SMALL, light.table, under, straight.astype(np.float32))
        return transport.transport(*parts, 2**15, seed).upward

    found = []
    for count in (1, 2, 2):
        threads(count)
        found.append(upward(5))
    assert found[0].tobytes() == found[1].tobytes() == found[2].tobytes()
    assert np.mean(upward(6) != found[0]) > 0.9


@pytest.mark.parametrize("quality", ["standard", "reference"])
def test_pictures_are_the_same_bytes_on_one_thread_and_on_two(
    mi: ModuleType, threads: Any, quality: str
) -> None:
    """The whole renderer, resampled surface to radiance."""
    from scenes import Renderer

    renderer, samples = Renderer(SMALL, "cpu"), {"standard": 2**15, "reference": 8}[quality]

    def picture(count: int, seed: int) -> Any:
        threads(count)
        return renderer.render(bump(), quality=quality, seed=seed, samples=samples)  # type: ignore[arg-type]

    one, two, other = picture(1, 3), picture(2, 3), picture(2, 4)
    for name in ("radiance", "position_mm", "pressure", "displacement_z"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes(), name
    assert one.noise_percent == two.noise_percent
    assert np.any(other.radiance != one.radiance)
    assert one.radiance.shape == (4, 32, 48) and one.radiance.dtype == np.float32


def test_fresh_renderer_repeats_a_used_one(mi: ModuleType) -> None:
    """What was rendered before leaves no trace: the scene is moved in place, and wholly so."""
    from scenes import Renderer

    fresh, used = Renderer(SMALL, "cpu"), Renderer(SMALL, "cpu")
    other = bump()
    other.point_data["displacement"] *= 3.0
    used.render(other, seed=1, samples=2**12)
    used.render(bump(), quality="reference", samples=1)
    one, two = (renderer.render(bump(), seed=3, samples=2**14) for renderer in (fresh, used))
    assert one.radiance.tobytes() == two.radiance.tobytes()


def test_unknown_quality_is_refused(mi: ModuleType) -> None:
    from scenes import Renderer

    with pytest.raises(
        ValueError, match=r"quality: received 'best'; allowed: 'preview', 'standard', 'reference'"
    ):
        Renderer(_tiny(), "cpu").render(bump(), quality="best")  # type: ignore[arg-type]


def _tiny() -> Sensor:
    return paper_sensor(columns=4, rows=3)
