"""What a layout can tell: counts and slopes against closed forms, more light, more pictures, fewer unknowns.

Presses are made up in closed form in place of the mechanics, as in test_forward.py; the mechanics' own slopes
are compared with each other in the slow tests.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from sensors import pressed
from test_simulate import small

import fem
import twin
from fem import spheres
from fem.background import spheres_on_background
from fem.mesh import QUALITIES
from twin import coarse as pixels
from twin import evaluate as judging
from twin import layout_fields, layout_study, touches
from twin.complaint import DesignError
from twin.evaluate import Bench, Layout, Protocol, evaluate
from twin.forward import DEPTH, Unknown, step_of
from twin.layers import Lighting

BALL = fem.Inclusion(9.0, 5.0, 80.0, (1.0, -0.5))
FEW = (
    Unknown("size_mm", 3.0),
    Unknown("modulus_kPa", 23.0),
    Unknown("specimen.modulus_kPa", 0.05, relative=True),
    Unknown("surface.rms_slope", 0.1, relative=True),
    Unknown("camera.gain_e_per_dn", 0.01, relative=True),
    Unknown("leds.*.flux_W", 0.01, relative=True),
)


def design(**camera: Any) -> twin.Design:
    """Two LEDs, and few pixels."""
    base = small(48, 30)
    return replace(base, leds=base.leds[:2], camera=replace(base.camera, **camera))


class Pressed:
    """A bump that rises with size, depth and modulus, over 0.45 kPa per mm and kPa of tissue over 5."""

    def __init__(self, there: twin.Design, ball: fem.Inclusion, level: float) -> None:
        base = 0.45 * level * there.specimen.modulus_kPa / 5.0
        rise = base * 0.17 * (ball.size / ball.depth) ** 2 * ball.modulus / (ball.modulus + 20.0)
        x0, y0 = ball.offset

        def pressure(x: Any, y: Any) -> Any:
            return base + rise * np.exp(-((x - x0) ** 2 + (y - y0) ** 2) / (0.3 * ball.size**2))

        self.surface = pressed(pressure, lambda x, y: (0.0, 0.0, -0.01 * pressure(x, y)))
        plain = pressed(lambda x, y: base, lambda x, y: (0.0, 0.0, -0.01 * base))
        for name in ("pressure", "displacement"):
            self.surface[f"{name}_0"] = plain[name]


class Emulator:
    """Stands where an emulator does: only its name is asked for."""

    plan = "closed form"
    pressure = np.ones(1)


@pytest.fixture(scope="module")
def bench(variant: str) -> Any:
    """Layouts evaluated on one bench, so that light is computed once."""
    kept = Bench(samples=2**12)
    patch = pytest.MonkeyPatch()
    patch.setattr(touches.presses, "emulated", lambda d, b, levels, e: [Pressed(d, b, lv) for lv in levels])

    def told(layout: Layout, unknowns: Any = FEW, **more: Any) -> judging.Evaluation:
        more = {"detection": False, "bench": kept, **more}
        return evaluate(layout, [BALL], unknowns, emulator=Emulator(), **more)  # type: ignore[arg-type]

    yield told
    patch.undo()


def layout(levels: tuple[float, ...] = (2.0,), frames: int = 1, **camera: Any) -> Layout:
    return Layout(design(**camera), Protocol(levels, frames=frames), {})


def sd(evaluation: judging.Evaluation) -> np.ndarray:
    return np.array([evaluation.judged[0].sd[name] for name in ("size_mm", "modulus_kPa")])


def test_slopes_have_closed_forms(bench: Any) -> None:
    """Counts go as one over the electrons per count, and a LED's share of them as its flux."""
    found = bench(layout()).judged[0]
    offset = design().camera.offset_dn
    at = found.names.index
    light = found.mean - offset
    assert found.jacobian[at("camera.gain_e_per_dn")] == pytest.approx(-light, rel=1e-4, abs=1e-5)
    for led in range(2):
        slope = found.jacobian[at(f"leds.{led}.flux_W")]
        assert slope == pytest.approx(found.layers[:, led], rel=1e-6)
    dark = 1e-3 * float(light.max())
    assert np.abs(found.layers.sum(axis=1) - light).max() < dark
    assert found.layer_jacobian is not None
    assert found.layer_jacobian.sum(axis=2) == pytest.approx(found.jacobian, rel=1e-3, abs=dark)
    # rough contact knows p / (E* h'): in this bump tissue's modulus is pressure, less what E* takes
    slope = found.jacobian[at("surface.rms_slope")][1]
    star = design().effective_modulus_kPa * (1 - 0.49**2)
    felt = 1.0 - star / design().specimen.modulus_kPa
    tissue = found.jacobian[at("specimen.modulus_kPa")][1]
    assert (tissue * slope).sum() / (slope**2).sum() == pytest.approx(-felt, abs=0.05)


