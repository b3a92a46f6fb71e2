"""Material forces, and contact whose directions they tell."""

from __future__ import annotations

from dataclasses import replace

import ccx_runner
import numpy as np
import pytest

import fem
from fem import elasticity, mesh
from fem.equilibrium import State, _newton
from fem.material_forces import material_forces
from fem.mesh import Geometry
from fem.meshed import Model, build, moduli
from fem.path import path
from fem.quadrature import quadrature
from fem.solver import one_thread

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
GEOMETRY = Geometry(PROBE, fem.Slab(30, 60, 5), fem.Inclusion(10, 5, 100))
PREVIEW = mesh.QUALITIES["preview"]


@pytest.fixture(scope="module")
def model() -> Model:
    return build(GEOMETRY, PREVIEW, True)


def test_they_are_the_derivative_of_the_energy(model: Model) -> None:
    """By undeformed places, the deformed ones held; against central differences."""
    rng = np.random.default_rng(0)
    shear, bulk = moduli(GEOMETRY, model, True)
    moved, way = (scale * rng.normal(size=model.place.shape) for scale in (0.05, 1.0))
    there = model.place + moved

    def energy(step: float) -> float:
        place = model.place + step * way
        return elasticity.forces(quadrature(model.nodes.cells, place), there - place, shear, bulk)[1]

    found = material_forces(model.quad, model.place, moved, shear, bulk)
    slope = (energy(1e-4) - energy(-1e-4)) / 2e-4
    assert (model.nodal(found) * way).sum() == pytest.approx(slope, rel=1e-6)


def test_nothing_drives_nodes_of_an_even_strain(model: Model) -> None:
    """Under x = F X the energy depends on the body's outline alone: what nodes inside do to it cancels."""
    strain = np.array([[1.1, 0.2, 0.0], [0.0, 0.95, -0.1], [0.05, 0.0, 1.02]])
    shear, bulk = np.full(model.quad.size, 2.0), np.full(model.quad.size, 80.0)
    moved = model.place @ (strain - np.eye(3)).T
    found = model.nodal(material_forces(model.quad, model.place, moved, shear, bulk))
    outline = np.zeros(len(found), dtype=bool)
    for body in (slice(0, model.nodes.slab), slice(model.nodes.slab, None)):
        at = model.place[body]
        outline[body] = (np.isclose(at, at.min(axis=0)) | np.isclose(at, at.max(axis=0))).any(axis=1)
    assert np.abs(found[~outline]).max() < 1e-9 * np.abs(found).max()


def test_tissue_that_slid_gains_nothing_by_sliding_on() -> None:
    """Along the face the slab's material forces vanish but at the corners. By slopes of the probe's face, as
    at a start, they do not at its edge, and more energy is stored."""
    with one_thread():
        way = path(GEOMETRY, build(GEOMETRY, PREVIEW, True), False)
        body, state = way.body, way.to(2.0)
        model = replace(state.model)
        flat = state.tie.interface.slope(model.place + state.moved)
        other = _newton(body, replace(state, tie=replace(state.tie, slope=flat)), 1e-9, renew=False)

    def driven(state: State) -> float:
        found = model.nodal(material_forces(model.quad, model.place, state.moved, body.shear, body.bulk))
        drive = found[model.interface.slab][..., :2]
        drive[0, :, 0] = drive[:, 0, 1] = 0.0  # planes of symmetry
        return float(np.abs(drive[~model.interface.corners]).max() / state.force.max())

    assert driven(state) < 1e-3
    assert driven(other) > 2e-2


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_the_edge_is_right_on_few_cells(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a press of 2 mm, against cells that shrink to 0.1 mm towards the edge."""

    def scalars() -> np.ndarray:
        answer = fem.press(PROBE, GEOMETRY.slab, GEOMETRY.inclusion, 2.0, quality="preview", estimate=False)
        whole = ccx_runner.tared(answer.surface, False)["total_mm3"]
        middle = ccx_runner.tared(answer.surface, True)["max_mm"]
        return np.array([1e3 * middle, ccx_runner.total_within(answer.surface, 10.8), whole])

    usual = scalars()
    monkeypatch.setitem(mesh.QUALITIES, "preview", replace(PREVIEW, edge=4, growth=(0.4, 1.6)))
    fine = scalars()
    print(usual, fine, usual / fine - 1)
    assert (np.abs(usual / fine - 1) < (2e-3, 2e-3, 7e-3)).all()
