"""Diffuse reflectance of slabs and half-spaces, against closed forms and published adding-doubling values."""

import numpy as np
import pytest
from scipy.special import expn, j0

from scenes import slab
from scenes.slab import Slab, cosines

Array = np.ndarray


def h_function(q: Array, albedo: float, k: float = 0.0) -> Array:
    """H for kernels exp(-q z) at lateral wave number k; Chandrasekhar's H(µ = 1/q) at k = 0.

    ln H = -(q/π) ∫ ln(1 - a atan(κ)/κ) / (q² + t²) dt over t > 0 with κ² = t² + k² (Chandrasekhar 1960,
    ch. V, by the Wiener-Hopf factorisation of the kernel's transform).
    """
    node, weight = np.polynomial.legendre.leggauss(400)
    angle, weight = 0.25 * np.pi * (1.0 + node), 0.25 * np.pi * weight
    t = np.tan(angle)
    kappa = np.hypot(t, k)
    log = np.log1p(-albedo * np.arctan(kappa) / kappa) / np.cos(angle) ** 2
    return np.exp(-q / np.pi * ((log * weight) / (q[..., None] ** 2 + t**2)).sum(axis=-1))


@pytest.mark.parametrize("albedo", [0.3, 0.8, 0.98, 0.999])
def test_plane_albedo_of_a_half_space_is_chandrasekhars(albedo: float) -> None:
    """1 - sqrt(1 - a) H(µ), and its Lambertian mean (Chandrasekhar 1960, ch. V)."""
    mu = np.linspace(0.02, 1.0, 25)
    plane = 1.0 - np.sqrt(1.0 - albedo) * h_function(1.0 / mu, albedo)
    np.testing.assert_allclose(Slab(albedo).plane_albedo(mu), plane, rtol=1e-6)
    node, weight = cosines()
    mean = 2 * weight @ (node * (1.0 - np.sqrt(1.0 - albedo) * h_function(1.0 / node, albedo)))
    assert Slab(albedo).reflectance(np.zeros(1))[0] == pytest.approx(mean, rel=1e-7)


def test_half_space_reflects_between_any_two_angles_as_chandrasekhar_says() -> None:
    """Radiance factor a H(µ) H(µ') / 4(µ + µ') (Chandrasekhar 1960, ch. V)."""
    albedo, mu = 0.9, np.array([0.05, 0.3, 1.0])
    node, _ = cosines()
    h_out, h_in = h_function(1.0 / mu, albedo), h_function(1.0 / node, albedo)
    exact = albedo * np.outer(h_out, h_in) / 4.0 / (mu[:, None] + node)
    np.testing.assert_allclose(Slab(albedo).factors(mu), exact, rtol=2e-4)


@pytest.mark.parametrize("k", [0.1, 1.0, 7.0, 60.0])
def test_transform_is_that_of_the_wiener_hopf_solution(k: float) -> None:
    """R^(k) = a ∬ H(q) H(q') / (q + q') dµ dµ' with q² = 1/µ² + k², by no discrete mode."""
    albedo = 0.95
    node, weight = cosines()
    q = np.sqrt(node**-2 + k**2)
    h = h_function(q, albedo, k)
    exact = albedo * np.sum(np.outer(weight * h, weight * h) / (q[:, None] + q))
    assert Slab(albedo).reflectance(np.array([k]))[0] == pytest.approx(exact, rel=1e-5)


@pytest.mark.parametrize("albedo", [0.3, 0.98])
@pytest.mark.parametrize("k", [0.1, 1.0, 5.0])
def test_beams_come_out_as_the_wiener_hopf_solution_says(albedo: float, k: float) -> None:
    """a H(p) H(p') / (p + p') with the beam's complex p = 1/µ + i k tanθ cosφ and the exit's p': 1 along the
    normal, q(µ') of all the directions of light that leaves."""
    mu, azimuth = np.array([[0.1], [0.4], [0.9], [1.0]]), np.linspace(0.0, np.pi, 5)
    p = 1.0 / mu + 1j * k * np.sqrt(1.0 - mu**2) / mu * np.cos(azimuth)
    node, weight = cosines()
    q, one = np.sqrt(node**-2 + k**2), np.ones(1)
    h, leaving = h_function(p, albedo, k), weight * h_function(q, albedo, k)
    everything = 0.5 * albedo * h / mu * (leaving / (p[..., None] + q)).sum(axis=-1)
    steep, less, more = (
        0.25 * albedo * h / mu * h_function(exit * one, albedo, k) / (p + exit)
        for exit in (1.0, 0.998, 1.002)
    )
    found = Slab(albedo).aslant(np.array([k]), mu[:, 0], azimuth)[:, 0]
    np.testing.assert_allclose(found[:2], [everything, steep], atol=1e-6 * np.abs(everything).max())
    deep = (less - more) / 0.004
    np.testing.assert_allclose(found[2], deep, atol=2e-5 * np.abs(deep).max())


