"""How far each quality is from the refined mesh, and what it costs: `make bench` prints it."""

import time

import pytest
from test_fem_convergence import REFINED

import fem
from fem.mesh import QUALITIES

LAYERS = (fem.Layer(2, 27), fem.Layer(3, 61), fem.Layer(5, 156))
PROBE, SLAB = fem.Probe(25, LAYERS), fem.Slab(30, 60, 5)
BALLS = [(10, 5, 100), (4, 6, 60), (13, 4, 120), (8, 5, 60)]
"""Size and depth (mm), modulus (kPa)."""

LARGEST = {"preview": 0.025, "standard": 0.0075, "reference": 0.0025}
"""Largest relative error of tared maximum and total that a quality may have."""


def press(ball: tuple[float, float, float], quality: str) -> tuple[float, float, int, float]:
    """Tared maximum (mm) and total (mm³) for 1 mm in small strain, unknowns, seconds."""
    begun = time.perf_counter()
    answer = fem.press(
        PROBE, SLAB, fem.Inclusion(*ball), 1.0, mechanics="linear", quality=quality, estimate=False
    )
    seconds = time.perf_counter() - begun
    tared = fem.scalars(answer.surface, 2.0)["tared"]
    return tared["max_mm"], tared["total_mm3"], answer.dof, seconds


@pytest.mark.slow
def test_quality_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(QUALITIES, "refined", REFINED)
    exact = [press(ball, "refined") for ball in BALLS]
    print(f"\nagainst {exact[0][2]} unknowns ({exact[0][3]:.0f} s), over {BALLS}:")
    for quality, allowed in LARGEST.items():
        press(BALLS[0], quality)  # topology and elimination order are found once
        found = [press(ball, quality) for ball in BALLS]
        errors = [[a[k] / b[k] - 1 for k in (0, 1)] for a, b in zip(found, exact, strict=True)]
        worst = [100 * max((e[k] for e in errors), key=abs) for k in (0, 1)]
        print(
            f"{quality:10} {found[0][2]:7} unknowns {min(f[3] for f in found):5.1f} s   "
            f"maximum {worst[0]:+.2f} %   total {worst[1]:+.2f} %   "
            + " ".join(f"({100 * m:+.2f}, {100 * t:+.2f})" for m, t in errors)
        )
        assert max(map(abs, worst)) < 100 * allowed
