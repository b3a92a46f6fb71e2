"""Luminaire files of the Illuminating Engineering Society: intensity over direction (ANSI/IES LM-63-19).

Of photometry type C, what LEDs are measured in: vertical angles from the axis, horizontal ones about it. Only
the shape is used; the flux is the design's. Tilted lamps, and types A and B, are refused, as is a lamp that
sends light behind itself, where a disc has none. Files are read whole and strictly: nothing is guessed.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

MAX_BYTES = 1_000_000
_MAX_ANGLES = 1000
_BEHIND = 0.01  # share of the flux behind the lamp that is put down to stray light and left out


class IesError(ValueError):
    """A file that holds no lamp that can be used; the message is what would do, in one line."""


@dataclass(frozen=True, eq=False)
class Lamp:
    """Intensity of a lamp, any unit, on a grid of directions.

    Attributes
    ----------
    vertical_deg : (n,)
        Angles from the axis, rising from 0 to 90 at most, where the last may be less: 0 beyond.
    horizontal_deg : (m,)
        Angles about the axis, rising from 0 to 360, the last the same direction as the first; [0] for a lamp
        that is the same all round.
    intensity : (m, n)
    """

    vertical_deg: Array
    horizontal_deg: Array
    intensity: Array

    def at(self, vertical_deg: Array, horizontal_deg: Array) -> Array:
        """Intensity between the grid's directions, linear in both angles, 0 beyond the last vertical one."""
        across = np.stack(
            [np.interp(vertical_deg, self.vertical_deg, row, right=0.0) for row in self.intensity]
        )
        if len(across) == 1:
            return np.asarray(across[0])
        turn = np.mod(horizontal_deg, 360.0)
        low = np.clip(np.searchsorted(self.horizontal_deg, turn, side="right") - 1, 0, len(across) - 2)
        share = (turn - self.horizontal_deg[low]) / (self.horizontal_deg[low + 1] - self.horizontal_deg[low])
        where = np.arange(across.shape[1])
        return np.asarray((1.0 - share) * across[low, where] + share * across[low + 1, where])


def beside(design: dict[str, Any], folder: Path) -> dict[str, Any]:
    """Return the nested tables of a design, with its LEDs' files as paths from the folder that it lies in."""
    leds = design.get("leds")
    for led in leds if isinstance(leds, list) else []:
        if isinstance(led, dict) and isinstance(led.get("ies"), str) and led["ies"]:
            led["ies"] = str(folder / led["ies"])
    return design


def read(path: str) -> Lamp:
    """Return the lamp of a file; raises `IesError`."""
    place = Path(path)
    try:
        if not place.is_file():
            raise IesError("an IES file that is there")
        state = place.stat()
    except (OSError, ValueError):
        raise IesError("an IES file that is there") from None
    if state.st_size > MAX_BYTES:
        raise IesError(f"an IES file of at most {MAX_BYTES:,} bytes (this one has {state.st_size:,})")
    return _read(str(place), state.st_mtime_ns, state.st_size)


def digest(path: str) -> str:
    """Hash of a luminaire file, as hex: what it says, wherever it lies."""
    return hashlib.sha256(Path(path).read_bytes()).hexdigest()


@lru_cache(maxsize=32)
def _read(path: str, changed_ns: int, size: int) -> Lamp:
    try:
        with open(path, "rb") as file:
            return parse(file.read(MAX_BYTES))
    except OSError as error:
        raise IesError(f"an IES file that can be read ({error.strerror})") from None


