"""Press the probe on the slab: linear elasticity, frictionless contact that must stay closed."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from fem import mesh, surface
from fem.model import Inclusion, NotModelled, Probe, Slab, check
from fem.solver import one_thread
from fem.system import Solution, Unit, solve

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]

_memory: dict[tuple[object, ...], Solution] = {}  # the last solution: further press levels only scale it
_TOO_UNEVEN = (
    "press: received moduli or lengths so far apart that the equations cannot be solved; "
    "not modelled: allowed are moduli and lengths closer to each other"
)


@dataclass(frozen=True)
class Press:
    """What a press does; names ending in `_0` are the same press without the inclusion, on the same mesh.

    Attributes
    ----------
    surface
        The whole contact surface: undeformed points (n, 3) mm, quads on all Q2 nodes, and of each point
        `displacement` (n, 3) mm of the probe, in its frame, +z into the specimen, so that pushed in is
        negative; `pressure` (n,) kPa, compression positive (see `fem.surface.pressure`); `displacement_0`,
        `pressure_0`; and the lumped `area` (n,) mm²: `pressure * area` sums to the force.
    cut
        The plane y = 0 of probe and slab: `displacement`, `displacement_0` (n, 3) mm, in the probe's frame,
        so that the chest wall moves by -indentation; cells' `material`: 0 tissue, 1 inclusion, 2, 3, ...
        layers from the contact side.
    indentation_mm, indentation_0_mm
        Travel of the glass against the chest wall; they differ when pressed by force.
    force_N, force_0_N, chest_force_N
        Force on the contact surface, the same without inclusion, and the chest wall's reaction; compression
        positive.
    min_pressure_kPa
        The smallest contact pressure of the two states; always positive, or the press would have been
        refused.
    dof, seconds
        Unknowns and time taken.
    path
        How contact was treated: "tied".
    """

    surface: pv.PolyData
    cut: pv.PolyData
    indentation_mm: float
    indentation_0_mm: float
    force_N: float
    force_0_N: float
    chest_force_N: float
    min_pressure_kPa: float
    dof: int
    seconds: float
    path: str = "tied"


def press(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    indentation: float | None = None,
    *,
    force: float | None = None,
    quality: str = "standard",
    progress: Progress | None = None,
) -> Press:
    """Press the probe straight down on the slab, above the inclusion.

    Parameters
    ----------
    inclusion
        None for plain tissue.
    indentation
        Travel of the glass towards the chest wall, mm; give this or `force`.
    force
        Force between probe and slab, N; the state without inclusion then has the same force.
    quality
        "preview", "standard" or "reference".
    progress
        Called as progress(stage, fraction done).

    Raises
    ------
    ValueError
        On impossible input, in one line.
    NotModelled
        On possible input that is not modelled: off-centre inclusion, overhanging probe, contact that opens.

    Example
    -------
    >>> layers = (Layer(2, 27), Layer(3, 61), Layer(5, 156))
    >>> press(Probe(25, layers), Slab(30, 60, 5), Inclusion(10, 5, 100), 2.0).force_N  # doctest: +SKIP
    """
    start = time.perf_counter()
    if (indentation is None) == (force is None):
        raise ValueError(
            f"indentation, force: received {indentation} and {force}; allowed exactly one of the two"
        )
    name, amount = ("indentation", indentation) if force is None else ("force", force)
    assert amount is not None
    if not (np.isfinite(amount) and amount > 0):
        raise ValueError(f"{name}: received {amount}; allowed are positive finite numbers")
    if quality not in mesh.QUALITIES:
        raise ValueError(f"quality: received {quality!r}; allowed {', '.join(mesh.QUALITIES)}")
    check(probe, slab, inclusion)
    res = mesh.QUALITIES[quality]
    if probe.width_mm == slab.width_mm:
        res = replace(res, side=0)

    key = (probe, slab, inclusion, quality)
    if key not in _memory:
        try:
            with one_thread():
                found = solve(probe, slab, inclusion, res, progress or (lambda stage, fraction: None))
        except np.linalg.LinAlgError:
            raise NotModelled(_TOO_UNEVEN) from None
        _memory.clear()
        _memory[key] = found
    solution = _memory[key]

    units = solution.with_inclusion, solution.without
    if force is None:
        scales = amount, amount
    else:
        scales = (1e3 * amount / _force(units[0]), 1e3 * amount / _force(units[1]))
    with one_thread():
        contact, lowest = _contact(solution, scales, res.edge)
    sys = solution.system
    faces, elements = surface.cut_faces(mesh.slab_topology(res))
    probe_faces, probe_elements = surface.cut_faces(mesh.probe_topology(res, len(probe.layers)))
    cut = surface.cut_plane(
        solution.place,
        np.vstack([faces, probe_faces + sys.slab_nodes]),
        sys.material[np.concatenate([elements, probe_elements + sys.slab_elements])],
        {
            n: s * u.displacement
            for n, s, u in zip(("displacement", "displacement_0"), scales, units, strict=True)
        },
    )
    return Press(
        contact,
        cut,
        indentation_mm=scales[0],
        indentation_0_mm=scales[1],
        force_N=1e-3 * scales[0] * _force(units[0]),
        force_0_N=1e-3 * scales[1] * _force(units[1]),
        chest_force_N=4e-3 * scales[0] * units[0].chest,
        min_pressure_kPa=lowest,
        dof=sys.tree.size,
        seconds=time.perf_counter() - start,
    )


def _force(unit: Unit) -> float:
    """Force on the whole contact surface, mN per mm of indentation."""
    return 4 * float(unit.reaction.sum())


def _contact(solution: Solution, scales: tuple[float, float], edge: int) -> tuple[pv.PolyData, float]:
    """The contact surface with its fields, and the smallest pressure on it, kPa."""
    sys = solution.system
    x, y = solution.place[sys.tip[:, 0], 0], solution.place[sys.tip[0], 1]
    contact = surface.contact_surface(surface.mirror_line(x), surface.mirror_line(y))
    lowest = np.inf
    for suffix, scale, unit in zip(
        ("", "_0"), scales, (solution.with_inclusion, solution.without), strict=True
    ):
        moved = scale * unit.displacement[sys.tip]
        pressure = surface.pressure(scale * unit.reaction, x, y, edge)
        if not np.isfinite(pressure).all():
            raise NotModelled(_TOO_UNEVEN)
        if pressure.min() <= 0:
            i, j = np.unravel_index(int(pressure.argmin()), pressure.shape)
            raise NotModelled(
                f"press: received a contact that opens, {pressure.min():.3g} kPa "
                f"at ({x[i]:.2f}, {y[j]:.2f}) mm; not modelled yet: allowed is contact that stays closed"
            )
        lowest = min(lowest, float(pressure.min()))
        signs = ((-1, 1), (1, -1), (1, 1))
        whole = [surface.mirror_grid(moved[..., a], *signs[a]) for a in range(3)]
        contact.point_data["displacement" + suffix] = np.stack(whole, axis=-1).reshape(-1, 3)
        contact.point_data["pressure" + suffix] = surface.mirror_grid(pressure).ravel()
    return contact, lowest
