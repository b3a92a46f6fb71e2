"""Our pictures as another camera takes them: other noise and pixels, and not quite where it should stand."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import map_coordinates

from scenes.camera import count_dtype, expose
from scenes.exr import write_png
from scenes.imager import Camera
from scenes.lens import through
from twin.design import Design
from twin.received import Received


def other_camera(camera: Camera, seed: int = 99) -> Camera:
    """A camera of the same brightness whose charges are 0.7 times as large, with other noise and pixels.

    Shot noise is 1.2 times as large in counts, read noise 2.4 times, PRNU and DSNU 1.5 and 2 times.
    """
    small = 0.7
    return replace(
        camera,
        exposure_ms=small * camera.exposure_ms,
        full_well_e=small * camera.full_well_e,
        gain_e_per_dn=small * camera.gain_e_per_dn,
        read_noise_e=1.7 * camera.read_noise_e,
        prnu_percent=1.5 * camera.prnu_percent,
        dsnu_e=2.0 * camera.dsnu_e,
        pattern_seed=seed,
    )


def moved(
    pictures: ArrayLike, shift: tuple[float, float], scale: float, turn: float, order: int = 1
) -> NDArray[np.float64]:
    """Pictures (n, rows, columns[, 3]) shifted (columns, rows), magnified, turned (radians), all alike.

    Beyond the border they go on as they end.
    """
    given = np.asarray(pictures, np.float64)
    rows, columns = given.shape[1:3]
    middle = np.array([rows - 1, columns - 1])[:, None, None] / 2
    grid = np.indices((rows, columns)) - middle - np.array(shift[::-1])[:, None, None]
    at = (np.cos(turn) * grid + np.sin(turn) * np.stack([grid[1], -grid[0]])) / scale + middle
    flat = np.moveaxis(given.reshape(len(given), rows, columns, -1), 3, 1).reshape(-1, rows, columns)
    out = np.stack([map_coordinates(plane, at, order=order, mode="nearest") for plane in flat])
    out = np.moveaxis(out.reshape(len(given), -1, rows, columns), 1, 3)
    return out.reshape(given.shape)


def real_camera(
    design: Design,
    lit: ArrayLike,
    plain: ArrayLike,
    seed: int = 0,
    shot: int = 0,
    *,
    frames: int = 1,
    reference_frames: int = 16,
    percent: float = 1.0,
    camera: Camera | None = None,
) -> Received:
    """Pictures of light through `other_camera`, misaligned by so many per cent in every way.

    ``lit`` and ``plain`` are (levels, rows, columns[, 3]) W m⁻² sr⁻¹, all LEDs together, with and without
    inclusion. Shift along both axes (of the width), magnification and turn (0.01 rad) have random signs,
    which are the seed's; the noise is that of seed and shot.
    """
    rng = np.random.default_rng([seed, 4])
    camera = other_camera(design.camera) if camera is None else camera
    sign = rng.choice([-1.0, 1.0], 4) * 0.01 * percent
    rng = np.random.default_rng([seed, 5, shot])
    step = (sign[0] * design.camera.shape[1], sign[1] * design.camera.shape[1])

    def taken(light: ArrayLike, count: int) -> NDArray[np.float32]:
        seen = moved(light, step, 1.0 + sign[2], sign[3])
        shots = [
            expose(
                camera, through(design.sensor(), level), design.light.wavelength_nm, rng, frames=count
            ).astype(np.float32)
            for level in np.maximum(seen, 0.0)
        ]
        return np.stack(shots)

    names = tuple(f"level {number}" for number in range(len(np.asarray(lit))))
    images = taken(lit, frames)
    return Received(images, taken(plain, reference_frames), frames, reference_frames, camera.bits, names)


def write_seen_from_below(pictures: ArrayLike, folder: Path, name: str, bits: int) -> list[Path]:
    """Write pictures (n, rows, columns[, 3]) as a camera below stores them, mirrored: PNG of whole counts."""
    folder.mkdir(parents=True, exist_ok=True)
    places = []
    for number, picture in enumerate(np.asarray(pictures)):
        places.append(folder / f"{name}-{number}.png")
        write_png(places[-1], np.rint(picture[:, ::-1]).astype(count_dtype(bits)))
    return places
