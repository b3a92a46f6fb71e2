"""The volumetric walk against published values, and the standard kernel against the walk."""

import dataclasses
from types import ModuleType

import numpy as np
import pytest

from scenes.contact import contact_optics
from scenes.ftir import gap_transmittance
from scenes.slab import Slab
from scenes.spread import spreader
from scenes.tissue import TissueOptics, couple, tissue_optics

PHOTONS = 400_000
N1, N3 = 1.4336, 1.40


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


# (albedo, g, index, total reflectance at normal incidence of a half-space), mirror reflection included. The
# first is Giovanelli's (1955; key giovanelli1955), as in Wang, Jacques & Zheng (1995; key wang1995); the
# second stands in the tests of iadpython, the rest were computed with it (0.5.3, 32 angles): an independent
# code for adding and doubling (Prahl, van Gemert & Welch 1993; key prahl1993).
PUBLISHED = [
    (0.9, 0.0, 1.5, 0.2600),
    (0.8, 0.0, 1.0, 0.28525),
    (0.6, 0.0, 1.33, 0.10285),
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
    """µa 1, µs 9 per mm, g 0.75, 0.2 mm, matched: van de Hulst (1980; key hulst1980), in wang1995."""
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
    assert leaving(tissue, n_before) @ upward == pytest.approx(walked.reflectance[0], rel=0.003)


def test_spread_is_the_walk_under_a_face_that_changes_from_place_to_place(
    steps: ModuleType, variant: str
) -> None:
    """Light enters evenly between x = -4 and 0; right of 0 lies the guide in full contact, left of it air.

    What leaves is compared strip by strip, 1 mm wide: all of it within 0.4 %, a strip within 2.5 % of the
    brightest. Light that was mirrored inside leaves 2 % too near, since R knows no angles.
    """
    import drjit as dr
    import mitsuba as mi

    guide, air = steps.fresnel(N3, N1), steps.fresnel(N3, 1.0)
    photons = 1_000_000
    random = steps.generator(photons, 6)
    u, s, t = (random.next_float32() for _ in range(3))
    start = mi.Point3f(4.0 * (u - 1.0), 0.0, 0.0)
    down = mi.warp.square_to_cosine_hemisphere(mi.Point2f(s, t))
    place, _, weight, _, _, _ = steps.roam(
        steps.Body(steps.Medium(1.0, 0.02)),
        start,
        down,
        random,
        lambda where, cosine: dr.select(where.x > 0.0, guide(where, cosine), air(where, cosine)),
    )
    strips = np.arange(-10.0, 10.5, 1.0)
    share = np.array(weight, dtype=float) / photons
    walked, _ = np.histogram(np.array(place.x), strips, weights=share)

    width, cells = 40.0, 160
    tissue = tissue_optics(1.0, 0.02)
    coupling = couple(contact_optics(N1, 1.0, N3, 0.5, 10.0, 550.0), tissue, N1, N3, 1.0)
    bare = dataclasses.replace(coupling, held=np.stack([coupling.free, coupling.held[-1]]))  # A_r = 0: air
    x = (np.arange(cells) + 0.5) / cells * width - width / 2
    entering = np.zeros((1, 2, cells, cells))
    entering[0, 0, :, (x > -4.0) & (x < 0.0)] = 1.0 / 4.0  # long in y: each row is a line
    contact = np.broadcast_to(np.where(x > 0.0, 1.0, 0.0), (cells, cells))
    line = spreader(tissue, bare, width, cells).solve(entering, contact)[0, :, cells // 2] * width / cells
    left = np.where(x > 0.0, leaving(tissue, N1) @ line, leaving(tissue, 1.0) @ line)
    model = np.array([left[(x > a) & (x < a + 1.0)].sum() for a in strips[:-1]])
    assert left.sum() == pytest.approx(share.sum(), rel=0.004)
    np.testing.assert_allclose(model, walked, atol=0.025 * walked.max())


@pytest.mark.parametrize("fraction", [0.25, 0.5])
def test_trapped_light_comes_back_to_the_camera_as_the_walk_says(steps: ModuleType, fraction: float) -> None:
    """Trapped light (cosines 0.25 to 0.7 in the guide) enters a rough contact, evenly over the face.

    What leaves within 20 degrees of the normal, where the camera is, agrees within 0.5 %, and all of it
    within 0.4 %. Lambertian tissue of the same total is 2 % (a quarter in contact) to 6 % (all) too bright.
    """
    import drjit as dr
    import mitsuba as mi

    from scenes.bsdf import Table

    optics = contact_optics(N1, 1.0, N3, 0.5, 10.0, 550.0)
    table, share = Table(Table.pack(optics)), mi.Float(fraction)
    photons, low, high = 2_000_000, 0.25, 0.7
    random = steps.generator(photons, 8)
    s, t = random.next_float32(), random.next_float32()
    cosine = dr.sqrt(low**2 + (high**2 - low**2) * s)
    sine = N1 / N3 * dr.sqrt(1.0 - cosine * cosine)
    across, along = dr.sincos(dr.two_pi * t)
    inward = mi.Vector3f(sine * along, sine * across, dr.sqrt(1.0 - sine * sine))
    face = steps.behind_guide(N3, N1, lambda where, cos: table.transmittance(share, cos))
    body = steps.Body(steps.Medium(1.0, 0.02))
    _, leaves, weight, _, _, _ = steps.roam(body, dr.zeros(mi.Point3f, photons), inward, random, face)
    light = np.array(weight * table.transmittance(share, cosine), dtype=float) / photons
    outside = 1.0 - (N3 / N1) ** 2 * (
        1.0 - np.array(leaves.z, dtype=float) ** 2
    )  # squared cosine in the guide
    to_camera = np.cos(np.deg2rad(20.0)) ** 2
    walked = light.sum(), light[outside > to_camera].sum()

    tissue = tissue_optics(1.0, 0.02)
    coupling = couple(optics, tissue, N1, N3, 1.0)
    node = round(128 * fraction)
    grid, passes = np.linspace(0, 1, 1025), optics.transmittance[node]

    def mean(start: float, stop: float) -> np.ndarray:
        """⟨T φ_i⟩ over even steps of the squared cosine, (modes,)."""
        cos = np.sqrt(start + (stop - start) * (np.arange(4000) + 0.5) / 4000)
        lobes = np.stack([np.interp(cos, grid, lobe) for lobe in coupling.lobes])
        return np.mean(np.interp(cos, grid, passes) * lobes, axis=1)

    answer = coupling.gain[node] @ mean(low**2, high**2)
    assert mean(0.0, 1.0) @ answer == pytest.approx(walked[0], rel=0.004)
    assert mean(to_camera, 1.0) @ answer * (1.0 - to_camera) == pytest.approx(walked[1], rel=0.005)


def leaving(tissue: TissueOptics, n_before: float) -> np.ndarray:
    """⟨φ_i T⟩ of a plain face to an index, (modes,)."""
    node, weight = np.polynomial.legendre.leggauss(1000)
    mu = 0.5 * (1 + node)
    passes = 0.5 * sum(gap_transmittance(N3, n_before, n_before, 0.0, mu, 550.0))
    return (weight * mu * passes * tissue.lobe(mu)).sum(axis=1)


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
    medium, dark = steps.Medium(1.0, 0.05), steps.Medium(1.0, 5.0)
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


@pytest.mark.parametrize(
    "cosine", [pytest.param(0.25, marks=pytest.mark.slow), 0.5, pytest.param(0.8, marks=pytest.mark.slow)]
)
def test_light_that_enters_aslant_comes_out_ahead(steps: ModuleType, variant: str, cosine: float) -> None:
    """Where it leaves, mean and squares along and across the way in, against the transform's derivatives: of
    all light, and of what leaves within 13 degrees of the normal."""
    import mitsuba as mi

    photons, tissue, k = 4_000_000, tissue_optics(1.0, 0.02), 0.02
    random = steps.generator(photons, 11)
    zero = 0.0 * random.next_float32()
    way = mi.Vector3f(float(np.sqrt(1.0 - cosine**2)) + zero, zero, cosine + zero)
    body = steps.Body(steps.Medium(1.0, 0.02))
    place, out, weight, _, _, _ = steps.roam(
        body, 0.0 * mi.Point3f(way), way, random, steps.fresnel(1.0, 1.0)
    )
    x, y, up, share = (np.asarray(v, dtype=np.float64) for v in (place.x, place.y, out.z, weight))
    values = np.stack([x, x**2 - y**2, x**2 + y**2])

    waves = np.array([0.0, k / tissue.transport_per_mm])
    beams = tissue.slab.aslant(waves, np.array([cosine]), np.array([0.0, 0.5 * np.pi]))[:, :, 0]
    for exit_, kept in ((0, up < 0.0), (1, up < -np.cos(np.deg2rad(13.0)))):
        total, along, across = beams[exit_, 0, 0].real, beams[exit_, 1, 0], beams[exit_, 1, 1].real
        exact = np.array([-along.imag / k, 2.0 * (across - along.real) / k**2, 0.0]) / total
        exact[2] = 2.0 * (2.0 * total - along.real - across) / k**2 / total
        light = share * kept
        mean = (light * values).mean(axis=1) / light.mean()
        error = (light * (values - mean[:, None])).std(axis=1) / light.mean() / np.sqrt(photons)
        assert np.all(np.abs(mean - exact) < 3.5 * error + np.array([2e-3, 0.02, 8e-3]) * exact), exit_
