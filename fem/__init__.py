"""Contact mechanics of probe and tissue: linear elasticity, three-dimensional, nearly incompressible."""

from fem.model import Inclusion, Layer, NotModelled, Probe, Slab
from fem.press import Press, press
from fem.scalars import scalars

__all__ = ["Inclusion", "Layer", "NotModelled", "Press", "Probe", "Slab", "press", "scalars"]
