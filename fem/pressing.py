"""Press the probe on the slab: the verb of this package."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, overload

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

from fem import mesh, surface, volume
from fem.carried import carried
from fem.contact_fields import TOO_UNEVEN, contact_of
from fem.equilibrium import NotConverged as Stuck
from fem.equilibrium import State
from fem.mesh import Geometry
from fem.meshed import build, moduli
from fem.model import Inclusion, NotConverged, NotModelled, Pose, Probe, Slab, check
from fem.path import path
from fem.solver import one_thread
from fem.tared import added, tared
from fem.topology import Layout, Resolution, materials, probe_topology, slab_topology
from fem.trust import discretisation_error, on_coarser
from fem.wrinkles import refuse_wrinkles

Floats = NDArray[np.float64]
Progress = Callable[[str, float], None]
Mechanics = Literal["finite", "linear"]

MECHANICS = ("finite", "linear")


@dataclass(frozen=True)
class Press:
    """What a press does; names ending in `_0` are the same press without the inclusion, on the same mesh.

    Attributes
    ----------
    surface
        The whole contact surface: undeformed points (n, 3) mm, quads on all Q2 nodes, and of each point
        `displacement` (n, 3) mm of the probe, in its frame, +z into the specimen, so that pushed in is
        negative; `pressure` (n,) kPa, compression positive, on the deformed surface; `displacement_0`,
        `pressure_0`; and the lumped areas `area`, `area_0` (n,) mm² of the deformed surface seen along z:
        `pressure * area` sums to the force. Points are a grid, x-major.
    cut
        The cut through the middle of probe and inclusion along x: `displacement`, `displacement_0` (n, 3) mm,
        in the probe's frame, so that the chest wall moves by -indentation; cells' `material`: 0 tissue, 1
        inclusion, 2, 3, ... layers from the contact side. Points are the nodes with the inclusion. At finite
        strain the slab's mesh follows the slip of either state: there `displacement_0` is of nodes that lie
        beside the points, near the contact by up to 0.08 mm (pressed 1 mm) or 0.25 mm (3 mm).
    indentation_mm, indentation_0_mm
        Travel of the glass towards the chest wall since the middle of the contact surface met the slab's
        undeformed surface; they differ when pressed by force.
    force_N, force_0_N, chest_force_N
        Force on the contact surface along z, the same without inclusion, and the chest wall's reaction;
        compression positive.
    min_pressure_kPa
        The smallest contact pressure of the two states; 0 where contact has opened.
    dof, seconds
        Unknowns, and the time that the call had taken when this level was done.
    path
        How contact was treated: "tied" (linear, closed all over), "sliding" (finite strain, closed all over)
        or "unilateral" (some of it is open).
    mechanics
        "finite" strain or "linear" elasticity.
    error_percent
        Estimate of the discretisation error of the tared displacement, in per cent of its maximum.
    background
        Plain tissue on the surface: "own", of the press's own mesh with its ripples, or "shared" by all
        inclusions (`fem.on_background`).
    signal
        What the inclusion adds: "meshed", with the ripples of its mesh, a per cent or two of the tared
        pressure's maximum, or "smooth", without them (`fem.on_background`).
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
    path: str
    mechanics: str
    error_percent: float
    _states: tuple[State, State] = field(repr=False)
    _geometry: Geometry = field(repr=False)
    _small: tuple[State, State] | None = field(default=None, repr=False)  # small strain per mm, if closed
    background: str = "own"
    signal: str = "meshed"

    def inclusion(self) -> tuple[Floats, Floats] | None:
        """The deformed inclusion as an ellipsoid, centre (3,) and axes (3, 3) in mm; see `fem.carried`."""
        return None if self._geometry.inclusion is None else carried(self._geometry, self._states[0])

    def volume(self) -> pv.UnstructuredGrid:
        """Displacement, material, modulus and stress throughout probe and slab; see `fem.volume`.

        At finite strain `displacement_0` in the slab is of the bare press's own nodes, as told of `cut`.
        """
        state, bare = self._states
        model = state.model
        of = _materials(self._geometry, model.layout)
        gradient, weight, where = volume.gradients(model.place, model.nodes.cells, state.moved)
        shear, bulk = moduli(self._geometry, model, True)
        finite = self.mechanics == "finite"
        dilation = (
            np.linalg.det(np.eye(3) + gradient) - 1 if finite else np.trace(gradient, axis1=-2, axis2=-1)
        )
        stress = volume.cell_stress(
            gradient, volume.linear_pressure(dilation, bulk, weight, where), shear, weight, self.mechanics
        )
        return volume.volume_grid(
            model.place,
            model.nodes.cells,
            state.moved,
            bare.moved,
            of,
            9 * bulk * shear / (3 * bulk + shear),
            stress,
            mirror=tuple(a for a, half in zip("xy", model.layout.symmetric, strict=True) if half),
        )


