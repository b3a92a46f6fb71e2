"""Derivatives of the standard picture against central differences of whole pictures, with common seeds."""

from dataclasses import dataclass, replace
from functools import cache

import numpy as np
import pytest
from sensors import paper_sensor, pressed

from scenes.contact import contact_fraction
from scenes.sensor import Lower
from scenes.skin import Skin

WIDTH = 25.0
PLACE = (1.0, 0.0)  # of the bump
GAPS = {"skin.rms_height_um": 0.5, "skin.gap_index": 0.002, "skin.dust": 0.02}
STEPS = {
    "leds.flux_W": 1e-3,
    "leds.exponent": 0.1,
    "leds.along_mm": 0.1,
    "leds.z_mm": 0.3,
    "skin.rms_slope": 0.1,
    **GAPS,
    "effective_modulus_kPa": 0.3,
    "pressure": 0.05,
    "bump": 0.05,
    "height": 0.02,
}
"""What is differentiated, and half the distance of the first differences."""


def sensor():
    """Two LEDs off the middle, with a lens, before a skin with a little dust; a small picture."""
    one = paper_sensor(columns=96, rows=61, pixel_um=(67.2, 78.4))
    lamps = zip(one.leds[:3:2], (3.0, 2.0), (-3.5, -6.0), strict=True)
    leds = tuple(
        replace(led, pattern="power", exponent=1.5, along_mm=along, z_mm=z) for led, along, z in lamps
    )
    return replace(one, leds=leds, skin=Skin(dust=0.05))


def press(scale=1.0, bump=0.0, height=0.0):
    """A bump of pressure, which pushes the surface down and aside; as much of each more."""
    from scenes import surface

    def rise(x, y):
        return np.exp(-((x - PLACE[0]) ** 2 + (y - PLACE[1]) ** 2) / 20.0)

    found = pressed(
        lambda x, y: scale * (0.9 + (0.4 + bump) * rise(x, y)),
        lambda x, y: (0.01 * x * rise(x, y), 0.01 * y * rise(x, y), -0.1 - (0.04 - height) * rise(x, y)),
    )
    return surface.resample(found, WIDTH)


def moved(name, off):
    """Sensor and press with a parameter off by so much."""
    one = sensor()
    if name.startswith("leds."):
        field = name.removeprefix("leds.")
        return replace(
            one, leds=tuple(replace(a, **{field: getattr(a, field) + off}) for a in one.leds)
        ), press()
    if name.startswith("skin."):
        field = name.removeprefix("skin.")
        return replace(one, skin=replace(one.skin, **{field: getattr(one.skin, field) + off})), press()
    if name == "effective_modulus_kPa":
        return replace(one, effective_modulus_kPa=one.effective_modulus_kPa + off), press()
    return one, press(**{"scale" if name == "pressure" else name: off + float(name == "pressure")})


def parameters(names):
    """As `gradients` takes them."""
    from scenes.gradients import Press

    bump = press(bump=1.0).pressure_kPa - press().pressure_kPa
    height = press(height=1.0).displacement_mm - press().displacement_mm
    ours = {"bump": Press("bump", pressure_kPa=bump), "height": Press("height", displacement_mm=height)}
    return [ours.get(name, name) for name in names]


@cache
def renderer_of(there):
    from scenes.render import Renderer

    return Renderer(there, device="cpu")


def picture(name, off, seed, samples):
    there, shape = moved(name, off)
    return renderer_of(there).render(shape, seed=seed, samples=samples).radiance.astype(float)


def difference(name, step, seed, samples):
    """Derivative of the picture, by differences of second order; of an index of 1 they look up only."""
    at = {1: 0.5, -1: -0.5}
    if name == "skin.gap_index":
        at = {0: -1.5, 1: 2.0, 2: -0.5}
    return sum(w / step * picture(name, k * step, seed, samples) for k, w in at.items())


@dataclass(frozen=True)
class Means:
    """Of pictures (..., n_led, rows, columns), all LEDs together: over the blob, and far from it."""

    blob: np.ndarray
    background: np.ndarray

    @staticmethod
    def of(pictures):
        rows, columns = np.shape(pictures)[-2:]
        x = ((np.arange(columns) + 0.5) / columns - 0.5) * WIDTH
        y = -((np.arange(rows) + 0.5) / rows - 0.5) * 18.5
        away = np.hypot(x - PLACE[0], y[:, None] - PLACE[1])
        whole = np.sum(pictures, axis=-3)
        return Means(whole[..., away < 3.0].mean(axis=-1), whole[..., away > 7.0].mean(axis=-1))


