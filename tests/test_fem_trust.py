"""The estimate of the discretisation error against the true one: that against a finer mesh."""

from __future__ import annotations

import numpy as np
import pytest
from test_fem_convergence import REFINED

import fem
from fem.mesh import QUALITIES, Geometry
from fem.meshed import build
from fem.path import Path, path
from fem.topology import Resolution
from fem.trust import COARSER, discretisation_error, on_coarser, tared

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
SLAB = fem.Slab(30, 60, 5)
CASES = [(10, 5), (4, 6), (13, 4), (6, 8), (8, 3), (5, 10), (12, 8), (9, 12)]  # size, depth, mm


def pair(geometry: Geometry, res: Resolution) -> tuple[Path, Path]:
    model = build(geometry, res, False)
    bare = path(geometry, model, False)
    return path(geometry, model, True, bare), bare


@pytest.mark.slow
@pytest.mark.parametrize(("size", "depth"), CASES)
def test_estimate_is_near_the_true_error(size: float, depth: float) -> None:
    """Within 0.5 and 3 times the true error, both relative to the largest tared displacement."""
    geometry = Geometry(PROBE, SLAB, fem.Inclusion(size, depth, 100))
    exact = tared(geometry, *pair(geometry, REFINED))
    ratios = {}
    for quality in ("preview", "standard"):
        found = pair(geometry, QUALITIES[quality])
        true = 100 * np.abs(tared(geometry, *found) - exact).max() / np.abs(exact).max()
        (coarse,) = on_coarser([geometry], QUALITIES[quality])
        ratios[quality] = discretisation_error(geometry, coarse, *found) / true
        print(f"size {size} depth {depth} {quality}: true {true:.3f} %, ratio {ratios[quality]:.2f}")
    assert all(0.5 < ratio < 3 for ratio in ratios.values())


def test_every_quality_has_a_coarser_mesh() -> None:
    assert set(COARSER) == set(QUALITIES.values())


def test_nothing_to_see_has_no_error() -> None:
    answer = fem.press(PROBE, SLAB, None, 1.0, mechanics="linear", quality="preview")
    assert answer.error_percent == 0


def test_an_inclusion_of_tissue_has_no_error() -> None:
    same = fem.Inclusion(10, 5, SLAB.modulus_kPa, poisson=SLAB.poisson)
    answer = fem.press(PROBE, SLAB, same, 1.0, mechanics="linear", quality="preview")
    assert answer.error_percent == 0


def test_moduli_are_estimated_together_as_alone() -> None:
    """They share the coarser mesh and its press without inclusion."""
    ball, moduli = fem.Inclusion(9, 5, 60), (30.0, 90.0)
    together = fem.press_moduli(PROBE, SLAB, ball, moduli, [1.0], mechanics="linear", quality="preview")
    for modulus, (press,) in zip(moduli, together, strict=True):
        alone = fem.press(
            PROBE, SLAB, fem.Inclusion(9, 5, modulus), 1.0, mechanics="linear", quality="preview"
        )
        assert press.error_percent == pytest.approx(alone.error_percent, rel=1e-6) and press.error_percent > 0