@overload
def press(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    indentation: Sequence[float],
    *,
    mechanics: Mechanics = ...,
    quality: str = ...,
    tilt: tuple[float, float] = ...,
    position: tuple[float, float] = ...,
    estimate: bool = ...,
    progress: Progress | None = ...,
) -> list[Press]: ...
@overload
def press(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    *,
    force: Sequence[float],
    mechanics: Mechanics = ...,
    quality: str = ...,
    tilt: tuple[float, float] = ...,
    position: tuple[float, float] = ...,
    estimate: bool = ...,
    progress: Progress | None = ...,
) -> list[Press]: ...
@overload
def press(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    indentation: float | None = None,
    *,
    force: float | None = None,
    mechanics: Mechanics = ...,
    quality: str = ...,
    tilt: tuple[float, float] = ...,
    position: tuple[float, float] = ...,
    estimate: bool = ...,
    progress: Progress | None = ...,
) -> Press: ...
def press(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    indentation: float | Sequence[float] | None = None,
    *,
    force: float | Sequence[float] | None = None,
    mechanics: Mechanics = "finite",
    quality: str = "standard",
    tilt: tuple[float, float] = (0.0, 0.0),
    position: tuple[float, float] = (0.0, 0.0),
    estimate: bool = True,
    progress: Progress | None = None,
) -> Press | list[Press]:
    """Press the probe on the slab; one level, or a list of levels for a sequence, found on one way down.

    Parameters
    ----------
    inclusion
        None for plain tissue.
    indentation
        Travel of the glass towards the chest wall, mm; give this or `force`.
    force
        Force between probe and slab along the probe's axis, N; the state without inclusion then has the same
        force.
    mechanics
        "finite": neo-Hookean solids and sliding contact. "linear": small strain, as the source paper has it.
    quality
        "preview", "standard" or "reference".
    tilt
        Rotation of the probe about x, then y, through the middle of its contact surface, degrees.
    position
        The probe's centre minus the slab's, mm. `inclusion.offset` stays relative to the probe.
    estimate
        False leaves out the estimate of the discretisation error (NaN), which takes a coarser solution.
    progress
        Called as progress(stage, fraction done).

    Raises
    ------
    ValueError
        On impossible input, in one line.
    NotModelled
        On possible input that is not modelled.
    NotConverged
        If no equilibrium is found, or only one whose contact has wrinkled, in one line.

    Example
    -------
    >>> layers = (Layer(2, 27), Layer(3, 61), Layer(5, 156))
    >>> press(Probe(25, layers), Slab(30, 60, 5), Inclusion(10, 5, 100), 2.0).force_N  # doctest: +SKIP
    """
    levels, by_force, several = _levels(indentation, force)
    _known("quality", quality, mesh.QUALITIES)
    _known("mechanics", mechanics, MECHANICS)
    geometry = _geometry(probe, slab, inclusion, tilt, position)
    answers = _presses([geometry], levels, by_force, mechanics, mesh.QUALITIES[quality], estimate, progress)
    (found,) = answers
    return found if several else found[0]


def press_moduli(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion,
    moduli: Sequence[float],
    indentation: float | Sequence[float],
    *,
    mechanics: Mechanics = "finite",
    quality: str = "standard",
    tilt: tuple[float, float] = (0.0, 0.0),
    position: tuple[float, float] = (0.0, 0.0),
    estimate: bool = True,
    progress: Progress | None = None,
) -> list[list[Press]]:
    """Press on inclusions that differ in their modulus only, which share mesh, factor and background.

    Returns
    -------
    For each modulus (kPa) the list of levels; else as `press`, with `inclusion.modulus` left out of account.
    """
    levels, _, _ = _levels(indentation, None)
    _known("quality", quality, mesh.QUALITIES)
    _known("mechanics", mechanics, MECHANICS)
    several = [_geometry(probe, slab, replace(inclusion, modulus=float(m)), tilt, position) for m in moduli]
    return list(_presses(several, levels, False, mechanics, mesh.QUALITIES[quality], estimate, progress))


def _known(name: str, value: str, allowed: object) -> None:
    if value not in allowed:  # type: ignore[operator]
        raise ValueError(f"{name}: received {value!r}; allowed {', '.join(allowed)}")  # type: ignore[arg-type]


def _geometry(
    probe: Probe,
    slab: Slab,
    inclusion: Inclusion | None,
    tilt: tuple[float, float],
    position: tuple[float, float],
) -> Geometry:
    pose = Pose(tuple(tilt), tuple(position))  # type: ignore[arg-type]
    check(probe, slab, inclusion, pose)
    return Geometry(probe, slab, inclusion, pose)


