"""Light that spreads sideways in the tissue: conservation, reciprocity, limits, speed."""

import time

import numpy as np
import pytest

from scenes.contact import ContactOptics, contact_optics
from scenes.spread import Spread, spreader
from scenes.tissue import Coupling, TissueOptics, couple, tissue_optics

N1, N3, WIDTH = 1.4336, 1.40, 25.0


def setting(
    scattering: float = 1.0, absorption: float = 0.02, cells: int = 100, modes: int = 2
) -> tuple[ContactOptics, TissueOptics, Coupling, Spread]:
    optics = contact_optics(N1, 1.0, N3, 0.5, 10.0, 550.0)
    tissue = tissue_optics(scattering, absorption, modes=modes)
    coupling = couple(optics, tissue, N1, N3, 1.0)
    return optics, tissue, coupling, spreader(tissue, coupling, WIDTH, cells)


def patchy(cells: int) -> np.ndarray:
    """Real contact from none to full, over millimetres."""
    y, x = np.mgrid[0:cells, 0:cells] / cells
    return np.clip(0.5 + 0.8 * np.sin(19 * x) * np.cos(13 * y), 0.0, 1.0)


def test_uniform_light_gives_the_local_gain() -> None:
    """In the middle of a guide 250 mean free paths wide, at nodes of the contact's table."""
    _, _, coupling, spread = setting(10.0, 0.2)
    entering = np.zeros((2, 2, 100, 100))
    entering[0, 0] = entering[1, 1] = 1.0
    for node in (0, 26, 128):
        upward = spread.solve(entering, np.full((100, 100), node / 128), 1e-9)[:, :, 50, 50]
        np.testing.assert_allclose(upward.T * coupling.scale, coupling.gain[node], rtol=2e-5, atol=1e-7)


def test_tissue_of_short_paths_is_local_everywhere() -> None:
    """µs' -> infinity: each cell answers by its own gain (the contact changes over millimetres)."""
    _, _, coupling, spread = setting(3000.0, 60.0, cells=60)
    fraction = patchy(60)
    entering = np.stack([1.0 + fraction, 0.1 * fraction])[None]
    upward = spread.solve(entering, fraction)
    node = np.linspace(0, 1, 129)
    gain = np.stack([[np.interp(fraction, node, coupling.gain[:, i, j]) for j in (0, 1)] for i in (0, 1)])
    local = np.einsum("ijyx,njyx->niyx", gain, entering) / coupling.scale
    np.testing.assert_allclose(upward[:, 0], local[:, 0], rtol=4e-3)


def test_solution_solves_the_equation() -> None:
    """V_0 = R (*) [E_0 + Σ W_0j V_j], with R summed over cells in plain loops; cells an eighth of a path."""
    _, tissue, coupling, spread = setting(0.25, 0.05, cells=60)
    fraction = patchy(60)
    entering = np.random.default_rng(1).random((1, 2, 60, 60))
    upward = spread.solve(entering, fraction, 1e-8)
    node = np.linspace(0, 1, 129)
    held = [[np.interp(fraction, node, coupling.held[:, i, j]) for j in (0, 1)] for i in (0, 1)]
    second = tissue.strengths[1] * (entering[0, 1] + held[1][0] * upward[0, 0] + held[1][1] * upward[0, 1])
    np.testing.assert_allclose(upward[0, 1], second, rtol=1e-4)
    # bare skin goes on far around: the same equation on a grid three times as wide, by iteration
    wide = 180
    down = np.zeros((wide, wide))
    inner = slice(60, 120)
    shares = tissue.kernel.cells(tissue.transport_per_mm * WIDTH / 60, wide)
    index = np.abs(np.arange(wide)[:, None] - np.arange(wide))
    up = np.zeros((wide, wide))
    for _ in range(60):
        down[...] = spread.free * up
        down[inner, inner] = entering[0, 0] + held[0][0] * up[inner, inner] + held[0][1] * upward[0, 1]
        up = apply(shares, index, down)
    np.testing.assert_allclose(upward[0, 0], up[inner, inner], rtol=5e-4)


