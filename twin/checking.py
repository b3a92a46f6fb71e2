"""The parts of a corpus's check: one sample, the references that samples share, the index, strange files."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pyarrow.compute as pc

from scenes import exr
from twin import index, store
from twin.complaint import shown
from twin.occupied import LOCK, leftovers
from twin.planned import EMULATOR, IES, PLAN, SAMPLES, TRACED

if TYPE_CHECKING:
    from collections.abc import Collection, Sequence

    import pyarrow as pa

    from twin.plan import Plan

# What others keep in a corpus's folder, and who knows: the reader's cache, the dataset card.
_TOLERATED = frozenset({PLAN, SAMPLES, EMULATOR, TRACED, LOCK, index.FILE, "README.md"})
_FOLDERS = frozenset({"samples", "references", "failed", "cache", "figures"})
_LARGEST = 2**32  # bytes of a picture that is looked into
_THOUSAND = re.compile(r"[0-9]{3,9}")
_NUMBER = re.compile(r"[0-9]{6,12}")
_SHARED = re.compile(r"references/([0-9a-f]{16})\.(exr|png)")


@dataclass(frozen=True)
class Problem:
    """What is wrong with one file."""

    where: str
    """Path from the corpus's folder, or what else it is about."""
    what: str
    sample: int | None = None
    """The sample that has to be made again."""
    reference: str | None = None
    """The shared reference that has to be made again."""

    def __str__(self) -> str:
        return f"{self.where}: {self.what}"


def check_sample(folder: Path, plan: Plan, shared: Shared, number: int) -> tuple[list[Problem], int]:
    """Return what is wrong with a sample, and how many files were hashed."""
    place = store.sample_folder(folder, number)
    name = place.relative_to(folder).as_posix()
    if not place.is_dir() or place.is_symlink():
        why = "is a link" if place.is_symlink() else "is missing, and the index has it"
        return [Problem(name, f"sample {number} {why}", number)], 0
    try:
        note = store.read_note(folder, number)
    except exr.ImageError as error:
        return [Problem(f"{name}/{store.SAMPLE}", _what(error), number)], 0
    found, files = [], 0
    own = {file: sha for file, sha in note.sha256.items() if not file.startswith("references/")}
    for file, sha in sorted(own.items()):
        files += 1
        if why := _changed(place / file, sha):
            found.append(Problem(f"{name}/{file}", why, number))
    for file, sha in note.sha256.items():
        if file not in own:
            shared.claim(file, sha, number)
    for path in sorted(place.iterdir()):
        if path.name not in own and path.name != store.SAMPLE:
            found.append(Problem(f"{name}/{shown(path.name)}", "is not one of the sample's files", number))
    if not found:
        found += _records(folder, plan, number, name)
    return found, files


def _records(folder: Path, plan: Plan, number: int, name: str) -> Iterator[Problem]:
    """Yield where the frames of a sample whose files are whole say other than the plan."""
    try:
        index.rows_of(folder, plan, number)
        for level, nominal in enumerate(plan.indentation_mm):
            record = store.read_record(store.sample_folder(folder, number) / f"{level}.exr")
            light, camera = plan.seeds(number)
            wanted = {
                "group": plan.group(number),
                "blank": plan.inclusion(number) is None,
                "parameters": plan.parameters(number),
                "seed": {"light": light, "camera": camera},
            }
            for field, value in wanted.items():
                if record.get(field) != value:
                    said = f"{field} is {shown(record.get(field))}, planned is {shown(value)}"
                    yield Problem(f"{name}/{level}.exr", f"record: {said}", number)
            if record["press"]["nominal_mm"] != nominal:
                yield Problem(
                    f"{name}/{level}.exr", f"record: press is not the planned {nominal:g} mm", number
                )
    except exr.ImageError as error:
        yield Problem(name, _what(error), number)


def _changed(path: Path, sha256: str) -> str:
    """Return what is wrong with a file that should have a hash; nothing where it has."""
    try:
        if path.is_symlink() or (path.exists() and not path.is_file()):
            return "is not a plain file"
        if store.sha256(path) == sha256:
            return ""
        if path.suffix == ".exr" and path.stat().st_size < _LARGEST:
            exr.read_exr_header(path)
    except FileNotFoundError:
        return "is missing"
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    except exr.ImageError as error:
        return f"has changed: {_what(error)}"
    except Exception:  # OpenEXR's own complaint about a head that was tampered with
        return "has changed: its head cannot be read"
    return "has changed: its SHA-256 is not the one that was written"


