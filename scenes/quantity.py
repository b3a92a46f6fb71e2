"""What the parts of a sensor share: how values are checked, bounds of common quantities, what is refused."""

from __future__ import annotations

from typing import Annotated, NamedTuple

from pydantic import Field

from .skin import CONFIG, RefractiveIndex

__all__ = ["CONFIG", "Conflict", "Length", "RefractiveIndex", "Wavelength"]

# Bounds far outside of what such a sensor has, so that only slips (a unit, a power of ten) are refused.
Length = Annotated[float, Field(ge=0.05, le=500.0)]
Wavelength = Annotated[float, Field(ge=350.0, le=1100.0)]


class Conflict(NamedTuple):
    """A value that does not fit the others: dotted field, what it holds, what would be allowed."""

    field: str
    received: object
    allowed: str
