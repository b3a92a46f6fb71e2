"""Designs of LEDs and cameras: one line for every mistake, files beside the design, indices."""

import tomllib

import pytest
from test_design import TSIS, changed

from twin.design import DesignError, load_design, parse_design

CURVES = {"wavelength_nm": [400, 700], "R": [0.5, 0.5]}

BAD = [
    (
        "camera.quantum_efficiency",
        "half",
        "'half'",
        "a number >= 0.001 and <= 1 or a table with the keys wav",
    ),
    ("camera.quantum_efficiency", CURVES, "None", "a curve where camera.colour is 'mono'"),
    ("camera.quantum_efficiency", {**CURVES, "mono": [0.5, 2.0]}, "2.0", "a number >= 0 and <= 1"),
    ("camera.quantum_efficiency", {"mono": [0.5, 0.5]}, "nothing", "a list of 2 to 1000"),
    ("camera.colour", "sepia", "'sepia'", "one of 'mono', 'rgb'"),
    ("camera.binning", 5, "5", "a divisor of 492 rows and 768 columns"),
    ("camera.frames", 0, "0", "an integer >= 1 and <= 10000"),
    ("camera.focus_mm", -10.5, "-10.5", "-10 to 10 mm"),
    ("camera.distortion", [-9.0, 0.0], "(-9.0, 0.0)", "lest the picture folds"),
    ("camera.vignetting", 1, "1", "true or false"),
    ("light.bands", 0, "0", "an integer >= 1 and <= 64"),
    ("glass.material", "diamond", "'diamond'", "one of 'N-BK7', 'soda-lime'"),
    ("leds.1.spectrum", "LED-B9", "'LED-B9'", "one of 'line', 'gaussian'"),
    ("leds.1.fwhm_nm", 20.0, "20.0", "none but with a gaussian spectrum"),
    ("leds.1.flux_lm", 3.0, "3.0", "a flux_W, or this with the peak_nm"),
    ("leds.1.exponent", 2.0, "2.0", "none but where pattern is 'power'"),
    ("leds.1.exponent", 0.1, "0.1", "a number >= 0.5 and <= 1000"),
    ("leds.1.tilt_deg", 100.0, "100.0", "a number >= -90 and <= 90"),
    ("leds.1.side", "above", "'above'", "one of '+x', '-x', '+y', '-y', 'below'"),
]


@pytest.fixture
def data():
    return tomllib.loads(TSIS)


@pytest.mark.parametrize(("path", "value", "received", "allowed"), BAD)
def test_every_mistake_is_one_line(data, path, value, received, allowed):
    with pytest.raises(DesignError) as caught:
        parse_design(changed(data, path, value), "my.toml")
    line = str(caught.value)
    assert "\n" not in line and line.startswith(f"my.toml: {path}")
    assert f"received {received}" in line
    assert allowed in line.split("; allowed ")[1]


def leds_with(data, **led):
    return {**data, "leds": [{"side": "+x", **led}]}


