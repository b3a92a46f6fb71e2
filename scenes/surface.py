"""The deformed contact surface as light needs it: a fine, regular triangle mesh with pressure."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pyvista as pv
import trimesh
from numpy.typing import NDArray
from scipy.interpolate import CloughTocher2DInterpolator, make_interp_spline
from scipy.ndimage import map_coordinates

# It does without what fails, an interruption too (heard again: `twin.interrupt`), and would log a traceback.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

Array = NDArray[np.float64]

NODES = 193  # per side: 0.13 mm on a 25 mm guide, four pixels of the paper's camera
_LIP_MM = 2e-3  # the mesh pierces the flat side walls by this much, so that no light slips between them


@dataclass(frozen=True)
class OpticalSurface:
    """Contact surface on a regular grid of undeformed points.

    Attributes
    ----------
    nodes_mm : (n,)
        Undeformed coordinate of the grid lines along x and y, from edge to edge of the guide, mm.
    displacement_mm : (n, n, 3)
        Displacement at [iy, ix], mm, +z into the specimen, glass at rest.
    pressure_kPa : (n, n)
        Contact pressure at [iy, ix], kPa.
    rest_mm : (n, n)
        Height z of the undeformed surface at [iy, ix], mm: 0 if it is flat.
    """

    nodes_mm: Array
    displacement_mm: Array
    pressure_kPa: Array
    rest_mm: Array


def resample(
    surface: pv.PolyData, width_mm: float, *, suffix: str = "", nodes: int = NODES
) -> OpticalSurface:
    """Interpolate the finite elements' surface onto the optical grid, C1-smooth, so normals are continuous.

    What the pressure rises by at the guide's edge, where it is singular, falls off within one node, so that
    it neither rings farther in nor changes the force.

    Parameters
    ----------
    surface
        Points (n, 3) mm undeformed, covering the guide's face; point arrays `displacement` (n, 3) mm and
        `pressure` (n,) kPa.
    width_mm
        Side of the guide's face, mm.
    suffix
        Appended to both array names: "_0" selects the press without inclusion.

    Raises
    ------
    ValueError
        The surface lacks an array or does not reach the guide's edges.
    """
    for name in (f"displacement{suffix}", f"pressure{suffix}"):
        if name not in surface.point_data:
            raise ValueError(
                f"surface: received point arrays {sorted(surface.point_data)}; allowed: one named '{name}'"
            )
    half = width_mm / 2
    points = np.asarray(surface.points, dtype=np.float64)[:, :2]
    reach = np.abs(points).max(axis=0)
    if np.any(np.abs(reach - half) > 1e-6 * width_mm):
        raise ValueError(
            f"surface: received points up to {reach.tolist()} mm from the middle; allowed {half} mm in x, y"
        )

    line = np.linspace(-half, half, nodes)
    names = (f"displacement{suffix}", f"pressure{suffix}")
    fields = np.column_stack([*(surface.point_data[name] for name in names), surface.points[:, 2]])
    values = _interpolate(points, fields, line)
    return OpticalSurface(line, values[..., :3], values[..., 3], values[..., 4])


def _interpolate(points: Array, fields: Array, line: Array) -> Array:
    """Fields (n, k) of points (n, 2) on the grid of `line` (m,), (m, m, k); splines if points are a grid. The
    fourth is the pressure."""
    columns, column = np.unique(np.round(points[:, 0], 9), return_inverse=True)
    rows, row = np.unique(np.round(points[:, 1], 9), return_inverse=True)
    if columns.size * rows.size == len(points) and min(columns.size, rows.size) > 3:
        grid = np.empty((rows.size, columns.size, fields.shape[1]))
        grid[row, column] = fields
        found = []
        for k in range(fields.shape[1]):
            down, across = (_weights(nodes, line, edge=k == 3) for nodes in (rows, columns))
            found.append(down @ grid[..., k] @ across.T)
        return np.stack(found, axis=-1)
    x, y = np.meshgrid(line, line)
    # the hull is closed: pull the outermost samples inside by rounding's width, else they would be NaN
    return np.asarray(CloughTocher2DInterpolator(points, fields)(x * (1 - 1e-9), y * (1 - 1e-9)))


def _weights(nodes: Array, line: Array, *, edge: bool) -> Array:
    """Weights (m, n) of the values at nodes (n,) at places `line` (m,): a cubic spline through them.

    With `edge` it goes through what the three next nodes foretell of the outermost two, each in a parabola.
    The excess of those falls off as (1 - t)² within one interval: with the integral that Simpson's rule, by
    which edge pressures carry their loads, gives them.
    """
    spline = np.asarray(make_interp_spline(nodes, np.eye(nodes.size), k=3)(line))
    if not edge:
        return spline
    found = spline.copy()
    for inward in (np.arange(4), nodes.size - 1 - np.arange(4)):
        place, known = nodes[inward[0]], inward[1:]
        excess = np.zeros(nodes.size)
        excess[inward[0]] = 1.0
        for one in known:
            others = nodes[known[known != one]]
            excess[one] = -np.prod((place - others) / (nodes[one] - others))
        away = np.minimum(np.abs((line - place) / (nodes[known[0]] - place)), 1.0)
        found += np.outer((1.0 - away) ** 2 - spline[:, inward[0]], excess)
    return found


def flat(width_mm: float, pressure_kPa: float, *, nodes: int = NODES) -> OpticalSurface:
    """An undeformed surface under uniform pressure."""
    line = np.linspace(-width_mm / 2, width_mm / 2, nodes)
    still = np.zeros((nodes, nodes, 3))
    return OpticalSurface(line, still, np.full((nodes, nodes), float(pressure_kPa)), still[..., 2])


def triangulate(surface: OpticalSurface) -> trimesh.Trimesh:
    """Deformed triangles, (n + 2)² vertices in row-major [iy, ix] order, normals towards the guide.

    The scene's side walls are flat, so what bulges beyond them (0.3 mm) is cut off: the mesh ends where the
    surface passes the wall, whichever nodes that lies between. An outermost ring closes the gap where the
    surface recedes.
    """
    lines = surface.nodes_mm
    x, y = np.meshgrid(lines, lines)
    position = np.stack([x, y, surface.rest_mm], axis=-1) + surface.displacement_mm
    normals = _normals(position)
    position[..., 2], *parts = _within_walls(surface, [position[..., 2], *np.moveaxis(normals, -1, 0)])
    normals = np.stack(parts, axis=-1)
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    position = np.pad(position, ((1, 1), (1, 1), (0, 0)), mode="edge")
    # rising, so that no triangle degenerates: 0.1 µm is the least at which single precision still tells
    # where in a triangle a point lies
    rank = np.arange(lines.size + 2)[::-1]
    limit = lines[-1] + _LIP_MM * (1.0 - np.minimum(rank, 19) / 20)
    for axis, shape in enumerate(((1, -1), (-1, 1))):
        outward = limit.reshape(shape)
        inward = -np.flip(outward)
        position[..., axis] = np.clip(position[..., axis], inward, outward)
        edge = np.moveaxis(position[..., axis], 1 - axis, 0)
        edge[0], edge[-1] = -limit[-1], limit[-1]
    ring = np.pad(normals, ((1, 1), (1, 1), (0, 0)), mode="edge").reshape(-1, 3)
    return trimesh.Trimesh(
        position.reshape(-1, 3), _faces(lines.size + 2), vertex_normals=ring, process=False
    )


def _within_walls(surface: OpticalSurface, fields: Sequence[Array]) -> list[Array]:
    """Fields (n, n) at the grid's points, but where these bulge beyond the walls at those of the surface that
    lie in the wall there."""
    lines, found = surface.nodes_mm, [np.array(values) for values in fields]
    place = np.stack(np.meshgrid(lines, lines), axis=-1) + surface.displacement_mm[..., :2]
    inside = np.clip(place, lines[0], lines[-1])
    beyond = (inside != place).any(axis=-1)
    if beyond.any():
        told = _look_up(lines, np.stack(found), _undeformed(surface, inside[beyond]))
        for values, new in zip(found, told, strict=True):
            values[beyond] = new
    return found


def _normals(position: Array) -> Array:
    """Unit normals (n, n, 3), towards the guide, of a grid of points (n, n, 3)."""
    along_y, along_x = np.gradient(position, axis=(0, 1), edge_order=2)
    normals = np.cross(along_y, along_x)
    return np.asarray(normals / np.linalg.norm(normals, axis=-1, keepdims=True))


def with_skirt(surface: OpticalSurface, values: Array) -> Array:
    """Values (n, n) at the grid's points as those of the vertices of `triangulate`, in their order."""
    return np.asarray(np.pad(_within_walls(surface, [values])[0], 1, mode="edge").ravel())


