"""A press as an input deck of CalculiX, so that an independent program can solve the very same geometry.

The 27-node hexahedra lose the nodes in the middle of their faces and bodies and become C3D20R, the 20-node
brick with reduced integration (Dhondt 2004; [dhondt2004]), which does not lock at Poisson's ratio 0.49.
`linear` is small strain, probe and slab tied in the normal direction; `finite` is large strain of a
neo-Hookean material, with frictionless face-to-face contact that slides and opens.

CalculiX finds which places face each other at the start of an increment, and keeps them to its end: its
contact is right to first order in the last increment's slip. So increments are short (`STRIDE`), and each
level is followed by `SETTLE` steps of the same travel. What they begin with must be small: deep presses come
back to equilibrium in swings that hardly die out, or grow. Where they still swing from one to the next, the
mean of the last two is the answer.

Run a deck with `ccx -i NAME` (without the `.inp`); displacements of the probe's contact nodes and the chest
wall's reaction come in `NAME.dat` for every step, fields for viewing in `NAME.frd`. Units are mm, mN, kPa.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import StringIO
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHex2

from fem import mesh
from fem.mesh import Geometry
from fem.meshed import build
from fem.model import Inclusion, Pose, Probe, Slab, check
from fem.topology import Resolution, materials, probe_topology

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mechanics = Literal["linear", "finite"]

STIFFNESS = 1e3
"""Of the contact, kPa per mm of overlap. Ten times more changes the tared maximum by +0.4 % and its total by
+1.7 % at 1 mm (13, 6, 40), by +1.1 and -5 % at 6 mm under a dome (10, 5, 100), and takes twice the time."""

STRIDE = 0.25
"""Longest increment of a finite press, mm."""

SETTLE = 3
"""Steps of the same travel after each level of a finite press."""

CLEAR = 1e-4
"""Gap at first between bodies that a tilt brings together at one place, mm."""

# CalculiX's order of the corners 1-8 and mid-edges 9-20 (user's manual, "Twenty-node brick element"), on the
# lattice {0, 1, 2}^3, and the corners of its faces S1-S6, counted from 0
_CORNERS = np.array([[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 2], [2, 0, 2], [2, 2, 2], [0, 2, 2]])
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_FACES = np.array([[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]])


@dataclass(frozen=True)
class Material:
    """A material by name, Young's modulus (kPa) and Poisson's ratio."""

    name: str
    modulus_kPa: float
    poisson: float


@dataclass(frozen=True)
class Bodies:
    """Probe and slab as arrays; which part of the whole it is, follows from `held`.

    Attributes
    ----------
    place
        Nodes, mm, (nodes, 3); those of probe and slab are apart, also where they touch.
    hexahedra
        Nodes of each element in the order of scikit-fem's ElementHex2, (elements, 27).
    material
        Which of `materials` each element is made of, (elements,).
    chest, glass
        Nodes on the chest wall and on the glass: held, apart from the chest wall's travel.
    held
        Other nodes on planes of symmetry, and the axis that each is held along.
    tip, skin
        Nodes of the probe's contact surface, and of the slab's whole surface.
    under
        For each node of `tip` the slab's node at the same place, for the tie of `linear`.
    normal
        Direction of the press, (3,).
    start
        Travel at which the bodies stand as they are given, mm; at most 0.
    """

    place: Floats
    hexahedra: Ints
    material: Ints
    materials: tuple[Material, ...]
    chest: Ints
    glass: Ints
    held: tuple[tuple[Ints, int], ...]
    tip: Ints
    skin: Ints
    under: Ints
    normal: Floats
    start: float

    def without_inclusion(self) -> Bodies:
        """The same mesh with the inclusion made of tissue."""
        tissue = replace(self.materials[0], name="INCLUSION")
        return replace(self, materials=(self.materials[0], tissue, *self.materials[2:]))


def bodies(geometry: Geometry, res: Resolution) -> Bodies:
    """The mesh of `fem.press` for a geometry, with the material of each element and what is held."""
    model = build(geometry, res, finite=False)
    nodes, slab, inner = model.nodes, geometry.slab, geometry.inclusion
    in_slab = np.arange(len(model.place)) < nodes.slab
    logical = probe_topology(model.layout).doflocs[2]
    glass = nodes.slab + np.flatnonzero(logical == logical.min())
    free = np.ones(len(model.place), dtype=bool)
    free[nodes.chest] = free[glass] = False
    held = [(np.flatnonzero(nodes.held[:, axis] & free), axis) for axis in (0, 1)]
    height = model.place @ model.normal
    skin = np.flatnonzero(in_slab & (height < height[in_slab].min() + 1e-9))
    between = (model.place[nodes.contact] - model.place[nodes.tip])[..., 2]
    start = min(0.0, float(between.min()) / float(model.normal[2]))
    if start < 0:
        start -= CLEAR
    ball = (slab.modulus_kPa, slab.poisson) if inner is None else (inner.modulus, inner.poisson)
    layers = enumerate(geometry.probe.layers, start=1)
    return Bodies(
        model.place - start * model.normal * model.slab,
        nodes.cells,
        materials(model.layout),
        (
            Material("TISSUE", slab.modulus_kPa, slab.poisson),
            Material("INCLUSION", *ball),
            *(Material(f"LAYER{i}", layer.modulus_kPa, layer.poisson) for i, layer in layers),
        ),
        nodes.chest,
        glass,
        tuple((found, axis) for found, axis in held if len(found)),
        nodes.tip.ravel(),
        skin,
        nodes.contact.ravel(),
        model.normal,
        start,
    )


def deck(
    path: Path,
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    levels: Sequence[float],
    *,
    mechanics: Mechanics = "finite",
    quality: str = "standard",
    tilt: tuple[float, float] = (0.0, 0.0),
    position: tuple[float, float] = (0.0, 0.0),
    without_inclusion: bool = False,
) -> Path:
    """Write a press as `fem.press` takes it, on the mesh that it uses.

    Parameters
    ----------
    path
        File to write, NAME.inp.
    levels
        Travel of the glass towards the chest wall, mm, rising.
    mechanics, quality, tilt, position
        As for `fem.press`.
    without_inclusion
        Fill the inclusion with tissue, for the press to tare with: on the same mesh.

    Returns
    -------
    The path.

    Raises
    ------
    ValueError
        On impossible input, in one line; so is what only a finite deck can hold.
    NotModelled
        On possible input that is not modelled.

    Example
    -------
    >>> layers = (Layer(2, 27), Layer(3, 61), Layer(5, 156))
    >>> probe, ball = Probe(25, layers), Inclusion(10, 5, 100)
    >>> deck(Path("a.inp"), probe, Slab(30, 60, 5), ball, [1.0])  # doctest: +SKIP
    """
    for name, value, allowed in (
        ("mechanics", mechanics, ("finite", "linear")),
        ("quality", quality, tuple(mesh.QUALITIES)),
    ):
        if value not in allowed:
            raise ValueError(f"{name}: received {value!r}; allowed {', '.join(allowed)}")
    pose = Pose(tuple(tilt), tuple(position))  # type: ignore[arg-type]
    check(probe, slab, inclusion, pose)
    if mechanics == "linear" and (any(pose.tilt_deg) or probe.dome_radius_mm is not None):
        raise ValueError(
            "mechanics: received 'linear' with a tilt or a dome; allowed is 'finite', since a linear deck "
            "ties surfaces that touch all over"
        )
    found = bodies(Geometry(probe, slab, inclusion, pose), mesh.QUALITIES[quality])
    return write(path, found.without_inclusion() if without_inclusion else found, levels, mechanics)


def write(
    path: Path,
    model: Bodies,
    levels: Sequence[float],
    mechanics: Mechanics = "finite",
    *,
    element: str = "C3D20R",
    stiffness: float = STIFFNESS,
    settle: int = SETTLE,
    stride: float = STRIDE,
) -> Path:
    """Write the deck of one press.

    Parameters
    ----------
    levels
        Travel, mm, rising: each is one step of the run, and in `finite` `settle` more.
    element
        C3D20R or C3D20: CalculiX's name of the brick.
    stiffness
        Of the contact of `finite`, kPa / mm.
    stride
        Longest increment of `finite`, mm.

    Raises
    ------
    ValueError
        On levels that do not rise from above zero.
    """
    levels = [float(level) for level in levels]
    if not levels or not np.isfinite(levels).all() or not np.all(np.diff([0.0, *levels]) > 0):
        raise ValueError(f"indentation: received {levels}; allowed are finite, positive, rising levels, mm")
    finite = mechanics == "finite"
    out = StringIO()
    out.write("** Press of a layered probe on a tissue slab; mm, mN, kPa. Written by fem.ccx\n*HEADING\n")
    out.write(f"{mechanics}, {', '.join(f'{level:g}' for level in levels)} mm\n")
    bricks = to_bricks(model.place, model.hexahedra)
    used = np.zeros(len(model.place), dtype=bool)
    used[bricks] = True
    _mesh(out, model, bricks, used, element)
    for material in model.materials:
        out.write(_material(material, finite))
    if finite:
        _contact(out, model, bricks, stiffness)
    else:
        _tie(out, model, used)
    out.write("*BOUNDARY\nGLASS, 1, 3\n")
    for i, (_, axis) in enumerate(model.held):
        out.write(f"HELD{i}, {axis + 1}\n")
    for before, level in pairwise([model.start, *levels]):
        share = _number(min(1.0, stride / (level - before)))
        _step(out, model, level, finite, f"{share}, 1., 1e-5, {share}")
        for _ in range(settle if finite else 0):
            _step(out, model, level, finite, "1., 1.")
    path.write_text(out.getvalue(), encoding="ascii")
    return path


def _step(out: StringIO, model: Bodies, level: float, finite: bool, increments: str) -> None:
    """One step, the chest wall at a travel (mm)."""
    out.write(f"*STEP, NLGEOM, INC=200\n*STATIC\n{increments}\n" if finite else "*STEP\n*STATIC\n")
    out.write("*BOUNDARY\n")
    for axis, moved in enumerate((model.start - level) * model.normal):
        out.write(f"CHEST, {axis + 1}, {axis + 1}, {_number(moved)}\n")
    out.write("*NODE PRINT, NSET=TIP, FREQUENCY=1000\nU\n")
    out.write("*NODE PRINT, NSET=CHEST, FREQUENCY=1000, TOTALS=ONLY\nRF\n")
    out.write("*NODE FILE, FREQUENCY=1000\nU, RF\n")
    if finite:
        out.write("*CONTACT FILE, FREQUENCY=1000\nCDIS, CSTR\n")
    out.write("*END STEP\n")


def to_bricks(place: Floats, hexahedra: Ints) -> Ints:
    """20-node bricks in CalculiX's order from 27-node hexahedra in scikit-fem's.

    Parameters
    ----------
    place
        Nodes, mm, (nodes, 3).
    hexahedra
        (elements, 27), of either handedness.

    Returns
    -------
    (elements, 20) node numbers, right-handed.
    """
    lattice = np.vstack([_CORNERS, [(_CORNERS[a] + _CORNERS[b]) // 2 for a, b in _EDGES]])
    number = {tuple(at): i for i, at in enumerate(np.round(2 * ElementHex2.doflocs).astype(int))}
    right = np.array([number[tuple(at)] for at in lattice])
    mirrored = np.array([number[(2 - x, y, z)] for x, y, z in lattice])
    bricks = hexahedra[:, right]
    a, b, c, d = (place[bricks[:, i]] for i in (0, 1, 3, 4))
    left_handed = np.einsum("ni,ni->n", np.cross(b - a, c - a), d - a) < 0
    return np.where(left_handed[:, None], hexahedra[:, mirrored], bricks)


def faces_on(bricks: Ints, nodes: Ints) -> Ints:
    """Faces whose four corners are all among `nodes`: rows (element, S1 ... S6 as 1 ... 6), both counted as
    CalculiX counts, from 1."""
    among = np.zeros(bricks.max() + 1, dtype=bool)
    among[nodes[nodes < len(among)]] = True
    element, face = np.nonzero(among[bricks[:, _FACES]].all(axis=2))
    return np.stack([element + 1, face + 1], axis=1)


def _mesh(out: StringIO, model: Bodies, bricks: Ints, used: NDArray[np.bool_], element: str) -> None:
    out.write("*NODE, NSET=ALL\n")
    nodes = np.flatnonzero(used)
    for i, (x, y, z) in zip(nodes + 1, model.place[nodes].tolist(), strict=True):
        out.write(f"{i}, {_number(x)}, {_number(y)}, {_number(z)}\n")
    for kind, material in enumerate(model.materials):
        out.write(f"*ELEMENT, TYPE={element}, ELSET={material.name}\n")
        for i in np.flatnonzero(model.material == kind):
            row = [str(n + 1) for n in (i, *bricks[i])]
            out.write(", ".join(row[:11]) + ",\n" + ", ".join(row[11:]) + "\n")
        out.write(f"*SOLID SECTION, ELSET={material.name}, MATERIAL={material.name}\n")
    sets = {"GLASS": model.glass, "CHEST": model.chest, "TIP": model.tip}
    sets |= {f"HELD{i}": nodes for i, (nodes, _) in enumerate(model.held)}
    for name, nodes in sets.items():
        out.write(f"*NSET, NSET={name}\n")
        kept = np.unique(nodes[used[nodes]]) + 1
        for start in range(0, len(kept), 12):
            out.write(", ".join(map(str, kept[start : start + 12])) + ",\n")


def _material(material: Material, finite: bool) -> str:
    """Hooke's law, or W = C10 (J^(-2/3) tr C - 3) + (J - 1)^2 / D1, with the same moduli at small strain."""
    if not finite:
        law = f"*ELASTIC\n{_number(material.modulus_kPa)}, {_number(material.poisson)}\n"
    else:
        shear = material.modulus_kPa / (2 * (1 + material.poisson))
        bulk = material.modulus_kPa / (3 * (1 - 2 * material.poisson))
        law = f"*HYPERELASTIC, NEO HOOKE\n{_number(shear / 2)}, {_number(2 / bulk)}\n"
    return f"*MATERIAL, NAME={material.name}\n{law}"


