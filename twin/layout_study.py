"""A study of kind "layout": which sensors are compared, on what, by what; a checked value from a TOML file.

Fields, objectives and an example: EXPLORE.md.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass as plain
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

import fem
from twin.complaint import DesignError, from_validation, not_finite, shown
from twin.design import Depth, Design, Offset
from twin.evaluate import UNKNOWNS, Protocol, check_unknown
from twin.forward import Unknown
from twin.objectives import BOUNDS, OBJECTIVES
from twin.study import CONFIG, FileName, Name, Number, Seed
from twin.study_file import read_study, study_tables

MAX_TRIALS = 100_000
MAX_CHOICES = 1000

Quality = Literal["preview", "standard"]
Position = tuple[Offset, Offset]


@dataclass(frozen=True, config=CONFIG)
class Axis:
    """What one field of the sensor may be: a range, or choices."""

    range: Annotated[tuple[Number, Number] | None, Field(description="[lowest, highest]")] = None
    choices: Annotated[tuple[Any, ...] | None, Field(min_length=1, max_length=MAX_CHOICES)] = None
    log: bool = False
    points: Annotated[int, Field(ge=2, le=1000, description="of a range, in a grid")] = 3


@dataclass(frozen=True, config=CONFIG)
class Ball:
    """One inclusion that the layouts are judged on."""

    size_mm: Number
    depth_mm: Number
    modulus_kPa: Number
    offset_x_mm: Number = 0.0
    offset_y_mm: Number = 0.0


@dataclass(frozen=True, config=CONFIG)
class Nuisance:
    """One thing that is not known exactly."""

    name: Name
    sd: Number
    relative: bool = False


@dataclass(frozen=True, config=CONFIG)
class Use:
    """How the sensor is used where no field says otherwise."""

    indentation_mm: Annotated[tuple[Depth, ...] | None, Field(min_length=1, max_length=20)] = None
    positions_mm: Annotated[tuple[Position, ...], Field(min_length=1, max_length=50)] = ((0.0, 0.0),)
    frames: Annotated[int | None, Field(ge=1, le=10_000)] = None


@dataclass(frozen=True, config=CONFIG)
class Search:
    """How layouts are chosen."""

    method: Literal["grid", "latin", "nsga2", "tpe"]
    trials: Annotated[int, Field(ge=1, le=MAX_TRIALS)] | None = None
    population: Annotated[int, Field(ge=2, le=1000, description="of nsga2")] = 20


@dataclass(frozen=True, config=CONFIG)
class LayoutStudy:
    """What is to be explored."""

    kind: Literal["layout"]
    name: Name
    fields: Annotated[dict[Name, Any], Field(min_length=1, max_length=100)]
    objectives: Annotated[dict[Name, Literal["minimize", "maximize"]], Field(min_length=1, max_length=10)]
    search: Search
    description: Annotated[str, Field(max_length=10_000)] = ""
    question: Annotated[str, Field(max_length=1000)] = ""
    design: FileName = "tsis"
    set: Annotated[dict[Name, Any], Field(max_length=100)] = Field(default_factory=dict)
    protocol: Use = Use()
    inclusions: Annotated[tuple[Ball, ...], Field(min_length=1, max_length=100)] = (
        Ball(6.0, 5.0, 60.0),
        Ball(11.0, 5.0, 100.0),
        Ball(6.0, 9.0, 100.0),
        Ball(11.0, 9.0, 60.0),
    )
    unknowns: Annotated[tuple[Nuisance, ...], Field(min_length=1, max_length=100)] | None = None
    constraints: Annotated[tuple[Name, ...], Field(max_length=100)] = ()
    exposure_fill: Annotated[float | None, Field(gt=0.0, le=1.0)] = None
    emulator: FileName | None = None
    quality: Quality = "preview"
    seed: Seed = 0

    def __post_init__(self) -> None:
        for name, value in self.fields.items():
            axis(f"fields.{name}", value)
        for name in self.objectives:
            if name not in OBJECTIVES:
                raise DesignError(f"objectives.{name}", "it", f"one of {', '.join(OBJECTIVES)}")
        for unknown in self.unknown():
            check_unknown(unknown)
        known = {unknown.name for unknown in self.unknown()}
        asked = [*self.objectives, *(limit.name for limit in limits(self.constraints))]
        for name in asked:
            if name in BOUNDS and BOUNDS[name] not in known:
                raise DesignError(f"objectives.{name}", f"it without the unknown {BOUNDS[name]}", "both")
        if self.search.method != "grid" and self.search.trials is None:
            raise DesignError("search.trials", "nothing", "how many layouts, an integer > 0")

    def unknown(self) -> tuple[Unknown, ...]:
        """The unknowns, by default those of the paper's box and a careful owner."""
        if self.unknowns is None:
            return UNKNOWNS
        return tuple(Unknown(one.name, one.sd, one.relative) for one in self.unknowns)

    def balls(self) -> tuple[fem.Inclusion, ...]:
        """The inclusions; raises `DesignError` for what none can be."""
        found = []
        for number, one in enumerate(self.inclusions):
            values = {"size": one.size_mm, "depth": one.depth_mm, "modulus": one.modulus_kPa}
            try:
                place = one.offset_x_mm, one.offset_y_mm
                found.append(fem.Inclusion(one.size_mm, one.depth_mm, one.modulus_kPa, place))
            except ValidationError as error:
                what = from_validation(error, values, TypeAdapter(fem.Inclusion).json_schema())
                raise what.renamed(f"inclusions.{number}.{what.field}") from None
        return tuple(found)

    def use(self, design: Design) -> Protocol:
        """The protocol where no field says otherwise: the design's press levels and exposures."""
        levels = self.protocol.indentation_mm or design.press.indentation_mm
        return Protocol(levels, self.protocol.positions_mm, self.protocol.frames or design.camera.frames)


