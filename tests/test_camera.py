"""The camera against closed forms of EMVA 1288: photon transfer, dark floor, quantisation, saturation."""

from dataclasses import replace

import numpy as np
import pytest

from scenes.camera import CameraError, expose, fixed_pattern, irradiance, mean_counts, mean_electrons, tare
from scenes.sensor import Camera

WAVELENGTH_NM = 550.0
PAPER = Camera(columns=768, rows=492, pixel_um=(8.4, 9.8), field_of_view_mm=25.0)
# Fine counts (1 electron each) show the noise itself; the ideal specimen has no noise but photons.
FINE = replace(
    PAPER, bits=16, gain_e_per_dn=1.0, offset_dn=200.0, prnu_percent=0.0, dsnu_e=0.0, dark_current_e_s=0.0
)


def generator(seed: int) -> np.random.Generator:
    return np.random.Generator(np.random.Philox(seed))


def flat(camera: Camera, electrons: float) -> np.ndarray:
    """Radiance (rows, columns) that gives this mean number of electrons in every pixel."""
    one = np.ones((camera.rows, camera.columns))
    return one * electrons / mean_electrons(camera, one, WAVELENGTH_NM)[0, 0]


def temporal_variance(camera: Camera, electrons: float, seed: int) -> tuple[float, float]:
    """Mean and temporal variance of a pair of frames: the fixed pattern drops out (EMVA 1288, section 6)."""
    rng, light = generator(seed), flat(camera, electrons)
    a, b = (expose(camera, light, WAVELENGTH_NM, rng).astype(float) for _ in range(2))
    return float((a.mean() + b.mean()) / 2), float((a - b).var() / 2)


def test_absolute_electron_count_by_hand():
    # m = 768 * 8.4 um / 25 mm = 0.258048; E = pi / (4 * 4^2 * 1.258048^2) = 0.0310155 W/m2 per W/m2/sr
    # photon energy at 550 nm: 3.611719e-19 J; A t QE = 82.32e-12 m2 * 10 ms * 0.5 = 4.116e-13 m2 s
    # 0.0310155 * 4.116e-13 / 3.611719e-19 = 35 346 electrons for 1 W/m2/sr
    light = np.ones((492, 768))
    assert irradiance(PAPER, light)[0, 0] == pytest.approx(0.0310155, rel=1e-5)
    assert mean_electrons(PAPER, light, WAVELENGTH_NM)[3, 5] == pytest.approx(35346.0, rel=1e-4)


@pytest.mark.parametrize(
    ("field", "factor", "expected"),
    [
        ("exposure_ms", 2, 2),
        ("exposure_ms", 0.1, 0.1),
        ("f_number", 2, 1 / 4),
        ("quantum_efficiency", 0.5, 0.5),
    ],
)
def test_light_scales_with_exposure_aperture_and_efficiency(field, factor, expected):
    light = np.ones((492, 768))
    changed = replace(PAPER, **{field: getattr(PAPER, field) * factor})
    ratio = mean_electrons(changed, light, WAVELENGTH_NM) / mean_electrons(PAPER, light, WAVELENGTH_NM)
    np.testing.assert_allclose(ratio, expected, rtol=1e-12)


def test_more_photons_at_longer_wavelength():
    light = np.ones((492, 768))
    ratio = mean_electrons(PAPER, light, 660.0) / mean_electrons(PAPER, light, 550.0)
    np.testing.assert_allclose(ratio, 660 / 550, rtol=1e-12)


def test_etendue_is_conserved_through_the_lens():
    """Flux through the pixel = radiance x area seen by the pixel x solid angle of the pupil."""
    focal_mm, m = 10.0, 768 * 8.4e-3 / 25.0
    camera = replace(PAPER, f_number=2.0)
    pupil_mm2 = np.pi / 4 * (focal_mm / camera.f_number) ** 2
    object_distance_mm = focal_mm * (1 + 1 / m)  # thin lens
    footprint_mm2 = 8.4e-3 * 9.8e-3 / m**2
    flux = footprint_mm2 * pupil_mm2 / object_distance_mm**2
    got = irradiance(camera, np.ones((492, 768)))[0, 0] * 8.4e-3 * 9.8e-3
    assert got == pytest.approx(flux, rel=1e-12)


