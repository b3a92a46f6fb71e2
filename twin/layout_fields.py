"""From what a trial took to a sensor with its protocol: fields of designs, of the layout and of the protocol.

A study's fields are dotted names of the design ("leds.*.z_mm"), and these:

- `layout.leds`: number of LEDs, the design's first one repeated; `layout.arrangement`: "around" (in turn on
  +x, -x, +y, -y), "facing" (+x and -x only) or "one side" (+x), spread evenly along each side;
- `layout.power_W`: flux of all LEDs together, shared evenly;
- `layout.sheet_mm`: thickness of a white contact sheet, 0 for none;
- `layout.match_gain`: true for a gain at which the full well is the converter's last count;
- `layout.layers`: thickness and modulus of each layer, [[mm, kPa], ...] from the contact side, all of the
  waveguide's index;
- `protocol.indentation_mm`, `protocol.positions_mm` (lists, as choices) and `protocol.frames`.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from pydantic import TypeAdapter, ValidationError

from twin.complaint import DesignError, from_validation, shown
from twin.design import Design, parse_design
from twin.evaluate import Layout, optical_key
from twin.fields import tables_of
from twin.layout_study import Axis, LayoutStudy, Use, axis

Value = float | int | str
Kind = str

SPECIAL = (
    "layout.leds",
    "layout.arrangement",
    "layout.power_W",
    "layout.sheet_mm",
    "layout.layers",
    "layout.match_gain",
)
PROTOCOL = ("protocol.indentation_mm", "protocol.positions_mm", "protocol.frames")
SHEET = {"modulus_kPa": 100.0, "scattering_per_mm": 30.0, "absorption_per_mm": 0.01}
"""The white sheet of `layout.sheet_mm`: silicone full of titanium dioxide."""

_SIDES = {"around": ("+x", "-x", "+y", "-y"), "facing": ("+x", "-x"), "one side": ("+x",)}
_WHOLE = ("layout.leds", "protocol.frames")


def said(value: Any) -> Value:
    """Return a value as Optuna and `Layout.values` hold it: lists and tables as JSON text."""
    if isinstance(value, list | tuple | dict) or value is None or isinstance(value, bool):
        return json.dumps(value, sort_keys=True)
    return value


def meant(name: str, value: Value, choices: Sequence[Any] | None) -> Any:
    """Return what a value of `said` stands for."""
    for choice in choices or ():
        if said(choice) == value and type(said(choice)) is type(value):
            return list(choice) if isinstance(choice, tuple) else choice
    return value


def axes(study: LayoutStudy, design: Design) -> dict[str, Axis]:
    """Return what each field may be, checked against the design; raises `DesignError` for unknown fields."""
    found = {name: axis(f"fields.{name}", value) for name, value in study.fields.items()}
    tables = tables_of(design)
    for name, one in found.items():
        where = f"fields.{name}"
        if name.startswith("protocol.") and name not in PROTOCOL:
            raise DesignError(where, "it", f"one of {', '.join(PROTOCOL)}")
        if name.startswith("layout.") and name not in SPECIAL:
            raise DesignError(where, "it", f"one of {', '.join(SPECIAL)}")
        if name in (
            "protocol.indentation_mm",
            "protocol.positions_mm",
            "layout.arrangement",
            "layout.layers",
        ):
            if one.choices is None:
                raise DesignError(where, "a range", "{choices = [...]}")
        elif name not in (*SPECIAL, *PROTOCOL):
            _paths(tables, name.split("."), where, name)
        ends = one.range if one.range is not None and whole(name, design) else ()
        if not all(float(end).is_integer() for end in ends):
            raise DesignError(where, shown(list(ends)), "whole numbers")
    for name in study.set:
        if name not in SPECIAL:
            _paths(tables, name.split("."), f"set.{name}", name)
    return found


def whole(name: str, design: Design) -> bool:
    """Whether a field is a whole number."""
    if name in _WHOLE:
        return True
    if name in (*SPECIAL, *PROTOCOL):
        return False
    tables = tables_of(design)
    values = [_get(tables, path) for path in _paths(tables, name.split("."), f"fields.{name}", name)]
    return all(isinstance(value, int) and not isinstance(value, bool) for value in values)


def base(study: LayoutStudy, design: Design) -> Layout:
    """The study's own design with its own protocol; raises `DesignError`."""
    changed = changed_design(design, study.set, "set")
    return Layout(changed, study.use(changed), {})


