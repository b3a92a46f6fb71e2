"""Plain tissue's pressure on cells that shrink towards the probe's edge, with what finite strain changes."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

import fem
from fem import mesh
from fem.ground import _pressed, bare_geometry, carry, fine, ground, lines
from fem.topology import Resolution

PROBE = fem.Probe(25, (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156)))
BARE = bare_geometry(PROBE, fem.Slab(30, 60, 5))
PREVIEW = mesh.QUALITIES["preview"]
FINER = Resolution(5, 1, 2, 3, 1, edge=8, side=4, layer=4, backing=1, growth=(0.65, 1.6))
AT = np.linspace(-10.0, 10.0, 81)


def pressure(contact: object) -> np.ndarray:
    """On the square |x|, |y| <= 10 mm, (81, 81)."""
    return carry(np.asarray(contact["pressure"]), lines(contact), (AT, AT)).reshape(81, 81)  # type: ignore[index,arg-type]


def test_a_press_mesh_ripples_and_this_does_not() -> None:
    """Standard quality's own mesh and that of plain tissue, against a finer one."""
    standard = mesh.QUALITIES["standard"]
    (finer,) = _pressed(BARE, FINER, False, (1.0,))
    (own,) = _pressed(BARE, standard, False, (1.0,))
    (found,) = ground(BARE, standard, False, (1.0,))
    off = [100 * (pressure(one) / pressure(finer) - 1) for one in (own, found)]
    print(*(f"{np.sqrt((o**2).mean()):.2f} % rms, {np.abs(o).max():.2f} at worst" for o in off), sep="; ")
    assert np.abs(off[0]).max() > 2
    assert np.abs(off[1]).max() < 0.5
    middle = pressure(found)[40, 40:]
    assert (np.diff(middle) > -1e-5 * middle[0]).all()  # it rises towards the edge, all the way


def test_finite_strain_vanishes_with_the_press() -> None:
    """What it changes is of first order in the depth, and the force is pressure times area."""
    small = pressure(ground(BARE, PREVIEW, False, (1.0,))[0])
    levels = (0.05, 0.1, 0.4)
    found = ground(BARE, PREVIEW, True, levels)
    share = [pressure(one) / (level * small) - 1 for level, one in zip(levels, found, strict=True)]
    size = [float(np.abs(s).max()) for s in share]
    for (a, b), (low, high) in zip(pairwise(size), pairwise(levels), strict=True):
        assert b / a == pytest.approx(high / low, rel=0.1)
    for level, one in zip(levels, found, strict=True):
        (press,) = fem.press(PROBE, BARE.slab, None, [level], quality="preview", estimate=False)
        force = 1e-3 * float(np.asarray(one["pressure"]) @ np.asarray(one["area"]))
        assert force == pytest.approx(press.force_N, rel=5e-3)


@pytest.mark.slow
def test_finite_strain_on_the_same_cells_all_the_way() -> None:
    """The pressure of a mesh that shrinks towards the edge at finite strain, five times as long to solve."""
    (direct,) = _pressed(BARE, fine(PREVIEW), True, (2.0,))
    (found,) = ground(BARE, PREVIEW, True, (2.0,))
    off = 100 * (pressure(found) / pressure(direct) - 1)
    print(f"within 10 mm: {np.sqrt((off**2).mean()):.2f} % rms, {np.abs(off).max():.2f} at worst")
    assert np.sqrt((off**2).mean()) < 0.3


def test_deeper_presses_do_not_jump() -> None:
    """On either side of the depth from which cells shrink less, and whatever else is pressed beside it."""
    (lesser,), (one, more) = (ground(BARE, PREVIEW, True, levels) for levels in ((3.59,), (1.0, 3.61)))
    off = 100 * (pressure(more) / pressure(lesser) * 3.59 / 3.61 - 1)
    print(f"{off.min():.2f} to {off.max():.2f} %")
    assert np.abs(off).max() < 0.3
    assert np.array_equal(pressure(one), pressure(ground(BARE, PREVIEW, True, (1.0,))[0]))
