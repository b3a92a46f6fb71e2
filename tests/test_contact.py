"""Rough contact: real contact area, gaps, and what they do to light on average."""

import numpy as np
import pytest
from scipy.integrate import simpson

from scenes import contact
from scenes.contact import ContactOptics, contact_fraction, contact_optics, mean_gap_um, real_contact
from scenes.ftir import gap_transmittance
from scenes.skin import Skin

Array = np.ndarray

WAVELENGTH = 550.0
DRY = (1.4336, 1.0, 1.40)
WET = (1.4336, 1.33, 1.40)
DENSE = (1.40, 1.0, 1.60)  # tissue denser than the guide
MEDIA = [DRY, WET, DENSE]
RMS_UM = 10.0


def law(media: tuple[float, float, float], gap_um: Array | float, cosine: Array | float) -> Array:
    """Transmittance of unpolarised light."""
    return np.asarray(0.5 * np.sum(gap_transmittance(*media, gap_um, cosine, WAVELENGTH), axis=0))


def brute_mean(media: tuple[float, float, float], mean_um: float, cosine: float) -> float:
    """∫ T(g) exp(-g/m)/m dg by Simpson's rule on gaps at most 4 nm apart: no substitution, no series."""
    top = 36.0 * mean_um
    gap = np.linspace(0.0, top, 2 * int(0.5 * top / min(0.004, 0.02 * mean_um)) + 1)
    return float(simpson(law(media, gap, cosine) * np.exp(-gap / mean_um) / mean_um, x=gap))


def kinks(media: tuple[float, float, float]) -> list[float]:
    """Cosines in the guide at which T has infinite slope: grazing in the gap, grazing in the tissue."""
    return [float(np.sqrt(1.0 - (n / media[0]) ** 2)) for n in media[1:] if n < media[0]]


def bilinear(optics: ContactOptics, fraction: float, cosine: float) -> float:
    table = optics.transmittance
    y, x = fraction * (table.shape[0] - 1), cosine * (table.shape[1] - 1)
    i, j = min(int(y), table.shape[0] - 2), min(int(x), table.shape[1] - 2)
    v, u = y - i, x - j
    row = (1 - v) * table[i] + v * table[i + 1]
    return float((1 - u) * row[j] + u * row[j + 1])


# real contact area


def test_light_load_gives_area_in_proportion_with_the_theorys_slope() -> None:
    """A_r -> kappa p / (E* h') (Persson 2001; Bush, Gibson and Thomas 1975)."""
    modulus, slope, kappa = 5.55, 2.0, 1.6
    pressure = np.array([1e-6, 1e-4, 1e-2])
    expected = kappa * pressure / (modulus * slope)
    np.testing.assert_allclose(contact_fraction(pressure, modulus, slope, kappa), expected, rtol=1e-6)


def test_contact_grows_with_load_up_to_full_contact() -> None:
    pressure = np.linspace(0.0, 20.0, 500)
    fraction = contact_fraction(pressure, 5.55, 2.0, 1.6)
    assert fraction[0] == 0.0
    assert np.all(np.diff(fraction) > 0.0)
    assert np.all(np.diff(fraction, 2) < 1e-15)  # ever less for the same step of load
    assert contact_fraction(np.array([1e6]), 5.55, 2.0, 1.6)[0] == 1.0


def test_tension_makes_no_contact() -> None:
    assert np.all(contact_fraction(np.array([-5.0, -1e-9, 0.0]), 5.55, 2.0, 1.6) == 0.0)


def test_only_the_groups_kappa_over_slope_and_pressure_over_modulus_matter() -> None:
    pressure = np.array([0.5, 1.0, 4.0])
    one = contact_fraction(pressure, 5.55, 2.0, 1.6)
    np.testing.assert_allclose(contact_fraction(3 * pressure, 3 * 5.55, 2.0, 1.6), one, rtol=1e-14)
    np.testing.assert_allclose(contact_fraction(pressure, 5.55, 2.5, 2.0), one, rtol=1e-14)


# gaps


def test_gap_closes_to_the_decay_length_and_opens_without_bound() -> None:
    """Over the whole area the mean separation is -u0 ln(A_r), u0 = h_rms / 2 (Persson 2007)."""
    fraction = np.array([1e-4, 1e-2, 0.1, 0.5, 0.9, 0.999])
    over_whole_area = (1.0 - fraction) * mean_gap_um(fraction, RMS_UM)
    np.testing.assert_allclose(over_whole_area, -0.5 * RMS_UM * np.log(fraction), rtol=1e-12)
    assert mean_gap_um(np.array([1.0]), RMS_UM)[0] == pytest.approx(0.5 * RMS_UM, rel=1e-14)
    assert np.isfinite(mean_gap_um(np.array([0.0]), RMS_UM)[0])


