"""The law of frustrated total internal reflection: against an independent code, and what physics demands."""

import warnings
from typing import Any

import numpy as np
import pytest

from scenes import gap_transmittance

WAVELENGTH = 550.0

# (guide, gap, tissue): the shipped sensor, other cures and tissues, a denser and a thinner tissue, water in
# the gap, a gap denser than the tissue, and one denser than both.
TRIPLES = [
    (1.4336, 1.0, 1.40),
    (1.418, 1.0, 1.36),
    (1.40, 1.0, 1.60),
    (1.4336, 1.33, 1.40),
    (1.50, 1.33, 1.36),
    (1.50, 1.33, 1.20),
    (1.33, 1.5, 1.40),
]
GAPS_UM = [0.0, 0.01, 0.05, 0.15, 0.3, 0.7, 1.0, 2.5, 5.0]


def brute(n1: float, n0: float, n3: float, gap_um: float, angle: float, polarisation: str) -> float:
    """Transmittance by the `tmm` package (Byrnes 2016), which multiplies complex matrices."""
    from tmm import coh_tmm

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it reminds its caller of conventions beyond the critical angle
        stack = coh_tmm(polarisation, [n1, n0, n3], [np.inf, 1e3 * gap_um, np.inf], angle, WAVELENGTH)
    return float(stack["T"])


