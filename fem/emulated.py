"""What stands in for a press: the answer of an emulator, or of multipoles."""

from __future__ import annotations

from dataclasses import dataclass

import pyvista as pv


@dataclass(frozen=True)
class Emulated:
    """Answer of an emulator; fields as those of `fem.Press`, which it can stand in for where no cut is drawn.

    Attributes
    ----------
    surface
        The contact surface with `displacement`, `pressure`, `area` and, without inclusion, `displacement_0`,
        `pressure_0`, `area_0`.
    error_percent
        95th percentile of what held-out solves of inclusions of this kind (`Errors.alike`: of 4 mm and more,
        or not; or nearest in size) were off by: largest error of the tared displacement off the probe's
        edge, in per cent of its maximum. None where too few were held out to tell.
    dof
        Unknowns of plain tissue, where spheres in it are multipoles (`fem.Multipoles`, whose answers these
        are, too).
    """

    surface: pv.PolyData
    indentation_mm: float
    indentation_0_mm: float
    force_N: float
    force_0_N: float
    min_pressure_kPa: float
    seconds: float
    mechanics: str
    error_percent: float | None
    path: str = "emulated"
    background: str = "shared"
    signal: str = "smooth"  # or "meshed"; as of `fem.Press`
    dof: int | None = None
