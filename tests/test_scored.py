"""Scores against finite differences, and a change told apart against the whole of it."""

from dataclasses import replace

import numpy as np
import pytest
from sensors import paper_sensor, pressed

WIDTH = 25.0


def bump(height, push=0.1):
    """A press with a bump of pressure, which also moves the surface up, down and sideways."""

    def pressure(x, y):
        return 0.9 + height * np.exp(-((x - 1.0) ** 2 + y**2) / 20.0)

    def displacement(x, y):
        risen = pressure(x, y) - 0.9
        return 0.04 * x * risen, 0.04 * y * risen, -push * pressure(x, y)

    return pressed(pressure, displacement)


@pytest.fixture(scope="module")
def renderer(variant):
    from scenes.render import Renderer

    sensor = paper_sensor(columns=48, rows=31, pixel_um=(134.4, 156.8))
    return Renderer(replace(sensor, leds=sensor.leds[:2]), device="cpu")


def near(step=0.02):
    """A surface, one beside it, and its slopes to the height of the bump."""
    from scenes import scored, surface

    low, middle, high = (surface.resample(bump(0.4 + off), WIDTH) for off in (-step, 0.0, step))
    slopes = (
        (getattr(high, name) - getattr(low, name)) / (2 * step)
        for name in ("displacement_mm", "pressure_kPa")
    )
    return middle, high, scored.Slope(*slopes, step)


