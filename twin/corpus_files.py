"""What a corpus on disk may hold, and how its files are opened: a corpus may come from a stranger.

Nothing outside its folder is opened, nothing larger than its plan says is unpacked, nothing is executed: the
plan is JSON, the index Parquet without its pandas notes, a picture EXR or PNG. Whatever does not fit is
refused in one line.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from twin import index, planned, store
from twin.complaint import DesignError, shown
from twin.planned import Plan
from twin.study import PARAMETERS

INCLUSION = PARAMETERS
"""Columns that say what lies in the tissue; NaN in a blank."""

_LARGEST_CELL = 1000  # characters of a text of the index
_HASHES = ("sha256_exr", "sha256_png", "sha256_reference")
_MAY_BE_NAN = ("error_percent", "min_pressure_kPa", "noise_percent", *index.TIMINGS)


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


def read_index(root: Path, plan: Plan) -> pa.Table:
    """Return the index, one row per frame, sorted by sample and level. Raises ValueError in one line."""
    place = inside(root, index.FILE)
    if not place.is_file():
        allowed = "the index (`twin corpus run` makes it of the frames)"
        raise DesignError(index.FILE, "no such file", allowed, source=str(root))
    table = index.read(root, plan, planned.sha256(root / planned.PLAN)).replace_schema_metadata(None)
    table = table.sort_by([("sample", "ascending"), ("level", "ascending")]).combine_chunks()
    _check_values(table, plan, str(place))
    return table


def _check_values(table: pa.Table, plan: Plan, source: str) -> None:
    """Refuse rows that are not those of finished samples, and values that no frame has."""

    def refuse(name: str, wrong: NDArray[Any], allowed: str) -> None:
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            value = table[name][row].as_py()
            raise DesignError(f"column {name}, row {row}", shown(value), allowed, source=source)

    for name in [field.name for field in table.schema if field.type != pa.float64()]:
        refuse(name, table[name].is_null().to_numpy(), "a value in each row")
    sample, level = (table[name].to_numpy() for name in ("sample", "level"))
    levels = len(plan.indentation_mm)
    refuse("sample", (sample < 0) | (sample >= len(plan)), f"0 to {len(plan) - 1}, as planned")
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
            elif field.name not in _MAY_BE_NAN:
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
