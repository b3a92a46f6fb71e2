"""Probe and slab as one meshed model, whose slab's mesh can follow the sliding."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from fem import elasticity, mesh
from fem.contact import Interface, Tie, recovery
from fem.mesh import Geometry
from fem.quadrature import Quadrature, join, quadrature
from fem.system import Nodes, System, nodes, system
from fem.topology import Layout, Resolution, materials

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@dataclass(frozen=True)
class Model:
    """Probe and slab in real coordinates, without the moduli of the slab's contents."""

    geometry: Geometry
    layout: Layout
    nodes: Nodes
    interface: Interface
    probe: Quadrature  # of the probe's elements, which stay as they are
    place: Floats  # undeformed nodes, (nodes, 3) mm
    shift: Floats  # of the slab's nodes under the probe's, within the slab's surface, (nx, ny, 2) mm
    normal: Floats  # direction of the press in the probe's frame, (3,)
    ball: NDArray[np.int64]  # elements of the inclusion
    finite: bool  # finite strain with sliding contact, or linear elasticity

    @cached_property
    def quad(self) -> Quadrature:
        """Of all elements. Made when asked for; an equilibrium lets go of it (`bare`)."""
        slab = quadrature(self.nodes.cells[: self.nodes.slab_cells], self.place)
        return join([slab, self.probe])

    def bare(self) -> Model:
        """The same without what can be made again."""
        return replace(self)

    def chest(self, indentation: float) -> Floats:
        """Displacements that are held, (nodes, 3) mm: the chest wall comes nearer by the indentation."""
        moved = np.zeros_like(self.place)
        moved[self.nodes.chest] = -indentation * self.normal
        return moved

    @property
    def slab(self) -> Floats:
        """1 at the slab's nodes, 0 at the probe's; (nodes, 1)."""
        return (np.arange(len(self.place)) < self.nodes.slab)[:, None].astype(float)

    @property
    def share(self) -> int:
        """How many times the part that is meshed makes up the whole."""
        return 2 ** sum(self.layout.symmetric)

    def system(self, closed: Bools) -> System:
        return system(self.layout, self.geometry.slab.sides, closed)

    def settle(self, moved: Floats, closed: Bools, bond: Tie) -> None:
        """Put the probe's closed nodes onto the slab's surface, in place."""
        distance = bond.gap(self.place + moved)
        moved[self.nodes.tip, 2] += np.where(closed, distance, 0.0)

    def nodal(self, forces: Floats) -> Floats:
        """Sum of element forces (m, 27, 3) at the nodes, (nodes, 3)."""
        return self.gather(self.nodes.cells, forces)

    def gather(self, cells: NDArray[np.int64], forces: Floats) -> Floats:
        """The same of some elements with nodes (m, 27)."""
        dofs = (3 * cells[:, :, None] + np.arange(3)).ravel()
        total = np.bincount(dofs, weights=forces.ravel(), minlength=self.place.size)
        return np.asarray(total, dtype=float).reshape(-1, 3)

    def wanted(self, moved: Floats) -> Floats:
        """The `shift` that brings the slab's nodes opposite the probe's, for displacements (nodes, 3).

        In the faces along the probe's edge it goes on as it is before them: round the edge the tissue bends
        up like a wall, on which a place across is no longer defined. A slab no wider than the probe keeps its
        edges.
        """
        shift = self.shift + self.interface.slip(self.place + moved)
        whole = [slice(None if half else 2, -2) for half in self.layout.symmetric]
        for axis in (0, 1):
            found = np.moveaxis(shift, axis, 0)  # a view, across the edge first
            for end, (edge, before) in ((-1, (slice(-2, None), -3)), (0, (slice(0, 2), 2))):
                if end == 0 and self.layout.symmetric[axis]:
                    continue
                more = found[edge, whole[1 - axis], axis] - found[before, whole[1 - axis], axis]
                found[edge] = found[before]
                found[edge, :, axis] += more.mean(axis=1, keepdims=True)
                if not self.layout.res.side:
                    found[end, :, axis] = 0.0
        return shift

    def follow(self, shift: Floats) -> Model:
        """The same with the slab's contact nodes at another place within the slab's stress-free surface."""
        place = self.place.copy()
        place[: self.nodes.slab] = mesh.morph_slab(self.layout, self.geometry, shift).doflocs.T
        return replace(self, place=place, shift=shift)


def build(
    geometry: Geometry,
    res: Resolution,
    finite: bool,
    layout: Layout | None = None,
) -> Model:
    """Mesh a geometry; `layout`: with less symmetry than it has."""
    layout = layout or geometry.layout(res)
    slab, probe = mesh.morph_slab(layout, geometry), mesh.morph_probe(layout, geometry)
    found = nodes(layout, geometry.slab.sides)
    place = np.hstack([slab.doflocs, probe.doflocs]).T
    x, y = place[found.tip[:, 0], 0], place[found.tip[0], 1]
    return Model(
        geometry,
        layout,
        found,
        Interface(found.contact, found.tip, (recovery(x), recovery(y)), layout.symmetric),
        quadrature(found.cells[found.slab_cells :], place),
        place,
        np.zeros((*found.tip.shape, 2)),
        mesh.rotation(geometry.pose.tilt_deg).T[:, 2],
        np.flatnonzero(materials(layout) == 1),
        finite,
    )


def moduli(geometry: Geometry, model: Model, inclusion: bool) -> tuple[Floats, Floats]:
    """Shear and bulk modulus of each element, kPa; the slab's own in place of the inclusion if it is left
    out."""
    probe, slab = geometry.probe, geometry.slab
    inner = geometry.inclusion if inclusion and geometry.inclusion is not None else None
    ball = (slab.modulus_kPa, slab.poisson) if inner is None else (inner.modulus, inner.poisson)
    table = [(slab.modulus_kPa, slab.poisson), ball, *((la.modulus_kPa, la.poisson) for la in probe.layers)]
    modulus, poisson = np.array(table).T[:, materials(model.layout)]
    return elasticity.lame(modulus, poisson)