@pytest.mark.parametrize(("bits", "gain"), [(12, 11.0), (16, 1.0), (10, 44.0)])
def test_photon_transfer_slope_is_the_gain(bits, gain):
    camera = replace(FINE, bits=bits, gain_e_per_dn=gain, offset_dn=20.0, prnu_percent=1.0, dsnu_e=10.0)
    levels = np.linspace(4000, 36000, 9)
    pairs = [temporal_variance(camera, level, seed) for seed, level in enumerate(levels, start=10)]
    mean, variance = np.transpose(pairs)
    slope, at_offset = np.polyfit(mean - camera.offset_dn, variance, 1)
    # 378k pixels: each variance is known to sqrt(2/N) = 0.23 %, the slope about as well: 1 % is four sigma.
    assert slope == pytest.approx(1 / gain, rel=0.01)
    floor = (camera.read_noise_e / gain) ** 2 + 1 / 12
    assert at_offset == pytest.approx(floor, abs=5 * 0.0023 * variance.mean())


def test_dark_floor_is_read_noise():
    mean, variance = temporal_variance(FINE, 0.0, 1)
    assert mean == pytest.approx(FINE.offset_dn, abs=5 * 12 / np.sqrt(2 * 492 * 768))
    assert variance == pytest.approx(12.0**2 + 1 / 12, rel=0.012)


def test_dark_current_adds_its_own_shot_noise():
    camera = replace(FINE, dark_current_e_s=1e5, read_noise_e=0.0)  # 1000 electrons in 10 ms
    mean, variance = temporal_variance(camera, 0.0, 2)
    assert mean - camera.offset_dn == pytest.approx(1000, abs=5 * np.sqrt(1000 / (2 * 492 * 768)))
    assert variance == pytest.approx(1000, rel=0.012)


def test_quantisation_noise_is_one_twelfth():
    """Under 0.7 counts of other noise, rounding adds 1/12 DN^2 to 1e-4 (EMVA 1288, section 2.3)."""
    camera = replace(FINE, read_noise_e=7.0, gain_e_per_dn=10.0)
    picture = expose(camera, flat(camera, 0.0), WAVELENGTH_NM, generator(3)).astype(float)
    assert picture.var() - 0.7**2 == pytest.approx(1 / 12, abs=4 * 0.0023 * 0.57)


def test_response_is_linear_below_saturation():
    levels = np.linspace(0, 40000, 9)
    means = [expose(FINE, flat(FINE, x), WAVELENGTH_NM, generator(4)).mean() for x in levels]
    error = np.array(means) - FINE.offset_dn - levels
    assert np.abs(error).max() < 5 * np.sqrt(40000 / (492 * 768))


def test_mean_counts_is_the_mean_of_the_pictures():
    ramp = flat(PAPER, 1.0) * np.linspace(0, 40000, 768)
    ideal = replace(PAPER, prnu_percent=0.0, dsnu_e=0.0)
    mean = expose(ideal, ramp, WAVELENGTH_NM, generator(5), frames=16)
    error = (mean - mean_counts(ideal, ramp, WAVELENGTH_NM)).mean(axis=0)
    # One column's mean over 492 x 16 draws; shot noise of 1.1 counts at the bright end. Rounding dithers out.
    bright = np.linspace(0, 40000, 768) > 8000
    assert np.abs(error[bright]).max() < 5 * 1.2 / np.sqrt(492 * 16)
    assert np.abs(error).max() < 0.5


def test_full_well_stops_the_charge_and_the_converter_stops_the_count():
    well = replace(FINE, full_well_e=20000.0, read_noise_e=0.0)
    assert np.all(expose(well, flat(well, 1e6), WAVELENGTH_NM, generator(6)) == 20200)
    assert np.all(mean_counts(well, flat(well, 1e6), WAVELENGTH_NM) == 20200)
    converter = replace(FINE, bits=12)
    assert np.all(expose(converter, flat(converter, 1e6), WAVELENGTH_NM, generator(6)) == 4095)
    absurd = expose(PAPER, flat(PAPER, 1e30), WAVELENGTH_NM, generator(6))
    assert absurd.min() >= 250  # the full well of a pixel may sit a shade under the last count
    no_offset = replace(FINE, offset_dn=0.0)
    assert expose(no_offset, flat(no_offset, 0.0), WAVELENGTH_NM, generator(6)).min() == 0


