"""From LEDs to the light that leaves the tissue: walks through the guide and passes in the tissue in turn.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from . import cells, housing, recurrence, trace
from .abreast import abreast
from .arrays import floats, numbers
from .bent import Bend, Bent, bent
from .bsdf import Table
from .gather import meet
from .irradiance import AngularBasis, Entrance, smooth, transmitted
from .passage import Face, Passage, Seen, passage
from .sensor import Led, Sensor
from .spread import Bed, Spread, spreader
from .tissue import Coupling, body_behind

Array = NDArray[np.float64]
Singles = NDArray[np.float32]

GRID = 200  # cells of the maps per side
MARGIN = 30  # cells beside them, in which light comes out of bare skin
ORDERS = 12  # of re-emission at most
_LEAST_SHARE = 1e-6
ENOUGH = 3e-3  # share of the light below which the orders to come are estimated


@dataclass(frozen=True)
class Behind:
    """What lies behind the contact, and how light spreads in it.

    Attributes
    ----------
    coarse
        The same on the cells that walks are counted on; there it is None.
    """

    coupling: Coupling
    passage: Passage
    spread: Spread
    bent: Bent  # on the cells that walks are counted on
    coarse: Behind | None

    @staticmethod
    def of(sensor: Sensor, coupling: Coupling, cells: int = GRID) -> Behind:
        """Behind this sensor's contact."""
        _, body = body_behind(sensor.skin, sensor.tissue)
        width, margin = sensor.guide.width_mm, MARGIN * cells // GRID
        wide = cells + 2 * margin
        first = passage(coupling, width, cells, margin)
        spread = spreader(body, coupling, width * wide / cells, wide)
        coarse = Behind.of(sensor, coupling, trace.CELLS) if cells > trace.CELLS else None
        curved = coarse.bent if coarse else bent(body, width, cells, margin, cells // 2)
        return Behind(coupling, first, spread, curved, coarse)


@dataclass(frozen=True)
class Ground:
    """The contact as the tissue's light meets it, on cells [iy, ix] of the guide's face.

    Attributes
    ----------
    fraction : (m, m)
        Real contact fraction of the deformed surface there; 0 beside the surface.
    meets : (m, m), single precision
        Share of the cell in which the surface lies.
    height_mm : (m, m)
        Of the surface, as of its nearest point where there is none.
    """

    fraction: Array
    meets: Singles
    height_mm: Array

    def coarser(self) -> Ground:
        """On the cells that walks are counted on."""
        return Ground(self.on_coarser(self.fraction), coarser(self.meets), coarser(self.height_mm))

    def on_coarser(self, values: Array) -> Array:
        """Means (..., trace.CELLS, trace.CELLS) of values (..., m, m) over the surface within those cells."""
        return np.asarray(coarser(values * self.meets) / np.maximum(coarser(self.meets), _LEAST_SHARE))


@dataclass(frozen=True)
class Light:
    """Light in the tissue and its whereabouts.

    Attributes
    ----------
    upward : (n_led, modes, trace.CELLS, trace.CELLS)
        Light that goes up inside the tissue towards the contact surface, V_i of `tissue`, W/mm².
    sinks : (n_led, len(trace.SINKS))
        W that end there; "tissue" is what the tissue keeps.
    trapped : (n_led,)
        W that come to the contact surface for the first time beyond the critical angle.
    landed : (n_led, layers, trace.CELLS, trace.CELLS), single precision
        Weighted irradiance of all light that was not gathered, W/mm², all orders together, as it was counted.
    fallen : (n_led, 5, housing.CELLS, housing.CELLS), or (n_led, 0) of a black one
        W that fell on the sides of the housing (`housing.Tally`).
    """

    upward: Array
    sinks: Array
    trapped: Array
    landed: Singles
    fallen: Array

    @property
    def traced(self) -> Singles:
        """`landed`, smooth: (n_led, layers, GRID, GRID)."""
        return even(self.landed, GRID // trace.CELLS)


def survey(scene: mi.Scene, sensor: Sensor) -> Ground:
    """Look at the deformed surface from below, cell by cell."""
    fraction, meets, height = (np.asarray(v).reshape(GRID, GRID) for v in glance(scene, sensor))
    if not meets.all():  # a rim that is drawn in
        near = distance_transform_edt(~meets, return_distances=False, return_indices=True)
        height = height[tuple(near)]
    return Ground(fraction.astype(np.float64), meets.astype(np.float32), height.astype(np.float64))


def glance(scene: mi.Scene, sensor: Sensor) -> tuple[mi.Float, mi.Bool, mi.Float]:
    """The same on the device, cell after cell: Dr.Jit differentiates it to the scene's surface."""
    width = sensor.guide.width_mm
    middles = (np.arange(GRID) + 0.5) / GRID * width - width / 2
    x, y = (floats(values) for values in np.meshgrid(middles, middles))
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    height = sensor.guide.under_contact_mm(0.5)
    si = meet(scene, mi.ShapePtr(contact), mi.Point3f(x, y, height), mi.Vector3f(0.0, 0.0, 1.0))
    meets = si.is_valid() & (si.shape == mi.ShapePtr(contact))
    fraction = dr.select(meets, contact.eval_attribute_1("vertex_contact_fraction", si, meets), 0.0)
    return fraction, meets, si.p.z


def transport(
    scene: mi.Scene,
    sensor: Sensor,
    table: Table,
    under: Under,
    straight: Singles,
    samples: int,
    seed: int,
    lit: Array | None = None,
) -> Light:
    """Follow the LEDs' light until it has ended.

    Mirrored light walks through the guide (`trace.walk`); what enters the tissue spreads there, and what
    comes back out walks again, order by order, from the cells that walks are counted on.

    Parameters
    ----------
    straight
        From `direct.direct`, (n_led, count, GRID, GRID), W/mm².
    samples
        Light paths per LED, more than half of them from the LED itself.
    seed
        Seed of every random choice; the result depends on nothing else, not even on the number of threads.
    lit
        `Under.upward` of the gathered light on those cells (`Under.coarser`), if it is known.
    """
    n_led = len(sensor.leds)
    under = under.coarser
    basis, behind = under.entrance.basis, under.behind
    flux = np.array([led.flux_W for led in sensor.leds])
    starts = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=(ORDERS + 1, 4))

    def walk(order: int, each: int, upward: Array | None) -> tuple[Singles, Array, Array, Array, Array]:
        index = dr.arange(mi.UInt32, n_led * each)
        number = index // mi.UInt32(dr.opaque(mi.UInt32, each))
        u = recurrence.evenly(recurrence.side_by_side(each, n_led), starts[order])
        if upward is None:
            legs = [first_leg(led) for led in sensor.leds]
            leg = dr.gather(mi.UInt32, numbers(legs), number)
            ray, amount, scale = trace.emit(sensor, number, u), dr.full(mi.Float, 1.0, n_led * each), flux
        else:
            ray, amount, _ = trace.re_emit(scene, sensor, table, behind.coupling, upward, number, u)
            scale = upward[:, 0].mean(axis=(1, 2)) * sensor.guide.width_mm**2
            amount /= dr.gather(mi.Float, floats(np.maximum(scale, 1e-30)), number)
            leg = mi.UInt32(trace.OTHER)
        begun = np.asarray(amount, dtype=np.float64).reshape(n_led, each).mean(axis=1)
        tally = housing.Tally(sensor) if sensor.housing.reflects else None
        parts = (scene, sensor, table, basis, number, ray, amount, leg, 16 * seed + order)
        found = trace.walk(*parts, tally=tally)
        area = (sensor.guide.width_mm / trace.CELLS) ** 2
        maps = (found.maps * (scale / each / area)[:, None, None, None]).astype(np.float32)
        sinks, trapped = found.sinks * (scale / each)[:, None], found.trapped * scale / each
        fallen = np.zeros((n_led, 0))
        if tally is not None:
            fallen = tally.collected() * (scale / each)[:, None, None, None]
        return maps, sinks, trapped, fallen, begun * scale

    plain = len(basis.columns)  # the maps that `Under.again` reads
    each = max(samples // 2, 1)
    maps, sinks, trapped, fell, _ = walk(0, each, None)
    landed, fallen = maps, fell
    newest = under.again(even(maps[:, :plain])) + (under.upward(coarser(straight)) if lit is None else lit)
    total = newest
    ratio = np.ones(n_led)
    for order in range(1, ORDERS + 1):
        before = newest[:, 0].sum(axis=(1, 2))
        if (before * ratio).sum() <= ENOUGH * total[:, 0].sum():
            break
        maps, more, _, fell, begun = walk(order, max(each >> min(2 * order, 6), 2), newest)
        sinks = sinks + more
        sinks[:, 0] -= begun
        newest = under.again(even(maps[:, :plain]))
        total, landed, fallen = total + newest, landed + maps, fallen + fell
        ratio = newest[:, 0].sum(axis=(1, 2)) / np.maximum(before, 1e-300)
    # each order is like the one before by now: the rest is a geometric series, or nothing behind black tissue
    ratio = np.clip(ratio, 0.0, 0.9) * (newest[:, 0].sum(axis=(1, 2)) > 0.0)
    rest = (ratio / (1.0 - ratio))[:, None, None, None]
    fallen = fallen + fell * rest.reshape(n_led, *(fell.ndim - 1) * (1,))
    return Light(total + newest * rest, sinks, trapped, landed + maps * rest.astype(np.float32), fallen)


def even(maps: Singles, factor: int = 1) -> NDArray[Any]:
    """Counted light (n_led, layers, m, m), smooth on cells so many times finer."""
    return np.stack(abreast(lambda number: smooth(maps[number], factor), len(maps)))


def coarser(maps: NDArray[Any]) -> NDArray[Any]:
    """Means over squares of the last two axes that are cells of walks."""
    return cells.coarser(maps, trace.CELLS)


def first_leg(led: Led) -> int:
    """Light from below belongs to no gathered family."""
    if led.side == "below":
        return trace.OTHER
    return trace.IN_AIR if led.coupling == "air" else trace.IN_GUIDE


@dataclass(frozen=True)
class Under:
    """The tissue under one contact.

    What has `landed` is weighted irradiance (n_led, layers, m, m), W/mm².
    """

    entrance: Entrance
    behind: Behind
    ground: Ground
    bed: Bed
    face: Face
    bend: Bend

    @staticmethod
    def at(basis: AngularBasis, behind: Behind, ground: Ground) -> Under:
        fraction = np.pad(ground.fraction, behind.passage.margin, constant_values=np.nan)
        entrance, face = Entrance.at(basis, ground.fraction), behind.passage.face(fraction)
        bed, inside = behind.spread.on(fraction), slice(behind.passage.margin, -behind.passage.margin)
        thrown = behind.spread.free + float(bed.excess[inside, inside].mean())
        bend = behind.bent.on(ground.height_mm, thrown)
        return Under(entrance, behind, ground, bed, face, bend)

    @cached_property
    def coarser(self) -> Under:
        """On the cells that walks are counted on."""
        return Under.coarse(self.entrance.basis, self.behind, self.ground)

    @staticmethod
    def coarse(basis: AngularBasis, behind: Behind, ground: Ground) -> Under:
        """That under a contact on cells of maps, on the cells that walks are counted on."""
        assert behind.coarse is not None
        return Under.at(basis, behind.coarse, ground.coarser())

    def again(self, landed: NDArray[np.floating]) -> Array:
        """Light that goes up in the tissue, (n_led, modes, m, m), as if it had entered evenly from all
        sides: enough for light that has been in the tissue before."""

        def one(number: int) -> Array:
            some = landed[number : number + 1] * self.ground.meets
            return self._upward(transmitted(self.entrance, some, self._modes))

        return np.concatenate(abreast(one, len(landed)))

    def upward(self, landed: NDArray[np.floating]) -> Array:
        """The same, ahead of where it went in."""

        def one(number: int) -> Array:
            entering = transmitted(self.entrance, landed[number : number + 1] * self.ground.meets)
            straight = self.behind.passage.enter(entering, glimpse=False)[0]
            return self._upward(entering[:, : self._modes], straight)

        return np.concatenate(abreast(one, len(landed)))

    def seen(self, landed: NDArray[np.floating]) -> Seen:
        """What of all light goes to the camera, with the margin.

        The traced part may be that of another press: what an inclusion changes in it is small. Light that has
        walked far through the guide tells of the whole press, and is 5 % of what enters the contact where
        LEDs shine in from air.
        """
        passage = self.behind.passage

        def one(number: int) -> Seen:
            entering = transmitted(self.entrance, landed[number : number + 1] * self.ground.meets)
            straight, glimpse = passage.enter(entering)
            source = self.wide(entering[:, : self._modes], straight)
            upward = self.bed.solve(source, 1e-6)
            further, again = passage.thrown_back(upward, self.face)
            more = np.zeros_like(upward)
            more[:, 0] = further
            more = self.bed.solve(more, 1e-3)
            last = passage.last_thrown_back(more, self.face)
            seen = passage.towards_camera(glimpse, again, last)
            return self.bent(seen, self.factor(source, upward))

        return Seen.of(abreast(one, len(landed)))

    def factor(self, source: Array, upward: Array) -> Array:
        """Light under this face over that under a flat one, (1, 1, m, m), of what goes in and comes up there,
        (n, modes, w, w) with the margin; of the first alone, where derivatives follow."""
        return self.bend.factor(source[:1, 0], upward[:1, 0])[:, None]

    def bent(self, seen: Seen, factor: Array) -> Seen:
        """Light under a flat face as it leaves this one, in place."""
        seen.maps[..., self.inside, self.inside] *= factor
        return seen

    def glanced(self, upward: Array) -> Seen:
        """About what goes to the camera of all LEDs together, from `Light.upward`: enough to tell noise."""
        steep = self.behind.coupling.lobes[:, -1]
        maps = np.pad(np.einsum("i,niyx->yx", steep, upward), self.margin)[None, None]
        return Seen(maps, np.zeros(1), np.zeros(1))

    def wide(self, entering: NDArray[np.floating], straight: Array | None = None) -> Array:
        """What goes in, with the margin; of mode 0 as it is ahead of where it went in, if that is known."""
        beside = (self.margin, self.margin)
        found = np.pad(entering.astype(np.float64), ((0, 0), (0, 0), beside, beside))
        if straight is not None:
            found[:, 0] = straight
        return found

    def _upward(self, entering: Singles, straight: Array | None = None) -> Array:
        """V under this face, without the margin."""
        source = self.wide(entering, straight)
        found = self.bed.solve(source, 1e-3)
        return found[..., self.inside, self.inside] * self.factor(source, found)

    @property
    def inside(self) -> slice:
        """The guide's face on cells with the margin, along either axis."""
        return slice(self.margin, -self.margin)

    @property
    def margin(self) -> int:
        """Cells beside the guide's face, on each side."""
        return self.behind.passage.margin

    @property
    def _modes(self) -> int:
        return len(self.behind.coupling.lobes)
