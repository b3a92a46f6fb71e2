"""A guide in layers of different index: closed forms, rays thrown by hand, energy, other pictures."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from sensors import paper_sensor
from test_direct import BLOCKS, RAYS, blocks, fresnel, irradiance

from scenes.sensor import Guide, Lower, Sensor

STACKS = {
    "denser below": (1.40, (8.0, 1.50)),
    "denser above": (1.50, (8.0, 1.40)),
    "three": (1.42, (3.0, 1.50), (5.0, 1.40)),
}


def layered(base: Sensor, top: float, *lower: tuple[float, float], **changes: Any) -> Sensor:
    """The sensor with layers of these thicknesses and indices under a first one."""
    layers = tuple(Lower(*layer) for layer in lower)
    guide = dataclasses.replace(base.guide, refractive_index=top, lower=layers, **changes)
    return dataclasses.replace(base, guide=guide)


def alone(coupling: Any, stack: str, **changes: Any) -> Sensor:
    """One LED on the side +x of a layered guide."""
    base = paper_sensor(coupling)
    led = dataclasses.replace(base.leds[0], side="+x", **changes)
    return layered(dataclasses.replace(base, leds=(led,)), *STACKS[stack])


SMALL: dict[str, Any] = {"columns": 48, "rows": 32, "pixel_um": (134.4, 150.7)}
LEVEL = 0.05  # cosine


def in_the_lower_layer(base: Sensor) -> Sensor:
    """LEDs inside the lower of two layers, one of them where the camera looks straight into it."""
    near = dataclasses.replace(base.leds[0], gap_mm=3.0)
    return layered(dataclasses.replace(base, leds=(near, *base.leds[1:])), *STACKS["denser below"])


# Gathered light


def thrown(one: Sensor, seed: int = 5) -> np.ndarray:
    """Power, (BLOCKS, BLOCKS) W, of light that comes to the contact straight or by the glass's lower face.

    Rays from the disc, refracted vector by vector at every face; what other faces mirror is left out.
    """
    led, guide, glass = one.leds[0], one.guide, one.glass
    random = np.random.Generator(np.random.Philox(seed))
    half, floors = guide.width_mm / 2, np.array(guide.floors_mm)
    indices = np.array([index for _, index in guide.layers])
    radius, turn = led.diameter_mm / 2 * np.sqrt(random.random(RAYS)), 2 * np.pi * random.random(RAYS)
    x = np.full(RAYS, half + (led.gap_mm if led.coupling == "air" else -led.gap_mm))
    y, z = led.along_mm + radius * np.cos(turn), led.z_mm + radius * np.sin(turn)
    sine2, turn = random.random(RAYS), 2 * np.pi * random.random(RAYS)
    d = np.stack([-np.sqrt(1 - sine2), np.sqrt(sine2) * np.cos(turn), np.sqrt(sine2) * np.sin(turn)])
    weight = np.full(RAYS, led.flux_W / RAYS)
    if led.coupling == "air":
        step = led.gap_mm / -d[0]
        y, z, x = y + step * d[1], z + step * d[2], np.full(RAYS, half)
        weight *= (np.abs(y) < half) & (z > floors[-1]) & (z < 0)
    layer = np.minimum((z[:, None] <= floors).sum(axis=1), len(floors) - 1)
    n = indices[layer]
    if led.coupling == "air":
        for index in indices:
            weight = np.where(n == index, weight * (1 - fresnel(1.0, index, -d[0])), weight)
        d = np.stack([-np.sqrt(1 - (d[1] ** 2 + d[2] ** 2) / n**2), d[1] / n, d[2] / n])
    p, down = d * n, d[2] < 0  # Snell: horizontal parts of p stay through horizontal faces
    sine = np.hypot(p[0], p[1])

    def cosine(index: float) -> np.ndarray:
        return np.sqrt(np.maximum(1 - (sine / index) ** 2, 0.0))

    def cross(height: Any, index: float, here: np.ndarray) -> None:
        nonlocal x, y
        run = np.where(here, height / np.maximum(index * cosine(index), 1e-9), 0.0)
        x, y = x + run * p[0], y + run * p[1]

    def through(before: float, after: float, here: np.ndarray) -> None:
        nonlocal weight
        passed = np.where(sine < before, 1 - fresnel(before, after, cosine(before)), 0.0)
        weight = np.where(here, weight * passed, weight)

    for k, index in enumerate(indices):  # down
        roof = 0.0 if k == 0 else floors[k - 1]
        cross(np.where(layer == k, z, roof) - floors[k], index, down & (layer <= k))
        through(
            index, indices[k + 1] if k + 1 < len(indices) else glass.refractive_index, down & (layer <= k)
        )
    cross(2 * glass.thickness_mm, glass.refractive_index, down)
    mirrored = np.where(sine < 1, fresnel(glass.refractive_index, 1.0, cosine(glass.refractive_index)), 1.0)
    weight = np.where(down, weight * mirrored, weight)
    through(glass.refractive_index, indices[-1], down)
    for k in range(len(indices))[::-1]:  # up
        here, roof = down | (layer >= k), 0.0 if k == 0 else floors[k - 1]
        cross(roof - np.where(~down & (layer == k), z, floors[k]), indices[k], here)
        if k > 0:
            through(indices[k], indices[k - 1], here)
    edges = np.linspace(-half, half, BLOCKS + 1)
    return np.histogram2d(y, x, bins=(edges, edges), weights=weight)[0]


@pytest.mark.slow
@pytest.mark.parametrize("stack", STACKS)
@pytest.mark.parametrize(("coupling", "z_mm"), [("air", -4.7), ("embedded", -4.7), ("air", -1.9)])
def test_gathered_power_equals_that_of_thrown_rays(
    variant: str, stack: str, coupling: str, z_mm: float
) -> None:
    """LEDs in one layer, and across the face between two; no symmetry helps."""
    one = alone(coupling, stack, along_mm=3.0, z_mm=z_mm)
    ours, theirs = blocks(irradiance(one), one.guide.width_mm), thrown(one)
    sigma = np.sqrt(theirs * one.leds[0].flux_W / RAYS)
    strong = theirs > 1e-3 * one.leds[0].flux_W
    assert strong.sum() > 10
    assert np.all(np.abs(ours - theirs)[strong] < 5 * sigma[strong] + 5e-3 * theirs[strong])
    off, noise = ours.sum() / theirs.sum() - 1, np.sqrt(one.leds[0].flux_W / RAYS / theirs.sum())
    print(f"{coupling}, {stack}: {100 * off:+.2f} ± {100 * noise:.2f} %")
    assert abs(off) < 2e-3 + 2 * noise


def test_layers_that_hardly_differ_gather_what_one_does(variant: str) -> None:
    one = alone("air", "three", along_mm=3.0, z_mm=-4.0)
    plain = layered(one, 1.4336)
    near = layered(one, 1.4336, (3.0, 1.43362), (5.0, 1.4336))
    ours, theirs = (blocks(irradiance(sensor), 25.0) for sensor in (near, plain))
    assert np.abs(ours - theirs).max() < 1e-3 * theirs.max()
    assert ours.sum() == pytest.approx(theirs.sum(), rel=5e-4)


# The camera's view

VIEWED = {
    "near and wide": paper_sensor(distance_mm=12.0, field_of_view_mm=24.0, columns=64, rows=48),
    "far": paper_sensor(columns=64, rows=48, pixel_um=(100.8, 100.8)),
}


@pytest.mark.parametrize("name", VIEWED)
def test_pixel_rays_arrive_where_mitsubas_refracted_rays_do(variant: str, name: str) -> None:
    """Followed through Mitsuba's faces; (1 - T)/T of parallel clear faces is the sum of their R/(1 - R)."""
    import mitsuba as mi

    from scenes import build, view
    from scenes.bsdf import Table

    sensor = layered(VIEWED[name], *STACKS["three"])
    scene = build.load_scene(sensor, Table.pack(build.optics_of(sensor)))
    rows, columns = sensor.camera.shape
    row, column = (part.ravel() for part in np.mgrid[0:rows, 0:columns])
    film = mi.Point2f(mi.Float((column + 0.5) / columns), mi.Float((row + 0.5) / rows))
    ray, _ = scene.sensors()[0].sample_ray(mi.Float(0.0), mi.Float(0.0), film, mi.Point2f(0.0))
    shapes = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    lost, scale = np.zeros(row.size), np.ones(row.size)
    for face in ("glass_to_air", "guide_to_glass", "layer_2", "layer_1"):
        si = scene.ray_intersect(ray)
        assert np.all(np.asarray(si.shape == shapes[face])), face
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(0.9999999), mi.Point2f(0.5))
        passed = np.asarray(sample.pdf).astype(np.float64)
        lost += (1 - passed) / passed
        scale = scale * np.asarray(weight[0])
        ray = si.spawn_ray(si.to_world(sample.wo))
    si = scene.ray_intersect(ray)
    assert np.all(np.asarray(si.shape == shapes["contact"]))
    rays = view.pixel_rays(sensor)
    origin, direction = (part.reshape(-1, 3) for part in (rays.origin_mm, rays.direction))
    assert np.all(origin[:, 2] == -2.0)
    expected = origin - direction * (origin[:, 2:] / direction[:, 2:])
    # Mitsuba starts anew a hair above each face, which keeps its rays half a µm from where they would go
    assert np.abs(np.array(si.p).T - expected).max() < 4 * 0.5e-3
    np.testing.assert_allclose(rays.transmittance.ravel(), 1 / (1 + lost), atol=1e-4)
    np.testing.assert_allclose(scale, rays.radiance_scale, rtol=1e-5)


