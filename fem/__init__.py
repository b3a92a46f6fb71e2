"""Contact mechanics of probe and tissue: linear elasticity, three-dimensional, nearly incompressible.

The nouns load at once; what computes is imported with the first `press`, so that reading a design stays fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from fem.model import Inclusion, Layer, NotModelled, Probe, Slab
from fem.scalars import scalars

if TYPE_CHECKING:
    from fem.pressing import Press, press

__all__ = ["Inclusion", "Layer", "NotModelled", "Press", "Probe", "Slab", "press", "scalars"]


def __getattr__(name: str) -> Any:
    if name in ("Press", "press"):
        from fem import pressing

        return getattr(pressing, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
