"""TSIS digital twin: from a press on tissue to the picture of an optical tactile sensor.

import twin

frame = twin.simulate(twin.load_design("tsis"), twin.Inclusion(size=10, depth=5, modulus=100))
frame.write("out")
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from fem import Inclusion
    from twin.complaint import DesignError
    from twin.corpus import Corpus
    from twin.design import Design, load_design
    from twin.frame import Frame
    from twin.simulation import simulate

__all__ = ["Corpus", "Design", "DesignError", "Frame", "Inclusion", "load_design", "simulate"]

# Loaded when first asked for, so that the program listens for Ctrl-C before anything slow begins.
_HOME = {
    "Corpus": "twin.corpus",
    "Design": "twin.design",
    "DesignError": "twin.complaint",
    "Frame": "twin.frame",
    "Inclusion": "fem",
    "load_design": "twin.design",
    "simulate": "twin.simulation",
}


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(_HOME[name]), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
