"""What the camera's pinhole sees: pixel rays through its lens and the glass's two flat faces, in closed form.

The lens maps the tangent r of a ray's angle in air to d(r) = r (1 + k1 r² + k2 r⁴) times its image
distance (radial terms of Brown 1971; key brown1971). `air_directions` inverts d, `picture_points` goes the
other way.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from .sensor import Sensor

Array = NDArray[np.float64]

SIGHT = 2
"""Raised where what the camera sees of the same light changes: kept layout studies are judged anew.
2: guide and glass absorb on the way to the camera, too."""


@dataclass(frozen=True, eq=False)
class PixelRays:
    """Rays of the camera's pixels where they come into the guide, going up; of a guide in layers, where they
    come into the one under the contact.

    Attributes
    ----------
    origin_mm, direction : (rows, columns, 3)
        Point on the face between guide and glass (on the first layer's lower face), and unit direction.
    transmittance : (rows, columns)
        Transmittance of all faces and the glass together, unpolarised, with the reflections between them
        summed; 0 where an LED below is in the way. What the guide absorbs is not in it.
    passed, mirrored, mirrored_outside : (rows, columns)
        The same without LEDs in the way; and the share that comes back at their angle, of light from the
        guide and of light from the air.
    radiance_scale : float
        Radiance in air over radiance there of an unattenuated ray, 1/n² (conservation of étendue).
    """

    origin_mm: Array
    direction: Array
    transmittance: Array
    passed: Array
    mirrored: Array
    mirrored_outside: Array
    radiance_scale: float


def tangent_scale(sensor: Sensor) -> float:
    """Distorted tangent of the ray angle in air per mm on the camera's sensor: 1 over the image distance.

    Chosen so that the picture is exactly `field_of_view_mm` wide where its middle row meets the contact
    surface, refraction included; the optics are otherwise rectilinear, but for the lens's distortion.
    """
    edge = sensor.camera.field_of_view_mm / 2

    def miss(sine: float) -> float:
        return _reach(sensor, sine) - edge

    sine = float(brentq(miss, 0.0, np.sin(np.arctan(edge / sensor.camera.distance_mm)), xtol=1e-15))
    tangent = sine / np.sqrt(1.0 - sine**2) * (1.0 + _stretch(sensor, sine**2 / (1.0 - sine**2)))
    return float(tangent / (0.5e-3 * sensor.camera.columns * sensor.camera.pixel_um[0]))


def air_directions(sensor: Sensor, column: Array, row: Array) -> Array:
    """Unit directions (..., 3) in air, from the pinhole up, of picture coordinates (x.5 are pixels'
    middles)."""
    (rows, columns), (width, height) = sensor.camera.shape, sensor.camera.pitch_mm
    scale = tangent_scale(sensor)
    tangent_x = (np.asarray(column) - columns / 2) * width * scale
    tangent_y = -(np.asarray(row) - rows / 2) * height * scale
    if any(sensor.camera.distortion):
        shrink = _undistort(sensor, np.hypot(tangent_x, tangent_y))
        tangent_x, tangent_y = tangent_x * shrink, tangent_y * shrink
    direction = np.stack(np.broadcast_arrays(tangent_x, tangent_y, np.ones_like(tangent_x)), axis=-1)
    return np.asarray(direction / np.linalg.norm(direction, axis=-1, keepdims=True))


def picture_points(sensor: Sensor, direction: Array) -> tuple[Array, Array]:
    """Column and row (...) at which the lens images rays of these directions (..., 3) in air, +z up."""
    (rows, columns), (width, height) = sensor.camera.shape, sensor.camera.pitch_mm
    tangent = direction[..., :2] / direction[..., 2:]
    spread = 1.0 + _stretch(sensor, np.sum(tangent**2, axis=-1))
    x, y = np.moveaxis(tangent * (spread / tangent_scale(sensor))[..., None], -1, 0)
    return columns / 2 + x / width, rows / 2 - y / height


def crowding(sensor: Sensor, direction: Array) -> Array:
    """Area of undistorted tangents per area of distorted ones, 1 without distortion: (r/d)(dr/dd)."""
    square = np.sum((direction[..., :2] / direction[..., 2:]) ** 2, axis=-1)
    k1, k2 = sensor.camera.distortion
    slope = 1.0 + 3.0 * k1 * square + 5.0 * k2 * square**2
    return np.asarray(1.0 / (slope * (1.0 + _stretch(sensor, square))))


def _stretch(sensor: Sensor, square: Any) -> Any:
    """d(r)/r - 1 of the squared tangent r²."""
    k1, k2 = sensor.camera.distortion
    return k1 * square + k2 * square**2


def _undistort(sensor: Sensor, distorted: Array) -> Array:
    """r/d(r) for given d, by Newton's method."""
    k1, k2 = sensor.camera.distortion
    tangent = distorted.copy()
    for _ in range(30):
        square = tangent**2
        miss = tangent * (1.0 + k1 * square + k2 * square**2) - distorted
        tangent = tangent - miss / np.maximum(1.0 + 3.0 * k1 * square + 5.0 * k2 * square**2, 0.05)
    back = tangent * (1.0 + _stretch(sensor, tangent**2))
    if np.abs(back - distorted).max() > 1e-9:
        raise ValueError(f"camera.distortion: received {(k1, k2)}; allowed less: the picture has no corners")
    return np.where(distorted > 0.0, tangent / np.where(distorted > 0.0, distorted, 1.0), 1.0)


def pixel_rays(sensor: Sensor) -> PixelRays:
    """Refract the ray through the middle of each pixel into the guide."""
    camera, glass, guide = sensor.camera, sensor.glass, sensor.guide
    rows, columns = camera.shape
    column, row = np.arange(columns) + 0.5, np.arange(rows)[:, None] + 0.5
    in_air = air_directions(sensor, *np.broadcast_arrays(column, row))
    in_glass = _refract(in_air, glass.refractive_index)
    in_guide = _refract(in_air, guide.refractive_index)
    offset = in_air[..., :2] / in_air[..., 2:] * camera.distance_mm
    offset = offset + in_glass[..., :2] / in_glass[..., 2:] * glass.thickness_mm
    for layer in reversed(guide.lower):
        inside = _refract(in_air, layer.refractive_index)
        offset = offset + inside[..., :2] / inside[..., 2:] * layer.thickness_mm
    origin = np.concatenate([offset, np.full((*offset.shape[:2], 1), guide.floors_mm[0])], axis=-1)
    mirrored, passed = _stacked(sensor, in_guide[..., 2], 0, _fresnel)
    outside = _outside(sensor, in_air[..., 2], in_guide[..., 2])
    open_ = np.where(_blocked(sensor, in_air, in_glass), 0.0, passed)
    return PixelRays(origin, in_guide, open_, passed, mirrored, outside, 1.0 / guide.refractive_index**2)


def below_mm(sensor: Sensor) -> float:
    """Depth of glass and lower layers in millimetres of the guide's first one, near the axis."""
    guide, glass = sensor.guide, sensor.glass
    first = guide.refractive_index
    depth = glass.thickness_mm * (first / glass.refractive_index)
    return depth + sum(layer.thickness_mm * first / layer.refractive_index for layer in guide.lower)


def _blocked(sensor: Sensor, in_air: Array, in_glass: Array) -> NDArray[np.bool_]:
    """Which rays meet the black back of an LED below, (rows, columns)."""
    lean_air, lean_glass = (rays[..., :2] / rays[..., 2:] for rays in (in_air, in_glass))
    blocked = np.zeros(in_air.shape[:2], bool)
    for led in sensor.leds:
        if led.side != "below":
            continue
        in_front = led.gap_mm if led.coupling == "air" else 0.0
        meets = lean_air * (sensor.camera.distance_mm - in_front)
        if led.coupling == "embedded":
            meets = meets + lean_glass * led.gap_mm
        blocked |= np.hypot(meets[..., 0] - led.x_mm, meets[..., 1] - led.y_mm) < led.diameter_mm / 2
    return blocked


def faces_reflectance(sensor: Sensor, cosine: Array, layer: int = 0) -> Array:
    """Share of light that all faces below a layer of the guide, those of the glass among them, send back,
    same shape as `cosine` (in the first layer). What the glass absorbs is left out of it."""
    return _stacked(sensor, cosine, layer, _fresnel)[0]


def faces_transmittance(sensor: Sensor, cosine: Array, layer: int = 0) -> Array:
    """Share of light that passes all of them, and the glass, into the air or from it."""
    return _stacked(sensor, cosine, layer, _fresnel)[1]


def faces_reflectances(sensor: Sensor, cosine: Array) -> tuple[Array, Array]:
    """`faces_reflectance` of s and of p polarised light."""
    s, p = (
        _stacked(sensor, cosine, 0, lambda *face, way=way: _fresnel_apart(*face)[way])[0] for way in (0, 1)
    )
    return s, p


def _stacked(sensor: Sensor, cosine: Array, layer: int, fresnel: Callable[..., Array]) -> tuple[Array, Array]:
    """Reflectance and transmittance of the faces below a layer, and of the glass between the last two.

    Incoherent sums over the reflections between a face and all below it, behind what keeps `a` of the light
    on one way: R = R1 + (1 - R1)² a² R2 / (1 - a² R1 R2), T = (1 - R1) a T2 / (1 - a² R1 R2).
    """
    n2 = sensor.glass.refractive_index
    indices = [index for _, index in sensor.guide.layers]
    sine = indices[0] * np.sqrt(1.0 - np.asarray(cosine) ** 2)
    second = fresnel(n2, 1.0, sine)
    through, below, kept = 1.0 - second, n2, _kept_by_glass(sensor, sine)
    for index in reversed(indices[layer:]):
        first = fresnel(index, below, sine)
        passes = 1.0 - kept**2 * first * second  # 0 where the first face reflects all already
        once = (1.0 - first) * kept / np.where(passes > 0.0, passes, 1.0)
        second, through = first + (1.0 - first) * kept * once * second, once * through
        below, kept = index, 1.0
    return np.asarray(second), np.asarray(through)


def _outside(sensor: Sensor, in_air: Array, in_guide: Array) -> Array:
    """Share of light from the air that comes back, at these cosines. Faces that absorb nothing reflect alike
    from both sides, which gives what those above the glass reflect."""
    clear = replace(sensor, glass=replace(sensor.glass, absorption_per_mm=0.0))
    sine = np.sqrt(1.0 - in_air**2)
    last, both = _fresnel(sensor.glass.refractive_index, 1.0, sine), faces_reflectance(clear, in_guide)
    above = (both - last) / ((1.0 - last) ** 2 + last * (both - last))
    returned = _kept_by_glass(sensor, sine) ** 2 * above
    return np.asarray(last + (1.0 - last) ** 2 * returned / (1.0 - last * returned))


def _kept_by_glass(sensor: Sensor, n_sine: Array) -> Any:
    """Share of light that the glass leaves on one way, at tangential index n sin(theta) (Beer's law)."""
    glass = sensor.glass
    if glass.absorption_per_mm == 0.0:
        return 1.0
    cosine = np.sqrt(np.maximum(1.0 - (n_sine / glass.refractive_index) ** 2, 1e-12))
    return np.exp(-glass.absorption_per_mm * glass.thickness_mm / cosine)


def _fresnel(n_in: float, n_out: float, n_sine: Array) -> Array:
    """Unpolarised Fresnel reflectance at tangential index n sin(theta) (Born & Wolf 1999; key born1999)."""
    s, p = _fresnel_apart(n_in, n_out, n_sine)
    return np.asarray(np.where(n_sine < n_out, 0.5 * (s + p), 1.0))


def _fresnel_apart(n_in: float, n_out: float, n_sine: Array) -> tuple[Array, Array]:
    """The same of s and p, 1 beyond the critical angle."""
    a = np.sqrt(np.maximum(n_in**2 - n_sine**2, 0.0))
    b = np.sqrt(np.maximum(n_out**2 - n_sine**2, 0.0))
    s = (a - b) / np.maximum(a + b, 1e-300)
    p = (n_out**2 * a - n_in**2 * b) / np.maximum(n_out**2 * a + n_in**2 * b, 1e-300)
    return np.where(n_sine < n_out, s**2, 1.0), np.where(n_sine < n_out, p**2, 1.0)


def _refract(in_air: Array, index: float) -> Array:
    tangential = in_air[..., :2] / index
    return np.concatenate([tangential, np.sqrt(1.0 - np.sum(tangential**2, axis=-1, keepdims=True))], axis=-1)


def _reach(sensor: Sensor, sine: float) -> float:
    """Distance from the axis, mm, at which a ray of this sine in air meets the undeformed contact surface."""
    path = (
        (sensor.camera.distance_mm, 1.0),
        (sensor.glass.thickness_mm, sensor.glass.refractive_index),
        *reversed(sensor.guide.layers),
    )
    return float(sum(length * sine / np.sqrt(n**2 - sine**2) for length, n in path))
