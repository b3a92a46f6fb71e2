"""Derivatives of the standard picture: what a small change of LEDs, surface state or press makes of it.

One call, one set of walks, all derivatives, and no noise from differencing. By stages:

- light that comes straight or by the glass is gathered in Dr.Jit loops, which Dr.Jit differentiates
  (`direct.answers`): LEDs' places and patterns, the relief of the contact;
- light that walks is weighted with the walk's score (`answers`, `followed`): the contact, the pattern; a disc
  that moves answers by the light of its rim;
- contact pressure to contact fraction, and what the camera sees of the contact: Dr.Jit differentiates
  (`fractions`, `gather.answer`);
- the tissue is linear in light: its equations are differentiated as they stand (`response`);
- the table of the contact's T over angle, to gap height, gap index and dust: central differences of its
  closed form, in double precision.

Left out: how the ways of *walked* light bend when the contact surface moves, so that heights are no more than
a part of the answer; the outline of LEDs in sight when they move, and what they show of their pattern; edges
of light at the outline of a side face and at faces between layers, and shade of LEDs on each other's light,
when they move. Not differentiated: what tissue, sheet, guide, glass and camera are made of, an LED's tilt,
size and gap.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from . import build, direct, gather, housing, surface, transport
from .answers import Answers
from .arrays import doubles, floats
from .contact import ContactOptics
from .followed import Emission, Stage, follow
from .irradiance import angular_basis
from .render import COLOUR, MOST_PASSES, PATHS_PER_LED, Renderer, passes
from .response import Basis, Landed, Other, Response
from .sensor import NotModelled, Sensor
from .surface import OpticalSurface
from .trace import CELLS

Array = NDArray[np.float64]

EMISSION = ("leds.flux_W", "leds.exponent", "leds.along_mm", "leds.z_mm")
CONTACT = ("skin.rms_slope", "skin.kappa", "effective_modulus_kPa")
GAPS = {"skin.rms_height_um": 0.02, "skin.gap_index": 0.002, "skin.dust": 0.01}
"""Steps of the table's differences: relative; absolute; absolute."""
PRESSURE = "pressure"
NAMES = (*EMISSION, *CONTACT, *GAPS, PRESSURE)
_RELIEF_MM = 0.01  # largest move, of the differences of relief and normals: geometry, without noise
_ROUGHLY = 1e-3  # tolerance of the bases of derivatives, relative


@dataclass(frozen=True)
class Press:
    """How an unknown changes a press, per unit: contact pressure (n, n) kPa and displacement (n, n, 3) mm of
    the surface's points, on `surface.OpticalSurface`'s grid; None where it does not."""

    name: str
    pressure_kPa: Array | None = None
    displacement_mm: Array | None = None


@dataclass(frozen=True)
class Gradients:
    """A picture and its derivatives.

    Attributes
    ----------
    names : of the q parameters.
    radiance : (n_led, rows, columns)
        At the lens, W m⁻² sr⁻¹, as `Renderer.render` has it with the same samples and seed.
    slopes : (q, n_led, rows, columns)
        Its derivative per unit of each parameter; of an LED's own in its own layer.
    """

    names: tuple[str, ...]
    radiance: Array
    slopes: Array


@dataclass(frozen=True)
class _Moves:
    """What one parameter changes of the contact: fraction (n, n) and displacement (n, n, 3) of its points,
    and the optics behind it."""

    fraction: Array
    displacement_mm: Array | None
    other: Other | None


