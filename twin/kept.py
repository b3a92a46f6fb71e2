"""What layouts share is computed once: results by a key of all that decides them, in memory and on disk."""

from __future__ import annotations

import hashlib
import os
import uuid
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

MEMORY_BYTES = 300_000_000
DISK_BYTES = 4_000_000_000


@dataclass
class Kept:
    """A store of arrays; ``folder`` keeps them for other processes too, None keeps them in memory alone."""

    folder: Path | None = None
    _held: OrderedDict[str, Arrays] = field(default_factory=OrderedDict)
    _bytes: int = 0

    def get(self, parts: Any, make: Callable[[], Arrays]) -> Arrays:
        """Return the arrays of a key, made if they are not there. The key is the text of `parts`."""
        key = hashlib.sha256(repr(parts).encode()).hexdigest()[:32]
        if key in self._held:
            self._held.move_to_end(key)
            return self._held[key]
        found = self._read(key)
        if found is None:
            found = make()
            self._write(key, found)
        self._hold(key, found)
        return found

    def _hold(self, key: str, arrays: Arrays) -> None:
        self._held[key] = arrays
        self._bytes += _size(arrays)
        while self._bytes > MEMORY_BYTES and len(self._held) > 1:
            self._bytes -= _size(self._held.popitem(last=False)[1])

    def _read(self, key: str) -> Arrays | None:
        if self.folder is None:
            return None
        try:
            with np.load(self.folder / f"{key}.npz", allow_pickle=False) as data:
                return {name: data[name] for name in data.files}
        except (OSError, ValueError, BadZipFile, EOFError):
            return None

    def _write(self, key: str, arrays: Arrays) -> None:
        if self.folder is None:
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        if sum(file.stat().st_size for file in self.folder.glob("*.npz")) > DISK_BYTES:
            return
        part = self.folder / f"{key}.{uuid.uuid4().hex[:8]}.part"
        with part.open("wb") as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
        os.replace(part, self.folder / f"{key}.npz")


def _size(arrays: Arrays) -> int:
    return sum(array.nbytes for array in arrays.values())
