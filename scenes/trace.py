"""Light traced from the LEDs: how much of it, and at what angles, arrives where on the contact surface.

Two families of paths are left out because `direct` gathers them without noise: straight from the LED to the
surface, and mirrored once in the glass's lower face.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline
from scipy.ndimage import correlate1d

from .build import led_frame
from .contact import ContactOptics
from .sensor import Sensor

Array = NDArray[np.float64]

CELLS = 100  # of the irradiance grid, per side
_SMOOTHING_CELLS = 2.5  # standard deviation of the smoothing kernel
# Deposits are summed as integers: the sum does not depend on the order of threads
_FIXED_POINT = float(2**20)
_MAX_BOUNCES = 256
# Legs of the two families of paths that `direct` gathers, and any other
_IN_AIR, _IN_GUIDE, _DOWN, _IN_GLASS_UP, _BACK_UP, _OTHER = range(6)
_SURE_BOUNCES = 12  # before Russian roulette
# Fractional parts of powers of 1/phi_4, phi_4 the root of x^5 = x + 1, times 2^32: an additive recurrence
# that fills the unit 4-cube evenly (Roberts 2018; key roberts2018)
_RECURRENCE = tuple(int((1.1673039782614187 ** -(k + 1) % 1.0) * 2**32) | 1 for k in range(4))


@dataclass(frozen=True)
class AngularBasis:
    """Separable form of the contact's transmittance, T(A_r, cos) = sum_k rows[:, k](A_r) columns[k](cos).

    Light arrives spread over angles, so T cannot be taken out of the integral over them; with this form the
    integral is `count` irradiances, smooth over the surface, whatever the pressure does from pixel to pixel.
    """

    rows: Array  # (n_fraction, count)
    columns: Array  # (count, n_cos)

    @property
    def count(self) -> int:
        return self.columns.shape[0]


def angular_basis(optics: ContactOptics, tolerance: float = 5e-5) -> AngularBasis:
    """Truncated singular value decomposition of the table, largest error at most `tolerance`."""
    u, s, v = np.linalg.svd(optics.transmittance, full_matrices=False)
    for count in range(1, s.size + 1):
        rows, columns = u[:, :count] * s[:count], v[:count]
        if np.abs(rows @ columns - optics.transmittance).max() <= tolerance:
            break
    return AngularBasis(rows, columns)


def trace(scene: mi.Scene, sensor: Sensor, basis: AngularBasis, samples: int, seed: int) -> Array:
    """Weighted irradiance on the contact surface, from every LED.

    Parameters
    ----------
    scene
        From `build.load_scene`, with its surface put in place.
    basis
        Weights of the angle of incidence, from `angular_basis`.
    samples
        Light paths per LED.
    seed
        Seed of every random choice; the result depends on nothing else, not even on the number of threads.

    Returns
    -------
    (n_led, count, CELLS, CELLS)
        ∫ columns[k](cos) L cos dω, W/mm², raw (not smoothed) on cells [iy, ix] of the deformed surface over
        the guide's face.
    """
    n_led, count, width = len(sensor.leds), basis.count, sensor.guide.width_mm
    index = dr.arange(mi.UInt32, n_led * samples)
    number = index // mi.UInt32(dr.opaque(mi.UInt32, samples))
    ray = _emit(sensor, number, index - number * dr.opaque(mi.UInt32, samples), seed)
    random = mi.PCG32(
        size=n_led * samples, initstate=dr.opaque(mi.UInt64, seed), initseq=mi.UInt64(index) + 1
    )
    weights = mi.Float(np.ascontiguousarray(basis.columns.T, dtype=np.float32).ravel())
    landed = dr.zeros(mi.Int64, n_led * count * CELLS * CELLS)
    named = {shape.id(): mi.ShapePtr(shape) for shape in scene.shapes()}
    contact = named["contact"]
    context = mi.BSDFContext(mi.TransportMode.Importance)
    n_cos = basis.columns.shape[1]

    throughput, bounce, alive = mi.Float(1.0), mi.UInt32(0), mi.Bool(True)
    in_air = mi.Bool(np.array([led.coupling == "air" for led in sensor.leds]))
    leg = dr.select(dr.gather(mi.Bool, in_air, number), mi.UInt32(_IN_AIR), mi.UInt32(_IN_GUIDE))

    def going(ray, throughput, bounce, leg, alive, random):  # type: ignore[no-untyped-def]
        return alive

    def step(ray, throughput, bounce, leg, alive, random):  # type: ignore[no-untyped-def]
        si = scene.ray_intersect(ray, alive)
        alive &= si.is_valid()
        cosine = mi.Frame3f.cos_theta(si.wi)
        on_contact = si.shape == contact
        gathered = (leg == _IN_GUIDE) | (leg == _BACK_UP)  # `direct` counts these
        lands = alive & on_contact & (cosine > 0.0) & ~gathered
        column = mi.UInt32(dr.clip((si.p.x / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        row = mi.UInt32(dr.clip((si.p.y / width + 0.5) * CELLS, 0.0, CELLS - 1.0))
        for k, weight in enumerate(weigh(weights, count, n_cos, cosine, lands)):
            amount = mi.Int64(dr.round(throughput * weight * _FIXED_POINT))
            cell = ((number * count + k) * CELLS + row) * CELLS + column
            dr.scatter_add(landed, amount, cell, lands)

        sample1 = random.next_float32()
        sample2 = mi.Point2f(random.next_float32(), random.next_float32())
        scattered, weight = si.bsdf(ray).sample(context, si, sample1, sample2, alive)
        throughput = throughput * dr.select(alive, weight[0], 0.0)
        passed = mi.has_flag(scattered.sampled_type, mi.BSDFFlags.DeltaTransmission)
        leg = _next_leg(leg, si.shape, passed, named)
        survive = dr.select(bounce < _SURE_BOUNCES, 1.0, dr.minimum(throughput, 0.95))
        alive &= (throughput > 0.0) & (random.next_float32() < survive) & (bounce < _MAX_BOUNCES)
        throughput = dr.select(alive, throughput / survive, 0.0)
        ray = si.spawn_ray(si.to_world(scattered.wo))
        return ray, throughput, bounce + 1, leg, alive, random

    dr.while_loop((ray, throughput, bounce, leg, alive, random), going, step)
    sums = landed.numpy().reshape(n_led, count, CELLS, CELLS).astype(np.float64) / _FIXED_POINT
    flux = np.array([led.flux_W for led in sensor.leds])
    return np.asarray(sums * (flux / samples / (width / CELLS) ** 2)[:, None, None, None])


def smooth(irradiance: Array, factor: int = 4) -> Array:
    """Smoothed irradiance on a grid `factor` times finer, over the last two axes, mirrored at the edges.

    The kernel 2 G - G * G has no second moment, so the curvature of the irradiance survives; cubic splines
    interpolate.
    """
    return _along_both(_smoothing_matrix(irradiance.shape[-1], factor, smoothed=True), irradiance)


def refine(irradiance: Array, factor: int) -> Array:
    """Values on a grid `factor` times finer over the last two axes, by cubic splines."""
    return _along_both(_smoothing_matrix(irradiance.shape[-1], factor, smoothed=False), irradiance)


def weigh(weights: mi.Float, count: int, n_cos: int, cosine: mi.Float, active: mi.Bool) -> list[mi.Float]:
    """The basis' columns at a cosine; `weights` is their (n_cos, count) table, flattened."""
    at = dr.clip(cosine, 0.0, 1.0) * (n_cos - 1)
    node = dr.minimum(mi.UInt32(at), n_cos - 2)
    share = at - mi.Float(node)
    low = [dr.gather(mi.Float, weights, node * count + k, active) for k in range(count)]
    high = [dr.gather(mi.Float, weights, (node + 1) * count + k, active) for k in range(count)]
    return [dr.lerp(a, b, share) for a, b in zip(low, high, strict=True)]