def test_prnu_is_its_share_of_the_signal_and_dsnu_a_constant():
    camera = replace(FINE, prnu_percent=2.0, dsnu_e=30.0)
    dark = expose(camera, flat(camera, 0.0), WAVELENGTH_NM, generator(7), frames=30)
    assert dark.std() == pytest.approx(np.hypot(30.0, 12 / np.sqrt(30)), rel=0.01)
    light = expose(camera, flat(camera, 20000.0), WAVELENGTH_NM, generator(8), frames=30)
    spatial = light.var() - (20000 + 12**2) / 30
    assert np.sqrt(spatial) == pytest.approx(np.hypot(0.02 * 20000, 30.0), rel=0.01)


def test_fixed_pattern_belongs_to_the_camera_not_to_the_frame():
    response, offset = fixed_pattern(PAPER)
    assert response.mean() == pytest.approx(1, abs=1e-4)
    assert abs(np.corrcoef(response.ravel(), offset.ravel())[0, 1]) < 0.01
    other, _ = fixed_pattern(replace(PAPER, pattern_seed=2))
    assert abs(np.corrcoef(response.ravel(), other.ravel())[0, 1]) < 0.01
    camera = replace(FINE, prnu_percent=2.0)
    light = flat(camera, 30000.0)
    a, b = (expose(camera, light, WAVELENGTH_NM, generator(seed), frames=8).ravel() for seed in (1, 2))
    assert np.corrcoef(a, b)[0, 1] > 0.9  # the same grain in frames of different seeds


def test_same_seed_same_bytes_other_seed_other_noise():
    light = flat(PAPER, 20000.0)
    one = expose(PAPER, light, WAVELENGTH_NM, generator(1))
    assert one.dtype == np.uint8 and one.shape == (492, 768)
    assert one.tobytes() == expose(PAPER, light, WAVELENGTH_NM, generator(1)).tobytes()
    two = expose(PAPER, light, WAVELENGTH_NM, generator(2))
    assert 0.3 < np.mean(one != two) < 0.9


def test_more_light_never_gives_fewer_counts_on_average():
    ramp = flat(PAPER, 1.0) * np.linspace(0, 60000, 768)
    assert np.all(np.diff(mean_counts(PAPER, ramp, WAVELENGTH_NM), axis=1) >= 0)
    even = replace(PAPER, prnu_percent=0.0)
    columns = expose(even, ramp, WAVELENGTH_NM, generator(1), frames=4).mean(axis=0)
    assert np.all(np.diff(columns[::32]) >= 0)


def test_averaging_frames_divides_the_variance():
    light = flat(FINE, 20000.0)
    mean = expose(FINE, light, WAVELENGTH_NM, generator(1), frames=16)
    assert mean.dtype == np.float32
    assert mean.var() == pytest.approx((20000 + 144) / 16, rel=0.012)


@pytest.mark.parametrize(("bits", "dtype"), [(8, np.uint8), (12, np.uint16), (16, np.uint16)])
def test_counts_come_in_the_smallest_type(bits, dtype):
    camera = replace(PAPER, bits=bits)
    assert expose(camera, flat(camera, 100.0), WAVELENGTH_NM, generator(1)).dtype == dtype


def test_tare_centres_rounds_and_clips():
    image = np.array([[10, 0, 255, 100]], np.uint8)
    reference = np.array([[10.4, 255, 0, 97.6]], np.float32)
    np.testing.assert_array_equal(tare(image, reference, 8), np.array([[128, 0, 255, 130]], np.uint8))
    assert tare(image, reference, 8).dtype == np.uint8
    np.testing.assert_array_equal(tare(image, reference, 12), [[2048, 1793, 2303, 2050]])


