"""Polarised light: the laws of stack, faces and bases; the walk of both kinds of light; what the mean of s
and p costs (`-m slow -s`)."""

from __future__ import annotations

import dataclasses
import json
import os
import subprocess
import sys
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sensors import HALF_MM, bump, paper_sensor

from scenes import backend, view
from scenes.contact import contact_optics, mean_gap_um
from scenes.ftir import gap_reflection, gap_transmittance
from scenes.mueller import contact_mueller, mean_over_gaps

HERE = Path(__file__).resolve().parent
WAVELENGTH = 550.0
SHIPPED = (1.4336, 1.0, 1.40)


def test_amplitudes_agree_with_an_independent_code_at_random() -> None:
    """Magnitude and phase of r_s and r_p against the `tmm` package, at all angles and gaps of 0 to 4 µm."""
    from tmm import coh_tmm

    rng = np.random.default_rng(1)
    worst = 0.0
    for _ in range(400):
        n1, n0, n3 = rng.uniform(1.0, 2.0, 3)
        gap, angle = rng.uniform(0.0, 2.0) ** 2, rng.uniform(0.0, 1.56)
        ours = gap_reflection(n1, n0, n3, gap, np.cos(angle), WAVELENGTH)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it reminds its caller of conventions beyond the critical angle
            for wave, amplitude in zip("sp", ours, strict=True):
                stack = coh_tmm(wave, [n1, n0, n3], [np.inf, 1e3 * gap, np.inf], angle, WAVELENGTH)
                worst = max(worst, abs(complex(amplitude) - stack["r"]))
    print(f"largest difference from tmm {worst:.1e}")
    assert worst < 1e-9


def test_reflected_and_transmitted_light_is_all_light() -> None:
    """Also at w = 0, at grazing incidence, and where gaps are wider than anything tunnels."""
    cosine = np.append(np.linspace(0.0, 1.0, 301), np.sqrt(1.0 - 1.0 / SHIPPED[0] ** 2))
    gaps = np.array([0.0, 1e-6, 0.05, 0.3, 5.0, 1e3])[:, None]
    amplitudes = gap_reflection(*SHIPPED, gaps, cosine, WAVELENGTH)
    transmitted = gap_transmittance(*SHIPPED, gaps, cosine, WAVELENGTH)
    for amplitude, share in zip(amplitudes, transmitted, strict=True):
        np.testing.assert_allclose(np.abs(amplitude) ** 2 + share, 1.0, atol=1e-12)


def test_amplitudes_refuse_what_the_law_refuses() -> None:
    with pytest.raises(ValueError, match=r"gap_reflection: gap_um: received -1.0; allowed 0 to inf, finite"):
        gap_reflection(*SHIPPED, -1.0, 0.5, WAVELENGTH)


@pytest.mark.parametrize(
    ("indices", "mean_um"), [(SHIPPED, 0.3), (SHIPPED, 8.0), ((1.4336, 1.41, 1.36), 2.0)]
)
def test_means_over_gaps_are_the_integrals(indices: tuple[float, float, float], mean_um: float) -> None:
    """Against the trapezoidal rule, before and beyond both critical angles."""
    cosine = np.array([0.02, 0.3, 0.6, 0.7166, 0.72, 1.0])
    gap = np.linspace(0.0, 30.0 * mean_um, 100_001)
    density = np.exp(-gap / mean_um) / mean_um * (gap[1] - gap[0])
    density[[0, -1]] *= 0.5
    found = mean_over_gaps(indices, np.array([mean_um]), cosine, WAVELENGTH)[:, 0]
    for column, one in enumerate(cosine):
        r_s, r_p = gap_reflection(*indices, gap, one, WAVELENGTH)
        s, p, both = (density @ values for values in (np.abs(r_s) ** 2, np.abs(r_p) ** 2, r_s * r_p.conj()))
        expected = [1.0 - (s + p) / 2.0, (p - s) / 2.0, both.real, both.imag]
        np.testing.assert_allclose(found[:, column], expected, atol=1e-6)


