"""Gathered LED light against closed forms and against rays thrown by hand."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensors import paper_sensor
from test_lamp import SKEWED_FLUX, skewed, write_skewed

from scenes.sensor import Led, Sensor
from scenes.surface import flat

RAYS = 2_000_000
BLOCKS = 10  # per side, of the comparison with thrown rays


def alone(coupling: str, **changes: Any) -> Sensor:
    """The sensor with one LED, on the side +x."""
    led = dataclasses.replace(paper_sensor(coupling).leds[0], side="+x", **changes)
    return dataclasses.replace(paper_sensor(coupling), leds=(led,))


def irradiance(one: Sensor) -> np.ndarray:
    """(200, 200) W/mm² on the flat, unloaded contact surface, every angle counting alike."""
    from scenes.direct import direct
    from scenes.irradiance import AngularBasis

    everything = AngularBasis(np.ones((1, 2, 1)), np.ones((1, 2)))
    return direct(one, everything, flat(one.guide.width_mm, 0.0))[0, 0]


def fresnel(n1: float, n2: float, cos1: np.ndarray) -> np.ndarray:
    """Unpolarised reflectance from the angles themselves, total beyond the critical one."""
    sine = n1 / n2 * np.sqrt(1 - cos1**2)
    cos2 = np.sqrt(np.maximum(1 - sine**2, 0.0))
    s = (n1 * cos1 - n2 * cos2) / (n1 * cos1 + n2 * cos2)
    p = (n2 * cos1 - n1 * cos2) / (n2 * cos1 + n1 * cos2)
    return np.where(sine < 1, 0.5 * (s**2 + p**2), 1.0)


def factor(led: Led, cosine: np.ndarray, along: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Intensity over that of a Lambertian disc: of cos^m, and of the file of `test_lamp` in closed form."""
    if led.tilt_deg:
        lean, m = np.radians(led.tilt_deg), led.exponent or 1.0
        ends = (np.maximum(up * np.sin(lean) + sign * cosine * np.cos(lean), 0.0) for sign in (1, -1))
        return np.asarray((m + 1) / 2 * sum(end**m for end in ends) / cosine)
    if led.pattern == "power":
        assert led.exponent is not None
        return np.asarray((led.exponent + 1) / 2 * cosine ** (led.exponent - 1))
    if led.pattern == "ies":
        return np.asarray(skewed(cosine, np.arctan2(up, along)) * np.pi / SKEWED_FLUX / cosine)
    return np.ones_like(cosine)


def thrown(one: Sensor, seed: int = 5) -> np.ndarray:
    """The same in (BLOCKS, BLOCKS) W, by rays from the disc, refracted and mirrored vector by vector."""
    led, guide, glass = one.leds[0], one.guide, one.glass
    random = np.random.Generator(np.random.Philox(seed))
    half, n = guide.width_mm / 2, guide.refractive_index
    radius = led.diameter_mm / 2 * np.sqrt(random.random(RAYS))
    turn = 2 * np.pi * random.random(RAYS)
    x = np.full(RAYS, half + (led.gap_mm if led.coupling == "air" else -led.gap_mm))
    y, z = led.along_mm + radius * np.cos(turn), led.z_mm + radius * np.sin(turn)
    sine2, turn = random.random(RAYS), 2 * np.pi * random.random(RAYS)
    d = np.stack([-np.sqrt(1 - sine2), np.sqrt(sine2) * np.cos(turn), np.sqrt(sine2) * np.sin(turn)])
    weight = led.flux_W / RAYS * factor(led, -d[0], d[1], d[2])
    if led.coupling == "air":
        step = led.gap_mm / -d[0]
        y, z, x = y + step * d[1], z + step * d[2], np.full(RAYS, half)
        weight = (
            weight * (1 - fresnel(1.0, n, -d[0])) * ((np.abs(y) < half) & (z > -guide.thickness_mm) & (z < 0))
        )
        d = np.stack([-np.sqrt(1 - (d[1] ** 2 + d[2] ** 2) / n**2), d[1] / n, d[2] / n])
    down = d[2] < 0
    # down to the glass, through it, back at its lower face, up through the guide: lateral run per leg
    in_glass = np.stack([d[0], d[1]]) * n / glass.refractive_index
    cos_glass = np.sqrt(1 - np.sum(in_glass**2, axis=0))
    rise = np.where(down, (z + guide.thickness_mm) + guide.thickness_mm, -z) / np.abs(d[2])
    sideways = np.where(down, 2 * glass.thickness_mm / cos_glass, 0.0)
    x, y = x + rise * d[0] + sideways * in_glass[0], y + rise * d[1] + sideways * in_glass[1]
    through = 1 - fresnel(n, glass.refractive_index, np.abs(d[2]))
    back = through**2 * fresnel(glass.refractive_index, 1.0, cos_glass)
    weight = weight * np.where(down, back, 1.0)
    edges = np.linspace(-half, half, BLOCKS + 1)
    return np.histogram2d(y, x, bins=(edges, edges), weights=weight)[0]


