"""The reference picture's derivatives: how light that is followed ray by ray answers a small change.

What changes is told apart. What the contact is at each point in space, the paths' scores answer (`exact`,
`wander.Spots`): nothing is followed twice, and no two paths part ways at a choice. Where the surface lies
bends the light's ways a little; that part, a few per cent, is taken from the smooth light of `tangent`,
walked anew on the moved surface: followed ray by ray it is 12 % weaker (`tests/test_scored.py`).

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from . import build, exact, gather, tangent, transport
from .render import Renderer
from .surface import OpticalSurface

Array = NDArray[np.float64]

_MOVED_MM = 0.1  # largest move of the surface: far above single precision, far below the guide's thickness
_LITTLE = 1e-3  # of the largest move, of which nobody asks


@dataclass(frozen=True)
class Slope:
    """How an unknown changes a contact surface, per unit: displacement (n, n, 3) in mm and pressure (n, n) in
    kPa of the surface's points; ``step`` is a small difference of the unknown."""

    displacement_mm: NDArray[np.floating]
    pressure_kPa: NDArray[np.floating]
    step: float


def in_place(shape: OpticalSurface, slope: Slope) -> OpticalSurface:
    """The surface itself, under the pressure that is found in its place one step beside."""
    change = slope.pressure_kPa - _carried(shape, slope.displacement_mm)
    return replace(shape, pressure_kPa=shape.pressure_kPa + slope.step * change)


def moved_along(shape: OpticalSurface, move_mm: NDArray[np.floating]) -> OpticalSurface:
    """The surface moved, every point in space under the pressure that was found there."""
    pressure = shape.pressure_kPa + _carried(shape, move_mm)
    return replace(shape, displacement_mm=shape.displacement_mm + move_mm, pressure_kPa=pressure)


def scored(
    renderer: Renderer, shape: OpticalSurface, slopes: Sequence[Slope], samples: int, seed: int
) -> tuple[Array, Array]:
    """Return the reference picture and what changed contact makes of it.

    Parameters
    ----------
    slopes
        Of q unknowns.
    samples
        Light paths per LED.

    Returns
    -------
    (n_led, rows, columns) and (q, n_led, rows, columns)
        Radiance at the lens, W m⁻² sr⁻¹, and its derivative per unit of each unknown.
    """
    parts = renderer.scene, renderer.sensor, renderer.table
    looks = [_look(renderer, in_place(shape, one)) for one in slopes]
    middle = _look(renderer, shape)
    by_fraction, by_windows, by_lamps = (
        np.stack([(one[k] - middle[k]) / slope.step for one, slope in zip(looks, slopes, strict=True)])
        for k in range(3)
    )
    _, windows, lamps = middle
    ground = transport.survey(renderer.scene, renderer.sensor)
    seen = exact.exact(*parts, renderer.rays, ground, samples, seed, slopes=by_fraction)
    picture = np.einsum("snyx,syx->nyx", seen[0], windows) + lamps
    answers = np.einsum("qsnyx,syx->qnyx", seen[1:], windows)
    answers += np.einsum("snyx,qsyx->qnyx", seen[0], by_windows) + by_lamps
    return 1e6 * picture, 1e6 * answers


def moved(
    renderer: Renderer,
    shape: OpticalSurface,
    straight: tangent.Straight,
    slopes: Sequence[Slope],
    samples: int,
    seed: int,
) -> Array:
    """Return what the surface's moves make of the picture, (q, n_led, rows, columns) W m⁻² sr⁻¹ per unit.

    `straight` is `tangent.gathered` on the surface; other arguments as of `scored`. Unknowns move the surface
    much alike: light is walked along the few moves of which all consist, so that where unknowns hide each
    other the noise of the walks goes, too.
    """
    largest = np.array([np.abs(one.displacement_mm).max() for one in slopes])
    moves = np.stack([np.asarray(one.displacement_mm, np.float64) for one in slopes])
    moves /= np.where(largest > 0.0, largest, 1.0)[:, None, None, None]
    share, size, pattern = np.linalg.svd(moves.reshape(len(slopes), -1), full_matrices=False)
    peak = np.abs(pattern).max(axis=1)

    def seen(there: OpticalSurface) -> Array:
        walked = tangent.traced(renderer, there, straight, seed, "standard", samples)
        return tangent.picture(renderer, there, straight, walked)

    picture = seen(shape)
    found = np.zeros((len(slopes), *picture.shape))
    for number in np.flatnonzero(size * peak > _LITTLE):
        move = _MOVED_MM / peak[number] * pattern[number].reshape(moves.shape[1:])
        answer = (seen(moved_along(shape, move)) - picture) * (peak[number] / _MOVED_MM)
        found += (largest * share[:, number] * size[number])[:, None, None, None] * answer
    return found


def _look(renderer: Renderer, there: OpticalSurface) -> tuple[Array, Array, Array]:
    """Contact fraction, windows and lamps; the surface stays in the scene."""
    parts = renderer.scene, renderer.sensor
    build.put_surface(*parts, there)
    sight = gather.look(*parts, renderer.table, renderer.behind.coupling, renderer.rays)
    fraction = transport.survey(*parts).fraction
    return fraction, sight.windows.astype(np.float64), sight.lamps.astype(np.float64)


def _carried(shape: OpticalSurface, move_mm: NDArray[np.floating]) -> Array:
    """Pressure that a point comes into when it moves along, (n, n) kPa: slopes over places in space are
    those over the surface's points through the inverse of what the displacement makes of these."""
    stretch = np.eye(2) + _slopes(shape.displacement_mm[..., :2], shape.nodes_mm)
    by_point = _slopes(shape.pressure_kPa, shape.nodes_mm)[..., None]
    slope = np.linalg.solve(np.swapaxes(stretch, -1, -2), by_point)[..., 0]
    return np.asarray(np.einsum("yxk,yxk->yx", slope, move_mm[..., :2]))


def _slopes(values: Array, line: Array) -> Array:
    """Derivatives along x and y, (..., 2), of values [iy, ix] on a grid."""
    return np.stack([np.gradient(values, line, axis=axis) for axis in (1, 0)], axis=-1)
