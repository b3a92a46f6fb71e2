"""What is said in words of an inclusion and of a press, on the sheet and in the terminal alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_CONTACT = {
    "tied": "closed contact",
    "sliding": "closed, sliding contact",
    "unilateral": "contact open in places",
}


def inclusion_in_words(inclusion: Any) -> str:
    """Return size, depth and modulus of an inclusion: ``10 mm wide, 5 mm deep (to its top), 100 kPa``."""
    width = f"{inclusion.size:g} mm wide"
    if any(part != 1 for part in inclusion.stretch):
        width = " × ".join(f"{inclusion.size * part:g}" for part in inclusion.stretch) + " mm (x, y, z)"
    return f"{width}, {inclusion.depth:g} mm deep (to its top), {inclusion.modulus:g} kPa"


def mechanics_in_words(fem: Mapping[str, Any]) -> str:
    """Return how a press was computed from ``mechanics`` and ``path`` of its frame."""
    strain = {"finite": "finite strain", "linear": "linear"}.get(fem["mechanics"], fem["mechanics"])
    return f"{strain}, {_CONTACT.get(fem['path'], fem['path'])}"
