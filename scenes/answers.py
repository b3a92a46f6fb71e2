"""What small changes of the contact do to light that meets it on a walk.

Import only after a variant is set (`scenes.backend.use`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from .arrays import floats, tensor
from .bsdf import Table

Array = NDArray[np.float64]

_LEAST = 1e-6  # of a share of light that is divided by


@dataclass(frozen=True)
class Answers:
    """Changes of the transmittance T of the contact, on the device; make it with `of`.

    A walk (`trace`) makes no choice at the contact: all its light goes on, with weight 1 - T. So what it
    leaves has for derivative the same, weighted with the walk's score, the derivative of the logarithm of its
    throughput (Glynn 1990; [glynn1990]). Chances at polished faces and of Russian roulette do not change, and
    nor do the ways.
    """

    slopes: mi.Texture2f
    tables: tuple[mi.Float | None, ...]
    width_mm: float

    @staticmethod
    def of(width_mm: float, slopes: Array, tables: Sequence[Array | None]) -> Answers:
        """From the derivatives of the contact fraction to q parameters, (q, m, m) on cells [iy, ix] of the
        guide's face, and those of the table of T, (n_fraction, n_cos) each, or None."""
        maps = np.ascontiguousarray(np.moveaxis(slopes, 0, -1), dtype=np.float32)
        texture = mi.Texture2f(tensor(maps), wrap_mode=dr.WrapMode.Clamp)
        flat = (None if one is None else floats(one) for one in tables)
        return Answers(texture, tuple(flat), width_mm)

    def mirrored(
        self, table: Table, p: mi.Point3f, fraction: mi.Float, cosine: mi.Float, active: mi.Bool
    ) -> list[mi.Float]:
        """Scores, to each parameter, of light that the contact mirrors."""
        through, changes = self._changes(table, p, fraction, cosine, active)
        relative = -dr.rcp(dr.maximum(1.0 - through, _LEAST))
        return [dr.select(active, relative * change, 0.0) for change in changes]

    def passed(
        self, table: Table, p: mi.Point3f, fraction: mi.Float, cosine: mi.Float, active: mi.Bool
    ) -> list[mi.Float]:
        """Scores, to each parameter, of light that passes the contact."""
        through, changes = self._changes(table, p, fraction, cosine, active)
        relative = dr.rcp(dr.maximum(through, _LEAST))
        return [dr.select(active, relative * change, 0.0) for change in changes]

    def _changes(
        self, table: Table, p: mi.Point3f, fraction: mi.Float, cosine: mi.Float, active: mi.Bool
    ) -> tuple[mi.Float, list[mi.Float]]:
        """T, and its derivatives."""
        through, steep = table.steep(fraction, cosine, active)
        place = mi.Point2f(p.x / self.width_mm + 0.5, p.y / self.width_mm + 0.5)
        found = [steep * slope for slope in self.slopes.eval(place, active)]
        for k, values in enumerate(self.tables):
            if values is not None:
                found[k] = found[k] + table.look_up(values, fraction, cosine, active)
        return through, found
