"""The contact surface as light meets it: resampled, triangulated, moved in the scene without reloading."""

from __future__ import annotations

from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.interpolate import LinearNDInterpolator
from sensors import HALF_MM, paper_sensor, pressed

from scenes.contact import contact_fraction
from scenes.surface import NODES, OpticalSurface, at, flat, heights, resample, triangulate, with_skirt

WIDTH = 2 * HALF_MM


def shaped(
    displacement: Any, pressure: Any = lambda x, y: 1.0 + 0.0 * x, nodes: int = NODES
) -> OpticalSurface:
    """An optical surface whose fields are functions of the undeformed x and y, mm."""
    line = np.linspace(-HALF_MM, HALF_MM, nodes)
    x, y = np.meshgrid(line, line)
    shift = np.stack([v + 0.0 * x for v in displacement(x, y)], axis=-1)
    return OpticalSurface(line, shift, pressure(x, y), 0 * x)


# Resampling


def test_linear_fields_are_resampled_exactly() -> None:
    surface = pressed(
        lambda x, y: 1.0 + 0.02 * x - 0.01 * y,
        lambda x, y: (0.004 * x + 0.001 * y, -0.002 * x, -0.05 + 0.003 * x + 0.002 * y),
        cells=20,
    )
    fine = resample(surface, WIDTH, nodes=77)
    x, y = np.meshgrid(fine.nodes_mm, fine.nodes_mm)
    expected = np.stack([0.004 * x + 0.001 * y, -0.002 * x, -0.05 + 0.003 * x + 0.002 * y], axis=-1)
    np.testing.assert_allclose(
        fine.displacement_mm, expected, atol=3e-7
    )  # iterated gradients: a third of a nm
    np.testing.assert_allclose(fine.pressure_kPa, 1.0 + 0.02 * x - 0.01 * y, atol=2e-6)
    assert fine.nodes_mm[0] == -HALF_MM and fine.nodes_mm[-1] == HALF_MM