def layout(study: LayoutStudy, design: Design, values: Mapping[str, Value]) -> Layout:
    """Return the layout of a trial.

    Raises
    ------
    DesignError
        In one line, for a sensor or a protocol that cannot be.
    """
    own = axes_of(study)
    wanted = {name: meant(name, value, own[name].choices) for name, value in values.items()}
    fields = {name: value for name, value in wanted.items() if name not in PROTOCOL}
    made = changed_design(design, {**study.set, **fields}, "fields")
    protocol = study.use(made)
    if "protocol.indentation_mm" in wanted or "protocol.positions_mm" in wanted:
        given = {
            name.removeprefix("protocol."): wanted[name]
            for name in ("protocol.indentation_mm", "protocol.positions_mm")
            if name in wanted
        }
        try:
            use = TypeAdapter(Use).validate_json(json.dumps(given), strict=True)
        except ValidationError:
            allowed = "lists of press depths, mm, and of places [x, y], mm"
            raise DesignError("protocol", shown(given), allowed) from None
        if use.indentation_mm is not None:
            protocol = replace(protocol, indentation_mm=use.indentation_mm)
        if "positions_mm" in given:
            protocol = replace(protocol, positions_mm=use.positions_mm)
    if "protocol.frames" in wanted:
        protocol = replace(protocol, frames=_frames(wanted["protocol.frames"]))
    return Layout(made, protocol, dict(values))


def _frames(value: Any) -> int:
    """The number of exposures that a value stands for, as a study's `[protocol]` may say it."""
    whole_number = int(value) if isinstance(value, float) and value.is_integer() else value
    kind = TypeAdapter(Use)
    given = {"frames": whole_number}
    try:
        frames = kind.validate_json(json.dumps(given), strict=True).frames
    except ValidationError as error:
        raise from_validation(error, given, kind.json_schema()).renamed("fields.protocol.frames") from None
    assert frames is not None  # a study's file has no null
    return frames


def axes_of(study: LayoutStudy) -> dict[str, Axis]:
    """What each field may be."""
    return {name: axis(f"fields.{name}", value) for name, value in study.fields.items()}


def changed_design(design: Design, fields: Mapping[str, Any], where: str) -> Design:
    """Return the design with some fields at other values; those of the layout come first."""
    tables = tables_of(design)
    for name in SPECIAL:
        if name in fields:
            _arrange(tables, name, fields)
    for name, value in fields.items():
        if name in SPECIAL:
            continue
        for path in _paths(tables, name.split("."), f"{where}.{name}", name):
            _put(tables, path, value)
    if fields.get("layout.match_gain"):
        camera = tables["camera"]
        camera["gain_e_per_dn"] = (
            camera["full_well_e"] * camera["binning"] ** 2 / (2 ** camera["bits"] - 1 - camera["offset_dn"])
        )
    return parse_design(tables)


def kind_of(study: LayoutStudy, design: Design, name: str, one: Axis) -> Kind:
    """Return what a field changes: "camera" (counts alone), "optical" (light again) or "mechanical".

    Found by what really differs between the values that the field may take.
    """
    from twin.coarse import coarse

    if name == "protocol.frames":
        return "camera"
    if name in PROTOCOL:
        return "optical"
    if name == "layout.layers":
        return "mechanical"
    seen, pressed = set(), set()
    for value in some(one, whole(name, design)):
        try:
            made = layout(study, design, {name: said(value)})
            there, small = made.design, coarse(made.design)[0]
        except DesignError:
            continue
        felt = there.effective_modulus_kPa, there.surface.rms_slope, there.surface.kappa
        seen.add(repr((optical_key(small), felt, made.protocol.indentation_mm)))
        pressed.add(repr((there.probe(), there.slab())))
    if len(pressed) > 1:
        return "mechanical"
    return "optical" if len(seen) > 1 else "camera"


def some(one: Axis, integer: bool) -> list[Any]:
    """A few values of a field: its choices, or the ends and the middle of its range."""
    if one.choices is not None:
        return list(one.choices)
    assert one.range is not None
    low, high = one.range
    middle = round((low + high) / 2) if integer else (low + high) / 2
    return [int(v) if integer else float(v) for v in (low, middle, high)]


