"""The contact surface as a Mitsuba BSDF: energy, reciprocity, and sampling that draws what it claims."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from scipy.stats import qmc
from sensors import ALBEDO, contact_bsdf, contact_table

from scenes.contact import contact_optics

FRACTIONS = [0.0, 0.003, 0.13, 0.5, 1.0]
# Grazing, where this tissue admits nothing; beyond and at the critical angle of an air gap; normal.
COSINES = [0.05, 0.4, 0.72, 1.0]


@pytest.fixture(scope="module")
def mi(variant: str) -> ModuleType:
    import mitsuba

    from scenes import bsdf  # noqa: F401  registers the plugin

    return mitsuba


@cache
def _material(fraction: float, albedo: float) -> Any:
    import mitsuba

    return mitsuba.load_dict(contact_bsdf(fraction, albedo))


def material(fraction: float, albedo: float = ALBEDO) -> Any:
    return _material(fraction, albedo)


def look_up(fraction: float, cosine: np.ndarray, albedo: float = ALBEDO) -> tuple[np.ndarray, float, float]:
    """T, its hemispherical mean and K by numpy's own interpolation."""
    table = contact_table(albedo)
    nodes = np.linspace(0.0, 1.0, table.transmittance.shape[0])
    row = np.array([np.interp(fraction, nodes, column) for column in table.transmittance.T])
    transmittance = np.interp(cosine, np.linspace(0.0, 1.0, row.size), row)
    mean, gain = (float(np.interp(fraction, nodes, v)) for v in (table.hemispherical, table.diffuse_gain))
    return transmittance, mean, gain


def absorbed(fraction: float, cosine: float, albedo: float) -> float:
    """Light that stays in the tissue: each pass absorbs 1 - albedo, T_in leaves, the rest goes on."""
    transmittance, mean, _ = look_up(fraction, np.array(cosine), albedo)
    inside = (1.4336 / 1.40) ** 2 * mean
    return float(transmittance * (1.0 - albedo) / (1.0 - albedo * (1.0 - inside)))


def arriving(mi: ModuleType, cosine: Any, count: int, azimuth: float = 0.7) -> Any:
    """Surface interactions with light at this cosine on the guide's side."""
    import drjit as dr

    si = dr.zeros(mi.SurfaceInteraction3f, count)
    cosine = mi.Float(cosine)
    sine = dr.sqrt(dr.maximum(1.0 - cosine * cosine, 0.0))
    si.wi = mi.Vector3f(sine * np.cos(azimuth), sine * np.sin(azimuth), cosine)
    return si


def hemisphere(mi: ModuleType, count: int = 4096, azimuths: int = 4) -> tuple[Any, np.ndarray]:
    """Directions at the middles of `count` equal steps of cosine, and their solid angles."""
    cosine = np.repeat((np.arange(count) + 0.5) / count, azimuths)
    phi = np.tile(2 * np.pi * np.arange(azimuths) / azimuths, count)
    sine = np.sqrt(1.0 - cosine**2)
    direction = mi.Vector3f(*(mi.Float(v) for v in (sine * np.cos(phi), sine * np.sin(phi), cosine)))
    return direction, np.full(cosine.size, 2 * np.pi / (count * azimuths))


def even_numbers(count: int) -> np.ndarray:
    """(3, count) points that fill the unit cube evenly, `count` a power of two."""
    return np.asarray(qmc.Sobol(3, rng=1).random_base2(count.bit_length() - 1).T)


def draw(mi: ModuleType, plugin: Any, cosine: float, count: int = 2**17, component: int | None = None) -> Any:
    ctx = mi.BSDFContext()
    if component is not None:
        ctx.component = component
    u = [mi.Float(row.astype(np.float32)) for row in even_numbers(count)]
    return plugin.sample(ctx, arriving(mi, cosine, count), u[0], mi.Point2f(u[1], u[2]), mi.Bool(True))


# Lookup


