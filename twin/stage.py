"""A folder or a file of results that appears whole or not at all.

Everything is written to a hidden sibling and renamed into place at the end, so a full disk, a mistake or
Ctrl-C leaves neither half a result nor a broken earlier one.
"""

from __future__ import annotations

import glob
import json
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.complaint import DesignError, shown


@contextmanager
def staged(out: str | Path, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield an empty folder that becomes ``out`` when the block ends well, and vanishes when it does not.

    ``out`` may be new, empty, or hold what an earlier run wrote and nothing else, which ``is_ours(out)``
    decides; that is then replaced. Anything else is refused with a `DesignError`, as is a place that cannot
    be written.
    """
    if not str(out):
        raise DesignError("out", "an empty name", "the folder to make for the results")
    target = Path(os.path.abspath(out))
    _refuse_foreign(out, target, is_ours)
    with _making(target, "out", str(out), "a folder that can be made") as folder:
        yield folder
        _swap(folder, target)


@contextmanager
def usable(field: str, folder: str | Path) -> Iterator[None]:
    """Say as a `DesignError` about ``field`` what the system has against a folder that the block uses."""
    try:
        yield
    except OSError as error:
        allowed = f"a folder that can be made, read and written ({_reason(error)})"
        raise DesignError(field, shown(str(folder)), allowed) from None


@contextmanager
def staged_file(name: str, field: str, suffix: str) -> Iterator[Path]:
    """Yield the path to write a file at, which takes its place when the block ends well; see `staged`.

    ``name`` must end in ``suffix``, and so does the path that is yielded. An earlier file is replaced; a
    folder, or a place that cannot be written, is refused with a `DesignError` about ``field``.
    """
    target = check_file(name, field, suffix)
    with _making(target, field, name, "a file that can be made") as folder:
        yield folder / target.name
        os.replace(folder / target.name, target)
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _making(target: Path, field: str, name: str, allowed: str) -> Iterator[Path]:
    """Yield an empty folder beside the target; if the block fails, it vanishes with the parents it needed.

    A signal may come between any two steps, so everything that makes something is inside the same `try`.
    """
    folder = target.with_name(f".{target.name}.{os.getpid()}.part")
    made: list[Path] = []
    try:
        try:
            _make_parents(target.parent, made)
            _remove_abandoned(target)
            folder.mkdir()
        except (OSError, ValueError) as error:
            raise DesignError(field, shown(name), f"{allowed} ({_reason(error)})") from None
        yield folder
    except BaseException:
        _settle(folder.with_suffix(".old"), target)
        shutil.rmtree(folder, ignore_errors=True)
        _remove_empty(made)
        raise


def check_file(name: str, field: str, suffix: str) -> Path:
    """Return the absolute path of a file to write, or raise `DesignError`."""
    target = Path(os.path.abspath(name))
    if not name.endswith(suffix) or target.name == suffix:
        raise DesignError(field, shown(name), f"the name of a file that ends in {suffix}")
    try:
        taken = target.exists() and not target.is_file()
    except (OSError, ValueError) as error:
        raise DesignError(field, shown(name), f"a file that can be made ({_reason(error)})") from None
    if taken:
        raise DesignError(field, f"{shown(name)}, which is not a file", f"a file that ends in {suffix}")
    return target


def has_keys(place: Path, *keys: str) -> bool:
    """Whether a file is a table in JSON with these keys: the name alone does not make it ours."""
    try:
        found = json.loads(place.read_bytes())
    except (OSError, ValueError, RecursionError):
        return False
    return isinstance(found, dict) and all(key in found for key in keys)


def begins(place: Path, text: str) -> bool:
    """Whether a file begins with the first words of a text of ours, up to what differs from file to file."""
    first = text.split("\n", 1)[0].split("{", 1)[0].encode()
    try:
        with open(place, "rb") as file:
            return file.read(len(first)) == first
    except OSError:
        return False


def _refuse_foreign(out: str | Path, target: Path, is_ours: Callable[[Path], bool]) -> None:
    allowed = "a new or empty folder, or one that holds an earlier result of twin and nothing else"
    try:
        if target.is_symlink() or (target.exists() and not target.is_dir()):
            raise DesignError("out", f"{shown(str(out))}, which is not a folder", allowed)
        if target.is_dir() and (os.path.ismount(target) or target.samefile(os.curdir)):
            what = "where a file system is mounted" if os.path.ismount(target) else "the working directory"
            raise DesignError("out", f"{shown(str(out))}, {what}", "a folder inside it")
        foreign = target.is_dir() and any(target.iterdir()) and not is_ours(target)
    except OSError as error:
        raise DesignError("out", shown(str(out)), f"a folder that can be read ({_reason(error)})") from None
    if foreign or target == target.parent:
        raise DesignError("out", f"{shown(str(out))}, which holds something else", allowed)


def _remove_abandoned(target: Path) -> None:
    """Remove what earlier runs towards the same folder left when they were killed outright.

    An earlier result that such a run had moved aside takes its place again where nothing new stands there.
    """
    for place in target.parent.glob(f".{glob.escape(target.name)}.*"):
        pid, _, kind = place.name.removeprefix(f".{target.name}.").partition(".")
        if kind not in ("part", "old") or not pid.isdecimal() or _lives(int(pid)):
            continue
        if place.is_symlink() or not place.is_dir():
            continue
        if kind == "old":
            _settle(place, target)
        else:
            shutil.rmtree(place, ignore_errors=True)


def _lives(pid: int) -> bool:
    if pid == os.getpid():  # the number of a process that is gone; this one has no such folder yet
        return False
    try:
        os.kill(pid, 0)
    except (ProcessLookupError, OverflowError):
        return False
    except OSError:  # somebody else's
        return True
    return True


def _make_parents(parent: Path, made: list[Path]) -> None:
    """Make a folder and those above it, and add the new ones to ``made``, the outermost first."""
    missing = [place for place in (parent, *parent.parents) if not place.exists()]
    for place in reversed(missing):
        made.append(place)  # first, for a signal may come once it is there
        place.mkdir()


def _remove_empty(made: list[Path]) -> None:
    for place in reversed(made):
        with suppress(OSError):  # never made, or somebody else uses it by now
            place.rmdir()


def _swap(folder: Path, target: Path) -> None:
    """Put the folder in the target's place; the earlier one goes only once the new one stands."""
    earlier = folder.with_suffix(".old")
    if target.exists():
        target.rename(earlier)
    folder.rename(target)
    _settle(earlier, target)


def _settle(earlier: Path, target: Path) -> None:
    """Remove the result that was moved aside, or put it back where no new one stands."""
    if not earlier.exists():
        return
    if target.exists():
        shutil.rmtree(earlier, ignore_errors=True)
    else:
        earlier.rename(target)


def _reason(error: OSError | ValueError) -> str:
    return (getattr(error, "strerror", None) or "the system refuses it").lower()
