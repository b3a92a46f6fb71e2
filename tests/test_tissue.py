"""Tissue behind a contact: its modes, what the face throws back, and the local limit."""

import dataclasses

import numpy as np
import pytest

from scenes.contact import contact_optics, moment_weights
from scenes.skin import Sheet, Skin, Tissue
from scenes.slab import Slab
from scenes.tissue import Coupling, TissueOptics, body_behind, couple, tissue_optics

N1, N3 = 1.4336, 1.40


def behind(tissue: TissueOptics, n_tissue: float = N3, **skin: float) -> Coupling:
    optics = contact_optics(N1, 1.0, n_tissue, 0.5, 10.0, 550.0, **skin)
    return couple(optics, tissue, N1, n_tissue, 1.0)


def out_and_in(coupling: Coupling, dust: float = 0.0) -> np.ndarray:
    """What leaves of each mode, (n_fraction, modes): (n1/n3)² times the guide's Lambertian mean of T φ."""
    optics = contact_optics(N1, 1.0, N3, 0.5, 10.0, 550.0, dust=dust)
    cosine = np.linspace(0.0, 1.0, optics.transmittance.shape[1])
    weights = 2 * moment_weights(cosine)
    return coupling.scale * np.einsum("m,im,am->ai", weights, coupling.lobes, optics.transmittance)


def test_total_is_exact_for_the_paper_sensors_tissue() -> None:
    """Chandrasekhar's 0.7246 for a = 1/1.02, where diffusion theory (Flock 1989) gives 0.68."""
    tissue = tissue_optics(1.0, 0.02)
    assert tissue.reflectance == pytest.approx(Slab(1 / 1.02).reflectance(np.zeros(1))[0], rel=1e-12)
    assert tissue.reflectance == pytest.approx(0.7246, abs=1e-4)


def test_only_albedo_and_distance_in_mean_free_paths_matter() -> None:
    one, five = tissue_optics(1.0, 0.02), tissue_optics(5.0, 0.1)
    r = np.array([0.2, 1.0, 4.0])
    np.testing.assert_allclose(five.profile(r / 5) / 25, one.profile(r), rtol=1e-10)
    np.testing.assert_allclose(five.within(r / 5), one.within(r), rtol=1e-10)


def test_modes_have_the_plane_albedo_and_no_net_flux() -> None:
    tissue = tissue_optics(1.0, 0.02, modes=3)
    mu = np.linspace(0.0, 1.0, 4001)
    lobes = tissue.lobe(mu)
    means = np.trapezoid(2 * mu * lobes, mu, axis=1)
    np.testing.assert_allclose(means, [1.0, 0.0, 0.0], atol=2e-4)
    np.testing.assert_allclose(tissue.reflectance * lobes[0], Slab(1 / 1.02).plane_albedo(mu), rtol=2e-4)


@pytest.mark.parametrize(("modes", "worst"), [(1, 0.05), (2, 1e-3), (3, 1e-3)])
def test_two_modes_give_what_trapped_light_leaves_for_the_camera(modes: int, worst: float) -> None:
    """In at cosines below 0.7, as trapped light, out above 0.9, as the camera sees; by the exact factors."""
    node, weight = np.polynomial.legendre.leggauss(40)
    mu, weight = 0.5 * (1 + node), weight
    tissue = tissue_optics(1.0, 0.02, modes=modes)
    lobes = tissue.lobe(mu)
    model = np.einsum("i,im,in->mn", tissue.strengths, lobes, lobes)
    exact = Slab(1 / 1.02).factors(mu)  # its own nodes are these
    enters, leaves = (weight * mu * mask for mask in (mu < 0.7, mu > 0.9))
    ratio = (leaves @ model @ enters) / (leaves @ exact @ enters)
    assert abs(ratio - 1) < worst


def test_local_limit_without_angles_is_the_old_closed_form() -> None:
    """K = (n1/n3)² ρ / (1 - ρ (1 - T_in))."""
    tissue = tissue_optics(1.0, 0.02, modes=1)
    flat = dataclasses.replace(tissue, lobes=np.ones_like(tissue.lobes))
    optics = contact_optics(N1, 1.0, N3, tissue.reflectance, 10.0, 550.0)
    gain = couple(optics, flat, N1, N3, 1.0).gain[:, 0, 0]
    np.testing.assert_allclose(gain, optics.diffuse_gain, rtol=1e-4)


@pytest.mark.parametrize("modes", [1, 2, 3])
@pytest.mark.parametrize("dust", [0.0, 0.3])
def test_white_tissue_gives_everything_back(modes: int, dust: float) -> None:
    """Furnace: without absorption all that enters leaves again, whatever its angle, contact and modes."""
    coupling = behind(tissue_optics(1.0, 0.0, modes=modes), dust=dust)
    leaving = np.einsum("ai,aij->aj", out_and_in(coupling, dust), coupling.gain) / coupling.scale
    np.testing.assert_allclose(leaving[:, 0], 1.0, atol=6e-4)
    np.testing.assert_allclose(leaving[:, 1:], 0.0, atol=2e-4)


def test_gain_is_symmetric_and_its_brdf_positive() -> None:
    coupling = behind(tissue_optics(1.0, 0.02))
    np.testing.assert_allclose(coupling.gain, np.swapaxes(coupling.gain, 1, 2), rtol=1e-10)
    some = np.linspace(225, 1024, 60).astype(int)  # from grazing in the tissue on
    lobes = coupling.lobes[:, some]
    assert np.einsum("im,aij,jn->amn", lobes, coupling.gain, lobes).min() > 0.0


def test_bare_skin_throws_back_what_fresnel_says() -> None:
    """Lambertian light inside n = 1.4 meets 53 % internal reflection."""
    tissue = tissue_optics(1.0, 0.02, modes=1)
    flat = dataclasses.replace(tissue, lobes=np.ones_like(tissue.lobes))
    assert behind(flat).free[0, 0] == pytest.approx(0.529, abs=2e-3)


def test_jumps_are_the_quantiles_of_the_distance() -> None:
    tissue = tissue_optics(2.0, 0.04)
    jumps = tissue.jumps_mm(101)
    shares = tissue.within(jumps[1:-1]) / tissue.reflectance
    np.testing.assert_allclose(shares, np.linspace(0, 1, 101)[1:-1], atol=2e-4)


def test_sheet_takes_the_tissues_place() -> None:
    white = Sheet(thickness_mm=0.5, modulus_kPa=100.0, scattering_per_mm=20.0, backing=0.5)
    index, body = body_behind(Skin(sheet=white), Tissue())
    assert index == white.refractive_index and body.slab.depth == pytest.approx(0.5 * 20.01)
    assert body.slab.backing == 0.5 and body.reflectance > 0.85
    assert body_behind(Skin(), Tissue())[0] == Tissue().refractive_index


def test_thick_sheet_is_tissue_and_a_black_one_gives_nothing() -> None:
    deep, half = tissue_optics(1.0, 0.02, 80.0), tissue_optics(1.0, 0.02)
    r = np.array([0.1, 1.0, 5.0])
    np.testing.assert_allclose(deep.profile(r), half.profile(r), rtol=1e-5)
    np.testing.assert_allclose(deep.lobes[0], half.lobes[0], rtol=1e-6)
    black = tissue_optics(0.0, 30.0, 0.3)
    assert black.reflectance == 0.0 and np.all(behind(black).gain == 0.0)