def test_gap_falls_with_contact_without_a_step_where_its_series_takes_over() -> None:
    fraction = np.unique(np.concatenate([np.linspace(1e-4, 1.0, 2000), 1.0 - np.geomspace(1e-7, 1e-2, 300)]))
    gap = mean_gap_um(fraction, RMS_UM)
    assert np.all(np.diff(gap) < 0.0)
    across = mean_gap_um(1.0 - 1e-4 * np.array([1 - 1e-9, 1 + 1e-9]), RMS_UM)
    assert across[0] == pytest.approx(across[1], rel=1e-11)


# the mean over gaps


@pytest.mark.parametrize("media", MEDIA)
def test_mean_over_gaps_equals_brute_force_even_next_to_the_critical_angle(
    media: tuple[float, float, float],
) -> None:
    critical = kinks(media)[0]
    near = critical + np.array([-1e-2, -1e-3, -1e-5, 1e-5, 1e-3, 4e-3, 1e-2])
    cosine = np.concatenate([[0.03, 0.25, 0.5, 0.8, 0.9, 1.0], near])
    for mean_um in (0.02, 0.5, 5.0, 25.0):
        ours = contact._mean_over_gaps(*media, np.array([mean_um]), cosine, WAVELENGTH)[0]
        exact = [brute_mean(media, mean_um, c) for c in cosine]
        np.testing.assert_allclose(ours, exact, atol=2e-6)


@pytest.mark.parametrize("media", MEDIA)
def test_fringes_and_tunnelling_meet_at_the_critical_angle(media: tuple[float, float, float]) -> None:
    critical, mean_um = kinks(media)[0], np.array([0.02, 0.5, 5.0, 50.0])
    sides = critical + np.array([-1e-11, 1e-11])
    means = contact._mean_over_gaps(*media, mean_um, sides, WAVELENGTH)
    np.testing.assert_allclose(means[:, 0], means[:, 1], atol=1e-3)  # infinite slope: sqrt(1e-11) apart


def test_mean_over_gaps_does_not_depend_on_its_company() -> None:
    """The nodes are shared between all means; a wide gap beside a narrow one must not change either."""
    cosine = np.array([0.1, 0.5, 0.71, 0.72, 0.9])
    together = contact._mean_over_gaps(*DRY, np.array([0.01, 500.0]), cosine, WAVELENGTH)
    for row, mean_um in enumerate((0.01, 500.0)):
        alone = contact._mean_over_gaps(*DRY, np.array([mean_um]), cosine, WAVELENGTH)[0]
        np.testing.assert_allclose(together[row], alone, atol=1e-9)


def test_wide_gaps_tunnel_in_proportion_to_the_share_of_narrow_ones() -> None:
    """For m far above the range of tunnelling, the mean is (1/m) ∫ T dg: what lies within that range."""
    gap = np.linspace(0.0, 4.0, 4001)
    range_um = simpson(law(DRY, gap, 0.5), x=gap)
    mean = contact._mean_over_gaps(*DRY, np.array([1e4]), np.array([0.5]), WAVELENGTH)[0, 0]
    assert 0.1 < range_um < 0.3
    assert mean == pytest.approx(range_um / 1e4, rel=1e-4)


def test_transmittance_of_the_mean_gap_would_be_wrong() -> None:
    """Why the mean is taken at all: a gap of micrometres lets nothing tunnel, its narrow places do.

    At a tenth of real contact, the usual state, the loose areas pass 8 % of what the real contact passes.
    """
    mean_um = float(mean_gap_um(np.array([0.1]), RMS_UM)[0])
    of_mean = float(law(DRY, mean_um, 0.5))
    mean_of = float(contact._mean_over_gaps(*DRY, np.array([mean_um]), np.array([0.5]), WAVELENGTH)[0, 0])
    assert of_mean < 1e-20
    assert 0.9 * mean_of > 0.05 * 0.1 * float(law(DRY, 0.0, 0.5))


# the table


@pytest.mark.parametrize("media", MEDIA)
def test_table_equals_brute_force_at_random_places(media: tuple[float, float, float]) -> None:
    """To 1e-4, but for the cells beside a critical angle (infinite slope), and A_r above two nodes."""
    optics = contact_optics(*media, 0.68, RMS_UM, WAVELENGTH)
    step = 1.0 / (optics.transmittance.shape[1] - 1)
    rng = np.random.default_rng(3)
    tried = 0
    while tried < 25:
        fraction, cosine = rng.uniform(2 / 128, 1.0), rng.uniform(0.0, 1.0)
        if min(abs(cosine - kink) for kink in kinks(media)) < 8 * step:
            continue
        tried += 1
        mean_um = float(mean_gap_um(np.array([fraction]), RMS_UM)[0])
        apart = brute_mean(media, mean_um, cosine)
        exact = fraction * float(law(media, 0.0, cosine)) + (1.0 - fraction) * apart
        assert bilinear(optics, fraction, cosine) == pytest.approx(exact, abs=1e-4), (fraction, cosine)


