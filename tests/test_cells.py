"""Maps on coarser and finer cells: which means are kept, and which light comes back."""

import numpy as np
import pytest

from scenes.cells import coarser, finer


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_means_are_kept(factor):
    maps = np.random.default_rng(0).uniform(1.0, 2.0, (3, 50, 50))
    assert coarser(finer(maps, 50 * factor, means=True), 50) == pytest.approx(maps, rel=1e-12)


@pytest.mark.parametrize("factor", [2, 4])
def test_light_that_was_linear_between_cells_comes_back(factor):
    """Traced light is: what is learned of its means is the same light again, beside the walls, too."""
    light = finer(np.random.default_rng(1).uniform(1.0, 2.0, (50, 50)), 50 * factor)
    assert finer(coarser(light, 50), 50 * factor, means=True) == pytest.approx(light, rel=1e-12)
    assert finer(coarser(light, 50), 50 * factor) != pytest.approx(light, rel=0.01)


def test_a_plane_stays_a_plane_inside():
    """Beside the walls, where there is no next cell, straight lines go on level."""
    plane = np.add.outer(np.arange(50.0), 2.0 * np.arange(50.0))
    fine = finer(plane, 100)[2:-2, 2:-2]
    assert np.diff(fine, axis=0) == pytest.approx(0.5) and np.diff(fine, axis=1) == pytest.approx(1.0)
