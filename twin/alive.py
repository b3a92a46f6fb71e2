"""Who works: locks on files, which the system takes back however their process ends."""

from __future__ import annotations

import fcntl
import os
import socket
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def alive(folder: Path) -> Iterator[str]:
    """Hold a lock in a folder that says that this process works; yields its name."""
    name = f"{socket.gethostname()}-{os.getpid()}-{uuid.uuid4().hex[:6]}"
    file = folder / f"{name}.lock"
    with locked(file):
        yield name
    # the file stays: without it a trial of this worker could not be told from one of another machine


@contextmanager
def locked(file: Path, wait: bool = True) -> Iterator[bool]:
    """Hold a file's lock; yields whether it is held, which without waiting it may not be."""
    file.parent.mkdir(parents=True, exist_ok=True)
    handle = os.open(file, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (0 if wait else fcntl.LOCK_NB))
        except BlockingIOError:
            yield False
            return
        yield True
    finally:
        os.close(handle)
