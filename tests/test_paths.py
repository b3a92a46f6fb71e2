"""Recorded light paths: Snell's law and the mirror's at every corner, and where paths go on the whole."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest
from sensors import bump, paper_sensor

from scenes.sensor import Glass, Housing, Sensor

INDEX = {"guide": 1.4336, "glass": 1.515, "air": 1.0}


def rendered(sensor: Sensor, surface: Any = None) -> Any:
    """A renderer whose contact surface is in place; flat and unloaded for None."""
    from scenes import Renderer, build
    from scenes import surface as surfaces

    renderer = Renderer(sensor, "cpu")
    width = sensor.guide.width_mm
    shape = surfaces.flat(width, 0.0) if surface is None else surfaces.resample(surface, width)
    build.put_surface(renderer.scene, sensor, shape)
    return renderer


def small(coupling: Any = "air", **changes: Any) -> Sensor:
    base = paper_sensor(coupling, columns=96, rows=64, pixel_um=(67.0, 75.0))
    return dataclasses.replace(base, **changes)


def medium(points: np.ndarray) -> np.ndarray:
    """Which medium points (n, 3) lie in, by the sensor's plan."""
    inside = np.abs(points[:, :2]).max(axis=1) < 12.5
    guide = inside & (points[:, 2] > -10.0)
    glass = inside & (points[:, 2] < -10.0) & (points[:, 2] > -12.0)
    return np.where(guide, "guide", np.where(glass, "glass", "air"))


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_every_corner_obeys_snell_or_the_mirror(variant: str, coupling: str) -> None:
    """Tangential index is kept through each face, and what does not pass leaves at the angle it came at."""
    from scenes import paths

    renderer = rendered(small(coupling))
    found = paths.from_leds(renderer.scene, renderer.sensor, renderer.table, 256, 1)
    vertices = found.vertices_mm.astype(np.float64)
    checked = passed = 0
    for k, face in enumerate(found.faces[:-1]):
        on = (face >= 0) & np.isfinite(vertices[k + 2]).all(axis=1)
        before, at, after = (vertices[k + step][on] for step in range(3))
        names = np.array(found.names)[face[on]]
        incoming, outgoing = at - before, after - at
        lengths = [np.linalg.norm(way, axis=1) for way in (incoming, outgoing)]
        clear = np.minimum(*lengths) > 1.0  # paths go on a hair off each face: that turns shorter ones more
        incoming, outgoing = incoming / lengths[0][:, None], outgoing / lengths[1][:, None]
        media = [medium(0.5 * (a + b)) for a, b in ((before, at), (at, after))]
        for name in set(names[clear]):
            here = clear & (names == name)
            axis = 0 if name.endswith("x") else 1 if name.endswith("y") else 2
            n_in, n_out = (np.array([INDEX[m] for m in side[here]]) for side in media)
            tangential = [i for i in range(3) if i != axis]
            kept = n_in[:, None] * incoming[here][:, tangential]
            assert np.abs(kept - n_out[:, None] * outgoing[here][:, tangential]).max() < 2e-3, name
            through = incoming[here][:, axis] * outgoing[here][:, axis] > 0
            assert np.array_equal(through, n_in != n_out), name  # a face parts two media
            assert name != "contact" or not through.any()
            checked, passed = checked + here.sum(), passed + through.sum()
    assert checked > 1000 and passed > 100


