"""Samples that a study lists: a table in a CSV file, or the combinations of a grid."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.complaint import DesignError, shown
from twin.fields import number_at, path_of
from twin.study import MAX_COUNT, PARAMETERS, check_parameter
from twin.texts import read_text

_MAX_BYTES = 2**30
_MAX_COLUMNS = 1000


def read_grid(grid: Mapping[str, tuple[float, ...]]) -> dict[str, NDArray[Any]]:
    """Return every combination of a grid's values, the last parameter's changing fastest, (n,) each."""
    axes = [grid.get(name, (0.0,)) for name in PARAMETERS]
    mesh = np.meshgrid(*(np.array(axis, np.float64) for axis in axes), indexing="ij")
    columns: dict[str, NDArray[Any]] = {
        name: values.ravel() for name, values in zip(PARAMETERS, mesh, strict=True)
    }
    columns["blank"] = np.zeros(len(columns[PARAMETERS[0]]), bool)
    return columns


def read_table(place: Path, tables: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
    """Return the samples of a CSV file, (n,) each: `PARAMETERS`, "blank", and any dotted field of the design.

    A row whose size is empty is blank. An empty offset is 0, an empty field what the design says.

    Raises
    ------
    DesignError
        In one line: file, line and column, what was received and what is allowed.
    """
    try:
        text = read_text(place, _MAX_BYTES, str(place), "a CSV file")
        rows = csv.reader(io.StringIO(text, newline=""), strict=True)
        header = [name.strip() for name in next(rows, [])]
        defaults = _defaults(header, tables)
        columns: dict[str, list[float]] = {name: [] for name in (*PARAMETERS, *defaults)}
        for row in rows:
            if row:
                where = f"line {rows.line_num}"
                if len(row) != len(header):
                    raise DesignError(where, f"{len(row)} values", f"{len(header)}, as the header has")
                cells = dict(zip(header, (cell.strip() for cell in row), strict=True))
                for name, value in _row(where, cells, defaults).items():
                    columns[name].append(value)
                if len(columns["size_mm"]) > MAX_COUNT:
                    raise DesignError("rows", "more", f"at most {MAX_COUNT}")
    except DesignError as error:
        raise error.renamed(source=str(place)) from None
    except (OSError, ValueError, csv.Error):
        raise DesignError("table", shown(str(place)), "a CSV file of UTF-8 text that can be read") from None
    if not columns["size_mm"]:
        raise DesignError("rows", "none", "one for each sample", source=str(place))
    found: dict[str, NDArray[Any]] = {name: np.array(values, np.float64) for name, values in columns.items()}
    found["blank"] = np.isnan(found["size_mm"])
    return found


def _defaults(header: list[str], tables: Mapping[str, Any]) -> dict[str, float | None]:
    """Return the design's values of the dotted fields in a header."""
    for name in PARAMETERS[:3]:
        if name not in header:
            raise DesignError("the first line", f"no {name}", f"a header with {', '.join(PARAMETERS[:3])}")
    if len(header) > _MAX_COLUMNS:
        raise DesignError("the first line", f"{len(header)} columns", f"at most {_MAX_COLUMNS}")
    defaults: dict[str, float | None] = {}
    for name in header:
        if header.count(name) > 1:
            raise DesignError("the first line", f"{shown(name)} twice", "every column once")
        if name not in PARAMETERS:
            if "." not in name:
                allowed = f"{', '.join(PARAMETERS)}, or dotted fields of the design"
                raise DesignError("the first line", shown(name), allowed)
            defaults[name] = number_at(tables, name, "the first line")
            if name != ".".join(map(str, path_of(name))):
                raise DesignError("the first line", shown(name), "a field by its plain name")
    return defaults


def _row(where: str, cells: Mapping[str, str], defaults: Mapping[str, float | None]) -> dict[str, float]:
    """Return the numbers of one row."""
    found: dict[str, float] = {}
    for name, default in defaults.items():
        if not cells[name] and default is None:
            raise DesignError(f"{where}, {name}", "nothing", "a number, where the design sets none")
        found[name] = _read(f"{where}, {name}", cells[name]) if cells[name] else float(default or 0.0)
    if not cells["size_mm"]:
        for name in PARAMETERS:
            if cells.get(name):
                raise DesignError(f"{where}, {name}", shown(cells[name]), "nothing where size_mm is empty")
        return {**found, **dict.fromkeys(PARAMETERS, math.nan)}
    for name in PARAMETERS:
        text = cells.get(name, "")
        value = 0.0 if not text and name.startswith("offset") else _read(f"{where}, {name}", text)
        check_parameter(f"{where}, {name}", name, value)
        found[name] = value
    return found


def _read(where: str, text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise DesignError(where, shown(text) if text else "nothing", "a finite number")
    return value
