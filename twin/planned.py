"""A plan as it lies in a corpus's folder: plan.json and samples.parquet, read as if a stranger had sent them.

JSON and Parquet only, which run no code; every name, size, number and hash is checked before it is used.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator
from dataclasses import dataclass as plain
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

import fem
from twin.complaint import DesignError, from_validation, not_finite, shown
from twin.design import Depth, Design, Signal, parse_design
from twin.draws import Stream
from twin.fields import MOST, expand, number_at, path_of, put, tables_of
from twin.presses import Quality
from twin.sample_table import read_samples
from twin.study import (
    CONFIG,
    MAX_COUNT,
    CorpusMechanics,
    GroupName,
    LightSeed,
    Name,
    Paths,
    Randomise,
    Sampler,
    Seed,
    check_distribution,
)
from twin.study_file import MAX_TEXT

PLAN = "plan.json"
SAMPLES = "samples.parquet"
EMULATOR = "emulator.npz"
TRACED = "traced.npz"
FORMAT = 1

_MAX_BYTES = 64 * 2**20  # of plan.json
IES = re.compile(r"leds\.[0-9]{1,2}\.ies")

Sha = Annotated[str, Field(min_length=64, max_length=64, pattern=r"^[0-9a-f]{64}$")]


@dataclass(frozen=True, config=CONFIG)
class EmulatorFile:
    file: Literal["emulator.npz"]
    sha256: Sha


@dataclass(frozen=True, config=CONFIG)
class TracedFile:
    file: Literal["traced.npz"]
    sha256: Sha


@dataclass(frozen=True, config=CONFIG)
class SamplesFile:
    file: Literal["samples.parquet"]
    count: Annotated[int, Field(ge=1, le=MAX_COUNT)]
    sha256: Sha


@dataclass(frozen=True, config=CONFIG)
class PlannedGroup:
    """Samples that were drawn alike, and how often a draw was refused."""

    name: GroupName
    sampler: Sampler
    count: Annotated[int, Field(ge=1, le=MAX_COUNT)]
    redrawn: Annotated[int, Field(ge=0, lt=2**53)] = 0
    fields: Annotated[
        tuple[Name, ...], Field(max_length=MOST, description="fields of the design that its table gives")
    ] = ()


@dataclass(frozen=True, config=CONFIG)
class Head:
    """What plan.json says."""

    format: Literal[1]
    name: Name
    description: Annotated[str, Field(max_length=10_000)]
    design: dict[str, Any]
    design_sha256: Sha
    seed: Seed
    quality: Quality
    light: Quality
    mechanics: CorpusMechanics
    emulator: EmulatorFile | None
    indentation_mm: Annotated[tuple[Depth, ...], Field(min_length=1, max_length=100)]
    light_seed: LightSeed
    randomise: Randomise
    samples: SamplesFile
    groups: Annotated[tuple[PlannedGroup, ...], Field(min_length=1, max_length=1000)]
    k: Signal
    versions: dict[str, Annotated[str, Field(max_length=100)]]
    study: Annotated[str, Field(max_length=MAX_TEXT)]
    ies: Annotated[dict[str, Sha], Field(max_length=64)] = Field(default_factory=dict)
    traced: TracedFile | None = None
    paths: Paths | None = None


_HEAD = TypeAdapter(Head)


@plain(frozen=True, eq=False)
class Plan:
    """A frozen corpus: what each of its samples is. `len(plan)` samples, numbered from 0.

    Attributes
    ----------
    folder : the corpus's.
    head : what plan.json says; the attributes below are its.
    columns : of samples.parquet by name, (n,) each: float64, but "sample" int64, "blank" bool, and "group"
        the number of its group, int64.
    """

    folder: Path
    head: Head
    columns: dict[str, NDArray[Any]]

    def __len__(self) -> int:
        return self.head.samples.count

    @property
    def name(self) -> str:
        return self.head.name

    @property
    def seed(self) -> int:
        return self.head.seed

    @property
    def quality(self) -> Quality:
        """Of the mechanics."""
        return self.head.quality

    @property
    def light(self) -> Quality:
        """Quality of the light."""
        return self.head.light

    @property
    def mechanics(self) -> CorpusMechanics:
        return self.head.mechanics

    @property
    def emulator(self) -> Path | None:
        """The emulator's file, where mechanics are "emulator"."""
        return self.folder / EMULATOR if self.head.emulator else None

    @property
    def traced(self) -> Path | None:
        """The file of learned traced light, where pictures take it."""
        return self.folder / TRACED if self.head.traced else None

    @property
    def indentation_mm(self) -> tuple[float, ...]:
        """Nominal press levels, mm."""
        return self.head.indentation_mm

    @property
    def light_seed(self) -> LightSeed:
        return self.head.light_seed

    @property
    def digest(self) -> str:
        """Hash of plan.json: of all that decides the pictures, not of the drawn numbers alone."""
        return sha256(self.folder / PLAN)

    @property
    def shares_references(self) -> bool:
        """Whether pictures without inclusion are the same for all samples.

        Where anything of the design varies they are not, nor where finite elements press: each inclusion
        has a mesh of its own.
        """
        fields = any("." in name for name in self.columns)
        return self.light_seed == "shared" and self.mechanics == "emulator" and not fields

    @property
    def groups(self) -> tuple[PlannedGroup, ...]:
        return self.head.groups

    @property
    def k(self) -> Signal:
        """Thresholds of the scalars."""
        return self.head.k

    @property
    def parameter_names(self) -> tuple[str, ...]:
        """Columns that hold what a sample is: all but its number, its group, and whether it is blank."""
        return tuple(name for name in self.columns if name not in ("sample", "group", "blank"))

    @cached_property
    def base(self) -> Design:
        """The design before anything is randomised, its press levels the nominal ones."""
        return design_in(self.head.design, self.folder)

    @cached_property
    def _tables(self) -> dict[str, Any]:
        return tables_of(self.base)

    @cached_property
    def _starts(self) -> NDArray[np.int64]:
        return np.concatenate([[0], np.cumsum([group.count for group in self.groups])])

    def design(self, number: int) -> Design:
        """Return a sample's own design, with its own values and the true depths of its presses.

        Raises `DesignError` for values that no design may have.
        """
        number = self._checked(number)
        fields = (name for name in self.columns if "." in name)
        return parse_design(put(self._tables, [(name, self.columns[name][number]) for name in fields]))

    def inclusion(self, number: int) -> fem.Inclusion | None:
        """Return a sample's inclusion, None where it is blank."""
        number = self._checked(number)
        if self.columns["blank"][number]:
            return None
        names = ("size_mm", "depth_mm", "modulus_kPa", "offset_x_mm", "offset_y_mm")
        size, depth, modulus, x, y = (float(self.columns[name][number]) for name in names)
        return fem.Inclusion(size, depth, modulus, (x, y))

    def indentations(self, number: int) -> tuple[float, ...]:
        """Return the true depths of a sample's presses, mm, one for each of `indentation_mm`."""
        number = self._checked(number)
        names = [f"press.indentation_mm.{level}" for level in range(len(self.indentation_mm))]
        return tuple(
            float(self.columns[name][number]) if name in self.columns else nominal
            for name, nominal in zip(names, self.indentation_mm, strict=True)
        )

    def parameters(self, number: int) -> dict[str, float | None]:
        """Return all `parameter_names` of a sample; None where a blank has no value."""
        number = self._checked(number)
        found = {name: float(self.columns[name][number]) for name in self.parameter_names}
        return {name: None if value != value else value for name, value in found.items()}

    def group(self, number: int) -> str:
        """Return the name of a sample's group."""
        return self.groups[self.columns["group"][self._checked(number)]].name

    def seeds(self, number: int) -> tuple[int, int]:
        """Return a sample's seeds of light (below 2^26, which leaves room for the LEDs) and camera (2^53)."""
        number = self._checked(number)
        group = int(self.columns["group"][number])
        stream, place = Stream(self.seed, self.groups[group].name), number - int(self._starts[group])
        light = Stream(self.seed, "").whole("light", 0, 26)
        if self.light_seed == "own":
            light = stream.whole("light", place, 26)
        return light, stream.whole("camera", place, 53)

    def _checked(self, number: int) -> int:
        if not 0 <= number < len(self):
            raise DesignError("sample", shown(number), f"an integer from 0 to {len(self) - 1}")
        return int(number)