def _levels(
    indentation: float | Sequence[float] | None, force: float | Sequence[float] | None
) -> tuple[list[float], bool, bool]:
    """Levels, whether they are forces, and whether a list is wanted."""
    if (indentation is None) == (force is None):
        raise ValueError(
            f"indentation, force: received {indentation} and {force}; allowed exactly one of the two"
        )
    name, given = ("indentation", indentation) if force is None else ("force", force)
    several = np.ndim(given) > 0  # type: ignore[arg-type]
    levels = [float(level) for level in (given if several else [given])]  # type: ignore[union-attr, arg-type]
    for level in levels:
        if not (np.isfinite(level) and level > 0):
            raise ValueError(f"{name}: received {level}; allowed are positive finite numbers")
    if not levels:
        raise ValueError(f"{name}: received no level; allowed at least one")
    return levels, force is not None, several


def _presses(
    geometries: Sequence[Geometry],
    levels: Sequence[float],
    by_force: bool,
    mechanics: Mechanics,
    res: Resolution,
    estimate: bool,
    progress: Progress | None,
) -> Iterator[list[Press]]:
    """The levels of geometries that differ in the inclusion's modulus only."""
    start = time.perf_counter()
    tell = progress or (lambda stage, fraction: None)
    tell("mesh", 0.0)
    total = 1 + len(geometries) * (len(set(levels)) + 1)
    done = [0]

    def step(stage: str) -> None:
        done[0] += 1
        tell(stage, min(1.0, done[0] / total))

    first = geometries[0]
    try:
        with one_thread():
            coarse = on_coarser(geometries, res) if estimate else [None] * len(geometries)
            model = build(first, res, mechanics == "finite")
            bare = path(first, model, False)
            step("without inclusion")
            paths = [bare if g.inclusion is None else path(g, model, True, bare) for g in geometries]
            flat = bool(bare.states[0].closed.all())
            if estimate or flat:
                for one in (bare, *paths):
                    one.rate()
            for geometry, full, other in zip(geometries, paths, coarse, strict=True):
                error = discretisation_error(geometry, other, full, bare) if estimate else np.nan
                small = (full.per_mm(), bare.per_mm()) if flat and geometry.inclusion else None
                step("error estimate")
                found: dict[float, Press] = {}
                for level in sorted(set(levels)):
                    states = tuple(
                        p.by_force(1e3 * level / model.share) if by_force else p.to(level)
                        for p in (full, bare)
                    )
                    seconds = time.perf_counter() - start
                    found[level] = _press(geometry, states, small, mechanics, res, error, seconds)  # type: ignore[arg-type]
                    step(f"level {level:g}")
                yield [found[level] for level in levels]
            tell("done", 1.0)
    except Stuck as stuck:
        raise NotConverged(f"{stuck}; allowed are presses that this mesh can follow") from None
    except np.linalg.LinAlgError:
        raise NotModelled(TOO_UNEVEN) from None


def _materials(geometry: Geometry, layout: Layout) -> NDArray[np.int64]:
    """`materials`; where there is no inclusion, the cells that the mesh keeps for one are tissue."""
    found = materials(layout)
    return found if geometry.inclusion is not None else np.where(found == 1, 0, found)


def _press(
    geometry: Geometry,
    states: tuple[State, State],
    small: tuple[State, State] | None,
    mechanics: Mechanics,
    res: Resolution,
    error: float,
    seconds: float,
) -> Press:
    model = states[0].model
    contact, lowest = contact_of(geometry, states)
    nodes, layout = model.nodes, model.layout
    faces, elements = surface.cut_faces(slab_topology(layout))
    probe_faces, probe_elements = surface.cut_faces(probe_topology(layout))
    cut = surface.cut_plane(
        model.place,
        np.vstack([faces, probe_faces + nodes.slab]),
        _materials(geometry, layout)[np.concatenate([elements, probe_elements + nodes.slab_cells])],
        {name: s.moved for name, s in zip(("displacement", "displacement_0"), states, strict=True)},
        mirror=layout.symmetric[0],
    )
    closed = all(state.closed.all() for state in states)
    if closed and small is not None and model.finite:
        rise, _ = added(contact, states[0].indentation, states[1].indentation)
        refuse_wrinkles(rise, tared(geometry, small)[0], states[0].indentation)
    forces = [1e-3 * model.share * float(state.force.sum()) for state in states]
    return Press(
        contact,
        cut,
        indentation_mm=states[0].indentation,
        indentation_0_mm=states[1].indentation,
        force_N=forces[0],
        force_0_N=forces[1],
        chest_force_N=1e-3 * model.share * float(states[0].chest[2]),
        min_pressure_kPa=lowest,
        dof=model.system(states[0].closed).tree.size,
        seconds=seconds,
        path="unilateral" if not closed else "sliding" if mechanics == "finite" else "tied",
        mechanics=mechanics,
        error_percent=error,
        _states=states,
        _geometry=geometry,
        _small=small,
    )
