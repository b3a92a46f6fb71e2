"""Learned once, used by everyone: the emulators of contact fields and the traced light that ship, and where
others are looked for.

`assets/emulators/tsis.npz` is the emulator of the design `tsis`, `tsis.light.npz` its traced light, each as
`twin emulate` wrote it.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

FOLDER = Path("emulators")
"""Folder where a design's own emulator is looked for: `tsis.npz` for the design `tsis`."""

_LIGHT = ".light.npz"


def shipped() -> list[str]:
    """Return the names of the designs whose emulator and traced light come with the package."""
    return sorted(entry.name.removesuffix(_LIGHT) for entry in _assets().iterdir() if _LIGHT in entry.name)


def emulator_file(name_or_file: str | Path, folder: Path = Path()) -> Path:
    """Return the file of an emulator: of a shipped one by its name, which wins over a file called so, else in
    the folder."""
    return _found(name_or_file, folder, ".npz")


def light_file(name_or_file: str | Path, folder: Path = Path()) -> Path:
    """Return the file of traced light, in the same way."""
    return _found(name_or_file, folder, _LIGHT)


def usual_emulator(design: str) -> Path:
    """Return the emulator of a design of this name if none is given: in `FOLDER`, else the shipped one."""
    own = FOLDER / f"{design}.npz"
    return emulator_file(design) if design in shipped() and not own.exists() else own


def _found(name_or_file: str | Path, folder: Path, ending: str) -> Path:
    name = str(name_or_file)
    return _assets() / (name + ending) if name in shipped() else folder / name_or_file


def _assets() -> Path:
    return Path(str(files("assets"))) / "emulators"
