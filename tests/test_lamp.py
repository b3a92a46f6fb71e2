"""LEDs' patterns: drawn and evaluated light against closed forms, IES files, and LEDs below the guide."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensors import bump, paper_sensor, pressed

from scenes import ies
from scenes.led import Led
from scenes.sensor import Sensor

SKEWED_FLUX = np.pi * 3 / 4 + np.pi / 8  # of `skewed`, by hand


def skewed(cosine: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """Intensity with no symmetry: cos(theta) (3/4 + sin²(theta) (1/4 + cos(turn - 0.5)/2))."""
    return cosine * (0.75 + (1 - cosine**2) * (0.25 + 0.5 * np.cos(turn - 0.5)))


def file_of(vertical: np.ndarray, horizontal: np.ndarray, candela: np.ndarray, kind: int = 1) -> str:
    """An LM-63-2002 file; numbers run over lines as they please."""
    counts = f"1 -1 2.5 {len(vertical)} {len(horizontal)} {kind} 2 0 0 0"
    head = f"IESNA:LM-63-2002\n[TEST] none\nTILT=NONE\n{counts}\n1.0 1.0 0.1\n"
    rows = [" ".join(f"{v:.7g}" for v in row) for row in (vertical, horizontal, *np.atleast_2d(candela))]
    return head + "\n".join(rows) + "\n"


def write_skewed(folder: Path) -> str:
    vertical, horizontal = np.linspace(0, 90, 91), np.linspace(0, 360, 73)
    candela = skewed(np.cos(np.radians(vertical)), np.radians(horizontal)[:, None])
    (folder / "skewed.ies").write_text(file_of(vertical, horizontal, candela))
    return str(folder / "skewed.ies")


def directions(count: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Middles of even cells of cosine and turn, and their solid angle."""
    cosine = (np.arange(count) + 0.5) / count
    turn = (np.arange(count) + 0.5) / count * 2 * np.pi
    c, t = np.meshgrid(cosine, turn)
    return c.ravel(), t.ravel(), 2 * np.pi / count**2


def leds_of(folder: Path) -> tuple[Led, ...]:
    narrow = np.linspace(0, 40, 21)
    (folder / "narrow.ies").write_text(file_of(narrow, np.zeros(1), np.cos(np.radians(narrow * 90 / 40))))
    return (
        Led(side="+x"),
        Led(side="-x", pattern="power", exponent=1.0),
        Led(side="+y", pattern="power", exponent=9.0),
        Led(side="-y", pattern="ies", ies=write_skewed(folder)),
        Led(side="below", pattern="ies", ies=str(folder / "narrow.ies")),
        Led(side="+x", tilt_deg=30.0),
        Led(side="+y", pattern="power", exponent=9.0, tilt_deg=-75.0),
    )


def test_all_the_flux_goes_out(variant: str, tmp_path: Path) -> None:
    """∫ L/L_Lambert cos/pi over the half space is 1 for every pattern; the skewed one is its closed form."""
    import mitsuba as mi

    from scenes.lamp import Patterns

    leds = leds_of(tmp_path)
    cosine, turn, step = directions(800)
    sine = np.sqrt(1 - cosine**2)
    parts = [mi.Float(v.astype(np.float32)) for v in (cosine, sine * np.cos(turn), sine * np.sin(turn))]
    patterns = Patterns(leds)
    found = [np.asarray(patterns.relative(mi.UInt32(n), *parts), np.float64) for n in range(len(leds))]
    for values in found:
        assert np.sum(values * cosine) * step / np.pi == pytest.approx(1.0, abs=2e-4)
    np.testing.assert_allclose(found[1], 1.0, rtol=1e-6)
    np.testing.assert_allclose(found[2], 5.0 * cosine**8, rtol=1e-4, atol=1e-12)
    exact = skewed(cosine, turn) / cosine * np.pi / SKEWED_FLUX
    np.testing.assert_allclose(found[3][cosine > 0.05], exact[cosine > 0.05], rtol=5e-3)
    axis = np.array([0.0, 0.5, np.sqrt(0.75)])
    before = np.stack([sine * np.cos(turn), sine * np.sin(turn), cosine])
    behind = before * np.array([[1.0], [1.0], [-1.0]])
    tilted = (np.maximum(axis @ before, 0.0) + np.maximum(axis @ behind, 0.0)) / cosine
    np.testing.assert_allclose(found[5], tilted, rtol=1e-3, atol=1e-5)


