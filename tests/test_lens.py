"""The thin lens against closed forms and against rays: absolute light, blur, vignetting, distortion."""

import dataclasses

import numpy as np
import pytest
from sensors import paper_sensor

from scenes import view
from scenes.camera import mean_electrons
from scenes.lens import disc, lens_of, relative_illumination, through


def test_lambertian_plate_of_known_flux_to_electrons_in_a_pixel() -> None:
    """From W/mm² of the contact surface to electrons, with the aperture's cone and not the camera's formula.

    The plate sends M/pi sin²(theta) pi through the cone that the pupil takes, n sin(theta) being kept on the
    way; the pixel's footprint comes from the pixels' own rays, the loss at the faces from Fresnel at 0°.
    """
    flux_W_mm2 = 2e-6
    for f_number in (2.0, 4.0, 8.0):
        sensor = paper_sensor(f_number=f_number)
        camera, guide, glass = sensor.camera, sensor.guide, sensor.glass
        n1, n2 = guide.refractive_index, glass.refractive_index

        pupil = lens_of(sensor).pupil_mm / 2
        slabs = ((camera.distance_mm, 1.0), (glass.thickness_mm, n2), (guide.thickness_mm, n1))
        sines = np.linspace(0.0, 0.5, 200_001)
        reach = sum(length * sines / np.sqrt(n**2 - sines**2) for length, n in slabs)
        sine = np.interp(pupil, reach, sines)
        r1, r2 = ((n1 - n2) / (n1 + n2)) ** 2, ((n2 - 1) / (n2 + 1)) ** 2
        passes = (1 - r1) * (1 - r2) / (1 - r1 * r2)
        rays = view.pixel_rays(sensor)
        meets = rays.origin_mm + guide.thickness_mm * rays.direction / rays.direction[..., 2:]
        row, column = 246, 384
        footprint = (meets[row, column + 1, 0] - meets[row, column, 0]) * (
            meets[row - 1, column, 1] - meets[row, column, 1]
        )
        watts = flux_W_mm2 * footprint * (sine / n1) ** 2 * passes
        photon_J = 6.62607015e-34 * 299_792_458.0 / 550e-9
        expected = watts * camera.exposure_ms * 1e-3 * camera.quantum_efficiency / photon_J

        inside = flux_W_mm2 * 1e6 / np.pi  # W m-2 sr-1 in the guide
        at_lens = inside * rays.transmittance * rays.radiance_scale
        got = mean_electrons(camera, through(sensor, at_lens), 550.0)[row, column]
        print(f"f/{f_number:g}: {got:.1f} electrons, {100 * (got / expected - 1):+.3f} % of the closed form")
        assert got == pytest.approx(expected, rel=5e-3)


def test_focal_length_follows_from_field_and_distance() -> None:
    """Gauss: 1/f = 1/u + 1/v at the magnification that the field asks for."""
    sensor = paper_sensor()
    lens = lens_of(sensor)
    seems = 40.0 + 2.0 / 1.515 + 10.0 / 1.4336
    assert lens.object_mm == pytest.approx(seems, rel=1e-12)
    # the magnification on the axis is not quite that of the whole field: refraction bends the outer rays more
    assert lens.magnification == pytest.approx(6.4512 / 25.0, rel=5e-3)
    assert 1 / lens.focal_mm == pytest.approx(1 / seems + 1 / (lens.magnification * seems), rel=1e-12)
    assert lens.focal_mm == pytest.approx(9.9, abs=0.1)
    assert lens.blur_mm == 0.0


@pytest.mark.parametrize("focus", [-5.0, -1.0, 2.0])
def test_blur_is_where_the_marginal_rays_arrive(focus: float) -> None:
    """A ray from the axis by the pupil's edge, bent by the thin lens, lands half the blur off the axis."""
    sensor = paper_sensor(focus_mm=focus, f_number=2.8)
    lens = lens_of(sensor)
    height = lens.pupil_mm / 2
    bent = height / lens.object_mm - height / lens.focal_mm
    assert abs(height + lens.image_mm * bent) == pytest.approx(lens.blur_mm / 2, rel=1e-9)
    assert lens.blur_mm > 0


def test_in_focus_nothing_changes() -> None:
    light = np.random.default_rng(1).random((492, 768))
    assert through(paper_sensor(), light).tobytes() == light.tobytes()