def test_the_reference_knows_nothing_of_the_inclusion(bench: Any) -> None:
    found = bench(layout()).judged[0]
    assert not found.jacobian[:2, 1].any() and found.jacobian[:2, 0].any()


@pytest.mark.slow
def test_more_of_everything_never_hurts(bench: Any) -> None:
    """Frames, levels, light below saturation, and unknowns that become known lower every bound."""
    one = sd(bench(layout()))
    assert (sd(bench(layout(frames=16))) < one).all()
    assert (sd(bench(layout((1.0, 2.0)))) < one).all()
    exposure = design().camera.exposure_ms
    brighter = [bench(layout(exposure_ms=factor * exposure)) for factor in (0.5, 0.7, 1.0, 1.2)]
    assert all(there.objectives["saturated_percent"] == 0.0 for there in brighter)
    assert (np.diff([sd(there) for there in brighter], axis=0) < 0).all()
    for number in range(3, len(FEW)):
        fewer = tuple(unknown for k, unknown in enumerate(FEW) if k != number)
        assert (sd(bench(layout(), fewer)) <= one * (1 + 1e-9)).all(), FEW[number]


@pytest.mark.slow
def test_information_adds_over_pictures(bench: Any) -> None:
    both, one, two = (bench(layout(levels)).judged[0].information for levels in ((1.0, 2.0), (1.0,), (2.0,)))
    assert both.fisher == pytest.approx(one.fisher + two.fisher, rel=1e-9)


