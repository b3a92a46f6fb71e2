"""What the twin reports, tared maximum and total, converges under refinement, and nothing locks."""

from __future__ import annotations

import pytest

import fem
from fem.mesh import QUALITIES
from fem.topology import Resolution

REFINED = Resolution(arc=5, core=2, shell=6, above=4, below=3, edge=5, side=5, layer=4, backing=2)


def signal(
    size: float, depth: float, modulus: float, quality: str, poisson: float = 0.49
) -> tuple[float, float]:
    """Tared maximum (mm) and total (mm³) for 1 mm, Poisson's ratio the same in all materials."""
    layers = (fem.Layer(2, 27, poisson), fem.Layer(3, 61, poisson), fem.Layer(5, 156, poisson))
    ball = fem.Inclusion(size, depth, modulus, poisson=poisson)
    probe, slab = fem.Probe(25, layers), fem.Slab(30, 60, 5, poisson)
    answer = fem.press(probe, slab, ball, 1.0, mechanics="linear", quality=quality, estimate=False)
    assert answer.chest_force_N == pytest.approx(answer.force_N, rel=1e-8)
    tared = fem.scalars(answer.surface, 2.0)["tared"]
    return tared["max_mm"], tared["total_mm3"]


@pytest.fixture
def refined(monkeypatch: pytest.MonkeyPatch) -> str:
    """Every cell count raised: a quality of its own, 145 thousand unknowns."""
    monkeypatch.setitem(QUALITIES, "refined", REFINED)
    return "refined"


@pytest.mark.parametrize(("size", "depth", "modulus"), [(10, 5, 100), (4, 6, 60)])
def test_preview_agrees_with_standard(size: float, depth: float, modulus: float) -> None:
    assert signal(size, depth, modulus, "preview") == pytest.approx(
        signal(size, depth, modulus, "standard"), rel=0.025
    )


@pytest.mark.parametrize("poisson", [0.45, 0.4999])
def test_preview_does_not_lock(poisson: float) -> None:
    expected = signal(10, 5, 100, "standard", poisson)
    assert signal(10, 5, 100, "preview", poisson) == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("size", "depth", "modulus"), [(10, 5, 100), (4, 6, 60)])
def test_standard_has_converged(size: float, depth: float, modulus: float, refined: str) -> None:
    """Within 2 %, the issue's bar; measured about 0.5 %."""
    expected = signal(size, depth, modulus, refined)
    found = signal(size, depth, modulus, "standard")
    print([f"{100 * (a / b - 1):+.2f} %" for a, b in zip(found, expected, strict=True)])
    assert found == pytest.approx(expected, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("poisson", [0.45, 0.49, 0.499, 0.4999])
def test_standard_does_not_lock(poisson: float, refined: str) -> None:
    """At every Poisson's ratio within 2 % of its own refined answer."""
    for ball in ((10, 5, 100), (4, 6, 60)):
        expected = signal(*ball, refined, poisson)
        found = signal(*ball, "standard", poisson)
        print(
            ball,
            poisson,
            found,
            [f"{100 * (a / b - 1):+.2f} %" for a, b in zip(found, expected, strict=True)],
        )
        assert found == pytest.approx(expected, rel=0.02)