def test_defocus_disc_is_even_and_keeps_the_light() -> None:
    """Second moments of an even disc are d²/16 each; pixels add 1/12 of their own."""
    kernel = disc(0.1, (8.4e-3, 9.8e-3))
    y, x = (np.arange(size) - size // 2 for size in kernel.shape)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-12)
    for along, pitch in ((x, 8.4e-3), (y[:, None], 9.8e-3)):
        moment = np.sum(kernel * along**2) * pitch**2
        assert moment == pytest.approx(0.1**2 / 16 + pitch**2 / 12, rel=0.01)
    blurred = paper_sensor(focus_mm=-4.0)
    light = np.zeros((492, 768))
    light[200, 300] = 1.0
    spread, lens = through(blurred, light), lens_of(blurred)
    cone = (lens.focal_mm / lens.image_mm * (1 + blurred.camera.magnification)) ** 2
    assert spread.sum() == pytest.approx(cone, rel=1e-9)
    assert cone == pytest.approx(1.0, abs=0.05)
    even = through(blurred, np.ones((492, 768)))
    np.testing.assert_allclose(even, cone, rtol=1e-9)


@pytest.mark.parametrize("distortion", [(0.0, 0.0), (-0.3, 0.1), (0.5, 0.0)])
def test_vignetting_is_the_share_of_rays_that_pixels_get(distortion: tuple[float, float]) -> None:
    """Rays thrown evenly over projected solid angle, imaged point by point, against cos⁴ and the crowding."""
    sensor = paper_sensor(
        distortion=distortion, vignetting=True, columns=24, rows=16, pixel_um=(268.8, 301.0)
    )
    rays = 4_000_000
    rng = np.random.Generator(np.random.Philox(3))
    sine2 = 0.2 * rng.random(rays)  # beyond the corners
    turn = 2 * np.pi * rng.random(rays)
    sine = np.sqrt(sine2)
    direction = np.stack([sine * np.cos(turn), sine * np.sin(turn), np.sqrt(1 - sine2)], axis=1)
    column, row = view.picture_points(sensor, direction)
    found = np.histogram2d(row, column, bins=(np.arange(17), np.arange(25)))[0]
    # a pixel of area A at image distance v takes A/v² of the projected solid angle on the axis
    scale = view.tangent_scale(sensor)
    per_pixel = rays / (0.2 * np.pi) * 0.2688 * 0.301 * scale**2
    expected = per_pixel * relative_illumination(sensor)
    assert np.abs(found - expected).max() < 5 * np.sqrt(expected.max()) + 0.004 * expected.max()
    assert abs(found.sum() / expected.sum() - 1) < 3e-3
    if not any(distortion):
        assert through(sensor, np.ones((16, 24)))[0, 0] < 0.9


@pytest.mark.parametrize("distortion", [(-0.4, 0.1), (0.3, 0.2)])
def test_distortion_goes_both_ways_and_keeps_the_field(distortion: tuple[float, float]) -> None:
    sensor = paper_sensor(distortion=distortion, field_of_view_mm=20.0)
    rng = np.random.default_rng(2)
    column, row = rng.random(1000) * 768, rng.random(1000) * 492
    back = view.picture_points(sensor, view.air_directions(sensor, column, row))
    np.testing.assert_allclose(back, (column, row), atol=1e-7)
    straight = paper_sensor(field_of_view_mm=20.0)
    edge = view.air_directions(sensor, np.array([0.0, 768.0]), np.array([246.0, 246.0]))
    np.testing.assert_allclose(
        edge, view.air_directions(straight, np.array([0.0, 768.0]), np.array([246.0, 246.0])), atol=1e-12
    )
    # Brown's law, about the axis: d = r (1 + k1 r² + k2 r⁴)
    k1, k2 = distortion
    tangent = np.linspace(0.0, 0.25, 6)[:, None] * [1.0, 0.0] + [0.0, 0.0]
    points, _ = view.picture_points(sensor, np.column_stack([tangent, np.ones(6)]))
    r = tangent[:, 0]
    image = (points - 384) * 8.4e-3 * view.tangent_scale(sensor)
    np.testing.assert_allclose(image, r * (1 + k1 * r**2 + k2 * r**4), atol=1e-12)


def test_ambient_light_is_added_before_the_lens() -> None:
    sensor = paper_sensor(ambient=0.5, vignetting=True)
    dark = through(sensor, np.zeros((492, 768)))
    np.testing.assert_allclose(dark, 0.5 * relative_illumination(sensor), rtol=1e-12)
    colour = dataclasses.replace(sensor, camera=dataclasses.replace(sensor.camera, vignetting=False))
    np.testing.assert_allclose(through(colour, np.ones((492, 768))), 1.5, rtol=1e-12)
