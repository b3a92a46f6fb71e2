"""What a corpus on disk may hold, and how its files are opened: a corpus may come from a stranger.

Nothing outside its folder is opened, nothing larger than its plan says is unpacked, nothing is executed: the
plan is JSON, the index Parquet without its pandas notes, a picture EXR or PNG. Whatever does not fit is
refused in one line.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from twin import store
from twin.complaint import DesignError, shown
from twin.design import Design, parse_design

PLAN, INDEX = "plan.json", "index.parquet"

INCLUSION = ("size_mm", "depth_mm", "modulus_kPa", "offset_x_mm", "offset_y_mm")
"""Columns that say what lies in the tissue; NaN in a blank."""

MAX_SAMPLES = 100_000_000
_LARGEST_PLAN = 64 * 2**20  # bytes
_LARGEST_CELL = 1000  # characters of a text of the index
_MAX_COLUMNS = 5000
_HASHES = ("sha256_exr", "sha256_png", "sha256_reference")
_WHOLE = ("sample", "level")
_TEXT = ("group", "exr", "png", "reference", *_HASHES, "version")
_MAY_BE_NAN = ("error_percent", "min_pressure_kPa", "noise_percent", "seconds_mechanics", "seconds_light")
_FINITE = tuple(name for name in store.MEASURED if name not in _MAY_BE_NAN)


@dataclass(frozen=True)
class Facts:
    """What a reader needs of a plan."""

    name: str
    description: str
    design: Design
    tables: dict[str, Any]
    """The design as nested tables, which randomised values are put into."""
    indentation_mm: tuple[float, ...]
    """Nominal press levels."""
    count: int
    """Samples that were planned."""
    told: dict[str, Any]
    """All of plan.json."""


def read_facts(root: Path) -> Facts:
    """Return what plan.json of a corpus says. Raises `DesignError`."""
    data = read_bytes(root, PLAN, _LARGEST_PLAN)
    source = str(root / PLAN)
    try:
        told = json.loads(data.decode("utf-8"), parse_constant=_no_constant)
    except RecursionError:
        raise DesignError("the file", "lists or tables nested too deep", "a plan", source=source) from None
    except ValueError as error:
        raise DesignError("the file", f"no JSON ({error})", "a plan", source=source) from None
    field = _field(told, source)
    if not isinstance(told, dict) or told.get("format") != 1:
        _refuse(source, "format", field("format"), "1")
    name, text = field("name"), told.get("description") or ""
    for key, value in (("name", name), ("description", text)):
        if not isinstance(value, str):
            _refuse(source, key, value, "text")
    levels = field("indentation_mm")
    if not isinstance(levels, list) or not 1 <= len(levels) <= 100 or not all(map(_is_depth, levels)):
        _refuse(source, "indentation_mm", levels, "1 to 100 depths > 0 and <= 100 mm")
    samples = field("samples")
    count = samples.get("count") if isinstance(samples, dict) else None
    if not isinstance(count, int) or isinstance(count, bool) or not 0 <= count <= MAX_SAMPLES:
        _refuse(source, "samples.count", count, f"0 to {MAX_SAMPLES}")
    tables = field("design")
    if not isinstance(tables, dict):
        _refuse(source, "design", tables, "the tables of a design")
    return Facts(
        name=str(name),
        description=str(text),
        design=parse_design(tables, f"{source}: design"),
        tables=tables,
        indentation_mm=tuple(float(level) for level in levels),
        count=int(count),
        told=told,
    )


def _field(told: Any, source: str) -> Any:
    def get(name: str) -> Any:
        if not isinstance(told, dict) or name not in told:
            _refuse(source, name, None, "it: the plan of a corpus has one")
        return told[name]

    return get


def _refuse(source: str, field: str, received: object, allowed: str) -> NoReturn:
    raise DesignError(field, "nothing" if received is None else shown(received), allowed, source=source)


def _no_constant(name: str) -> NoReturn:
    raise ValueError(f"{name} is not a number")


def _is_depth(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and 0 < value <= 100


def inside(root: Path, name: str) -> Path:
    """Return the path of a file of the corpus; `DesignError` if links lead out of its folder."""
    place, home = os.path.realpath(root / name), os.path.realpath(root)
    if not place.startswith(home + os.sep):
        allowed = "a file within the corpus (a link leads out of it)"
        raise DesignError("path", shown(name), allowed, source=str(root))
    return Path(place)


def read_bytes(root: Path, name: str, largest: int) -> bytes:
    """Return a file of the corpus, of at most so many bytes. Raises `DesignError`."""
    place = inside(root, name)
    try:
        if not place.is_file():
            raise FileNotFoundError(2, "no such file")
        with open(place, "rb") as file:
            data = file.read(largest + 1)
    except OSError as error:
        what = f"nothing that can be read ({(error.strerror or 'error').lower()})"
        raise DesignError(name, what, "a file of the corpus", source=str(root)) from error
    if len(data) > largest:
        raise DesignError(name, f"more than {largest} bytes", "a smaller file", source=str(root))
    return data


def read_checked(root: Path, name: str, largest: int, sha256: str) -> bytes:
    """Return the same, if it is what the index knows. Raises `DesignError`."""
    data = read_bytes(root, name, largest)
    found = hashlib.sha256(data).hexdigest()
    if found != sha256:
        allowed = f"{sha256[:16]}..., which the index has (`twin corpus verify` tells more)"
        raise DesignError(name, f"SHA-256 {found[:16]}...", allowed, source=str(root))
    return data


def read_index(root: Path, facts: Facts) -> pa.Table:
    """Return the index, one row per frame, sorted by sample and level. Raises `DesignError`."""
    source, levels = str(root / INDEX), len(facts.indentation_mm)
    place = inside(root, INDEX)
    if not place.is_file():
        allowed = "the index (`twin corpus run` makes it of the frames)"
        raise DesignError(INDEX, "no such file", allowed, source=str(root))
    try:
        with pq.ParquetFile(place, memory_map=False) as file:
            rows, schema = file.metadata.num_rows, file.schema_arrow
            if rows > facts.count * levels:
                allowed = f"at most {facts.count} samples of {levels} levels, as the plan has it"
                raise DesignError("rows", str(rows), allowed, source=source)
            _check_schema(schema, source)
            table = file.read().replace_schema_metadata(None)
        table = table.cast(pa.schema([(field.name, _plain(field)) for field in table.schema]))
    except (pa.ArrowException, OSError) as error:
        what = f"a file that cannot be read ({str(error).splitlines()[0][:100]})"
        raise DesignError("the file", what, "Parquet", source=source) from None
    table = table.sort_by([("sample", "ascending"), ("level", "ascending")])
    _check_values(table, facts, source)
    return table


def _plain(field: pa.Field) -> pa.DataType:
    if field.name in _WHOLE:
        return pa.int64()
    if field.name == "blank":
        return pa.bool_()
    return pa.string() if field.name in _TEXT or _is_text(field.type) else pa.float64()


def _is_text(kind: pa.DataType) -> bool:
    return bool(pa.types.is_string(kind) or pa.types.is_large_string(kind))


def _check_schema(schema: pa.Schema, source: str) -> None:
    names = schema.names
    if len(names) > _MAX_COLUMNS or len(set(names)) != len(names):
        allowed = f"at most {_MAX_COLUMNS}, each of its own name"
        raise DesignError("columns", f"{len(names)}, {len(set(names))} names", allowed, source=source)
    wanted = (*_WHOLE, "blank", *_TEXT, *INCLUSION, *store.MEASURED)
    if missing := [name for name in wanted if name not in names]:
        raise DesignError("columns", f"none named {missing[0]!r}", ", ".join(wanted), source=source)
    for field in schema:
        kind, name = field.type, field.name
        whole = pa.types.is_integer(kind)
        if name in _WHOLE:
            good, allowed = whole, "integers"
        elif name == "blank":
            good, allowed = pa.types.is_boolean(kind), "true or false"
        elif name in _TEXT:
            good, allowed = _is_text(kind), "text"
        else:
            number = whole or pa.types.is_floating(kind)
            good = number or (
                _is_text(kind) and name not in (*INCLUSION, *store.MEASURED) and "." not in name
            )
            allowed = "numbers"
        if not good:
            raise DesignError(f"column {name}", f"type {str(kind)[:60]}", allowed, source=source)


def _check_values(table: pa.Table, facts: Facts, source: str) -> None:
    """Refuse rows that are not those of finished samples, and values that no frame has."""

    def refuse(name: str, wrong: np.ndarray, allowed: str) -> None:
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            value = table[name][row].as_py()
            raise DesignError(f"column {name}, row {row}", shown(value), allowed, source=source)

    for name in (*_WHOLE, "blank", *_TEXT):
        refuse(name, table[name].is_null().to_numpy(), "a value in each row")
    sample, level = (table[name].to_numpy() for name in _WHOLE)
    levels = len(facts.indentation_mm)
    refuse("sample", (sample < 0) | (sample >= facts.count), f"0 to {facts.count - 1}, as planned")
    refuse("level", level != np.arange(len(level)) % levels, f"each of 0 to {levels - 1} once for a sample")
    first = np.arange(len(sample)) // levels * levels
    refuse("sample", sample != sample[np.minimum(first, max(len(sample) - 1, 0))], f"{levels} rows of each")
    starts = sample[::levels]
    twice = np.zeros(len(sample), bool)
    twice[::levels][1:] = np.diff(starts) == 0
    refuse("sample", twice, f"{levels} rows of each")
    if len(sample) % levels:
        allowed = f"{levels} for each sample"
        raise DesignError("rows", str(len(sample)), allowed, source=source)
    blank = table["blank"].to_numpy()
    for field in table.schema:
        if field.type == pa.float64():
            values = table[field.name].to_numpy()
            refuse(field.name, np.isinf(values), "finite numbers")
            if field.name in INCLUSION:
                refuse(field.name, np.isnan(values) & ~blank, "a number, but in a blank")
            elif field.name in _FINITE or "." in field.name:
                refuse(field.name, np.isnan(values), "finite numbers")
        elif field.type == pa.string():
            length = pc.fill_null(pc.utf8_length(table[field.name]), 0).to_numpy()
            refuse(field.name, length > _LARGEST_CELL, f"at most {_LARGEST_CELL} characters")
    for name in _HASHES:
        good = pc.match_substring_regex(table[name], "^[0-9a-f]{64}$").to_numpy()
        refuse(name, ~good, "a SHA-256 in hexadecimal")
    # The only names there are: whatever else a row says, it cannot lead elsewhere.
    folders = [store.sample_folder(Path(), int(number)).as_posix() for number in starts]
    for name in ("exr", "png"):
        wanted = [f"{folder}/{step}.{name}" for folder in folders for step in range(levels)]
        wrong = pc.not_equal(table[name], pa.array(wanted, pa.string())).to_numpy()
        refuse(name, wrong, "samples/SSS/NNNNNN/LEVEL." + name + " of this row")
    own = [f"{folder}/{step}.reference.exr" for folder in folders for step in range(levels)]
    shared = pc.match_substring_regex(table["reference"], "^references/[0-9a-f]{16}\\.exr$")
    good = pc.or_(shared, pc.equal(table["reference"], pa.array(own, pa.string()))).to_numpy()
    refuse("reference", ~good, "references/KEY.exr, or LEVEL.reference.exr of this row's sample")