def apply(shares: np.ndarray, index: np.ndarray, light: np.ndarray) -> np.ndarray:
    """Convolution along y by a matrix for each distance in x."""
    result = np.zeros_like(light)
    for away in range(light.shape[1]):
        column = shares[away][index]  # (to y, from y) at this distance in x
        if away == 0:
            result += column @ light
        else:
            result[:, away:] += column @ light[:, :-away]
            result[:, :-away] += column @ light[:, away:]
    return result


def test_light_from_here_seen_there_is_light_from_there_seen_here() -> None:
    _, _, _, spread = setting()
    one, other = np.random.default_rng(2).random((2, 1, 2, 100, 100))
    fraction = patchy(100)
    there = (other * spread.solve(one, fraction)).sum()
    here = (one * spread.solve(other, fraction)).sum()
    assert there == pytest.approx(here, rel=1e-6)


def test_no_more_leaves_than_enters_and_all_of_it_if_the_tissue_is_white() -> None:
    """Flux up less flux thrown back is what leaves: all that enters if the tissue is white."""
    _, _, coupling, spread = setting(20.0, 0.0)
    fraction = np.full((100, 100), 64 / 128)
    entering = np.zeros((1, 2, 100, 100))
    entering[0, 0, 40:60, 40:60] = 1.0
    upward = spread.solve(entering, fraction, 1e-7)
    lost = np.eye(2)[0] - coupling.held[64, 0]
    left = (lost[:, None, None] * upward[0]).sum()
    assert 0.985 < left / entering.sum() < 1.0  # R falls as 1/r³ in white tissue: the rest goes round the rim


def test_answer_falls_with_contact_and_rises_with_scattering() -> None:
    light = np.zeros((1, 2, 100, 100))
    light[0, 0, 50, 50] = 1.0
    brightness = [
        setting(s)[3].solve(light, np.full((100, 100), a)).sum() for s in (0.5, 2.0) for a in (1.0, 0.1)
    ]
    assert brightness[0] < brightness[1] < brightness[3] and brightness[0] < brightness[2] < brightness[3]


def test_same_bits_every_time_and_each_led_on_its_own() -> None:
    _, _, _, spread = setting()
    light = np.random.default_rng(3).random((4, 2, 100, 100))
    fraction = patchy(100)
    together = spread.solve(light, fraction)
    assert np.array_equal(together, spread.solve(light, fraction))
    np.testing.assert_allclose(spread.solve(light[2:3], fraction)[0], together[2], rtol=3e-6)


def test_dark_stays_dark_and_a_black_sheet_gives_nothing_back() -> None:
    optics, _, _, spread = setting()
    assert np.all(spread.solve(np.zeros((1, 2, 100, 100)), patchy(100)) == 0.0)
    black = tissue_optics(0.0, 30.0, 0.3)
    nothing = spreader(black, couple(optics, black, N1, N3, 1.0), WIDTH, 100)
    assert np.all(nothing.solve(np.ones((1, 2, 100, 100)), patchy(100))[:, 0] == 0.0)


def test_light_enters_and_leaves_a_thin_white_sheet_at_the_same_place() -> None:
    """A sheet of a tenth of a cell: the local gain at every cell but the rim's."""
    optics = contact_optics(N1, 1.0, N3, 0.5, 10.0, 550.0)
    sheet = tissue_optics(20.0, 0.1, 0.02, 0.8)
    coupling = couple(optics, sheet, N1, N3, 1.0)
    light = np.zeros((1, 2, 100, 100))
    light[0, 0] = 1.0
    upward = spreader(sheet, coupling, WIDTH, 100).solve(light, np.full((100, 100), 0.25))[0, :, 50, 50]
    np.testing.assert_allclose(upward * coupling.scale, coupling.gain[32, :, 0], rtol=2e-4, atol=1e-6)


def test_four_leds_take_well_under_a_tenth_of_a_second() -> None:
    """m = 200; time of the processor, the fastest of twenty, so that a busy machine does not decide."""
    _, _, _, spread = setting(cells=200)
    light, fraction = np.random.default_rng(4).random((4, 2, 200, 200)), patchy(200)

    def seconds() -> float:
        start = time.process_time()
        spread.solve(light, fraction)
        return time.process_time() - start

    assert min(seconds() for _ in range(20)) < 0.1
