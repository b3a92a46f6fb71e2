"""Contact mechanics of probe and tissue: nearly incompressible solids at finite or small strain, in contact.

The nouns load at once; what computes is imported with its first use, so that reading a design stays fast.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from fem.model import Inclusion, Layer, NotConverged, NotModelled, Pose, Probe, Slab
from fem.scalars import scalars

if TYPE_CHECKING:
    from fem.background import on_background
    from fem.ccx import deck
    from fem.emulating import build_emulator
    from fem.emulator import Emulated, Emulator
    from fem.emulator_file import load_emulator, save_emulator
    from fem.plane import Press2D, press_2d
    from fem.plane_scalars import scalars_2d
    from fem.pressing import Press, press, press_moduli
    from fem.spheres import Multipoles, multipoles
    from fem.volume import save_volume, volume_grid

__all__ = [
    "Emulated",
    "Emulator",
    "Inclusion",
    "Layer",
    "Multipoles",
    "NotConverged",
    "NotModelled",
    "Pose",
    "Press",
    "Press2D",
    "Probe",
    "Slab",
    "build_emulator",
    "deck",
    "load_emulator",
    "multipoles",
    "on_background",
    "press",
    "press_2d",
    "press_moduli",
    "save_emulator",
    "save_volume",
    "scalars",
    "scalars_2d",
    "volume_grid",
]

_LATER = {
    "Emulated": "emulator",
    "Emulator": "emulator",
    "Press": "pressing",
    "deck": "ccx",
    "on_background": "background",
    "build_emulator": "emulating",
    "load_emulator": "emulator_file",
    "Multipoles": "spheres",
    "multipoles": "spheres",
    "press": "pressing",
    "press_moduli": "pressing",
    "Press2D": "plane",
    "press_2d": "plane",
    "scalars_2d": "plane_scalars",
    "save_emulator": "emulator_file",
    "save_volume": "volume",
    "volume_grid": "volume",
}


def __getattr__(name: str) -> Any:
    if name in _LATER:
        return getattr(import_module(f"fem.{_LATER[name]}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
