"""What the camera sees: pixel rays in closed form, against rays that Mitsuba refracts."""

from __future__ import annotations

import dataclasses
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from sensors import HALF_MM, paper_sensor

from scenes import view
from scenes.sensor import Glass, Guide, Lower, Sensor

SENSORS = {
    "paper": paper_sensor(),
    "paper, coarse": paper_sensor(columns=96, rows=61, pixel_um=(67.2, 78.4)),
    "near and wide": paper_sensor(distance_mm=12.0, field_of_view_mm=24.0),
    "barrel": paper_sensor(distortion=(-0.4, 0.1), field_of_view_mm=20.0),
    "binned, cushion": paper_sensor(distortion=(0.3, 0.2), binning=2, field_of_view_mm=22.0),
    "square pixels, few": paper_sensor(columns=64, rows=48, pixel_um=(10.0, 10.0), field_of_view_mm=20.0),
}


@pytest.fixture(scope="module")
def mi(variant: str) -> ModuleType:
    import mitsuba

    return mitsuba


def load(sensor: Sensor) -> Any:
    from scenes import build
    from scenes.bsdf import Table

    return build.load_scene(sensor, Table.pack(build.optics_of(sensor)))


def through_the_glass(
    mi: ModuleType, sensor: Sensor, scene: Any, columns: np.ndarray, rows: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Follow camera rays through Mitsuba's faces: arrival points (n, 3), transmittance, radiance scale."""
    film = mi.Point2f(mi.Float(columns / sensor.camera.shape[1]), mi.Float(rows / sensor.camera.shape[0]))
    ray, _ = scene.sensors()[0].sample_ray(
        mi.Float(0.0), sample1=mi.Float(0.0), sample2=film, sample3=mi.Point2f(0.0)
    )
    shapes = {shape.id(): shape for shape in scene.shapes()}
    reflectances, scale = [], 1.0
    for name in ("glass_to_air", "guide_to_glass"):
        si = scene.ray_intersect(ray)
        assert np.all(np.asarray(si.shape == mi.ShapePtr(shapes[name])))
        # the number just below 1 always asks for the refracted ray
        sample, weight = si.bsdf().sample(mi.BSDFContext(), si, mi.Float(0.9999999), mi.Point2f(0.5))
        reflectances.append(1.0 - np.asarray(sample.pdf).astype(np.float64))
        scale = scale * np.asarray(weight[0])
        ray = si.spawn_ray(si.to_world(sample.wo))
    si = scene.ray_intersect(ray)
    assert np.all(np.asarray(si.shape == mi.ShapePtr(shapes["contact"])))
    lower, upper = reflectances
    return np.array(si.p).T, (1 - lower) * (1 - upper) / (1 - lower * upper), scale


@pytest.mark.parametrize("name", SENSORS)
def test_pixel_rays_arrive_where_mitsubas_refracted_rays_do(mi: ModuleType, name: str) -> None:
    sensor = SENSORS[name]
    rays, (rows_, columns_) = view.pixel_rays(sensor), sensor.camera.shape
    rng = np.random.default_rng(4)
    corners = np.array([[0, 0], [0, columns_ - 1], [rows_ - 1, 0], [rows_ - 1, columns_ - 1]])
    inside = np.column_stack([rng.integers(0, rows_, 300), rng.integers(0, columns_, 300)])
    row, column = np.concatenate([corners, inside]).T
    arrived, transmittance, scale = through_the_glass(mi, sensor, load(sensor), column + 0.5, row + 0.5)

    origin, direction = rays.origin_mm[row, column], rays.direction[row, column]
    np.testing.assert_allclose(np.linalg.norm(direction, axis=1), 1.0, atol=1e-12)
    expected = origin + direction * (-origin[:, 2:] / direction[:, 2:])
    error = np.abs(arrived - expected).max()
    print(f"{name}: arrival points differ by {1e3 * error:.3f} µm at most")
    assert error < 1e-3
    np.testing.assert_allclose(rays.transmittance[row, column], transmittance, atol=1e-4)
    np.testing.assert_allclose(scale, rays.radiance_scale, rtol=1e-5)  # étendue: radiance falls by 1/n²


@pytest.mark.parametrize("name", SENSORS)
def test_middle_row_is_exactly_as_wide_as_the_field_of_view(mi: ModuleType, name: str) -> None:
    sensor = SENSORS[name]
    camera = sensor.camera
    rows_, columns_ = camera.shape
    for column, edge in ((0.0, -0.5), (columns_ / 2, 0.0), (columns_, 0.5)):
        assert view_x(sensor, column) == pytest.approx(edge * camera.field_of_view_mm, abs=1e-9)
    inset = 1e-3 * columns_  # the very edge may miss a guide as wide as the field
    columns = np.array([inset, columns_ / 2, columns_ - inset])
    arrived, _, _ = through_the_glass(mi, sensor, load(sensor), columns, np.full(3, rows_ / 2))
    np.testing.assert_allclose(arrived[:, 0], [view_x(sensor, c) for c in columns], atol=1e-3)
    np.testing.assert_allclose(arrived[:, 1], 0.0, atol=1e-5)


def view_x(sensor: Sensor, column: float, row: float | None = None, axis: int = 0) -> float:
    """Where a picture coordinate lands on the undeformed surface, x or y, mm, by Snell's law per slab."""
    row = sensor.camera.shape[0] / 2 if row is None else row
    tangential = view.air_directions(sensor, np.array(column), np.array(row))
    across = float(np.hypot(tangential[0], tangential[1]))
    if across == 0.0:
        return 0.0
    slabs = [
        (sensor.camera.distance_mm, 1.0),
        (sensor.glass.thickness_mm, sensor.glass.refractive_index),
        (sensor.guide.thickness_mm, sensor.guide.refractive_index),
    ]
    reach = sum(thickness * np.tan(np.arcsin(across / index)) for thickness, index in slabs)
    return float(reach * tangential[axis] / across)


def test_picture_is_as_seen_from_the_specimen(mi: ModuleType) -> None:
    """Columns grow with +x, rows with -y."""
    sensor = SENSORS["paper"]
    camera = sensor.camera
    columns = np.array([100.5, 600.5, 384.0, 384.0])
    rows = np.array([246.0, 246.0, 40.5, 450.5])
    arrived, _, _ = through_the_glass(mi, sensor, load(sensor), columns, rows)
    left, right, top, bottom = arrived[:, :2]
    assert left[0] < -5 and right[0] > 5 and top[1] > 5 and bottom[1] < -5
    assert abs(left[1]) < 1e-5 and abs(top[0]) < 1e-5
    rays = view.pixel_rays(sensor)
    assert rays.direction.shape == rays.origin_mm.shape == (camera.rows, camera.columns, 3)
    assert np.all(np.diff(rays.direction[0, :, 0]) > 0) and np.all(np.diff(rays.direction[:, 0, 1]) < 0)


def test_picture_is_symmetric() -> None:
    rays = view.pixel_rays(SENSORS["paper"])
    mirrored = rays.origin_mm[::-1, ::-1] * [-1, -1, 1]
    np.testing.assert_allclose(mirrored, rays.origin_mm, atol=1e-12)
    np.testing.assert_allclose(rays.transmittance, rays.transmittance[::-1, ::-1], atol=1e-14)


def test_pixels_keep_their_shape() -> None:
    """One row is 9.8 / 8.4 of one column: everywhere in the tangents, on the surface in the middle."""
    sensor = SENSORS["paper"]
    camera = sensor.camera
    direction = view.air_directions(sensor, *np.meshgrid(np.arange(0, 768, 7.0), np.arange(0, 492, 5.0)))
    tangent = direction[..., :2] / direction[..., 2:]
    per_column = np.diff(tangent[..., 0], axis=1) / 7
    per_row = -np.diff(tangent[..., 1], axis=0) / 5
    np.testing.assert_allclose(per_column, per_column[0, 0], rtol=1e-10)  # rectilinear
    np.testing.assert_allclose(per_row, per_column[0, 0] * 9.8 / 8.4, rtol=1e-10)

    x = view_x(sensor, camera.columns / 2 + 1)
    y = view_x(sensor, camera.columns / 2, camera.rows / 2 - 1, axis=1)
    assert y / x == pytest.approx(9.8 / 8.4, rel=1e-6)


# The faces' reflectance


def with_indices(guide: float, glass: float) -> Sensor:
    paper = SENSORS["paper"]
    plain: dict[str, Any] = {name: getattr(paper, name) for name in ("leds", "camera", "skin", "tissue")}
    return Sensor(
        guide=Guide(width_mm=2 * HALF_MM, thickness_mm=10.0, refractive_index=guide),
        glass=Glass(refractive_index=glass),
        effective_modulus_kPa=paper.effective_modulus_kPa,
        **plain,
    )


def test_normal_incidence_is_the_textbook_stack() -> None:
    n1, n2 = 1.4336, 1.515
    r1, r2 = ((n1 - n2) / (n1 + n2)) ** 2, ((n2 - 1) / (n2 + 1)) ** 2
    expected = (r1 + r2 - 2 * r1 * r2) / (1 - r1 * r2)  # two faces, incoherent (Born & Wolf 1999)
    ours = view.faces_reflectance(with_indices(n1, n2), np.array(1.0))
    assert float(ours) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("glass", [1.40, 1.46, 1.515, 1.9])
def test_light_beyond_the_critical_angle_of_air_is_all_sent_back(glass: float) -> None:
    """Whatever the glass: sin(theta) > 1/n of the guide decides."""
    sensor = with_indices(1.4336, glass)
    critical = np.sqrt(1 - 1 / 1.4336**2)
    beyond = np.linspace(0.0, critical - 1e-9, 200)
    np.testing.assert_allclose(view.faces_reflectance(sensor, beyond), 1.0, atol=1e-12)
    below = view.faces_reflectance(sensor, np.linspace(critical + 1e-3, 1.0, 200))
    assert np.all(below < 1.0) and np.all(below > 0.0)
    assert float(view.faces_reflectance(sensor, np.array(critical + 1e-12))) == pytest.approx(1.0, abs=1e-4)


def test_glass_of_the_guides_index_leaves_one_face() -> None:
    """With no step between guide and glass, what is left is Fresnel's reflectance towards air."""
    n, cosine = 1.45, np.linspace(0.75, 1.0, 50)
    cos_air = np.sqrt(1 - n**2 * (1 - cosine**2))
    r_s = (n * cosine - cos_air) / (n * cosine + cos_air)
    r_p = (cosine - n * cos_air) / (cosine + n * cos_air)
    ours = view.faces_reflectance(with_indices(n, n), cosine)
    np.testing.assert_allclose(ours, 0.5 * (r_s**2 + r_p**2), rtol=1e-12)


@pytest.mark.parametrize("absorption", [0.0, 0.3])
def test_reflections_inside_the_glass_are_summed_to_the_last(absorption: float) -> None:
    """Followed one by one, at 30 degrees in the guide; through a glass that absorbs, too."""
    n1, n2 = 1.4336, 1.9
    cosine = np.cos(np.radians(30.0))
    cos2 = np.sqrt(1 - (n1 / n2) ** 2 * (1 - cosine**2))
    cos3 = np.sqrt(1 - n1**2 * (1 - cosine**2))

    def fresnel(a: float, cos_a: float, b: float, cos_b: float) -> float:
        s = (a * cos_a - b * cos_b) / (a * cos_a + b * cos_b)
        p = (b * cos_a - a * cos_b) / (b * cos_a + a * cos_b)
        return float(0.5 * (s**2 + p**2))

    r1, r2 = fresnel(n1, cosine, n2, cos2), fresnel(n2, cos2, 1.0, cos3)
    base = with_indices(n1, n2)
    sensor = dataclasses.replace(base, glass=dataclasses.replace(base.glass, absorption_per_mm=absorption))
    once = np.exp(-absorption * sensor.glass.thickness_mm / cos2)
    back, through, inside = r1, 0.0, 1.0 - r1
    for _ in range(60):
        through += inside * once * (1 - r2)
        back += inside * once**2 * r2 * (1 - r1)
        inside *= once**2 * r2 * r1
    assert float(view.faces_reflectance(sensor, np.array(cosine))) == pytest.approx(back, rel=1e-12)
    assert float(view.faces_transmittance(sensor, np.array(cosine))) == pytest.approx(through, rel=1e-12)

    outside, inside = r2, 1.0 - r2
    for _ in range(60):
        outside += inside * once**2 * r1 * (1 - r2)
        inside *= once**2 * r2 * r1
    found = view._outside(sensor, np.array(cos3), np.array(cosine))
    assert float(found) == pytest.approx(outside, rel=1e-12)


def looking_at_a_leaning_plane(
    sensor: Sensor, pressure_kPa: float, rays: view.PixelRays | None = None
) -> tuple[Any, view.PixelRays]:
    """What the camera sees of a contact surface at z = -0.2 + 0.01 x, and its rays."""
    from scenes import build, gather
    from scenes.bsdf import Table
    from scenes.surface import NODES, OpticalSurface
    from scenes.tissue import couple, tissue_optics

    optics = build.optics_of(sensor)
    coupling = couple(optics, tissue_optics(1.0, 0.02), sensor.guide.refractive_index, 1.40, 1.0)
    packed = Table.pack(optics, coupling)
    scene = build.load_scene(sensor, packed)
    line = np.linspace(-HALF_MM, HALF_MM, NODES)
    x, _ = np.meshgrid(line, line)
    plane = np.stack([0 * x, 0 * x, -0.2 + 0.01 * x], axis=-1)
    build.put_surface(scene, sensor, OpticalSurface(line, plane, pressure_kPa + 0 * x, 0 * x))
    rays = rays or view.pixel_rays(sensor)
    return gather.look(scene, sensor, Table(packed), coupling, rays), rays


@pytest.mark.parametrize("lower", [(), (Lower(3.0, 1.5), Lower(2.0, 1.41))], ids=["one", "three"])
def test_light_is_absorbed_on_its_way_to_the_camera(mi: ModuleType, lower: tuple[Lower, ...]) -> None:
    """Beer's law along the pixels' rays through glass, layers and guide to a raised, tilted plane; and along
    those that the lower faces have mirrored, which go through the guide three times."""

    def windows(guide_per_mm: float, glass_per_mm: float) -> tuple[np.ndarray, view.PixelRays]:
        base = paper_sensor(columns=48, rows=32, field_of_view_mm=20.0)
        guide = dataclasses.replace(base.guide, absorption_per_mm=guide_per_mm, lower=lower)
        glass = dataclasses.replace(base.glass, absorption_per_mm=glass_per_mm)
        sight, rays = looking_at_a_leaning_plane(dataclasses.replace(base, guide=guide, glass=glass), 0.0)
        return sight.windows.astype(float), rays

    clear, rays = windows(0.0, 0.0)
    n_sine = paper_sensor().guide.refractive_index * np.sqrt(1.0 - rays.direction[..., 2] ** 2)
    in_first = (-0.2 + rays.origin_mm @ (slope := np.array([0.01, 0.0, -1.0]))) / -(rays.direction @ slope)
    in_lower = sum(
        (one.thickness_mm / np.sqrt(1.0 - (n_sine / one.refractive_index) ** 2) for one in lower),
        np.zeros_like(n_sine),
    )
    in_glass = 2.0 / np.sqrt(1.0 - (n_sine / 1.515) ** 2)

    absorbed = windows(0.05, 0.0)[0] / clear
    np.testing.assert_allclose(absorbed[0], np.exp(-0.05 * (in_first + in_lower)), rtol=2e-4)
    # the plane leans, so that the three ways differ by some hundredths
    thrice = -np.log(absorbed[1]) / 0.05 / (3.0 * (in_first + in_lower))
    assert np.isfinite(thrice[8:-8, 12:-12]).all()
    np.testing.assert_allclose(thrice[8:-8, 12:-12], 1.0, atol=0.02)

    # what goes through the glass again after a reflection in it is a thousandth
    absorbed = windows(0.0, 0.1)[0] / clear
    np.testing.assert_allclose(absorbed[0], np.exp(-0.1 * in_glass), rtol=5e-4)
    assert np.all(absorbed[1] < 0.7 * absorbed[0])


def test_an_absorbing_guide_looks_the_same_again(mi: ModuleType) -> None:
    """What rays lose is worked out anew each time, and not taken from what they had before."""
    base = paper_sensor(columns=48, rows=32, field_of_view_mm=20.0)
    sensor = dataclasses.replace(base, guide=dataclasses.replace(base.guide, absorption_per_mm=0.05))
    rays = view.pixel_rays(sensor)
    first, again = (looking_at_a_leaning_plane(sensor, 0.0, rays)[0].windows for _ in range(2))
    np.testing.assert_array_equal(first, again)


def test_camera_looks_at_the_deformed_surface(mi: ModuleType) -> None:
    """`gather.look` on a raised, tilted plane: position = where the closed-form ray meets that plane."""
    sensor = paper_sensor(columns=48, rows=32, field_of_view_mm=20.0)
    sight, rays = looking_at_a_leaning_plane(sensor, 1.0)
    slope = np.array([0.01, 0.0, -1.0])
    t = -(-0.2 + rays.origin_mm @ slope) / (rays.direction @ slope)
    expected = (rays.origin_mm + t[..., None] * rays.direction)[..., :2]
    np.testing.assert_allclose(sight.position_mm, expected, atol=2e-4)


@pytest.mark.parametrize("name", ["paper, coarse", "near and wide"])
def test_followed_light_is_seen_where_the_pixels_look(mi: ModuleType, name: str) -> None:
    """Points of pixels' rays at heights about the face's are counted in those pixels; a rim that is pressed
    far down, and so looks larger than the picture, in none."""
    import drjit as dr

    from scenes import exact

    sensor = SENSORS[name]
    rays = view.pixel_rays(sensor)
    film = exact.Film.at(sensor, rays, 0.0)
    rows, columns = rays.transmittance.shape
    rng = np.random.default_rng(5)
    row, column = rng.integers(0, rows, 400), rng.integers(0, columns, 400)
    levels = [-1.0, -0.5, 0.2]
    which = rng.integers(0, len(levels), 400)
    height = np.array(levels)[which]
    origin, direction = rays.origin_mm[row, column], rays.direction[row, column]
    run = (height + sensor.guide.top_mm) / direction[:, 2]
    at = np.stack([*(origin + run[:, None] * direction)[:, :2].T, height])
    on_face = (np.abs(at[:2]) < HALF_MM).all(axis=0)
    places = mi.Point3f(*(mi.Float(part) for part in at.astype(np.float32)))
    seen = exact._View.of(film, sensor)
    seen.add(dr.zeros(mi.UInt32, 400), places, [dr.ones(mi.Float, 400)], mi.Bool(on_face))
    expected = np.zeros((rows, columns))
    areas = np.stack([exact.Film.at(sensor, rays, level).area_mm2 for level in levels])
    larger = (film.area_mm2 / areas)[which, row, column]  # a pixel sees less of what is nearer
    np.add.at(expected, (row[on_face], column[on_face]), larger[on_face])
    counted = seen.collected()[0, 0]
    assert np.abs(counted[expected == 0]).max(initial=0.0) == 0.0  # none lies a pixel off
    # the slope of rays over the face is taken from its middle: 1 % off from 12 mm, 0.1 % from the paper's 40
    off = 1.5e-2 if "near" in name else 2e-3
    assert counted[expected > 0] == pytest.approx(expected[expected > 0], rel=off)

    beyond = exact._View.of(film, sensor)
    edge = mi.Point3f(mi.Float(HALF_MM - 0.01), dr.linspace(mi.Float, -9.0, 9.0, 301), mi.Float(-0.5))
    if sensor.camera.field_of_view_mm > 2.0 * HALF_MM - 0.5:
        beyond.add(mi.UInt32(0), edge, [mi.Float(1.0)], mi.Bool(True))
        assert beyond.collected().sum() == 0.0
