"""The plane element: exact on linear fields, third order on smooth ones, Lamé and Eshelby, no locking."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.special import j0, j1
from skfem import MeshQuad, MeshQuad2
from test_fem_eshelby import eshelby, outer_displacement

from fem import plane_element as element
from fem import plane_mesh
from fem.elasticity import lame
from fem.plane_element import KINDS, Kind

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

# any far strain that the kind can carry, as a linear displacement (x, z) -> gradient @ (x, z)
LINEAR = {
    "plane_strain": np.array([[0.3, -0.2], [0.05, 0.4]]),
    "axisymmetric": np.array([[0.3, 0.0], [0.0, -0.2]]),
}


def curved_square(cells: int) -> MeshQuad2:
    """Unit square, one side on the axis, whose inner elements are smoothly bent."""
    mesh = MeshQuad2.from_mesh(MeshQuad.init_tensor(*2 * (np.linspace(0, 1, cells + 1),)))
    x, z = mesh.doflocs
    bump = 0.05 * np.sin(np.pi * x) * np.sin(np.pi * z)
    return MeshQuad2(mesh.doflocs + bump * np.array([[1.0], [-1.0]]), mesh.t)


def solve(
    mesh: MeshQuad2, modulus: Floats, poisson: Floats, kind: Kind, held: Bools, given: Floats, load: Floats
) -> tuple[Floats, Floats]:
    """Displacement and nodal force, each (2, nodes), with `given` where `held` and `load` elsewhere."""
    matrices = element.stiffness(mesh, modulus, poisson, kind)
    local = element.element_dofs(mesh)
    fixed = held.T.ravel()
    full = np.where(fixed, given.T.ravel(), 0.0)

    def force() -> Floats:
        each = (matrices @ full[local][:, :, None])[:, :, 0]
        return np.bincount(local.ravel(), weights=each.ravel(), minlength=len(full))

    rest = load.T.ravel() - force()
    number = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    full[~fixed] = element.Banded(matrices, number[local]).solve(rest[~fixed])
    return full.reshape(-1, 2).T, force().reshape(-1, 2).T


def uniform(mesh: MeshQuad2, modulus: float, poisson: float) -> tuple[Floats, Floats]:
    n = mesh.t.shape[1]
    return np.full(n, modulus), np.full(n, poisson)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.4999])
def test_patch(kind: Kind, poisson: float) -> None:
    """A linear displacement is reproduced to rounding on curved elements, the axis free to follow."""
    mesh = curved_square(3)
    place = mesh.doflocs
    exact = LINEAR[kind] @ place
    held = np.tile((place < 1e-9).any(axis=0) | (place > 1 - 1e-9).any(axis=0), (2, 1))
    if kind == "axisymmetric":
        held[1, (place[0] < 1e-9) & (np.abs(place[1] - 0.5) < 0.49)] = False
    found, _ = solve(mesh, *uniform(mesh, 5.0, poisson), kind, held, exact, np.zeros_like(exact))
    assert np.abs(found - exact).max() < 1e-11


def test_rigid_motion_costs_nothing() -> None:
    mesh = curved_square(2)
    x, z = mesh.doflocs
    along = np.stack([0 * x, 0 * x + 1])
    for kind, motions in (
        ("plane_strain", (along, along[::-1], np.stack([-z, x]))),
        ("axisymmetric", (along,)),
    ):
        matrices = element.stiffness(mesh, *uniform(mesh, 5.0, 0.49), kind)  # type: ignore[arg-type]
        for motion in motions:
            force = matrices @ motion.T.ravel()[element.element_dofs(mesh)][:, :, None]
            assert np.abs(force).max() < 1e-11


def solenoidal(p: Floats, kind: Kind) -> tuple[Floats, Floats, Floats]:
    """A displacement that keeps volume, its strains xx, zz, yy, 2 xz, and its load per shear modulus.

    Each component is an eigenfunction of the vector Laplacian, so the load is -mu times that.
    """
    k = np.pi
    x, z = k * p
    zero = np.zeros_like(x)
    if kind == "plane_strain":
        u = np.stack([np.sin(z), np.sin(x)])
        return u, np.stack([zero, zero, zero, k * (np.cos(z) + np.cos(x))]), k**2 * u
    u = np.stack([j1(x) * np.cos(z), -j0(x) * np.sin(z)])
    hoop = k * j1(x) / x  # evaluated inside elements only, never on the axis
    strain = [(k * j0(x) - hoop) * np.cos(z), -k * j0(x) * np.cos(z), hoop * np.cos(z), zero]
    return u, np.stack(strain), 2 * k**2 * u


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_manufactured_solution_converges_at_third_order(kind: Kind, poisson: float) -> None:
    """Error of displacement falls as h³, of strain as h², by the same amount at every Poisson's ratio."""
    shear = 1.0 / (2 * (1 + poisson))
    errors = []
    for cells in (5, 10):
        mesh = curved_square(cells)
        q2 = element.basis(mesh)
        volume = element.weights(q2, kind)
        points = np.asarray(q2.global_coordinates())
        exact, exact_strain, load_density = solenoidal(points, kind)
        nodes = mesh.dofs.element_dofs
        load = np.zeros_like(mesh.doflocs)
        for i in range(9):
            weight = np.asarray(q2.basis[i][0]) * volume
            for a in range(2):
                np.add.at(load[a], nodes[i], shear * (load_density[a] * weight).sum(axis=1))
        place = mesh.doflocs
        edge = (place < 1e-9) | (place > 1 - 1e-9)
        held = np.tile(edge.any(axis=0), (2, 1))
        if kind == "axisymmetric":  # nothing but the axis' own condition on the axis
            held[1] = edge[1] | (place[0] > 1 - 1e-9)
        given = solenoidal(np.maximum(place, 1e-30), kind)[0]
        found, _ = solve(mesh, *uniform(mesh, 1.0, poisson), kind, held, given, load)
        here = sum(found[:, nodes[i], None] * np.asarray(q2.basis[i][0]) for i in range(9))
        local = found.T.ravel()[element.element_dofs(mesh)]
        strain = np.einsum("ekdq,ed->keq", element.strains(q2, kind), local)
        errors.append(
            [
                np.sqrt((((a - b) ** 2).sum(axis=0) * volume).sum())
                for a, b in ((here, exact), (strain, exact_strain))
            ]
        )
    rates = np.log2(np.array(errors[0]) / errors[1])
    assert rates[0] > 2.8 and rates[1] > 1.85
    assert errors[1][0] < 2e-4  # the same bound at every Poisson's ratio: nothing locks


