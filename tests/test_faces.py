"""Where rays meet the sensor and how polished faces turn them, against Mitsuba on the same scene."""

from typing import Any

import numpy as np
import pytest
from sensors import HALF_MM, bump, paper_sensor

RAYS = 2**17


@pytest.fixture(scope="module")
def met(variant: str) -> dict[str, Any]:
    """Rays from all over the sensor, in all directions, and both answers to them."""
    import drjit as dr
    import mitsuba as mi

    from scenes import Renderer, build, faces, surface

    sensor = paper_sensor("embedded")
    scene = Renderer(sensor, "cpu").scene
    build.put_surface(scene, sensor, surface.resample(bump(), sensor.guide.width_mm))
    random = mi.PCG32(size=RAYS, initstate=3)
    place = [random.next_float32() for _ in range(3)]
    cosine, (s, c) = 2.0 * random.next_float32() - 1.0, dr.sincos(dr.two_pi * random.next_float32())
    sine = dr.sqrt(1.0 - dr.square(cosine))
    origin = mi.Point3f((place[0] - 0.5) * 28.0, (place[1] - 0.5) * 28.0, place[2] * 14.0 - 13.0)
    ray = mi.Ray3f(origin, mi.Vector3f(sine * c, sine * s, cosine))
    sample = random.next_float32()
    found = faces.Faces(scene, sensor)
    ours, stock = found.meet(ray, mi.Bool(True)), scene.ray_intersect(ray)
    context = mi.BSDFContext(mi.TransportMode.Importance)
    turned, weight = stock.bsdf(ray).sample(context, stock, sample, mi.Point2f(0.3, 0.7), stock.is_valid())
    ids = {shape.id(): np.array(stock.shape == mi.ShapePtr(shape)) for shape in scene.shapes()}
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    kind = np.array(ours.kind)
    return {
        "faces": faces,
        "kind": kind,
        "beside": np.any(np.abs(np.array(stock.p)[:2]) > HALF_MM, axis=0),
        "ids": ids,
        "valid": np.array(stock.is_valid()),
        "discs": kind == faces.LED,
        "ours": [np.array(a) for a in (ours.p, ours.n, ours.normal, ours.cosine, ours.t)],
        "stock": [
            np.array(a) for a in (stock.p, stock.n, stock.sh_frame.n, mi.Frame3f.cos_theta(stock.wi), stock.t)
        ],
        "fraction": np.array(ours.fraction),
        "stock_fraction": np.array(
            contact.eval_attribute_1("vertex_contact_fraction", stock, ours.kind == faces.CONTACT)
        ),
        "turned": np.array(found.polished(ours, sample)),
        "stock_turned": np.array(stock.to_world(turned.wo)),
        "weight": np.array(weight[0]),
        "start": np.array(ours.leaving(ours.mirrored).o),
        "stock_start": np.array(stock.spawn_ray(ours.mirrored).o),
    }


def test_every_ray_meets_the_face_that_mitsuba_meets(met: dict[str, Any]) -> None:
    """But for the lip, which light meets from beside the guide alone."""
    faces, kind, valid = met["faces"], met["kind"], met["valid"]
    lip = met["ids"]["contact"] & valid & met["beside"]
    assert np.all(kind[lip] == faces.NOTHING) and lip.sum() < 1e-4 * valid.sum()
    valid = valid & ~lip
    assert np.array_equal(kind != faces.NOTHING, valid)
    wanted = {"contact": faces.CONTACT, "guide": faces.TO_GLASS, "glass": faces.TO_AIR}
    wanted |= {"wall": faces.WALL, "rim": faces.RIM, "led": faces.LED}
    for name, here in met["ids"].items():
        expected = wanted[name.split("_")[0]]
        assert np.all(kind[here & valid] == expected), name
        assert (here & valid).any(), name


def test_light_from_beside_the_guide_passes_the_lip_by(variant: str) -> None:
    """Straight up 1 µm beside the wall Mitsuba meets the contact mesh, and 1 µm before it both do."""
    import mitsuba as mi

    from scenes import Renderer, build, faces, surface

    sensor = paper_sensor("air")
    scene = Renderer(sensor, "cpu").scene
    build.put_surface(scene, sensor, surface.resample(bump(), sensor.guide.width_mm))
    x = mi.Float([HALF_MM + 1e-3, -HALF_MM - 1e-3, HALF_MM - 1e-3, 1e-3 - HALF_MM])
    ray = mi.Ray3f(mi.Point3f(x, 1.3, -1.0), mi.Vector3f(0.0, 0.0, 1.0))
    stock, ours = scene.ray_intersect(ray), faces.Faces(scene, sensor).meet(ray, mi.Bool(True))
    contact = next(shape for shape in scene.shapes() if shape.id() == "contact")
    assert np.array(stock.is_valid() & (stock.shape == mi.ShapePtr(contact))).all()
    assert np.array(ours.kind).tolist() == [faces.NOTHING] * 2 + [faces.CONTACT] * 2


def test_points_normals_and_contact_fraction_are_mitsubas(met: dict[str, Any]) -> None:
    there = met["valid"] & ~met["discs"]  # an LED's normal is not needed: light ends there
    for ours, stock, limit in zip(met["ours"], met["stock"], (3e-5, 1e-6, 1e-6, 1e-6, 0.0), strict=True):
        assert np.abs(ours - stock)[..., there].max() <= limit
    on = met["kind"] == met["faces"].CONTACT
    assert np.abs(met["fraction"] - met["stock_fraction"])[on].max() < 2e-6
    assert met["fraction"][on].max() > 0.05
    assert np.abs(met["start"] - met["stock_start"])[:, there].max() < 3e-5
    assert np.abs(met["start"][:, there]).max() < 2 * HALF_MM


def test_dielectric_faces_turn_light_as_mitsubas_do(met: dict[str, Any]) -> None:
    faces, kind = met["faces"], met["kind"]
    for clear in (faces.TO_GLASS, faces.TO_AIR, faces.WALL):
        here = kind == clear
        off = np.abs(met["turned"] - met["stock_turned"]).max(axis=0)[here]
        assert (
            np.quantile(off, 0.9999) < 1e-4
        )  # but for one at the critical angle, or on the edge of the draw
        assert np.all(met["weight"][here] == 1.0)


def test_lanes_side_by_side_hold_every_path_once(variant: str) -> None:
    from scenes import recurrence

    order = np.array(recurrence.side_by_side(1000, 3)).reshape(3, 1000)
    assert np.array_equal(np.sort(order, axis=1).ravel(), np.arange(3000))
    step = np.array(recurrence._RECURRENCE) / 2**32
    points = (np.arange(2**14)[:, None] * step) % 1.0
    jump = np.abs(np.diff(points[np.array(recurrence.side_by_side(2**14, 1))], axis=0)).max(axis=1)
    assert np.median(jump) < 0.25 * np.median(np.abs(np.diff(points, axis=0)).max(axis=1))
