"""The folder of an exploration: whose it is, what it says of itself, and how it comes to be."""

from __future__ import annotations

import hashlib
import json
import os
import re
import tomllib
import uuid
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, TypeAdapter, ValidationError
from pydantic.dataclasses import dataclass

from scenes import ies
from scenes.traced import LIGHT
from scenes.view import SIGHT
from twin.complaint import DesignError, shown
from twin.design import Design, parse_design
from twin.explored import design_toml
from twin.fields import flat, tables_of
from twin.stage import usable

STUDY, BASE, HEAD, DATABASE = "study.toml", "base.toml", "explore.json", "study.db"
TRIALS, BASELINE, KEPT, WORKERS = "trials", "baseline", "kept", "workers"
LOCK = "storage.lock"

JUDGED = 2
"""Version of how layouts are judged beside their light; 2: a mesh and a row of pixels no longer tell of an
inclusion (`twin.touches`, `scenes.tangent`)."""

_SECRETS = (
    (re.compile(r"(?<=://)([^:/]*):.*@"), r"\1:***@"),
    (re.compile(r"(?i)(?<=[?&])(pass\w*)=[^&]*"), r"\1=***"),
)


@dataclass(frozen=True)
class Head:
    """What `explore.json` says. Folders made before have no hashes: these are not compared then."""

    storage: str | None
    trials: Annotated[int, Field(ge=1)]
    emulator: str | None
    emulator_sha256: str | None = None
    luminaires: tuple[str | None, ...] | None = None
    light: tuple[int, int] | None = None
    """Versions of the light that layouts are judged in: `scenes.traced.LIGHT`, `scenes.view.SIGHT`."""
    judged: int = 1
    """`JUDGED`; folders of before 2 do not say it."""


_HEAD = TypeAdapter(Head)


def head_of(design: Design, storage: str | None, trials: int, emulator: Path | None) -> Head:
    """What a folder is to say of an exploration."""
    told = None if emulator is None else _sha256(emulator)
    lamps = tuple(None if led.ies is None else ies.digest(led.ies) for led in design.leds)
    place = None if emulator is None else str(emulator.resolve())
    return Head(storage, trials, place, told, lamps, (LIGHT, SIGHT), JUDGED)


def earlier(folder: Path, text: str) -> Head | None:
    """Return what a folder says of the exploration of this study that is in it; None for a new one.

    Raises
    ------
    DesignError
        In one line, for a folder that holds anything else, or cannot be read.
    """
    with usable("--out", folder):
        if (folder / STUDY).exists():
            if (folder / STUDY).read_bytes() != text.encode():
                allowed = "a new folder, or that of the same study file"
                raise DesignError("--out", shown(str(folder)), allowed)
            for name in (HEAD, BASE):
                if not (folder / name).is_file():
                    received = f"{shown(str(folder))}, which holds {STUDY} and no {name}"
                    raise DesignError("--out", received, "a new or empty folder, or one that explore made")
            return head(folder)
        # the lock is there where an exploration was cut off before it had begun
        if folder.exists() and any(folder.iterdir()) and not (folder / WORKERS / LOCK).is_file():
            allowed = "a new or empty folder, or one that explore made"
            raise DesignError("--out", shown(str(folder)), allowed)
    return None


def head(folder: Path) -> Head:
    """Return what a folder says of its exploration; raises `DesignError` for what it cannot say."""
    try:
        return _HEAD.validate_json((folder / HEAD).read_bytes())
    except ValidationError as error:
        where = ".".join(map(str, error.errors()[0]["loc"]))
        received = f"{shown(str(folder))}, whose {HEAD} is not as it was written {where and f'({where})'}"
        raise DesignError("--out", received, "a folder as explore made it") from None


