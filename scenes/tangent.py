"""Pictures beside the picture of one press: how light answers small changes of the contact surface.

Light that comes to the contact straight or by the glass's lower face (`direct`) depends at every target on
the surface's height and slopes there and nowhere else. So it is gathered on one relief, together with its
slopes to height, x-slope and y-slope by central differences; presses near by then cost no gathering. Light
that walked farther is that of the middle press (`Renderer.render(traced=...)`). Contact, tissue and the
camera's view are computed anew for every picture. So differences carry no noise of their own.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from . import build, direct, gather, housing, transport
from .render import PATHS_PER_LED, Renderer
from .surface import OpticalSurface
from .view import PixelRays

Array = NDArray[np.float64]

_HEIGHT_MM = 0.05  # of the differences: far above rounding, far below an LED's size
_SLOPE = 0.01
_ASIDE_MM = (1.3e-4, 0.7e-4, 0.0)
"""Of pixels, along neither the sides nor the diagonals of the surface's mesh. With an odd number of rows or
columns the middle ones' rays lie in a line of it: they slip between its triangles on one press and not on the
next, where `gather.meet` looks for them a hair aside, and differences tell of that, not of the press."""


@dataclass(frozen=True)
class Straight:
    """Gathered light near one relief.

    Attributes
    ----------
    relief : (3, m, m), of `direct.relief`.
    light : (n_led, layers, m, m) W/mm² on it.
    slopes : (3, n_led, layers, m, m) W/mm² per mm of height and per unit of slope along x and y.
    """

    relief: Array
    light: Array
    slopes: NDArray[np.float32]

    def on(self, relief: Array) -> Array:
        """Light on a relief near by, (n_led, layers, m, m) W/mm², weighted: of either sign."""
        found = self.light.copy()
        for slope, moved in zip(self.slopes, relief - self.relief, strict=True):
            found += slope * moved
        return found


def gathered(renderer: Renderer, shape: OpticalSurface) -> Straight:
    """Gather light on a press and near it. Raises `NotModelled` where the housing reflects."""
    housing.refuse(renderer.sensor, "pictures beside the picture of one press")
    sensor, basis = renderer.sensor, renderer.basis
    relief = direct.relief(sensor, shape)
    slopes = []
    for number, step in enumerate((_HEIGHT_MM, _SLOPE, _SLOPE)):
        ends = []
        for sign in (1.0, -1.0):
            moved = relief.copy()
            moved[number] += sign * step
            ends.append(direct.on(sensor, basis, moved))
        slopes.append(((ends[0] - ends[1]) / (2.0 * step)).astype(np.float32))
    return Straight(relief, direct.on(sensor, basis, relief).astype(np.float64), np.stack(slopes))


def traced(
    renderer: Renderer, shape: OpticalSurface, straight: Straight, seed: int, quality: str, samples: int = 0
) -> Array:
    """Light on a press that is not gathered, (n_led, layers, m, m) W/mm²; ``samples`` paths per LED, by
    default the quality's."""
    renderer.check_leds(shape)
    build.put_surface(renderer.scene, renderer.sensor, shape)
    ground = transport.survey(renderer.scene, renderer.sensor)
    sensor, basis, behind = renderer.sensor, renderer.basis, renderer.behind
    light = straight.on(direct.relief(sensor, shape))
    under = transport.Under.at(basis, behind, ground)
    parts = (renderer.scene, sensor, renderer.table, under, light.astype(np.float32))
    with threadpool_limits(1):
        found = transport.transport(*parts, samples or PATHS_PER_LED[quality], seed)
    return found.traced.astype(np.float64)


def picture(renderer: Renderer, shape: OpticalSurface, straight: Straight, traced: Array) -> Array:
    """Radiance at the lens, (n_led, rows, columns) W m⁻² sr⁻¹, of a press near that of the traced light."""
    renderer.check_leds(shape)
    sensor, basis, behind = renderer.sensor, renderer.basis, renderer.behind
    build.put_surface(renderer.scene, sensor, shape)
    sight = gather.look(renderer.scene, sensor, renderer.table, behind.coupling, _beside(renderer.rays))
    ground = transport.survey(renderer.scene, sensor)
    light = straight.on(direct.relief(sensor, shape))
    with threadpool_limits(1):
        seen = transport.Under.at(basis, behind, ground).seen(light + traced)
    return np.asarray(gather.picture(sight, seen, transport.MARGIN), np.float64)


@lru_cache(maxsize=8)  # one of a renderer, as on the device
def _beside(rays: PixelRays) -> PixelRays:
    return replace(rays, origin_mm=rays.origin_mm + np.array(_ASIDE_MM))