@pytest.mark.parametrize("dust", [0.0, 0.3])
def test_matrices_are_of_the_contact_that_the_model_has(dust: float) -> None:
    """The same mean T as `contact_optics`, and nothing that no light could be: a² >= b² + c² + s²."""
    optics = contact_optics(*SHIPPED, 0.7, 10.0, WAVELENGTH, dust=dust, n_fraction=9, n_cos=257)
    matrix = contact_mueller(*SHIPPED, 10.0, WAVELENGTH, dust=dust, n_fraction=9, n_cos=257)
    gaps, cosine = mean_gap_um(np.linspace(0.0, 1.0, 9), 10.0), np.linspace(0.0, 1.0, 257)
    apart = mean_over_gaps(SHIPPED, gaps, cosine, WAVELENGTH)[0]
    expected = contact_optics(*SHIPPED, 0.7, 10.0, WAVELENGTH, n_fraction=9, n_cos=257).transmittance[0]
    np.testing.assert_allclose(apart[0], expected, atol=1e-9)

    a, b = 1.0 - optics.transmittance, -matrix.diattenuation
    length = np.sqrt(b**2 + matrix.real**2 + matrix.imaginary**2)
    assert np.all(length <= a + 1e-9)
    pure = gap_reflection(*SHIPPED, gaps[4], cosine, WAVELENGTH)
    tunnels = (cosine > 0.35) & (cosine < 0.65)
    assert np.all((length < (1.0 - 3e-4) * a)[4, tunnels]), (
        "gaps shift s and p differently: their mean depolarises"
    )
    np.testing.assert_allclose(np.abs(pure[0] * pure[1].conj())[tunnels], 1.0, atol=1e-9)


def test_retardance_of_total_reflection_is_the_closed_form(variant: str) -> None:
    """tan(delta/2) = cos(theta) sqrt(sin² - n²) / sin² (Born & Wolf 1999, sec. 1.5.4; key born1999): of the
    stack with a wide gap, of Mitsuba's Fresnel, and of ours on the device."""
    import mitsuba as mi

    from scenes import stokes

    n = SHIPPED[1] / SHIPPED[0]
    cosine = np.linspace(0.02, 0.99 * np.sqrt(1.0 - n**2), 50)
    sine2 = 1.0 - cosine**2
    delta = 2.0 * np.arctan(cosine * np.sqrt(sine2 - n**2) / sine2)
    r_s, r_p = gap_reflection(*SHIPPED, 1e3, cosine, WAVELENGTH)
    both = r_s * r_p.conj()
    np.testing.assert_allclose(np.angle(both), delta, atol=1e-9)
    face, _ = stokes.fresnel(mi.Float(cosine), mi.Float(n))
    np.testing.assert_allclose(face.c.numpy(), both.real, atol=2e-5)
    np.testing.assert_allclose(face.s.numpy(), both.imag, atol=2e-5)


@pytest.mark.parametrize("eta", [1.4336, 1.0 / 1.4336, 1.4336 / 1.515])
def test_fresnel_matrices_are_mitsubas(variant: str, eta: float) -> None:
    """From both sides, below and beyond the critical angle; and what is lost in one is in the other."""
    import mitsuba as mi

    from scenes import stokes

    values = np.concatenate([np.linspace(-1.0, -0.01, 40), np.linspace(0.01, 1.0, 40)])
    # at the critical angle the sines of single precision are apart
    cosine = mi.Float(values[np.abs(np.abs(values) - np.sqrt(abs(1 - min(eta, 1 / eta) ** 2))) > 2e-3])
    mirrored, passing = stokes.fresnel(cosine, mi.Float(eta))
    theirs = mi.mueller.specular_reflection(cosine, mi.Complex2f(eta, 0.0)).numpy()
    expected = [theirs[0, 0], theirs[0, 1], theirs[2, 2], theirs[3, 2]]
    for ours, other in zip((mirrored.a, mirrored.b, mirrored.c, mirrored.s), expected, strict=True):
        np.testing.assert_allclose(ours.numpy(), other, atol=2e-5)
    np.testing.assert_allclose(mirrored.a.numpy(), mi.fresnel(cosine, mi.Float(eta))[0].numpy(), atol=2e-6)
    theirs = mi.mueller.specular_transmission(cosine, mi.Float(eta)).numpy()
    passes = mirrored.a.numpy() < 0.9999
    for ours, other in zip(
        (passing.a, passing.b, passing.c), (theirs[0, 0], theirs[0, 1], theirs[2, 2]), strict=True
    ):
        np.testing.assert_allclose(ours.numpy()[passes], other[passes], atol=2e-5)
    np.testing.assert_allclose((mirrored.a + passing.a).numpy(), 1.0, atol=1e-6)


