"""A housing below the glass that reflects: its light on its way, and in the picture."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from sensors import bump
from test_simulate import small

from scenes.sensor import Housing, NotModelled, Sensor, Tissue
from twin.design import Design, DesignError, load_design, parse_design

DENSE = Tissue(scattering_per_mm=1000.0, absorption_per_mm=20.0)


def white(reflectance: float, coupling: str = "embedded", tissue: Tissue | None = None) -> Sensor:
    whole = small().sensor()
    leds = tuple(dataclasses.replace(led, coupling=coupling) for led in whole.leds)
    return dataclasses.replace(
        whole, leds=leds, tissue=tissue or whole.tissue, housing=Housing(reflectance=reflectance)
    )


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_light_is_kept(variant: str, coupling: str) -> None:
    """Emitted = all sinks, and nothing goes through the box."""
    from scenes import Renderer, trace

    sensor = white(0.7, coupling)
    light = Renderer(sensor, "cpu").render(bump(), samples=2**18)
    assert light.sinks is not None
    flux = sum(led.flux_W for led in sensor.leds)
    assert light.sinks.sum() == pytest.approx(flux, rel=1.5e-3)
    sinks = dict(zip(trace.SINKS, light.sinks.sum(axis=0) / flux, strict=True))
    assert sinks["housing"] > 5e-3
    if coupling == "embedded":  # from air, some goes down beside guide and box
        assert sinks["below"] < 1e-4


def test_housing_keeps_what_it_does_not_send_back(variant: str) -> None:
    """Absorbed = (1 - rho) of what falls on the sides, path by path."""
    import drjit as dr
    import mitsuba as mi

    from scenes import Renderer, housing, recurrence, surface, trace
    from scenes.build import put_surface

    sensor, each = white(0.7), 2**13
    renderer = Renderer(sensor, "cpu")
    put_surface(renderer.scene, sensor, surface.flat(sensor.guide.width_mm, 0.5))
    n_led = len(sensor.leds)
    lanes = dr.arange(mi.UInt32, n_led * each)
    number, tally = lanes // each, housing.Tally(sensor)
    ray = trace.emit(sensor, number, recurrence.evenly(lanes % each, np.arange(4)))
    one, leg = dr.full(mi.Float, 1.0, n_led * each), dr.full(mi.UInt32, trace.OTHER, n_led * each)
    parts = (renderer.scene, sensor, renderer.table, renderer.basis, number, ray, one, leg, 3)
    left = trace.walk(*parts, tally=tally)
    fallen = tally.collected()
    assert fallen.shape == (n_led, 5, housing.CELLS, housing.CELLS)
    kept = 0.3 * fallen.sum(axis=(1, 2, 3))
    assert (kept > 1e-3 * each).all()
    np.testing.assert_allclose(left.sinks[:, trace.SINKS.index("housing")], kept, rtol=1e-4)


def test_box_is_met_where_rays_lead(variant: str) -> None:
    import mitsuba as mi

    from scenes.housing import SIDES, Box

    sensor = white(0.5)
    box = Box.of(sensor)
    x, lean = np.array([0.0, 0.0, -3.0, 0.0, 2.0]), np.array([0.0, 2.0, -2.0, 0.1, 0.0])
    y, lean_y = np.array([0.0, 0.0, 1.0, 4.0, -5.0]), np.array([0.0, 0.0, 0.5, -0.1, -3.0])
    met = box.meet(*(mi.Float(values) for values in (x, y, lean, lean_y)))
    places = np.asarray(met).T
    run = np.minimum((box.half - np.sign(lean) * x) / np.maximum(np.abs(lean), 1e-9), box.depth)
    run = np.minimum(run, (box.half - np.sign(lean_y) * y) / np.maximum(np.abs(lean_y), 1e-9))
    np.testing.assert_allclose(places[:, 0], x + run * lean, atol=1e-4)
    np.testing.assert_allclose(places[:, 2], box.top - run, atol=1e-4)
    side, across, up = (np.asarray(values) for values in box.side(met))
    assert [SIDES[number] for number in side] == ["floor", "+x", "-x", "floor", "-y"]
    assert across[0] == pytest.approx(0.5) and up[0] == pytest.approx(0.5)
    assert up[1] == pytest.approx(1.0 - run[1] / box.depth, abs=1e-5)
    assert across[4] == pytest.approx((places[4, 0] + box.half) / (2 * box.half), abs=1e-5)


def test_evenly_lit_box_is_its_radiance_times_the_mirrors(variant: str) -> None:
    """E on all sides: L = rho E / pi, and the glass alone sends back its Fresnel reflectance of it."""
    from scenes import Renderer, build, gather, housing, surface, view
    from scenes.build import put_surface

    sensor = white(0.6)
    renderer = Renderer(sensor, "cpu")
    put_surface(renderer.scene, sensor, surface.flat(sensor.guide.width_mm, 0.0))
    sight = gather.look(renderer.scene, sensor, renderer.table, renderer.behind.coupling, renderer.rays)
    box, n_led = housing.Box.of(sensor), len(sensor.leds)
    fallen = np.empty((n_led, 5, housing.CELLS, housing.CELLS))
    fallen[:] = 2.5 * (box.areas_mm2 / housing.CELLS**2)[None, :, None, None]
    seen = housing.seen(sensor, sight.mirrors[:1], fallen)
    glass = view.faces_reflectance(sensor, renderer.rays.direction[..., 2]).ravel()
    np.testing.assert_allclose(seen, np.tile(0.6 / np.pi * 2.5 * glass, (n_led, 1)), rtol=2e-5)
    # nothing touches: the gap's two faces mirror, seen twice through the glass
    middle = tuple(length // 2 for length in renderer.rays.transmittance.shape)
    shape = renderer.rays.transmittance.shape
    by_contact = housing.seen(sensor, sight.mirrors[1:], fallen)[0].reshape(shape)
    bare = 1.0 - build.optics_of(sensor).transmittance[0, -1]
    expected = 0.6 / np.pi * 2.5 * bare * renderer.rays.transmittance[middle] ** 2
    assert by_contact[middle] == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
@pytest.mark.parametrize("tissue", [DENSE], ids=["dense"])
def test_picture_is_that_of_stock_path(variant: str, tissue: Tissue) -> None:
    """Stock `path` through the same box: an independent code. A corner of the picture, where the veil is a
    third of the light."""
    from scenes import Renderer, reference, surface

    sensor = white(0.8, tissue=tissue)
    renderer = Renderer(sensor, "cpu")
    shape = surface.flat(sensor.guide.width_mm, 0.5)
    ours = renderer.render(shape, samples=2**18, seed=1)
    black = Renderer(dataclasses.replace(sensor, housing=Housing()), "cpu").render(
        shape, samples=2**18, seed=1
    )
    rows, columns = sensor.camera.shape
    top, left = int(0.4 * rows), int(0.4 * columns)
    crop = (top, top + rows // 5, left, left + columns // 5)
    mean, error = reference.path_trace(renderer.scene, sensor, 6000, 1, crop=crop)

    def here(picture: np.ndarray) -> float:
        return float(picture.sum(axis=0)[crop[0] : crop[1], crop[2] : crop[3]].mean())

    sigma = np.sqrt(np.sum(error**2)) / error.size
    found, without = here(ours.radiance), here(black.radiance)
    print(f"ours {found:.4g}, path {mean.mean():.4g} ± {sigma:.2g}; black {without:.4g}")
    assert found == pytest.approx(mean.mean(), abs=3.0 * sigma + 0.01 * mean.mean())
    assert found > 1.2 * without > 0.0
    assert ours.from_housing_percent > black.from_housing_percent == 0.0


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_standard_is_the_reference(variant: str) -> None:
    from scenes import Renderer

    sensor = white(0.8)
    renderer = Renderer(sensor, "cpu")
    standard = [renderer.render(bump(), samples=2**20, seed=seed).radiance.sum(axis=0) for seed in range(2)]
    passes = [
        renderer.render(bump(), quality="reference", samples=2**22, seed=seed).radiance.sum(axis=0)
        for seed in range(4)
    ]
    ratio = np.mean(standard) / np.array([one.mean() for one in passes])
    error = ratio.std(ddof=1) / np.sqrt(len(ratio))
    print(f"standard over reference {ratio.mean():.4f} ± {error:.4f}")
    assert abs(ratio.mean() - 1.0) < 0.005 + 3.0 * error


def test_what_leaves_it_out_refuses_it(variant: str) -> None:
    from scenes import Renderer, gradients, surface, tangent

    sensor = white(0.5)
    renderer = Renderer(sensor, "cpu")
    shape = surface.resample(bump(), sensor.guide.width_mm)
    seen = renderer.render(shape, samples=2**10)
    for call in (
        lambda: renderer.render(shape, traced=seen.traced),
        lambda: tangent.gathered(renderer, shape),
        lambda: gradients.gradients(renderer, shape, ["leds.flux_W"]),
    ):
        with pytest.raises(
            NotModelled, match=r"housing\.reflectance: received 0\.5; allowed 0 \(black\)"
        ) as told:
            call()
        assert "\n" not in str(told.value)


@pytest.mark.parametrize("given", [-0.1, 0.99, "white", True])
def test_design_refuses_other_reflectances(given: object) -> None:
    with pytest.raises(DesignError, match=r"housing\.reflectance"):
        parse_design(tables() | {"housing": {"reflectance": given}})


def test_black_is_the_default_and_keeps_the_keys_of_before() -> None:
    from twin.bench import optical_key

    plain, black, grey = (parse_design(tables() | more) for more in ({}, HOUSING[0.0], HOUSING[0.4]))
    assert optical_key(plain) == optical_key(black) != optical_key(grey)
    assert repr(plain.sensor()) == repr(black.sensor())


HOUSING = {rho: {"housing": {"reflectance": rho}} for rho in (0.0, 0.4)}


def tables() -> dict[str, object]:
    import tomllib
    from importlib.resources import files

    return tomllib.loads(files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8"))


def test_verbs_that_leave_it_out_say_so(tmp_path: object) -> None:
    from twin.conflicts import black

    design: Design = dataclasses.replace(load_design("tsis"), housing=Housing(reflectance=0.4))
    with pytest.raises(
        DesignError, match=r"housing\.reflectance: received 0\.4; allowed 0 \(black\) in learned"
    ):
        black(design, "learned light")