@pytest.mark.parametrize(
    ("led", "field", "allowed"),
    [
        ({"flux_lm": 3.0, "flux_W": 0.02, "spectrum": "LED-B3"}, "flux_lm", "none beside flux_W = 0.02"),
        ({"flux_lm": 3.0, "peak_nm": 1000.0}, "flux_lm", "a flux_W, where light is invisible"),
        ({"spectrum": "LED-B3", "peak_nm": 500.0}, "peak_nm", "none with LED-B3, which is a table"),
        ({"spectrum": "gaussian", "peak_nm": 500.0}, "fwhm_nm", "a width, nm"),
        ({"side": "below", "x_mm": 12.0}, "x_mm", "-11.75 to 11.75 mm"),
        ({"side": "below", "coupling": "embedded", "gap_mm": 2.0}, "gap_mm", "less than the glass's 2 mm"),
        ({"side": "below", "gap_mm": 40.0}, "gap_mm", "less than the camera's distance of 40 mm"),
        ({"pattern": "power"}, "exponent", "a value where pattern is 'power'"),
        ({"spectrum": "gaussian", "fwhm_nm": 20.0}, "peak_nm", "a wavelength, nm, for a gaussian spectrum"),
        ({"pattern": "ies"}, "ies", "a value where pattern is 'ies'"),
        ({"pattern": "ies", "ies": "absent.ies"}, "ies", "an IES file that is there"),
        ({"pattern": "ies", "ies": "absent.ies", "tilt_deg": 9.0}, "tilt_deg", "0 where pattern is 'ies'"),
        ({"ies": "absent.ies"}, "ies", "none but where pattern is 'ies'"),
    ],
)
def test_leds_that_cannot_be_are_one_line(data, led, field, allowed):
    with pytest.raises(DesignError) as caught:
        parse_design(leds_with(data, **led), "my.toml")
    line = str(caught.value)
    assert line.startswith(f"my.toml: leds.0.{field}: received ") and allowed in line and "\n" not in line


def test_luminaire_files_lie_beside_the_design(data, tmp_path):
    """A relative path counts from the design's folder, wherever twin runs."""
    (tmp_path / "sub").mkdir()
    file = "IESNA:LM-63-2002\nTILT=NONE\n1 -1 1 3 1 1 2 0 0 0\n1 1 1\n0 45 90\n0\n10 7 0\n"
    (tmp_path / "sub" / "lens.ies").write_text(file)
    led = '\n[[leds]]\nside = "+x"\nalong_mm = 5.0\npattern = "ies"\nies = "sub/lens.ies"\n'
    (tmp_path / "my.toml").write_text(TSIS + led, encoding="utf-8")
    assert load_design(tmp_path / "my.toml").leds[4].ies == str(tmp_path / "sub" / "lens.ies")


def test_indices_follow_the_wavelength_where_none_is_fixed(data):
    """Sylgard by Schneider, N-BK7 by Schott; numbers that are given hold for all light."""
    del data["waveguide"]["refractive_index"]
    data["glass"]["material"] = "N-BK7"
    blue, red = (parse_design(data).sensor(wavelength) for wavelength in (450.0, 650.0))
    assert blue.guide.refractive_index - red.guide.refractive_index == pytest.approx(
        1.44208 - 1.42892, abs=2e-5
    )
    assert blue.glass.refractive_index == pytest.approx(1.5253, abs=2e-4)
    assert red.glass.refractive_index == pytest.approx(1.5145, abs=2e-4)
    fixed = load_design("tsis")
    assert fixed.sensor(450.0).guide.refractive_index == fixed.sensor(650.0).guide.refractive_index == 1.4336


def layered(*indices, **surface):
    """The shipped design with an index for each layer, None where it says none."""
    data = tomllib.loads(TSIS)
    for layer, index in zip(data["waveguide"]["layers"], indices, strict=True):
        if index is not None:
            layer["refractive_index"] = index
    data["surface"].update(surface)
    return parse_design(data)


def test_layers_have_indices_of_their_own():
    """Neighbours of one index are one layer to light; the mechanics never know."""
    plain, own = load_design("tsis"), layered(1.4, None, 1.5)
    assert layered(1.4336, None, 1.4336).guide() == plain.guide()
    assert own.guide().layers == ((2.0, 1.4), (3.0, 1.4336), (5.0, 1.5))
    assert layered(1.4, 1.4, None).guide().layers == ((5.0, 1.4), (5.0, 1.4336))
    assert own.probe() == plain.probe()
    with pytest.raises(DesignError, match=r"surface.gap_index: received 1.33; .* index 1.2 at the contact"):
        layered(1.2, None, None, gap_index=1.33)
    with pytest.raises(
        DesignError, match=r"waveguide.layers.1.refractive_index: received 0.5; allowed .*>= 1"
    ):
        layered(None, 0.5, None)