@pytest.mark.parametrize(("fraction", "n3"), [(1.0, 1.40), (0.0, 1.0)])
def test_contact_without_gaps_and_without_contact_is_a_plain_face(
    variant: str, fraction: float, n3: float
) -> None:
    """Touching: guide to tissue. Dust everywhere, beyond the critical angle: guide to air. Signs too."""
    import drjit as dr
    import mitsuba as mi

    from scenes import stokes

    dust = 1.0 - fraction
    matrix = contact_mueller(*SHIPPED, 10.0, WAVELENGTH, dust=dust, n_fraction=5, n_cos=1025)
    top = 1.0 if fraction else 0.95 * np.sqrt(1.0 - 1.0 / SHIPPED[0] ** 2)
    cosine = mi.Float(np.linspace(0.01, top, 64))
    cosine = dr.round(cosine * 1024) / 1024  # the table's nodes
    mirrored, _ = stokes.fresnel(cosine, mi.Float(n3 / SHIPPED[0]))
    through = 1.0 - mirrored.a
    apart, ours = stokes.Contact(matrix).at(mi.Float(fraction), cosine, through, mi.Bool(True))
    np.testing.assert_allclose(apart.numpy(), -mirrored.b.numpy(), atol=1e-4)
    for one, other in zip((ours.b, ours.c, ours.s), (mirrored.b, mirrored.c, mirrored.s), strict=True):
        np.testing.assert_allclose(one.numpy(), other.numpy(), atol=1e-4)


def test_bases_turn_as_mitsubas(variant: str) -> None:
    import drjit as dr
    import mitsuba as mi

    from scenes import stokes

    rng = np.random.default_rng(3)
    d, one, other = (mi.Vector3f(rng.normal(size=(3, 200)).astype(np.float32)) for _ in range(3))
    d = dr.normalize(d)
    side, new = (dr.normalize(v - dr.dot(v, d) * d) for v in (one, other))
    light = mi.Vector4f(rng.normal(size=(4, 200)).astype(np.float32))
    theirs = mi.mueller.rotate_stokes_basis(d, side, new) @ light
    np.testing.assert_allclose(stokes.turned(light, d, side, new).numpy(), theirs.numpy(), atol=2e-3)


def test_faces_before_the_camera_are_the_mean_on_the_axis_and_let_p_through_beside_it() -> None:
    sensor = paper_sensor()
    cosine = np.array([1.0, 0.95])
    s, p = view.faces_reflectances(sensor, cosine)
    mean = view.faces_reflectance(sensor, cosine)
    np.testing.assert_allclose([s[0], p[0]], mean[0], rtol=1e-12)
    assert s[1] > mean[1] > p[1]
    assert abs(0.5 * (s[1] + p[1]) - mean[1]) < 1e-3, "to first order the mean is that of both faces' means"


@pytest.mark.parametrize(("coupling", "walls"), [("embedded", "polished"), ("air", "diffuse")])
def test_unpolarised_light_of_the_walk_is_the_models(variant: str, coupling: Any, walls: Any) -> None:
    """With the mean of s and p at each face the walk is `trace`'s, place by place and sink by sink, and the
    energy of both kinds of light closes."""
    import drjit as dr
    import mitsuba as mi

    from scenes import recurrence, surface, trace
    from scenes.polarised import Polarised

    base = paper_sensor(coupling)
    absorbs = dataclasses.replace(base.guide, walls=walls, absorption_per_mm=0.002)
    sensor, each = dataclasses.replace(base, guide=absorbs), 2**13
    both = Polarised(sensor, surface.resample(bump(), 2 * HALF_MM))
    starts = np.array([1, 2, 3, 4])
    number, start = both._from_leds(each, starts)
    left = both._walk((number, start), 5)
    parts = both.scene, sensor, both.table, both.basis, number
    ray = trace.emit(sensor, number, recurrence.evenly(recurrence.side_by_side(each, 4), starts))
    plain = trace.walk(*parts, ray, dr.full(mi.Float, 1.0, 4 * each), mi.UInt32(trace.OTHER), 5)

    scale = np.abs(plain.maps).max()
    np.testing.assert_allclose(left.maps[0], plain.maps, atol=2e-3 * scale)
    assert np.mean(np.abs(left.maps[0] - plain.maps) > 1e-5 * scale) < 1e-3, "rays that rounding parts"
    np.testing.assert_allclose(left.sinks[0], plain.sinks, rtol=2e-3, atol=2.0)
    for light, allowed in zip(left.sinks, (2e-3, 5e-3), strict=True):
        assert light.sum() / (4 * each) == pytest.approx(1.0, abs=allowed)
    entered = left.entered.sum(axis=(-2, -1))
    np.testing.assert_allclose(entered, left.sinks[..., trace.SINKS.index("tissue")], rtol=2e-2)


