"""Where the nodes of a mesh lie on the contact surface, before the mesh is made."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from fem import mesh
from fem.mesh import Geometry
from fem.topology import Resolution

Floats = NDArray[np.float64]


def logical_lines(res: Resolution) -> Floats:
    """Logical coordinates of the nodes along x on the footprint, (n,)."""
    box = res.reach * np.arange(2 * res.arc + 1) / (2 * res.arc)
    half = np.concatenate([box, res.reach + np.arange(1, 2 * res.edge + 1) / 2])
    return np.concatenate([-half[:0:-1], half])


def lines(geometry: Geometry, res: Resolution) -> tuple[Floats, Floats]:
    """Real coordinates of a mesh's nodes on the footprint along x and y, mm, each (n,)."""
    return lines_of(geometry, [res])[0]


def lines_of(geometry: Geometry, meshes: Sequence[Resolution]) -> list[tuple[Floats, Floats]]:
    """`lines` of several meshes."""
    along_x, along_y = mesh.box_around(geometry).surface
    return [(_line(along_x, res), _line(along_y, res)) for res in meshes]


@lru_cache(maxsize=256)  # as `ground.cubic`: where slopes are found, most specimens' lines are the same
def _line(span: mesh.Span, res: Resolution) -> Floats:
    found = span.lines(logical_lines(res), res)
    found.flags.writeable = False
    return found
