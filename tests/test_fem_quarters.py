"""Plain tissue by quarters: loads answered as on the whole mesh; spheres on planes and beside them."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from test_fem_multipoles import PROBE, SLAB

import fem
from fem import spheres
from fem.meshed import build
from fem.operators import AtRest
from fem.operators import product as force_of
from fem.path import path
from fem.quarters import character, quarter_of, signs_of, whole, whole_force
from fem.solver import Factor
from fem.system import EVEN

PARITIES = list(product((False, True), repeat=2))


@pytest.mark.parametrize("sides", ["free", "symmetric"])
def test_four_quarters_answer_a_load_as_the_whole(sides: str) -> None:
    """A force on one node; displacements at its images and on the face, and forces there."""
    geometry, res = spheres._bare(PROBE, replace(SLAB, sides=sides)), spheres.QUALITIES["preview"].mesh
    models = [
        build(geometry, res, False, replace(geometry.layout(res), symmetric=half))
        for half in ((False, False), (True, True))
    ]
    force, found = np.array([0.3, -0.7, 1.0]), []
    full, part = models
    rests: list[AtRest] = [path(geometry, model, False).body.rest for model in models]
    inside = (part.place[: part.nodes.slab] > [1.0, 1.0, 3.0]).all(axis=1)
    inside &= (part.place[: part.nodes.slab] < [9.0, 9.0, 12.0]).all(axis=1)
    node = int(np.flatnonzero(inside)[0])
    at = int(np.linalg.norm(full.place[: full.nodes.slab] - part.place[node], axis=1).argmin())
    load = np.zeros_like(full.place)
    load[at] = force
    sys = full.system(np.ones(full.nodes.tip.shape, dtype=bool))
    moved = sys.expand(Factor(sys.tree, rests[0]).solve(sys.gather(load)))
    pushed = full.nodal(force_of(rests[0], moved, full))
    load = np.zeros_like(part.place)
    load[node] = force / 4
    tip, push = np.zeros((*full.nodes.tip.shape, 3)), np.zeros(full.nodes.tip.shape)
    images = {turn: np.zeros(3) for turn in PARITIES}
    for odd in PARITIES:
        quarter = quarter_of(part, rests[1], odd)
        values = quarter.factor.solve(quarter.system.gather(load))[:, None]
        seen = quarter.at(part.nodes.tip, values)[..., 0]
        tip += np.stack([whole(seen[..., a], odd, a) for a in range(3)], axis=-1)
        push += whole_force((quarter.reaction @ values[:, 0]).reshape(part.nodes.tip.shape), odd)
        for turn, image in images.items():
            image += character(odd, turn) * signs_of(turn) * quarter.at(np.array(node), values)[:, 0]
        found.append(np.abs(values).max())
    assert min(found) > 0.05 * max(found)
    for turn, image in images.items():
        place = signs_of(turn) * part.place[node]
        there = int(np.linalg.norm(full.place[: full.nodes.slab] - place, axis=1).argmin())
        np.testing.assert_allclose(image, moved[there], atol=1e-9 * np.abs(moved).max())
    np.testing.assert_allclose(tip, moved[full.nodes.tip], atol=1e-9 * np.abs(moved).max())
    top = np.abs(pushed[full.nodes.tip, 2]).max()
    np.testing.assert_allclose(push, pushed[full.nodes.tip, 2], atol=1e-6 * top)


def test_a_sphere_beside_a_plane_is_nearly_one_on_it() -> None:
    tissue = fem.multipoles(PROBE, SLAB, "preview")
    for on, beside in (((0.0, 0.0), (1e-7, 1e-7)), ((2.0, 0.0), (2.0, 1e-7))):
        balls = (fem.Inclusion(10, 5, 100, offset=offset) for offset in (on, beside))
        one, other = (tissue.press(ball, [1.0])[0].surface for ball in balls)
        for name in ("pressure", "displacement"):
            np.testing.assert_allclose(one[name], other[name], rtol=0, atol=1e-5 * np.abs(other[name]).max())


def test_only_the_parities_of_a_sphere_are_factored() -> None:
    tissue = fem.multipoles(PROBE, SLAB, "preview")
    for offset, count in (((0.0, 0.0), 1), ((2.0, 0.0), 2), ((0.0, -1.0), 3), ((2.0, -1.0), 4)):
        tissue.press(fem.Inclusion(10, 5, 100, offset=offset), [1.0])
        assert len(tissue._quarters) == count and EVEN in tissue._quarters
