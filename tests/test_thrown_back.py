"""Light that a rough face throws back into the tissue, and where it comes out: kernels against the walk.

Most of it is grazing light, which comes from less deep and goes farther when it is mirrored: what went in
aslant is seen less far ahead than with a Lambertian in its place.
"""

from __future__ import annotations

import dataclasses
from functools import lru_cache
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from sensors import paper_sensor

from scenes.aslant import _AZIMUTHS, _waves, by_exit
from scenes.slab import Slab, cosines

LANES, PASSES = 2**19, 4
ALL, STEEP = 0, 1
REACH_MM, SPOT_MM = 8.0, 1.5


@pytest.mark.parametrize("albedo", [0.3, 0.98])
def test_what_leaves_along_the_normal_tells_what_leaves_anywhere(albedo: float) -> None:
    """Where every exit counts alike, all light that leaves."""
    body = Slab(albedo)
    mu, weight = cosines()
    beams = body.aslant(_waves(), mu, 2.0 * np.pi * np.arange(_AZIMUTHS) / _AZIMUTHS)
    even = (2.0 * mu * weight) @ beams[ALL].mean(axis=2).T
    found, expected = by_exit(beams[STEEP], np.ones(mu.size)), beams[ALL] / even[:, None, None]
    coarse = _waves() < 2.0  # 24 azimuths are too few for finer waves in grazing light
    steep = mu > 0.1
    assert np.abs(found - expected)[coarse][:, steep].max() < 1e-6


@lru_cache
def renderer_of(gap_index: float) -> Any:
    from scenes import Renderer

    sensor = paper_sensor("embedded")
    skin = dataclasses.replace(sensor.skin, gap_index=gap_index)
    return Renderer(dataclasses.replace(sensor, skin=skin), "cpu")


def walked(renderer: Any, fraction: float, angle: float, seed: int) -> np.ndarray:
    """Light seen straight from below, its mean place along x, mm, and the mean square of x and y, mm², where
    a spot of light goes in at an angle in the guide, towards +x."""
    import drjit as dr
    import mitsuba as mi

    from scenes import walk, wander

    sensor, table, width = renderer.sensor, renderer.table, renderer.sensor.guide.width_mm

    class Below:
        spread_per_mm = 0.0

        def __init__(self) -> None:
            self.sums = dr.zeros(mi.Int64, 4)

        def towards(self, point: Any) -> Any:
            return mi.Vector3f(0.0 * point.x, 0.0, -1.0)

        def add(self, number: Any, point: Any, amounts: Any, active: Any) -> None:
            near = active & (dr.maximum(dr.abs(point.x), dr.abs(point.y)) < REACH_MM)
            for k, factor in enumerate((1.0, point.x, dr.square(point.x), dr.square(point.y))):
                counted = mi.Int64(dr.round(amounts[0] * factor * 2.0**26))
                dr.scatter_add(self.sums, counted, mi.UInt32(k), near)

    spots = wander.Spots.of(sensor, np.full((200, 200), fraction), None)
    relief, below = wander.Relief.on(np.zeros((200, 200)), width), Below()
    random = walk.generator(LANES, seed)
    place = SPOT_MM * mi.warp.square_to_std_normal(mi.Point2f(random.next_float32(), random.next_float32()))
    way = mi.Vector3f(float(np.sin(angle)), 0.0, float(np.cos(angle)))
    met = SimpleNamespace(p=mi.Point3f(place.x, place.y, 0.0), d=way)
    every, one = dr.full(mi.Bool, True, LANES), dr.full(mi.Float, 1.0, LANES)
    parts = (sensor, table, spots, relief, [below], met, mi.UInt32(0), one, every, random)
    _, left, _, _ = wander.wander(*parts)
    dr.eval(left, below.sums)
    light, *moments = below.sums.numpy() / 2.0**26
    straight = table.transmittance(mi.Float(fraction), mi.Float(1.0)).numpy()[0]
    return np.array([np.pi * light / straight / LANES, *(one / light for one in moments)])


def foretold(renderer: Any, fraction: float, angle: float) -> np.ndarray:
    """The same of standard light."""
    import mitsuba as mi

    from scenes.transport import GRID, Ground, Under

    width = renderer.sensor.guide.width_mm
    level = np.zeros((GRID, GRID))
    meets = np.ones((GRID, GRID), np.float32)
    under = Under.at(renderer.basis, renderer.behind, Ground(level + fraction, meets, level))
    x = (np.arange(GRID) + 0.5) / GRID * width - width / 2
    spot = np.exp(-0.5 * (x**2 + x[:, None] ** 2) / SPOT_MM**2) / (2.0 * np.pi * SPOT_MM**2)
    cosine, ahead = mi.Float(float(np.cos(angle))), mi.Float(1.0)
    counts = renderer.basis.weights().at(cosine, ahead, mi.Float(0.0), mi.Bool(True))
    passed = renderer.table.transmittance(mi.Float(fraction), cosine).numpy()[0]
    layers = np.array([one.numpy()[0] for one in counts]) / passed
    landed = (layers[:, None, None] * spot)[None].astype(np.float32)
    seen = under.seen(landed).maps[0, 0, under.inside, under.inside]
    near = np.abs(x) < REACH_MM
    seen, x = seen[np.ix_(near, near)].astype(np.float64), x[near]
    light = seen.sum()
    means = ((seen * values).sum() / light for values in (x, x**2, (x**2)[:, None]))
    return np.array([light * (width / GRID) ** 2, *means])


@pytest.mark.parametrize(
    ("gap_index", "fraction", "degrees"),
    [
        (1.0, 0.15, 45.0),
        *(
            pytest.param(1.0, fraction, degrees, marks=pytest.mark.slow)
            for fraction in (0.15, 0.5, 1.0)
            for degrees in (25.0, 45.0, 70.0)
            if (fraction, degrees) != (0.15, 45.0)
        ),
        *(pytest.param(1.33, 0.15, degrees, marks=pytest.mark.slow) for degrees in (25.0, 45.0, 70.0)),
    ],
)
def test_light_comes_out_where_the_walk_has_it(
    variant: str, gap_index: float, fraction: float, degrees: float
) -> None:
    """How much of it, within 0.2 %, how far ahead, 0.006 mm, and how widely spread."""
    renderer, angle = renderer_of(gap_index), np.radians(degrees)
    runs = np.array([walked(renderer, fraction, angle, 100 + k) for k in range(PASSES)])
    found, error = runs.mean(axis=0), runs.std(axis=0, ddof=1) / np.sqrt(PASSES)
    ours = foretold(renderer, fraction, angle)
    print(
        gap_index, fraction, degrees, np.round(found, 4), "±", np.round(error, 4), np.round(ours - found, 4)
    )
    assert np.all(np.abs(ours - found) < [0.002 * found[0], 0.006, 0.03, 0.03] + 3.0 * error)