def test_table_on_the_device_equals_numpys_interpolation(mi: ModuleType) -> None:
    from scenes.bsdf import Table

    table = Table(Table.pack(contact_table()))
    rng = np.random.default_rng(5)
    edge = [(0.0, 0.0), (0.0, 1.0), (1.0, 0.0), (1.0, 1.0), (0.5, 0.25)]  # corners and nodes
    places = np.concatenate([rng.random((300, 2)), edge]).astype(np.float32)
    fraction, cosine = mi.Float(places[:, 0]), mi.Float(places[:, 1])
    expected = [look_up(float(a), np.array(c)) for a, c in places.astype(np.float64)]
    for ours, column in zip(
        (
            table.transmittance(fraction, cosine),
            table.hemispherical(fraction),
            table.diffuse(fraction, cosine, cosine),
        ),
        zip(*expected, strict=True),
        strict=True,
    ):
        # single precision places a point within a cell to 1e-4 of the cell, steep beside the critical angles
        np.testing.assert_allclose(np.asarray(ours), np.array(column, dtype=np.float64), atol=1e-5)


def test_lookup_outside_the_table_is_clamped(mi: ModuleType) -> None:
    from scenes.bsdf import Table

    table = Table(Table.pack(contact_table()))
    beyond = table.transmittance(mi.Float([-0.1, 1.1]), mi.Float([1.0 + 1e-6, -1e-6]))
    inside = table.transmittance(mi.Float([0.0, 1.0]), mi.Float([1.0, 0.0]))
    np.testing.assert_allclose(np.asarray(beyond), np.asarray(inside))


# Energy


@pytest.mark.parametrize("albedo", [0.0, ALBEDO, 1.0])
def test_reflected_reemitted_and_absorbed_light_add_up_when_sampled(mi: ModuleType, albedo: float) -> None:
    for fraction in FRACTIONS:
        for cosine in COSINES:
            _, weight = draw(mi, material(fraction, albedo), cosine)
            reflected = float(np.mean(np.asarray(weight[0])))
            assert reflected + absorbed(fraction, cosine, albedo) == pytest.approx(1.0, abs=1e-3), (
                fraction,
                cosine,
            )


@pytest.mark.parametrize("albedo", [0.0, ALBEDO, 1.0])
def test_reflected_reemitted_and_absorbed_light_add_up_by_quadrature(mi: ModuleType, albedo: float) -> None:
    """The mirror's share from the law, the diffuse lobe integrated from `eval`."""
    wo, solid_angle = hemisphere(mi)
    for fraction in FRACTIONS:
        for cosine in COSINES:
            si = arriving(mi, cosine, solid_angle.size)
            lobe = np.asarray(material(fraction, albedo).eval(mi.BSDFContext(), si, wo, mi.Bool(True))[0])
            mirror = 1.0 - float(look_up(fraction, np.array(cosine), albedo)[0])
            total = mirror + float(np.sum(lobe * solid_angle)) + absorbed(fraction, cosine, albedo)
            assert total == pytest.approx(1.0, abs=1e-3), (fraction, cosine)


def test_energy_balances_between_the_tables_nodes(mi: ModuleType) -> None:
    """A thousand random contacts from a texture, at random angles; without absorption nothing is lost."""
    from scenes.bsdf import Table

    rng = np.random.default_rng(8)
    side, per = 32, 2048
    count = side * side
    fraction, cosine = rng.random((side, side)).astype(np.float32), rng.random(count).astype(np.float32)
    bitmap = mi.Bitmap(fraction[..., None])
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "nearest"}
    table = Table.pack(contact_table(1.0))
    plugin = mi.load_dict({"type": "frustrated_tir", "table": table, "contact_fraction": texture})

    wo, solid_angle = hemisphere(mi, per, 1)
    si = arriving(mi, np.repeat(cosine, per), count * per)
    x, y = np.tile((np.arange(side) + 0.5) / side, side), np.repeat((np.arange(side) + 0.5) / side, side)
    si.uv = mi.Point2f(mi.Float(np.repeat(x, per)), mi.Float(np.repeat(y, per)))
    wo = mi.Vector3f(*(mi.Float(np.tile(np.asarray(part), count)) for part in wo))
    lobe = np.asarray(plugin.eval(mi.BSDFContext(), si, wo, mi.Bool(True))[0]).reshape(count, per)
    mirror = 1.0 - np.asarray(Table(table).transmittance(mi.Float(fraction.ravel()), mi.Float(cosine)))
    np.testing.assert_allclose(mirror + lobe @ solid_angle, 1.0, atol=1e-3)