def gradients(
    renderer: Renderer,
    pressed: OpticalSurface,
    parameters: Sequence[str | Press] = (*EMISSION[:1], *EMISSION[2:], *CONTACT, PRESSURE),
    *,
    samples: int = PATHS_PER_LED["standard"],
    seed: int = 0,
) -> Gradients:
    """Return the standard picture of a press and its derivatives.

    Parameters
    ----------
    pressed
        From `surface.resample`.
    parameters
        Of `NAMES`: flux of the LEDs, W, exponent of their power pattern, place along their sides and height,
        mm; numbers of the skin; the contact modulus E*, kPa; the pressure as a whole (relative: 1 is twice as
        much); or a `Press`.
    samples, seed
        Light paths per LED, and their seed, as of `Renderer.render`.

    Raises
    ------
    ValueError
        For parameters that the sensor does not have.
    NotModelled
        For LEDs below, or painted walls before LEDs in air, with a place; for the height of LEDs that a face
        between layers crosses; for pressure and contact modulus where contact is full; for an inclusion of
        other colour; and for LEDs that the pressed rim would shade.
    """
    sensor = renderer.sensor
    names = tuple(one if isinstance(one, str) else one.name for one in parameters)
    if sensor.inclusion is not None:
        raise NotModelled(COLOUR)
    housing.refuse(sensor, "derivatives of the picture")
    for one in parameters:
        _check(sensor, one)
    renderer.check_leds(pressed)
    build.put_surface(renderer.scene, sensor, pressed)
    with threadpool_limits(1):
        moves = [_moves(renderer, pressed, one) for one in parameters]
        slopes = np.stack([_on_cells(renderer, pressed, one) for one in moves])
        under = transport.Under.at(renderer.basis, renderer.behind, transport.survey(renderer.scene, sensor))
        others = [one.other for one in moves]
        response = Response.of(under, slopes, others)
        walked_on = Response.of(under.coarser, under.ground.on_coarser(slopes), others)
        basis = Basis((renderer.basis, *(one.basis for one in others if one is not None)))
        straight = _gathered(renderer, basis, pressed, names, moves)
        lit = walked_on.upward(straight.coarser())
        tables = [None if one is None else one.transmittance for one in others]
        answers = Answers.of(sensor.guide.width_mm, slopes, tables)
        emission = Emission(*(np.array([float(name == at) for name in names]) for at in _MOVING))
        stage = Stage(renderer.scene, sensor, renderer.table, basis, walked_on, answers, emission)
        count, each = passes(samples, len(sensor.leds))
        walked = follow(stage, lit, each, seed * MOST_PASSES)
        for number in range(1, count):
            walked = walked + follow(stage, lit, each, seed * MOST_PASSES + number)
        seen = response.seen(straight + walked.over(count).even(transport.GRID // CELLS))
    sight = gather.look(renderer.scene, sensor, renderer.table, renderer.behind.coupling, renderer.rays)
    radiance = gather.picture(sight, seen[0], transport.MARGIN).astype(np.float64)
    found = np.empty((len(parameters), *radiance.shape))
    for number, (name, move) in enumerate(zip(names, moves, strict=True)):
        if name == "leds.flux_W":
            found[number] = radiance / np.array([led.flux_W for led in sensor.leds])[:, None, None]
            continue
        step = dr.opaque(mi.Float, 0.0)
        dr.enable_grad(step)
        _hang(renderer, pressed, move, step)
        table = renderer.table
        if move.other is not None:
            table = table.moved(step * floats(move.other.transmittance))
        glance = gather.glance(renderer.scene, sensor, table, renderer.behind.coupling, renderer.rays)
        answer = gather.answer(glance, step, seen[0], seen[1 + number], transport.MARGIN)
        found[number] = answer.reshape(radiance.shape)
    build.put_surface(renderer.scene, sensor, pressed)
    return Gradients(names, radiance, found)


_MOVING = ("leds.along_mm", "leds.z_mm", "leds.exponent")


def fraction_slope(sensor: Sensor, pressure_kPa: Array, name: str, change: Array | None = None) -> Array:
    """Derivative of the real contact fraction (`contact.contact_fraction`), same shape as the pressure: to a
    number of the skin, the contact modulus, or along a `change` of the pressure. By Dr.Jit's automatic
    differentiation."""
    step = dr.opaque(mi.Float64, 0.0)
    dr.enable_grad(step)
    skin, modulus = sensor.skin, sensor.effective_modulus_kPa
    load = doubles(np.maximum(pressure_kPa, 0.0))
    if change is not None:
        rising = np.where(np.asarray(pressure_kPa) > 0.0, change, 0.0)
        load = load + step * doubles(rising)
    slope, kappa = (
        getattr(skin, one) + (step if name == f"skin.{one}" else 0.0) for one in ("rms_slope", "kappa")
    )
    stiff = modulus + (step if name == "effective_modulus_kPa" else 0.0)
    fraction = dr.erf(0.5 * float(np.sqrt(np.pi)) * kappa * load / (stiff * slope))
    dr.forward(step)
    return np.asarray(dr.grad(fraction)).reshape(np.shape(pressure_kPa))


def _check(sensor: Sensor, parameter: str | Press) -> None:
    """Refuse what the sensor does not have, or what does not change smoothly."""
    name = parameter if isinstance(parameter, str) else PRESSURE
    if name not in NAMES:
        raise ValueError(f"parameters: received {name!r}; allowed: {', '.join(NAMES)}, or a Press")
    if name in (*CONTACT, PRESSURE) and sensor.skin.contact == "full":
        raise NotModelled(f"parameters: received {name!r}; allowed only where skin.contact is 'rough'")
    for number, led in enumerate(sensor.leds):
        received = f"leds.{number} for {name!r}: received"
        if name == "leds.flux_W" and led.flux_W == 0.0:
            raise ValueError(f"{received} flux_W = 0; allowed: more than 0")
        if name == "leds.exponent" and (led.pattern != "power" or led.tilt_deg):
            raise ValueError(
                f"{received} pattern {led.pattern!r}, tilt {led.tilt_deg:g}; allowed: 'power', tilt 0"
            )
        if name in ("leds.along_mm", "leds.z_mm") and (
            led.side == "below" or (led.coupling == "air" and sensor.guide.walls != "polished")
        ):
            raise NotModelled(
                f"{received} side {led.side!r}, walls {sensor.guide.walls!r}; allowed: LEDs at the sides, "
                "embedded or before polished walls"
            )
    if name == "leds.z_mm" and direct.crossed(sensor):
        raise NotModelled(
            f"parameters: received {name!r}; allowed only where no face between layers crosses an LED's disc"
        )


def _moves(renderer: Renderer, pressed: OpticalSurface, parameter: str | Press) -> _Moves:
    sensor, still = renderer.sensor, np.zeros(pressed.pressure_kPa.shape)
    if isinstance(parameter, Press):
        fraction, change = still, parameter.pressure_kPa
        if change is not None:
            fraction = fraction_slope(sensor, pressed.pressure_kPa, PRESSURE, change)
        return _Moves(fraction, parameter.displacement_mm, None)
    if parameter in CONTACT:
        return _Moves(fraction_slope(sensor, pressed.pressure_kPa, parameter), None, None)
    if parameter == PRESSURE:
        rising = fraction_slope(sensor, pressed.pressure_kPa, parameter, pressed.pressure_kPa)
        return _Moves(rising, None, None)
    return _Moves(still, None, _other(renderer, parameter) if parameter in GAPS else None)


def _other(renderer: Renderer, name: str) -> Other:
    """Derivative of the contact's optics to a number of the skin, by differences of second order."""
    sensor, field = renderer.sensor, name.removeprefix("skin.")
    value = getattr(sensor.skin, field)
    step = GAPS[name] * (value if field == "rms_height_um" else 1.0)
    weights = {-1: -0.5, 1: 0.5}
    if field != "rms_height_um" and value - step < (1.0 if field == "gap_index" else 0.0):
        weights = {0: -1.5, 1: 2.0, 2: -0.5}
    elif field == "dust" and value + step > 1.0:
        weights = {0: 1.5, -1: -2.0, -2: 0.5}
    transmittance: Array | float = 0.0
    held: Array | float = 0.0
    thrown: list[Array | float] = [0.0 for _ in renderer.behind.coupling.thrown]
    for number, weight in weights.items():
        there = replace(sensor, skin=replace(sensor.skin, **{field: value + number * step}))
        optics = build.optics_of(there)
        coupling, share = build.coupling_of(there, optics), weight / step
        transmittance = transmittance + share * optics.transmittance
        held = held + share * coupling.held
        thrown = [one + share * more for one, more in zip(thrown, coupling.thrown, strict=True)]
    change = np.asarray(transmittance)
    peak = max(float(np.abs(change).max()), 1e-30)
    nothing = np.zeros(len(change))
    even = ContactOptics(change / peak, nothing, nothing)
    basis = angular_basis(even, renderer.behind.coupling, _ROUGHLY, 10.0 * _ROUGHLY)
    turning = tuple(replace(part, rows=peak * part.rows) for part in basis.turning)
    basis = replace(basis, rows=peak * basis.rows, turning=turning)
    return Other(change, np.asarray(held), tuple(np.asarray(one) for one in thrown), basis)


def _gathered(
    renderer: Renderer, basis: Basis, pressed: OpticalSurface, names: Sequence[str], moves: Sequence[_Moves]
) -> Landed:
    """Gathered light and its derivatives."""
    sensor = renderer.sensor
    ground = direct.relief(sensor, pressed)
    light = direct.on(sensor, basis, ground).astype(np.float32)
    slopes = np.zeros((len(moves), len(light), basis.told, *light.shape[2:]), np.float32)
    for number, (name, move) in enumerate(zip(names, moves, strict=True)):
        change = direct.Change(
            along_mm=float(name == "leds.along_mm"),
            z_mm=float(name == "leds.z_mm"),
            exponent=float(name == "leds.exponent"),
        )
        if move.displacement_mm is not None:
            low, high = (direct.relief(sensor, there) for there in _beside(pressed, move.displacement_mm))
            change = direct.Change(ground=(high - low) * _per(move.displacement_mm))
        if name in _MOVING or change.ground is not None:
            slopes[number] = direct.answers(sensor, renderer.basis, ground, change)
    return Landed(light, slopes)


def _on_cells(renderer: Renderer, pressed: OpticalSurface, move: _Moves) -> Array:
    """Derivative of the contact fraction in space, (GRID, GRID)."""
    if not move.fraction.any() and move.displacement_mm is None:
        return np.zeros((transport.GRID, transport.GRID))
    step = dr.opaque(mi.Float, 0.0)
    dr.enable_grad(step)
    _hang(renderer, pressed, move, step)
    fraction, _, _ = transport.glance(renderer.scene, renderer.sensor)
    dr.forward(step)
    found = np.asarray(dr.grad(fraction)).astype(np.float64)
    build.put_surface(renderer.scene, renderer.sensor, pressed)
    return found.reshape(transport.GRID, transport.GRID)


def _hang(renderer: Renderer, pressed: OpticalSurface, move: _Moves, step: mi.Float) -> None:
    """Let the scene's surface hang on a step of a parameter."""
    build.put_surface(renderer.scene, renderer.sensor, pressed)
    parameters = mi.traverse(renderer.scene)
    changes = {"vertex_contact_fraction": surface.with_skirt(pressed, move.fraction)}
    if move.displacement_mm is not None:
        low, high = (surface.triangulate(one) for one in _beside(pressed, move.displacement_mm))
        per = _per(move.displacement_mm)
        changes["vertex_positions"] = (high.vertices - low.vertices) * per
        changes["vertex_normals"] = (high.vertex_normals - low.vertex_normals) * per
    for name, change in changes.items():
        if np.any(change):
            slope = floats(change)
            parameters[f"contact.{name}"] = mi.Float(parameters[f"contact.{name}"]) + step * slope
    parameters.update()


def _beside(pressed: OpticalSurface, move_mm: Array) -> tuple[OpticalSurface, OpticalSurface]:
    """The surface moved a little back and forth."""
    little = 0.5 / _per(move_mm) * move_mm
    low, high = (
        replace(pressed, displacement_mm=pressed.displacement_mm + sign * little) for sign in (-1.0, 1.0)
    )
    return low, high


def _per(move_mm: Array) -> float:
    """Over which a difference `_beside` is a derivative."""
    return 0.5 * max(float(np.abs(move_mm).max()), 1e-30) / _RELIEF_MM
