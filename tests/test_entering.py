"""Light that enters the tissue, place by place: gathered and traced, against every ray followed.

Sharper than pictures, which tissue blurs and whose walks in it are most of their noise. Of tissue so dark
that light enters once.
"""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from sensors import bump, domed, paper_sensor

from scenes.skin import Sheet, Tissue

CELLS = 200
DARK = Tissue(scattering_per_mm=0.01, absorption_per_mm=10.0)
EDGES = [0.0, 4.0, 8.0, 9.0, 10.0, 11.0, 12.0, 12.375, 12.5]
"""Square bands, mm from the middle; the last is the outermost of the mesh's cells."""


@pytest.mark.parametrize(
    ("coupling", "curved", "passes"),
    [
        ("air", True, 4),
        pytest.param("air", False, 40, marks=pytest.mark.slow),
        pytest.param("air", True, 40, marks=pytest.mark.slow),
        pytest.param("embedded", True, 40, marks=pytest.mark.slow),
    ],
)
def test_what_enters_is_the_references(
    variant: str, monkeypatch: pytest.MonkeyPatch, coupling: Any, curved: bool, passes: int
) -> None:
    """Within 0.3 % of it in each band, and the noise."""
    from scenes import Renderer, build, surface

    sensor = dataclasses.replace(paper_sensor(coupling), tissue=DARK)
    renderer = Renderer(sensor, "cpu")
    shape = domed() if curved else surface.resample(bump(), sensor.guide.width_mm)
    build.put_surface(renderer.scene, sensor, shape)
    ours, theirs = _gathered(renderer, shape, max(passes // 4, 3)), _followed(renderer, passes, monkeypatch)
    line = np.abs((np.arange(CELLS) + 0.5) / CELLS - 0.5) * sensor.guide.width_mm
    place = np.maximum(line, line[:, None])
    for low, high in pairwise(EDGES):
        band = (place >= low) & (place < high)
        (mean, error), (expected, noise) = (_mean(maps[:, band].mean(axis=1)) for maps in (ours, theirs))
        off, sure = 100 * (mean / expected - 1), 100 * np.hypot(error, noise) / expected
        print(f"{coupling}, {'domed' if curved else 'flat'}, {low:g} to {high:g}: {off:+.2f} ± {sure:.2f} %")
        assert abs(off) < 0.3 + 3.5 * sure


def test_behind_a_black_sheet_light_is_counted_once(variant: str) -> None:
    """What the maps say enters is what the walks' balance says: nothing comes back to go on."""
    from scenes import Renderer, build, direct, surface, transport
    from scenes.irradiance import transmitted
    from scenes.trace import SINKS

    base = paper_sensor("air")
    sheet = Sheet(thickness_mm=0.5, modulus_kPa=100.0, scattering_per_mm=0.0, absorption_per_mm=5.0)
    sensor = dataclasses.replace(base, skin=dataclasses.replace(base.skin, sheet=sheet))
    renderer, shape = Renderer(sensor, "cpu"), surface.resample(bump(), sensor.guide.width_mm)
    build.put_surface(renderer.scene, sensor, shape)
    under = transport.Under.at(renderer.basis, renderer.behind, transport.survey(renderer.scene, sensor))
    straight = direct.direct(sensor, renderer.basis, shape)
    light = transport.transport(renderer.scene, sensor, renderer.table, under, straight, 2**17, 1)
    entered = transmitted(under.entrance, straight + light.traced, 1).sum()
    entered *= (sensor.guide.width_mm / CELLS) ** 2
    assert entered == pytest.approx(light.sinks[:, SINKS.index("tissue")].sum(), rel=0.02)


def _mean(values: np.ndarray) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def _gathered(renderer: Any, shape: Any, seeds: int) -> np.ndarray:
    """(seeds, CELLS, CELLS) W/mm² that enter of all LEDs, weighed with the tissue's first lobe."""
    from scenes import direct, transport
    from scenes.irradiance import transmitted

    ground = transport.survey(renderer.scene, renderer.sensor)
    under = transport.Under.at(renderer.basis, renderer.behind, ground)
    straight = direct.direct(renderer.sensor, renderer.basis, shape)
    parts = (renderer.scene, renderer.sensor, renderer.table, under, straight, 2**19)
    traced = (transport.transport(*parts, 100 + seed).traced for seed in range(seeds))
    return np.array([transmitted(under.entrance, straight + one, 1).sum(axis=(0, 1)) for one in traced])


def _followed(renderer: Any, passes: int, monkeypatch: pytest.MonkeyPatch) -> np.ndarray:
    """The same, (passes, CELLS, CELLS), by rays that end where they enter."""
    import drjit as dr
    import mitsuba as mi

    from scenes import exact, transport

    sensor, paths, unit = renderer.sensor, 2**19, 2.0**26
    ground, width = transport.survey(renderer.scene, sensor), sensor.guide.width_mm
    counted = dr.zeros(mi.Int64, CELLS * CELLS)
    lobe = renderer.behind.coupling.lobes[0]
    weights, last = mi.Float(lobe.astype(np.float32)), len(lobe) - 1

    def weight(cosine: Any) -> Any:
        at = dr.clip(cosine, 0.0, 1.0) * last
        node = dr.minimum(mi.UInt32(at), last - 1)
        low, high = (dr.gather(mi.Float, weights, node + k) for k in (0, 1))
        return dr.lerp(low, high, at - mi.Float(node))

    def end(*told: Any, **_: Any) -> tuple[Any, ...]:
        met, throughput, enters, random, scores = told[5], *told[7:11]
        column, row = (
            mi.UInt32(dr.clip((at / width + 0.5) * CELLS, 0, CELLS - 1)) for at in (met.p.x, met.p.y)
        )
        amount = mi.Int64(dr.round(throughput * weight(met.cosine) * unit))
        dr.scatter_add(counted, amount, row * CELLS + column, enters)
        return mi.Ray3f(met.p, met.d), mi.Float(0.0), random, scores

    monkeypatch.setattr(exact.wander, "wander", end)
    found = []
    for seed in range(passes):
        counted = dr.zeros(mi.Int64, CELLS * CELLS)
        exact.exact(renderer.scene, sensor, renderer.table, renderer.rays, ground, paths, 5000 + seed)
        found.append(counted.numpy().reshape(CELLS, CELLS) / unit)
    per = sensor.leds[0].flux_W / paths / (width / CELLS) ** 2
    return np.array(found) * per
