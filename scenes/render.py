"""Radiance pictures of a pressed surface: one scene per sensor, one layer per LED, three qualities."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from . import backend, spread, surface, tissue, view
from .sensor import NotModelled, Sensor

if TYPE_CHECKING:
    import pyvista as pv

    from .gather import Sight

Quality = Literal["preview", "standard", "reference"]

PATHS_PER_LED = {"preview": 2**17, "standard": 2**22}
"""Light paths that the qualities spend on each LED; "reference" has its own."""

_PATHS_PER_PASS = 2**20  # independent passes bound the memory and tell the noise
_MOST_PASSES = 4096  # so that seeds of passes do not meet

REFERENCE_SAMPLES = 2**24
"""Light paths per LED of a reference picture."""


@dataclass(frozen=True)
class Rendering:
    """What the camera's lens receives, and what it looks at.

    Attributes
    ----------
    radiance : (n_led, rows, columns)
        Radiance at the lens from each LED, W m⁻² sr⁻¹.
    position_mm : (rows, columns, 2)
        Point of the deformed contact surface that the middle of each pixel sees, x and y, mm.
    pressure, displacement_z : (rows, columns)
        Contact pressure, kPa, and displacement, mm (+z into the specimen), at that point.
    noise_percent : float
        Standard error of the radiance of all LEDs together from Monte Carlo: root mean square over pixels, in
        per cent of the mean; from the spread of independent passes (traced) or of the samples (reference).
    seconds : float
        Wall-clock time.
    """

    radiance: NDArray[np.float32]
    position_mm: NDArray[np.float32]
    pressure: NDArray[np.float32]
    displacement_z: NDArray[np.float32]
    noise_percent: float
    seconds: float


class Renderer:
    """A sensor's scene, built once; each `render` moves its contact surface in place."""

    def __init__(self, sensor: Sensor, device: str = "auto") -> None:
        """Load the scene on `device` ("auto", "cpu" or "cuda"; see `backend.use`)."""
        backend.use(device)
        # only now: Mitsuba's classes bind to the variant that is active when they are defined
        from . import build, transport
        from .bsdf import Table
        from .irradiance import angular_basis

        self.sensor = sensor
        self.rays = view.pixel_rays(sensor)
        guide = sensor.guide
        with threadpool_limits(1):  # linear algebra on several threads sums in another order
            optics = build.optics_of(sensor)
            index, body = tissue.body_behind(sensor.skin, sensor.tissue)
            coupling = tissue.couple(optics, body, guide.refractive_index, index)
            spreads = spread.spreader(body, coupling, guide.width_mm, transport.GRID)
            self.basis = angular_basis(optics, coupling.lobes)
        self.behind = transport.Behind(coupling, spreads)
        self.table = Table(Table.pack(optics, coupling))
        self.scene = build.load_scene(sensor, Table.pack(optics, coupling))

    def render(
        self,
        pressed: pv.PolyData,
        *,
        field: str = "pressure",
        quality: Quality = "standard",
        seed: int = 0,
        samples: int | None = None,
        progress: Callable[[float], None] | None = None,
    ) -> Rendering:
        """Return the radiance picture of a pressed contact surface.

        Parameters
        ----------
        pressed
            Contact surface: points (n, 3) mm undeformed, with point arrays `displacement` and `pressure`.
        field
            "pressure", or "pressure_0" for the press without inclusion (and `displacement_0` with it).
        quality
            "preview" and "standard" trace light from the LEDs and spread it in the tissue on a grid;
            "reference" follows every ray through guide and tissue: minutes.
        seed
            Seed of the light. The same seed gives the same bytes, whatever the number of threads.
        samples
            Light paths per LED, instead of the quality's own number.
        progress
            Called with the finished share, 0 to 1.
        """
        if quality not in (*PATHS_PER_LED, "reference"):
            raise ValueError(f"quality: received {quality!r}; allowed: 'preview', 'standard', 'reference'")
        from . import build, gather

        start = time.perf_counter()
        tell = progress or (lambda done: None)
        shape = surface.resample(pressed, self.sensor.guide.width_mm, suffix=field.removeprefix("pressure"))
        build.put_surface(self.scene, self.sensor, shape)
        sight = gather.look(self.scene, self.sensor, self.table, self.behind.coupling, self.rays)
        if quality == "reference":
            radiance, noise = self._reference(sight, samples or REFERENCE_SAMPLES, seed, tell)
        else:
            self._check_leds(shape)
            radiance, noise = self._traced(shape, sight, samples or PATHS_PER_LED[quality], seed, tell)
        pressure, displacement_z = surface.at(shape, sight.position_mm)
        return Rendering(
            radiance, sight.position_mm, pressure, displacement_z, noise, time.perf_counter() - start
        )

    def _check_leds(self, shape: surface.OpticalSurface) -> None:
        """Refuse LEDs that the deformed rim would shade: the gathered light knows no shade."""
        lowest = float((shape.rest_mm + shape.displacement_mm[..., 2]).min())
        for number, led in enumerate(self.sensor.leds):
            if led.side != "below" and led.z_mm + led.diameter_mm / 2 > lowest:
                allowed = (
                    f"at most {lowest - led.diameter_mm / 2:.3g} mm under this press, below the pressed rim"
                )
                raise NotModelled(f"leds.{number}.z_mm: received {led.z_mm:g}; allowed {allowed}")

    def _traced(
        self,
        shape: surface.OpticalSurface,
        sight: Sight,
        samples: int,
        seed: int,
        tell: Callable[[float], None],
    ) -> tuple[NDArray[np.float32], float]:
        from . import direct, gather, transport

        straight = direct.direct(self.sensor, self.basis, shape)
        ground = transport.survey(self.scene, self.sensor)
        passes = max(2, -(-samples // _PATHS_PER_PASS))
        runs = []
        for number in range(passes):
            with threadpool_limits(1):
                light = transport.transport(
                    self.scene,
                    self.sensor,
                    self.table,
                    self.basis,
                    self.behind,
                    ground,
                    straight,
                    max(samples // passes, 2),
                    seed * _MOST_PASSES + number,
                )
            runs.append(gather.picture(sight, light.upward))
            tell((number + 1) / passes)
        # the smoothing kernel has negative sides: next to an edge of light they may undershoot the dark
        radiance = np.maximum(np.mean(runs, axis=0, dtype=np.float64), 0.0)
        totals = np.sum(runs, axis=1, dtype=np.float64)
        spread = np.std(totals, axis=0, ddof=1) / np.sqrt(passes)
        relative = np.sqrt(np.mean(spread**2)) / max(np.mean(totals), 1e-30)
        return radiance.astype(np.float32), float(100.0 * relative)

    def _reference(
        self, sight: Sight, samples: int, seed: int, tell: Callable[[float], None]
    ) -> tuple[NDArray[np.float32], float]:
        from . import exact, transport

        ground = transport.survey(self.scene, self.sensor)
        each = max(_PATHS_PER_PASS // len(self.sensor.leds), 1)
        passes = max(2, -(-samples // each))
        total, squares = None, None
        for number in range(passes):
            seen = exact.exact(
                self.scene,
                self.sensor,
                self.table,
                self.rays,
                ground.fraction,
                -(-samples // passes),
                seed * _MOST_PASSES + number,
            )
            layers = 1e6 * (np.einsum("snyx,syx->nyx", seen, sight.windows) + sight.lamps)
            whole = layers.sum(axis=0)
            total = layers if total is None else total + layers
            squares = whole**2 if squares is None else squares + whole**2
            tell((number + 1) / passes)
        assert total is not None and squares is not None
        mean = total / passes
        whole = mean.sum(axis=0)
        spread2 = np.maximum(squares / passes - whole**2, 0.0) / (passes - 1)
        return mean.astype(np.float32), float(100.0 * np.sqrt(spread2.mean()) / max(whole.mean(), 1e-30))