def test_rays_are_drawn_as_the_patterns_say(variant: str, tmp_path: Path) -> None:
    """Counts in bins of even solid angle against the radiance of `relative`, chi-square per bin."""
    import mitsuba as mi

    from scenes.lamp import Patterns

    leds, rays, bins = leds_of(tmp_path), 400_000, 12
    random = np.random.Generator(np.random.Philox(2)).random((2, rays)).astype(np.float32)
    patterns = Patterns(leds)
    cosine, turn, step = directions(bins * 20)
    sine = np.sqrt(1 - cosine**2)
    parts = [mi.Float(v.astype(np.float32)) for v in (cosine, sine * np.cos(turn), sine * np.sin(turn))]
    for number in range(len(leds)):
        d = patterns.draw(mi.UInt32(number), mi.Point2f(mi.Float(random[0]), mi.Float(random[1])))
        x, y, z = (np.asarray(part, np.float64) for part in d)
        np.testing.assert_allclose(x**2 + y**2 + z**2, 1.0, atol=1e-5)
        angle = np.mod(np.arctan2(y, x), 2 * np.pi)
        counts = np.histogram2d(angle, z, bins=bins, range=((0, 2 * np.pi), (0, 1)))[0]
        density = np.asarray(patterns.relative(mi.UInt32(number), *parts), np.float64) * cosine / np.pi * step
        expected = rays * density.reshape(bins, 20, bins, 20).sum(axis=(1, 3))
        strong = expected > 50
        chi2 = np.sum((counts - expected)[strong] ** 2 / expected[strong])
        assert chi2 < strong.sum() + 5 * np.sqrt(2 * strong.sum()), leds[number]
        assert counts[~strong].sum() < 1.2 * expected[~strong].sum() + 60


@pytest.mark.parametrize(("side", "part"), [("+x", 2), ("-x", 2), ("+y", 2), ("-y", 2), ("below", 1)])
def test_rays_lean_towards_the_contact(variant: str, side: Any, part: int) -> None:
    """Mean direction of cos^8 about an axis 40 degrees up: 9/10 along it but for what is mirrored."""
    import mitsuba as mi

    from scenes import trace

    led = Led(side=side, pattern="power", exponent=8.0, tilt_deg=40.0)
    sensor = dataclasses.replace(paper_sensor(), leds=(led,))
    random = np.random.Generator(np.random.Philox(4)).random((4, 100_000)).astype(np.float32)
    rays = trace.emit(sensor, mi.UInt32(np.zeros(100_000, np.uint32)), [mi.Float(row) for row in random])
    mean = [float(np.mean(np.asarray(getattr(rays.d, axis)))) for axis in "xyz"]
    assert mean[part] == pytest.approx(0.9 * np.sin(np.radians(40.0)), abs=5e-3)


def test_file_of_a_quadrant_is_unfolded(tmp_path: Path) -> None:
    """0..90 degrees mean four mirrored quadrants; commas and wild line ends are read as spaces."""
    vertical, horizontal = np.linspace(0, 90, 10), np.array([0.0, 45.0, 90.0])
    candela = np.outer([1.0, 2.0, 3.0], np.cos(np.radians(vertical)))
    lamp = ies.parse(file_of(vertical, horizontal, candela).replace(" ", ", ").encode())
    turn = np.array([0.0, 45.0, 90.0, 135.0, 180.0, 270.0, 315.0, 350.0, 22.5])
    expected = np.array([1, 2, 3, 2, 1, 3, 2, 1 + 10 / 45, 1.5]) * np.cos(np.radians(30.0))
    np.testing.assert_allclose(lamp.at(np.full(9, 30.0), turn), expected, rtol=1e-6)
    np.testing.assert_allclose(lamp.at(np.array([95.0]), np.zeros(1)), 0.0)