def load_plan(folder: str | Path) -> Plan:
    """Return the plan of a corpus's folder; nothing in it is trusted.

    Raises
    ------
    DesignError
        In one line: the file, the field, what was received and what is allowed.
    """
    place = Path(folder)
    source = str(place / PLAN)
    head = _head(place, source)
    try:
        _check_files(place, head)
        design = design_in(head.design, place)
        tables = tables_of(design)
        if head.design_sha256 != design_sha256(head.design):
            raise DesignError("design_sha256", shown(head.design_sha256), "the hash of the design beside it")
        if head.k != design.signal:
            raise DesignError("k", shown(head.k), "the design's signal")
        if design.press.indentation_mm != head.indentation_mm:
            received = shown(list(design.press.indentation_mm))
            raise DesignError("design.press.indentation_mm", received, f"{list(head.indentation_mm)}")
        total = sum(group.count for group in head.groups)
        if total != head.samples.count or len({group.name for group in head.groups}) < len(head.groups):
            allowed = f"groups with a name for each, and samples.count = {head.samples.count} together"
            raise DesignError("groups", f"{total} samples", allowed)
        for key, distribution in head.randomise.items():
            check_distribution(f"randomise.{key}", distribution)
        fields = list(columns_of(tables, head))
    except DesignError as error:
        raise error.renamed(source=source) from None
    except RecursionError:
        raise DesignError("design", "tables nested too deep", "a few levels", source=source) from None
    columns = read_samples(place / SAMPLES, fields, head.groups)
    return Plan(place, head, columns)


