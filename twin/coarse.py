"""A camera of few pixels in place of one of many: the same field, and counts as of one true pixel.

Light is smooth over a fraction of a millimetre, so a coarse pixel stands for the many true ones that see the
same. Each of those tells what it tells by itself: noise, full well and rounding stay those of a true pixel,
and information is multiplied by their number.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError

from estimation.information import Noise
from twin.complaint import DesignError, shown
from twin.design import Design
from twin.forward import noise_of

Floats = NDArray[np.float64]

CELL_MM = 0.2
"""Side of a coarse pixel on the contact surface, mm, where the camera has finer ones."""

_SHORTEST_MS = 1e-3  # as `scenes.imager.Camera` has it


@dataclass(frozen=True)
class Counted:
    """Pictures of a coarse camera, and what light makes of them.

    Attributes
    ----------
    mean : (..., rows, columns[, 3]) counts, stopped at the full well.
    layers : (..., n_led, rows, columns[, 3]) counts of each LED's light alone.
    open : where the full well is not reached, as `mean`.
    """

    mean: Floats
    layers: Floats
    open: NDArray[np.bool_]


def coarse(design: Design, cell_mm: float = CELL_MM) -> tuple[Design, float]:
    """Return the design with few pixels, and the number of true pixels that each stands for.

    The exposure is shortened by that number, since a coarse pixel is so many times larger.
    """
    camera = design.camera
    rows, columns = camera.shape
    fewer = [
        min(many, max(round(extent / cell_mm), 1))
        for many, extent in ((rows, camera.field_height_mm), (columns, camera.field_of_view_mm))
    ]
    block = rows * columns / (fewer[0] * fewer[1])
    # where the exposure may not be as short as that, the lens takes the rest, unless its blur matters
    exposure = (
        max(camera.exposure_ms / block, _SHORTEST_MS)
        if camera.focus_mm == 0.0
        else camera.exposure_ms / block
    )
    closed = float(np.sqrt(exposure * block / camera.exposure_ms))
    pixel = camera.pixel_um[0] * camera.columns / fewer[1], camera.pixel_um[1] * camera.rows / fewer[0]
    try:
        small = replace(
            camera,
            rows=fewer[0],
            columns=fewer[1],
            pixel_um=pixel,
            binning=1,
            exposure_ms=exposure,
            f_number=camera.f_number * closed,
            dark_current_e_s=camera.dark_current_e_s * camera.exposure_ms / exposure * camera.binning**2,
            full_well_e=camera.full_well_e * camera.binning**2,
        )
    except ValidationError:
        received = shown((camera.exposure_ms, camera.binning))
        raise DesignError(
            "camera.exposure_ms, camera.binning", received, "an exposure and a binning that are less extreme"
        ) from None
    return replace(design, camera=small), block


def noise(design: Design, block: float, frames: int) -> Noise:
    """Noise of a coarse pixel: that of a true one, told so many times."""
    return replace(noise_of(design, 1), frames=frames * block)  # type: ignore[arg-type]


def counted(design: Design, radiance: NDArray[np.floating]) -> Counted:
    """Return the counts of radiance (..., n_led, rows, columns[, 3]), W m⁻² sr⁻¹, on a coarse camera."""
    camera, per = design.camera, per_radiance(design)
    planes = 2 if camera.colour == "mono" else 3
    layers = _through(design, np.asarray(radiance, np.float64), planes) * per
    ambient = stray(design)
    dark = camera.dark_current_e_s * camera.exposure_ms * 1e-3 / camera.gain_e_per_dn
    light = layers.sum(axis=-planes - 1) + ambient + dark
    well = camera.full_well_e / camera.gain_e_per_dn
    return Counted(np.minimum(light, well) + camera.offset_dn, layers, light < well)


def counted_slopes(design: Design, slopes: NDArray[np.floating]) -> Floats:
    """Return layers of counts per unit, as `slopes` (..., n_led, rows, columns[, 3]) are of radiance."""
    planes = 2 if design.camera.colour == "mono" else 3
    return _through(design, np.asarray(slopes, np.float64), planes) * per_radiance(design)


def per_radiance(design: Design) -> Floats:
    """Counts per W m⁻² sr⁻¹ of each channel, () or (3,)."""
    from scenes.camera import mean_electrons

    camera = design.camera
    shape = camera.shape if camera.colour == "mono" else (*camera.shape, len(camera.channels))
    electrons = mean_electrons(camera, np.ones(shape), design.light.wavelength_nm)[0, 0]
    return np.asarray(electrons / camera.gain_e_per_dn)


def _through(design: Design, fields: Floats, planes: int) -> Floats:
    """What the lens makes of fields, ambient light left out."""
    camera = design.camera
    if camera.focus_mm == 0.0 and not camera.vignetting and not any(camera.distortion):
        return fields
    from scenes.lens import through

    sensor = replace(design.sensor(), camera=replace(camera, ambient=0.0))
    flat = fields.reshape(-1, *fields.shape[-planes:])
    # a lens spreads what is positive: slopes go through it as the difference of two such
    found = [through(sensor, np.maximum(one, 0.0)) - through(sensor, np.maximum(-one, 0.0)) for one in flat]
    return np.stack(found).reshape(fields.shape)


def stray(design: Design) -> Floats | float:
    """Counts of ambient light, (rows, columns[, 3])."""
    camera = design.camera
    if camera.ambient == 0.0:
        return 0.0
    from scenes.lens import through

    shape = camera.shape if camera.colour == "mono" else (*camera.shape, 3)
    return through(design.sensor(), np.zeros(shape)) * per_radiance(design)