def _arrange(tables: dict[str, Any], name: str, fields: Mapping[str, Any]) -> None:
    """Apply one of `SPECIAL`."""
    value = fields[name]
    where = f"fields.{name}"
    if name in ("layout.leds", "layout.arrangement"):
        count = fields.get("layout.leds", len(tables["leds"]))
        if not isinstance(count, int) or isinstance(count, bool) or not 1 <= count <= 64:
            raise DesignError("fields.layout.leds", shown(count), "an integer >= 1 and <= 64")
        way = fields.get("layout.arrangement", "around")
        if not isinstance(way, str) or way not in _SIDES:
            raise DesignError("fields.layout.arrangement", shown(way), f"one of {', '.join(_SIDES)}")
        tables["leds"] = _placed(tables["leds"][0], count, _SIDES[way], tables["waveguide"]["width_mm"])
    elif name == "layout.power_W":
        if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
            raise DesignError(where, shown(value), "a number >= 0, W")
        for led in tables["leds"]:
            led["flux_lm"] = None
            led["flux_W"] = float(value) / len(tables["leds"])
    elif name == "layout.sheet_mm":
        if isinstance(value, bool) or not isinstance(value, int | float) or not value >= 0:
            raise DesignError(where, shown(value), "a number >= 0, mm")
        tables["surface"]["sheet"] = {**SHEET, "thickness_mm": float(value)} if value else None
    elif name == "layout.layers":
        rows = np.asarray(value, dtype=object)
        if rows.ndim != 2 or rows.shape[1] != 2:
            raise DesignError(where, shown(value), "a list of [thickness in mm, modulus in kPa]")
        before = tables["waveguide"]["layers"]
        if any(layer.get("refractive_index") is not None for layer in before):
            raise DesignError(where, shown(value), "no layers where the base's have indices of their own")
        poisson = before[0]["poisson"]
        tables["waveguide"]["layers"] = [
            {"thickness_mm": thickness, "modulus_kPa": modulus, "poisson": poisson}
            for thickness, modulus in value
        ]


def _placed(led: dict[str, Any], count: int, sides: tuple[str, ...], width: float) -> list[dict[str, Any]]:
    """So many LEDs in turn on the sides, evenly along each."""
    on = [[number for number in range(count) if number % len(sides) == k] for k in range(len(sides))]
    found: list[dict[str, Any]] = []
    for number in range(count):
        side = number % len(sides)
        place, many = on[side].index(number), len(on[side])
        along = ((place + 0.5) / many - 0.5) * width
        found.append({**led, "side": sides[side], "along_mm": along})
    return found


def _paths(node: Any, steps: Sequence[str], where: str, name: str) -> list[tuple[str | int, ...]]:
    """Return the places that a dotted name stands for; "*" is every element of a list."""
    found: list[tuple[str | int, ...]] = [()]
    for depth, step in enumerate(steps):
        after: list[tuple[str | int, ...]] = []
        for path in found:
            here = _get(node, path)
            if isinstance(here, list) and step == "*":
                after += [(*path, number) for number in range(len(here))]
            elif isinstance(here, list) and step.isascii() and step.isdigit() and int(step) < len(here):
                after.append((*path, int(step)))
            elif isinstance(here, Mapping) and step in here:
                after.append((*path, step))
            else:
                place = ".".join(steps[:depth]) or "the design"
                names = (
                    ", ".join(here)
                    if isinstance(here, Mapping)
                    else f'"*" or 0 to {len(here) - 1}'
                    if (isinstance(here, list))
                    else "nothing below it"
                )
                special = f", {', '.join((*SPECIAL, *PROTOCOL))}" if depth == 0 else ""
                raise DesignError(where, shown(step), f"a field of {place}: {names}{special}")
        found = after
    return found


def _get(node: Any, path: Sequence[str | int]) -> Any:
    for step in path:
        node = node[step]
    return node


def _put(node: Any, path: Sequence[str | int], value: Any) -> None:
    before = _get(node, path[:-1])
    number = isinstance(before[path[-1]], int) and not isinstance(before[path[-1]], bool)
    if isinstance(value, float) and value.is_integer() and number:
        value = int(value)
    if path[-1] == "flux_W" and "flux_lm" in before:
        before["flux_lm"] = None
    before[path[-1]] = value
