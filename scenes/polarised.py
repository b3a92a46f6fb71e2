"""How large the error is of taking all light for unpolarised: both kinds of light, on the same paths.

LEDs give unpolarised light. Fresnel's faces and the frustrated reflections at the contact polarise it on its
way (`stokes_walk`); in the tissue it loses its state, so that light which leaves it starts anew, is polarised
by the contact, and walks again or goes to the camera through the contact and the flat faces, s and p apart.
The standard model has the mean of s and p at each face instead. What is common to both is as in `transport`,
but for the light that comes straight from the LEDs, which is not gathered here; LEDs in sight are left out.

Import only after a variant is set (`scenes.backend.use` or `use_polarised`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates
from threadpoolctl import threadpool_limits

from . import build, gather, housing, recurrence, stokes, trace, view
from .arrays import floats
from .bsdf import Table
from .gather import Sight
from .irradiance import angular_basis
from .mueller import ContactMueller, contact_mueller
from .sensor import Sensor
from .stokes_walk import Left, Start, walk
from .surface import OpticalSurface
from .tissue import body_behind
from .transport import GRID, MARGIN, Behind, Ground, Under, survey

Array = NDArray[np.float64]

_ORDERS = 12  # of re-emission at most
_ENOUGH = 1e-3  # share of the light below which the orders to come are estimated
_SEEDS = 16  # of the walks of one seed


@dataclass(frozen=True)
class Compared:
    """Both kinds of light under one press; the leading axis is `stokes_walk.KINDS`.

    Attributes
    ----------
    entered : (2, n_led, CELLS, CELLS)
        Light that enters the tissue in each cell of the contact surface, W.
    radiance : (2, n_led, rows, columns)
        What the camera's lens receives, W m⁻² sr⁻¹, without LEDs in sight.
    through : (2, n_led, rows, columns)
        The same of the unpolarised walk's light in the tissue: what the faces before the camera alone do.
    sinks : (2, n_led, len(trace.SINKS))
        W that end there.
    """

    entered: Array
    radiance: NDArray[np.float32]
    through: NDArray[np.float32]
    sinks: Array


class Polarised:
    """A sensor's scene under one press, and both kinds of light in it."""

    def __init__(self, sensor: Sensor, pressed: OpticalSurface) -> None:
        """Load the scene and press its surface."""
        housing.refuse(sensor, "polarised light")
        self.sensor = sensor
        with threadpool_limits(1):
            optics = build.optics_of(sensor)
            coupling = build.coupling_of(sensor, optics)
            behind = Behind.of(sensor, coupling)
            self.basis = angular_basis(optics, coupling)
        mueller = contact_mueller_of(sensor)
        packed = Table.pack(optics, coupling)
        self.table, self.contact = Table(packed), stokes.Contact(mueller)
        self.scene = build.load_scene(sensor, packed)
        build.put_surface(self.scene, sensor, pressed)
        ground = survey(self.scene, sensor)
        with threadpool_limits(1):
            self.under = Under.at(self.basis, behind, ground)
        rays = view.pixel_rays(sensor)
        sight = gather.look(self.scene, sensor, self.table, coupling, rays)
        cosine = rays.direction[..., 2]
        apart = sight_ratios(sensor, sight, ground, optics.transmittance, mueller, cosine)
        self.sights = (sight, _weighed(sight, apart))

    def entering(self, samples: int, seed: int) -> Array:
        """Light of the LEDs that enters the tissue as it comes from them, as `Compared.entered`; `samples`
        light paths from each LED."""
        starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=4)
        left = self._walk(self._from_leds(samples, starts), _SEEDS * seed)
        flux = np.array([led.flux_W for led in self.sensor.leds])
        return left.entered * (flux / samples)[:, None, None]

    def compare(self, samples: int, seed: int) -> Compared:
        """Follow `samples` light paths from each LED, and half as many, then fewer, out of the tissue.

        The result depends on `seed` alone, not on the number of threads.
        """
        sensor, under = self.sensor, self.under
        starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=(_ORDERS + 1, 4))
        flux = np.array([led.flux_W for led in sensor.leds])

        left = self._walk(self._from_leds(samples, starts[0]), _SEEDS * seed)
        maps, entered, sinks = _scaled(left, flux / samples)
        landed = _finer(maps, sensor)
        with threadpool_limits(1):
            newest = np.stack([under.upward(one) for one in landed])
        first = newest[:, :, 0].sum(axis=(-2, -1))
        ratio, again, more = np.ones_like(first), np.zeros_like(landed), np.zeros_like(entered)
        for order in range(1, _ORDERS + 1):
            before = newest[:, :, 0].sum(axis=(-2, -1))
            if (before * ratio).sum() <= _ENOUGH * first.sum():
                break
            each = max(samples >> min(order, 4), 2)
            start, scale, begun = self._from_tissue(newest, each, starts[order])
            left = self._walk(start, _SEEDS * seed + order)
            maps, more, ends = _scaled(left, scale / each)
            again = _finer(maps, sensor)
            with threadpool_limits(1):
                newest = np.stack([under.again(one) for one in again])
            landed, entered, sinks = landed + again, entered + more, sinks + ends
            sinks[..., 0] -= begun
            ratio = newest[:, :, 0].sum(axis=(-2, -1)) / np.maximum(before, 1e-300)
        rest = np.clip(ratio, 0.0, 0.9) / (1.0 - np.clip(ratio, 0.0, 0.9))
        landed = landed + again * rest[:, :, None, None, None].astype(np.float32)
        entered = entered + more * rest[:, :, None, None]
        with threadpool_limits(1):
            seen = [under.seen(one) for one in landed]
        plain, half, polarised = (
            gather.picture(sight, one, MARGIN, lamps=False)
            for sight, one in (
                (self.sights[0], seen[0]),
                (self.sights[1], seen[0]),
                (self.sights[1], seen[1]),
            )
        )
        return Compared(entered, np.stack([plain, polarised]), np.stack([plain, half]), sinks)

    def _walk(self, start: tuple[mi.UInt32, Start], seed: int) -> Left:
        number, begin = start
        return walk(self.scene, self.sensor, self.table, self.contact, self.basis, number, begin, seed)

    def _points(self, each: int, starts: np.ndarray) -> tuple[mi.UInt32, list[mi.Float]]:
        n_led = len(self.sensor.leds)
        number = dr.arange(mi.UInt32, n_led * each) // mi.UInt32(dr.opaque(mi.UInt32, each))
        return number, recurrence.evenly(recurrence.side_by_side(each, n_led), starts)

    def _from_leds(self, each: int, starts: np.ndarray) -> tuple[mi.UInt32, Start]:
        number, u = self._points(each, starts)
        ray, one = trace.emit(self.sensor, number, u), dr.full(mi.Float, 1.0, dr.width(number))
        return number, Start(ray, one, stokes.unpolarised(one), mi.coordinate_system(ray.d)[0])

    def _from_tissue(
        self, upward: Array, each: int, starts: np.ndarray
    ) -> tuple[tuple[mi.UInt32, Start], Array, Array]:
        """Light of both kinds that leaves the tissue, its scale (n_led,), and how much it is, (2, n_led)."""
        number, u = self._points(each, starts)
        parts = self.scene, self.sensor, self.table, self.under.behind.coupling
        scale = upward[0, :, 0].mean(axis=(1, 2)) * self.sensor.guide.width_mm**2
        per = dr.gather(mi.Float, floats(np.maximum(scale, 1e-30)), number)
        (ray, plain, _), (_, polarised, _) = (trace.re_emit(*parts, one, number, u) for one in upward)
        plain, polarised = plain / per, polarised / per
        left = trace.depart(self.scene, self.sensor, self.table, u)
        through = self.table.transmittance(left.fraction, left.cosine, left.meets)
        apart, _ = self.contact.at(left.fraction, left.cosine, through, left.meets)
        side = stokes.across(ray.d, left.normal, mi.coordinate_system(ray.d)[0])
        state = polarised * mi.Vector4f(1.0, dr.select(through > 0.0, apart / through, 0.0), 0.0, 0.0)
        begun = [
            np.asarray(one, dtype=np.float64).reshape(len(scale), each).mean(axis=1) * scale
            for one in (plain, polarised)
        ]
        return (number, Start(ray, plain, state, side)), scale, np.stack(begun)