def apart(found, expected):
    """Largest difference of the means of two derivatives (seeds, names), relative to the second, (names,)."""
    pairs = ((found.blob, expected.blob), (found.background, expected.background))
    return np.max([np.abs((a.mean(axis=0) - b.mean(axis=0)) / b.mean(axis=0)) for a, b in pairs], axis=0)


def hold_choices(monkeypatch):
    """Let walks make the same random choices whatever the contact is: no Russian roulette, and directions
    out of the tissue as of Lambertian light. Differences of pictures then have less noise, and no other mean.
    """
    import drjit as dr
    import mitsuba as mi

    from scenes import trace
    from scenes.bsdf import Table

    def draw(self, fraction, sample1, sample2, active=True):
        return mi.warp.square_to_cosine_hemisphere(sample2)

    def density(self, fraction, cosine, active=True):
        return dr.maximum(cosine, 1e-4) * dr.inv_pi

    monkeypatch.setattr(trace, "_SURE_BOUNCES", 10_000)
    monkeypatch.setattr(trace, "ENOUGH", 1e-30)
    monkeypatch.setattr(Table, "draw", draw)
    monkeypatch.setattr(Table, "density", density)


def answered(names, seeds, samples):
    """Means of the derivatives, (seeds, names)."""
    from scenes.gradients import gradients

    asked = parameters(names)
    parts = renderer_of(sensor()), press(), asked
    return Means.of(np.array([gradients(*parts, samples=samples, seed=seed).slopes for seed in seeds]))


def differences(names, seeds, samples, share=1.0):
    """Means of differences over a share of the steps, (seeds, names)."""
    return Means.of(
        np.array([[difference(name, share * STEPS[name], seed, samples) for name in names] for seed in seeds])
    )


def show(names, found, whole, half):
    """The table: derivatives, differences over whole and half steps, and what they are apart."""
    for k, name in enumerate(names):
        for where in ("blob", "background"):
            ours, steps, halves = (getattr(one, where)[:, k] for one in (found, whole, half))
            off, middle = ours - halves, halves.mean()
            said = f"{100 * off.mean() / middle:+.2f}"
            if len(off) > 1:
                said += f" ± {100 * off.std(ddof=1) / np.sqrt(len(off)) / abs(middle):.2f}"
            print(f"{name:22} {where:10} {ours.mean():+.5g} {steps.mean():+.5g} {middle:+.5g} {said} %")


def test_the_contact_law_is_differentiated(variant):
    """Dr.Jit's derivative of the contact fraction against differences of the law in NumPy."""
    from scenes.gradients import fraction_slope

    one, pressure = sensor(), np.linspace(0.0, 6.0, 60)
    change = np.cos(pressure)

    def law(pressure=pressure, slope=one.skin.rms_slope, kappa=one.skin.kappa):
        return contact_fraction(pressure, one.effective_modulus_kPa, slope, kappa)

    step = 1e-5
    for name, low, high in (
        ("skin.rms_slope", law(slope=2.0 - step), law(slope=2.0 + step)),
        ("skin.kappa", law(kappa=1.6 - step), law(kappa=1.6 + step)),
        ("pressure", law(pressure - step * change), law(pressure + step * change)),
    ):
        found = fraction_slope(one, pressure, name, change if name == "pressure" else None)
        inside = slice(1, None)  # no pressure, no pull
        np.testing.assert_allclose(found[inside], ((high - low) / (2 * step))[inside], atol=1e-8)