def columns_of(tables: dict[str, Any], head: Head) -> Iterator[str]:
    """Yield the design's fields that vary over the samples, each once: those randomised, then a table's."""
    seen = {varied.field: None for varied in expand(tables, head.randomise)}
    for number, group in enumerate(head.groups):
        for field in group.fields:
            number_at(tables, field, f"groups.{number}.fields")
            seen.setdefault(field)
    if len(seen) > MOST:
        raise DesignError("randomise", f"{len(seen)} numbers", f"at most {MOST} that vary")
    yield from (".".join(map(str, path_of(field))) for field in seen)


def design_sha256(tables: dict[str, Any]) -> str:
    """Return the hash of a design's tables, as hex."""
    text = json.dumps(tables, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).hexdigest()


def design_in(tables: dict[str, Any], folder: Path) -> Design:
    """Return the design of a plan; its luminaire files lie in the corpus's folder."""
    leds = tables.get("leds")
    if isinstance(leds, list) and any(isinstance(led, dict) and led.get("ies") for led in leds):
        leds = [
            {**led, "ies": str(folder / led["ies"])} if isinstance(led, dict) and led.get("ies") else led
            for led in leds
        ]
    return parse_design({**tables, "leds": leds})


def _head(place: Path, source: str) -> Head:
    """Read plan.json."""
    allowed = "a folder that `twin corpus plan` wrote"
    text = plain_file(place / PLAN, _MAX_BYTES, allowed).read_bytes()
    try:
        data = json.loads(text)
    except (ValueError, RecursionError):
        raise DesignError("the file", "text that is not JSON", allowed, source=source) from None
    schema = _HEAD.json_schema()
    try:
        for complaint in not_finite(data, schema):
            raise complaint.renamed(source=source)
    except RecursionError:
        raise DesignError("the file", "tables nested too deep", allowed, source=source) from None
    if isinstance(data, dict) and data.get("format") != FORMAT:
        known = f"{FORMAT}, which this version reads"
        raise DesignError("format", shown(data.get("format")), known, source=source)
    try:
        return _HEAD.validate_json(text, strict=True)
    except ValidationError as error:
        if error.errors()[0]["type"] == "json_invalid":  # though Python's own reader took it
            raise DesignError("the file", "tables nested too deep", allowed, source=source) from None
        raise from_validation(error, data, schema).renamed(source=source) from None


def _check_files(place: Path, head: Head) -> None:
    """Raise `DesignError` if a file beside plan.json is another than it says."""
    named = {SAMPLES: head.samples.sha256, **head.ies}
    if (head.emulator is not None) != (head.mechanics == "emulator"):
        raise DesignError("emulator", shown(head.emulator), 'a file with mechanics = "emulator" only')
    if head.emulator is not None:
        named[EMULATOR] = head.emulator.sha256
    if head.traced is not None:
        named[TRACED] = head.traced.sha256
    leds = head.design.get("leds")
    said = [led.get("ies") for led in leds if isinstance(led, dict)] if isinstance(leds, list) else []
    for name in [*head.ies, *(name for name in said if name is not None)]:
        if not isinstance(name, str) or not IES.fullmatch(name) or name not in head.ies:
            raise DesignError("ies", shown(name), "leds.0.ies, ... in the corpus's folder, with their hashes")
    for name, wanted in named.items():
        found = sha256(plain_file(place / name, 4 * 2**30, "a file of the plan"))
        if found != wanted:
            raise DesignError(name, f"a file of SHA-256 {found[:16]}...", f"{wanted[:16]}..., as planned")


def plain_file(place: Path, most: int, allowed: str) -> Path:
    """Return the path if a file of at most so many bytes lies there, not a link; else raise `DesignError`."""
    try:
        good = place.is_file() and not place.is_symlink() and place.stat().st_size <= most
    except (OSError, ValueError):
        good = False
    if not good:
        raise DesignError(place.name, shown(str(place)), f"{allowed}: a plain file of at most {most} bytes")
    return place


def sha256(place: Path) -> str:
    """Return a file's SHA-256 as hex."""
    with open(place, "rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()
