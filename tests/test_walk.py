"""The volumetric walk against published values, and the standard kernel against the walk."""

from types import ModuleType
from typing import Any

import numpy as np
import pytest

from scenes.contact import contact_optics
from scenes.ftir import gap_transmittance
from scenes.slab import Slab, cosines
from scenes.spread import spreader
from scenes.tissue import couple, tissue_optics

PHOTONS = 400_000


@pytest.fixture
def steps(variant: str) -> ModuleType:
    from scenes import walk

    return walk


def reflected(
    steps: ModuleType, scattering: float, absorption: float, g: float, n: float
) -> tuple[float, float]:
    """Total reflectance at normal incidence from air, mirror reflection included, and its error."""
    body = steps.Body(steps.Medium(scattering, absorption, g))
    share, error = steps.walk(body, PHOTONS, 1, entry=1.0, indices=(n, 1.0)).reflectance
    mirror = ((n - 1) / (n + 1)) ** 2
    return mirror + (1 - mirror) * share, error


# (albedo, g, index, total reflectance at normal incidence of a half-space), mirror reflection included. The first is
# Giovanelli's (1955; key giovanelli1955), as in Wang, Jacques & Zheng (1995; key wang1995); the second and third
# stand in the tests of iadpython, the rest were computed with it (0.5.3, 32 angles), an independent code for adding
# and doubling (Prahl, van Gemert & Welch 1993; key prahl1993).
PUBLISHED = [
    (0.9, 0.0, 1.5, 0.2600),
    (0.8, 0.0, 1.0, 0.28525),
    (0.6, 0.0, 1.33, 0.10275),
    (0.98, 0.0, 1.4, 0.53159),
    (0.95, 0.5, 1.4, 0.27593),
    (0.99, 0.9, 1.4, 0.27868),
]


@pytest.mark.parametrize(("albedo", "g", "index", "published"), PUBLISHED)
def test_half_space_reflects_as_published(
    steps: ModuleType, albedo: float, g: float, index: float, published: float
) -> None:
    share, error = reflected(steps, albedo, 1 - albedo, g, index)
    assert error < 0.004 * published
    assert share == pytest.approx(published, rel=0.01)


def test_slab_reflects_and_passes_as_published(steps: ModuleType) -> None:
    """µa = 1, µs = 9 per mm, g = 0.75, 0.2 mm, matched: van de Hulst (1980; key hulst1980), by Wang et al. (1995)."""
    body = steps.Body(steps.Medium(9.0, 1.0, 0.75), thickness_mm=0.2)
    walked = steps.walk(body, 1_000_000, 1, entry=1.0)
    assert walked.reflectance[0] == pytest.approx(0.09739, rel=0.01)
    assert walked.transmittance[0] == pytest.approx(0.66096, rel=0.01)


def agrees(share: tuple[float, float], exact: float, sigmas: float = 4.0) -> bool:
    return abs(share[0] - exact) < sigmas * share[1]


@pytest.mark.parametrize("cosine", [0.1, 0.5, 1.0])
def test_beams_reflect_as_chandrasekhar_says(steps: ModuleType, cosine: float) -> None:
    walked = steps.walk(steps.Body(steps.Medium(0.9, 0.1)), PHOTONS, 2, entry=cosine)
    assert agrees(walked.reflectance, Slab(0.9).plane_albedo(np.array([cosine]))[0])


def test_sheet_on_a_backing_reflects_as_the_slab_does(steps: ModuleType) -> None:
    body = steps.Body(steps.Medium(0.9, 0.1), thickness_mm=1.5, backing=0.8)
    walked = steps.walk(body, PHOTONS, 3, edges_mm=np.geomspace(0.1, 6.0, 9))
    sheet = tissue_optics(0.9, 0.1, 1.5, 0.8)
    assert agrees(walked.reflectance, sheet.reflectance)
    rings = np.diff(sheet.within(walked.edges_mm)) / np.pi / np.diff(walked.edges_mm**2)
    assert np.all(np.abs(walked.profile - rings) < 4.5 * walked.profile_error + 1e-3 * rings)