GOOD = file_of(np.array([0.0, 45.0, 90.0]), np.zeros(1), np.array([1.0, 0.7, 0.0]))


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"", "TILT=NONE"),
        (b"\x00\xff" * 1000, "TILT=NONE"),
        (GOOD.replace("TILT=NONE", "TILT=INCLUDE").encode(), "TILT=NONE"),
        (GOOD.replace("0.7", "nan").encode(), "finite"),
        (GOOD.replace("0.7", "-0.7").encode(), "negative"),
        (GOOD.replace("0.7", "seven").encode(), "'seven'"),
        (GOOD.replace(" 3 1 1 2", " 300000000 1 1 2").encode(), "vertical angles"),
        (GOOD.replace(" 3 1 1 2", " 3 1e300 1 2").encode(), "horizontal angles"),
        (GOOD.replace(" 3 1 1 2", " 2.5 1 1 2").encode(), "vertical angles"),
        (GOOD.replace(" 3 1 1 2", " 3 1 2 2").encode(), "type C"),
        (GOOD.replace(" 3 1 1 2", " 4 1 1 2").encode(), "rise|cut short"),
        (GOOD.encode()[:-10], "cut short"),
        (GOOD.encode() + b"5\n", "ends after"),
        (GOOD.replace("0 45 90", "0 45 200").encode(), "180"),
        (GOOD.replace("0 45 90", "10 45 90").encode(), "from 0"),
        (GOOD.replace("0 45 90", "0 45 180").encode(), "behind"),
        (GOOD.replace("1 0.7 0", "0 0 0").encode(), "shines"),
        (GOOD.replace("2.5 3", "0 3").encode(), "multiplier"),
    ],
)
def test_bad_files_are_refused_in_one_line(data: bytes, message: str) -> None:
    with pytest.raises(ies.IesError, match=message) as caught:
        ies.parse(data)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 200


def test_files_that_are_no_files_are_refused(tmp_path: Path) -> None:
    large = tmp_path / "large.ies"
    large.write_bytes(b" " * (ies.MAX_BYTES + 1))
    for path in ("", str(tmp_path), "/dev/zero", str(tmp_path / "absent.ies"), "a\0b", str(large)):
        with pytest.raises(ies.IesError):
            ies.read(path)


def below(coupling: str = "air", **changes: Any) -> Sensor:
    base = paper_sensor(columns=96, rows=64, pixel_um=(67.0, 75.0))
    led = Led(side="below", coupling=coupling, x_mm=7.0, y_mm=-3.0, **changes)  # type: ignore[arg-type]
    return dataclasses.replace(base, leds=(led,))


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_light_from_below_balances(variant: str, coupling: str) -> None:
    """All that an LED below gives ends somewhere; most of it goes through the contact or out again."""
    from scenes import Renderer, direct, surface, trace, transport
    from scenes.build import put_surface

    for given in ({}, {"pattern": "power", "exponent": 6.0}):
        sensor = below(coupling, **given)
        renderer = Renderer(sensor, "cpu")
        shape = surface.resample(bump(), sensor.guide.width_mm)
        put_surface(renderer.scene, sensor, shape)
        straight = direct.direct(sensor, renderer.basis, shape)
        assert not straight.any()
        ground = transport.survey(renderer.scene, sensor)
        light = transport.transport(
            renderer.scene,
            sensor,
            renderer.table,
            transport.Under.at(renderer.basis, renderer.behind, ground),
            straight.astype(np.float32),
            2**17,
            3,
        )
        assert light.sinks.sum() == pytest.approx(sensor.leds[0].flux_W, rel=5e-3)
        assert light.sinks[0, trace.SINKS.index("tissue")] > 0.1 * sensor.leds[0].flux_W


@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_led_below_and_its_mirror_image_are_as_path_sees_them(variant: str, coupling: str) -> None:
    """Its back hides what is behind; its front stands mirrored in a contact surface that hardly touches.

    Above the light of the tissue beside it, which `path` has without depth.
    """
    from scenes import Renderer
    from scenes.reference import path_trace

    flat = pressed(lambda x, y: 0.01, lambda x, y: (0.0, 0.0, 0.0))
    renderer = Renderer(below(coupling, diameter_mm=3.0), "cpu")
    ours = renderer.render(flat, quality="preview").radiance.sum(axis=0)
    mirror = ours > 0.5 * ours.max()
    hidden = renderer.rays.transmittance == 0.0
    assert 20 < mirror.sum() < 400 and 20 < hidden.sum() < 400
    assert not ours[hidden].any()

    def both(crop: tuple[int, int, int, int], seed: int) -> np.ndarray:
        mean, _ = path_trace(renderer.scene, renderer.sensor, 4096, seed, crop=crop)
        return np.array([ours[crop[0] : crop[1], crop[2] : crop[3]].mean(), mean.mean()])

    row, column = (round(float(place.mean())) for place in np.nonzero(hidden))
    inside, beside, back = (37, 43, 68, 73), (37, 43, 58, 64), (row - 1, row + 1, column - 1, column + 1)
    assert mirror[37:43, 68:73].all() and not mirror[37:43, 58:64].any()
    image, tissue = both(inside, 3), both(beside, 4)
    seen, expected = image - tissue
    assert seen == pytest.approx(expected, rel=0.04)
    assert both(back, 5)[1] == 0.0
