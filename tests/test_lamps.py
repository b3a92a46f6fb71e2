"""Intensities on radiance layers: against the same pictures put together anew, and closed forms."""

import time
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

import twin
from estimation.information import Information, Noise, bound, inform
from twin import lamp_settings as settings_of
from twin import lamps as lit
from twin.complaint import DesignError
from twin.evaluate import Judged

NOISE = Noise(shot=1 / 176.47, read_dn=12 / 176.47, offset_dn=4.0)
REFERENCE = replace(NOISE, frames=16)
NAMES = ("size_mm", "depth_mm", "modulus_kPa", "leds.0.flux_W", "camera.gain_e_per_dn", "camera.offset_dn")
PRIOR = np.array([3.2, 2.3, 0.4, 0.05, 0.01, 0.5])
SIDE = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])


def fields(theta: np.ndarray, side: int) -> np.ndarray:
    """Layers (2, 4, side, side): light from four sides that falls off, dimmed by a bump of d, h and E."""
    size, depth, modulus = theta[:3]
    y, x = np.mgrid[:side, :side] / (side - 1) - 0.5
    rise = (size / 10) ** 3 * (1 - 1 / np.exp(modulus)) * np.exp(-(x**2 + y**2) * (60 / depth + modulus))
    sides = np.stack([18 * np.exp(0.8 * (a * x + b * y)) for a, b in SIDE])
    skewed = np.stack([1 + 0.3 * (a * x + b * y) for a, b in SIDE])  # each LED sees the bump from its side
    found = np.stack([sides * (1 + 0.4 * rise * skewed), sides])
    found[:, 0] *= np.exp(theta[3])
    return found


def picture(theta: np.ndarray, intensity: Any, side: int = 24) -> np.ndarray:
    """Means (2, side, side) of all LEDs with their intensities, the gain and the offset."""
    light = np.einsum("k,pkyx->pyx", np.asarray(intensity, float), fields(theta, side))
    return light * np.exp(-theta[4]) + 4.0 + theta[5]


TRUTH = np.array([9.0, 5.0, 1.2, 0.0, 0.0, 0.0])


def slopes_of(function: Any) -> np.ndarray:
    steps = 1e-5 * np.eye(6)
    return np.stack([(function(TRUTH + h) - function(TRUTH - h)) / 2e-5 for h in steps])


def judged(side: int = 24) -> Judged:
    """What part one of an exploration keeps of a layout with all LEDs at 1."""
    mean, jacobian = picture(TRUTH, np.ones(4), side), slopes_of(lambda t: picture(t, np.ones(4), side))
    layer = slopes_of(lambda t: fields(t, side))
    told = inform(NAMES, [(jacobian[:, 0], mean[0], NOISE), (jacobian[:, 1], mean[1], REFERENCE)], PRIOR)
    return Judged(twin.Inclusion(9.0, 5.0, 60.0), mean, fields(TRUTH, side), NAMES, jacobian, layer, told, {})


def made(side: int = 24, **more: Any) -> lit.Lamps:
    held = {"noise": NOISE, "reference": REFERENCE, "top": 255.0, "flux_W": np.full(4, 0.01)}
    return lit.lamps(judged(side), **{**held, **more})


def anew(intensity: Any, noise: Noise = NOISE) -> Information:
    """The same information from pictures made with these intensities."""
    mean, jacobian = picture(TRUTH, intensity), slopes_of(lambda t: picture(t, intensity))
    many = replace(noise, frames=max(noise.frames, 16))
    return inform(NAMES, [(jacobian[:, 0], mean[0], noise), (jacobian[:, 1], mean[1], many)], PRIOR)