def _tie(out: StringIO, model: Bodies, used: NDArray[np.bool_]) -> None:
    """z of each contact node of the probe is z of the slab's node there; x and y stay free of each other."""
    for tip, under in zip(model.tip, model.under, strict=True):
        if used[tip]:
            out.write(f"*EQUATION\n2\n{tip + 1}, 3, 1., {under + 1}, 3, -1.\n")


def _contact(out: StringIO, model: Bodies, bricks: Ints, stiffness: float) -> None:
    """The probe's face is the dependent side, as only it has an edge that the other can slide past."""
    for name, nodes in (("TIPFACE", model.tip), ("SKINFACE", model.skin)):
        out.write(f"*SURFACE, NAME={name}, TYPE=ELEMENT\n")
        for element, face in faces_on(bricks, nodes):
            out.write(f"{element}, S{face}\n")
    out.write("*SURFACE INTERACTION, NAME=SMOOTH\n*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE=LINEAR\n")
    out.write(f"{_number(stiffness)}\n*CONTACT PAIR, INTERACTION=SMOOTH, TYPE=SURFACE TO SURFACE\n")
    out.write("TIPFACE, SKINFACE\n")


def _number(value: float) -> str:
    """A number in a deck: CalculiX reads twenty characters and drops the rest, exponents too."""
    return f"{float(value):.12g}"
