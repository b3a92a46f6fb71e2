"""Traced light learned from many presses: recovered where it is smooth, refused where it does not belong."""

import pickle
from dataclasses import replace

import numpy as np
import pytest
from test_forward import pressing
from test_lamp import file_of
from test_simulate import small

import fem
import twin
from scenes import SpectralRenderer, traced
from scenes.sensor import NotModelled, Sensor
from scenes.skin import Sheet
from scenes.surface import OpticalSurface
from twin import learn_light
from twin.complaint import DesignError
from twin.exposure import expected_counts
from twin.learn_light import light_of
from twin.retake import average


def presses(n: int, seed: int) -> tuple[list[OpticalSurface], list[np.ndarray], list[np.ndarray]]:
    """Dents of two hidden numbers, in pairs with and without a third; light is a quadratic of them."""
    rng = np.random.default_rng(seed)
    line = np.linspace(-12.5, 12.5, 65)
    shapes = [np.cos(np.add.outer(k * line / 5.0, line / (2.0 + k))) for k in range(3)]
    cells = np.linspace(-1, 1, 100)
    patterns = [np.exp(-np.add.outer((cells - 0.2 * k) ** 2, cells**2)) for k in range(-2, 3)]
    surfaces, fractions, light = [], [], []
    hiddens = np.repeat(rng.uniform(-1, 1, ((n + 1) // 2, 3)), 2, axis=0)[:n]
    hiddens[1::2, 2] = 0.0
    for hidden in hiddens:
        moved = np.zeros((65, 65, 3))
        moved[..., 2] = -0.1 * sum(h * shape for h, shape in zip(hidden, shapes, strict=True))
        surfaces.append(OpticalSurface(line, moved, np.ones((65, 65)), np.zeros((65, 65))))
        fraction = 0.3 + 0.1 * sum(h * p for h, p in zip(hidden, patterns, strict=False))
        fractions.append(fraction)
        amounts = [1.0, *(0.1 * hidden), 0.05 * hidden[0] * (hidden[0] + hidden[2])]
        one = sum(a * p for a, p in zip(amounts, patterns, strict=True))
        light.append(0.01 * np.broadcast_to(one, (4, 2, 100, 100)))
    return surfaces, fractions, light


@pytest.fixture(scope="module")
def sensor() -> Sensor:
    design = small()
    return replace(
        design.sensor(),
        leds=tuple(replace(design.sensor().leds[0], side=s) for s in ("+x", "-x", "+y", "-y")),
    )


@pytest.fixture(scope="module")
def learned(sensor) -> traced.TracedLight:
    surfaces, fractions, light = presses(120, 0)
    told = [traced.describe(*one) for one in zip(surfaces, fractions, strict=True)]
    return traced.learn(sensor, told, light)


def test_smooth_light_is_recovered(learned, sensor):
    for surface, fraction, light in zip(*presses(10, 1), strict=True):
        found = learned.at(sensor, surface, fraction) * 0.01 / sensor.leds[0].flux_W
        assert np.abs(found - light).max() < 3e-3 * light.max()
    assert learned.error_percent < 0.2


def test_what_an_inclusion_changes_is_recovered(learned, sensor):
    """To a hundredth, although it depends on the press."""
    surfaces, fractions, light = presses(40, 4)
    found = np.stack([learned.at(sensor, *one) for one in zip(surfaces, fractions, strict=True)])
    miss, signal = (one[::2] - one[1::2] for one in (found - np.stack(light), np.stack(light)))
    assert np.sqrt((miss**2).mean()) < 0.01 * np.sqrt((signal**2).mean())


@pytest.mark.parametrize("maps", [119, 121])
def test_each_press_has_its_light(sensor, maps):
    surfaces, fractions, light = presses(maps, 0)
    told = [traced.describe(*one) for one in zip(surfaces, fractions, strict=True)]
    told = [*told, told[-1]][:120]
    with pytest.raises(ValueError, match="zip"):
        traced.learn(sensor, told, iter(light))


def test_pairs_share_what_tracing_is_off_by(sensor):
    """Noise of one for both, as large as the inclusion's light: what is left of it there is a tenth."""
    surfaces, fractions, light = presses(120, 0)
    told = [traced.describe(*one) for one in zip(surfaces, fractions, strict=True)]
    rng = np.random.default_rng(5)
    cells = np.linspace(-1, 1, 100)
    wave = np.cos(2.0 * cells) * np.cos(3.0 * cells[:, None])
    off = 1e-3 * np.repeat(rng.standard_normal(60), 2)
    learned = traced.learn(sensor, told, [one + x * wave for one, x in zip(light, off, strict=True)])
    surfaces, fractions, light = presses(40, 4)
    found = np.stack([learned.at(sensor, *one) for one in zip(surfaces, fractions, strict=True)])
    error = found - np.stack(light)
    miss = error[::2] - error[1::2]
    assert np.sqrt((miss**2).mean()) < 0.1 * np.sqrt(2.0) * 1e-3 * np.sqrt((wave**2).mean())


def test_light_follows_the_leds_power(learned, sensor):
    surface, fraction, _ = (one[0] for one in presses(1, 2))
    twice = replace(
        sensor, leds=(replace(sensor.leds[0], flux_W=2 * sensor.leds[0].flux_W), *sensor.leds[1:])
    )
    before, after = (learned.at(one, surface, fraction) for one in (sensor, twice))
    assert np.allclose(after[0], 2 * before[0]) and np.allclose(after[1:], before[1:])


def test_an_led_that_is_dark_in_this_band_is_learned_as_dark(sensor):
    """Its light is in another band, but it stands in the way of the others' here, too."""
    dark = replace(sensor, leds=(replace(sensor.leds[0], flux_W=0.0), *sensor.leds[1:]))
    surfaces, fractions, light = presses(60, 0)
    lit = [np.concatenate([0.0 * maps[:1], maps[1:]]) for maps in light]
    told = [traced.describe(*one) for one in zip(surfaces, fractions, strict=True)]
    learned = traced.learn(dark, told, lit)
    found = learned.at(dark, surfaces[0], fractions[0])
    assert np.isfinite(found).all() and not found[0].any() and found[1:].min() > 0.0
    traced.check([learned], [dark])
    for use in (
        lambda: traced.check([learned], [sensor]),
        lambda: learned.at(sensor, surfaces[0], fractions[0]),
    ):
        with pytest.raises(NotModelled, match="learned of another sensor"):  # its light was never followed
            use()


def test_a_light_that_changes_some_sensors_leaves_that_of_others(sensor):
    """Painted walls, sheets and then tissue that scatters forward have changed since what ships was learned,
    and nothing else."""
    painted = replace(sensor, guide=replace(sensor.guide, walls="absorbing"))
    covered = replace(sensor, skin=replace(sensor.skin, sheet=Sheet(0.1, 500.0)))
    forward = replace(sensor, tissue=replace(sensor.tissue, anisotropy=0.9))
    assert traced.version(sensor) < traced.version(painted) == traced.version(covered)
    assert traced.version(covered) < traced.version(forward) < traced.LIGHT  # the last is noise
    hidden = replace(covered, tissue=forward.tissue)  # by the sheet
    assert traced.version(hidden) == traced.version(covered)


def test_a_failed_led_is_refused_before_anything_is_traced(tmp_path):
    design = small()
    failed = replace(design, leds=(replace(design.leds[0], flux_W=0.0), *design.leds[1:]))
    with pytest.raises(DesignError, match=r"leds\.0\.flux_W: received 0"):
        learn_light.learn_light(failed, str(tmp_path / "a.npz"))
    assert not list(tmp_path.iterdir())


def test_light_belongs_to_what_a_luminaire_file_says_wherever_it_lies(sensor, tmp_path):
    def key(name: str) -> str:
        led = replace(sensor.leds[0], pattern="ies", ies=str(tmp_path / name))
        return traced.optics_key(replace(sensor, leds=(led,)))

    angles = np.array([0.0, 45.0, 90.0])
    (tmp_path / "a.ies").write_text(file_of(angles, np.zeros(1), np.array([100.0, 70.0, 0.0])))
    (tmp_path / "b.ies").write_bytes((tmp_path / "a.ies").read_bytes())
    before = key("a.ies")
    assert key("b.ies") == before
    (tmp_path / "a.ies").write_text(file_of(angles, np.zeros(1), np.array([100.0, 5.0, 0.0])))
    assert key("a.ies") != before


def test_light_of_another_sensor_is_refused(learned, sensor):
    surface, fraction, _ = (one[0] for one in presses(1, 2))
    other = replace(sensor, leds=(replace(sensor.leds[0], z_mm=sensor.leds[0].z_mm - 1), *sensor.leds[1:]))
    with pytest.raises(NotModelled, match="learned of another sensor"):
        learned.at(other, surface, fraction)
    camera = replace(sensor, camera=replace(sensor.camera, exposure_ms=1.0))
    assert np.isfinite(learned.at(camera, surface, fraction)).all()


def test_a_press_far_from_what_was_learned_is_refused(learned, sensor):
    surface, fraction, _ = (one[0] for one in presses(1, 2))
    far = replace(surface, displacement_mm=30 * surface.displacement_mm)
    with pytest.raises(NotModelled, match="as far out as those learned"):
        learned.at(sensor, far, fraction)


def test_files_come_back_as_they_were(learned, sensor, tmp_path):
    traced.save([learned], tmp_path / "light.npz")
    (again,) = traced.load(tmp_path / "light.npz")
    surface, fraction, _ = (one[0] for one in presses(1, 3))
    assert np.array_equal(again.at(sensor, surface, fraction), learned.at(sensor, surface, fraction))


class Bomb:
    def __reduce__(self):
        return (exec, ("raise SystemExit('a pickle ran')",))


def test_hostile_files_are_refused(learned, tmp_path):
    place = tmp_path / "light.npz"
    np.savez(place, format=np.array([Bomb()], dtype=object))
    with pytest.raises(NotModelled, match="no traced light"):
        traced.load(place)
    place.write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(NotModelled, match="no traced light"):
        traced.load(place)
    for change in (
        {"modes": learned.modes[:, :1]},
        {"centre": learned.centre * np.nan},
        {"nodes": learned.nodes[:, :1]},
        {"nodes": learned.nodes[1:]},
        {"nodes": 0.0 * learned.nodes},
        {"kernel": learned.kernel[:2]},
        {"kernel": np.array([1.5, 1.0, 1.0])},
        {"kernel": np.array([99.0, 1.0, 1.0])},
        {"kernel": np.array([1.0, 1e-200, 1.0])},
    ):
        traced.save([replace(learned, **change)], place)
        with pytest.raises(NotModelled, match="no traced light"):
            traced.load(place)


def test_files_of_an_older_format_are_refused_in_one_line(learned, tmp_path, monkeypatch):
    place = tmp_path / "light.npz"
    with monkeypatch.context() as older:
        older.setattr(traced, "FORMAT", "tsis-traced-2")
        traced.save([learned], place)
        assert len(traced.load(place)) == 1  # it was whole in its time
    with pytest.raises(DesignError, match=r"traced: received .*; allowed a file of") as refused:
        light_of(place)
    assert "\n" not in str(refused.value)
    with pytest.raises(DesignError, match=r"traced: received .*; allowed a file of"):
        twin.simulate(small(), None, 1.0, traced=place)


def test_files_of_an_earlier_light_are_refused_in_one_line(sensor, tmp_path, monkeypatch):
    """The format is today's, what it was learned of is not: pictures of the same press have changed since."""
    surfaces, fractions, light = presses(120, 0)
    told = [traced.describe(*one) for one in zip(surfaces, fractions, strict=True)]
    place = tmp_path / "light.npz"
    with monkeypatch.context() as earlier:
        earlier.setattr(traced, "version", lambda sensor: 7)
        traced.save([traced.learn(sensor, told, light)], place)
        traced.check(light_of(place), [sensor])  # it was good in its time
    (old,) = light_of(place)
    for use in (
        lambda: traced.check([old], [sensor]),
        lambda: old.at(sensor, surfaces[0], fractions[0]),
    ):
        with pytest.raises(NotModelled, match=r"^traced: received light .* by an earlier version") as refused:
            use()
        assert "\n" not in str(refused.value)


def test_presses_traced_for_an_earlier_light_or_another_design_are_traced_anew(tmp_path, monkeypatch):
    task = learn_light.Task(small(), fem.Inclusion(10, 5, 100), 2.0, "", 0, tmp_path / "0.0000.npz")
    arrays = {"description": np.zeros(3), "traced.0": np.zeros((1, 2, 4, 4))}
    for path in learn_light._files(task):
        assert not learn_light._kept(task)  # nor the press alone
        learn_light._write(path, {"mark": np.array(learn_light._mark(task)), **arrays})
    assert learn_light._kept(task) and len(learn_light._read(task.place)[1]) == 1
    camera = replace(task.design, name="another")
    for other in (replace(task, depth_mm=1.0), replace(task, design=camera)):
        assert not learn_light._kept(other)
    monkeypatch.setattr(traced, "PRESSES_SINCE", traced.PRESSES_SINCE + 1)
    assert not learn_light._kept(task)
    np.savez(task.place, **arrays)  # of a version that left no mark
    assert not learn_light._kept(task)


@pytest.mark.slow
def test_noise_of_tracing_is_above_the_cameras():
    """Why there is learned light: tared previews of the paper's sensor, in blocks of 12 x 12 pixels."""
    design = twin.load_design("tsis")
    (press,) = pressing(design, fem.Inclusion(10, 5, 100), [2.0], None)
    renderer = SpectralRenderer(design.sensor(), count=design.light.bands, at=design.sensor, device="cpu")
    tared, counts = [], 0.0
    for seed in range(4):
        pair = [
            expected_counts(
                design, renderer.render(press.surface, field=field, quality="preview", seed=seed).radiance
            )
            for field in ("pressure", "pressure_0")
        ]
        tared.append(average((pair[0] - pair[1]).astype(np.float32), (12, 12)))
        counts = float(pair[0].mean())
    camera = design.camera
    photons = np.sqrt(counts * camera.gain_e_per_dn + camera.read_noise_e**2) / camera.gain_e_per_dn / 12.0
    noise = float(np.std(tared, axis=0, ddof=1).mean())
    print(f"\ntracing {noise:.3f} counts, camera {photons:.3f}")
    assert noise > 2.0 * photons
