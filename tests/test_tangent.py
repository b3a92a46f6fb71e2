"""Pictures beside one press against pictures of their own: gathered light is linear in a small change."""

from dataclasses import replace

import numpy as np
from sensors import paper_sensor, pressed


def bump(height: float, x0: float = 0.0):
    def pressure(x, y):
        return 0.9 + height * np.exp(-((x - x0) ** 2 + y**2) / 20.0)

    return pressed(pressure, lambda x, y: (0.0, 0.0, -0.1 * pressure(x, y)))


def test_a_picture_beside_is_the_picture(variant):
    from scenes import surface, tangent
    from scenes.render import Renderer

    camera = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
    sensor = paper_sensor(**camera)
    renderer = Renderer(replace(sensor, leds=sensor.leds[:2]), device="cpu")
    middle, there = (surface.resample(bump(h), 25.0) for h in (0.4, 0.5))
    straight = tangent.gathered(renderer, middle)
    traced = tangent.traced(renderer, middle, straight, 5, "preview", 2**12)
    slope = tangent.picture(renderer, there, straight, traced) - tangent.picture(
        renderer, middle, straight, traced
    )
    each = [
        renderer.render(bump(h), quality="preview", seed=5, traced=(traced,)).radiance for h in (0.4, 0.5)
    ]
    exact = each[1].astype(float) - each[0]
    assert np.linalg.norm(slope - exact) < 0.01 * np.linalg.norm(exact)


def test_rays_in_a_line_of_the_mesh_tell_of_no_press_that_is_the_same(variant):
    """The middle row's rays lie in one, and slip between triangles on some presses and not on others."""
    from scenes import surface, tangent
    from scenes.render import Renderer

    sensor = paper_sensor(columns=96, rows=61, pixel_um=(67.2, 78.4))
    renderer = Renderer(replace(sensor, leds=sensor.leds[:1]), device="cpu")
    middle = surface.resample(bump(0.4), 25.0)
    straight = tangent.gathered(renderer, middle)
    traced = tangent.traced(renderer, middle, straight, 5, "preview", 2**12)
    random = np.random.default_rng(0)
    seen = []
    for _ in range(2):  # of rounding
        noise = 1e-9 * random.standard_normal(middle.displacement_mm.shape)
        there = replace(middle, displacement_mm=middle.displacement_mm + noise)
        seen.append(tangent.picture(renderer, there, straight, traced)[0].astype(float))
    off = np.abs(seen[1] / seen[0] - 1.0).max(axis=1)
    print("a row off by up to", off.max(), "the usual one by", np.median(off))
    assert off.max() < 5.0 * np.median(off)