def test_any_setting_is_the_picture_made_anew() -> None:
    """Flux, gain and offset among the unknowns: rounded counts, 20 settings, within 1e-3 of the bounds."""
    given = made(noise=replace(NOISE, frames=9), reference=replace(NOISE, frames=144))
    settings = np.random.default_rng(1).uniform(0, 2.5, (20, 4))
    settings[0] = 1.0
    found = lit.fishers(given, settings)
    for matrix, setting in zip(found, settings, strict=True):
        fresh = anew(setting)
        wanted = bound(replace(fresh, fisher=9 * fresh.fisher)).sd
        assert bound(Information(NAMES, matrix, given.prior)).sd == pytest.approx(wanted, rel=1e-3)
    sd = lit.bounds([given], settings)[:, 0]
    assert sd[7] == pytest.approx(bound(Information(NAMES, found[7], given.prior), lit.WANTED).sd, rel=1e-9)


def test_full_pixels_tell_nothing() -> None:
    """Light without end tells nothing at all, and what has begun to saturate less than before."""
    given = made()
    assert not lit.fishers(given, [1e3] * 4).any()
    sd = lit.bounds([given], [[2.0] * 4, [4.0] * 4])[:, 0]
    assert (sd[1] > sd[0]).all()


def test_no_setting_tells_less_than_nothing() -> None:
    """However far a setting is from that which the slopes were scaled for, and however much it tells: in
    single precision one of these came out as minus 4e-4."""
    frames = 10_000
    given = made(noise=replace(NOISE, frames=frames), reference=replace(NOISE, frames=frames))
    settings = np.concatenate([np.eye(4), 0.002 + 2.0 * np.eye(4)])
    for matrix in frames * lit.fishers(given, settings) + given.prior:
        scale = np.sqrt(np.diag(matrix))
        assert np.linalg.eigvalsh(matrix / np.outer(scale, scale)).min() > 0.0


def test_one_after_the_other_is_the_sum_of_pictures_of_one() -> None:
    given, setting = made(), np.array([1.0, 0.5, 2.0, 0.0])
    alone = [lit.fishers(given, setting * (np.arange(4) == k))[0] for k in range(4)]
    assert lit.fishers(given, setting, sequential=True)[0] == pytest.approx(sum(alone), rel=1e-12)


def test_a_thousand_settings_take_under_five_seconds() -> None:
    """Four inclusions, a picture and a reference of 3600 pixels, four LEDs, 12 unknowns."""
    one = judged(60)
    assert one.layer_jacobian is not None
    names = NAMES + tuple(f"{name}'" for name in NAMES)
    noise = np.random.default_rng(2)
    slopes = one.layer_jacobian + 0.1 * noise.standard_normal(one.layer_jacobian.shape) * one.layer_jacobian
    more = replace(
        one,
        names=names,
        jacobian=np.concatenate([one.jacobian, one.jacobian + (slopes - one.layer_jacobian).sum(axis=2)]),
        layer_jacobian=np.concatenate([one.layer_jacobian, slopes]),
        information=Information(names, np.eye(12), np.diag(np.concatenate([PRIOR, PRIOR]) ** -2.0)),
    )
    given = [
        lit.lamps(more, noise=NOISE, reference=REFERENCE, top=255.0, flux_W=np.ones(4)) for _ in range(4)
    ]
    settings = np.random.default_rng(0).uniform(0.2, 1.5, (1000, 4))
    since = time.perf_counter()
    found = lit.bounds(given, settings)
    assert time.perf_counter() - since < 5.0
    assert found.shape == (1000, 4, 3) and np.isfinite(found).all()


def test_the_optimum_beats_every_setting_of_a_grid() -> None:
    """Within the power of the design and without saturation; against all settings in steps of a twelfth."""
    given = [made()]
    found = settings_of.optimise(given)
    assert found.best.power_W <= 0.04 * (1 + 1e-9) and found.best.full <= 1 + 1e-9
    assert found.best.worth <= found.before.worth
    twelfths = [
        (a, b, c, 12 - a - b - c) for a in range(13) for b in range(13 - a) for c in range(13 - a - b)
    ]
    grid = 4 * np.array(twelfths) / 12
    grid = grid / np.maximum(lit.fullness(given, grid), 1.0)[:, None]
    assert found.best.worth <= lit.worth(lit.bounds(given, grid)).min() * 1.002