@pytest.mark.parametrize(
    "layer", [Slab(0.98), Slab(0.98, 2.0), Slab(0.98, 2.0, 0.7), Slab(0.999, 0.3, 0.9), Slab(0.5, 1.0, 0.5)]
)
def test_beams_from_all_sides_are_lambertian_light(layer: Slab) -> None:
    node, weight = cosines()
    azimuth = 2.0 * np.pi * (np.arange(64) + 0.5) / 64
    k = np.array([0.0, 0.3, 2.0])
    everything, steep, _ = (layer.aslant(k, node, azimuth).mean(axis=3) * 2.0 * node * weight).sum(axis=2)
    np.testing.assert_allclose(everything, layer.reflectance(k), rtol=1e-6)
    assert steep[0] == pytest.approx(layer.plane_albedo(np.ones(1))[0], rel=1e-6)  # by reciprocity


# Isotropic scattering, no index step: (albedo, optical depth, normal incidence up and down, Lambertian up and
# down) by adding and doubling (Prahl, van Gemert & Welch 1993; key prahl1993; iadpython 0.5.3 and its tests).
ADDING_DOUBLING = [
    (0.9, 1.0, 0.26741, 0.59163, 0.35271, 0.47475),
    (0.8, 1e5, 0.28525, 0.0, 0.34187, 0.0),
    (0.9, 0.2, None, None, 0.13120, 0.83015),
]


@pytest.mark.parametrize(("albedo", "depth", "up_beam", "down_beam", "up", "down"), ADDING_DOUBLING)
def test_slabs_agree_with_adding_and_doubling(
    albedo: float, depth: float, up_beam: float | None, down_beam: float | None, up: float, down: float
) -> None:
    ours = [part[0] for part in Slab(albedo, depth)._passes(np.zeros(1))]
    np.testing.assert_allclose(ours, [up, down], atol=1e-5)
    if up_beam is not None:
        assert Slab(albedo, depth).plane_albedo(np.ones(1))[0] == pytest.approx(up_beam, abs=1e-5)


@pytest.mark.parametrize("body", [Slab(0.9), Slab(0.9, 1.0), Slab(0.9, 1.0, 0.8), Slab(0.0, 0.5, 0.8)])
def test_angles_are_reciprocal_and_sum_to_the_total(body: Slab) -> None:
    mu, weight = cosines()
    factors = body.factors(mu)
    np.testing.assert_allclose(factors, factors.T, atol=1e-11)
    even = 2.0 * mu * weight
    assert even @ factors @ even == pytest.approx(body.reflectance(np.zeros(1))[0], rel=1e-10)


def test_white_keeps_all_light_and_black_none() -> None:
    k = np.zeros(1)
    assert Slab(1.0, 2.0, 1.0).reflectance(k)[0] == pytest.approx(1.0, abs=1e-7)
    assert sum(part[0] for part in Slab(1.0, 2.0)._passes(k)) == pytest.approx(1.0, abs=1e-7)
    assert Slab(1.0).reflectance(k)[0] == pytest.approx(1.0, abs=1e-4)  # 1e-9 is absorbed per scattering
    assert Slab(0.0).reflectance(k)[0] == pytest.approx(0.0, abs=1e-14)


def test_clear_slab_gives_back_what_its_backing_does() -> None:
    """Twice through, 2 E3(d), and Lambertian in between."""
    assert Slab(0.0, 0.4, 0.7).reflectance(np.zeros(1))[0] == pytest.approx(0.7 * (2 * expn(3, 0.4)) ** 2)


@pytest.mark.parametrize("k", [0.0, 2.0, 12.0])
def test_unscattered_light_through_a_slab_is_the_transform_of_its_profile(k: float) -> None:
    """z² exp(-r)/(π r⁴) on the far face."""
    depth, rho = 0.3, np.geomspace(1e-4, 60.0, 100_001)
    r = np.hypot(rho, depth)
    by_hand = np.trapezoid(2 * rho * depth**2 * np.exp(-r) / r**4 * j0(k * rho), rho)
    assert slab._straight(np.array([k]), depth)[0] == pytest.approx(by_hand, abs=1e-6)


def test_thick_slab_is_a_half_space_at_every_wave_number() -> None:
    k = np.array([0.0, 0.3, 3.0, 30.0])
    np.testing.assert_allclose(Slab(0.95, 60.0).reflectance(k), Slab(0.95).reflectance(k), rtol=1e-9)
