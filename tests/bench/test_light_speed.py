"""How much sooner traced light gives a picture than stock `path` at equal noise: `make bench` prints it."""

import time

import numpy as np
import pytest

GOAL = 15_000.0
"""Least ratio of times at equal noise: below it, tracing from the LEDs would not be worth its code."""

NOISE_PERCENT = 1.0
CROP = (230, 262, 368, 400)
PATH_SAMPLES = 2048


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_standard_against_path(variant: str, coupling: str) -> None:
    import dataclasses

    import pyvista as pv

    from scenes import Renderer, reference
    from twin import load_design

    sensor = load_design("tsis").sensor()
    leds = tuple(dataclasses.replace(led, coupling=coupling) for led in sensor.leds)
    renderer = Renderer(dataclasses.replace(sensor, leds=leds), device="cpu")
    pressed = pv.Plane(i_size=25.0, j_size=25.0, i_resolution=20, j_resolution=20)
    radius2 = np.sum(np.asarray(pressed.points) ** 2, axis=1)
    pressed.point_data["pressure"] = 0.6 + 0.4 * np.exp(-radius2 / 30.0)
    pressed.point_data["displacement"] = np.zeros((pressed.n_points, 3))
    renderer.render(pressed, samples=2**10)  # compile

    standard = renderer.render(pressed, seed=1)
    ours = standard.seconds * (standard.noise_percent / NOISE_PERCENT) ** 2

    start = time.perf_counter()
    mean, error = reference.path_trace(renderer.scene, renderer.sensor, PATH_SAMPLES, 1, crop=CROP)
    seconds = time.perf_counter() - start
    noise = 100.0 * np.sqrt(np.mean(error**2)) / np.mean(mean)
    share = mean.size / standard.pressure.size
    theirs = seconds / share * (noise / NOISE_PERCENT) ** 2

    print(
        f"\nfull picture at {NOISE_PERCENT:g} % noise, LEDs {coupling}: ours {ours:.2f} s (all LEDs apart), "
        f"path {theirs:.0f} s (all LEDs together, from a crop), ratio {theirs / ours:.0f} (goal {GOAL:.0f})"
    )
    assert theirs / ours >= GOAL