@pytest.mark.slow
def test_scores_are_what_finite_differences_find(renderer):
    """Contact fraction all over, and of one half: the same paths, chosen anew at contacts a fifth off."""
    import drjit as dr
    import mitsuba as mi

    from scenes import build, exact, surface, transport

    build.put_surface(renderer.scene, renderer.sensor, surface.resample(bump(0.4), WIDTH))
    parts = renderer.scene, renderer.sensor, renderer.table, renderer.rays
    ground = transport.survey(renderer.scene, renderer.sensor)
    fraction = ground.fraction
    parameters = mi.traverse(renderer.scene)
    name = "contact.vertex_contact_fraction"
    mesh = mi.Float(parameters[name])
    dr.eval(mesh)

    def seen(scale, seed):
        parameters[name] = mesh * scale
        parameters.update()
        return exact.exact(*parts, replace(ground, fraction=fraction * scale), 2**15, seed)

    left = fraction * (np.arange(fraction.shape[1]) < fraction.shape[1] // 2)
    slopes = np.stack([fraction, left, fraction - left])
    step, off, whole = 0.2, [], []
    for seed in range(8):
        difference = (seen(1 + step, seed) - seen(1 - step, seed)) / (2 * step)
        value = seen(1.0, seed)
        found = exact.exact(*parts, ground, 2**15, seed, slopes=slopes)
        np.testing.assert_array_equal(found[0], value)  # who asks for slopes sees the same picture
        difference, *answers = (one.sum(axis=(1, 2, 3)) for one in (difference, *found[1:]))
        np.testing.assert_allclose(answers[0], answers[1] + answers[2], rtol=1e-4)
        off.append(answers[0] - difference)
        whole.append(difference)
    off, whole = np.array(off), np.mean(whole, axis=0)
    error = off.std(axis=0, ddof=1) / np.sqrt(len(off)) / whole
    share = off.mean(axis=0) / whole
    print("scores over differences - 1:", share.round(4), "±", error.round(4))
    assert error.max() < 0.02
    assert (np.abs(share) < 4 * error + 0.004).all()  # a fifth is no small step: third order


def test_scores_know_no_other_order_of_paths(renderer):
    """Where nothing changes, nothing answers, and local tissue has no scores."""
    from scenes import build, exact, surface, transport

    build.put_surface(renderer.scene, renderer.sensor, surface.resample(bump(0.4), WIDTH))
    parts = renderer.scene, renderer.sensor, renderer.table, renderer.rays
    ground = transport.survey(renderer.scene, renderer.sensor)
    fraction = ground.fraction
    found = exact.exact(*parts, ground, 2**8, 0, slopes=np.zeros((2, *fraction.shape)))
    assert found.shape[0] == 3
    assert np.abs(found[1:]).max() == 0.0
    with pytest.raises(ValueError, match="slopes"):
        exact.exact(*parts, ground, 2**8, 0, local=True, slopes=fraction[None])


def test_a_change_told_apart_adds_up(renderer):
    """In smooth light: what contact and place change by themselves is what both change together."""
    from scenes import scored, tangent

    middle, high, slope = near()
    moved = scored.moved_along(middle, slope.step * slope.displacement_mm)
    straight = tangent.gathered(renderer, middle)
    walked = tangent.traced(renderer, middle, straight, 5, "preview", 2**12)
    first, *others = (
        tangent.picture(renderer, shape, straight, walked)
        for shape in (middle, high, scored.in_place(middle, slope), moved)
    )
    whole, contact, place = (one - first for one in others)
    print("place over contact", np.linalg.norm(place) / np.linalg.norm(contact))
    assert np.linalg.norm(place) > 0.01 * np.linalg.norm(contact)  # else it would not matter
    assert np.linalg.norm(contact + place - whole) < 0.1 * np.linalg.norm(place)


def test_moves_are_answered_together_as_alone(renderer):
    """Three unknowns that move the surface in two ways, and one that does not, with walks of one seed."""
    from scenes import scored, tangent

    middle, _, slope = near()
    down = np.zeros_like(middle.displacement_mm)
    down[..., 2] = -0.9
    none = np.zeros_like(middle.pressure_kPa)
    ways = [slope.displacement_mm, down, 0.5 * slope.displacement_mm - 2.0 * down, 0.0 * down]
    straight = tangent.gathered(renderer, middle)
    found = scored.moved(renderer, middle, straight, [scored.Slope(way, none, 0.1) for way in ways], 2**14, 3)
    np.testing.assert_allclose(found[2], 0.5 * found[0] - 2.0 * found[1], atol=1e-9 * np.abs(found[2]).max())
    assert np.abs(found[3]).max() == 0.0
    alone = scored.moved(renderer, middle, straight, [scored.Slope(down, none, 0.1)], 2**14, 3)[0]
    assert np.linalg.norm(found[1] - alone) < 0.3 * np.linalg.norm(alone)  # noise of few walks


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_moves_are_answered_as_rays_answer_them(renderer):
    """The part left to smooth light, followed ray by ray: down by a tenth of a mm."""
    from scenes import build, exact, gather, scored, surface, tangent, transport

    middle = surface.resample(bump(0.0), WIDTH)
    down = np.zeros_like(middle.displacement_mm)
    down[..., 2] = -1.0
    slope = scored.Slope(down, np.zeros_like(middle.pressure_kPa), 0.1)
    straight = tangent.gathered(renderer, middle)
    smooth = scored.moved(renderer, middle, straight, [slope], 2**20, 3)[0].sum(axis=0)

    def seen(shape, seed):
        parts = renderer.scene, renderer.sensor
        build.put_surface(*parts, shape)
        sight = gather.look(*parts, renderer.table, renderer.behind.coupling, renderer.rays)
        ground = transport.survey(*parts)
        found = exact.exact(*parts, renderer.table, renderer.rays, ground, 2**18, seed)
        return 1e6 * (np.einsum("snyx,syx->yx", found, sight.windows) + sight.lamps.sum(axis=0))

    there, far = scored.moved_along(middle, 0.1 * down), 0.1
    answers = [
        np.sum((seen(there, seed) - seen(middle, seed)) / far * smooth) / np.sum(smooth**2)
        for seed in range(12)
    ]
    share, error = np.mean(answers), np.std(answers, ddof=1) / np.sqrt(len(answers))
    print(f"moves by rays over moves by smooth light: {share:.3f} ± {error:.3f}")
    assert error < 0.03
    assert abs(share - 1.0) < 0.03 + 3.0 * error
