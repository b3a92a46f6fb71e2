"""The three numbers of a surface, against closed forms."""

from __future__ import annotations

import numpy as np
import pytest

import fem
from fem.surface import contact_surface


def surface_with(tared_mm: object, cells: int = 6, raw_mm: float = 0.0) -> object:
    x = np.linspace(-10, 10, 2 * cells + 1)
    surface = contact_surface(x, x)
    signal = np.asarray(tared_mm(surface.points[:, 0], surface.points[:, 1]))  # type: ignore[operator]
    surface.point_data["displacement"] = np.stack([0 * signal, 0 * signal, -signal - raw_mm], axis=1)
    surface.point_data["displacement_0"] = np.stack([0 * signal, 0 * signal, 0 * signal - raw_mm], axis=1)
    return surface


def test_paraboloid() -> None:
    """s = 10 µm - r²/10: integral and top exact (quadratic), area above 2 µm is pi * 80 mm²."""
    surface = surface_with(lambda x, y: 1e-3 * (10 - 0.1 * (x**2 + y**2)))
    tared = fem.scalars(surface, 2.0)["tared"]
    assert tared["max_mm"] == pytest.approx(10e-3, rel=1e-12)
    assert tared["total_mm3"] == pytest.approx(1e-3 * (10 * 400 - 0.1 * 2 * 400 * 100 / 3), rel=1e-12)
    assert tared["area_mm2"] == pytest.approx(np.pi * 80, rel=1e-3)


def test_raw_is_not_tared() -> None:
    surface = surface_with(lambda x, y: 0 * x + 1e-3, raw_mm=0.5)
    three = fem.scalars(surface, 2.0)
    assert three["raw"]["max_mm"] == pytest.approx(0.501)
    assert three["raw"]["area_mm2"] == pytest.approx(400)
    assert three["tared"]["total_mm3"] == pytest.approx(0.4)
    assert three["tared"]["area_mm2"] == 0


def test_a_maximum_between_nodes_is_found() -> None:
    """The quadratic field, not only its nodes, is searched; its top here lies between nodes."""
    surface = surface_with(lambda x, y: 1e-3 * (5 - (x - 0.4) ** 2 - (y + 0.3) ** 2), cells=4)
    assert fem.scalars(surface, 2.0)["tared"]["max_mm"] == pytest.approx(5e-3, abs=2e-5)


def test_half_plane_is_cut_within_elements() -> None:
    """A linear field's area above the threshold is exact to the subgrid's triangles."""
    surface = surface_with(lambda x, y: 1e-3 * (x + 0.37))
    assert fem.scalars(surface, 2.0)["tared"]["area_mm2"] == pytest.approx(20 * (10 - 1.63), rel=1e-9)
