"""Polarised and unpolarised light followed through the sensor on the same paths.

The walk is that of `trace`, none of it gathered. At a polished face chance takes Fresnel's mean of s and p,
and the Stokes vector the face's Mueller matrix over it; both lose what passes where it never comes back, and
at the contact what enters the tissue. Painted walls and tissue depolarise.

Import only after a variant is set (`scenes.backend.use` or `use_polarised`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import stokes
from .bsdf import Table
from .faces import CONTACT, LED, NOTHING, TO_AIR, TO_GLASS, WALL, Faces
from .irradiance import AngularBasis
from .sensor import Sensor
from .trace import CELLS, ENOUGH, MAX_BOUNCES, SINKS, absorb, bounce_off, chance, leaves
from .windows import painted

Array = NDArray[np.float64]

KINDS = ("unpolarised", "polarised")
"""Of light, the leading axis of all that is counted."""

_FIXED_POINT = float(2**20)


@dataclass(frozen=True)
class Left:
    """What a walk left of both kinds of light.

    Attributes
    ----------
    maps : (2, n_led, layers, CELLS, CELLS)
        As `trace.Landed.maps`, of all light; for polarised light, of the unpolarised light of which as much
        would enter.
    entered : (2, n_led, CELLS, CELLS)
        Sum of what enters the tissue in each cell.
    sinks : (2, n_led, len(SINKS))
        Sum of what ended there.
    """

    maps: Array
    entered: Array
    sinks: Array


@dataclass(frozen=True)
class Start:
    """Rays of both kinds of light: rays, `throughput` unpolarised, the polarised state and its basis."""

    ray: mi.Ray3f
    throughput: mi.Float
    state: mi.Vector4f
    side: mi.Vector3f


def walk(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    contact: stokes.Contact,
    basis: AngularBasis,
    number: mi.UInt32,
    start: Start,
    seed: int,
) -> Left:
    """Follow light through the scene until it has ended; arguments as those of `trace.walk`."""
    n_led, layers, width = len(sensor.leds), basis.layers, sensor.guide.width_mm
    weights, count = basis.weights(), basis.layers + 1
    maps = [dr.zeros(mi.Int64, n_led * count * CELLS * CELLS) for _ in KINDS]
    faces = Faces(scene, sensor)
    lanes = dr.width(number)
    sequence = dr.arange(mi.UInt64, lanes) + 1
    random = mi.PCG32(size=lanes, initstate=dr.opaque(mi.UInt64, seed), initseq=sequence)
    ended = [mi.Float(0.0) for _ in (*SINKS, *SINKS)]
    begin = (start.ray, start.throughput, start.state, start.side)
    state = (*begin, mi.UInt32(0), start.throughput > 0.0, random, *ended)

    def going(ray, throughput, light, side, bounce, alive, random, *ended):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, light, side, bounce, alive, random, *ended):  # type: ignore[no-untyped-def]
        sinks = list(ended)

        def end(name: str, where: mi.Bool, plain: mi.Float, polarised: mi.Float) -> None:
            for kind, amount in enumerate((plain, polarised)):
                sinks[kind * len(SINKS) + SINKS.index(name)] += dr.select(where, amount, 0.0)

        met = faces.meet(ray, alive)
        for medium, lost in absorb(sensor, ray, met, throughput).items():
            share = lost / dr.maximum(throughput, 1e-30)
            end(medium, alive, lost, share * light.x)
            throughput, light = throughput - lost, (1.0 - share) * light
        gone = alive & (met.kind == NOTHING)
        down = ray.o.z < -sensor.guide.thickness_mm
        end("below", gone & down, throughput, light.x)
        end("aside", gone & ~down, throughput, light.x)
        alive = alive & ~gone

        new = stokes.across(ray.d, met.normal, side)
        light, side = stokes.turned(light, ray.d, side, new), new
        cosine = met.cosine
        on_contact = alive & (met.kind == CONTACT) & (cosine > 0.0)
        through = table.transmittance(met.fraction, cosine, on_contact)
        apart, mirror = contact.at(met.fraction, cosine, through, on_contact)
        relative = dr.select(through > 0.0, apart / through, 0.0)
        alike = light.x + relative * light.y  # unpolarised light of which as much enters
        lands = on_contact & (met.n.z < -0.5)
        column = mi.UInt32(dr.clip((met.p.x / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        row = mi.UInt32(dr.clip((met.p.y / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        cell = ((number * CELLS + row) * CELLS + column) * count
        counted = [*weights.at(cosine, met.along.x, met.along.y, lands), through]
        for where, irradiance in zip(maps, (throughput, alike), strict=True):
            for k, weight in enumerate(counted):
                amount = mi.Int64(dr.round(irradiance * weight * _FIXED_POINT))
                dr.scatter_add(where, amount, cell + k, lands)
        end("tissue", on_contact, throughput * through, alike * through)

        elsewhere = alive & ~on_contact
        sample1, sample2 = random.next_float32(), mi.Point2f(random.next_float32(), random.next_float32())
        direction, share = bounce_off(sensor, faces, met, elsewhere, sample1, sample2)
        lost = elsewhere & leaves(sensor, met)
        direction = dr.select(on_contact | lost, met.mirrored, direction)
        share = dr.select(lost, faces.reflectance(met), share)
        kept = throughput * dr.select(on_contact, 1.0 - through, share)
        clear = elsewhere & ((met.kind == TO_GLASS) | (met.kind == TO_AIR) | (met.kind == WALL))
        if sensor.guide.walls != "polished":
            clear &= ~painted(sensor, met, elsewhere)
        mirrored, passing = stokes.fresnel(cosine, faces.eta(met))
        passed = cosine * dr.dot(direction, met.normal) < 0.0
        chosen = dr.select(passed, passing.acts(light), mirrored.acts(light))
        taken = dr.rcp(dr.maximum(dr.select(passed, passing.a, mirrored.a), 1e-12))
        chosen *= dr.select(lost, 1.0, taken)
        after = dr.select(clear, chosen, stokes.unpolarised(share * light.x))
        after = dr.select(on_contact, mirror.acts(light), after)

        for name, where in (
            ("leds", met.kind == LED),
            ("walls", met.kind == WALL),
            ("frame", (met.kind != LED) & (met.kind != WALL)),
        ):
            end(name, elsewhere & ~clear & where, throughput - kept, light.x - after.x)
        for name, where in (("below", met.kind == TO_AIR), ("aside", met.kind == WALL)):
            end(name, lost & where, throughput - kept, light.x - after.x)
        survive = chance(kept, bounce, ENOUGH)
        alive = alive & (kept > 0.0) & (random.next_float32() < survive) & (bounce < MAX_BOUNCES)
        throughput, light = dr.select(alive, kept / survive, 0.0), dr.select(alive, after / survive, 0.0)
        return met.leaving(direction), throughput, light, side, bounce + 1, alive, random, *sinks

    last = dr.while_loop(state, going, step)

    def per_led(values: mi.Float) -> Array:
        values = values + dr.zeros(mi.Float, lanes)
        return np.asarray(values, dtype=np.float64).reshape(n_led, -1).sum(axis=1)

    dr.eval(maps, last[7:])
    counted = np.stack([one.numpy().reshape(n_led, CELLS, CELLS, count) for one in maps]) / _FIXED_POINT
    sinks = np.stack([per_led(amount) for amount in last[7:]], axis=1).reshape(n_led, len(KINDS), len(SINKS))
    return Left(
        np.ascontiguousarray(np.moveaxis(counted[..., :layers], -1, 2)),
        counted[..., layers],
        np.moveaxis(sinks, 1, 0),
    )