def test_table_is_finer_than_its_kinks_matter() -> None:
    """Beside a critical angle single cells are off by up to a few 1e-2, but not the integral over angles."""
    coarse = contact_optics(*DRY, 0.68, RMS_UM, WAVELENGTH)
    fine = contact_optics(*DRY, 0.68, RMS_UM, WAVELENGTH, n_cos=8193)
    np.testing.assert_allclose(coarse.hemispherical, fine.hemispherical, atol=2e-5)


@pytest.mark.parametrize("media", MEDIA)
def test_more_contact_lets_more_light_through_beyond_the_critical_angle(
    media: tuple[float, float, float],
) -> None:
    optics = contact_optics(*media, 0.68, RMS_UM, WAVELENGTH)
    cosine = np.linspace(0.0, 1.0, optics.transmittance.shape[1])
    dark = (cosine < kinks(media)[0]) & (cosine > 0.0)
    assert np.all(np.diff(optics.transmittance[:, dark], axis=0) >= 0.0)
    assert np.all((optics.transmittance >= 0.0) & (optics.transmittance <= 1.0))
    assert np.all(optics.transmittance[:, 0] == 0.0)  # grazing light is mirrored


@pytest.mark.parametrize("media", MEDIA)
def test_full_contact_and_none(media: tuple[float, float, float]) -> None:
    optics = contact_optics(*media, 0.68, RMS_UM, WAVELENGTH)
    cosine = np.linspace(0.0, 1.0, optics.transmittance.shape[1])
    np.testing.assert_allclose(optics.transmittance[-1], law(media, 0.0, cosine), atol=1e-13)
    beyond = cosine < kinks(media)[0] - 0.1
    assert optics.transmittance[0, beyond].max() < 5e-3  # unloaded: gaps of 60 µm on average


def test_hemispherical_mean_is_that_of_the_interpolant() -> None:
    optics = contact_optics(*DRY, 0.68, RMS_UM, WAVELENGTH)
    fine = np.linspace(0.0, 1.0, 8 * 1024 + 1)
    for row in (0, 17, 128):
        values = np.interp(fine, np.linspace(0.0, 1.0, 1025), optics.transmittance[row])
        # Simpson's rule is exact for cubics, and x times a linear piece is a quadratic
        assert optics.hemispherical[row] == pytest.approx(2 * simpson(values * fine, x=fine), rel=1e-12)


# energy


def from_tissue(media: tuple[float, float, float], fraction: Array) -> Array:
    """Hemispherical transmittance for isotropic light inside the tissue, integrated on the tissue's side."""
    backward = media[::-1]
    cosine = np.linspace(0.0, 1.0, 4001)
    touching = law(backward, 0.0, cosine)
    apart = contact._mean_over_gaps(*backward, mean_gap_um(fraction, RMS_UM), cosine, WAVELENGTH)
    transmittance = fraction[:, None] * touching + (1.0 - fraction[:, None]) * apart
    return np.asarray(2.0 * simpson(transmittance * cosine, x=cosine, axis=-1))


@pytest.mark.parametrize("media", MEDIA)
def test_isotropic_light_meets_the_same_face_from_both_sides(media: tuple[float, float, float]) -> None:
    """n3² T_in = n1² T_hemispherical: étendue and reciprocity, integrated over each side's own angles."""
    optics = contact_optics(*media, 0.68, RMS_UM, WAVELENGTH)
    fraction = np.linspace(0.0, 1.0, 129)
    expected = (media[0] / media[2]) ** 2 * optics.hemispherical
    np.testing.assert_allclose(from_tissue(media, fraction), expected, atol=2e-4)


@pytest.mark.parametrize("albedo", [0.0, 0.3, 0.68, 0.95, 1.0])
@pytest.mark.parametrize("media", MEDIA)
def test_mirrored_reemitted_and_absorbed_light_add_up(
    media: tuple[float, float, float], albedo: float
) -> None:
    """For every contact and angle, with the passes through the tissue followed one by one."""
    optics = contact_optics(*media, albedo, RMS_UM, WAVELENGTH)
    entered = optics.transmittance
    reemitted = entered * (optics.diffuse_gain * optics.hemispherical)[:, None]

    inside = from_tissue(media, np.linspace(0.0, 1.0, 129))
    in_tissue, absorbed, left = np.ones(129), np.zeros(129), np.zeros(129)
    for _ in range(400):
        absorbed += (1.0 - albedo) * in_tissue
        left += albedo * inside * in_tissue
        in_tissue *= albedo * (1.0 - inside)
    assert in_tissue.max() < 1e-3
    np.testing.assert_allclose((1.0 - entered) + reemitted + entered * absorbed[:, None], 1.0, atol=1e-3)
    np.testing.assert_allclose(reemitted, entered * left[:, None], atol=1e-3)


