"""The table of a corpus's samples: samples.parquet, one row each, and its checks."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from twin.complaint import DesignError, shown
from twin.fields import limits, path_of
from twin.study import LIMITS, PARAMETERS

MAX_NUMBERS = 200_000_000
"""Most samples times columns."""
_MAX_BYTES = 4 * 2**30  # unpacked


class Counted(Protocol):
    """A group of samples."""

    @property
    def name(self) -> str: ...
    @property
    def count(self) -> int: ...


def _schema(fields: Sequence[str]) -> pa.Schema:
    numbers = [(name, pa.float64()) for name in (*PARAMETERS, *fields)]
    return pa.schema([("sample", pa.int64()), ("group", pa.string()), ("blank", pa.bool_()), *numbers])


def write_samples(
    place: Path, columns: Mapping[str, NDArray[Any]], fields: Sequence[str], groups: Sequence[str]
) -> None:
    """Write the columns of `twin.planned.Plan`, with the groups' names; the same numbers make the same
    bytes."""
    names = pa.array(groups, pa.string())
    arrays = {**columns, "group": pa.DictionaryArray.from_arrays(columns["group"], names).cast(pa.string())}
    schema = _schema(fields)
    table = pa.Table.from_arrays([pa.array(arrays[name]) for name in schema.names], schema=schema)
    pq.write_table(table, place, compression="zstd", row_group_size=100_000)


def read_samples(place: Path, fields: Sequence[str], groups: Sequence[Counted]) -> dict[str, NDArray[Any]]:
    """Return the columns of `twin.planned.Plan`: nothing in the file is trusted.

    Raises
    ------
    DesignError
        In one line.
    """
    source, count = str(place), sum(group.count for group in groups)
    wanted = _schema(fields)
    try:
        with pq.ParquetFile(place) as file:
            _check_shape(file, wanted, count)
        with pq.ParquetFile(place, read_dictionary=["group"]) as file:
            table = file.read()
            columns = {name: table[name].to_numpy() for name in wanted.names if name != "group"}
            name_of = table["group"].combine_chunks().cast(pa.dictionary(pa.int32(), pa.string()))
            columns["group"] = _codes(name_of, groups)
        nulls = [name for name in wanted.names if table[name].null_count]
        if nulls:
            raise DesignError(nulls[0], "nothing in some rows", "a value in every row")
        _check_values(columns, fields, groups)
    except DesignError as error:
        raise error.renamed(source=source) from None
    except (pa.ArrowException, OSError, ValueError, TypeError, OverflowError, MemoryError) as error:
        why = " ".join(str(error).split())[:120]
        raise DesignError(
            "the file", f"what cannot be read ({why})", "a table of samples", source=source
        ) from None
    return {name: columns[name] for name in wanted.names}


def _check_shape(file: pq.ParquetFile, wanted: pa.Schema, count: int) -> None:
    """Look at the file's own description before anything is unpacked."""
    found = file.schema_arrow
    if found.names != wanted.names:
        odd = next((name for name in found.names if name not in wanted.names), None)
        odd = odd or next((name for name in wanted.names if name not in found.names), "their order")
        raise DesignError("columns", shown(odd), f"the {len(wanted.names)} that the plan asks for")
    for field in wanted:
        if found.field(field.name).type != field.type:
            raise DesignError(field.name, f"values of type {found.field(field.name).type}", f"{field.type}")
    about = file.metadata
    if about.num_rows != count:
        raise DesignError("rows", shown(about.num_rows), f"{count}, as planned")
    if count * len(wanted.names) > MAX_NUMBERS:
        raise DesignError("rows", f"{count} of {len(wanted.names)} columns", f"{MAX_NUMBERS} numbers at most")
    size = sum(about.row_group(number).total_byte_size for number in range(about.num_row_groups))
    if not 0 <= size <= _MAX_BYTES:
        raise DesignError("the file", f"{size} bytes unpacked", f"at most {_MAX_BYTES}")


def _codes(names: pa.DictionaryArray, groups: Sequence[Counted]) -> NDArray[np.int64]:
    numbers = {group.name: number for number, group in enumerate(groups)}
    known = names.dictionary.to_pylist()
    strange = [name for name in known if name not in numbers]
    if strange:
        raise DesignError("group", shown(strange[0]), "a group of the plan")
    of = np.array([numbers[name] for name in known], np.int64)
    return np.asarray(of[names.indices.to_numpy(zero_copy_only=False)])


def _check_values(
    columns: Mapping[str, NDArray[Any]], fields: Sequence[str], groups: Sequence[Counted]
) -> None:
    count = len(columns["sample"])
    if not np.array_equal(columns["sample"], np.arange(count)):
        raise DesignError("sample", "other numbers", f"0 to {count - 1}, rising")
    if not np.array_equal(columns["group"], np.repeat(range(len(groups)), [group.count for group in groups])):
        raise DesignError("group", "another order", "the plan's groups one after the other")
    for name in PARAMETERS:
        values, (low, high) = columns[name], LIMITS[name]
        if not np.isnan(values[columns["blank"]]).all():
            raise DesignError(name, "numbers", "NaN where a sample is blank")
        _check_range(name, values[~columns["blank"]], low, high)
    for field in fields:
        about = limits(path_of(field))
        low = about.get("minimum", about.get("exclusiveMinimum", -1e300))
        high = about.get("maximum", about.get("exclusiveMaximum", 1e300))
        _check_range(field, columns[field], low, high)


def _check_range(name: str, values: NDArray[np.float64], low: float, high: float) -> None:
    wrong = ~((values >= low) & (values <= high))
    if wrong.any():
        found = shown(float(values[wrong][0]))
        raise DesignError(name, found, f"numbers >= {low:g} and <= {high:g}")