def annulus(cells: int) -> tuple[MeshQuad2, Floats]:
    """Quarter of a ring, radii 1 to 2, on exactly placed nodes, and its nodes' radii."""
    mesh = MeshQuad2.from_mesh(
        MeshQuad.init_tensor(np.linspace(1, 2, cells + 1), np.linspace(0, np.pi / 2, cells + 1))
    )
    r, t = mesh.doflocs
    place = r * np.stack([np.cos(t), np.sin(t)])
    place[np.abs(place) < 1e-15] = 0.0
    return MeshQuad2(place, mesh.t), r


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("poisson", [0.3, 0.49, 0.4999])
def test_lame(kind: Kind, poisson: float) -> None:
    """Thick-walled cylinder (plane strain) and sphere (axisymmetry), widened from inside, free outside.

    u = A r + B / r^n, n = 1 or 2, with A from the free outer wall; the radial forces that it takes sum to the
    inner pressure on the inner wall (Lamé).
    """
    mesh, radius = annulus(6)
    (shear,), (bulk,) = lame(np.array([5.0]), np.array([poisson]))
    if kind == "plane_strain":
        n, stiff = 1, bulk + shear / 3  # radial stress is 2 stiff A - 2 mu B / r²
        a = shear / (stiff * 2**2)
        pressure = 2 * shear - 2 * stiff * a
        area = np.pi / 2
    else:
        n = 2
        a = 4 * shear / (3 * bulk * 2**3)
        pressure = 4 * shear - 3 * bulk * a
        area = 2 * np.pi
    exact = (a * radius + radius**-n) * mesh.doflocs / radius
    inner = radius < 1 + 1e-9
    held = (mesh.doflocs == 0) | inner
    found, force = solve(mesh, *uniform(mesh, 5.0, poisson), kind, held, exact, np.zeros_like(exact))
    assert np.abs(found - exact).max() < 1e-4 * np.abs(exact).max()
    radial = (force * mesh.doflocs)[:, inner].sum()
    assert radial == pytest.approx(pressure * area, rel=1e-4)