def test_more_power_never_hurts_and_saturation_ends_it() -> None:
    worths = [settings_of.optimise([made()], power_W=power).best for power in (0.01, 0.04, 0.2, 10.0)]
    assert all(b.worth <= a.worth * 1.001 for a, b in pairwise(worths))
    assert worths[-1].full == pytest.approx(1.0) and worths[-1].power_W < 1.0


def test_more_light_never_hurts_below_saturation() -> None:
    """The same shares, brighter; unrounded noise is monotone, rounding may take back a little."""
    given = made(noise=replace(NOISE, bits=None), reference=replace(REFERENCE, bits=None))
    steps = np.linspace(0.05, 2.5, 40)[:, None] * np.array([1.0, 0.6, 1.3, 0.2])
    steps = steps[lit.fullness([given], steps) < 1]
    assert len(steps) > 20
    sd = lit.bounds([given], steps)[:, 0]
    assert (np.diff(sd, axis=0) <= 0).all()
    rounded = lit.bounds([made()], steps)[:, 0]
    assert (np.diff(rounded, axis=0) <= 0.02 * rounded[1:]).all()


def test_failures_and_bins() -> None:
    given = [made()]
    whole = lit.bounds(given, np.ones(4))[0]
    dark = settings_of.failures(given, np.ones(4))
    assert dark.shape == (4, 1, 3) and (dark > whole).all()
    assert dark[2] == pytest.approx(lit.bounds(given, [1.0, 1.0, 0.0, 1.0])[0])
    spread = settings_of.binning(given, np.ones(4), 0.1)
    assert spread.shape == (200, 1, 3) and spread.std(axis=0).min() > 0
    assert np.abs(spread / whole - 1).max() < 0.2
    assert settings_of.binning(given, np.ones(4), 0.0, draws=3) == pytest.approx(np.stack([whole] * 3))


def test_slopes_that_the_layers_do_not_hold_are_refused() -> None:
    one = judged()
    assert one.layer_jacobian is not None
    with pytest.raises(ValueError, match=r"size_mm: received a slope of which the layers hold .*; allowed"):
        lit.lamps(
            replace(one, layer_jacobian=0.5 * one.layer_jacobian),
            noise=NOISE,
            reference=REFERENCE,
            top=255.0,
            flux_W=np.ones(4),
        )
    with pytest.raises(ValueError, match="layer_jacobian"):
        lit.lamps(
            replace(one, layer_jacobian=None), noise=NOISE, reference=NOISE, top=255.0, flux_W=np.ones(4)
        )
    with pytest.raises(DesignError, match="power_W"):
        settings_of.optimise([made()], power_W=0.0)
    with pytest.raises(ValueError, match="intensity"):
        lit.fishers(made(), [[1.0, 1.0, 1.0, -1.0]])


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_re_weighting_is_what_evaluating_anew_finds(variant: str) -> None:
    """Real light, presses solved: four other fluxes, every bound within 0.2 %, pictures within 1e-4."""
    from twin.evaluate import Bench, Layout, Protocol, evaluate

    design, bench = twin.load_design("tsis"), Bench(cell_mm=0.8, samples=2**13)
    share = np.array([1.6, 0.3, 1.2, 0.5])
    leds = tuple(replace(led, flux_W=x * led.flux_W) for led, x in zip(design.leds, share, strict=True))
    ball = twin.Inclusion(10.0, 5.0, 60.0)
    first, anew = (
        evaluate(Layout(one, Protocol((2.0,)), {}), [ball], detection=False, bench=bench)
        for one in (design, replace(design, leds=leds))
    )
    (given,) = lit.lamps_of(first)
    light = np.tensordot(share, first.judged[0].layers, (0, 1)) + given.pictures[0].dark[0]
    assert light == pytest.approx(anew.judged[0].mean, rel=1e-4)
    found = lit.bounds([given], share, given.names)[0, 0]
    assert found == pytest.approx(np.array(list(anew.judged[0].sd.values())), rel=2e-3)
    same = lit.bounds([given], np.ones(4), given.names)[0, 0]
    assert same == pytest.approx(np.array(list(first.judged[0].sd.values())), rel=1e-5)
