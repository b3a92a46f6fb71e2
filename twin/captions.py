"""What is said in words of an inclusion and of a press, on the sheet and in the terminal alike."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_CONTACT = {
    "tied": "closed contact",
    "sliding": "closed, sliding contact",
    "unilateral": "contact open in places",
    "multipoles": "a sphere's multipoles in plain tissue",
}


def inclusion_in_words(inclusion: Any) -> str:
    """Return size, depth and modulus of an inclusion: ``10 mm wide, 5 mm deep (to its top), 100 kPa``."""
    width = f"{inclusion.size:g} mm wide"
    if any(part != 1 for part in inclusion.stretch):
        width = " × ".join(f"{inclusion.size * part:g}" for part in inclusion.stretch) + " mm (x, y, z)"
    return f"{width}, {inclusion.depth:g} mm deep (to its top), {inclusion.modulus:g} kPa"


_STRAIN = {"finite": "finite strain", "linear": "linear"}


def mechanics_in_words(fem: Mapping[str, Any]) -> str:
    """Return how a press was computed from ``mechanics`` and ``path`` of its frame."""
    if fem["mechanics"] == "emulator":
        return f"emulator ({_STRAIN.get(fem['emulated'], fem['emulated'])})"
    return f"{_STRAIN.get(fem['mechanics'], fem['mechanics'])}, {_CONTACT.get(fem['path'], fem['path'])}"


def percent_in_words(percent: float | None, of: str = "") -> str:
    """Return an error, ``1.5 % of its maximum``, or that nobody knows it."""
    return "not known" if percent is None else f"{percent:.2g} %{of}"


def error_in_words(fem: Mapping[str, Any]) -> str:
    """Return what ``error_percent`` of a frame is: of the mesh, of an emulator, or of multipoles."""
    if fem["mechanics"] == "emulator":
        return "held-out error (95 %), tared"
    return (
        "last multipoles, tared surface" if fem["path"] == "multipoles" else "error estimate, tared surface"
    )
