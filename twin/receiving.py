"""Reading what a user gives to an estimator: folders of ``twin simulate``, or a real camera's PNG files.

Files may come from anybody: they are limited in size, and refused before they are unpacked where they are not
what the model can take. Every refusal is a `DesignError`, one line.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scenes import exr
from twin.complaint import DesignError, shown
from twin.exposure import REFERENCE_FRAMES
from twin.frame import MEAN, RECORD
from twin.received import MAX_FRAMES, Received, Wanted
from twin.sound import check_apart, check_exposure, check_pair, check_same

Float = NDArray[np.float32]

_OFF, _APART = 0.03, 0.0015
"""Share of a press level that simulated frames' may be off, all of them alike, as an estimator allows for;
and that one may be off beyond the others, which it takes for a softer inclusion (1 %: E is 4 sd off)."""
_MOST_RECORD = 2**20  # bytes
_SIMULATED = "folder of twin simulate"


def receive(
    frames: Sequence[str | Path],
    wanted: Wanted,
    *,
    references: Sequence[str | Path] = (),
    exposures: int = 1,
    flip: bool = False,
) -> Received:
    """Return the pictures of one specimen, read and checked.

    Parameters
    ----------
    frames : folders that `twin.simulate` wrote, of one press or of several, in any order; or PNG files, one
        for each press level in order, or ``exposures`` of them for each, those of the first level first.
    wanted : what the model can take.
    references : PNG files of the same presses without inclusion, in the same order; the same number of them
        for each level.
    exposures : how many of the frames to average for each level.
    flip : the files are seen from below, by the camera: their columns are turned round.

    Raises `DesignError` for what cannot be read, does not fit the model, or is no pair of pictures.
    """
    if not frames:
        raise DesignError("FRAME", "nothing", f"a {_SIMULATED}, or a PNG file for each press level")
    if isinstance(exposures, bool) or exposures < 1:
        raise DesignError("--frames", shown(exposures), "an integer > 0")
    places = [Path(frame) for frame in frames]
    folders = [place for place in places if os.path.isdir(place)]  # False for any odd name
    if len(places) == 1 and not os.path.lexists(places[0]):  # a mistyped folder, not one file of several
        allowed = f"a {_SIMULATED}, or a PNG file for each press level"
        raise DesignError(str(places[0]), "no such file or folder", allowed)
    if not folders:
        return _from_camera(places, [Path(name) for name in references], wanted, exposures, flip)
    if len(folders) < len(places):
        other = next(place for place in places if place not in folders)
        raise DesignError(str(other), "a file beside folders", "folders only, or files only")
    for flag, given in (("--reference", references), ("--flip", flip)):
        if given:
            allowed = "it with files only: folders of twin simulate have references, and need no turning"
            raise DesignError(flag, "it with a folder", allowed)
    return _from_folders(_opened(folders), wanted, exposures)


def _from_camera(
    files: list[Path], references: list[Path], wanted: Wanted, exposures: int, flip: bool
) -> Received:
    _check_count(len(files), wanted, exposures, "FRAME", "files")
    if not references or len(references) % wanted.levels:
        levels = f"{wanted.levels} press level{'s' if wanted.levels > 1 else ''}"
        allowed = f"pictures of the press without inclusion, as many for each of {levels}"
        raise DesignError("--reference", f"{len(references) or 'no'} files", allowed)
    several = len(references) // wanted.levels
    if several > MAX_FRAMES:
        raise DesignError("--reference", f"{several} a level", f"at most {MAX_FRAMES}")
    _check_frames(exposures, wanted)
    twice = {os.path.abspath(place) for place in references} & {os.path.abspath(place) for place in files}
    if twice:
        raise DesignError("--reference", f"{min(twice)}, which is a FRAME too", "other files")
    images, plain = [], []
    for level in range(wanted.levels):
        images.append(_mean(files[level * exposures : (level + 1) * exposures], wanted))
        plain.append(_mean(references[level * several : (level + 1) * several], wanted))
    turn = (slice(None), slice(None), slice(None, None, -1)) if flip else (slice(None),)
    return _checked(
        Received(
            images=np.ascontiguousarray(np.stack(images)[turn]),
            references=np.ascontiguousarray(np.stack(plain)[turn]),
            frames=exposures,
            reference_frames=several,
            bits=wanted.bits,
            names=tuple(str(place) for place in files[::exposures]),
        )
    )


def _mean(files: list[Path], wanted: Wanted) -> Float:
    """The mean of exposures of one press level, each of them checked."""
    total = np.zeros(wanted.planes, np.float64)
    first: Float | None = None
    taken: dict[bytes, str] = {}
    for place in files:
        picture = _png(place, wanted)
        check_exposure(picture, wanted.bits, str(place))
        check_apart(picture, str(place), taken)
        if first is None:
            first = picture
        else:
            check_same(first, picture, wanted.bits, (str(files[0]), str(place)))
        total += picture
    return (total / len(files)).astype(np.float32)


def _png(place: Path, wanted: Wanted) -> Float:
    """One picture, (rows, columns[, 3]) counts."""
    return _unpacked(_bytes(place, wanted), place, wanted)


def _unpacked(data: bytes, place: Path, wanted: Wanted) -> Float:
    # ISO/IEC 15948, 11.2.2: bit depth and colour type follow width and height
    if data[:8] == b"\x89PNG\r\n\x1a\n" and len(data) > 25:
        depth, kind = data[24], data[25]
        needed = 8 if wanted.bits <= 8 else 16
        if depth != needed:
            allowed = f"{needed} bits, as the model's camera of {wanted.bits} bits writes"
            raise DesignError(str(place), f"a PNG of {depth} bits", allowed)
        if kind in (0, 2) and (kind == 0) != (wanted.colour == "mono"):
            names = {"mono": "a grey picture", "rgb": "a picture in colour"}
            received = names["mono" if kind == 0 else "rgb"]
            raise DesignError(str(place), received, f"{names[wanted.colour]}, as the model's camera takes")
    try:
        picture = exr.decode_png(data, place, shape=wanted.shape)
    except exr.ImageError as error:
        raise _as_one_line(error, place) from None
    if picture.shape != wanted.planes:
        raise DesignError(str(place), f"an array of {picture.shape}", str(wanted.planes))
    if picture.max() >= 2**wanted.bits:
        allowed = f"0 to {2**wanted.bits - 1}, the {wanted.bits} bits of the model's camera"
        raise DesignError(str(place), f"counts up to {picture.max()}", allowed)
    return picture.astype(np.float32)


def _opened(folders: list[Path]) -> list[Path]:
    """Folders of one frame each: those given, and those within a folder of several."""
    found: list[Path] = []
    for folder in folders:
        if (folder / RECORD).is_file():
            found.append(folder)
            continue
        try:
            inside = sorted(place for place in folder.iterdir() if place.name.isdigit())
        except OSError as error:
            raise DesignError(str(folder), _reason(error), "a folder that can be read") from None
        inside = [place for place in inside if (place / RECORD).is_file()]
        if not inside:
            raise DesignError(str(folder), f"a folder without {RECORD}", f"a {_SIMULATED}")
        found += inside
    return found


def _from_folders(folders: list[Path], wanted: Wanted, exposures: int) -> Received:
    _check_count(len(folders), wanted, exposures, "FRAME", "frames")
    by_level: list[list[tuple[Path, dict[str, Any]]]] = [[] for _ in range(wanted.levels)]
    depths, off = np.array(wanted.indentation_mm), list[float]()
    for folder in folders:
        record = _record(folder)
        depth = _number(record, "press", "indentation_mm", folder)
        level = int(np.argmin(np.abs(depths - depth)))
        if abs(depth - depths[level]) > _OFF * depths[level]:
            allowed = f"{', '.join(f'{value:g}' for value in depths)} mm, the levels of the model"
            raise DesignError(f"{folder}: press.indentation_mm", f"{depth:g}", allowed)
        by_level[level].append((folder, record))
        off.append(depth / depths[level] - 1.0)
        if max(off) - min(off) > _APART:
            allowed = f"levels that are off alike, within {_APART:.2%} (another: {off[0]:+.2%})"
            received = f"{depth:g}, {off[-1]:+.2%} off its level"
            raise DesignError(f"{folder}: press.indentation_mm", received, allowed)
    for depth, group in zip(depths, by_level, strict=True):
        if len(group) != exposures:
            raise DesignError("FRAME", f"{len(group)} at {depth:g} mm", f"{exposures} at each press level")
    read = [[_simulated(*pair, wanted) for pair in group] for group in by_level]
    counts = {(sum(one.frames for one in same), sum(one.reference_frames for one in same)) for same in read}
    if len(counts) > 1:
        raise DesignError("FRAME", "unlike numbers of exposures", "equal ones at all press levels")
    ((frames, several),) = counts
    _check_frames(frames, wanted)
    for first, *others in read:
        taken: dict[bytes, str] = {}
        for one in (first, *others):
            check_apart(one.image, one.name, taken)
        for other in others:
            check_same(first.image, other.image, wanted.bits, (first.name, other.name))
    images = [_weighted([(one.image, one.frames) for one in same]) for same in read]
    plain = [_weighted([(one.reference, one.reference_frames) for one in same]) for same in read]
    return _checked(
        Received(
            images=np.stack(images),
            references=np.stack(plain),
            frames=frames,
            reference_frames=several,
            bits=wanted.bits,
            names=tuple(same[0].name for same in read),
        )
    )


class _Frame(NamedTuple):
    """What a folder of one frame holds."""

    image: Float
    reference: Float
    frames: int
    reference_frames: int
    name: str


def _weighted(parts: list[tuple[Float, int]]) -> Float:
    total = sum(weight for _, weight in parts)
    mean = sum(picture.astype(np.float64) * (weight / total) for picture, weight in parts)
    return np.asarray(mean, np.float32)


def _simulated(folder: Path, record: dict[str, Any], wanted: Wanted) -> _Frame:
    averaged = (folder / MEAN).is_file()
    frames = _count(record, "frames", None if averaged else 1, folder)
    several = _count(record, "reference_frames", max(REFERENCE_FRAMES, frames), folder)
    if averaged:
        image = _counts(folder / MEAN, record, wanted)
    else:
        place = folder / "image.png"
        image = _unpacked(_hashed(place, record, wanted), place, wanted)
    reference = _counts(folder / "reference.exr", record, wanted)
    check_exposure(image, wanted.bits, str(folder))
    check_exposure(reference, wanted.bits, str(folder / "reference.exr"))
    return _Frame(image, reference, frames, several, str(folder))


def _counts(place: Path, record: dict[str, Any], wanted: Wanted) -> Float:
    """The counts of an EXR file, with their fractions."""
    names = ["counts"] if wanted.colour == "mono" else ["counts.R", "counts.G", "counts.B"]
    data = _hashed(place, record, wanted)
    try:
        planes = exr.decode_exr(data, place, shape=wanted.shape, names=names)
    except exr.ImageError as error:
        raise _as_one_line(error, place) from None
    if set(planes) != set(names):
        raise DesignError(str(place), f"channels {sorted(planes)}", f"{names}")
    found = np.stack([planes[name] for name in names], axis=-1).astype(np.float32).reshape(wanted.planes)
    top = 2.0**wanted.bits - 1
    if not (np.isfinite(found).all() and found.min() >= 0 and found.max() <= top):
        raise DesignError(str(place), "counts that no camera gives", f"finite ones, 0 to {top:g}")
    return found


def _record(folder: Path) -> dict[str, Any]:
    place = folder / RECORD
    data = _limited(place, _MOST_RECORD)
    try:
        record = json.loads(data)
    except (ValueError, RecursionError):
        raise DesignError(str(place), "what is no JSON", f"that of a {_SIMULATED}") from None
    if not isinstance(record, dict):
        raise DesignError(str(place), shown(record), "a table in JSON")
    return record


def _number(record: dict[str, Any], table: str, name: str, folder: Path) -> float:
    inner = record.get(table)
    value = inner.get(name) if isinstance(inner, dict) else None
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not 0 < value < math.inf:
        raise DesignError(f"{folder / RECORD}: {table}.{name}", shown(value), "a finite number > 0")
    return float(value)


def _count(record: dict[str, Any], name: str, default: int | None, folder: Path) -> int:
    inner = record.get("tsis")
    value = inner.get(name, default) if isinstance(inner, dict) else default
    if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= MAX_FRAMES:
        allowed = f"an integer of 1 to {MAX_FRAMES}"
        raise DesignError(f"{folder / RECORD}: tsis.{name}", shown(value), allowed)
    return value


def _hashed(place: Path, record: dict[str, Any], wanted: Wanted) -> bytes:
    """A file's bytes, if they are those that the frame's record knows."""
    data = _bytes(place, wanted)
    hashes = record.get("sha256")
    told = hashes.get(place.name) if isinstance(hashes, dict) else None
    if told != hashlib.sha256(data).hexdigest():
        raise DesignError(str(place), "a file that is not the one written", f"that of sha256 in {RECORD}")
    return data


def _bytes(place: Path, wanted: Wanted) -> bytes:
    return _limited(place, 16 * math.prod(wanted.planes) + 2**20)


def _limited(place: Path, largest: int) -> bytes:
    try:
        if not place.is_file():  # a pipe would wait for ever
            raise FileNotFoundError(2, "no such file")
        with open(place, "rb") as file:
            data = file.read(largest + 1)
    except (OSError, ValueError) as error:
        what = f"nothing that can be read ({_reason(error)})"
        raise DesignError(str(place), what, "a file") from None
    if len(data) > largest:
        raise DesignError(str(place), f"more than {largest} bytes", "a smaller file, of the model's size")
    return data


def _reason(error: OSError | ValueError) -> str:
    return (getattr(error, "strerror", None) or "the system refuses it").lower()


def _as_one_line(error: exr.ImageError, place: Path) -> DesignError:
    """What a reader of pictures says, as field, received and allowed."""
    text = str(error).removeprefix(f"{place}: ")
    received, _, allowed = text.removeprefix("received ").partition(", allowed: ")
    return DesignError(str(place), received, allowed or "a picture that can be read")


def _check_count(given: int, wanted: Wanted, exposures: int, field: str, what: str) -> None:
    if given != wanted.levels * exposures:
        depths = ", ".join(f"{depth:g}" for depth in wanted.indentation_mm)
        each = f"{exposures} for each" if exposures > 1 else "one for each"
        allowed = f"{each} of the model's press levels, {depths} mm (--frames N: N exposures for each)"
        raise DesignError(field, f"{given} {what[:-1] if given == 1 else what}", allowed)


def _check_frames(frames: int, wanted: Wanted) -> None:
    least, most = wanted.frames
    if not least <= frames <= most:
        raise DesignError("--frames", str(frames), f"{least} to {most}, for which the model was trained")


def _checked(received: Received) -> Received:
    check_pair(received)
    return received
