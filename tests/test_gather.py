"""What the camera gathers, where a pixel's ray could go astray or meets an LED."""

import dataclasses

import numpy as np
from sensors import bump, paper_sensor


def test_square_pixels_see_the_surface_everywhere(variant: str) -> None:
    """Their rays run exactly along the mesh's diagonals, where they could slip between two triangles."""
    from scenes import Renderer

    square = paper_sensor(columns=256, rows=256, pixel_um=(6.0, 6.0))
    seen = Renderer(square, "cpu").render(bump(), quality="preview", samples=2**12)
    assert seen.pressure.min() > 0.85
    assert seen.radiance.sum(axis=0).min() > 0.0


def test_led_in_sight_and_its_mirror_image_are_as_path_sees_them(variant: str) -> None:
    """An embedded LED far inside stands in the picture, and again mirrored in the contact surface."""
    from scenes import Renderer
    from scenes.reference import path_trace

    base = paper_sensor("embedded")
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
