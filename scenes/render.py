"""Radiance pictures of a pressed surface: one scene per sensor, one layer per LED, three qualities."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from . import backend, surface, view
from .sensor import NotModelled, Sensor

if TYPE_CHECKING:
    import mitsuba as mi
    import pyvista as pv

    from .bsdf import Table
    from .gather import Sight
    from .irradiance import AngularBasis
    from .traced import TracedLight
    from .transport import Behind

    _Tables = tuple[Behind, AngularBasis, mi.TensorXf, Table]

Array = NDArray[np.float64]
Quality = Literal["preview", "standard", "reference"]

PATHS_PER_LED = {"preview": 2**17, "standard": 2**20, "reference": 2**24}
"""Light paths that the qualities spend on each LED."""

COLOUR = (
    "inclusion: received optics of its own; allowed none but in pictures of reference quality, whose light "
    "alone is followed below the surface"
)
"""Why other light refuses an inclusion of other colour."""

_PATHS_PER_PASS = 2**21  # of all LEDs; independent passes bound the memory and tell the noise
_LEAST_PASSES = 2
MOST_PASSES = 2**14  # so that seeds of passes do not meet


@dataclass(frozen=True)
class Rendering:
    """What the camera's lens receives, and what it looks at.

    Attributes
    ----------
    radiance : (n_led, rows, columns)
        Radiance at the lens from each LED, W m⁻² sr⁻¹.
    position_mm : (rows, columns, 2)
        Point of the deformed contact surface that the middle of each pixel sees, x and y, mm.
    surface : what is looked at.
    noise_percent : float
        Standard error of the radiance of all LEDs together from Monte Carlo: root mean square over pixels, in
        per cent of the mean; from the spread of independent passes (of gathered qualities by the light's main
        way through the tissue alone, and without LEDs in sight: some 5 % low, while one figure of two passes
        scatters by 12 %; `tests/test_noise.py`).
    seconds : float
        Wall-clock time.
    from_housing_percent : float
        Of all this radiance, what is the inside of a housing that reflects, mirrored in glass and contact.
    sinks, trapped : (n_led, len(trace.SINKS)) and (n_led,), or None
        W that end in each sink, and W trapped at their first contact with the surface (see
        `transport.Light`); None for the reference quality.
    traced : tuple of (n_led, layers, m, m), one for each band, or None
        Light on the contact surface that was not gathered; `Renderer.render` takes it back.
    """

    radiance: NDArray[np.float32]
    position_mm: NDArray[np.float32]
    surface: surface.OpticalSurface
    noise_percent: float
    seconds: float
    from_housing_percent: float = 0.0
    sinks: Array | None = None
    trapped: Array | None = None
    traced: tuple[NDArray[np.floating], ...] | None = None

    @property
    def pressure(self) -> NDArray[np.float32]:
        """Contact pressure at each pixel's point, (rows, columns) kPa."""
        return self._fields[0]

    @property
    def displacement_z(self) -> NDArray[np.float32]:
        """Displacement at each pixel's point, (rows, columns) mm, +z into the specimen."""
        return self._fields[1]

    @cached_property
    def _fields(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        return surface.at(self.surface, self.position_mm)


class Renderer:
    """A sensor's scene, built once; each `render` moves its contact surface in place."""

    def __init__(
        self, sensor: Sensor, device: str = "auto", *, coloured: bool = False, like: Renderer | None = None
    ) -> None:
        """Load the scene on `device` ("auto", "cpu" or "cuda"; see `backend.use`).

        With `coloured` the sensor may have an `inclusion` of other colour, whose `place` every picture is
        then told; without, it is refused, so that no picture leaves it out unnoticed. What is behind the
        contact is taken from a renderer ``like`` this one, where that is the same.
        """
        if sensor.inclusion is not None and not coloured:
            raise NotModelled(COLOUR)
        backend.use(device)
        # only now: Mitsuba's classes bind to the variant that is active when they are defined
        from . import build

        self.sensor = sensor
        self.rays = view.pixel_rays(sensor)
        same = like is not None and _contact(like.sensor) == _contact(sensor)
        self.tables: _Tables = like.tables if like is not None and same else _tables(sensor)
        self.behind, self.basis, self.packed, self.table = self.tables
        self.scene = build.load_scene(sensor, self.packed)

    @backend.flushing()
    def render(
        self,
        pressed: pv.PolyData | surface.OpticalSurface,
        *,
        field: str = "pressure",
        quality: Quality = "standard",
        seed: int = 0,
        samples: int | None = None,
        noise: float | None = None,
        traced: tuple[Array | TracedLight, ...] | None = None,
        coarse: bool = False,
        place: tuple[Array, Array] | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Rendering:
        """Return the radiance picture of a pressed contact surface.

        Parameters
        ----------
        pressed
            Contact surface: points (n, 3) mm undeformed, with point arrays `displacement` and `pressure`; or
            what `surface.resample` makes of it.
        field
            "pressure", or "pressure_0" for the press without inclusion (and `displacement_0` with it).
        quality
            "preview" and "standard" trace light from the LEDs and spread it in the tissue on a grid;
            "reference" follows every ray through guide and tissue: minutes.
        seed
            Seed of the light. The same seed gives the same bytes, whatever the number of threads.
        samples
            Light paths per LED, instead of the quality's own number.
        noise
            Go on, pass by pass, until `noise_percent` is at most this.
        traced
            `Rendering.traced` of a press like this one, of the same sensor: nothing is traced then, only the
            gathered light, the contact, the tissue and the camera's view are computed anew. No noise of its
            own, so that differences of pictures are smooth, and up to 6 % off where LEDs shine in from air
            (`tests/test_forward.py`), 10 % where they are embedded. Or light that was learned from many
            presses (`traced.TracedLight`), which follows the press.
        coarse
            With `traced` light: maps of half as many cells a side, in half of the time. What pictures
            change by from one press to another like it stays right (`tests/test_rendered.py`).
        place
            Centre (3,) and axes (3, 3), mm, of the deformed inclusion (points centre + axes @ u, |u| <= 1) in
            the sensor's frame; None for plain tissue. Only optics of its own, `Sensor.inclusion`, show it.
        progress
            Called with the finished share, 0 to 1.
        """
        if quality not in PATHS_PER_LED:
            raise ValueError(f"quality: received {quality!r}; allowed: 'preview', 'standard', 'reference'")
        if noise is not None and not noise > 0.0:
            raise ValueError(f"noise: received {noise:g} %; allowed: more than 0")
        if self.sensor.inclusion is not None and (quality != "reference" or traced is not None):
            raise NotModelled(COLOUR)
        from . import build, gather, housing

        if coarse and traced is None:
            raise ValueError("coarse: received True without traced light; allowed with it")
        if traced is not None:
            housing.refuse(self.sensor, "light that was learned, or is that of another press")

        start = time.perf_counter()
        shape = pressed
        if not isinstance(shape, surface.OpticalSurface):
            shape = surface.resample(shape, self.sensor.guide.width_mm, suffix=field.removeprefix("pressure"))
        build.put_surface(self.scene, self.sensor, shape)
        sight = gather.look(self.scene, self.sensor, self.table, self.behind.coupling, self.rays)
        samples = samples or PATHS_PER_LED[quality]
        count, each = passes(samples, len(self.sensor.leds))
        effort = _Effort(count, noise, progress or (lambda done: None))
        if quality == "reference" and traced is None:
            found = self._followed(sight, each, seed, effort, place)
        else:
            self.check_leds(shape)
            known = None if traced is None else traced[0]
            found = self._gathered(shape, sight, each, seed, effort, known, coarse)
        return Rendering(
            # the smoothing kernel has negative sides: next to an edge of light they may undershoot the dark
            np.maximum(found.radiance, 0.0).astype(np.float32),
            sight.position_mm,
            shape,
            found.noise_percent,
            time.perf_counter() - start,
            found.from_housing_percent,
            found.sinks,
            found.trapped,
            None if found.traced is None else (found.traced,),
        )

    def check_leds(self, shape: surface.OpticalSurface) -> None:
        """Refuse LEDs that the deformed rim would shade: the gathered light knows no shade."""
        lowest = float((shape.rest_mm + shape.displacement_mm[..., 2]).min())
        for number, led in enumerate(self.sensor.leds):
            if led.side != "below" and led.z_mm + led.diameter_mm / 2 > lowest:
                allowed = (
                    f"at most {lowest - led.diameter_mm / 2:.3g} mm under this press, below the pressed rim"
                )
                raise NotModelled(f"leds.{number}.z_mm: received {led.z_mm:g}; allowed {allowed}")

    def _gathered(
        self,
        shape: surface.OpticalSurface,
        sight: Sight,
        samples: int,
        seed: int,
        effort: _Effort,
        known: Array | TracedLight | None,
        coarse: bool,
    ) -> _Found:
        """Gathered light, and traced light from independent passes, or as it is `known`."""
        from . import direct, gather, trace, transport

        ground = transport.survey(self.scene, self.sensor)
        if coarse and known is not None:
            straight = direct.direct(self.sensor, self.basis, shape, trace.CELLS)
            if isinstance(known, np.ndarray):
                walked = transport.coarser(known)
            else:
                walked = known.at(self.sensor, shape, ground.fraction, trace.CELLS)
            with threadpool_limits(1):
                under = transport.Under.coarse(self.basis, self.behind, ground)
                seen = under.seen(straight + walked.astype(np.float32, copy=False))
            effort.tell(1.0)
            return _Found(gather.picture(sight, seen, under.margin), 0.0)
        straight = direct.direct(self.sensor, self.basis, shape)
        fallen, sums = np.zeros(0), list[Any]()
        with threadpool_limits(1):
            under = transport.Under.at(self.basis, self.behind, ground)
            lit = under.coarser.upward(transport.coarser(straight)) if known is None else None
        parts = (self.scene, self.sensor, self.table, under, straight, samples)

        def glances() -> Iterator[NDArray[np.floating]]:
            for number in range(MOST_PASSES):
                with threadpool_limits(1):
                    light = transport.transport(*parts, seed * MOST_PASSES + number, lit)
                    seen = under.coarser.glanced(light.upward)
                found = (light.landed, light.sinks, light.trapped, light.fallen)
                sums[:] = found if number == 0 else [a + b for a, b in zip(sums, found, strict=True)]
                yield gather.picture(sight, seen, under.coarser.margin, lamps=False)[0]

        if known is None:
            count, noise = effort.spend(glances())
            landed, sinks, trapped, fallen = (total / count for total in sums)
            with threadpool_limits(1):
                traced: NDArray[np.floating] = transport.even(landed, transport.GRID // trace.CELLS)
        elif isinstance(known, np.ndarray):
            noise, traced, sinks, trapped = 0.0, known, None, None
        else:
            noise, traced, sinks, trapped = 0.0, known.at(self.sensor, shape, ground.fraction), None, None
        with threadpool_limits(1):
            seen = under.seen(straight + traced.astype(np.float32, copy=False))
        effort.tell(1.0)
        picture = gather.picture(sight, seen, under.margin)
        share = self._add_housing(picture, sight, fallen) if self.sensor.housing.reflects else 0.0
        return _Found(picture, noise, share, sinks, trapped, traced)

    def _add_housing(self, picture: NDArray[np.floating], sight: Sight, fallen: Array) -> float:
        """Add what is seen of the housing to the picture (n_led, rows, columns); its share, per cent."""
        from . import housing

        glow = 1e6 * housing.seen(self.sensor, sight.mirrors, fallen).reshape(picture.shape)
        picture += glow
        return float(100.0 * glow.sum() / max(picture.sum(), 1e-30))

    def _followed(
        self,
        sight: Sight,
        samples: int,
        seed: int,
        effort: _Effort,
        place: tuple[Array, Array] | None,
    ) -> _Found:
        """Every ray followed, in independent passes."""
        from . import exact, housing, transport

        tally = housing.Tally(self.sensor) if self.sensor.housing.reflects else None
        flux = np.array([led.flux_W for led in self.sensor.leds])
        ground = transport.survey(self.scene, self.sensor)
        parts = (self.scene, self.sensor, self.table, self.rays, ground, samples)
        total: Array | float = 0.0

        def passes() -> Iterator[Array]:
            nonlocal total
            for number in range(MOST_PASSES):
                seen = exact.exact(*parts, seed * MOST_PASSES + number, place=place, tally=tally)
                layers = 1e6 * (np.einsum("snyx,syx->nyx", seen, sight.windows) + sight.lamps)
                total = total + layers
                yield layers.sum(axis=0)

        count, noise = effort.spend(passes())
        picture, share = np.asarray(total) / count, 0.0
        if tally is not None:
            fallen = tally.collected() * (flux / samples / count)[:, None, None, None]
            share = self._add_housing(picture, sight, fallen)
        return _Found(picture, noise, share)


def _tables(sensor: Sensor) -> _Tables:
    """What is behind the contact, how it depends on angles, the contact's optics, the same on the device."""
    from . import build, transport
    from .bsdf import Table
    from .irradiance import angular_basis

    with threadpool_limits(1):  # linear algebra on several threads sums in another order
        optics = build.optics_of(sensor)
        coupling = build.coupling_of(sensor, optics)
        behind = transport.Behind.of(sensor, coupling)
        basis = angular_basis(optics, coupling)
    packed = Table.pack(optics, coupling)
    return behind, basis, packed, Table(packed)


def _contact(sensor: Sensor) -> tuple[object, ...]:
    """All that decides what is behind the contact and how light enters: not how much of it is real."""
    return sensor.guide, replace(sensor.skin, rms_slope=1.0, kappa=1.0), sensor.tissue, sensor.wavelength_nm


def passes(samples: int, n_led: int) -> tuple[int, int]:
    """Number of independent passes that so many light paths per LED are followed in, and paths in each."""
    count = max(_LEAST_PASSES, -(-samples // max(_PATHS_PER_PASS // n_led, 1)))
    return count, max(-(-samples // count), 2)


@dataclass(frozen=True)
class _Found:
    """What is in a `Rendering`."""

    radiance: NDArray[np.floating]
    noise_percent: float
    from_housing_percent: float = 0.0
    sinks: Array | None = None
    trapped: Array | None = None
    traced: NDArray[np.floating] | None = None


@dataclass(frozen=True)
class _Effort:
    """So many passes, or as many as the noise asks for, per cent; `tell` hears the finished share."""

    passes: int
    noise: float | None
    tell: Callable[[float], None]

    def spend(self, pictures: Iterator[NDArray[np.floating]]) -> tuple[int, float]:
        """Number of pictures (rows, columns) that were taken, and the noise of their mean in per cent."""
        whole: Array | float = 0.0
        squares: Array | float = 0.0
        for number, picture in enumerate(pictures, start=1):
            bright = np.asarray(picture, dtype=np.float64)
            whole, squares = whole + bright, squares + bright**2
            if number < min(self.passes, _LEAST_PASSES):
                continue
            variance = np.maximum(squares - whole**2 / number, 0.0) / max(number - 1, 1) / number
            found = float(100.0 * np.sqrt(variance.mean()) / max(np.mean(whole) / number, 1e-30))
            left = self.passes - number
            if self.noise is not None:
                left = int(np.ceil(number * ((found / self.noise) ** 2 - 1.0)))
            self.tell(number / (number + max(left, 0)))
            if left <= 0:
                break
        return number, found