def test_field_of_view_and_lens_follow_snell_through_the_stack() -> None:
    from scenes import lens, view

    sensor = layered(paper_sensor(), *STACKS["three"])
    camera = sensor.camera
    sine = view.air_directions(sensor, np.array(camera.columns), np.array(camera.rows / 2))[0]
    slabs = [(40.0, 1.0), (2.0, 1.515), (5.0, 1.40), (3.0, 1.50), (2.0, 1.42)]
    reach = sum(thickness * np.tan(np.arcsin(sine / index)) for thickness, index in slabs)
    assert reach == pytest.approx(camera.field_of_view_mm / 2, abs=1e-9)
    assert lens.lens_of(sensor).object_mm == pytest.approx(sum(t / n for t, n in slabs), rel=1e-12)
    focus = dataclasses.replace(sensor, camera=dataclasses.replace(camera, focus_mm=-4.0))
    found = lens.lens_of(focus)
    sharp = 1 / (1 / found.focal_mm - 1 / found.image_mm)
    assert sharp == pytest.approx(sum(t / n for t, n in slabs) - 2.0 / 1.42 - 2.0 / 1.50, rel=1e-9)


def test_reflectance_at_normal_incidence_is_that_of_a_pile_of_plates() -> None:
    from scenes import view

    sensor = layered(paper_sensor(), *STACKS["three"])
    steps = np.array([1.42, 1.50, 1.40, 1.515, 1.0])
    each = ((steps[1:] - steps[:-1]) / (steps[1:] + steps[:-1])) ** 2
    lost = np.sum(each / (1 - each))
    assert float(view.faces_reflectance(sensor, np.array(1.0))) == pytest.approx(lost / (1 + lost), rel=1e-9)