def parse(data: bytes) -> Lamp:
    """Return the lamp that a file's bytes describe; raises `IesError`."""
    lines = data.decode("latin-1").splitlines()
    tilt = next(
        (number for number, line in enumerate(lines) if line.strip().upper().startswith("TILT=")), None
    )
    if tilt is None:
        raise IesError("an IES LM-63 file, which has a line TILT=NONE")
    if lines[tilt].strip().upper() != "TILT=NONE":
        raise IesError("an IES file with TILT=NONE")
    numbers = _numbers(lines[tilt + 1 :])

    def take(count: int) -> Array:
        found = np.array(list(islice(numbers, count)))
        if found.size != count:
            raise IesError("an IES file that is not cut short")
        return found

    # lamps, lumens per lamp, multiplier, counts of angles, type, units, width, length, height, then ballast,
    # a number for future use, and watts
    head = take(13)
    count_v, count_h = (_whole(head[i], name) for i, name in ((3, "vertical"), (4, "horizontal")))
    if head[5] != 1:
        raise IesError(f"an IES file of photometry type C, 1 (this one is of {head[5]:g})")
    if not head[2] > 0:
        raise IesError(f"an IES file with a candela multiplier above 0 (this one has {head[2]:g})")
    vertical, horizontal = take(count_v), take(count_h)
    intensity = take(count_v * count_h).reshape(count_h, count_v)
    if next(numbers, None) is not None:
        raise IesError("an IES file that ends after its candelas")
    if intensity.min() < 0:
        raise IesError("an IES file without negative candelas")
    _check_angles(vertical, horizontal)
    return _front(vertical, *_all_round(horizontal, intensity))


def _numbers(lines: list[str]) -> Iterator[float]:
    """The numbers of a file, which spaces, commas and line ends may part."""
    for line in lines:
        for word in line.replace(",", " ").split():
            try:
                value = float(word)
            except ValueError:
                raise IesError(f"an IES file with numbers after TILT=NONE (not {word[:20]!r})") from None
            if not math.isfinite(value):
                raise IesError("an IES file with finite numbers")
            yield value


def _whole(value: float, name: str) -> int:
    if value != round(value) or not 1 <= value <= _MAX_ANGLES:
        raise IesError(f"an IES file with 1 to {_MAX_ANGLES} {name} angles (this one says {value:g})")
    return int(value)


def _check_angles(vertical: Array, horizontal: Array) -> None:
    rising = np.all(np.diff(vertical) > 0) and np.all(np.diff(horizontal) > 0)
    if not rising or vertical[0] != 0.0 or vertical[-1] > 180.0 or vertical.size < 2:
        raise IesError("an IES file whose angles rise, the vertical ones from 0 to at most 180 degrees")
    if horizontal[0] != 0.0 or horizontal[-1] not in (0.0, 90.0, 180.0, 360.0):
        raise IesError("an IES file whose horizontal angles run from 0 to 0, 90, 180 or 360 degrees")


def _all_round(horizontal: Array, intensity: Array) -> tuple[Array, Array]:
    """Unfold the lamp's symmetry: 0..90 is a quadrant, 0..180 a half, 0..360 all of it."""
    while horizontal[-1] in (90.0, 180.0):
        horizontal = np.concatenate([horizontal, 2.0 * horizontal[-1] - horizontal[-2::-1]])
        intensity = np.concatenate([intensity, intensity[-2::-1]])
    return horizontal, intensity


def _front(vertical: Array, horizontal: Array, intensity: Array) -> Lamp:
    """Leave out what is behind the lamp, and refuse one that is dark in front."""
    middle = np.radians(np.linspace(0.0, 180.0, 3601))
    mean = intensity[0] if len(intensity) == 1 else np.trapezoid(intensity, horizontal, axis=0) / 360.0
    flux = np.interp(np.degrees(middle), vertical, mean, right=0.0) * np.sin(middle)
    if not flux.sum() > 0:
        raise IesError("an IES file of a lamp that shines")
    behind = flux[middle > np.pi / 2].sum() / flux.sum()
    if behind > _BEHIND:
        raise IesError(f"a lamp with at most {_BEHIND:.0%} of its flux behind it (this one has {behind:.0%})")
    if vertical[-1] <= 90.0:
        return Lamp(vertical, horizontal, intensity)
    edge = np.array([[np.interp(90.0, vertical, row)] for row in intensity])
    kept = vertical < 90.0
    return Lamp(
        np.append(vertical[kept], 90.0), horizontal, np.concatenate([intensity[:, kept], edge], axis=1)
    )