def test_lame_cylinder_in_axisymmetry() -> None:
    """The same cylinder as a ring whose ends may not move, all but incompressible."""
    mesh = MeshQuad2.from_mesh(MeshQuad.init_tensor(np.linspace(1, 2, 7), np.linspace(0, 1, 3)))
    (shear,), (bulk,) = lame(np.array([5.0]), np.array([0.4999]))
    x, z = mesh.doflocs
    exact = np.stack([shear / ((bulk + shear / 3) * 4) * x + 1 / x, 0 * x])
    held = np.stack([x < 1 + 1e-9, (z < 1e-9) | (z > 1 - 1e-9)])
    found, _ = solve(mesh, *uniform(mesh, 5.0, 0.4999), "axisymmetric", held, exact, np.zeros_like(exact))
    assert np.abs(found - exact).max() < 2e-4


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("contrast", "poisson"), [(20.0, 0.49), (20.0, 0.4999), (0.1, 0.3)])
def test_eshelby(kind: Kind, contrast: float, poisson: float) -> None:
    """On the mesh of presses, the inclusion's strain: mean within 0.2 %, root mean square within 1 %.

    Sphere: Eshelby (1957), far strain (-1/2, -1/2, 1). Cylinder: far strain (1, 0, -1); inside it is that
    times (k + 1) / (k m + 1), k = 3 - 4 nu, m the contrast, and outside the Airy functions cos 2t and
    cos 2t / r² are added (Michell's solution).
    """
    res = plane_mesh.QUALITIES["standard"]
    section = plane_mesh.Section(4.0, 4.5, 8.0, (1.0,), None, (1.0, 1.0), 4.0)
    mesh = plane_mesh.morph_slab(res, section)
    place = mesh.doflocs - np.array([[0.0], [4.0]])
    outer = (place[0] > 4.5 - 1e-9) | (np.abs(place[1]) > 4 - 1e-9)
    exact = np.zeros_like(place)
    if kind == "axisymmetric":
        far = np.diag([-0.5, -0.5, 1.0])
        inside, eigen = eshelby(far, contrast, poisson, poisson)
        solid = np.stack([place[0], 0 * place[0], place[1]])[:, outer]
        exact[:, outer] = outer_displacement(solid, far, eigen, 1.0, poisson)[[0, 2]]
        wanted = np.array([inside[0, 0], inside[2, 2], inside[1, 1], 0.0])
    else:
        k = 3 - 4 * poisson
        strain = (k + 1) / (k * contrast + 1)
        c = 1 - contrast * strain
        r, t = np.hypot(*place[:, outer]), np.arctan2(*place[::-1, outer])
        along = (r + (k + 1) * c / r - c / r**3) * np.cos(2 * t)
        around = (-r - (k - 1) * c / r - c / r**3) * np.sin(2 * t)
        exact[:, outer] = along * np.stack([np.cos(t), np.sin(t)]) + around * np.stack(
            [-np.sin(t), np.cos(t)]
        )
        wanted = np.array([strain, -strain, 0.0, 0.0])
    held = np.tile(outer, (2, 1))
    held[0, place[0] < 1e-9] = True
    ball = plane_mesh.slab_materials(res) == 1
    moduli = np.where(ball, contrast, 1.0), np.full(len(ball), poisson)
    found, _ = solve(mesh, *moduli, kind, held, exact, np.zeros_like(exact))
    chosen = np.flatnonzero(ball)
    q2 = element.basis(mesh, chosen)
    local = found.T.ravel()[element.element_dofs(mesh)[chosen]]
    error = np.einsum("ekdq,ed->keq", element.strains(q2, kind), local) - wanted[:, None, None]
    volume = element.weights(q2, kind)
    size = np.linalg.norm(wanted)
    assert np.linalg.norm((error * volume).sum(axis=(1, 2)) / volume.sum()) < 0.002 * size
    assert np.sqrt(((error**2).sum(axis=0) * volume).sum() / volume.sum()) < 0.01 * size


def test_a_singular_body_is_refused() -> None:
    """Nothing held: the factor says so instead of answering."""
    mesh = curved_square(2)
    matrices = element.stiffness(mesh, *uniform(mesh, 5.0, 0.3), "plane_strain")
    matrices[:, 0, 0] -= 1.0
    with pytest.raises(np.linalg.LinAlgError):
        element.Banded(matrices, element.element_dofs(mesh))