# Light followed


@pytest.mark.parametrize(("top", "below"), [(1.40, 1.50), (1.50, 1.40), (1.30, 1.45)])
def test_trapped_share_of_an_isotropic_source_under_another_layer(
    variant: str, top: float, below: float
) -> None:
    """n sin(theta) > 1 is trapped, > the first layer's index never comes to the contact.

    Without light within 3° of level, which faces mirror so well that it comes to the walls.
    """
    import drjit as dr
    import mitsuba as mi

    from scenes import Renderer, build, recurrence, surface, trace

    base = paper_sensor(columns=16, rows=12, pixel_um=(403.2, 403.2))
    led = dataclasses.replace(base.leds[0], diameter_mm=0.02, z_mm=-0.025)
    wide = dataclasses.replace(
        base,
        guide=Guide(500.0, 0.1, top, lower=(Lower(0.05, below),)),
        leds=(led,),
        glass=dataclasses.replace(base.glass, thickness_mm=0.05),
    )
    renderer = Renderer(wide, "cpu")
    build.put_surface(renderer.scene, wide, surface.flat(500.0, 0.0))
    count = 220_000
    u = recurrence.evenly(dr.arange(mi.UInt32, count), np.array([11, 12, 13, 14]))
    height = dr.copysign(LEVEL + (1.0 - LEVEL) * dr.abs(2.0 * u[0] - 1.0), 2.0 * u[0] - 1.0)
    sine, (s, c) = dr.sqrt(1.0 - dr.square(height)), dr.sincos(dr.two_pi * u[1])
    direction = mi.Vector3f(sine * c, sine * s, height)
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -0.075), direction)
    number, one = dr.zeros(mi.UInt32, count), dr.full(mi.Float, 1.0, count)
    leg = dr.full(mi.UInt32, trace.OTHER, count)
    found = trace.walk(renderer.scene, wide, renderer.table, renderer.basis, number, ray, one, leg, 1)
    never = max(np.sqrt(max(1.0 - (top / below) ** 2, 0.0)), LEVEL)
    share, expected = found.trapped[0] / count, (np.sqrt(1.0 - 1.0 / below**2) - never) / (1.0 - LEVEL)
    print(f"{top} on {below}: {share:.4f}, closed form {expected:.4f}")
    assert abs(share - expected) < 3 * np.sqrt(expected * (1.0 - expected) / count)