def test_standard_kernel_has_the_walks_profile_from_a_fifth_to_five_millimetres(steps: ModuleType) -> None:
    """Within 5 %, and within its own noise of some 0.5 %, for the paper sensor's tissue; total within 1 %."""
    edges = np.geomspace(0.2, 5.0, 15)
    walked = steps.walk(steps.Body(steps.Medium(1.0, 0.02)), 2_000_000, 4, edges_mm=edges)
    tissue = tissue_optics(1.0, 0.02)
    rings = np.diff(tissue.within(edges)) / np.pi / np.diff(edges**2)
    assert tissue.reflectance == pytest.approx(walked.reflectance[0], rel=0.003)
    np.testing.assert_allclose(rings, walked.profile, rtol=0.02)
    assert np.all(np.abs(rings - walked.profile) < 4.5 * walked.profile_error)


@pytest.mark.slow
@pytest.mark.parametrize(("scattering", "absorption"), [(0.5, 0.002), (5.0, 0.3), (2.0, 0.01)])
def test_standard_kernel_has_the_walks_profile_over_the_range_of_tissues(
    steps: ModuleType, scattering: float, absorption: float
) -> None:
    edges = np.geomspace(0.2, 5.0, 15)
    walked = steps.walk(steps.Body(steps.Medium(scattering, absorption)), 8_000_000, 4, edges_mm=edges)
    tissue = tissue_optics(scattering, absorption)
    rings = np.diff(tissue.within(edges)) / np.pi / np.diff(edges**2)
    assert tissue.reflectance == pytest.approx(walked.reflectance[0], rel=0.003)
    assert np.all(np.abs(rings - walked.profile) < 0.05 * rings + 4.5 * walked.profile_error)


@pytest.mark.parametrize("n_before", [1.4336, 1.0])
def test_modes_and_face_together_are_the_walk_under_a_real_face(steps: ModuleType, n_before: float) -> None:
    """Full contact with the guide, and bare skin: what leaves of Lambertian light that has entered."""
    walked = steps.walk(steps.Body(steps.Medium(1.0, 0.02)), 1_000_000, 5, indices=(1.4, n_before))
    tissue = tissue_optics(1.0, 0.02)
    node, weight = np.polynomial.legendre.leggauss(1000)
    mu = 0.5 * (1 + node)
    lobes = tissue.lobe(mu)
    passes = 0.5 * sum(gap_transmittance(1.4, n_before, n_before, 0.0, mu, 550.0))
    held = np.einsum("m,im,jm->ij", weight * mu * (1 - passes), lobes, lobes)
    rho = np.diag(tissue.strengths)
    upward = np.linalg.solve(np.eye(2) - rho @ held, rho[:, 0])
    assert (weight * mu * passes * lobes).sum(axis=1) @ upward == pytest.approx(
        walked.reflectance[0], rel=0.003
    )