@pytest.mark.parametrize(
    ("lower", "names"),
    [((), (*list(STEPS)[1:4], "height")), ((Lower(5.0, 1.5),), ("leds.along_mm", "height"))],
)
def test_gathered_light_is_differentiated_through_its_loops(variant, lower, names):
    """Dr.Jit's derivatives of irradiance on the contact, to an LED's place and pattern and to the relief,
    against differences; away from the rim beside the LEDs, where light has edges."""
    from scenes import direct
    from scenes.irradiance import AngularBasis

    ground = direct.relief(sensor(), press())
    one = replace(sensor(), guide=replace(sensor().guide, lower=lower))
    everything = AngularBasis(np.ones((1, 2, 1)), np.ones((1, 2)))
    rise = direct.relief(one, press(height=1.0)) - ground

    def light(name="leds.z_mm", off=0.0, ground=ground):
        there = replace(moved(name, off)[0], guide=one.guide)
        return direct.on(there, everything, ground)[:, 0, 40:160, 40:160]

    cases = {
        "leds.along_mm": direct.Change(along_mm=1.0),
        "leds.z_mm": direct.Change(z_mm=1.0),
        "leds.exponent": direct.Change(exponent=1.0),
        "height": direct.Change(ground=rise),
    }
    for name in names:
        found = direct.answers(one, everything, ground, cases[name])[:, 0, 40:160, 40:160]
        step = 0.1 if name == "height" else 0.02  # far above the rounding of single precision
        low, high = (
            light(ground=ground + off * rise) if name == "height" else light(name, off)
            for off in (-step, step)
        )
        expected = (high - low) / (2 * step)
        # a face between layers cuts off whole points of a disc here and there: in differences that is noise
        size = (lambda maps: np.median(np.abs(maps))) if lower else np.linalg.norm
        print(name, "off by", size(found - expected) / size(expected))
        assert size(found - expected) < (0.001 if lower else 0.01) * size(expected), name
        assert size(-found - expected) > size(expected), name


def test_derivatives_come_with_the_picture(variant):
    """The picture is the renderer's own but for the order of its sums, which libraries choose by the size of
    what they sum and by processor: a few 1e-6, and where one of the paths that leave the tissue takes another
    turn by it, some 1e-5 over a millimetre (of seeds 3 to 9 two do; without those paths none, 5e-6). That of
    the flux is the picture over the flux; every parameter answers."""
    names = ["leds.flux_W", "skin.rms_slope"]
    from scenes.gradients import gradients

    renderer = renderer_of(sensor())
    found = gradients(renderer, press(), parameters(names), samples=2**10, seed=3)
    plain = renderer.render(press(), samples=2**10, seed=3).radiance
    apart = np.abs(np.maximum(found.radiance, 0.0) / plain - 1.0)
    assert np.percentile(apart, 99) < 5e-6
    assert apart.max() < 5e-5
    np.testing.assert_allclose(found.slopes[0], found.radiance / 0.01, rtol=1e-6)
    assert np.isfinite(found.slopes).all()
    assert (np.abs(found.slopes).max(axis=(1, 2, 3)) > 0.0).all()


def stage(name):
    """A scene with the press in place, and the slope of its contact fraction on cells to a parameter."""
    from scenes import build, gradients, transport

    renderer, shape = renderer_of(sensor()), press()
    build.put_surface(renderer.scene, renderer.sensor, shape)
    move = gradients._moves(renderer, shape, parameters([name])[0])
    slope = gradients._on_cells(renderer, shape, move)
    return renderer, transport.survey(renderer.scene, renderer.sensor), slope


@pytest.mark.parametrize("name", ["bump", "skin.rms_slope"])
def test_walks_are_scored(variant, name, monkeypatch):
    """What the LEDs' walks leave, against the same walks over contacts a little off, without Russian
    roulette: then ways do not change, and differences have no noise."""
    import drjit as dr
    import mitsuba as mi

    from scenes import build, recurrence, trace
    from scenes.answers import Answers

    monkeypatch.setattr(trace, "_SURE_BOUNCES", 10_000)
    monkeypatch.setattr(trace, "ENOUGH", 1e-30)
    renderer, _, slope = stage(name)
    answers = Answers.of(WIDTH, slope[None], [None])
    each = 2**12
    number = dr.arange(mi.UInt32, 2 * each) // each

    def walked(off):
        build.put_surface(renderer.scene, sensor(), moved(name, off)[1])
        if name.startswith("skin."):
            build.put_surface(renderer.scene, moved(name, off)[0], press())
        u = recurrence.evenly(recurrence.side_by_side(each, 2), np.arange(4))
        ray, one = trace.emit(sensor(), number, u), dr.full(mi.Float, 1.0, 2 * each)
        parts = renderer.scene, sensor(), renderer.table, renderer.basis, number, ray, one
        return trace.walk(*parts, mi.UInt32(trace.IN_AIR), 5, answers, [mi.Float(0.0) * one])

    found = walked(0.0).answers[0].sum(axis=(2, 3))
    expected = (walked(STEPS[name]).maps - walked(-STEPS[name]).maps).sum(axis=(2, 3)) / (2 * STEPS[name])
    print(name, "scored walks over differences:", np.sum(found * expected) / np.sum(expected**2))
    assert np.linalg.norm(found - expected) < 0.02 * np.linalg.norm(expected)