@plain(frozen=True)
class Limit:
    """A constraint: an objective that is at most (``sign`` 1) or at least (-1) a value."""

    name: str
    sign: int
    value: float
    text: str

    def excess(self, found: float) -> float:
        """How far it is violated; 0 and less where it holds."""
        return self.sign * (found - self.value)


@plain(frozen=True)
class Source:
    """A study, the file's text, and the folder that its relative names start from."""

    study: LayoutStudy
    text: str
    folder: Path
    name: str


_LIMIT = re.compile(r"\s*([A-Za-z_]+)\s*(<=|>=)\s*([-+0-9.eE]+)\s*")


def axis(where: str, value: Any) -> Axis:
    """Return what a field may be: a list of two numbers is a range; raises `DesignError`."""
    allowed = "[lowest, highest], {range = [lowest, highest]} or {choices = [...]}"
    if isinstance(value, list | tuple):
        value = {"range": list(value)}
    if not isinstance(value, dict):
        raise DesignError(where, shown(value), allowed)
    try:
        found = TypeAdapter(Axis).validate_python(value)
    except ValidationError as error:
        what = from_validation(error, value, TypeAdapter(Axis).json_schema())
        raise DesignError(where, what.received, allowed) from None
    if (found.range is None) == (found.choices is None):
        raise DesignError(
            where, "both range and choices" if found.range else "neither range nor choices", allowed
        )
    if found.range is not None:
        low, high = found.range
        if not low < high:
            raise DesignError(
                where, shown(list(found.range)), "[lowest, highest], the first below the second"
            )
        if found.log and low <= 0:
            raise DesignError(where, shown(low), "a lowest value > 0 where log = true")
    if found.choices is not None:
        said = [json.dumps(choice, sort_keys=True, default=str) for choice in found.choices]
        for number, choice in enumerate(said):
            if choice in said[:number]:
                raise DesignError(f"{where}.choices", f"{choice} twice", "each once")
    return found


def limits(constraints: tuple[str, ...]) -> list[Limit]:
    """Return the constraints; raises `DesignError` for those that nothing meets."""
    found: list[Limit] = []
    for number, text in enumerate(constraints):
        where, said = f"constraints.{number}", _LIMIT.fullmatch(text)
        if said is None:
            raise DesignError(where, shown(text), '"OBJECTIVE <= NUMBER" or "OBJECTIVE >= NUMBER"')
        name, sign = said[1], 1 if said[2] == "<=" else -1
        if name not in OBJECTIVES:
            raise DesignError(where, shown(name), f"one of {', '.join(OBJECTIVES)}")
        try:
            value = float(said[3])
        except ValueError:
            raise DesignError(where, shown(said[3]), "a number") from None
        objective = OBJECTIVES[name]
        if (sign == 1 and value < objective.least) or (sign == -1 and value > objective.most):
            allowed = f"what {name} can be: {objective.least:g} to {objective.most:g}"
            raise DesignError(where, shown(text), allowed)
        limit = Limit(name, sign, value, text)
        for other in found:
            if other.name == name and other.sign != sign and sign * (other.value - value) > 0:
                raise DesignError(
                    where, f"{text!r} beside {other.text!r}", "constraints that can both be met"
                )
        found.append(limit)
    return found


_ADAPTER = TypeAdapter(LayoutStudy)


def load(name_or_path: str | Path) -> Source:
    """Return the layout study of that name under ``assets/studies``, or of that TOML file.

    Raises
    ------
    DesignError
        One line: file, dotted field, the value received and what is allowed.
    """
    name = str(name_or_path)
    text, folder = read_study(name, "layout")
    return Source(parse(text, name), text, folder, name)


def parse(text: str, source: str = "") -> LayoutStudy:
    """Return the study that a TOML text describes; ``source`` names it in the error."""
    data = study_tables(text, source)
    if data.get("kind") == "corpus":
        allowed = "'layout' (a corpus study goes into `twin corpus plan`)"
        raise DesignError("kind", "'corpus'", allowed, source=source)
    schema = _ADAPTER.json_schema()
    found = list(not_finite(data, schema))
    if found:
        raise found[0].renamed(source=source)
    try:  # as JSON: see twin.design.parse_design
        study = _ADAPTER.validate_json(json.dumps(data, default=lambda date: True), strict=True)
        limits(study.constraints)
        study.balls()
    except ValidationError as error:
        raise from_validation(error, data, schema).renamed(source=source) from None
    except DesignError as error:
        raise error.renamed(source=source) from None
    return study