MEASURED = {
    "air": (0.19, 0.19, 0.29),
    "embedded": (0.57, 0.24, 0.27),
    "air, full contact": (0.07, 0.04, 0.05),
    "embedded, full contact": (-0.03, -0.01, -0.01),
    "air, water film": (0.02, 0.00, 0.04),
    "domed": (0.32, 0.08, 0.21),
    "air, sheet": (0.24, 0.19, 0.33),
    "air, tissue 1.36": (0.18, 0.19, 0.32),
}
"""Errors of the unpolarised model in blob, background and the whole picture, per cent."""


def run(program: str, *words: object) -> dict[str, Any]:
    """What a program of the tests prints, in a process of its own."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([str(HERE.parent), str(HERE)])}
    command = [sys.executable, str(HERE / program), *map(str, words)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return dict(json.loads(done.stdout.strip().splitlines()[-1]))


def test_the_polarised_variant_has_a_process_of_its_own(variant: str) -> None:
    """What asks for the plain variant refuses to run in it, in one line, and the other way round."""
    with pytest.raises(backend.BackendError, match="already runs Mitsuba's llvm_ad_mono;"):
        backend.use_polarised("cpu")
    words = (
        "from scenes import backend; print(backend.use_polarised('cpu')); print(backend.use_polarised())\n"
    )
    words += "try: backend.use('cpu')\nexcept backend.BackendError as error: print(error)"
    done = subprocess.run(
        [sys.executable, "-c", words], cwd=HERE.parent, capture_output=True, text=True, check=True
    )
    first, second, refusal = done.stdout.strip().splitlines()
    assert first == second == "llvm_ad_mono_polarized"
    assert "already runs Mitsuba's llvm_ad_mono_polarized" in refusal


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("kind", "light"), [("polarised", "polarised"), ("plain", "unpolarised")])
def test_dielectrics_agree_with_stock_mitsuba(kind: str, light: str) -> None:
    """A guide before a bare face that polarises by 7 %: our walk against Mitsuba's own materials along rays
    from the LEDs, and its `path` from a meter behind the face; in the plain variant the unpolarised light.
    """
    found = run("stock_polarised.py", kind, 32_000_000, 4_000_000)
    print(
        f"{kind}: " + "; ".join(f"{name} {mean:.5f} ± {error:.5f} W" for name, (mean, error) in found.items())
    )
    value, error = found[light]
    for name in ("materials", "path"):
        other, noise = found[name]
        assert noise < 0.01 * other
        assert abs(value - other) < 3.5 * np.hypot(error, noise), name
    other = found["unpolarised" if light == "polarised" else "polarised"][0]
    assert abs(value - other) > 0.05 * value


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("case", MEASURED)
def test_the_error_of_the_unpolarised_model(case: str) -> None:
    """What the mean of s and p makes of a picture beyond what polarised light makes of it: as measured, and
    within 1 % in each part; faces before the camera within 0.01 %. The paper's sensor, a standard press."""
    found = run("polarised_process.py", case, 6, 2**18)
    assert found["variant"] == "llvm_ad_mono_polarized"
    assert found["sinks"] == pytest.approx([1.0, 1.0], abs=1e-3), "emitted light ends"
    for name, (off, error) in found["off"].items():
        print(f"{case}, {name}: {off:+.3f} ± {error:.3f} %")
    for name, expected in zip(("blob", "background", "picture"), MEASURED[case], strict=True):
        off, error = found["off"][name]
        assert error < 0.06
        assert abs(off - expected) < 0.02 + 4.0 * error, name
        assert abs(off) < 1.0
    assert all(abs(off) < 0.01 for name, (off, _) in found["off"].items() if name.startswith("faces"))