def test_a_camera_costs_no_light(bench: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    bench(layout())

    def none(*_: Any) -> Any:
        raise AssertionError("a picture was rendered")

    monkeypatch.setattr(Lighting, "_picture", none)
    for camera in ({"bits": 12, "gain_e_per_dn": 11.0}, {"read_noise_e": 5.0}, {"full_well_e": 9e4}):
        assert (sd(bench(layout(**camera))) > 0).all()
    with pytest.raises(AssertionError, match="rendered"):
        bench(layout(field_of_view_mm=20.0))


def test_the_same_seed_gives_the_same_numbers(bench: Any) -> None:
    few, one, another = FEW[:1], Bench(samples=2**12), Bench(samples=2**12)
    first, again, other = (
        bench(layout(), few, bench=used, seed=seed) for used, seed in ((one, 3), (another, 3), (another, 4))
    )
    assert first.judged[0].mean.tobytes() == again.judged[0].mean.tobytes()
    assert first.objectives == again.objectives
    assert first.judged[0].mean.tobytes() != other.judged[0].mean.tobytes()


def test_coarse_pixels_keep_the_information(variant: str) -> None:
    """Of an even picture a coarse camera tells what the fine one does, rounding included."""
    fine = twin.load_design("tsis")
    few, block = pixels.coarse(fine, 0.5)
    assert block * few.camera.rows * few.camera.columns == 768 * 492
    for level in (0.01, 0.3, 0.6):
        from twin.exposure import expected_counts

        many = expected_counts(fine, np.full((1, 492, 768), level))
        some = pixels.counted(few, np.full((1, *few.camera.shape), level)).mean
        assert some.mean() == pytest.approx(many.mean(), rel=1e-12)
        from estimation.information import pixel_information
        from twin.forward import noise_of

        whole = pixel_information(many, noise_of(fine)).sum()
        assert pixel_information(some, pixels.noise(few, block, 1)).sum() == pytest.approx(whole, rel=1e-9)


def test_exposure_is_filled(bench: Any) -> None:
    found = bench(layout(), fill=0.9)
    bright = np.percentile(found.judged[0].mean[0], 99.9) - design().camera.offset_dn
    assert bright == pytest.approx(0.9 * (255 - design().camera.offset_dn), rel=0.02)


def test_unknowns_and_presses_that_cannot_be_are_refused(bench: Any) -> None:
    for unknown in (Unknown("surface.dust", 0.1), Unknown("camera.rows", 1.0), Unknown("size_mm", 0.0)):
        with pytest.raises(DesignError, match=r"received .*; allowed "):
            bench(layout(), (unknown,))
    with pytest.raises(DesignError, match=r"protocol\.indentation_mm"):
        bench(layout((50.0,)))


@pytest.mark.parametrize("emulator", [Emulator(), None])
def test_steps_beyond_what_a_design_allows_are_taken_on_the_other_side(
    emulator: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The press may be no deeper, its specimen no thinner, its inclusion no larger; fields go as depth over
    thickness here."""
    deepest = design()
    deepest = replace(deepest, press=replace(deepest.press, indentation_mm=(6.0,)))
    ball = replace(BALL, size=30.0 - 15.0 - 0.02, depth=15.0)  # near the chest wall

    class Thin(Pressed):
        path = "tied"

        def __init__(self, there: twin.Design, inside: fem.Inclusion, level: float) -> None:
            super().__init__(there, replace(inside, size=9.0), level * 30.0 / there.specimen.thickness_mm)

    monkeypatch.setattr(touches.presses, "emulated", lambda d, b, lv, e: [Thin(d, b, one) for one in lv])
    monkeypatch.setattr(touches, "_press", lambda there, inside, _: Thin(there, inside, 1.0))
    unknowns = [Unknown("specimen.thickness_mm", 1.0), Unknown("size_mm", 3.2), Unknown(DEPTH, 0.01, True)]
    found = touches.touch(deepest, ball, 6.0, (0.0, 0.0), unknowns, emulator)
    plain = found.plain[3]
    assert found.slopes["specimen.thickness_mm"][1, 3] == pytest.approx(-plain / 30.0, rel=1e-4)
    assert found.slopes[DEPTH][1, 3] == pytest.approx(plain, rel=1e-4)
    assert np.abs(found.slopes["size_mm"]).max() < 1e-6


def test_steps_keep_an_inclusion_an_inclusion() -> None:
    """Also one that is softer than the step that others are told with."""
    for name, value in (("modulus_kPa", 1.5), ("depth_mm", 0.05), ("size_mm", 0.05)):
        assert 0.0 < step_of(Unknown(name, 20.0), value) < 0.5 * value
    assert step_of(Unknown("modulus_kPa", 23.0), 80.0) == 2.0
    assert step_of(Unknown("offset_x_mm", 1.0), 0.0) == pytest.approx(0.1)


def test_lumps_that_an_emulator_does_not_know_are_solved(monkeypatch: pytest.MonkeyPatch) -> None:
    """An emulator of a narrower sensor ends above the deepest of them."""

    class Solved(Exception):
        pass

    def emulated(there: twin.Design, ball: fem.Inclusion, levels: Any, emulator: Any) -> list[Pressed]:
        if ball.depth > 8.0:
            raise fem.NotModelled("inclusion.depth: received 11 mm; allowed in this emulator 3.5 to 10 mm")
        return [Pressed(there, ball, level) for level in levels]

    def press(there: twin.Design, ball: fem.Inclusion, by_multipoles: bool) -> Any:
        assert ball.depth == 11.0 and by_multipoles
        raise Solved

    monkeypatch.setattr(touches.presses, "emulated", emulated)
    monkeypatch.setattr(touches, "_press", press)
    with pytest.raises(Solved):
        evaluate(layout(), [BALL], FEW, emulator=Emulator(), bench=Bench(samples=2**12), detection=True)  # type: ignore[arg-type]


@pytest.mark.slow
def test_solved_slopes_are_those_of_independent_solves() -> None:
    """By multipoles, symmetry, proportion and differences, against meshes that follow the inclusion and share
    nothing but the physics: these are off by more themselves, and come nearer as they are refined."""
    there = twin.load_design("tsis")
    ball = fem.Inclusion(9.0, 6.0, 80.0)
    unknowns = [Unknown(n, s) for n, s in (("size_mm", 3.2), ("depth_mm", 2.3), ("modulus_kPa", 23.0))]
    unknowns += [Unknown("offset_x_mm", 1.0), Unknown("offset_y_mm", 1.0), Unknown(DEPTH, 0.01, True)]
    found = touches.touch(there, ball, 2.0, (0.0, 0.0), unknowns, None)
    inner = (slice(None), slice(20, -20), slice(20, -20))

    def tared(one: fem.Inclusion, quality: str) -> np.ndarray:
        press = fem.press(
            there.probe(), there.slab(), one, 2.0, mechanics="linear", quality=quality, estimate=False
        )
        both = touches._both(there, there, press.surface)
        return (both[0] - both[1])[inner]

    ends = {
        "size_mm": [replace(ball, size=9.0 + s) for s in (0.3, -0.3)],
        "depth_mm": [replace(ball, depth=6.0 + s) for s in (0.3, -0.3)],
        "modulus_kPa": [replace(ball, modulus=80.0 + s) for s in (6.0, -6.0)],
        "offset_x_mm": [replace(ball, offset=(s, 0.0)) for s in (0.3, -0.3)],
        "offset_y_mm": [replace(ball, offset=(0.0, s)) for s in (0.3, -0.3)],
    }
    for name, (high, low) in ends.items():
        step = 12.0 if name == "modulus_kPa" else 0.6
        mine = found.slopes[name][0][inner].astype(float)
        off = []
        for quality in ("preview", "standard"):
            slope = (tared(high, quality) - tared(low, quality)) / step
            off.append([np.linalg.norm(mine[k] - slope[k]) / np.linalg.norm(slope[k]) for k in (2, 3)])
        print(name, "displacement and pressure off by", off)
        coarse, fine = np.array(off)
        assert (fine < coarse).all(), name
        assert fine[0] < 0.02, name
        assert fine[1] < (0.03 if "offset" not in name else 0.07), name
        assert not found.slopes[name][1].any()
    assert found.slopes[DEPTH][1] == pytest.approx(found.plain, rel=1e-5, abs=1e-7)


@pytest.mark.slow
def test_bounds_of_solved_presses_are_those_of_finer_tissue(
    variant: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What tells size, depth and modulus apart is a thousandth of what any of them changes: four times as
    many cells along each side of the tissue, ten degrees of multipoles, another background."""
    study = layout_study.load("layers").study
    base = layout_fields.base(study, twin.load_design("tsis"))
    names = "size_mm", "depth_mm", "modulus_kPa"

    def bounds() -> np.ndarray:
        unknowns = tuple(one for one in study.unknown() if "offset" not in one.name)
        fill = study.exposure_fill
        found = evaluate(base, study.balls(), unknowns, fill=fill, detection=False, bench=Bench())
        return np.array([found.objectives["bound_" + name] for name in names])

    coarse = bounds()
    fine = replace(spheres.QUALITIES["standard"].mesh, arc=6, shell=3, above=3, below=3, edge=3, layer=3)
    monkeypatch.setitem(spheres.QUALITIES, "fine", spheres.Fineness(fine, 10))

    def press(there: twin.Design, ball: fem.Inclusion, by_multipoles: bool) -> Any:
        assert by_multipoles
        found = fem.multipoles(there.probe(), there.slab(), "fine").press(ball, [1.0])
        return spheres_on_background(found, there.probe(), there.slab(), QUALITIES["reference"])[0]

    monkeypatch.setattr(touches, "_press", press)
    finer = bounds()
    print("bounds on d, h, E", coarse, "in finer tissue", finer)
    assert coarse == pytest.approx(finer, rel=0.04)


@pytest.mark.parametrize("efficiency", [0.5, 1.0])
def test_a_camera_that_misses_nothing_has_a_slope_to_its_efficiency(efficiency: float) -> None:
    """Counts go with it; at 1, which no step passes, the slope is taken to one side."""
    base = small()
    design = replace(base, camera=replace(base.camera, quantum_efficiency=efficiency, full_well_e=1e7))
    radiance = np.full((1, len(design.leds), *design.camera.shape), 1e-3)
    unknown = Unknown("camera.quantum_efficiency", 0.01, relative=True)
    layers, rest = judging._camera_slope(design, radiance, unknown)
    np.testing.assert_allclose(layers, pixels.counted(design, radiance).layers, rtol=1e-3)
    np.testing.assert_allclose(rest, 0.0, atol=1e-6)
