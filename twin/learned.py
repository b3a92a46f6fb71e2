"""Learned once, used by everyone: the emulators of contact fields, the traced light and the trained models
that ship, and where others are looked for.

`assets/emulators/tsis.npz` is the emulator of the design `tsis`, `tsis.light.npz` its traced light, each as
`twin emulate` wrote it; `assets/models/tsis.safetensors` and `.json` are an estimator, as
`twin calibrate --lean` wrote it.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

FOLDER = Path("emulators")
"""Folder where a design's own emulator is looked for: `tsis.npz` for the design `tsis`."""

_LIGHT = ".light.npz"
_MODEL = ".safetensors"


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


def models() -> list[str]:
    """Return the names of the models that come with the package."""
    return sorted(place.name.removesuffix(_MODEL) for place in _assets("models").glob(f"*{_MODEL}"))


def model_file(name_or_file: str | Path) -> Path:
    """Return the file of a trained model, its ending left out or not: one that is there, else a shipped one
    of this name."""
    name = str(name_or_file).removesuffix(_MODEL)
    place = Path(name + _MODEL)
    shipped_one = not place.exists() and str(name_or_file) in models()
    return _assets("models") / (name + _MODEL) if shipped_one else place


def usual_emulator(design: str) -> Path:
    """Return the emulator of a design of this name if none is given: in `FOLDER`, else the shipped one."""
    own = FOLDER / f"{design}.npz"
    return emulator_file(design) if design in shipped() and not own.exists() else own


def _found(name_or_file: str | Path, folder: Path, ending: str) -> Path:
    name = str(name_or_file)
    return _assets() / (name + ending) if name in shipped() else folder / name_or_file


def _assets(folder: str = "emulators") -> Path:
    return Path(str(files("assets"))) / folder
