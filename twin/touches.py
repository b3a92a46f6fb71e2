"""The contact of a press and how it changes with what is not known: all that light needs of the mechanics.

Fields stand on the regular grid of `scenes.surface`, so that presses on different meshes can be subtracted.
The pressure is the one that the rough contact's law feels under the design's own modulus E* and slope h':
A_r depends on p κ / (E* h') alone, so what changes E*, h' or κ is a change of the pressure.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

import fem
from fem import spheres
from scenes.surface import OpticalSurface, resample
from twin import forward, presses
from twin.complaint import DesignError, shown
from twin.design import Design, parse_design
from twin.fields import number_at, put, tables_of
from twin.forward import DEPTH, INCLUSION, Unknown

if TYPE_CHECKING:
    from fem import Emulator

Floats = NDArray[np.float64]
Mechanics = Literal["emulator", "linear"]

_SKIN = {"surface.rms_slope": -1.0, "surface.kappa": 1.0}
"""What the contact's law feels of them: the pressure times their power."""
_DEGREE = 6
"""Of multipoles: those beyond the fourth are 1 % of a press, but tell size, depth and modulus apart."""
_SOLID = ("specimen.modulus_kPa", "specimen.thickness_mm", "specimen.poisson")


@dataclass(frozen=True)
class Touch:
    """One press at one place, with and without the inclusion.

    Attributes
    ----------
    fields, plain : (4, n, n), displacement along x, y, z (mm) and pressure (kPa), at [iy, ix] of the nodes.
    slopes : by unknown the derivatives of both, (2, 4, n, n), per its unit, per e-fold where relative.
    steps : by unknown half the difference that they were found over.
    """

    fields: Floats
    plain: Floats
    slopes: dict[str, NDArray[np.float32]]
    steps: dict[str, float]


def touches_contact(unknown: str) -> bool:
    """Whether the pictures know of an unknown through the contact of the press."""
    layer = unknown.startswith("waveguide.layers.") and unknown.endswith((".modulus_kPa", ".poisson"))
    return unknown in (*INCLUSION, DEPTH, *_SOLID, *_SKIN) or layer


def knows_inclusion(unknown: str) -> bool:
    """Whether an unknown leaves the picture without inclusion alone."""
    return unknown in INCLUSION


def surface_of(design: Design, fields: Floats) -> OpticalSurface:
    """The contact surface as light needs it, from (4, n, n) fields."""
    line = np.linspace(-0.5, 0.5, fields.shape[-1]) * design.waveguide.width_mm
    return OpticalSurface(line, np.moveaxis(fields[:3], 0, -1), fields[3], _rest(design, line))


def touch(
    design: Design,
    inclusion: fem.Inclusion,
    level: float,
    position: tuple[float, float],
    unknowns: Sequence[Unknown],
    emulator: Emulator | None,
) -> Touch:
    """Return the contact of one press and its slopes to those unknowns that move it.

    Parameters
    ----------
    position : of the sensor, mm, minus the design's; the specimen is taken to go on beside it, so that only
        the inclusion's offset changes.
    emulator : of the design's mechanics; without, solved on a coarse mesh at small strain, where fields are
        in proportion to the depth: spheres by multipoles in plain tissue (`fem.multipoles`), what these do
        not model on a mesh around it (`fem.press`, "linear").

    Raises
    ------
    DesignError, fem.NotModelled
        In one line.
    """
    x, y = (inclusion.offset[axis] - position[axis] for axis in (0, 1))
    there = replace(inclusion, offset=(x, y))
    wanted = [unknown for unknown in unknowns if touches_contact(unknown.name)]
    return (
        _emulated(design, there, level, wanted, emulator)
        if emulator
        else _solved(design, there, level, wanted)
    )