def test_spread_is_the_walk_under_a_face_that_changes_from_place_to_place(
    steps: ModuleType, variant: str
) -> None:
    """Light enters evenly between x = -4 and 0; right of 0 the face is the guide's at full contact, left of it in
    air. What is left of the light is compared strip by strip, 1 mm wide, within 1 % of the brightest."""
    import mitsuba as mi

    n1, n3, width, cells = 1.4336, 1.40, 40.0, 160
    guide, air = steps.fresnel(n3, n1), steps.fresnel(n3, 1.0)

    def passing(where: Any, cosine: Any) -> Any:
        import drjit as dr

        return dr.select(where.x > 0.0, guide(where, cosine), air(where, cosine))

    photons = 1_000_000
    random = steps._random(photons, 6)
    u, v, s, t = (random.next_float32() for _ in range(4))
    start = mi.Point3f(4.0 * (u - 1.0), 0.0 * v, 0.0 * v)
    down = mi.warp.square_to_cosine_hemisphere(mi.Point2f(s, t))
    place, _, weight, _ = steps.roam(steps.Body(steps.Medium(1.0, 0.02)), start, down, random, passing)
    strips = np.arange(-10.0, 10.5, 1.0)
    walked, _ = np.histogram(np.array(place.x), strips, weights=np.array(weight) / photons)

    optics = contact_optics(n1, 1.0, n3, 0.5, 10.0, 550.0)
    tissue = tissue_optics(1.0, 0.02)
    coupling = couple(optics, tissue, n1, n3)
    spread = spreader(tissue, coupling, width, cells)
    # bare skin in the table: a node of its own, in the place of no contact
    held = np.stack([coupling.free, coupling.held[-1]])
    from scenes.spread import Spread, _without_local

    two = Spread(spread.transform, cells, spread.free, *_without_local(tissue.strengths, held))
    x = (np.arange(cells) + 0.5) / cells * width - width / 2
    entering = np.zeros((1, 2, cells, cells))
    entering[0, 0, :, (x > -4.0) & (x < 0.0)] = 1.0 / (
        4.0 * width
    )  # a long strip: the sum over y is the line
    contact = np.broadcast_to(np.where(x > 0.0, 1.0, 0.0), (cells, cells))
    upward = two.solve(entering, contact)[0]
    mu, weights = cosines()
    overlap = np.einsum("m,im,jm->ij", 2 * mu * weights, tissue.lobe(mu), tissue.lobe(mu))
    leaving = np.stack([(overlap - part)[0] for part in held])
    rows = slice(3 * cells // 8, 5 * cells // 8)  # far from the strip's ends
    line = upward[:, rows].mean(axis=1) * width * width / cells
    left = np.where(x > 0.0, leaving[1] @ line, leaving[0] @ line)
    model = np.array([left[(x > a) & (x < a + 1.0)].sum() for a in strips[:-1]])
    np.testing.assert_allclose(model, walked, atol=0.01 * walked.max())
    assert model.sum() == pytest.approx(walked.sum(), rel=0.004)


def test_a_ball_of_the_same_medium_changes_nothing_and_one_that_holds_all_is_the_medium(
    steps: ModuleType,
) -> None:
    medium, other = steps.Medium(1.0, 0.1), steps.Medium(2.0, 0.5, 0.6)
    plain = steps.walk(steps.Body(medium), PHOTONS, 7).reflectance
    same = steps.walk(
        steps.Body(medium, ball=steps.Ball((0.0, 0.0, 2.0), 1.5, medium)), PHOTONS, 8
    ).reflectance
    assert agrees(same, plain[0], 6.0)
    alone = steps.walk(steps.Body(other), PHOTONS, 9).reflectance
    everywhere = steps.Body(steps.Medium(3.0, 0.1), ball=steps.Ball((0.0, 0.0, 0.0), 1e3, other))
    assert agrees(steps.walk(everywhere, PHOTONS, 10).reflectance, alone[0], 6.0)


def test_dark_ball_darkens_less_the_deeper_it_lies(steps: ModuleType) -> None:
    medium, dark = steps.Medium(1.0, 0.01), steps.Medium(1.0, 5.0)
    balls = [steps.Ball((0.0, 0.0, depth + 2.0), 2.0, dark) for depth in (0.5, 2.0, 8.0)]
    shares = [steps.walk(steps.Body(medium, ball=ball), PHOTONS, 11).reflectance for ball in balls]
    plain = steps.walk(steps.Body(medium), PHOTONS, 11).reflectance
    assert shares[0][0] < shares[1][0] < shares[2][0] <= plain[0] + 3 * plain[1]
    assert plain[0] - shares[0][0] > 20 * shares[0][1]


def test_same_seed_same_bits_on_any_number_of_threads(steps: ModuleType) -> None:
    import drjit as dr

    body = steps.Body(steps.Medium(1.0, 0.1, 0.5))
    threads = dr.thread_count()
    try:
        results = []
        for count in (1, 2):
            dr.set_thread_count(count)
            results.append(steps.walk(body, 50_000, 12))
    finally:
        dr.set_thread_count(threads)
    assert results[0].reflectance == results[1].reflectance
    assert np.array_equal(results[0].profile, results[1].profile)
    assert results[0].reflectance != steps.walk(body, 50_000, 13).reflectance


def test_lobe_of_white_tissue_is_lambertian(steps: ModuleType) -> None:
    """Isotropic light in a white slab on a white backing stays isotropic."""
    walked = steps.walk(steps.Body(steps.Medium(1.0, 0.0), 2.0, 1.0), PHOTONS, 14)
    np.testing.assert_allclose(walked.lobe, 1 / 8, atol=4.5 * walked.lobe_error.max())
    assert walked.reflectance[0] == pytest.approx(1.0, abs=2e-3)
