"""What the camera gathers, where a pixel's ray could go astray or meets an LED."""

import dataclasses
from typing import Literal

import numpy as np
import pytest
from sensors import bump, dense, paper_sensor, pressed


def test_square_pixels_see_the_surface_everywhere(variant: str) -> None:
    """Their rays run exactly along the mesh's diagonals, where they could slip between two triangles."""
    from scenes import Renderer

    square = paper_sensor(columns=256, rows=256, pixel_um=(6.0, 6.0))
    seen = Renderer(square, "cpu").render(bump(), quality="preview", samples=2**12)
    assert seen.pressure.min() > 0.85
    assert seen.radiance.sum(axis=0).min() > 0.0


@pytest.mark.parametrize(("along", "z"), [(11.75, -1.0), (0.0, -0.9), (-11.0, -9.0)])
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_no_light_is_negative(
    variant: str, coupling: Literal["air", "embedded"], along: float, z: float
) -> None:
    """One LED leaves most of the picture dark, where the smoothing kernel's negative sides could show."""
    from scenes import Renderer

    base = paper_sensor(coupling, columns=96, rows=64, pixel_um=(67.0, 75.0))
    led = dataclasses.replace(base.leds[0], along_mm=along, z_mm=z)
    one = Renderer(dataclasses.replace(base, leds=(led,)), "cpu")
    radiance = one.render(bump(), quality="preview", samples=2**14).radiance
    assert radiance.min() >= 0.0
    assert radiance.max() > 0.0


def test_led_above_the_pressed_rim_is_refused(variant: str) -> None:
    from scenes import Renderer
    from scenes.sensor import NotModelled

    base = paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0))
    high = dataclasses.replace(base.leds[0], z_mm=-0.76)
    low_rim = pressed(lambda x, y: 0.9, lambda x, y: (0.0, 0.0, -0.3 * (abs(x) > 12.0)))
    with pytest.raises(NotModelled, match=r"leds\.0\.z_mm: received -0.76; allowed at most"):
        Renderer(dataclasses.replace(base, leds=(high,)), "cpu").render(low_rim, samples=2**12)


def test_led_in_sight_and_its_mirror_image_are_as_path_sees_them(variant: str) -> None:
    """An embedded LED far inside stands in the picture, and again mirrored in the contact surface."""
    from scenes import Renderer
    from scenes.reference import path_trace

    base = dense(paper_sensor("embedded"))
    inside = tuple(dataclasses.replace(led, gap_mm=4.0) for led in base.leds)
    renderer = Renderer(dataclasses.replace(base, leds=inside), "cpu")
    ours = renderer.render(bump(), quality="preview").radiance.sum(axis=0)
    straight, mirrored = (205, 287, 90, 120), (205, 287, 129, 150)
    for top, end_row, left, end_column in (straight, mirrored):
        mean, _ = path_trace(renderer.scene, renderer.sensor, 256, 3, crop=(top, end_row, left, end_column))
        here = ours[top:end_row, left:end_column]
        beside = np.median(mean)
        assert mean.max() > 3 * beside
        # one ray a pixel against many: the rim of the LED differs from pixel to pixel, its light hardly
        np.testing.assert_allclose((here - beside).sum(), (mean - beside).sum(), rtol=0.05)


def test_survey_meets_the_surface_in_every_cell(variant: str) -> None:
    """Its rays, too, run along the mesh's diagonals: a cell that slipped through would be a hole."""
    from scenes import Renderer, build, surface, transport

    renderer = Renderer(paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0)), "cpu")
    for factor in (1.0, 1.001, 0.7):
        deformed = bump()
        deformed.point_data["displacement"] = factor * np.asarray(deformed.point_data["displacement"])
        build.put_surface(renderer.scene, renderer.sensor, surface.resample(deformed, 25.0))
        ground = transport.survey(renderer.scene, renderer.sensor)
        assert ground.meets.all()
        assert ground.fraction.min() > 0.0
