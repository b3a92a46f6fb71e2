"""Light of many wavelengths: lumens, dispersion, and bands against sums over the whole spectrum."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from sensors import bump, paper_sensor

from scenes import dispersion
from scenes.camera import LIGHT_SPEED_M_S, PLANCK_J_S, mean_electrons
from scenes.led import Led
from scenes.sensor import Sensor
from scenes.spectral import band_sensors
from scenes.spectrum import ILLUMINANTS, bands, efficacy, longest, luminous_efficiency, shape

RGB = {
    "wavelength_nm": (400.0, 500.0, 600.0, 700.0),
    "R": (0.0, 0.05, 0.5, 0.3),
    "G": (0.05, 0.5, 0.2, 0.05),
    "B": (0.5, 0.3, 0.02, 0.0),
}


def test_lumens_of_a_line_are_683_times_v() -> None:
    """K_m at 555 nm, half of it and less where CIE 018:2019 says so."""
    assert efficacy("line", 555.0, None) == pytest.approx(683.0, rel=1e-5)
    np.testing.assert_allclose(luminous_efficiency([510.0, 610.0, 450.0]), [0.503, 0.503, 0.038], rtol=1e-9)
    assert luminous_efficiency(900.0) == 0.0


def test_lumens_of_a_blackbody_are_its_luminous_efficacy() -> None:
    """Planck's law over all wavelengths and V give the known 93 lm/W at 6500 K, 17 lm/W at 2856 K."""
    wavelength = np.arange(100.0, 60_000.0, 1.0) * 1e-9
    for kelvin, expected, within in ((6500.0, 93.0, 2.5), (2856.0, 17.0, 0.6)):
        power = wavelength**-5.0 / np.expm1(
            PLANCK_J_S * LIGHT_SPEED_M_S / (wavelength * 1.380649e-23 * kelvin)
        )
        got = 683.0 * np.sum(power * luminous_efficiency(wavelength * 1e9)) / power.sum()
        assert got == pytest.approx(expected, abs=within)


def test_gaussian_has_its_width_and_place() -> None:
    wavelength, density = shape("gaussian", 525.0, 33.0)
    mean = np.sum(density * wavelength)
    assert density.sum() == pytest.approx(1.0, abs=1e-12)
    assert mean == pytest.approx(525.0, abs=1e-6)
    spread = np.sqrt(np.sum(density * (wavelength - mean) ** 2))
    assert spread == pytest.approx(33.0 / np.sqrt(8 * np.log(2)), rel=1e-5)


def test_led_in_lumens_is_the_led_in_watts() -> None:
    for given in (
        {"spectrum": "LED-B3"},
        {"peak_nm": 525.0},
        {"spectrum": "gaussian", "peak_nm": 620.0, "fwhm_nm": 18.0},
    ):
        led = Led(side="+x", flux_lm=3.0, **given)  # type: ignore[arg-type]
        assert led.flux_W * led.lumens_per_watt == pytest.approx(3.0, rel=1e-12)
        assert dataclasses.replace(led, z_mm=-4.0).flux_W == led.flux_W


@pytest.mark.parametrize("name", sorted(ILLUMINANTS))
def test_white_leds_are_as_bright_as_white_light_can_be(name: str) -> None:
    """A white LED's light gives 220 to 350 lm/W: near the best that renders colour (Ohno 2004's limits)."""
    assert 220.0 < efficacy(name, None, None) < 350.0


def test_indices_are_those_of_the_tables() -> None:
    """N-BK7 at the data sheet's d, F and C lines; Sylgard at 550 nm; soda lime's n_d."""
    for line, index in ((587.5618, 1.5168), (486.1327, 1.52238), (656.2725, 1.51432)):
        assert dispersion.n_bk7(line) == pytest.approx(index, abs=1e-5)
    assert dispersion.pdms(550.0) == pytest.approx(1.4336, abs=5e-5)
    assert dispersion.soda_lime(587.6) == pytest.approx(1.523, abs=1e-3)


def sensor_of(*leds: dict[str, Any], **camera: Any) -> Sensor:
    base = paper_sensor(**camera)
    return dataclasses.replace(
        base, leds=tuple(Led(side="+x", along_mm=4.0 * i, **led) for i, led in enumerate(leds))
    )


def test_a_line_is_one_band_of_weight_one() -> None:
    (band,) = bands(paper_sensor().leds, paper_sensor().camera, 550.0, 5)
    assert band.wavelength_nm == 550.0 and band.parts == 1
    assert np.all(band.share == 1.0) and band.share.shape == (4, 1)