def _faces(n: int) -> NDArray[np.int64]:
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    lower = np.column_stack([corner, corner + n, corner + 1])
    upper = np.column_stack([corner + 1, corner + n, corner + n + 1])
    return np.concatenate([lower, upper])


def at(
    surface: OpticalSurface, position_mm: NDArray[np.float32]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pressure, kPa, and displacement along z, mm, at deformed positions (..., 2) mm; shape (...).

    Positions are many and shifts smooth: where points come from is found on the grid, and looked up.
    """
    line = surface.nodes_mm
    x, y = np.meshgrid(line, line)
    grid = np.stack([x, y], axis=-1)
    shift = grid - _undeformed(surface, grid)
    target = np.asarray(position_mm, dtype=np.float64)
    undeformed = target - _look_up(line, np.moveaxis(shift, -1, 0), target, -1)
    fields = np.stack([surface.pressure_kPa, surface.displacement_mm[..., 2]])
    pressure, displacement_z = _look_up(line, fields, undeformed)
    return pressure.astype(np.float32), displacement_z.astype(np.float32)


def heights(surface: OpticalSurface, line_mm: Array) -> Array:
    """Height z, mm, of the deformed surface at [iy, ix] of the grid of deformed coordinates `line_mm`
    (m,)."""
    x, y = np.meshgrid(line_mm, line_mm)
    fields = (surface.rest_mm + surface.displacement_mm[..., 2])[None]
    undeformed = _undeformed(surface, np.stack([x, y], axis=-1))
    return np.asarray(_look_up(surface.nodes_mm, fields, undeformed)[0])


def _undeformed(surface: OpticalSurface, target: Array) -> Array:
    """Undeformed points (..., 2) of deformed positions (..., 2) mm, by fixed-point iteration, which contracts
    by the strain (a few per cent)."""
    across = np.moveaxis(surface.displacement_mm[..., :2], -1, 0)
    undeformed = target
    for _ in range(4):
        undeformed = target - _look_up(surface.nodes_mm, across, undeformed, -1)
    return undeformed


def _look_up(line: Array, fields: Array, points: Array, axis: int = 0) -> Array:
    """Fields (k, n, n) on the grid of `line` (n,), bilinear, at points (..., 2); k along `axis`."""
    index = np.moveaxis((points[..., ::-1] - line[0]) / (line[1] - line[0]), -1, 0)
    return np.stack([map_coordinates(values, index, order=1, mode="nearest") for values in fields], axis=axis)
