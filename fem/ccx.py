"""A press as an input deck of CalculiX, so that an independent program can solve the very same geometry.

The 27-node hexahedra lose the nodes in the middle of their faces and bodies and become C3D20R, the 20-node
brick with reduced integration (Dhondt 2004; [dhondt2004]). Its eight integration points do not lock at Poisson's
ratio 0.49. `linear` is small strain, probe and slab tied in the normal direction; `finite` is large strain of a
neo-Hookean material, with frictionless face-to-face contact that slides and opens.

Run a deck with `ccx -i NAME` (without the `.inp`); displacements of the probe's contact nodes and the chest wall's
reaction come in `NAME.dat` for every level, fields for viewing in `NAME.frd`. Units as everywhere: mm, mN, kPa.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from io import StringIO
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from skfem import ElementHex2

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Mechanics = Literal["linear", "finite", "tied"]

STIFFNESS = 1e5
"""Of the contact, kPa per mm of overlap: so large that ten times more or less changes nothing reported."""

# CalculiX's order of the corners 1-8 and mid-edges 9-20 (user's manual, "Twenty-node brick element"), on the
# lattice {0, 1, 2}^3, and the corners of its faces S1-S6, counted from 0
_CORNERS = np.array(
    [[0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0], [0, 0, 2], [2, 0, 2], [2, 2, 2], [0, 2, 2]]
)
_EDGES = [(0, 1), (1, 2), (2, 3), (3, 0), (4, 5), (5, 6), (6, 7), (7, 4), (0, 4), (1, 5), (2, 6), (3, 7)]
_FACES = np.array([[0, 1, 2, 3], [4, 7, 6, 5], [0, 4, 5, 1], [1, 5, 6, 2], [2, 6, 7, 3], [3, 7, 4, 0]])


@dataclass(frozen=True)
class Material:
    """A material by name, Young's modulus (kPa) and Poisson's ratio."""

    name: str
    modulus_kPa: float
    poisson: float


@dataclass(frozen=True)
class Model:
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
        Nodes on the chest wall and on the glass: held, apart from the chest wall's travel along z.
    held
        Nodes on planes of symmetry, and the axis that each is held along.
    tip, skin
        Nodes of the probe's contact surface, and of the slab's surface that it may touch.
    under
        For each node of `tip` the slab's node at the same place, for the tie of `linear`; may be empty.
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

    def replaced(self, name: str, by: str) -> Model:
        """The same mesh with the material `name` given the constants of the material `by`."""
        source = next(m for m in self.materials if m.name == by)
        materials = (replace(source, name=name) if m.name == name else m for m in self.materials)
        return replace(self, materials=tuple(materials))


def write(
    path: Path,
    model: Model,
    indentation: Sequence[float],
    mechanics: Mechanics = "finite",
    *,
    element: str = "C3D20R",
    stiffness: float = STIFFNESS,
    first_step: float = 0.25,
    kind: str = "SURFACE TO SURFACE",
    pair: str = "TIPFACE, SKINFACE",
) -> Path:
    """Write the deck of one press.

    Parameters
    ----------
    path
        File to write, NAME.inp.
    model
        Geometry, materials and sets.
    indentation
        Levels, mm, rising: each is one step of the run.
    mechanics
        "linear" or "finite"; see the module.
    element
        C3D20R, C3D20 or C3D20H: CalculiX's name of the brick.
    stiffness
        Of the contact of `finite`, kPa / mm.
    first_step
        Increment that CalculiX tries first in `finite`, as part of a level.

    Returns
    -------
    The path.

    Raises
    ------
    ValueError
        On levels that do not rise from above zero, or a tie without pairs.
    """
    levels = [float(level) for level in indentation]
    if not levels or not np.all(np.diff([0.0, *levels]) > 0) or not np.isfinite(levels).all():
        raise ValueError(f"indentation: received {levels}; allowed are finite, positive, rising levels, mm")
    if mechanics != "finite" and len(model.under) != len(model.tip):
        raise ValueError(
            "mechanics: received linear; allowed only where probe and slab have matching nodes and touch, "
            "which a domed or tilted press has not"
        )
    out = StringIO()
    out.write("** Press of a layered probe on a tissue slab; mm, mN, kPa. Written by fem.ccx\n*HEADING\n")
    out.write(f"{mechanics}, {', '.join(f'{level:g}' for level in levels)} mm\n")
    bricks = to_bricks(model.place, model.hexahedra)
    used = np.zeros(len(model.place), dtype=bool)
    used[bricks] = True
    _mesh(out, model, bricks, used, element)
    for material in model.materials:
        out.write(_material(material, mechanics))
    if mechanics != "finite":
        _tie(out, model, used)
    else:
        _contact(out, model, bricks, stiffness, kind, pair)
    out.write("*BOUNDARY\nGLASS, 1, 3\nCHEST, 1, 2\n")
    for i, (_, axis) in enumerate(model.held):
        out.write(f"HELD{i}, {axis + 1}\n")
    for level in levels:
        out.write("*STEP\n*STATIC\n" if mechanics == "linear" else "*STEP, NLGEOM, INC=200\n*STATIC\n")
        if mechanics != "linear":
            out.write(f"{first_step:g}, 1., 1e-4, 1.\n")
        out.write(f"*BOUNDARY\nCHEST, 3, 3, {-level!r}\n")
        out.write("*NODE PRINT, NSET=TIP, FREQUENCY=1000\nU\n")
        out.write("*NODE PRINT, NSET=CHEST, FREQUENCY=1000, TOTALS=ONLY\nRF\n")
        out.write("*NODE FILE, FREQUENCY=1000\nU, RF\n")
        if mechanics == "finite":
            out.write("*CONTACT FILE, FREQUENCY=1000\nCDIS, CSTR\n")
        out.write("*END STEP\n")
    path.write_text(out.getvalue(), encoding="ascii")
    return path


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


def _mesh(out: StringIO, model: Model, bricks: Ints, used: NDArray[np.bool_], element: str) -> None:
    out.write("*NODE, NSET=ALL\n")
    nodes = np.flatnonzero(used)
    for i, (x, y, z) in zip(nodes + 1, model.place[nodes].tolist(), strict=True):
        out.write(f"{i}, {x!r}, {y!r}, {z!r}\n")
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


def _material(material: Material, mechanics: Mechanics) -> str:
    """Hooke's law, or W = C10 (J^(-2/3) tr C - 3) + (J - 1)^2 / D1, with the same moduli at small strain."""
    if mechanics == "linear":
        law = f"*ELASTIC\n{material.modulus_kPa!r}, {material.poisson!r}\n"
    else:
        shear = material.modulus_kPa / (2 * (1 + material.poisson))
        bulk = material.modulus_kPa / (3 * (1 - 2 * material.poisson))
        law = f"*HYPERELASTIC, NEO HOOKE\n{shear / 2!r}, {2 / bulk!r}\n"
    return f"*MATERIAL, NAME={material.name}\n{law}"


def _tie(out: StringIO, model: Model, used: NDArray[np.bool_]) -> None:
    """z of each contact node of the probe is z of the slab's node there; x and y stay free of each other."""
    for tip, under in zip(model.tip, model.under, strict=True):
        if used[tip]:
            out.write(f"*EQUATION\n2\n{tip + 1}, 3, 1., {under + 1}, 3, -1.\n")


def _contact(out: StringIO, model: Model, bricks: Ints, stiffness: float, kind: str, pair: str) -> None:
    """The probe's face is the dependent side, as only it has an edge that the other can slide past."""
    for name, nodes in (("TIPFACE", model.tip), ("SKINFACE", model.skin)):
        out.write(f"*SURFACE, NAME={name}, TYPE=ELEMENT\n")
        for element, face in faces_on(bricks, nodes):
            out.write(f"{element}, S{face}\n")
    law = f"LINEAR\n{stiffness!r}\n" if np.isfinite(stiffness) else "HARD\n"
    out.write(f"*SURFACE INTERACTION, NAME=SMOOTH\n*SURFACE BEHAVIOR, PRESSURE-OVERCLOSURE={law}")
    out.write(f"*CONTACT PAIR, INTERACTION=SMOOTH, TYPE={kind}\n{pair}\n")