@pytest.mark.parametrize("name", ["bump", "skin.rms_slope"])
def test_the_tissue_is_linearised(variant, name):
    """What goes to the camera of given light, against contacts a little off: whole, and cell by cell."""
    from scenes import direct, transport
    from scenes.response import Landed, Response

    renderer, ground, slope = stage(name)
    basis, behind = renderer.basis, renderer.behind
    light = direct.direct(sensor(), basis, press()).astype(np.float32)

    def seen(off):
        there = replace(ground, fraction=ground.fraction + off * slope)
        return transport.Under.at(basis, behind, there).seen(light)

    under = transport.Under.at(basis, behind, ground)
    response = Response.of(under, slope[None], [None])
    middle, found = response.seen(Landed(light, np.zeros((1, *light.shape), np.float32)))
    step = 0.01 / np.abs(slope).max()
    low, high = seen(-step), seen(step)
    np.testing.assert_allclose(middle.maps, seen(0.0).maps, rtol=1e-5, atol=1e-6 * middle.maps.max())
    parts = ([*np.moveaxis(one.maps, 1, 0), one.behind_mm, one.steeper] for one in (found, low, high))
    for number, (ours, before, after) in enumerate(zip(*parts, strict=True)):
        expected = (after - before) / (2 * step)
        off = np.linalg.norm(ours - expected) / np.linalg.norm(expected)
        print(name, number, "off by", off)
        assert off < 0.02


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_table_of_the_contact(variant, monkeypatch):
    """Pictures of walks whose choices do not hang on the contact: nothing is left to noise."""
    from scenes.answers import Answers

    hold_choices(monkeypatch)
    names = ["skin.rms_slope", "effective_modulus_kPa", "skin.rms_height_um", "skin.dust", "pressure", "bump"]
    asked, parts = [*names, "skin.gap_index", "height"], (range(1), 2**14)
    found, whole, half = answered(asked, *parts), differences(asked, *parts), differences(asked, *parts, 0.5)
    show(asked, found, whole, half)
    must = slice(0, len(names))  # of the others the differences themselves do not converge
    assert (apart(whole, half)[must] < 0.01).all()
    assert (apart(found, half)[must] < 0.005).all()
    assert (apart(Means(-found.blob, -found.background), half)[must] > 0.005).all()
    monkeypatch.setattr(Answers, "mirrored", lambda self, table, p, fraction, cosine, active: [0.0 * p.x])
    for name in ("skin.rms_slope", "bump"):  # light that a contact takes is missed elsewhere
        k = asked.index(name)
        there = Means(half.blob[:, k : k + 1], half.background[:, k : k + 1])
        off = apart(answered([name], *parts), there)[0]
        print(f"{name} without its scores: apart by {off:.4f}")
        assert off > 0.005


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_table_of_the_leds(variant, monkeypatch):
    """Walked light of LEDs that move has the noise of its paths, in both; the rim's light is not left out."""
    from scenes import followed

    names = ["leds.flux_W", "leds.exponent", "leds.along_mm", "leds.z_mm"]
    parts = (range(4), 2**18)
    found, half = answered(names, *parts), differences(names, *parts, 0.5)
    few = differences(names, range(1), 2**18)
    show(names, found, few, half)
    first = Means(half.blob[:1], half.background[:1])
    print("whole steps against half ones:", apart(few, first))
    for where in ("blob", "background"):
        off = getattr(found, where) - getattr(half, where)
        noise = off.std(axis=0, ddof=1) / np.sqrt(len(off))
        size = np.abs(getattr(half, where).mean(axis=0))
        assert (noise < 0.04 * size).all()
        assert (np.abs(off.mean(axis=0)) < 0.03 * size).all()
    assert (apart(Means(-found.blob, -found.background), half) > 0.5).all()

    walked = followed._walked

    def without_rim(*given):
        landed = walked(*given)
        return replace(landed, slopes=0.0 * landed.slopes) if given[-1] is True else landed

    monkeypatch.setattr(followed, "_walked", without_rim)
    blind = answered(names[2:], *parts)
    there = Means(half.blob[:, 2:], half.background[:, 2:])
    print("without the rim's light apart by", apart(blind, there))
    assert (apart(blind, there) > 0.1).all()