def _emulated(
    design: Design, ball: fem.Inclusion, level: float, unknowns: Sequence[Unknown], emulator: Emulator
) -> Touch:
    def fields(changes: dict[str, float]) -> tuple[Floats, Floats]:
        there, inclusion, scale = _changed(design, ball, changes)
        presses.check(there, inclusion, [scale * level])
        press = presses.emulated(there, inclusion, [scale * level], emulator)[0]
        return _both(design, there, press.surface)

    middle = fields({})
    found: dict[str, NDArray[np.float32]] = {}
    steps = {}
    for unknown in unknowns:
        value = value_of(design, ball, unknown.name)
        steps[unknown.name] = step = forward.step_of(unknown, value)
        if unknown.name in _SKIN:
            found[unknown.name] = _skin(unknown, value, middle)
            continue
        found[unknown.name] = _slope(fields, unknown, value, step, middle)
    return Touch(*middle, found, steps)


def _slope(
    fields: Callable[[dict[str, float]], tuple[Floats, Floats]],
    unknown: Unknown,
    value: float,
    step: float,
    middle: tuple[Floats, Floats],
) -> NDArray[np.float32]:
    def at(to: float) -> Floats:
        return np.stack(fields({unknown.name: to}))

    return forward.slope_of(at, unknown, value, step, np.stack(middle)).astype(np.float32)


def _solved(design: Design, ball: fem.Inclusion, level: float, unknowns: Sequence[Unknown]) -> Touch:
    """At 1 mm, then in proportion; a centred inclusion shares its symmetry."""
    presses.check(design, ball, [level])
    steps = {u.name: forward.step_of(u, value_of(design, ball, u.name)) for u in unknowns}
    by_multipoles = mesh_stays(design, ball, steps)

    def fields(changes: dict[str, float]) -> tuple[Floats, Floats]:
        there, inclusion, _ = _changed(design, ball, changes)
        there.check_inclusion(inclusion)
        return _both(design, there, _press(there, inclusion, by_multipoles).surface)

    middle = fields({})
    square = ball.offset == (0.0, 0.0)
    found: dict[str, NDArray[np.float32]] = {}
    for unknown in unknowns:
        name = unknown.name
        value, step = value_of(design, ball, name), steps[name]
        if name in _SKIN:
            found[name] = _skin(unknown, value, middle)
        elif name == DEPTH:
            found[name] = np.stack(middle).astype(np.float32)
        elif square and name == "offset_y_mm" and "offset_x_mm" in found:
            found[name] = _turned(found["offset_x_mm"])
        elif square and name == "offset_x_mm":
            high = fields({name: step})
            found[name] = _difference(high, (_mirrored(high[0]), _mirrored(high[1])), step)
        else:
            found[name] = _slope(fields, unknown, value, step, middle)
    for name in found:
        if knows_inclusion(name):
            # a mesh that follows the inclusion takes the error of the background along: what the inclusion
            # adds is the difference of two presses on one mesh
            found[name][0] -= found[name][1]
            found[name][1] = 0.0
    scaled = {name: (level * slope).astype(np.float32) for name, slope in found.items()}
    return Touch(level * middle[0], level * middle[1], scaled, steps)


def mesh_stays(design: Design, ball: fem.Inclusion, steps: dict[str, float]) -> bool:
    """Whether a solved inclusion, and all that it is changed to (``steps`` by unknown), is pressed by
    multipoles, whose mesh stays. One that follows the inclusion leaves ripples in the pressure, 4 % of what
    its size changes, that tell size from modulus better than the press does."""
    own = [name for name in steps if knows_inclusion(name)]
    ends = [{name: value_of(design, ball, name) + k * steps[name]} for name in own for k in (-2, -1, 1, 2)]
    for changes in [{}, *ends]:
        try:
            changed = _changed(design, ball, changes)[1]
            spheres.refuse(design.probe(), design.slab(), changed, design.pose())
        except fem.NotModelled:
            return False
        except ValueError:  # it does not fit: no slope is taken there
            continue
    return True