def contact_mueller_of(sensor: Sensor) -> ContactMueller:
    """What `build.optics_of` leaves out of this sensor's contact."""
    skin = sensor.skin
    index, _ = body_behind(skin, sensor.tissue)
    indices = sensor.guide.refractive_index, skin.gap_index, index
    return contact_mueller(*indices, skin.rms_height_um, sensor.wavelength_nm, dust=skin.dust)


def sight_ratios(
    sensor: Sensor, sight: Sight, ground: Ground, mean: Array, mueller: ContactMueller, cosine: Array
) -> Array:
    """Radiance at the camera with s and p apart over that with their means, (sights, rows, columns).

    Light leaves the tissue without a state. Contact and flat faces are taken as parallel: all that happens
    to it on its way, also mirrored in the lower faces and the contact, is then a product of shares, of s
    and of p. `mean` is T (n_fraction, n_cos); `cosine` that of the pixels' rays in the guide.
    """
    places = [
        [np.asarray(one).reshape(cosine.shape) * GRID - 0.5 for one in (y, x)] for x, y, _ in sight.points
    ]
    fractions = [map_coordinates(ground.fraction, place, order=1, mode="nearest") for place in places]

    def at(table: Array, fraction: Array) -> Array:
        rows, columns = (size - 1 for size in table.shape)
        return np.asarray(map_coordinates(table, [fraction * rows, cosine * columns], order=1))

    through = [at(mean, one) for one in fractions]
    half = [at(mueller.diattenuation, one) for one in fractions]
    plate = view.faces_reflectance(sensor, cosine)
    bare = through[0] * (1.0 - plate), through[1] * plate * (1.0 - through[0]) * (1.0 - plate)
    apart: list[Array] = [np.zeros_like(cosine), np.zeros_like(cosine)]
    for sign, of_faces in zip((1.0, -1.0), view.faces_reflectances(sensor, cosine), strict=True):
        first, second = (t + sign * d for t, d in zip(through, half, strict=True))
        apart[0] += 0.5 * first * (1.0 - of_faces)
        apart[1] += 0.5 * second * of_faces * (1.0 - first) * (1.0 - of_faces)
    return np.stack([a / np.maximum(b, 1e-30) for a, b in zip(apart, bare, strict=True)])


def _weighed(sight: Sight, ratios: Array) -> Sight:
    points = [(x, y, gain * floats(ratio)) for (x, y, gain), ratio in zip(sight.points, ratios, strict=True)]
    return replace(sight, points=points)


def _scaled(left: Left, watts: Array) -> tuple[Array, Array, Array]:
    """Maps, entered light and sinks in W, from W per path of each LED."""
    return (
        left.maps * watts[:, None, None, None],
        left.entered * watts[:, None, None],
        left.sinks * watts[:, None],
    )


def _finer(maps: Array, sensor: Sensor) -> NDArray[np.float32]:
    """W per cell of `trace` as W/mm² on the cells of `transport`, not smoothed."""
    area, factor = (sensor.guide.width_mm / trace.CELLS) ** 2, GRID // trace.CELLS
    return np.repeat(np.repeat((maps / area).astype(np.float32), factor, axis=-1), factor, axis=-2)
