"""index.parquet: one row per frame, made from the frames alone, so that it can always be made again.

What was measured comes from the text in the head of each EXR, hashes and timings from `sample.json`. Timings,
the only columns that differ between two runs of a plan, come last.
"""

from __future__ import annotations

import io
import os
import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.parquet as pq

from scenes import exr
from twin import store

if TYPE_CHECKING:
    from twin.plan import Plan

FILE = "index.parquet"
FORMAT = 1
TIMINGS = ("seconds_mechanics", "seconds_light")
"""Seconds per frame: a sample's, divided by its press levels."""

_TEXTS = ("exr", "png", "reference", "sha256_exr", "sha256_png", "sha256_reference", "version")
_SHARED = re.compile(r"references/[0-9a-f]{16}\.exr")


def schema(parameters: Iterable[str], plan: str) -> pa.Schema:
    """Return the columns for these parameters, and the SHA-256 of the plan.json that they belong to."""
    first = [("sample", pa.int64()), ("level", pa.int32()), ("group", pa.string()), ("blank", pa.bool_())]
    numbers = [(name, pa.float64()) for name in (*parameters, *store.MEASURED)]
    rest = [*((name, pa.string()) for name in _TEXTS), *((name, pa.float64()) for name in TIMINGS)]
    return pa.schema([*first, *numbers, *rest], {"format": str(FORMAT), "plan": plan})


def rows_of(corpus: Path, plan: Plan, number: int) -> list[dict[str, Any]]:
    """Return a sample's rows, one for each press level, from its files.

    Raises
    ------
    scenes.exr.ImageError
        In one line, if a file is missing, or says what no run wrote.
    """
    note = store.read_note(corpus, number)
    folder, levels = store.sample_folder(corpus, number), len(plan.indentation_mm)
    name = folder.relative_to(corpus).as_posix()
    rows = []
    for level in range(levels):
        place = folder / f"{level}.exr"
        record = store.read_record(place)
        try:
            row = _typed(store.row_of(record), plan)
            reference = record["reference"]
            own = reference == f"{name}/{level}.reference.exr"
            if not own and not (isinstance(reference, str) and _SHARED.fullmatch(reference)):
                raise ValueError("reference")
            if (row["sample"], row["level"]) != (number, level):
                raise ValueError("sample")
            row |= {"exr": f"{name}/{level}.exr", "png": f"{name}/{level}.png", "reference": reference}
            row["sha256_exr"], row["sha256_png"] = (note.sha256[f"{level}.{kind}"] for kind in ("exr", "png"))
            row["sha256_reference"] = note.sha256[f"{level}.reference.exr" if own else reference]
        except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as error:
            what = " ".join(str(error).split())[:80]
            raise exr.ImageError(f"{place}: record: received what no run writes ({what})") from error
        row["version"] = note.version
        row |= {f"seconds_{stage}": note.seconds[stage] / levels for stage in ("mechanics", "light")}
        rows.append(row)
    return rows


def _typed(row: Mapping[str, Any], plan: Plan) -> dict[str, Any]:
    """Return a record's part of the row with nothing in it but what its columns hold."""
    found: dict[str, Any] = {name: row[name] for name in ("sample", "level", "group", "blank")}
    for name, kind in zip(found, (int, int, str, bool), strict=True):
        if type(found[name]) is not kind:
            raise ValueError(name)
    for name in (*plan.parameter_names, *store.MEASURED):
        value = row[name]
        if value is not None and type(value) not in (int, float):
            raise ValueError(name)
        found[name] = None if value is None else float(value)
    if len(found) != len(row):
        raise ValueError(next(name for name in row if name not in found))
    return found


def table_of(corpus: Path, plan: Plan, numbers: Iterable[int], sha256: str) -> tuple[pa.Table, dict[int, str]]:
    """Return the rows of these samples, in this order, and for those that cannot be read, why (one line)."""
    rows: list[dict[str, Any]] = []
    bad: dict[int, str] = {}
    for number in numbers:
        try:
            rows += rows_of(corpus, plan, number)
        except exr.ImageError as error:
            bad[number] = str(error)
    return pa.Table.from_pylist(rows, schema=schema(plan.parameter_names, sha256)), bad


def folders(corpus: Path) -> dict[str, list[int]]:
    """Return the numbers of the samples that are there, rising, by the folder of a thousand they lie in."""
    found: dict[str, list[int]] = {}
    for number in sorted(store.finished(corpus)):
        found.setdefault(store.sample_folder(corpus, number).parent.name, []).append(number)
    return found


class Table:
    """The index while samples are being added: what was read stays, a folder with news is read again."""

    def __init__(self, corpus: Path, plan: Plan, sha256: str) -> None:
        self.corpus, self.plan, self.sha256 = corpus, plan, sha256
        self.bad: dict[int, str] = {}
        """Samples whose files cannot be read, and why."""
        self._kept: dict[str, tuple[list[int], pa.Table, dict[int, str]]] = {}

    def write(self) -> int:
        """Write index.parquet, all at once, and return its number of rows.

        Raises `scenes.exr.ImageError` if it cannot be written.
        """
        for name, numbers in folders(self.corpus).items():
            numbers = [number for number in numbers if number < len(self.plan)]
            if name not in self._kept or self._kept[name][0] != numbers:
                self._kept[name] = numbers, *table_of(self.corpus, self.plan, numbers, self.sha256)
        kept = [self._kept[name] for name in sorted(self._kept, key=int)]
        self.bad = {number: line for _, _, bad in kept for number, line in bad.items()}
        empty = schema(self.plan.parameter_names, self.sha256).empty_table()
        whole = pa.concat_tables([empty, *(table for _, table, _ in kept)]).combine_chunks()
        exr.write_bytes(self.corpus / FILE, _parquet(whole))
        return whole.num_rows


def build(corpus: Path, plan: Plan, sha256: str) -> Table:
    """Write index.parquet from the frames, and return the table that it was made with."""
    table = Table(corpus, plan, sha256)
    table.write()
    return table


def _parquet(table: pa.Table) -> bytes:
    stream = io.BytesIO()
    pq.write_table(table, stream, compression="zstd", row_group_size=100_000, write_statistics=False)
    return stream.getvalue()


def read(corpus: Path, plan: Plan, sha256: str) -> pa.Table:
    """Return index.parquet, checked against its plan before it is unpacked.

    Raises
    ------
    ValueError
        In one line.
    """
    place, wanted = corpus / FILE, schema(plan.parameter_names, sha256)
    try:
        if os.path.getsize(place) > 8 * 2**30:
            raise ValueError("too large")
        with pq.ParquetFile(place) as file:
            found, about = file.schema_arrow, file.metadata
            unpacked = sum(about.row_group(part).total_byte_size for part in range(about.num_row_groups))
            if not found.equals(wanted):
                raise ValueError("other columns than the plan's")
            if (found.metadata or {}).get(b"plan") != sha256.encode():
                raise ValueError("of another plan.json")
            if about.num_rows > len(plan) * len(plan.indentation_mm) or unpacked > 16 * 2**30:
                raise ValueError("more rows than frames")
            return file.read()
    except (OSError, ValueError, TypeError, MemoryError, OverflowError, pa.ArrowException) as error:
        what = error.strerror if isinstance(error, OSError) and error.strerror else " ".join(str(error).split())
        raise ValueError(f"{FILE}: cannot be read ({str(what)[:120]})") from None