def test_bands_hold_all_electrons_of_every_channel() -> None:
    """Their shares sum to ∫ S QE lambda: electrons of even light as of photons counted by wavelength."""
    sensor = sensor_of({"spectrum": "LED-B3"}, {"peak_nm": 620.0}, colour="rgb", quantum_efficiency=RGB)
    camera = sensor.camera
    found = bands(sensor.leds, camera, 550.0, 4)
    assert [band.leds for band in found] == [(0,)] * 4 + [(1,)]
    share = sum(band.share for band in found)
    wavelength, density = shape("LED-B3", None, None)
    light = np.broadcast_to(share[0], (*camera.shape, 3))  # 1 W m-2 sr-1 at every wavelength alike
    photons_J = wavelength * 1e-9 / (PLANCK_J_S * LIGHT_SPEED_M_S)
    per_joule = (camera.efficiency(wavelength) * density * photons_J).sum(axis=1)
    line = mean_electrons(camera, np.ones((*camera.shape, 3)), 550.0)[0, 0]
    one = line / (camera.best_efficiency * 550e-9 / (PLANCK_J_S * LIGHT_SPEED_M_S))  # joules on a pixel
    np.testing.assert_allclose(mean_electrons(camera, light, 550.0)[0, 0], one * per_joule, rtol=1e-12)
    expected = camera.efficiency(620.0)[:, 0] / camera.best_efficiency * 620 / 550
    np.testing.assert_allclose(share[1], expected, rtol=1e-12)


@pytest.mark.parametrize("name", ["LED-B3", "LED-RGB1"])
def test_few_bands_integrate_what_changes_slowly(name: str) -> None:
    """Of a picture that falls by e in 200 nm: three bands sum it within 2 %, nine and more ever better."""
    sensor = sensor_of({"spectrum": name})
    wavelength, density = shape(name, None, None)

    def falls(at: np.ndarray) -> np.ndarray:
        return np.exp(-(at - 400.0) / 200.0)

    exact = np.sum(density * wavelength / 550.0 * falls(wavelength))
    errors = []
    for count in (1, 3, 9, 27):
        found = bands(sensor.leds, sensor.camera, 550.0, count)
        got = sum(float(band.share[0, 0]) * falls(np.array(band.wavelength_nm)) for band in found)
        errors.append(abs(float(got / exact) - 1.0))
    assert errors[1] < 0.02 and errors[2] < 0.004 and errors[3] < 0.0005
    assert errors[0] > 4 * errors[1] > 8 * errors[2]


@pytest.mark.slow
def test_three_bands_of_white_light_are_enough(variant: str) -> None:
    """Blob and mean of the paper's sensor, with a guide of Sylgard 184 on N-BK7, in 1, 3 and 5 bands against
    12: of gathered light, nearly all of it, which has no noise."""
    from scenes import SpectralRenderer
    from scenes.transport import GRID
    from twin import load_design

    design = load_design("tsis")

    def sensor(wavelength_nm: float = 550.0) -> Sensor:
        whole = design.sensor(wavelength_nm)
        camera = dataclasses.replace(whole.camera, columns=96, rows=61, pixel_um=(67.2, 78.4))
        white = tuple(dataclasses.replace(led, spectrum="LED-B3", peak_nm=None) for led in whole.leds)
        guide = dataclasses.replace(whole.guide, refractive_index=dispersion.pdms(wavelength_nm))
        glass = dataclasses.replace(whole.glass, refractive_index=dispersion.n_bk7(wavelength_nm))
        return dataclasses.replace(whole, camera=camera, leds=white, guide=guide, glass=glass)

    def taken(count: int) -> np.ndarray:
        renderer = SpectralRenderer(sensor(), count=count, at=sensor, device="cpu")
        assert len(renderer.renderers) == count
        dark = [np.zeros((4, one.basis.layers, GRID, GRID)) for one in renderer.renderers]
        seen = renderer.render(bump(), traced=tuple(dark))
        whole = seen.radiance.sum(axis=0, dtype=np.float64)
        return np.array([whole[26:35, 40:56].mean(), whole.mean()])

    many = taken(12)
    for count, allowed in ((1, 1.0), (3, 0.2), (5, 0.1)):
        off = 100.0 * (taken(count) / many - 1.0)
        print(f"{count} bands against 12: blob {off[0]:+.4f} %, mean {off[1]:+.4f} %")
        assert np.all(np.abs(off) < allowed)


def test_camera_blind_to_an_led_sees_it_dark() -> None:
    sensor = sensor_of({"peak_nm": 850.0}, colour="rgb", quantum_efficiency=RGB)
    (band,) = bands(sensor.leds, sensor.camera, 550.0, 3)
    assert not band.share.any() and band.leds == (0,)
    assert longest(sensor.leds, 550.0) == 850.0


def test_painted_walls_keep_the_windows_of_leds_of_other_colours() -> None:
    """An LED in air has its window in the paint whatever colour shines just now."""
    base = sensor_of({"peak_nm": 466.0}, {"peak_nm": 625.0}, colour="rgb", quantum_efficiency=RGB)
    painted = dataclasses.replace(base, guide=dataclasses.replace(base.guide, walls="diffuse"))
    for sensor, count in ((base, 1), (painted, 2)):
        parts = band_sensors(sensor)
        assert [len(one.leds) for _, _, one in parts] == [count, count]
    dark = [[led.flux_W == 0.0 for led in one.leds] for _, _, one in parts]
    assert dark == [[False, True], [True, False]]