# Sampling


def chi_square(
    mi: ModuleType, fraction: float, cosine: float, mode: str = "Radiance", seed: int = 0, distort: Any = None
) -> Any:
    """Mitsuba's own test: are as many directions drawn as `pdf` says, the mirror's left aside?"""
    from mitsuba import chi2

    ctx = mi.BSDFContext(getattr(mi.TransportMode, mode))
    plugin, on = material(fraction), mi.Bool(True)

    def draws(u: Any) -> Any:
        si = arriving(mi, cosine, u.shape[1])
        sample, _ = plugin.sample(ctx, si, u[0], mi.Point2f(u[1], u[2]), on)
        diffuse = sample.sampled_type == mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
        return sample.wo, mi.Float(diffuse)

    def density(wo: Any) -> Any:
        value = plugin.pdf(ctx, arriving(mi, cosine, wo.shape[1]), wo, on)
        return value if distort is None else value * distort(wo)

    domain = chi2.SphericalDomain()
    return chi2.ChiSquareTest(
        domain, draws, density, sample_dim=3, sample_count=300_000, res=31, ires=24, seed=seed
    )


@pytest.mark.parametrize("fraction", [0.003, 0.13, 1.0])
@pytest.mark.parametrize("cosine", [0.3, 0.72, 1.0])
@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
def test_samples_pass_the_chi_square_test(
    mi: ModuleType,
    fraction: float,
    cosine: float,
    mode: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """In number as well as in direction: the diffuse share of all samples is 0.3 % to all of them."""
    monkeypatch.chdir(tmp_path)  # a failing test writes its histograms where it stands
    test = chi_square(mi, fraction, cosine, mode, seed=int(100 * (fraction + cosine)))
    passed = test.run(significance_level=0.01, test_count=18)
    print(f"A_r {fraction}, cos {cosine}, {mode}: p-value {test.p_value:.3f}")
    assert passed, test.messages


@pytest.mark.parametrize("fraction", [0.003, 0.13, 0.5039, 1.0])  # on a node of the table and between
def test_light_from_an_led_keeps_the_weight_of_the_albedo(mi: ModuleType, fraction: float) -> None:
    """Drawn as the lobe is, no sample outweighs another: else weights grow from bounce to bounce."""
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    u = [mi.Float(row.astype(np.float32)) for row in even_numbers(2**17)]
    _, weight = material(fraction).sample(
        ctx, arriving(mi, 0.4, 2**17), u[0], mi.Point2f(u[1], u[2]), mi.Bool(True)
    )
    weight = np.asarray(weight[0])
    transmittance, mean, gain = look_up(fraction, np.array(0.4))
    albedo = 1.0 - transmittance + transmittance * gain * mean
    assert weight.mean(dtype=np.float64) == pytest.approx(float(albedo), abs=1e-4)
    assert np.quantile(weight, 0.999) < 1.1 * albedo


def test_component_alone_passes_mitsubas_own_adapter(
    mi: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`BSDFAdapter` as it comes, on a tissue dense enough that no sample is worth nothing."""
    from mitsuba import chi2

    from scenes.bsdf import Table

    monkeypatch.chdir(tmp_path)
    dense = Table.pack(contact_optics(1.40, 1.0, 1.60, ALBEDO, 10.0, 550.0))
    ctx = mi.BSDFContext()
    ctx.component = 1
    adapter = chi2.BSDFAdapter(
        "frustrated_tir", {**contact_bsdf(0.13), "table": dense}, wi=[0.6, 0, 0.8], ctx=ctx
    )
    test = chi2.ChiSquareTest(chi2.SphericalDomain(), *adapter, sample_dim=3, sample_count=300_000, res=31)
    assert test.run(significance_level=0.01, test_count=1), test.messages


@pytest.mark.parametrize("distort", [lambda wo: 0.88 + 0.18 * wo.z, lambda wo: 1.02])
def test_chi_square_test_refuses_a_wrong_density(
    mi: ModuleType, distort: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A few per cent too many samples near the normal, or altogether, are found out."""
    monkeypatch.chdir(tmp_path)
    assert not chi_square(mi, 1.0, 0.8, distort=distort).run(significance_level=0.01, quiet=True)


@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("cosine", COSINES)
def test_mirror_and_diffuse_samples_are_drawn_in_their_shares(
    mi: ModuleType, fraction: float, cosine: float
) -> None:
    """Mirror: probability (1 - T) / (1 - T + T K mean), pdf the same, direction and weight of a mirror."""
    sample, weight = draw(mi, material(fraction), cosine)
    transmittance, mean, gain = look_up(fraction, np.array(cosine))
    albedo = 1.0 - transmittance + transmittance * gain * mean
    mirror_share = float((1.0 - transmittance) / albedo)

    component = np.asarray(sample.sampled_component)
    mirrored = component == 0
    assert np.mean(mirrored) == pytest.approx(mirror_share, abs=1e-3)
    kinds = np.where(mirrored, +mi.BSDFFlags.DeltaReflection, +mi.BSDFFlags.DiffuseReflection)
    np.testing.assert_array_equal(np.asarray(sample.sampled_type), kinds)
    assert np.all(np.asarray(sample.eta) == 1.0)
    if mirrored.any():
        np.testing.assert_allclose(np.asarray(sample.pdf)[mirrored], mirror_share, atol=1e-4)
        np.testing.assert_allclose(np.asarray(weight[0])[mirrored], albedo, rtol=1e-4)
        si = arriving(mi, cosine, 1)
        outgoing, incoming = np.array(sample.wo)[:, mirrored], np.array(si.wi)
        np.testing.assert_allclose(
            outgoing, np.broadcast_to(incoming * [[-1], [-1], [1]], outgoing.shape), atol=1e-6
        )


@pytest.mark.parametrize("fraction", FRACTIONS)
@pytest.mark.parametrize("cosine", COSINES)
def test_weight_of_a_diffuse_sample_is_value_over_density(
    mi: ModuleType, fraction: float, cosine: float
) -> None:
    plugin, count = material(fraction), 2**12
    sample, weight = draw(mi, plugin, cosine, count)
    si, ctx = arriving(mi, cosine, count), mi.BSDFContext()
    value = np.asarray(plugin.eval(ctx, si, sample.wo, mi.Bool(True))[0])
    density = np.asarray(plugin.pdf(ctx, si, sample.wo, mi.Bool(True)))
    both = plugin.eval_pdf(ctx, si, sample.wo, mi.Bool(True))
    np.testing.assert_array_equal(np.asarray(both[0][0]), value)
    np.testing.assert_array_equal(np.asarray(both[1]), density)
    diffuse = np.asarray(sample.sampled_component) == 1
    assert diffuse.any() or cosine == 0.05
    np.testing.assert_allclose(np.asarray(sample.pdf)[diffuse], density[diffuse], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(
        np.asarray(weight[0])[diffuse], value[diffuse] / density[diffuse], rtol=2e-4, atol=1e-6
    )


@pytest.mark.parametrize("fraction", FRACTIONS)
def test_density_integrates_to_the_diffuse_share(mi: ModuleType, fraction: float) -> None:
    wo, solid_angle = hemisphere(mi)
    for cosine in COSINES:
        si = arriving(mi, cosine, solid_angle.size)
        density = np.asarray(material(fraction).pdf(mi.BSDFContext(), si, wo, mi.Bool(True)))
        transmittance, mean, gain = look_up(fraction, np.array(cosine))
        diffuse = transmittance * gain * mean
        expected = float(diffuse / (1.0 - transmittance + diffuse))
        assert float(np.sum(density * solid_angle)) == pytest.approx(expected, abs=1e-4)


@pytest.mark.parametrize("component", [0, 1])
def test_single_components_carry_their_own_energy(mi: ModuleType, component: int) -> None:
    """Asked for one lobe only, the other's energy is left out, not moved over."""
    transmittance, mean, gain = look_up(0.5, np.array(0.4))
    expected = (1.0 - transmittance, transmittance * gain * mean)[component]
    sample, weight = draw(mi, material(0.5), 0.4, component=component)
    assert np.all(np.asarray(sample.sampled_component) == component)
    assert float(np.mean(np.asarray(weight[0]))) == pytest.approx(float(expected), abs=1e-3)


# Form


@pytest.mark.parametrize("fraction", FRACTIONS)
def test_diffuse_lobe_is_reciprocal_and_is_the_formula(mi: ModuleType, fraction: float) -> None:
    """f(i, o) = f(o, i) = T(cos_i) T(cos_o) K / pi; `eval` carries the cosine of the way out."""
    rng = np.random.default_rng(6)
    cos_i, cos_o = rng.uniform(0.02, 1.0, (2, 500))
    forth, back = arriving(mi, cos_i, 500), arriving(mi, cos_o, 500, azimuth=2.5)
    plugin, ctx, on = material(fraction), mi.BSDFContext(), mi.Bool(True)
    one = np.asarray(plugin.eval(ctx, forth, back.wi, on)[0]) / cos_o
    other = np.asarray(plugin.eval(ctx, back, forth.wi, on)[0]) / cos_i
    np.testing.assert_allclose(one, other, rtol=2e-5, atol=1e-7)
    t_i, _, gain = look_up(fraction, cos_i)
    t_o, _, _ = look_up(fraction, cos_o)
    np.testing.assert_allclose(one, t_i * t_o * gain / np.pi, rtol=1e-3, atol=1e-5)


def test_black_from_behind_and_towards_behind(mi: ModuleType) -> None:
    plugin, ctx, on = material(0.5), mi.BSDFContext(), mi.Bool(True)
    wo = mi.Vector3f(mi.Float([0.6, 0.6]), mi.Float([0.0, 0.0]), mi.Float([0.8, -0.8]))
    behind = arriving(mi, [-0.5, -0.5], 2)
    assert np.all(np.asarray(plugin.eval(ctx, behind, wo, on)[0]) == 0.0)
    assert np.all(np.asarray(plugin.pdf(ctx, behind, wo, on)) == 0.0)
    front = arriving(mi, [0.5, 0.5], 2)
    values = np.asarray(plugin.eval(ctx, front, wo, on)[0])
    assert values[0] > 0.0 and values[1] == 0.0
    assert np.asarray(plugin.pdf(ctx, front, wo, on))[1] == 0.0
    _, weight = draw(mi, plugin, -0.5, 64)
    assert np.all(np.asarray(weight[0]) == 0.0)


def test_grazing_light_gives_no_nan(mi: ModuleType) -> None:
    for fraction in (0.0, 1.0):
        for cosine in (0.0, 1e-7, 1e-30):
            sample, weight = draw(mi, material(fraction), cosine, 256)
            assert np.all(np.isfinite(np.asarray(weight[0]))) and np.all(np.isfinite(np.asarray(sample.pdf)))
    black, perfect = draw(mi, material(1.0, 0.0), 1.0, 256)
    assert np.all(np.isfinite(np.asarray(perfect[0]))) and np.all(np.isfinite(np.array(black.wo)))


def test_contact_is_changed_in_place(mi: ModuleType) -> None:
    plugin = mi.load_dict(contact_bsdf(0.0))
    parameters = mi.traverse(plugin)
    parameters["contact_fraction.value"] = 0.5
    parameters.update()
    wo = mi.Vector3f(0.6, 0.0, 0.8)
    ours = plugin.eval(mi.BSDFContext(), arriving(mi, 0.4, 1), wo, mi.Bool(True))
    expected = material(0.5).eval(mi.BSDFContext(), arriving(mi, 0.4, 1), wo, mi.Bool(True))
    assert np.asarray(ours[0])[0] == pytest.approx(np.asarray(expected[0])[0], rel=1e-6)
