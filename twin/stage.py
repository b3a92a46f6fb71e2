"""A folder or a file of results that appears whole or not at all.

Everything is written to a hidden sibling and renamed into place at the end, so a full disk, a mistake or
Ctrl-C leaves neither half a result nor a broken earlier one.
"""

from __future__ import annotations

import glob
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
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
    made: list[Path] = []
    try:
        made = _make_parents(target.parent)
        _remove_abandoned(target)
        folder = target.with_name(f".{target.name}.{os.getpid()}.part")
        folder.mkdir()
    except (OSError, ValueError) as error:
        _remove_empty(made)
        raise DesignError("out", shown(str(out)), f"a folder that can be made ({_reason(error)})") from None
    try:
        yield folder
        _swap(folder, target)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        _remove_empty(made)
        raise


@contextmanager
def staged_file(name: str, field: str, suffix: str) -> Iterator[Path]:
    """Yield the path to write a file at, which takes its place when the block ends well; see `staged`.

    ``name`` must end in ``suffix``, and so does the path that is yielded. An earlier file is replaced; a
    folder, or a place that cannot be written, is refused with a `DesignError` about ``field``.
    """
    target = check_file(name, field, suffix)
    made: list[Path] = []
    try:
        made = _make_parents(target.parent)
        _remove_abandoned(target)
        folder = target.with_name(f".{target.name}.{os.getpid()}.part")
        folder.mkdir()
    except (OSError, ValueError) as error:
        _remove_empty(made)
        raise DesignError(field, shown(name), f"a file that can be made ({_reason(error)})") from None
    try:
        yield folder / target.name
        os.replace(folder / target.name, target)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        _remove_empty(made)
        raise
    shutil.rmtree(folder, ignore_errors=True)


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


def _refuse_foreign(out: str | Path, target: Path, is_ours: Callable[[Path], bool]) -> None:
    allowed = "a new or empty folder, or one that holds an earlier result of twin and nothing else"
    try:
        if target.is_symlink() or (target.exists() and not target.is_dir()):
            raise DesignError("out", f"{shown(str(out))}, which is not a folder", allowed)
        foreign = target.is_dir() and any(target.iterdir()) and not is_ours(target)
    except OSError as error:
        raise DesignError("out", shown(str(out)), f"a folder that can be read ({_reason(error)})") from None
    if foreign or target == target.parent:
        raise DesignError("out", f"{shown(str(out))}, which holds something else", allowed)


def _remove_abandoned(target: Path) -> None:
    """Remove what earlier runs towards the same folder left when they were killed outright."""
    for place in target.parent.glob(f".{glob.escape(target.name)}.*.part"):
        pid = place.name.removeprefix(f".{target.name}.").removesuffix(".part")
        if pid.isdecimal() and place.is_dir() and not place.is_symlink() and not _lives(int(pid)):
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


def _make_parents(parent: Path) -> list[Path]:
    """Make a folder and those above it; return the new ones, the outermost first."""
    missing = [place for place in (parent, *parent.parents) if not place.exists()]
    made: list[Path] = []
    try:
        for place in reversed(missing):
            place.mkdir()
            made.append(place)
    except OSError:
        _remove_empty(made)
        raise
    return made


def _remove_empty(made: list[Path]) -> None:
    for place in reversed(made):
        try:
            place.rmdir()
        except OSError:  # somebody else uses it by now
            return


def _swap(folder: Path, target: Path) -> None:
    """Put the folder in the target's place; the earlier one goes only once the new one stands."""
    if not target.exists():
        folder.rename(target)
        return
    earlier = folder.with_suffix(".old")
    target.rename(earlier)
    try:
        folder.rename(target)
    except BaseException:
        earlier.rename(target)
        raise
    shutil.rmtree(earlier, ignore_errors=True)


def _reason(error: OSError | ValueError) -> str:
    return (getattr(error, "strerror", None) or "the system refuses it").lower()
