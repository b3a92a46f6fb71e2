"""Whose a corpus is while it is being run: a lock that its run holds, and what a killed one leaves behind."""

from __future__ import annotations

import fcntl
import json
import os
import re
import shutil
import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.complaint import DesignError, shown

LOCK = "run.lock"

_LEFT = re.compile(r"\.[A-Za-z0-9_.-]+\.part")
_PLACES = (".", "samples/*", "references", "failed")


@contextmanager
def locked(corpus: Path) -> Iterator[None]:
    """Have the corpus for this process alone; the lock ends with it, however it ends.

    Raises
    ------
    DesignError
        If another run has it.
    OSError
        If the folder cannot be written.
    """
    place = corpus / LOCK
    handle = _open(place)
    try:
        with suppress(OSError):  # a full disk: the lock holds without saying whose it is
            os.ftruncate(handle, 0)
            os.write(handle, json.dumps({"host": socket.gethostname(), "pid": os.getpid()}).encode())
        yield
    finally:
        with suppress(OSError):
            place.unlink()
        os.close(handle)


def _open(place: Path) -> int:
    while True:
        handle = os.open(place, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            with suppress(FileNotFoundError):
                if os.path.sameopenfile(handle, handle) and os.stat(place).st_ino == os.fstat(handle).st_ino:
                    return handle
        except BlockingIOError:
            os.close(handle)
            allowed = "one run at a time: wait for it, or stop it"
            raise DesignError("DIR", f"{shown(str(place.parent))}, which {holder(place.parent)} is running", allowed) from None
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)  # the one before removed it meanwhile


def holder(corpus: Path) -> str | None:
    """Return which process runs the corpus now, in words; None where none does."""
    try:
        handle = os.open(corpus / LOCK, os.O_RDWR | os.O_NOFOLLOW)
    except OSError:
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_SH | fcntl.LOCK_NB)
        return None
    except OSError:
        try:
            said = json.loads(os.read(handle, 1000))
            return f"process {int(said['pid'])} on {str(said['host'])[:100]}"
        except (OSError, ValueError, KeyError, TypeError):
            return "another process"
    finally:
        os.close(handle)


def leftovers(corpus: Path) -> list[Path]:
    """Return the temporary files and folders that lie in a corpus: of its run, or of one that was killed."""
    return sorted(
        path for place in _PLACES for path in corpus.glob(f"{place}/.*.part") if _LEFT.fullmatch(path.name)
    )


def sweep(corpus: Path) -> int:
    """Remove what killed runs left, and return how much that was. Only for who holds the lock."""
    found = leftovers(corpus)
    for path in found:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.unlink()
    return len(found)