def test_curved_fields_are_smooth_between_coarse_nodes() -> None:
    """A bump 4 mm wide on nodes 0.8 mm apart: 0.2 % of its height, five times better than flat facets."""

    def bump(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.exp(-(x**2 + y**2) / 32.0)

    errors, facets = [], []
    for cells in (15, 30, 60):
        surface = pressed(lambda x, y: bump(x, y), lambda x, y: (0.0, 0.0, -0.02 * bump(x, y)), cells=cells)
        fine = resample(surface, WIDTH, nodes=91)
        x, y = np.meshgrid(fine.nodes_mm, fine.nodes_mm)
        errors.append(np.abs(fine.pressure_kPa - bump(x, y)).max())
        flat_facets = LinearNDInterpolator(surface.points[:, :2], surface["pressure"])
        facets.append(np.nanmax(np.abs(flat_facets(x, y) - bump(x, y))))
    assert errors[1] < 2.5e-3
    assert np.all(np.diff(errors) < 0.0) and errors[2] < errors[0] / 10
    assert np.all(5 * np.array(errors) < facets)


def test_quadratic_fields_are_resampled_well() -> None:
    surface = pressed(lambda x, y: 1.0 + 0.0 * x, lambda x, y: (0.0, 0.0, -2e-4 * (x**2 + x * y)), cells=40)
    fine = resample(surface, WIDTH, nodes=97)
    x, y = np.meshgrid(fine.nodes_mm, fine.nodes_mm)
    error = np.abs(fine.displacement_mm[..., 2] + 2e-4 * (x**2 + x * y))
    assert error[10:-10, 10:-10].max() < 1e-5 and error.max() < 3e-5  # of 0.03 mm


def test_pressure_that_rises_at_the_edge_does_not_ring_and_keeps_its_force() -> None:
    """p = 1 + s^-0.4 at the distance s from the edge, where nodes carry the load of the last cell."""
    line = np.linspace(-HALF_MM, HALF_MM, 25)
    cell = line[2] - line[0]
    load = 1.0 + cell**-0.4 / 0.6  # mean over the last cell
    inner = [1.0 + (HALF_MM - np.abs(at)) ** -0.4 for at in (line[1], line[2])]
    value = 6.0 * load - 4.0 * inner[0] - inner[1]
    distance = np.maximum(HALF_MM - np.abs(line), 1e-9)
    along = np.where(distance < 1e-6, value, 1.0 + distance**-0.4)
    surface = pressed(lambda x, y: 1.0 + 0.0 * x, lambda x, y: (0.0, 0.0, 0.0), cells=24)
    at_node = np.abs(np.asarray(surface.points)[:, :1] - line).argmin(axis=1)
    surface.point_data["pressure"] = along[at_node]
    fine = resample(surface, WIDTH, nodes=601)
    across, x = fine.pressure_kPa[300], fine.nodes_mm
    np.testing.assert_allclose(fine.pressure_kPa, np.broadcast_to(across, (601, 601)), rtol=1e-12)
    inside = np.abs(x) < HALF_MM - cell
    true = 1.0 + (HALF_MM - np.abs(x[inside])) ** -0.4
    assert np.abs(across[inside] / true - 1.0).max() < 0.003  # a plain spline: 0.009
    simpson = np.tile([2.0, 4.0], 13)[:25]
    simpson[[0, -1]] = 1.0
    force = simpson @ along * cell / 6.0
    assert np.trapezoid(across, x) == pytest.approx(force, rel=2e-3)


def test_suffix_selects_the_press_without_inclusion() -> None:
    surface = pressed(lambda x, y: 2.0 + 0.0 * x, lambda x, y: (0.0, 0.0, -0.1))
    surface.point_data["pressure_0"] = np.full(surface.n_points, 1.5)
    surface.point_data["displacement_0"] = np.full((surface.n_points, 3), -0.03)
    fine = resample(surface, WIDTH, suffix="_0", nodes=17)
    np.testing.assert_allclose(fine.pressure_kPa, 1.5)
    np.testing.assert_allclose(fine.displacement_mm, -0.03)


def test_surfaces_without_fields_or_of_another_size_are_refused() -> None:
    surface = pressed(lambda x, y: 1.0 + 0.0 * x, lambda x, y: (0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"surface: received .*'pressure'.*; allowed: .*'displacement_0'"):
        resample(surface, WIDTH, suffix="_0")
    with pytest.raises(ValueError, match=r"surface: received points up to .* allowed 15"):
        resample(surface, 30.0)


# Triangles


def test_flat_surface_is_the_guides_face_seen_from_the_guide() -> None:
    mesh = triangulate(flat(WIDTH, 1.0))
    assert mesh.area == pytest.approx((WIDTH + 2 * 2e-3) ** 2, rel=1e-9)  # the lip of 2 µm around
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, -1]] * len(mesh.faces), atol=1e-12)
    assert len(mesh.vertices) == (193 + 2) ** 2


def test_area_of_a_deformed_surface_is_that_of_the_deformed_plane() -> None:
    slope = 0.02
    mesh = triangulate(shaped(lambda x, y: (0.0, 0.0, slope * x)))
    inner = WIDTH**2 * np.sqrt(1 + slope**2)
    assert mesh.area == pytest.approx(inner, rel=5e-4)  # the lip, flat, adds 3e-4
    expected = np.array([slope, 0.0, -1.0]) / np.sqrt(1 + slope**2)
    middle = np.all(np.abs(mesh.triangles_center[:, :2]) < HALF_MM - 0.3, axis=1)
    np.testing.assert_allclose(mesh.face_normals[middle], np.tile(expected, (middle.sum(), 1)), atol=1e-9)


DEFORMATIONS = {
    "outward bulge of 0.2 mm": lambda x, y: (0.2 * x / HALF_MM, 0.2 * y / HALF_MM, -0.05 + 0.002 * x),
    "outward bulge by the sides only": lambda x, y: (
        0.2 * np.sign(x) * np.abs(x / HALF_MM) ** 20,
        0.2 * np.sign(y) * np.abs(y / HALF_MM) ** 20,
        0.1 * np.abs(x / HALF_MM) ** 20,
    ),
    "inward retreat of 0.2 mm": lambda x, y: (-0.2 * x / HALF_MM, -0.2 * y / HALF_MM, -0.05),
    "shift to one side": lambda x, y: (0.15, -0.15, 0.01 * np.sin(x)),
}