def check_same(folder: Path, before: Head, now: Head, design: Design) -> None:
    """Refuse to go on with another sensor or another emulator than a folder's layouts were judged with."""
    tables = tomllib.loads((folder / BASE).read_text(encoding="utf-8"))
    for led, own in zip(tables["leds"], design.leds, strict=False):
        if led.get("ies") is not None and own.ies is not None:
            led["ies"] = own.ies  # compared by what they say, wherever they lie now
    there = parse_design(tables, str(folder / BASE))
    old, new = (_told(one, each) for one, each in ((there, before), (design, now)))
    for field in sorted(set(old) | set(new)):
        if old.get(field) != new.get(field):
            received = f"{shown(str(folder))}, the folder of another sensor"
            allowed = f"a new folder, or {field} = {shown(old.get(field))} as there"
            raise DesignError("--out", f"{received} ({field} is now {shown(new.get(field))})", allowed)
    if before.light not in (None, now.light) or before.judged != now.judged:
        received = f"{shown(str(folder))}, whose layouts were judged by another version"
        raise DesignError("--out", received, "a new folder")
    known = before.emulator_sha256
    if known is None and before.emulator is not None:
        with suppress(OSError):  # one that is gone cannot be compared, but its layouts can be read
            known = _sha256(Path(before.emulator))
    if (before.emulator is None) == (now.emulator is None) and known in (None, now.emulator_sha256):
        return
    received = f"{shown(str(folder))}, the folder of another emulator"
    allowed = f"a new folder, or {'no emulator' if before.emulator is None else before.emulator} as it was"
    raise DesignError("--out", received, allowed)


def check_moved(folder: Path, before: Head, url: str, known: int) -> None:
    """Refuse another storage that knows no layout where a folder holds some: they would be overwritten."""
    if not known and any((folder / TRIALS).glob("*")):
        there = hidden(before.storage or own_database(folder))
        allowed = f"{there}, which knows the layouts of that folder, or a new folder"
        raise DesignError("--storage", hidden(url), allowed)


def _told(design: Design, said: Head) -> dict[str, Any]:
    """Values of a design as they are compared: luminaires by what they say where that is known."""
    tables, lamps = tables_of(design), dict(enumerate(said.luminaires or ()))
    del tables["description"]
    for number, led in enumerate(tables["leds"]):
        if led["ies"] is not None:
            led["ies"] = lamps.get(number) or ies.digest(led["ies"])
    return flat(tables)


@contextmanager
def making(folder: Path) -> Iterator[None]:
    """Make the folder of an exploration; what was made and is empty goes again where the block fails."""
    made: list[Path] = []
    try:
        with usable("--out", folder):
            for place in (*reversed(folder.parents), folder, folder / WORKERS, folder / TRIALS):
                if not place.is_dir():
                    made.append(place)  # first, for a signal may come once it is there
                    place.mkdir(exist_ok=True)
                if place == folder / WORKERS:  # by which a process beside this one knows whose folder it is
                    (place / LOCK).touch()
        yield
    except BaseException:
        if folder / WORKERS in made and not (folder / DATABASE).exists():
            with suppress(OSError):
                (folder / WORKERS / LOCK).unlink(missing_ok=True)
        for place in reversed(made):
            with suppress(OSError):  # never made, or somebody else uses it by now
                place.rmdir()
        raise


def write(folder: Path, text: str, design: Design, said: Head) -> None:
    """Write what a folder says of its exploration, the study last: with it the exploration has begun."""
    secret = said.storage is not None and hidden(said.storage) != said.storage
    with usable("--out", folder):
        _replace(folder / BASE, design_toml(design))
        _replace(folder / HEAD, json.dumps(vars(said), indent=1) + "\n", 0o600 if secret else 0o666)
        _replace(folder / STUDY, text)


def own_database(folder: Path) -> str:
    """Return the URL of the database in a folder.

    SQLAlchemy reads a URL's % as the beginning of a character's number, ? as its end, and Optuna puts its
    version in place of {}.
    """
    place = re.sub("[%?{}]", lambda found: f"%{ord(found[0]):02X}", str((folder / DATABASE).resolve()))
    return f"sqlite:///{place}"


def hidden(url: str) -> str:
    """Return a storage's URL without its password."""
    for pattern, instead in _SECRETS:
        url = pattern.sub(instead, url)
    return url


def _sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _replace(path: Path, text: str, mode: int = 0o666) -> None:
    part = path.with_name(f".{path.name}.{uuid.uuid4().hex[:8]}")
    with open(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "w", encoding="utf-8") as file:
        file.write(text)
    os.replace(part, path)
