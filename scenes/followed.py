"""Light that is not gathered, with its derivatives: `transport.transport` and what it answers, from one walk.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import recurrence, trace, transport
from .answers import Answers
from .arrays import floats, numbers
from .bsdf import Table
from .build import led_frame
from .lamp import Patterns
from .response import Basis, Landed, Response
from .sensor import Sensor

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Emission:
    """What q parameters change in the LEDs, per unit of each: places along their sides and up, mm, and
    exponents of their patterns; (q,) each."""

    along_mm: Array
    z_mm: Array
    exponent: Array


@dataclass(frozen=True)
class Stage:
    """A scene with its surface in place, and what is asked of it; how tissue responds on the walks' cells."""

    scene: mi.Scene
    sensor: Sensor
    table: Table
    basis: Basis
    response: Response
    answers: Answers
    emission: Emission


def follow(stage: Stage, lit: Array, samples: int, seed: int) -> Landed:
    """Light that is not gathered, and its derivatives, as walks count it: on trace.CELLS a side, not smooth.

    Parameters
    ----------
    lit
        `Response.upward` of the gathered light on those cells, (1 + q, n_led, modes, m, m).
    samples, seed
        As of `transport.transport`; the light itself is the same but for rounding.
    """
    response, n_led = stage.response, len(stage.sensor.leds)
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=(transport.ORDERS + 1, 4))
    each = max(samples // 2, 1)
    traced = _from_leds(stage, each, starts[0], 16 * seed)
    landed = traced
    total = newest = response.again(traced.even()) + lit
    ratio, turn = np.ones(n_led), np.zeros((len(lit) - 1, n_led))
    for order in range(1, transport.ORDERS + 1):
        before = newest[:, :, 0].sum(axis=(2, 3))
        if (before[0] * ratio).sum() <= transport.ENOUGH * total[0, :, 0].sum():
            break
        count = max(each >> min(2 * order, 6), 2)
        landed = _from_tissue(stage, newest, count, starts[order], 16 * seed + order)
        newest = response.again(landed.even())
        total, traced = total + newest, traced + landed
        after = newest[:, :, 0].sum(axis=(2, 3))
        ratio = after[0] / np.maximum(before[0], 1e-300)
        turn = (after[1:] - ratio * before[1:]) / np.maximum(before[0], 1e-300)
    # the orders to come are a geometric series: its sum, and the derivative of that
    turn = np.where((ratio > 0.0) & (ratio < 0.9), turn, 0.0)
    ratio = np.clip(ratio, 0.0, 0.9)
    rest, rises = ratio / (1.0 - ratio), turn / (1.0 - ratio) ** 2
    light = landed.light * _of_led(rest)
    slopes = landed.slopes * _of_led(rest)
    for slope, rise in zip(slopes, rises, strict=True):
        slope += landed.light[:, : stage.basis.told] * _of_led(rise)
    return traced + Landed(light, slopes)


def _of_led(factor: Array) -> NDArray[np.float32]:
    """A factor of each LED's maps."""
    return factor.astype(np.float32)[:, None, None, None]


def _from_leds(stage: Stage, each: int, start: NDArray[np.integer], seed: int) -> Landed:
    """What the LEDs' own light leaves.

    A disc that moves changes its light by what its rim sends (Reynolds' transport theorem): with even
    emission per area, (2/R) times the mean over the rim of what a ray leaves there times the rim's move
    outwards. Rays of opposite points of the rim go in pairs, with the same choices: their noise cancels.
    """
    sensor, emission = stage.sensor, stage.emission
    number, u = _lanes(sensor, each, start)
    legs = [transport.first_leg(led) for led in sensor.leds]
    leg = dr.gather(mi.UInt32, numbers(legs), number)
    one = dr.full(mi.Float, 1.0, len(sensor.leds) * each)

    ray = trace.emit(sensor, number, u)
    scores = [mi.Float(0.0) * one for _ in emission.exponent]
    if emission.exponent.any():
        half, floor = sensor.guide.width_mm / 2, -sensor.guide.thickness_mm - sensor.glass.thickness_mm
        axes = np.array([led_frame(led, half, floor)[1] for led in sensor.leds]).T
        axis = mi.Vector3f(*(dr.gather(mi.Float, floats(part), number) for part in axes))
        cosine = dr.dot(ray.d, axis)
        score = Patterns(sensor.leds).score(number, cosine)
        scores = [score * float(unit) for unit in emission.exponent]
    flux = np.array([led.flux_W for led in sensor.leds])
    maps = _walked(stage, number, ray, one, leg, seed, flux, stage.answers, scores)

    number, u = _lanes(sensor, each, start, paired=True)
    moving = np.flatnonzero((emission.along_mm != 0.0) | (emission.z_mm != 0.0))
    if moving.size:
        odd = dr.arange(mi.UInt32, dr.width(number)) & 1
        u[0] = u[0] + 0.5 * mi.Float(odd)
        ray = trace.emit(sensor, number, u, rim=True)
        sine, cosine = dr.sincos(dr.two_pi * u[0])
        upright = [-1.0 if led.side in ("+x", "-y") else 1.0 for led in sensor.leds]
        rises = sine * dr.gather(mi.Float, floats(upright), number)
        per = dr.gather(mi.Float, floats([4.0 / led.diameter_mm for led in sensor.leds]), number)
        scores = [
            per * (cosine * float(emission.along_mm[k]) + rises * float(emission.z_mm[k])) for k in moving
        ]
        maps.slopes[moving] += _walked(stage, number, ray, one, leg, seed, flux, None, scores, True).slopes
    return maps


def _from_tissue(stage: Stage, upward: Array, each: int, start: NDArray[np.integer], seed: int) -> Landed:
    """What light leaves that comes out of the tissue, (1 + q, n_led, modes, m, m)."""
    sensor, coupling = stage.sensor, stage.response.under.behind.coupling
    number, u = _lanes(sensor, each, start)
    parts = (stage.scene, sensor, stage.table, coupling, upward[0], number, u)
    ray, amount, scores = trace.re_emit(*parts, stage.answers, list(upward[1:]))
    scale = upward[0, :, 0].mean(axis=(1, 2)) * sensor.guide.width_mm**2
    amount /= dr.gather(mi.Float, floats(np.maximum(scale, 1e-30)), number)
    return _walked(stage, number, ray, amount, mi.UInt32(trace.OTHER), seed, scale, stage.answers, scores)


def _walked(
    stage: Stage,
    number: mi.UInt32,
    ray: mi.Ray3f,
    amount: mi.Float,
    leg: mi.UInt32,
    seed: int,
    scale: Array,
    answers: Answers | None,
    scores: Sequence[mi.Float],
    paired: bool = False,
) -> Landed:
    """What a walk leaves; `scale` (n_led,) is W of a throughput of 1."""
    sensor = stage.sensor
    dr.eval(ray, amount, *scores)
    parts = (stage.scene, sensor, stage.table, stage.basis, number, ray, amount, leg, seed)
    found = trace.walk(*parts, answers, scores, paired)
    each = dr.width(number) // len(sensor.leds)
    area = (sensor.guide.width_mm / trace.CELLS) ** 2
    factor = (scale / each / area)[:, None, None, None]
    return Landed(*((maps * factor).astype(np.float32) for maps in (found.maps, found.answers)))


def _lanes(
    sensor: Sensor, each: int, start: NDArray[np.integer], *, paired: bool = False
) -> tuple[mi.UInt32, list[mi.Float]]:
    """LED of each lane, and its point of the unit 4-cube; the same for two and two lanes if `paired`."""
    n_led = len(sensor.leds)
    number = dr.arange(mi.UInt32, n_led * each) // mi.UInt32(dr.opaque(mi.UInt32, each))
    if not paired:
        return number, recurrence.evenly(recurrence.side_by_side(each, n_led), start)
    half = (each + 1) // 2
    pairs = recurrence.side_by_side(half, n_led)
    within = dr.arange(mi.UInt32, n_led * each) - number * each
    return number, recurrence.evenly(dr.gather(mi.UInt32, pairs, number * half + (within >> 1)), start)
