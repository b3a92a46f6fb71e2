"""Eshelby (1957): a stiff sphere in uniformly strained matter is itself strained uniformly, in closed form.

The exact outer displacement (Mura 1987, eq. 11.30) is prescribed on the faces of the very mesh that presses
use, so the block's finite size does not matter.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from fem import elasticity, mesh, solver
from fem.model import Inclusion, Layer, Probe, Slab
from fem.quadrature import quadrature
from fem.topology import Layout, Resolution, materials

Floats = NDArray[np.float64]


def eshelby(far: Floats, contrast: float, poisson: float, poisson_in: float) -> tuple[Floats, Floats]:
    """Strain inside and equivalent eigenstrain (both 3 x 3) for the far strain; moduli over the matrix's."""
    (mu,), (bulk,) = elasticity.lame(np.array([1.0]), np.array([poisson]))
    (mu_in,), (bulk_in,) = elasticity.lame(np.array([contrast]), np.array([poisson_in]))
    alpha = (1 + poisson) / (3 * (1 - poisson))  # Eshelby's tensor of the sphere: volume
    beta = 2 * (4 - 5 * poisson) / (15 * (1 - poisson))  # and shape
    volume = np.trace(far) / 3 * np.eye(3)
    shape = far - volume
    volume_in = volume / (1 + alpha * (bulk_in / bulk - 1))
    shape_in = shape / (1 + beta * (mu_in / mu - 1))
    return volume_in + shape_in, (volume_in - volume) / alpha + (shape_in - shape) / beta


def outer_displacement(x: Floats, far: Floats, eigen: Floats, radius: float, poisson: float) -> Floats:
    """Displacement (3, n) at x (3, n) outside the sphere: Mura 1987, eq. 11.30, with its potentials."""
    r = np.linalg.norm(x, axis=0)
    one = np.eye(3)
    mixed = (
        np.einsum("ij,kn->ijkn", one, x) + np.einsum("ik,jn->ijkn", one, x) + np.einsum("jk,in->ijkn", one, x)
    )
    cube = np.einsum("in,jn,kn->ijkn", x, x, x)
    third_of_r = -mixed / r**3 + 3 * cube / r**5
    third_of_inverse = 3 * mixed / r**5 - 15 * cube / r**7
    size = 4 * np.pi * radius**3 / 3
    psi = size * (third_of_r + radius**2 / 5 * third_of_inverse)
    phi = -size * x / r**3
    disturbed = (
        np.einsum("ijkn,jk->in", psi, eigen)
        - 2 * poisson * np.trace(eigen) * phi
        - 4 * (1 - poisson) * (eigen @ phi)
    )
    return far @ x + disturbed / (8 * np.pi * (1 - poisson))


CASES = [  # contrast, Poisson's ratio, far strain
    (20.0, 0.49, (-0.5, -0.5, 1.0)),
    (20.0, 0.4999, (-0.5, -0.5, 1.0)),
    (20.0, 0.4999, (1.0, -0.7, -0.3)),
    (20.0, 0.3, (0.2, -0.1, 1.0)),
    (0.1, 0.45, (0.0, 0.0, 1.0)),
]


def relative_error(
    contrast: float, poisson: float, far: tuple[float, ...], res: Resolution
) -> tuple[Floats, Floats, float]:
    """Error of the strain in the sphere (3, 3, elements, points), its weights, size of the exact strain."""
    slab, probe = Slab(8.0, 9.0, 1.0), Probe(8.0, (Layer(1.0, 1.0),))
    ball = Inclusion(2.0, 3.0, contrast)
    layout = Layout(res, 1)
    block = mesh.morph_slab(layout, mesh.Geometry(probe, slab, ball))
    inside = materials(layout)[: block.t.shape[1]] == 1
    quad = quadrature(block.dofs.element_dofs.T, block.doflocs.T)
    strain_far = np.diag(far)
    strain_in, eigen = eshelby(strain_far, contrast, poisson, poisson)

    place = block.doflocs - np.array([[0.0], [0.0], [ball.centre_mm]])
    held = np.zeros_like(place, dtype=bool)
    held[:, (place[0] > 4.5 - 1e-9) | (place[1] > 4.5 - 1e-9) | (np.abs(place[2]) > 4 - 1e-9)] = True
    exact = np.zeros_like(place)
    exact[:, held[0]] = outer_displacement(place[:, held[0]], strain_far, eigen, 1.0, poisson)
    held[0, place[0] < 1e-9] = held[1, place[1] < 1e-9] = True  # symmetry planes

    matrices = elasticity.stiffness(
        quad, *elasticity.lame(np.where(inside, contrast, 1.0), np.full(len(inside), poisson))
    )
    local, fixed = (3 * quad.nodes[:, :, None] + np.arange(3)).reshape(quad.size, -1), held.T.ravel()
    number = np.where(fixed, -1, np.cumsum(~fixed) - 1)
    full = np.where(fixed, exact.T.ravel(), 0.0)
    force = (matrices @ full[local][:, :, None])[:, :, 0]
    load = -np.bincount(local.ravel(), weights=force.ravel(), minlength=len(full))[~fixed]
    tree = solver.plan(number[local], block.p[:, block.t].mean(axis=1).T)
    full[~fixed] = solver.Factor(tree, matrices).solve(load)

    within = np.flatnonzero(inside)
    part = quad.part(within)
    gradient = elasticity.slopes(part, full.reshape(-1, 3)).transpose(2, 3, 0, 1)
    strain = (gradient + np.swapaxes(gradient, 0, 1)) / 2
    return (
        strain - strain_in[:, :, None, None],
        part.weight / part.weight.sum(),
        float(np.linalg.norm(strain_in)),
    )


@pytest.mark.parametrize(("contrast", "poisson", "far"), CASES)
def test_strain_in_the_sphere_at_standard_quality(
    contrast: float, poisson: float, far: tuple[float, ...]
) -> None:
    """Mean within 0.5 %, root mean square deviation within 2 %, on the mesh that presses use."""
    res = replace(mesh.QUALITIES["standard"], side=1, edge=1, above=1)
    error, weight, size = relative_error(contrast, poisson, far, res)
    assert np.linalg.norm((error * weight).sum(axis=(2, 3))) < 0.005 * size
    assert np.sqrt(((error**2).sum(axis=(0, 1)) * weight).sum()) < 0.02 * size


@pytest.mark.parametrize(("contrast", "poisson", "far"), CASES[1:2])
def test_strain_is_uniform_everywhere_on_a_finer_mesh(
    contrast: float, poisson: float, far: tuple[float, ...]
) -> None:
    """At every point within 2 %, though the strain in the matrix beside it is up to ten times larger."""
    res = Resolution(arc=5, core=2, shell=7, above=1, below=1, edge=1, side=1, layer=1, backing=1)
    error, _, size = relative_error(contrast, poisson, far, res)
    assert np.linalg.norm(error, axis=(0, 1)).max() < 0.02 * size