@pytest.mark.parametrize("media", MEDIA)
def test_white_furnace_on_the_table_even_between_its_nodes(media: tuple[float, float, float]) -> None:
    """Without absorption mirror and re-emission are all of it: K times the hemispherical mean is 1."""
    optics = contact_optics(*media, 1.0, RMS_UM, WAVELENGTH)
    nodes, between = np.linspace(0.0, 1.0, 129), np.linspace(0.0, 1.0, 5001)
    np.testing.assert_allclose(optics.diffuse_gain * optics.hemispherical, 1.0, atol=1e-12)
    gain, mean = (np.interp(between, nodes, row) for row in (optics.diffuse_gain, optics.hemispherical))
    np.testing.assert_allclose(gain * mean, 1.0, atol=1e-3)


def test_black_tissue_gives_nothing_back() -> None:
    assert np.all(contact_optics(*DRY, 0.0, RMS_UM, WAVELENGTH).diffuse_gain == 0.0)


def test_gain_is_the_scattering_ratio_when_nothing_comes_back_twice() -> None:
    """To first order in the albedo, K = (n1/n3)² albedo."""
    optics = contact_optics(*DRY, 1e-6, RMS_UM, WAVELENGTH)
    np.testing.assert_allclose(optics.diffuse_gain, (1.4336 / 1.40) ** 2 * 1e-6, rtol=2e-6)


# states of the surface


def test_full_contact_is_all_or_nothing() -> None:
    pressure = np.array([-1.0, 0.0, 1e-6, 0.5, 50.0])
    closed = real_contact(pressure, Skin(contact="full"), 5.55)
    np.testing.assert_array_equal(closed, [0.0, 0.0, 1.0, 1.0, 1.0])
    rough = real_contact(pressure, Skin(), 5.55)
    np.testing.assert_array_equal(rough, contact_fraction(pressure, 5.55, 2.0, 1.6))


@pytest.mark.parametrize("media", [DRY, WET])
def test_dust_lets_through_what_wide_gaps_do(media: tuple[float, float, float]) -> None:
    """Nothing beyond the critical angle, whatever the pressure; below it two faces without fringes.

    Incoherent light between them sums to 1/T = 1/T_12 + 1/T_23 - 1, for s and p on their own.
    """
    all_dust = contact_optics(*media, 0.68, RMS_UM, WAVELENGTH, dust=1.0).transmittance
    assert np.ptp(all_dust, axis=0).max() == 0.0
    cosine = np.linspace(0.0, 1.0, all_dust.shape[1])
    dark = cosine < kinks(media)[0]
    assert np.all(all_dust[0, dark] == 0.0)
    cosine = cosine[~dark][3:]
    between = np.sqrt(1.0 - (media[0] / media[1]) ** 2 * (1.0 - cosine**2))
    first = gap_transmittance(media[0], media[1], media[1], 0.0, cosine, WAVELENGTH)
    second = gap_transmittance(media[1], media[2], media[2], 0.0, between, WAVELENGTH)
    washed = np.mean([1 / (1 / a + 1 / b - 1) for a, b in zip(first, second, strict=True)], axis=0)
    np.testing.assert_allclose(all_dust[0, ~dark][3:], washed, atol=1e-4)


def test_dust_takes_its_share_of_the_mean_not_of_the_contact() -> None:
    clean, dusty, dust = (contact_optics(*DRY, 0.68, RMS_UM, WAVELENGTH, dust=d) for d in (0.0, 0.25, 1.0))
    mixed = 0.75 * clean.transmittance + 0.25 * dust.transmittance
    np.testing.assert_allclose(dusty.transmittance, mixed, atol=1e-14)


def test_wet_gaps_let_more_light_through_and_hold_less_back() -> None:
    """Water in the gaps moves the critical angle from 46 to 68 degrees from the normal."""
    dry, wet = (contact_optics(*media, 0.68, RMS_UM, WAVELENGTH) for media in (DRY, WET))
    assert np.all(wet.hemispherical >= dry.hemispherical - 1e-12)
    assert wet.hemispherical[0] > 1.5 * dry.hemispherical[0]
    assert kinks(WET)[0] == pytest.approx(np.sqrt(1 - (1.33 / 1.4336) ** 2))