def test_paths_stay_inside_and_end_once(variant: str) -> None:
    """No corner lies beyond guide, glass or the LEDs' gap, and every path that ended says how."""
    from scenes import paths

    renderer = rendered(small(), bump())
    found = paths.from_leds(renderer.scene, renderer.sensor, renderer.table, 512, 2)
    again = paths.from_leds(renderer.scene, renderer.sensor, renderer.table, 512, 2)
    assert np.array_equal(found.vertices_mm, again.vertices_mm, equal_nan=True)
    assert np.array_equal(found.fate, again.fate)
    alive = np.isfinite(found.vertices_mm[..., 0])
    assert (np.diff(alive.astype(int), axis=0) <= 0).all()  # once ended, no more corners
    ends = alive.sum(axis=0) - 1
    inner = np.arange(len(alive))[:, None] < ends  # the last corner of a path that leaves is drawn outside
    corners = found.vertices_mm[inner]
    assert np.abs(corners[:, :2]).max() < 12.5 + 0.5 + 1e-3
    assert corners[:, 2].max() < 0.5 + 1e-3 and corners[:, 2].min() > -12.0 - 1e-3
    leaving = np.isin(found.fate, [paths.FATES.index(name) for name in ("below", "aside", "missed")])
    last = found.faces[ends - 1, np.arange(len(ends))]
    assert np.array_equal(leaving, last < 0)


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_shares_are_those_of_the_weighted_walk(variant: str, coupling: Any) -> None:
    """Chance and weight are two ways to follow the same light: every sink within four standard errors."""
    import drjit as dr
    import mitsuba as mi

    from scenes import paths, recurrence, trace

    base = small(coupling)
    guide = dataclasses.replace(base.guide, absorption_per_mm=0.004)
    white = dataclasses.replace(base, guide=guide, housing=Housing(reflectance=0.5))
    renderer = rendered(white, bump())
    scene, sensor, each = renderer.scene, renderer.sensor, 2**13
    found = paths.from_leds(scene, sensor, renderer.table, each, 3, bounces=256)
    number = dr.arange(mi.UInt32, 4 * each) // each
    u = recurrence.evenly(dr.arange(mi.UInt32, 4 * each) % each, np.array([1, 2, 3, 4]))
    ray, one = trace.emit(sensor, number, u), dr.full(mi.Float, 1.0, 4 * each)
    leg = dr.full(mi.UInt32, trace.OTHER, 4 * each)
    walked = trace.walk(scene, sensor, renderer.table, renderer.basis, number, ray, one, leg, 5)
    count = 4 * each
    ended = np.bincount(found.fate, minlength=len(paths.FATES)) / count
    ended[paths.FATES.index("aside")] += ended[paths.FATES.index("missed")]
    for sink, name in enumerate(trace.SINKS):
        share = walked.sinks[:, sink].sum() / count
        assert abs(ended[sink] - share) <= 4 * np.sqrt(2 * share * (1 - share) / count) + 1e-12, name
    critical = np.sqrt(1.0 - 1.0 / 1.4336**2)
    share = walked.trapped.sum() / count
    assert abs((found.first_cosine < critical).mean() - share) < 4 * np.sqrt(2 * share / count)
    assert ended[paths.FATES.index("going")] == 0.0


def test_isotropic_source_in_an_unbounded_slab(variant: str) -> None:
    """sqrt(1 - 1/n²) of the light is trapped, whatever the plate below; walls 10 000 thicknesses away.

    0.03 % of the light runs so level that it comes to a wall first; three standard errors are 0.3 %.
    """
    import drjit as dr
    import mitsuba as mi

    from scenes import recurrence, trace

    base = small()
    led = dataclasses.replace(base.leds[0], diameter_mm=0.02, z_mm=-0.025)
    wide = dataclasses.replace(
        base,
        guide=dataclasses.replace(base.guide, width_mm=500.0, thickness_mm=0.05),
        glass=Glass(thickness_mm=0.05),
        leds=(led,),
    )
    renderer = rendered(wide)
    count = 220_000
    u = recurrence.evenly(dr.arange(mi.UInt32, count), np.array([11, 12, 13, 14]))
    direction = mi.warp.square_to_uniform_sphere(mi.Point2f(u[0], u[1]))
    ray = mi.Ray3f(mi.Point3f(0.0, 0.0, -0.025), direction)
    number, one = dr.zeros(mi.UInt32, count), dr.full(mi.Float, 1.0, count)
    leg = dr.full(mi.UInt32, trace.OTHER, count)
    found = trace.walk(renderer.scene, wide, renderer.table, renderer.basis, number, ray, one, leg, 1)
    share, expected = found.trapped[0] / count, np.sqrt(1.0 - 1.0 / 1.4336**2)
    error = np.sqrt(expected * (1.0 - expected) / count)
    assert error < 1e-3
    assert abs(share - expected) < 3 * error