@pytest.mark.slow
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("coupling", "stack"), [("air", "denser above"), ("embedded", "three")])
def test_energy_closes_and_standard_is_the_reference(variant: str, coupling: Any, stack: str) -> None:
    """Emitted = sum of sinks to 0.2 %; all light of both pictures within 1 % and three standard errors."""
    from sensors import bump

    from scenes import Renderer

    sensor = layered(paper_sensor(coupling, **SMALL), *STACKS[stack], absorption_per_mm=0.002)
    renderer = Renderer(sensor, "cpu")
    found = renderer.render(bump(), quality="preview", samples=2**19, seed=1)
    assert found.sinks is not None
    emitted = sum(led.flux_W for led in sensor.leds)
    assert found.sinks.sum() == pytest.approx(emitted, rel=2e-3)
    runs = [renderer.render(bump(), quality="reference", samples=2**15, seed=k) for k in range(4)]
    light = np.array([run.radiance.sum(dtype=np.float64) for run in runs])
    off = found.radiance.sum(dtype=np.float64) / light.mean() - 1
    error = light.std(ddof=1) / np.sqrt(light.size) / light.mean()
    print(f"{coupling}, {stack}: {100 * off:+.2f} ± {100 * error:.2f} %")
    assert abs(off) < 0.01 + 3 * error


def test_surface_does_not_reach_through_the_first_layer(variant: str) -> None:
    from scenes import Renderer, surface
    from scenes.sensor import NotModelled

    renderer = Renderer(layered(paper_sensor(**SMALL), 1.40, (9.9, 1.50)), "cpu")
    flat = surface.flat(25.0, 1.0)
    deep = dataclasses.replace(flat, displacement_mm=flat.displacement_mm - [0.0, 0.0, 0.2])
    with pytest.raises(NotModelled, match=r"0.1 mm above the first change of index; allowed more than 0.21"):
        renderer.render(deep, quality="preview", samples=64)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_standard_picture_agrees_with_path(variant: str) -> None:
    """Mitsuba's stock tracer on the same scene: 4 x 8 pixels of the blob."""
    from sensors import bump, dense

    from scenes import Renderer
    from scenes.reference import path_trace

    sensor = in_the_lower_layer(paper_sensor("embedded", **SMALL))
    renderer = Renderer(dense(sensor), "cpu")
    runs = [renderer.render(bump(), quality="standard", seed=k).radiance.sum(axis=0) for k in (1, 2)]
    top, end, left, right = crop = (14, 18, 20, 28)
    mean, error = path_trace(renderer.scene, sensor, 2**20, 7, crop=crop)
    own = np.sqrt(np.sum(error**2)) / error.size / mean.mean()
    off = np.mean(runs, axis=0, dtype=np.float64)[top:end, left:right].mean() / mean.mean() - 1
    print(f"path {mean.mean():.5g} ± {100 * own:.2f} %, standard {100 * off:+.2f} %")
    assert own < 5e-3
    assert abs(off) < 5e-3 + 2 * own


@pytest.mark.slow
def test_led_in_sight_is_as_bright_and_large_as_by_path(variant: str) -> None:
    """A pixel is one ray, so that the outline is jagged: brightness is compared inside it."""
    from sensors import bump, dense

    from scenes import Renderer
    from scenes.reference import path_trace

    sensor = in_the_lower_layer(paper_sensor("embedded"))
    dark = tuple(dataclasses.replace(led, flux_W=0.0) for led in sensor.leds[1:])
    sensor = dataclasses.replace(sensor, leds=(sensor.leds[0], *dark))
    renderer = Renderer(dense(sensor), "cpu")
    ours = renderer.render(bump(), quality="preview", samples=2**12).radiance[0]
    top, end, left, right = crop = (222, 270, 690, 740)
    ours = ours[top:end, left:right]
    mean, _ = path_trace(renderer.scene, sensor, 1024, 7, crop=crop)
    lit, spot = mean > 0.5 * mean.max(), ours > 0.5 * ours.max()
    assert spot.sum() > 200
    assert spot.sum() == pytest.approx(lit.sum(), rel=0.05)
    assert np.median(ours[spot]) == pytest.approx(np.median(mean[lit]), rel=5e-3)
