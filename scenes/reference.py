"""The reference picture: Mitsuba's stock path tracer through the real scene, slow and without our shortcuts.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .sensor import Sensor

Array = NDArray[np.float64]
Crop = tuple[int, int, int, int]

_WAVEFRONT = 2**21  # light paths in flight: 1 GB at the most
MAX_DEPTH = 256  # trapped light takes tens of reflections; what is cut off is below 1e-6
ROULETTE_DEPTH = 24


def path_trace(
    scene: mi.Scene,
    sensor: Sensor,
    samples: int,
    seed: int,
    *,
    crop: Crop | None = None,
    progress: Callable[[float], None] | None = None,
) -> tuple[Array, Array]:
    """Radiance at the camera by stock `path`, from the LEDs that are switched on.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    samples
        Light paths per pixel.
    crop
        (first row, last row + 1, first column, last column + 1); all pixels for None.
    progress
        Called with the finished share, 0..1.

    Returns
    -------
    (mean, error)
        Radiance (rows, columns) in W m⁻² sr⁻¹ and the standard error of each pixel's mean. Sums run in a
        fixed order: the bytes do not depend on the number of threads.
    """
    film_rows, film_columns = sensor.camera.shape
    top, end_row, left, end_column = crop or (0, film_rows, 0, film_columns)
    rows, columns = end_row - top, end_column - left
    pixels = rows * columns
    integrator = mi.load_dict({"type": "path", "max_depth": MAX_DEPTH, "rr_depth": ROULETTE_DEPTH})
    eye = scene.sensors()[0]

    per_pass = max(1, min(samples, _WAVEFRONT // pixels))
    passes = -(-samples // per_pass)
    total, squares = np.zeros(pixels), np.zeros(pixels)
    for number in range(passes):
        sampler = mi.load_dict({"type": "independent", "sample_count": per_pass})
        sampler.seed(dr.opaque(mi.UInt32, (seed * 1_000_003 + number) % 2**32), pixels * per_pass)
        pixel = dr.arange(mi.UInt32, pixels * per_pass) // per_pass
        jitter = sampler.next_2d()
        column, row = mi.Float(pixel % columns) + left, mi.Float(pixel // columns) + top
        film = mi.Point2f((column + jitter.x) / film_columns, (row + jitter.y) / film_rows)
        ray, _ = eye.sample_ray(mi.Float(0.0), mi.Float(0.0), film, mi.Point2f(0.0))
        radiance = integrator.sample(scene, sampler, mi.RayDifferential3f(ray))[0][0]
        total += dr.block_sum(radiance, per_pass).numpy()
        squares += dr.block_sum(dr.square(radiance), per_pass).numpy()
        if progress is not None:
            progress((number + 1) / passes)
    count = passes * per_pass
    mean = total / count
    error = np.sqrt(np.maximum(squares / count - mean**2, 0.0) / max(count - 1, 1))
    return 1e6 * mean.reshape(rows, columns), 1e6 * error.reshape(rows, columns)
