"""From LEDs to the light that leaves the tissue: walks through the guide and passes in the tissue in turn.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from . import trace
from .bsdf import Table
from .irradiance import AngularBasis, smooth, transmitted
from .sensor import Sensor

Array = NDArray[np.float64]

GRID = 200  # cells of the maps per side
_ORDERS = 12  # of re-emission at most
_ENOUGH = 1e-4  # share of the light below which the next order is left out


@dataclass(frozen=True)
class Ground:
    """The contact as the tissue's light meets it, on cells [iy, ix] of the guide's face.

    Attributes
    ----------
    fraction : (GRID, GRID)
        Real contact fraction of the deformed surface there; 0 beside the surface.
    meets : (GRID, GRID)
        Whether the surface lies there.
    escape : (GRID, GRID)
        Share of the light from inside the tissue that passes, (n1/n3)² times the guide side's hemispherical
        transmittance.
    """

    fraction: Array
    meets: NDArray[np.bool_]
    escape: Array


@dataclass(frozen=True)
class Light:
    """Light in the tissue and its whereabouts.

    Attributes
    ----------
    upward : (n_led, GRID, GRID)
        Flux that goes up inside the tissue towards the contact surface, U, W/mm².
    sinks : (n_led, len(trace.SINKS))
        W that end there; "tissue" is what the tissue keeps.
    trapped : (n_led,)
        W that come to the contact surface for the first time beyond the critical angle.
    """

    upward: Array
    sinks: Array
    trapped: Array


def survey(scene: mi.Scene, sensor: Sensor, table: Table) -> Ground:
    """Look at the deformed surface from below, cell by cell."""
    width = sensor.guide.width_mm
    middles = (np.arange(GRID) + 0.5) / GRID * width - width / 2
    x, y = (mi.Float(values.ravel().astype(np.float32)) for values in np.meshgrid(middles, middles))
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    height = -0.5 * sensor.guide.thickness_mm
    si = scene.ray_intersect(mi.Ray3f(mi.Point3f(x, y, height), mi.Vector3f(0.0, 0.0, 1.0)))
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)
    inward = (sensor.guide.refractive_index / sensor.tissue.refractive_index) ** 2
    escape = dr.select(meets, inward * table.hemispherical(fraction, meets), 0.0)
    found = [np.asarray(values).reshape(GRID, GRID) for values in (fraction, meets, escape)]
    return Ground(found[0].astype(np.float64), found[1].astype(bool), found[2].astype(np.float64))


def transport(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    basis: AngularBasis,
    ground: Ground,
    straight: Array,
    samples: int,
    seed: int,
) -> Light:
    """Follow the LEDs' light until it has ended.

    Mirrored light walks through the guide (`trace.walk`); what enters the tissue spreads there, and what
    comes back out walks again, order by order.

    Parameters
    ----------
    straight
        From `direct.direct`, (n_led, count, GRID, GRID), W/mm².
    samples
        Light paths per LED, half of them from the LED itself.
    seed
        Seed of every random choice; the result depends on nothing else, not even on the number of threads.
    """
    n_led = len(sensor.leds)
    flux = np.array([led.flux_W for led in sensor.leds])
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=(_ORDERS + 1, 4))

    def walk(order: int, each: int, upward: Array | None) -> tuple[Array, Array, Array, Array]:
        index = dr.arange(mi.UInt32, n_led * each)
        number = index // mi.UInt32(dr.opaque(mi.UInt32, each))
        place = index - number * dr.opaque(mi.UInt32, each)
        u = trace.evenly(place, starts[order])
        if upward is None:
            legs = [trace.IN_AIR if led.coupling == "air" else trace.IN_GUIDE for led in sensor.leds]
            leg = dr.gather(mi.UInt32, mi.UInt32(np.array(legs, dtype=np.uint32)), number)
            ray, amount, scale = trace.emit(sensor, number, u), dr.full(mi.Float, 1.0, n_led * each), flux
        else:
            ray, amount = trace.re_emit(scene, sensor, table, upward, number, u)
            scale = upward.mean(axis=(1, 2)) * sensor.guide.width_mm**2
            amount /= dr.gather(mi.Float, mi.Float(np.maximum(scale, 1e-30)), number)
            leg = mi.UInt32(trace.OTHER)
        begun = np.asarray(amount, dtype=np.float64).reshape(n_led, each).mean(axis=1)
        found = trace.walk(scene, sensor, table, basis, number, ray, amount, leg, 16 * seed + order)
        area = (sensor.guide.width_mm / trace.CELLS) ** 2
        maps = found.maps * (scale / each / area)[:, None, None, None]
        sinks, trapped = found.sinks * (scale / each)[:, None], found.trapped * scale / each
        return maps, sinks, trapped, begun * scale

    each = max(samples // 2, 1)
    maps, sinks, trapped, _ = walk(0, each, None)
    landed = straight + smooth(maps, GRID // trace.CELLS)
    total = newest = _spread(sensor, basis, ground, landed)
    for order in range(1, _ORDERS + 1):
        if newest.sum() <= _ENOUGH * total.sum():
            break
        maps, more, _, begun = walk(order, max(each >> min(order - 1, 4), 1), newest)
        sinks = sinks + more
        sinks[:, 0] -= begun
        newest = _spread(sensor, basis, ground, smooth(maps, GRID // trace.CELLS))
        total = total + newest
    return Light(total, sinks, trapped)


def _spread(sensor: Sensor, basis: AngularBasis, ground: Ground, landed: Array) -> Array:
    """Flux that goes up in the tissue, (n_led, GRID, GRID), from weighted irradiance."""
    entering = transmitted(basis, landed, ground.fraction) * ground.meets
    albedo = sensor.tissue.albedo
    return np.asarray(albedo * entering / (1.0 - albedo * (1.0 - ground.escape)))
