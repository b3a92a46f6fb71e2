"""A corpus on disk: where its files lie, what stands in them, and the table of all frames.

    plan.json, samples.parquet      what is to be made; see `twin.plan`
    samples/000/000123/             one sample: 0.exr, 0.png, ... for each press level, sample.json
    references/KEY.exr, KEY.png     the same press without inclusion, where several samples share it
    failed/000123.json              why a sample is missing
    index.parquet                   one row per frame; made from the frames, which know everything themselves

A sample's folder appears whole or not at all. Everything that decides a picture, and everything measured on
it, is text in the head of its EXR file (`record`), which the index only repeats.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from scenes import exr

SAMPLE = "sample.json"
PER_FOLDER = 1000  # samples: more entries make some file systems slow

_MOST = 2**20  # bytes of a sample.json
_FILE = re.compile(r"[0-9]{1,3}(\.reference)?\.(exr|png)|references/[0-9a-f]{16}\.(exr|png)")
_SHA = re.compile(r"[0-9a-f]{64}")

_FEM = {
    f"fem_{kind}_{name}": ("fem", kind, name)
    for kind in ("raw", "tared")
    for name in ("max_mm", "total_mm3", "area_mm2")
}
_TSIS = {
    f"tsis_{kind}_{name}": ("tsis", kind, name)
    for kind in ("raw", "tared")
    for name in ("max_dn", "total_dn", "area_px")
}
_OTHERS = {
    "indentation_mm": ("press", "indentation_mm"),
    "nominal_mm": ("press", "nominal_mm"),
    "force_N": ("press", "force_N"),
    "error_percent": ("fem", "error_percent"),
    "min_pressure_kPa": ("fem", "min_pressure_kPa"),
    "noise_percent": ("tsis", "noise_percent"),
    "saturated_percent": ("tsis", "saturated_percent"),
}
MEASURED = {**_OTHERS, **_FEM, **_TSIS}
"""Columns of the index, and where a frame's record holds them."""


def sample_folder(corpus: Path, number: int) -> Path:
    """Return where a sample's finished files lie."""
    return corpus / "samples" / f"{number // PER_FOLDER:03d}" / f"{number:06d}"


def failure_file(corpus: Path, number: int) -> Path:
    """Return where the reason lies that a sample is missing."""
    return corpus / "failed" / f"{number:06d}.json"


def finished(corpus: Path) -> set[int]:
    """Return the numbers of the samples that are there, whole."""
    found = (place.name for place in corpus.glob("samples/[0-9]*/[0-9]*") if (place / SAMPLE).exists())
    return {int(name) for name in found if name.isdecimal()}


@contextmanager
def sample_in_making(corpus: Path, number: int) -> Iterator[Path]:
    """Yield an empty folder that takes the sample's place when the block ends well; else it vanishes.

    Where another process has finished the same sample meanwhile, its folder stays: the bytes are the same.
    """
    place = sample_folder(corpus, number)
    place.parent.mkdir(parents=True, exist_ok=True)
    making = place.with_name(f".{place.name}.{os.getpid()}.part")
    try:
        shutil.rmtree(making, ignore_errors=True)
        making.mkdir()
        yield making
        _flush(making)
        try:
            making.rename(place)
        except OSError:
            if not (place / SAMPLE).exists():
                raise
            shutil.rmtree(making)
        with suppress(OSError):
            failure_file(corpus, number).unlink()
    except BaseException:
        shutil.rmtree(making, ignore_errors=True)
        raise


def _flush(folder: Path) -> None:
    """Have the folder's entries on the disk before its name is."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def write_frame(path: Path, planes: Mapping[str, NDArray[np.float32]], record: Mapping[str, Any]) -> None:
    """Write one frame's EXR, half floats where they lose nothing that matters, with its record.

    Planes are (rows, columns[, 3]) float32; those of colour become NAME.R, NAME.G, NAME.B. Counts keep all
    their bits, because scalars were computed from them.
    """
    flat = exr.flat_planes(planes)
    half = {name for name in flat if not name.startswith("counts")}
    exr.write_exr(path, flat, {"record": dumped(record)}, half=half)


def read_record(path: Path) -> dict[str, Any]:
    """Return the record of a frame's EXR, from the file's head alone.

    Raises `scenes.exr.ImageError` in one line.
    """
    text = exr.read_exr_text(path).get("record", "")
    with suppress(ValueError, RecursionError):
        record = json.loads(text, parse_constant=_refused)
        if isinstance(record, dict):
            return record
    raise exr.ImageError(f"{path}: record: received none that can be read, allowed: that of a frame")


@dataclass(frozen=True)
class Note:
    """What `sample.json` says: the SHA-256 of the sample's files by name, seconds by stage, the version."""

    sample: int
    sha256: dict[str, str]
    seconds: dict[str, float]
    version: str


def read_note(corpus: Path, number: int) -> Note:
    """Return what a sample's `sample.json` says. Nothing in it is trusted.

    Raises `scenes.exr.ImageError` in one line.
    """
    place = sample_folder(corpus, number) / SAMPLE
    try:
        with open(place, "rb") as file:
            data = json.loads(file.read(_MOST + 1)[:_MOST], parse_constant=_refused)
        hashes = {name: value for name, value in data["sha256"].items() if _FILE.fullmatch(name)}
        seconds = {name: float(data["seconds"][name]) for name in ("mechanics", "light", "write")}
        note = Note(int(data["sample"]), hashes, seconds, str(data["versions"]["tsis-twin"])[:100])
        good = all(isinstance(value, str) and _SHA.fullmatch(value) for value in hashes.values())
        good = good and all(0.0 <= value < 1e9 for value in seconds.values())
        if good and len(hashes) == len(data["sha256"]) and note.sample == number and hashes:
            return note
    except OSError as error:
        raise exr.ImageError(f"{place}: cannot be read ({error.strerror})") from error
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError, OverflowError):
        pass
    raise exr.ImageError(f"{place}: received what cannot be read, allowed: what `twin corpus run` wrote")


def _refused(name: str) -> None:
    raise ValueError(name)


def row_of(record: Mapping[str, Any]) -> dict[str, Any]:
    """Return what the index says of a frame's record; files, hashes and timings come from `sample.json`."""
    row: dict[str, Any] = {name: record[name] for name in ("sample", "level", "group", "blank")}
    row.update(record["parameters"])
    for column, keys in MEASURED.items():
        value: Any = record
        for key in keys:
            value = value[key]
        row[column] = value
    return row


def dumped(value: Mapping[str, Any]) -> str:
    """Return a record as text: sorted, one line, the same bytes for the same values; NaN becomes null."""
    return json.dumps(_plain(value), sort_keys=True, allow_nan=False, ensure_ascii=True)


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, np.generic):
        return _plain(value.item())
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def sha256(path: Path) -> str:
    """Return a file's SHA-256, in hexadecimal."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