def value_of(design: Design, ball: fem.Inclusion, name: str) -> float:
    """Return what an unknown is expected to be."""
    if name in INCLUSION:
        values = (ball.size, ball.depth, ball.modulus, *ball.offset)
        return float(dict(zip(INCLUSION, values, strict=True))[name])
    if name == DEPTH:
        return 1.0
    found = number_at(tables_of(design), name, "unknowns")
    if found is None:
        raise DesignError("unknowns", shown(name), "a number that the design holds")
    return found


def _press(design: Design, ball: fem.Inclusion, by_multipoles: bool) -> fem.Press | fem.Emulated:
    """By 1 mm."""
    if by_multipoles:
        return presses.expanded(design, ball, [1.0], quality="preview", degree=_DEGREE)[0]
    bodies = design.probe(), design.slab(), ball
    return _tied(fem.press(*bodies, 1.0, mechanics="linear", quality="preview", estimate=False))


def _tied(press: fem.Press) -> fem.Press:
    """The press, if its contact is closed all over: only then are fields in proportion to the depth."""
    if press.path != "tied":
        received = f"a press whose contact is {press.path}"
        raise fem.NotModelled(f"press: received {received}; not modelled here: contact that opens (domes)")
    return press


def _changed(
    design: Design, ball: fem.Inclusion, changes: dict[str, float]
) -> tuple[Design, fem.Inclusion, float]:
    """Design, inclusion and factor of the press depth with some unknowns at other values."""
    names = {"size_mm": "size", "depth_mm": "depth", "modulus_kPa": "modulus"}
    own: dict[str, Any] = {names[name]: value for name, value in changes.items() if name in names}
    own["offset"] = tuple(changes.get(name, ball.offset[k]) for k, name in enumerate(INCLUSION[3:]))
    fields = [(name, value) for name, value in changes.items() if name not in INCLUSION and name != DEPTH]
    there = parse_design(put(tables_of(design), fields)) if fields else design
    return there, replace(ball, **own), changes.get(DEPTH, 1.0)


def _both(design: Design, there: Design, surface: Any) -> tuple[Floats, Floats]:
    """Fields with and without inclusion, the pressure as if under the E* of `design`."""
    felt = design.effective_modulus_kPa / there.effective_modulus_kPa
    found = []
    for suffix in ("", "_0"):
        shape = resample(surface, design.waveguide.width_mm, suffix=suffix)
        found.append(np.stack([*np.moveaxis(shape.displacement_mm, -1, 0), felt * shape.pressure_kPa]))
    return found[0], found[1]


def _difference(high: Sequence[Floats], low: Sequence[Floats], step: float) -> NDArray[np.float32]:
    return ((np.stack(high) - np.stack(low)) / (2.0 * step)).astype(np.float32)


def _skin(unknown: Unknown, value: float, middle: tuple[Floats, Floats]) -> NDArray[np.float32]:
    slope = np.zeros((2, *middle[0].shape), np.float32)
    slope[:, 3] = np.stack(middle)[:, 3] * _SKIN[unknown.name] / (1.0 if unknown.relative else value)
    return slope


def _mirrored(fields: Floats) -> Floats:
    """Fields of the press mirrored in x = 0."""
    sign = np.array([-1.0, 1.0, 1.0, 1.0])[:, None, None]
    return np.asarray(sign * fields[..., ::-1])


def _turned(slopes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Slopes to y from those to x, of a press that is the same with x and y exchanged."""
    return np.ascontiguousarray(slopes.swapaxes(-1, -2)[:, [1, 0, 2, 3]])


def _rest(design: Design, line: Floats) -> Floats:
    """Height of the undeformed surface: that of a dome, or 0."""
    radius = design.waveguide.dome_radius_mm
    if radius is None:
        return np.zeros((line.size, line.size))
    square = line[:, None] ** 2 + line**2
    return np.asarray(np.sqrt(radius**2 - square) - radius)