@pytest.mark.parametrize("coupling", ["air", "embedded"])
@pytest.mark.parametrize("pattern", ["power", "ies", "leaning"])
def test_patterns_power_per_block_equals_that_of_thrown_rays(
    variant: str, tmp_path: Path, coupling: str, pattern: str
) -> None:
    """cos^4, and a lamp that sends more light to one side; no symmetry helps."""
    given: dict[str, Any] = {"pattern": pattern, "ies": write_skewed(tmp_path)}
    if pattern != "ies":
        given = {"pattern": "power", "exponent": 4.0, "tilt_deg": 0.0 if pattern == "power" else -20.0}
    one = alone(coupling, along_mm=3.0, z_mm=-3.5, **given)
    ours, theirs = blocks(irradiance(one), one.guide.width_mm), thrown(one)
    sigma = np.sqrt(theirs * 2.5 * one.leds[0].flux_W / RAYS)  # a ray carries at most 2.5 flux/RAYS
    assert np.abs(ours - theirs).max() < 5e-4 * one.leds[0].flux_W
    strong = theirs > 1e-3 * one.leds[0].flux_W
    assert strong.sum() > 20
    assert np.all(np.abs(ours - theirs)[strong] < 5 * sigma[strong] + 2e-3 * theirs[strong])
    assert abs(ours.sum() / theirs.sum() - 1) < 3e-3
    plain = blocks(irradiance(alone(coupling, along_mm=3.0, z_mm=-3.5)), one.guide.width_mm)
    assert np.abs(ours - plain).max() > 0.005 * one.leds[0].flux_W  # it would be seen if it were left out


def blocks(values: np.ndarray, width_mm: float) -> np.ndarray:
    side = values.shape[0] // BLOCKS
    cell = (width_mm / values.shape[0]) ** 2
    return values.reshape(BLOCKS, side, BLOCKS, side).sum(axis=(1, 3)) * cell


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_power_per_block_equals_that_of_thrown_rays(variant: str, coupling: str) -> None:
    """Air: Snell's law is solved backwards through the face; embedded: not. No symmetry helps."""
    one = alone(coupling, along_mm=3.0, z_mm=-3.5)
    ours, theirs = blocks(irradiance(one), one.guide.width_mm), thrown(one)
    sigma = np.sqrt(theirs * one.leds[0].flux_W / RAYS)  # each ray carries at most flux/RAYS
    assert np.abs(ours - theirs).max() < 5e-4 * one.leds[0].flux_W
    strong = theirs > 1e-3 * one.leds[0].flux_W
    assert strong.sum() > 20
    assert np.all(np.abs(ours - theirs)[strong] < 5 * sigma[strong] + 1e-3 * theirs[strong])
    assert abs(ours.sum() / theirs.sum() - 1) < 2e-3


def test_small_embedded_led_is_lamberts_law(variant: str) -> None:
    """Straight up from a small disc: E = F/pi cos(led) cos(surface) / r², all in one medium."""
    one = alone("embedded", diameter_mm=0.01)
    values = irradiance(one)
    half, led = one.guide.width_mm / 2, one.leds[0]
    line = (np.arange(200) + 0.5) / 200 * 2 * half - half
    x, y = np.meshgrid(line, line)
    away, up = (half - led.gap_mm) - x, -led.z_mm
    r2 = away**2 + y**2 + up**2
    straight = led.flux_W / np.pi * away * up / r2**2
    # what comes by the glass is small only where it mostly leaves, below the critical angle
    near = (away > 1.0) & (away < 4.0) & (np.abs(y) < 3.0)
    mirrored_up = 2 * one.guide.thickness_mm - up + 2 * one.glass.thickness_mm
    mirrored = led.flux_W / np.pi * away * mirrored_up / (away**2 + y**2 + mirrored_up**2) ** 2
    assert np.all(values[near] > 0.999 * straight[near])
    assert np.all(values[near] < 1.001 * straight[near] + 0.15 * mirrored[near])


def test_light_is_linear_in_flux_and_adds_over_leds(variant: str) -> None:
    one = alone("air")
    led = one.leds[0]
    twice = dataclasses.replace(one, leds=(dataclasses.replace(led, flux_W=2 * led.flux_W),))
    np.testing.assert_allclose(irradiance(twice), 2 * irradiance(one), rtol=1e-6, atol=0)


def test_sides_are_equivalent(variant: str) -> None:
    """Turning the sensor by 90 degrees turns the light with it."""
    one = alone("air", along_mm=3.0)
    led: Led = one.leds[0]
    other = dataclasses.replace(one, leds=(dataclasses.replace(led, side="-x"),))
    np.testing.assert_allclose(irradiance(other), irradiance(one)[:, ::-1], rtol=2e-4, atol=1e-12)
    top = dataclasses.replace(one, leds=(dataclasses.replace(led, side="+y"),))
    np.testing.assert_allclose(irradiance(top), irradiance(one).T, rtol=2e-4, atol=1e-12)


def test_fewer_points_of_a_disc_find_the_same_rays(variant):
    """They lie farther apart, so that each ray is farther from the one that its search begins with."""
    from scenes.direct import on, relief
    from scenes.irradiance import AngularBasis

    everything = AngularBasis(np.ones((1, 2, 1)), np.ones((1, 2)))
    sensor = paper_sensor("air")
    ground = relief(sensor, flat(sensor.guide.width_mm, -0.1))
    few, many = (on(sensor, everything, ground, points)[:, 0] for points in (12, 24))
    assert np.abs(few - many).mean() < 0.01 * many.mean()


@pytest.mark.parametrize("points", [12, 24])
def test_rays_land_where_they_should(variant, monkeypatch, points):
    """What the point before foretold is so near that more steps of Newton's method change nothing."""
    from scenes import direct
    from scenes.irradiance import AngularBasis

    everything = AngularBasis(np.ones((1, 2, 1)), np.ones((1, 2)))
    sensor = paper_sensor("air")
    ground = direct.relief(sensor, flat(sensor.guide.width_mm, -0.1))
    found = direct.on(sensor, everything, ground, points)
    monkeypatch.setattr(direct, "_NEWTON_AGAIN", 8)
    exact = direct.on(sensor, everything, ground, points)
    assert np.sqrt(((found - exact) ** 2).mean()) < 2e-4 * exact.mean()