@pytest.mark.parametrize("name", DEFORMATIONS)
def test_mesh_stays_whole_and_within_the_lip(name: str) -> None:
    """The side walls are flat: what bulges is pressed back, what recedes is bridged; no triangle collapses.

    Judged in single precision, which is what the scene holds.
    """
    mesh = triangulate(shaped(DEFORMATIONS[name]))
    vertices = np.asarray(mesh.vertices, dtype=np.float32).astype(np.float64)
    a, b, c = (vertices[mesh.faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    assert np.all(normal[:, 2] < 0.0)  # towards the guide, none folded over
    assert np.abs(vertices[:, :2]).max() == pytest.approx(HALF_MM + 2e-3, abs=1e-6)
    for axis in (0, 1):  # the rim is closed all round, so that no light slips out
        assert np.sum(np.abs(vertices[:, axis]) > HALF_MM) >= 2 * 195
    covered = 0.5 * np.abs(normal[:, 2]).sum()
    assert covered == pytest.approx(
        (WIDTH + 4e-3) ** 2, rel=1e-6
    )  # a graph over the face: no hole, no overlap


@pytest.mark.parametrize("name", DEFORMATIONS)
def test_vertex_normals_are_unit_vectors_towards_the_guide(name: str) -> None:
    normals = triangulate(shaped(DEFORMATIONS[name])).vertex_normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0, atol=1e-9)
    assert np.all(normals[:, 2] < 0.0)


def test_vertex_normals_are_those_of_the_surface_up_to_the_rim() -> None:
    """Of a paraboloid in closed form; where it bulges beyond a wall, those where it passes it."""
    for bulge in (0.0, 0.1, -0.1):
        mesh = triangulate(shaped(lambda x, y, b=bulge: (b * x / HALF_MM, 0.0, -(x**2 + y**2) / 300.0)))
        line = np.pad(np.linspace(-HALF_MM, HALF_MM, 193), 1, mode="edge")
        x, y = (v.ravel() for v in np.meshgrid(line, line))
        within = HALF_MM / (1.0 + max(bulge, 0.0) / HALF_MM)
        slopes = np.clip(x, -within, within) / 150.0 / (1.0 + bulge / HALF_MM), y / 150.0
        expected = np.column_stack([-slopes[0], -slopes[1], -np.ones_like(x)])
        expected /= np.linalg.norm(expected, axis=1, keepdims=True)
        np.testing.assert_allclose(mesh.vertex_normals, expected, rtol=0, atol=1e-6)


def test_a_bulging_rim_is_cut_off_where_it_passes_the_wall() -> None:
    """Heights and pressures of vertices are those of the surface there, however the nodes lie about the wall;
    were nodes beyond it only pressed back, they would be 0.02 to 0.06 mm too low there, the last facet the
    steeper the nearer the next node is to the wall."""
    for bulge in (0.12, 0.25, 0.259, 0.262, 0.4):  # nodes are 0.13 mm apart
        surface = shaped(
            lambda x, y, b=bulge: (b * (x / HALF_MM) ** 9, 0.0, -0.3 * (x / HALF_MM) ** 8),
            pressure=lambda x, y: 1.0 + (x / HALF_MM) ** 8,
        )
        vertices = triangulate(surface).vertices
        fine = np.linspace(-HALF_MM, HALF_MM, 20_001)
        along = fine + bulge * (fine / HALF_MM) ** 9
        wanted = np.interp(np.clip(vertices[:, 0], -HALF_MM, HALF_MM), along, (fine / HALF_MM) ** 8)
        np.testing.assert_allclose(vertices[:, 2], -0.3 * wanted, atol=5e-4)
        np.testing.assert_allclose(with_skirt(surface, surface.pressure_kPa), 1.0 + wanted, atol=2e-3)


def test_values_on_vertices_follow_the_vertices() -> None:
    surface = shaped(lambda x, y: (0.0, 0.0, 0.0), pressure=lambda x, y: 1.0 + 0.02 * x + 0.03 * y)
    vertices = np.clip(triangulate(surface).vertices, -HALF_MM, HALF_MM)
    values = with_skirt(surface, surface.pressure_kPa)
    np.testing.assert_allclose(values, 1.0 + 0.02 * vertices[:, 0] + 0.03 * vertices[:, 1], atol=1e-4)


# Looking fields up at deformed positions


def test_inverse_mapping_is_exact_for_an_affine_displacement() -> None:
    """x' = A x + b with 2 % strain; pressure and height linear in x come back at x'."""
    a, b = np.array([[1.015, 0.004], [-0.003, 1.02]]), np.array([0.03, -0.02])

    def displacement(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, ...]:
        return a[0, 0] * x + a[0, 1] * y + b[0] - x, a[1, 0] * x + a[1, 1] * y + b[1] - y, -0.05 + 0.002 * x

    surface = shaped(displacement, pressure=lambda x, y: 1.0 + 0.02 * x - 0.03 * y)
    undeformed = np.random.default_rng(7).uniform(-0.97 * HALF_MM, 0.97 * HALF_MM, (500, 2))
    deformed = (undeformed @ a.T + b).astype(np.float32)
    pressure, height = at(surface, deformed)
    x, y = undeformed.T
    np.testing.assert_allclose(pressure, 1.0 + 0.02 * x - 0.03 * y, atol=1e-6)
    np.testing.assert_allclose(height, -0.05 + 0.002 * x, atol=1e-6)


def test_at_keeps_the_shape_of_the_positions_and_holds_the_rim() -> None:
    surface = shaped(lambda x, y: (-0.05 * x / HALF_MM, 0.0, -0.1), pressure=lambda x, y: 2.0 + 0.0 * x)
    pressure, height = at(surface, np.full((3, 5, 2), HALF_MM, dtype=np.float32))  # beyond the receded edge
    assert pressure.shape == height.shape == (3, 5)
    np.testing.assert_allclose(pressure, 2.0)
    np.testing.assert_allclose(height, -0.1)


def test_heights_are_indexed_rows_along_y() -> None:
    surface = shaped(lambda x, y: (0.0, 0.0, 0.01 * x + 0.03 * y))
    line = np.array([-5.0, 0.0, 5.0])
    np.testing.assert_allclose(heights(surface, line), 0.01 * line + 0.03 * line[:, None], atol=1e-6)


# In the scene


@pytest.fixture(scope="module")
def mi(variant: str) -> ModuleType:
    import mitsuba

    return mitsuba


@pytest.fixture(scope="module")
def scene(mi: ModuleType) -> Any:
    from scenes import build
    from scenes.bsdf import Table

    sensor = paper_sensor()
    return build.load_scene(sensor, Table.pack(build.optics_of(sensor)))


def shoot(mi: ModuleType, scene: Any, count: int = 2000) -> tuple[np.ndarray, np.ndarray, Any]:
    """Slanted rays from inside the guide to the contact surface: origins (n, 3), directions (n, 3), hits."""
    rng = np.random.default_rng(9)
    origin = np.column_stack([rng.uniform(-9, 9, (count, 2)), np.full(count, -4.0)]).astype(np.float32)
    direction = np.column_stack([rng.uniform(-0.5, 0.5, (count, 2)), np.ones(count)])
    direction = (direction / np.linalg.norm(direction, axis=1, keepdims=True)).astype(np.float32)
    ray = mi.Ray3f(mi.Point3f(*origin.T), mi.Vector3f(*direction.T))
    return origin.astype(np.float64), direction.astype(np.float64), scene.ray_intersect(ray)


PLANES = [(-0.05, 0.004, -0.002), (0.08, 0.0, 0.003), (0.0, 0.0, 0.0)]


def test_surface_moves_in_place_to_the_displaced_plane(mi: ModuleType, scene: Any) -> None:
    """Rays meet the plane z = c + s_x x + s_y y where geometry says, each time, in the same scene."""
    from scenes import build

    sensor = paper_sensor()
    shapes = {shape.id(): shape for shape in scene.shapes()}
    for c, s_x, s_y in PLANES:
        build.put_surface(
            scene, sensor, shaped(lambda x, y, c=c, s=(s_x, s_y): (0.0, 0.0, c + s[0] * x + s[1] * y))
        )
        origin, direction, si = shoot(mi, scene)
        slope = np.array([s_x, s_y, -1.0])
        expected = -(c + origin @ slope) / (direction @ slope)
        np.testing.assert_allclose(np.asarray(si.t), expected, atol=2e-5)
        assert np.all(np.asarray(si.shape == mi.ShapePtr(shapes["contact"])))
        normal = slope / np.linalg.norm(slope)
        for ours in (np.array(si.n), np.array(si.sh_frame.n)):
            np.testing.assert_allclose(ours.T, np.tile(normal, (len(origin), 1)), atol=2e-4)
    assert {shape.id(): shape for shape in scene.shapes()} == shapes


def test_sideways_displacement_carries_pressure_along(mi: ModuleType, scene: Any) -> None:
    from scenes import build

    sensor = paper_sensor()
    surface = shaped(lambda x, y: (0.1 * x / HALF_MM, 0.0, -0.05), pressure=lambda x, y: 1.0 + 0.05 * x)
    build.put_surface(scene, sensor, surface)
    _, _, si = shoot(mi, scene)
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    ours = np.asarray(contact.eval_attribute_1("vertex_contact_fraction", si))
    undeformed = np.asarray(si.p.x).astype(np.float64) / (1 + 0.1 / HALF_MM)
    skin = sensor.skin
    expected = contact_fraction(
        1.0 + 0.05 * undeformed, sensor.effective_modulus_kPa, skin.rms_slope, skin.kappa
    )
    np.testing.assert_allclose(ours, expected, atol=1e-5)


@pytest.mark.parametrize("name", DEFORMATIONS)
def test_contact_is_known_to_the_very_rim(mi: ModuleType, scene: Any, name: str) -> None:
    """Where the rim is pressed back its triangles are 0.1 µm wide: enough for single precision."""
    from scenes import build

    sensor = paper_sensor()
    build.put_surface(scene, sensor, shaped(DEFORMATIONS[name], pressure=lambda x, y: 0.9 + 0.02 * (x + y)))
    rng = np.random.default_rng(10)
    across, along = rng.uniform(0.0, 1.99e-3, 200_000) + HALF_MM, rng.uniform(-12.0, 12.0, 200_000)
    for x, y in ((across, along), (-across, along), (along, across), (along, -across)):
        # from within the lip, above the walls' lower end and below the surface
        origin = mi.Point3f(mi.Float(x), mi.Float(y), mi.Float(-0.5))
        si = scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(0, 0, 1)))
        contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
        hit = np.asarray(si.shape == mi.ShapePtr(contact))
        assert hit.mean() > 0.99
        fraction = np.asarray(contact.eval_attribute_1("vertex_contact_fraction", si))[hit]
        skin = sensor.skin
        pressure = 0.9 + 0.02 * (np.asarray(si.p.x) + np.asarray(si.p.y))[hit]
        expected = contact_fraction(pressure, sensor.effective_modulus_kPa, skin.rms_slope, skin.kappa)
        assert np.all(np.isfinite(fraction))
        np.testing.assert_allclose(fraction, expected, atol=0.01 * expected.max())


def test_updating_many_times_costs_no_reload(mi: ModuleType, scene: Any) -> None:
    """The mesh keeps its buffers' sizes and its place in the scene over many presses."""
    from scenes import build

    sensor = paper_sensor()
    before = len(mi.traverse(scene)["contact.vertex_positions"])
    for depth in np.linspace(0.0, 0.1, 5):
        build.put_surface(scene, sensor, shaped(lambda x, y, d=depth: (0.0, 0.0, -d)))
        origin, direction, si = shoot(mi, scene, 100)
        np.testing.assert_allclose(np.asarray(si.t), (-depth - origin[:, 2]) / direction[:, 2], atol=1e-5)
    assert len(mi.traverse(scene)["contact.vertex_positions"]) == before


def test_surface_of_another_grid_is_refused(scene: Any) -> None:
    from scenes import build

    with pytest.raises(ValueError, match=r"deformed: received 97 nodes per side; allowed 193"):
        build.put_surface(scene, paper_sensor(), flat(WIDTH, 1.0, nodes=97))