def _what(error: Exception) -> str:
    """Return an error without the path that it starts with."""
    _, colon, rest = str(error).partition(": ")
    return rest if colon else str(error)


class Shared:
    """References that several samples share: each is hashed once."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.known: dict[str, str] = {}
        """Hash that the first sample gave for each file."""
        self._users: dict[str, int] = {}
        self._bad: dict[str, str] = {}
        self._found: list[Problem] = []
        self._lock = threading.Lock()

    def claim(self, file: str, sha256: str, number: int) -> None:
        """Take note of what a sample says of a file; look at it the first time."""
        with self._lock:
            if file not in self.known:
                self.known[file], self._users[file] = sha256, number
                if why := _changed(self.folder / file, sha256):
                    self._bad[file] = why
            elif self.known[file] == sha256:
                self._users[file] = min(self._users[file], number)  # samples come in any order
            else:
                where = store.sample_folder(self.folder, number).relative_to(self.folder).as_posix()
                why = f"gives another SHA-256 for {file} than sample {self._users[file]}"
                self._found.append(Problem(f"{where}/{store.SAMPLE}", why, number))

    def problems(self, *, complete: bool) -> list[Problem]:
        """Return what is wrong with them; ``complete``: whether all samples that could use one are there."""
        place = self.folder / "references"
        entries = sorted(place.iterdir()) if place.is_dir() else []
        strange = [
            Problem(f"references/{shown(path.name)}", "belongs to no sample")
            for path in entries
            if f"references/{path.name}" not in self.known
            and not path.name.endswith(".part")
            and (complete or not _SHARED.fullmatch(f"references/{path.name}"))
        ]
        bad = []
        for file, why in sorted(self._bad.items()):
            match = _SHARED.fullmatch(file)
            bad.append(Problem(file, why, self._users[file], match[1] if match else None))
        return bad + self._found + strange


def check_places(folder: Path, plan: Plan) -> Iterator[Problem]:
    """Yield files and folders that no run of this plan makes."""
    for path in leftovers(folder):
        where = path.relative_to(folder).as_posix()
        yield Problem(where, "is temporary: of a run that was killed, run removes it")
    for path in sorted(folder.iterdir()):
        known = path.name in (_FOLDERS if path.is_dir() else _TOLERATED) or IES.fullmatch(path.name)
        if (not known and not path.name.endswith(".part")) or path.is_symlink():
            yield Problem(shown(path.name), "is a link" if path.is_symlink() else "is not a corpus's")
    for thousand in sorted((folder / "samples").glob("*")):
        if not thousand.is_dir() or thousand.is_symlink() or not _THOUSAND.fullmatch(thousand.name):
            yield Problem(f"samples/{shown(thousand.name)}", "is not a corpus's")
            continue
        for path in sorted(thousand.iterdir()):
            right = _NUMBER.fullmatch(path.name) and int(path.name) < len(plan)
            right = right and store.sample_folder(folder, int(path.name)) == path
            if not right and not path.name.endswith(".part"):
                yield Problem(f"samples/{thousand.name}/{shown(path.name)}", "is no sample of the plan")


def check_index(
    table: pa.Table, rows: pa.Table, numbers: Sequence[int], present: Collection[int]
) -> Iterator[Problem]:
    """Yield where the index says other of these samples, neighbours, than their frames do (``rows``).

    ``present`` are those whose frames can be read: what the index has of others was told already.
    """
    within = pc.and_(
        pc.greater_equal(table["sample"], numbers[0]), pc.less_equal(table["sample"], numbers[-1])
    )
    found = table.filter(within)
    if found.equals(rows):
        return
    listed, wanted = found.to_pylist(), rows.to_pylist()
    of: dict[tuple[Any, Any], dict[str, Any]] = {}
    for row in listed:
        key = row["sample"], row["level"]
        if key in of:
            yield Problem(index.FILE, f"{_frame(key)} is there twice")
        of[key] = row
    for row in wanted:
        key = row["sample"], row["level"]
        said = of.pop(key, None)
        if said is None:
            yield Problem(index.FILE, f"{_frame(key)} is not in it")
            continue
        for column, value in row.items():
            if said[column] != value and not (said[column] != said[column] and value is None):
                what = f"{column} is {shown(said[column])}, its files say {shown(value)}"
                yield Problem(index.FILE, f"{_frame(key)}: {what}")
    for key in (key for key in of if key[0] in present):
        yield Problem(index.FILE, f"{_frame(key)} is in it, but its files are not there")


def _frame(key: tuple[Any, Any]) -> str:
    return f"sample {key[0]} level {key[1]}"
