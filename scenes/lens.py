"""The lens between radiance and pixels: a thin lens, its depth of field, and how it darkens off the axis.

Its aperture is its pupil and stands where the pinhole of `view` does. Left out: diffraction (an Airy disc of
2.44 wavelengths times f-number (1 + m), a pixel or less), and blur that changes over the picture: the
undeformed contact surface sets one blur for all that is seen.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from . import view
from .sensor import Guide, Sensor

Array = NDArray[np.float64]

_FINER = 8  # sub-pixels per pixel and axis in which the defocus disc is counted


@dataclass(frozen=True)
class Lens:
    """A thin lens that images the undeformed contact surface onto the camera's pixels; lengths are mm.

    Attributes
    ----------
    focal_mm : focal length, 1/f = 1/(distance in focus) + 1/(image distance).
    object_mm : distance at which the contact surface seems to stand on the axis, through glass and guide.
    image_mm : distance from lens to pixels.
    pupil_mm : diameter of the aperture, f over the f-number.
    blur_mm : diameter of the disc on the pixels that a point of the contact surface is spread over.
    """

    focal_mm: float
    object_mm: float
    image_mm: float
    pupil_mm: float
    blur_mm: float

    @property
    def magnification(self) -> float:
        """Size of the image over that of the contact surface, on the axis."""
        return self.image_mm / self.object_mm


def lens_of(sensor: Sensor) -> Lens:
    """The thin lens that the field of view, the distance and the plane in focus ask for.

    Seen through a flat face, depth t in an index n seems t/n (Hecht 2017, section 5.2; key hecht2017): the
    surface stands at u = distance + t_glass/n_glass + sum of t/n over the guide's layers. With the image
    distance v that the rays to the edge of the field ask for, Gauss' 1/f = 1/u_f + 1/v holds for the plane in
    focus, u_f. A point at u then spreads over a disc of pupil * v * |1/u - 1/u_f|.
    """
    camera, guide = sensor.camera, sensor.guide
    seems = camera.distance_mm + sensor.glass.thickness_mm / sensor.glass.refractive_index
    seems += sum(thickness / index for thickness, index in guide.layers)
    sharp = seems + _seems(guide, camera.focus_mm)
    image = 1.0 / view.tangent_scale(sensor)
    focal = 1.0 / (1.0 / sharp + 1.0 / image)
    pupil = focal / camera.f_number
    return Lens(focal, seems, image, pupil, pupil * image * abs(1.0 / seems - 1.0 / sharp))


def _seems(guide: Guide, height_mm: float) -> float:
    """How high above the contact surface a plane seems to lie, mm; below it, through the layers up to it."""
    if height_mm > -guide.top_mm or not guide.lower:
        return height_mm / guide.refractive_index
    seems, left = 0.0, -height_mm
    for thickness, index in guide.layers:
        seems -= min(thickness, left) / index
        left -= min(thickness, left)
    return seems


def through(sensor: Sensor, radiance: Array) -> Array:
    """Radiance that the pixels act as if they saw on the axis of a lens in focus, same shape.

    Ambient light is added, the defocus disc spreads all, and with `vignetting` the pixels off the axis get
    less: cos⁴ of the ray's angle in air (Horn 1986, section 10.3; key horn1986), times the solid angle that
    the lens's distortion gives or takes. Beyond its border the picture is taken to go on as at the border.

    Parameters
    ----------
    radiance : (rows, columns) or (rows, columns, 3)
        At the lens, W m⁻² sr⁻¹, all LEDs together.
    """
    camera, lens = sensor.camera, lens_of(sensor)
    seen = np.asarray(radiance, np.float64)
    if camera.ambient > 0.0:
        seen = seen + camera.ambient
    if camera.focus_mm != 0.0:
        seen = _spread(seen, disc(lens.blur_mm, camera.pitch_mm))
    if camera.focus_mm != 0.0 or any(camera.distortion):
        # the aperture's cone, f/(N v), is not quite that of the field's mean magnification, 1/(N (1 + m))
        seen = seen * (lens.focal_mm / lens.image_mm * (1.0 + camera.magnification)) ** 2
    if camera.vignetting:
        shade = relative_illumination(sensor)
        seen = seen * (shade if seen.ndim == 2 else shade[..., None])
    return seen


def relative_illumination(sensor: Sensor) -> Array:
    """Irradiance of pixels that see even radiance, over that on the axis, (rows, columns)."""
    rows, columns = sensor.camera.shape
    column, row = np.broadcast_arrays(np.arange(columns) + 0.5, np.arange(rows)[:, None] + 0.5)
    direction = view.air_directions(sensor, column, row)
    return np.asarray(direction[..., 2] ** 4 * view.crowding(sensor, direction))


def disc(diameter_mm: float, pitch_mm: tuple[float, float]) -> Array:
    """Share of an even disc's light that each pixel around its middle takes, (odd, odd), summing to 1."""
    reach = [int(np.ceil(diameter_mm / 2 / pitch - 0.5)) if diameter_mm > pitch else 0 for pitch in pitch_mm]
    fine = [(np.arange((2 * r + 1) * _FINER) + 0.5) / _FINER - r - 0.5 for r in reach]
    x, y = (line * pitch for line, pitch in zip(fine, pitch_mm, strict=True))
    inside = (x[None, :] ** 2 + y[:, None] ** 2 <= (diameter_mm / 2) ** 2).astype(np.float64)
    share = inside.reshape(2 * reach[1] + 1, _FINER, 2 * reach[0] + 1, _FINER).sum(axis=(1, 3))
    if share.sum() == 0.0:
        share[reach[1], reach[0]] = 1.0
    return np.asarray(share / share.sum())


def _spread(picture: Array, kernel: Array) -> Array:
    if kernel.size == 1:
        return picture
    margin = [(size // 2, size // 2) for size in kernel.shape]
    if picture.ndim == 3:
        return np.stack([_spread(picture[..., k], kernel) for k in range(picture.shape[2])], axis=-1)
    wide = np.pad(picture, margin, mode="edge")
    # transforms leave rounding errors of either sign where there is no light
    return np.maximum(fftconvolve(wide, kernel, mode="valid"), 0.0)