def fresnel(n1: float, n3: float, cos1: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Transmittances of one interface, s and p, from Fresnel's amplitudes (Born & Wolf 1999, sec. 1.5.2)."""
    cos3 = np.sqrt(np.maximum(1.0 - (n1 / n3) ** 2 * (1.0 - cos1**2), 0.0))
    r_s = (n1 * cos1 - n3 * cos3) / (n1 * cos1 + n3 * cos3)
    r_p = (n3 * cos1 - n1 * cos3) / (n3 * cos1 + n1 * cos3)
    return 1.0 - r_s**2, 1.0 - r_p**2


def critical_angles(n1: float, *others: float) -> list[float]:
    return [float(np.arcsin(n / n1)) for n in others if n < n1]


@pytest.mark.parametrize("triple", TRIPLES)
def test_law_agrees_with_an_independent_code_on_both_sides_of_the_critical_angles(
    triple: tuple[float, float, float],
) -> None:
    n1, n0, n3 = triple
    angles = list(np.linspace(0.0, 1.55, 13))
    for critical in critical_angles(n1, n0, n3):
        angles += [critical - 1e-2, critical - 1e-5, critical + 1e-5, critical + 1e-2]
    worst = 0.0
    for gap in GAPS_UM:
        law = gap_transmittance(n1, n0, n3, gap, np.cos(angles), WAVELENGTH)
        for polarisation, ours in zip("sp", law, strict=True):
            independent = [brute(n1, n0, n3, gap, angle, polarisation) for angle in angles]
            worst = max(worst, float(np.abs(ours - independent).max()))
    print(f"{triple}: largest difference from tmm {worst:.1e}")
    assert worst < 1e-9


def test_law_agrees_with_an_independent_code_at_random() -> None:
    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(400):
        n1, n0, n3 = rng.uniform(1.0, 2.0, 3)
        gap, angle = rng.uniform(0.0, 5.0), rng.uniform(0.0, 1.56)
        law = gap_transmittance(n1, n0, n3, gap, np.cos(angle), WAVELENGTH)
        for polarisation, ours in zip("sp", law, strict=True):
            worst = max(worst, abs(float(ours) - brute(n1, n0, n3, gap, angle, polarisation)))
    assert worst < 1e-9


@pytest.mark.parametrize(("n1", "n0", "n3"), TRIPLES)
def test_closed_gap_is_a_plain_interface(n1: float, n0: float, n3: float) -> None:
    cosine = np.linspace(0.02, 1.0, 200)
    law = gap_transmittance(n1, n0, n3, 0.0, cosine, WAVELENGTH)
    np.testing.assert_allclose(law, fresnel(n1, n3, cosine), atol=1e-13)


@pytest.mark.parametrize("n3", [1.2, 1.4336, 1.6])
def test_gap_filled_with_the_guides_own_material_is_no_gap(n3: float) -> None:
    cosine = np.linspace(0.02, 1.0, 200)
    for gap in (0.0, 0.3, 5.0):
        law = gap_transmittance(1.4336, 1.4336, n3, gap, cosine, WAVELENGTH)
        np.testing.assert_allclose(law, fresnel(1.4336, n3, cosine), atol=1e-12)


def test_gap_filled_with_the_tissues_own_material_is_no_gap() -> None:
    cosine = np.linspace(0.35, 1.0, 200)
    law = gap_transmittance(1.4336, 1.36, 1.36, 0.8, cosine, WAVELENGTH)
    np.testing.assert_allclose(law, fresnel(1.4336, 1.36, cosine), atol=1e-12)


def test_equal_media_are_clear() -> None:
    """All indices equal: whatever the gap, all light passes."""
    law = gap_transmittance(1.4, 1.4, 1.4, np.linspace(0.0, 5.0, 11), 0.3, WAVELENGTH)
    np.testing.assert_allclose(law, 1.0, atol=1e-13)


@pytest.mark.parametrize(("n1", "n0", "n3"), [t for t in TRIPLES if t[1] < t[0] and t[1] < t[2]])
def test_law_is_continuous_through_the_critical_angle(n1: float, n0: float, n3: float) -> None:
    """At w = 0 sine and hyperbolic sine meet in a²; a step or nan there would be a ring in pictures."""
    critical = np.sqrt(1.0 - (n0 / n1) ** 2)
    for gap in (0.05, 0.3, 2.0, 5.0):
        for offset in (1e-8, 1e-10, 1e-12, 1e-15):
            below = gap_transmittance(n1, n0, n3, gap, critical + offset, WAVELENGTH)
            above = gap_transmittance(n1, n0, n3, gap, critical - offset, WAVELENGTH)
            exact = gap_transmittance(n1, n0, n3, gap, critical, WAVELENGTH)
            np.testing.assert_allclose(below, above, atol=2e4 * offset + 1e-12)
            np.testing.assert_allclose(exact, above, atol=2e4 * offset + 1e-12)


def test_at_the_critical_angle_the_limit_is_the_parabola() -> None:
    """w = 0 up to rounding: T_s = 4 q1 q3 / ((q1 + q3)² + a² (n1² - n0²)(n3² - n0²))."""
    n1, n0, n3, gap = 1.25, 1.0, 1.5, 0.2
    cosine = 0.6  # sin = 0.8 = n0 / n1
    q1, q3, a = n1 * cosine, np.sqrt(n3**2 - 1.0), 2e3 * np.pi * gap / WAVELENGTH
    expected = 4 * q1 * q3 / ((q1 + q3) ** 2 + a**2 * (n1**2 - n0**2) * (n3**2 - n0**2))
    assert gap_transmittance(n1, n0, n3, gap, cosine, WAVELENGTH)[0] == pytest.approx(expected, rel=1e-10)


def test_wide_gap_lets_nothing_through_beyond_the_critical_angle() -> None:
    cosine = np.linspace(0.0, 0.65, 50)  # critical angle of 1.4336 to air: cos = 0.717
    for gap in (50.0, 1e3, 1e9):
        law = gap_transmittance(1.4336, 1.0, 1.40, gap, cosine, WAVELENGTH)
        assert np.all(np.isfinite(law))
        assert np.max(law) < 1e-60


def test_tunnelling_decays_with_the_evanescent_wave() -> None:
    """Far into the gap T falls as exp(-2 g / d), d = λ / (2 pi sqrt(n1² sin² - n0²))."""
    cosine, gap = 0.5, np.array([1.0, 1.5])
    decay = 2e3 * np.pi / WAVELENGTH * np.sqrt(1.4336**2 * (1 - cosine**2) - 1.0)
    for t in gap_transmittance(1.4336, 1.0, 1.40, gap, cosine, WAVELENGTH):
        assert np.log(t[0] / t[1]) == pytest.approx(2 * decay * 0.5, rel=1e-4)


def test_range_of_frustration_is_a_fraction_of_a_wavelength() -> None:
    """The design's claim: FTIR sees gaps of 100 to 300 nm, then no more."""
    gap = np.linspace(0.0, 1.0, 2001)
    cosine = 0.5
    t = 0.5 * np.sum(gap_transmittance(1.4336, 1.0, 1.40, gap, cosine, WAVELENGTH), axis=0)
    assert np.all(np.diff(t) < 0.0)
    half, hundredth = gap[np.argmax(t < 0.5 * t[0])], gap[np.argmax(t < 0.01 * t[0])]
    assert 0.05 < half < 0.3
    assert hundredth < 0.6


@pytest.mark.parametrize(("n1", "n0", "n3"), TRIPLES)
def test_law_is_reciprocal(n1: float, n0: float, n3: float) -> None:
    """Helmholtz: forth at theta1 equals back at theta3, n1 sin(theta1) = n3 sin(theta3)."""
    tangential = np.linspace(0.0, min(n1, n3) * 0.9999, 100)
    cos1, cos3 = np.sqrt(1.0 - (tangential / n1) ** 2), np.sqrt(1.0 - (tangential / n3) ** 2)
    for gap in GAPS_UM:
        forth = gap_transmittance(n1, n0, n3, gap, cos1, WAVELENGTH)
        back = gap_transmittance(n3, n0, n1, gap, cos3, WAVELENGTH)
        np.testing.assert_allclose(forth, back, atol=1e-11)


def test_brewsters_angle_passes_all_p_light() -> None:
    """At tan(theta) = n3/n1 on a closed gap, and at tan(theta) = n0/n1 between equal media for any gap."""
    at_contact = np.cos(np.arctan(1.40 / 1.4336))
    t_p = gap_transmittance(1.4336, 1.0, 1.40, 0.0, at_contact, WAVELENGTH)[1]
    assert t_p == pytest.approx(1.0, abs=1e-14)
    at_gap = np.cos(np.arctan(1.0 / 1.4336))
    t_s, t_p = gap_transmittance(1.4336, 1.0, 1.4336, np.linspace(0.0, 5.0, 200), at_gap, WAVELENGTH)
    np.testing.assert_allclose(t_p, 1.0, atol=1e-12)
    assert t_s.min() < 0.8


def test_polarisations_agree_at_normal_incidence_and_fringes_peak_at_half_waves() -> None:
    gap = np.array([0.0, 0.25, 0.5, 1.0]) * WAVELENGTH * 1e-3  # closed, quarter wave, half wave, full wave
    t_s, t_p = gap_transmittance(1.4336, 1.0, 1.40, gap, 1.0, WAVELENGTH)
    np.testing.assert_allclose(t_s, t_p, atol=1e-14)
    np.testing.assert_allclose(t_s[[2, 3]], t_s[0], atol=1e-13)
    quarter = 4 * 1.4336 * 1.40 / (1.0 + 1.4336 * 1.40) ** 2  # Born & Wolf 1999, sec. 1.6.4
    assert t_s[1] == pytest.approx(quarter, rel=1e-12)


def test_only_gap_over_wavelength_matters() -> None:
    cosine = np.linspace(0.0, 1.0, 50)
    one = gap_transmittance(1.4336, 1.0, 1.40, 0.2, cosine, 500.0)
    twice = gap_transmittance(1.4336, 1.0, 1.40, 0.4, cosine, 1000.0)
    np.testing.assert_allclose(one, twice, rtol=1e-12)


def test_transmittance_is_a_share_whatever_the_input() -> None:
    rng = np.random.default_rng(2)
    size = 200_000
    n1, n0, n3 = rng.uniform(1.0, 4.0, (3, size))
    gap = rng.choice([0.0, 1e-9, 1e-3, 1.0, 1e3, 1e12], size) * rng.uniform(0.0, 1.0, size)
    cosine = np.where(rng.random(size) < 0.1, rng.choice([0.0, 1e-300, 1e-12, 1.0], size), rng.random(size))
    wavelength = rng.uniform(350.0, 1100.0, size)
    for t in gap_transmittance(n1, n0, n3, gap, cosine, wavelength):
        assert np.all((t >= 0.0) & (t <= 1.0 + 1e-9))


def test_no_light_enters_where_the_tissue_admits_none() -> None:
    n1, n3 = 1.50, 1.36
    cosine = np.sqrt(1.0 - (n3 / n1) ** 2) * np.array([0.0, 0.5, 0.999])
    assert np.all(np.array(gap_transmittance(n1, 1.0, n3, 0.0, cosine, WAVELENGTH)) == 0.0)


def test_arguments_broadcast() -> None:
    t_s, t_p = gap_transmittance(1.4336, 1.0, [[1.36], [1.40]], 0.1, [0.2, 0.5, 0.9], WAVELENGTH)
    assert t_s.shape == t_p.shape == (2, 3)
    one = gap_transmittance(1.4336, 1.0, 1.40, 0.1, 0.5, WAVELENGTH)[1]
    assert one.shape == () and one == t_p[1, 1]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n1", 0.99),
        ("n0", 0.5),
        ("n3", -1.4),
        ("gap_um", -1e-9),
        ("cos_theta", 1.0000001),
        ("cos_theta", -0.1),
        ("wavelength_nm", 0.0),
        ("wavelength_nm", -550.0),
        ("n1", np.inf),
        ("n3", np.nan),
        ("gap_um", np.inf),
        ("cos_theta", np.nan),
    ],
)
def test_refusals_name_the_argument_and_what_it_received(name: str, value: float) -> None:
    good: dict[str, Any] = {
        "n1": 1.4336,
        "n0": 1.0,
        "n3": 1.40,
        "gap_um": [0.1, 0.2],
        "cos_theta": [0.5, 0.6],
        "wavelength_nm": WAVELENGTH,
    }
    received: Any = [good[name][0], value] if isinstance(good[name], list) else value
    with pytest.raises(ValueError, match=rf"gap_transmittance: {name}: received .*; allowed") as refusal:
        gap_transmittance(**{**good, name: received})
    assert str(float(value)) in str(refusal.value) and "\n" not in str(refusal.value)