def test_light_that_the_camera_is_blind_to_is_followed_all_the_same(variant: str) -> None:
    """Where it ends is a question about the sensor: the sinks of both LEDs add up to what they emit."""
    from scenes import SpectralRenderer

    base = paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0))
    camera = dataclasses.replace(base.camera, colour="rgb", quantum_efficiency=RGB)
    leds = tuple(
        dataclasses.replace(led, peak_nm=peak) for led, peak in zip(base.leds, (850.0, 525.0), strict=False)
    )
    one = SpectralRenderer(dataclasses.replace(base, camera=camera, leds=leds), device="cpu")
    assert one.response[0] == 0.0 < one.response[1]
    assert len(one.whole.sensor.leds) == 2
    found = one.render(bump(), quality="preview", samples=2**14)
    assert found.sinks is not None
    np.testing.assert_allclose(found.sinks.sum(axis=1), [led.flux_W for led in leds], rtol=0.02)
    assert not found.radiance[0].any() and found.radiance[1].any()
    dark = tuple(dataclasses.replace(led, peak_nm=850.0) for led in base.leds)
    blind = SpectralRenderer(dataclasses.replace(base, camera=camera, leds=dark), device="cpu")
    assert len(blind.renderers) == 1 and len(blind.whole.sensor.leds) == 4


def test_line_renders_the_same_bytes_as_one_renderer(variant: str) -> None:
    from scenes import Renderer, SpectralRenderer

    sensor = paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0))
    options = {"quality": "preview", "samples": 2**14, "seed": 5}
    one = Renderer(sensor, "cpu").render(bump(), **options)  # type: ignore[arg-type]
    spectral = SpectralRenderer(sensor, count=5, device="cpu")
    assert len(spectral.renderers) == 1
    assert spectral.render(bump(), **options).radiance.tobytes() == one.radiance.tobytes()  # type: ignore[arg-type]


def test_a_renderer_like_another_takes_only_what_is_the_same(variant: str) -> None:
    """Of other contact and light, the tables; of other tissue, none; and the same bytes as one of its own."""
    from scenes import SpectralRenderer

    sensor = paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0))
    skin = dataclasses.replace(sensor.skin, rms_slope=1.3 * sensor.skin.rms_slope)
    leds = tuple(dataclasses.replace(led, flux_W=2.0 * led.flux_W) for led in sensor.leds)
    first, other = SpectralRenderer(sensor, device="cpu"), dataclasses.replace(sensor, skin=skin, leds=leds)
    like = SpectralRenderer(other, device="cpu", like=first)
    assert like.renderers[0].behind is first.renderers[0].behind
    options = {"quality": "preview", "samples": 2**14, "seed": 5}
    own = SpectralRenderer(other, device="cpu").render(bump(), **options).radiance  # type: ignore[arg-type]
    assert like.render(bump(), **options).radiance.tobytes() == own.tobytes()  # type: ignore[arg-type]
    paler = dataclasses.replace(sensor.tissue, absorption_per_mm=0.5 * sensor.tissue.absorption_per_mm)
    unlike = SpectralRenderer(dataclasses.replace(sensor, tissue=paler), device="cpu", like=first)
    assert unlike.renderers[0].behind is not first.renderers[0].behind


def test_colours_of_two_leds_are_summed_channel_by_channel(variant: str) -> None:
    """Each LED alone at its wavelength, times what the channels make of it."""
    from scenes import Renderer, SpectralRenderer

    sensor = sensor_of({"peak_nm": 620.0}, {"peak_nm": 470.0}, columns=96, rows=64, pixel_um=(67.0, 75.0))
    camera = dataclasses.replace(sensor.camera, colour="rgb", quantum_efficiency=RGB)
    sensor = dataclasses.replace(sensor, camera=camera)
    layers = SpectralRenderer(sensor, device="cpu").render(bump(), quality="preview", samples=2**16).radiance
    assert layers.shape == (2, 64, 96, 3)
    for number, wavelength in enumerate((620.0, 470.0)):
        alone = dataclasses.replace(sensor, leds=(sensor.leds[number],), wavelength_nm=wavelength)
        plain = Renderer(alone, "cpu").render(bump(), quality="preview", samples=2**16).radiance[0]
        share = camera.efficiency(wavelength)[:, 0] / camera.best_efficiency * wavelength / 550.0
        for channel in range(3):
            expected = share[channel] * plain.sum(dtype=np.float64)
            assert layers[number, ..., channel].sum(dtype=np.float64) == pytest.approx(expected, rel=0.01)