def _along_both(step: Array, irradiance: Array) -> Array:
    # einsum, not matmul: its order of summation does not depend on the number of threads
    return np.einsum("yi,...ij,xj->...yx", step, irradiance, step, optimize=["einsum_path", (0, 1), (0, 1)])


@lru_cache(maxsize=4)
def _smoothing_matrix(cells: int, factor: int, *, smoothed: bool) -> Array:
    """(factor * cells, cells): smooth along one axis if asked to, then refine by cubic splines."""
    reach = int(np.ceil(6 * _SMOOTHING_CELLS))
    gauss = np.exp(-0.5 * (np.arange(-reach, reach + 1) / _SMOOTHING_CELLS) ** 2)
    gauss /= gauss.sum()
    twice = np.convolve(gauss, gauss)
    kernel = -twice
    kernel[reach:-reach] += 2.0 * gauss
    cell_values = correlate1d(np.eye(cells), kernel, axis=0, mode="reflect") if smoothed else np.eye(cells)
    middles, finer = np.arange(cells) + 0.5, (np.arange(factor * cells) + 0.5) / factor
    return np.asarray(CubicSpline(middles, cell_values)(finer))


def _emit(sensor: Sensor, number: mi.UInt32, index: mi.UInt32, seed: int) -> mi.Ray3f:
    """Rays from the LEDs' discs, even over area, cosine-weighted over angle, by an additive recurrence."""
    half = sensor.guide.width_mm / 2
    frames = np.array([np.concatenate(led_frame(led, half)) for led in sensor.leds])
    radii = np.array([led.diameter_mm / 2 for led in sensor.leds])
    columns = [mi.Float(column.astype(np.float32)) for column in (*frames.T, radii)]
    centre, axis, tangent = (
        mi.Vector3f(*(dr.gather(mi.Float, columns[3 * i + j], number) for j in range(3))) for i in range(3)
    )
    radius = dr.gather(mi.Float, columns[9], number)

    start = np.random.Generator(np.random.Philox(seed)).integers(0, 2**32, size=4, dtype=np.uint64)
    u = [_fraction(dr.opaque(mi.UInt32, int(start[k])) + index * _RECURRENCE[k]) for k in range(4)]
    on_disc = mi.warp.square_to_uniform_disk_concentric(mi.Point2f(u[0], u[1]))
    direction = mi.warp.square_to_cosine_hemisphere(mi.Point2f(u[2], u[3]))
    frame = mi.Frame3f(tangent, dr.cross(axis, tangent), axis)
    origin = centre + radius * (on_disc.x * frame.s + on_disc.y * frame.t)
    away = frame.to_world(direction)
    return mi.Ray3f(mi.Point3f(origin + 1e-4 * away), away)


def _next_leg(
    leg: mi.UInt32, shape: mi.ShapePtr, passed: mi.Bool, named: dict[str, mi.ShapePtr]
) -> mi.UInt32:
    """The leg after an event at `shape`, `passed` if light went through it."""
    on_wall = mi.Bool(False)
    for name, pointer in named.items():
        if name.startswith("wall_"):
            on_wall |= shape == pointer
    upper, lower = shape == named["guide_to_glass"], shape == named["glass_to_air"]
    following = mi.UInt32(_OTHER)
    for before, event, after in (
        (_IN_AIR, on_wall & passed, _IN_GUIDE),
        (_IN_GUIDE, upper & passed, _DOWN),
        (_DOWN, lower & ~passed, _IN_GLASS_UP),
        (_IN_GLASS_UP, upper & passed, _BACK_UP),
    ):
        following = dr.select((leg == before) & event, mi.UInt32(after), following)
    return following


def _fraction(integer: mi.UInt32) -> mi.Float:
    """Upper 24 bits of an integer as a number in [0, 1)."""
    return mi.Float(integer >> 8) * float(2**-24)
