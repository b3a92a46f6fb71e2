"""How far a press can be trusted: its discretisation error, estimated from a coarser mesh.

The tared displacement of the contact surface is found once more on the next coarser mesh, by linear
elasticity (whose discretisation error is nearly that of finite strain, at a fraction of the cost). Both
meshes have the same topology but for their resolution, so the difference measures the coarser one's error,
and a fixed share of it the finer one's (`SHARE`, measured; `tests/test_fem_trust.py`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fem.mesh import QUALITIES, Geometry
from fem.meshed import build
from fem.path import Path, path
from fem.topology import Resolution

Floats = NDArray[np.float64]

COARSER = {
    # fewer cells where preview's own errors are: along the inclusion, and to both sides of the probe's edge.
    # Thinner layers over deep inclusions would tell nothing of them: ten times the error.
    QUALITIES["preview"]: Resolution(
        arc=2, core=1, shell=3, above=2, below=1, edge=1, side=1, layer=1, backing=1
    ),
    QUALITIES["standard"]: QUALITIES["preview"],
    QUALITIES["reference"]: QUALITIES["standard"],
}
SHARE = 0.5
_SILENT = 1e-10  # mm / mm: a tared displacement that is rounding
_GRID = 61  # places along each axis at which the fields are compared


def on_coarser(geometries: Sequence[Geometry], res: Resolution) -> list[Floats | None]:
    """`tared` of geometries that differ in the inclusion's modulus only, on the mesh that is coarser than a
    quality's; None where there is nothing to tare.

    Before the quality's own mesh is made: beside its factor, memory is dear.
    """
    if geometries[0].inclusion is None:
        return [None] * len(geometries)
    model = build(geometries[0], COARSER[res], False)
    bare = path(geometries[0], model, False)
    return [tared(one, path(one, model, True, bare), bare) for one in geometries]


def discretisation_error(geometry: Geometry, coarse: Floats | None, full: Path, bare: Path) -> float:
    """Estimate the error of the tared displacement, in per cent of its maximum; 0 where there is no
    signal: without inclusion, or with one of the tissue's own moduli.

    Parameters
    ----------
    coarse
        One of `on_coarser`.
    full, bare
        Paths with and without inclusion on the mesh in question.
    """
    if coarse is None:
        return 0.0
    fine = tared(geometry, full, bare)
    largest = np.abs(fine).max()
    if largest < _SILENT:
        return 0.0
    return float(100 * SHARE * np.abs(fine - coarse).max() / largest)


def tared(geometry: Geometry, full: Path, bare: Path) -> Floats:
    """Tared displacement into the probe per mm of a linear tied press, on a regular grid (n, n), mm / mm."""
    rates = [p.rate() for p in (full, bare)]
    model = full.states[0].model
    nodes, half = model.nodes, geometry.probe.width_mm / 2
    field = -(rates[0] - rates[1])[nodes.tip][..., 2]
    at = model.place[nodes.tip]
    rows = []
    for lines, symmetric in (
        (at[:, 0, 0], model.layout.symmetric[0]),
        (at[0, :, 1], model.layout.symmetric[1]),
    ):
        places = np.abs(np.linspace(-half, half, _GRID)) if symmetric else np.linspace(-half, half, _GRID)
        rows.append(_interpolation(lines, places))
    return np.asarray(rows[0] @ field @ rows[1].T)


def _interpolation(lines: Floats, places: Floats) -> Floats:
    """Weights of the nodes of quadratic elements (n,) at places (m,); (m, n)."""
    first = 2 * np.clip(np.searchsorted(lines[2:-1:2], places), 0, (len(lines) - 3) // 2)
    t = (places - lines[first]) / (lines[first + 2] - lines[first])
    rows = np.zeros((len(places), len(lines)))
    at = np.arange(len(places))
    rows[at, first], rows[at, first + 1], rows[at, first + 2] = (
        (1 - t) * (1 - 2 * t),
        4 * t * (1 - t),
        t * (2 * t - 1),
    )
    return rows