@pytest.mark.parametrize(
    ("radiance", "message"),
    [
        (np.zeros((5, 5)), r"shape \(5, 5\), allowed: \(492, 768\)"),
        (np.full((492, 768), -1.0), "finite and >= 0"),
        (np.full((492, 768), np.nan), "finite and >= 0"),
        (np.full((492, 768), np.inf), "finite and >= 0"),
    ],
)
def test_bad_radiance_is_refused_in_one_line(radiance, message):
    with pytest.raises(CameraError, match=message) as caught:
        expose(PAPER, radiance, WAVELENGTH_NM, generator(1))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("frames", [0, -1, 1.5, True])
def test_bad_frames_are_refused(frames):
    with pytest.raises(CameraError, match="frames"):
        expose(PAPER, flat(PAPER, 1.0), WAVELENGTH_NM, generator(1), frames=frames)


def test_binned_pixels_add_light_and_read_once():
    """Four times the electrons and the full well; the read noise of one; the pattern is the camera's own."""
    camera = replace(FINE, binning=2, gain_e_per_dn=4.0)
    light = np.ones((246, 384)) * 10000.0 / mean_electrons(FINE, np.ones((492, 768)), WAVELENGTH_NM)[0, 0]
    assert mean_electrons(camera, light, WAVELENGTH_NM)[0, 0] == pytest.approx(40000.0, rel=1e-12)
    dark = expose(camera, 0 * light, WAVELENGTH_NM, generator(1)).astype(float)
    assert dark.std() * 4.0 == pytest.approx(np.hypot(12.0, 4.0 / np.sqrt(12)), rel=0.02)
    full = expose(replace(camera, read_noise_e=0.0), 100 * light, WAVELENGTH_NM, generator(1))
    assert np.all(full == round(4 * 45000 / 4.0 + 200))
    fine, _ = fixed_pattern(replace(PAPER, prnu_percent=2.0))
    coarse, _ = fixed_pattern(replace(PAPER, prnu_percent=2.0, binning=2))
    np.testing.assert_allclose(coarse, fine.reshape(246, 2, 384, 2).mean(axis=(1, 3)), rtol=1e-12)


def test_mean_of_rounded_frames_loses_what_rounding_took():
    """Without noise to dither it, averaging cannot bring back a fraction of a count."""
    quiet = replace(FINE, read_noise_e=0.0, gain_e_per_dn=1000.0)
    mean = expose(quiet, flat(quiet, 0.0), WAVELENGTH_NM, generator(1), frames=64)
    assert np.all(mean == 200.0)
    coarse = replace(quiet, offset_dn=200.4)
    assert np.all(expose(coarse, flat(coarse, 0.0), WAVELENGTH_NM, generator(1), frames=64) == 200.0)


def colour_camera(**changes) -> Camera:
    table = {"wavelength_nm": (400.0, 700.0), "R": (0.1, 0.3), "G": (0.5, 0.5), "B": (0.4, 0.0)}
    return Camera(**{**as_arguments(PAPER), "colour": "rgb", "quantum_efficiency": table, **changes})


def as_arguments(camera: Camera) -> dict:
    return {name: getattr(camera, name) for name in camera.__dataclass_fields__}


def test_colour_channels_have_their_own_photons_and_pattern():
    camera = colour_camera()
    light = np.ones((492, 768, 3))
    electrons = mean_electrons(camera, light, WAVELENGTH_NM)
    mono = mean_electrons(replace(PAPER, quantum_efficiency=1.0), np.ones((492, 768)), WAVELENGTH_NM)[0, 0]
    np.testing.assert_allclose(electrons[0, 0] / mono, [0.3, 0.5, 0.4], rtol=1e-12)
    picture = expose(camera, light * 0.5, WAVELENGTH_NM, generator(1))
    assert picture.shape == (492, 768, 3) and picture.dtype == np.uint8
    noise = (picture - picture.mean(axis=(0, 1))).reshape(-1, 3)
    assert np.abs(np.corrcoef(noise.T) - np.eye(3)).max() < 0.01
    np.testing.assert_allclose(camera.efficiency([400.0, 550.0, 800.0])[0], [0.1, 0.2, 0.0], atol=1e-12)
