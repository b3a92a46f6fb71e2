"""A study of kind "corpus": what is sampled and randomised, as a frozen, checked value from a TOML file.

Fields, defaults and an example: CORPORA.md. `twin.layout_study` has the other kind, which compares sensors.
"""

from __future__ import annotations

import json
from dataclasses import dataclass as plain
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import ConfigDict, Discriminator, Field, Tag, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from fem.model import Inclusion
from twin.complaint import DesignError, from_validation, not_finite, shown
from twin.design import Depth
from twin.presses import Quality
from twin.study_file import read_study, study_tables

CONFIG = ConfigDict(extra="forbid", allow_inf_nan=False)

MAX_COUNT = 10_000_000
"""Most samples of a corpus."""

PARAMETERS = ("size_mm", "depth_mm", "modulus_kPa", "offset_x_mm", "offset_y_mm")
"""What an inclusion is sampled in."""

Sampler = Literal["uniform", "latin", "sobol", "grid", "table"]
CorpusMechanics = Literal["finite", "linear", "multipoles", "emulator"]
LightSeed = Literal["shared", "own"]
Paths = Annotated[int, Field(ge=2**10, le=2**32)]
"""Light paths from each LED."""
Name = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[^\x00-\x1f\x7f-\x9f]*$")]
GroupName = Annotated[str, Field(min_length=1, max_length=100, pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]*$")]
"""Fit to be a file's name, which readers and exporters may make of it."""
FileName = Annotated[str, Field(min_length=1, max_length=4000)]
Number = Annotated[float, Field(ge=-1e9, le=1e9)]
Count = Annotated[int, Field(ge=1, le=MAX_COUNT)]
Seed = Annotated[int, Field(ge=0, lt=2**63)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]


def _kind(value: Any) -> str:
    return "range" if isinstance(value, list | tuple) else "number"


Span = Annotated[
    Annotated[Number, Tag("number")] | Annotated[tuple[Number, Number], Tag("range")], Discriminator(_kind)
]
"""One value for all samples, or the lowest and the highest."""


@dataclass(frozen=True, config=CONFIG)
class Ranges:
    """Where the inclusions of a group lie; size, depth (to the top) and modulus are needed."""

    size_mm: Annotated[Span, Field(description="diameter, mm")]
    depth_mm: Annotated[Span, Field(description="depth to the top, mm")]
    modulus_kPa: Annotated[Span, Field(description="Young's modulus, kPa")]
    offset_x_mm: Annotated[Span, Field(description="inclusion minus probe centre along x, mm")] = 0.0
    offset_y_mm: Annotated[Span, Field(description="the same along y, mm")] = 0.0

    def span(self, name: str) -> tuple[float, float]:
        """Return the lowest and the highest value of one of `PARAMETERS`."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)


@dataclass(frozen=True, config=CONFIG)
class Group:
    """Samples that are drawn alike."""

    name: GroupName
    sampler: Sampler
    count: Count | None = None
    blanks: Annotated[Share, Field(description="share without inclusion")] = 0.0
    inclusion: Ranges | None = None
    grid: dict[str, Annotated[tuple[Number, ...], Field(min_length=1, max_length=10_000)]] | None = None
    table: FileName | None = None


@dataclass(frozen=True, config=CONFIG)
class Distribution:
    """How one number of the design is drawn; see `twin.draws.draw`."""

    distribution: Literal["uniform", "normal", "lognormal", "choice", "integer"]
    low: Number | None = None
    high: Number | None = None
    mean: Number | None = None
    sd: Annotated[float, Field(ge=0.0, le=1e9)] | None = None
    of: Annotated[tuple[Number, ...], Field(min_length=1, max_length=10_000)] | None = None
    relative: bool = False


Randomise = Annotated[dict[Name, Distribution], Field(max_length=1000)]

# What each distribution needs, and what it may have besides.
_NEEDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "uniform": (("low", "high"), ("relative",)),
    "normal": (("sd",), ("mean", "low", "high", "relative")),
    "lognormal": (("sd",), ("relative",)),
    "choice": (("of",), ("relative",)),
    "integer": (("low", "high"), ()),
}


@dataclass(frozen=True, config=CONFIG)
class Study:
    """What a corpus is to hold."""

    kind: Literal["corpus"]
    name: Name
    samples: Annotated[tuple[Group, ...], Field(min_length=1, max_length=1000)]
    description: Annotated[str, Field(max_length=10_000)] = ""
    design: FileName = "tsis"
    seed: Seed = 0
    quality: Quality = "standard"
    light: Quality | None = None
    paths: Paths | None = None
    mechanics: CorpusMechanics | None = None
    emulator: FileName | None = None
    traced: FileName | None = None
    indentation_mm: Annotated[tuple[Depth, ...], Field(min_length=1, max_length=100)] = (1.0, 2.0, 3.0)
    light_seed: LightSeed = "shared"
    randomise: Randomise = Field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.emulator is not None and self.mechanics != "emulator":
            raise DesignError("emulator", "it with other mechanics", 'it with mechanics = "emulator" only')
        names = [group.name for group in self.samples]
        for number, group in enumerate(self.samples):
            if group.name in names[:number]:
                raise DesignError(f"samples.{number}.name", shown(group.name), "a name for each group")
            _check_group(f"samples.{number}", group)
        for key, distribution in self.randomise.items():
            check_distribution(f"randomise.{key}", distribution)


@plain(frozen=True)
class Source:
    """A study, the file's text, and the folder that its relative names start from."""

    study: Study
    text: str
    folder: Path
    name: str


def _check_group(where: str, group: Group) -> None:
    """Raise `DesignError` if a group lacks what its sampler needs, or has what it does not take."""
    random = group.sampler in ("uniform", "latin", "sobol")
    takes = ("count", "inclusion") if random else (group.sampler,)
    for field in ("count", "inclusion", "grid", "table"):
        given = getattr(group, field) is not None
        if given and field not in takes:
            allowed = f"{' and '.join(takes)}, which sampler = {group.sampler!r} takes"
            raise DesignError(f"{where}.{field}", "it", allowed)
        if not given and field in takes:
            allowed = f"it, which sampler = {group.sampler!r} needs"
            raise DesignError(f"{where}.{field}", "nothing", allowed)
    if group.blanks and not random:
        allowed = "0 with grid and table (in a table, leave size_mm empty)"
        raise DesignError(f"{where}.blanks", shown(group.blanks), allowed)
    if group.inclusion is not None:
        for name in PARAMETERS:
            value = getattr(group.inclusion, name)
            if isinstance(value, tuple) and not value[0] < value[1]:
                allowed = "[lowest, highest], the first below the second, or one number"
                raise DesignError(f"{where}.inclusion.{name}", shown(list(value)), allowed)
            for end in group.inclusion.span(name):
                check_parameter(f"{where}.inclusion.{name}", name, end)
    if group.grid is not None:
        _check_grid(f"{where}.grid", group.grid)


def _check_grid(where: str, grid: dict[str, tuple[float, ...]]) -> None:
    for name in PARAMETERS[:3]:
        if name not in grid:
            raise DesignError(f"{where}.{name}", "nothing", "a list of numbers")
    total = 1
    for name, values in grid.items():
        if name not in PARAMETERS:
            raise DesignError(f"{where}.{name}", "it", f"one of {', '.join(PARAMETERS)}")
        for number, value in enumerate(values):
            check_parameter(f"{where}.{name}.{number}", name, value)
        total *= len(values)
        if total > MAX_COUNT:
            raise DesignError(where, "more combinations", f"at most {MAX_COUNT} together")


# What an inclusion may be by itself, as `fem.Inclusion` has it: lowest and highest of each parameter.
_SCHEMA = TypeAdapter(Inclusion).json_schema()["properties"]
LIMITS: dict[str, tuple[float, float]] = {
    **{
        f"{name}_{unit}": (_SCHEMA[name]["minimum"], _SCHEMA[name]["maximum"])
        for name, unit in (("size", "mm"), ("depth", "mm"), ("modulus", "kPa"))
    },
    **{
        f"offset_{axis}_mm": tuple(_SCHEMA["offset"]["prefixItems"][0][end] for end in ("minimum", "maximum"))
        for axis in "xy"
    },
}


def check_parameter(field: str, name: str, value: float) -> None:
    """Raise `DesignError` if one of `PARAMETERS` is beyond what any inclusion may have."""
    low, high = LIMITS[name]
    if not low <= value <= high:
        raise DesignError(field, shown(value), f"a number >= {low:g} and <= {high:g}")


def check_distribution(where: str, found: Distribution) -> None:
    """Raise `DesignError` if a distribution lacks a number, has one too many, or is empty."""
    needs, more = _NEEDS[found.distribution]
    for field in ("low", "high", "mean", "sd", "of", "relative"):
        given = getattr(found, field) not in (None, False)
        if not given and field in needs:
            raise DesignError(f"{where}.{field}", "nothing", f"it, which {found.distribution!r} needs")
        if given and field not in (*needs, *more):
            allowed = f"{', '.join((*needs, *more))}, which {found.distribution!r} takes"
            raise DesignError(f"{where}.{field}", "it", allowed)
    low, high = found.low, found.high
    if low is not None and high is not None and not low < high:
        raise DesignError(f"{where}.low", shown(low), f"a number below high = {high:g}")
    if found.distribution == "integer" and not (
        float(low or 0).is_integer() and float(high or 0).is_integer()
    ):
        raise DesignError(f"{where}.low", shown([low, high]), "integers as low and high")


_ADAPTER = TypeAdapter(Study)


def load_study(name_or_path: str | Path) -> Source:
    """Return the study of that name under ``assets/studies``, or of that TOML file.

    Raises
    ------
    DesignError
        One line: file, dotted field, the value received and what is allowed.
    """
    name = str(name_or_path)
    text, folder = read_study(name, "corpus")
    return Source(parse_study(text, name), text, folder, name)


def parse_study(text: str, source: str = "") -> Study:
    """Return the study that a TOML text describes; ``source`` names it in the error."""
    data = study_tables(text, source)
    if data.get("kind") == "layout":
        raise DesignError(
            "kind", "'layout'", "'corpus' (a layout study goes into `twin explore`)", source=source
        )
    schema = _ADAPTER.json_schema()
    found = list(not_finite(data, schema))
    if found:
        raise found[0].renamed(source=source)
    try:  # as JSON: see twin.design.parse_design
        return _ADAPTER.validate_json(json.dumps(data, default=lambda date: True), strict=True)
    except ValidationError as error:
        raise from_validation(error, data, schema).renamed(source=source) from None
