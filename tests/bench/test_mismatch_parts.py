"""What pictures by full solves are off by from a model's own, part by part, told by the model's own fit.

TWIN_MODEL=tsis TWIN_CORPUS=corpora/phantoms TWIN_SAMPLES=6,7 \\
    pytest -m slow -s tests/bench/test_mismatch_parts.py
"""

import os
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import fem
import twin
from fem.ground import carry, lines
from twin import fitting, presses, rendered, retake
from twin.chain import BLOCK, seen_by, whole_blocks
from twin.estimator import Estimator
from twin.estimator_file import load_estimator
from twin.study import PARAMETERS

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(  # one alone is an error
        not {"TWIN_MODEL", "TWIN_CORPUS"} & set(os.environ), reason="needs TWIN_MODEL and TWIN_CORPUS"
    ),
]
Floats = NDArray[np.float64]
SAMPLES = [int(number) for number in os.environ.get("TWIN_SAMPLES", "6").split(",")]
PATHS, DRAWS = 2**22, int(os.environ.get("TWIN_DRAWS", "4"))
FIELDS = ("pressure", "displacement")


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return load_estimator(os.environ["TWIN_MODEL"])


@pytest.mark.timeout(3600)
@pytest.mark.parametrize("sample", SAMPLES)
def test_parts_of_the_mismatch_are_within_what_calibration_says(
    estimator: Estimator, sample: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    table, chain = twin.Corpus(os.environ["TWIN_CORPUS"]).table, estimator.chain
    row = int(np.flatnonzero(np.asarray(table["sample"]) == sample)[0])
    values = {name: float(table[name][row]) for name in (*PARAMETERS, *estimator.prior.names)}
    design, depths = seen_by(chain.design, values)
    size, depth, modulus, x, y = (values[name] for name in PARAMETERS)
    ball = fem.Inclusion(size, depth, modulus, (x, y))
    own = [one.surface for one in presses.emulated(design, ball, depths, chain.emulator)]
    full = presses.solved(design, ball, depths, estimate=False, pictured=True)
    solved = [one.surface for one in full]

    def learned(surfaces: list[Any]) -> Floats:
        found = [SimpleNamespace(surface=one) for one in surfaces]
        monkeypatch.setattr(presses, "emulated", lambda *_: found)
        return rendered.rendered(chain, estimator.traced, values).astype(float)

    ours = learned(own)
    contact = learned(solved)
    parts = {"contact, all of it": contact - ours}
    for name, fields, plain in (
        ("plain tissue", (), True),
        ("what the inclusion adds to the pressure", FIELDS[:1], False),
        ("to the displacement", FIELDS[1:], False),
    ):
        mixed = [put(*pair, fields, plain) for pair in zip(own, solved, strict=True)]
        parts[name] = learned(mixed) - ours
    draws = np.stack([followed(estimator, design, values, solved, seed) for seed in range(1, DRAWS + 1)])
    parts["light, mean of draws"] = draws.mean(axis=0) - contact

    told = teller(estimator, ours, values)
    print(f"\n{ball}: d, h / mm, E / kPa, and over the calibrated model's own standard deviation")
    for name, part in parts.items():
        shift, sd = told(part)
        print(f"  {name}: {np.round(shift, 3)}, {np.round(shift / sd, 2)}")
        assert np.abs(shift / sd).max() < 1.5, name
    spread = np.std([told(one - contact)[0] for one in draws], axis=0, ddof=1)
    print(f"  paths of one draw, standard deviation of {DRAWS}: {np.round(spread, 3)}")


def put(own: Any, solved: Any, fields: tuple[str, ...], plain: bool) -> Any:
    """The emulator's surface with plain tissue, or some fields of what the inclusion adds, of a solve."""
    found = own.copy(deep=True)
    to = lines(own)

    def there(name: str) -> Floats:
        values = np.asarray(solved[name]).reshape(solved.n_points, -1)
        return np.asarray(carry(values, lines(solved), to)).reshape(np.asarray(own[name]).shape)

    base = {name: there(f"{name}_0") if plain else np.asarray(own[f"{name}_0"]) for name in FIELDS}
    source = {
        name: (there(name), there(f"{name}_0")) if name in fields else (own[name], own[f"{name}_0"])
        for name in FIELDS
    }
    found["pressure_0"], found["displacement_0"] = base["pressure"], base["displacement"]
    found["pressure"] = base["pressure"] * source["pressure"][0] / source["pressure"][1]
    found["displacement"] = base["displacement"] + source["displacement"][0] - source["displacement"][1]
    return found


def followed(estimator: Estimator, design: Any, values: dict[str, float], surfaces: Any, seed: int) -> Floats:
    """Coarse counts (levels, 2, r, c) in standard light of paths of their own."""
    chain = estimator.chain
    renderer = rendered.renderer_of(chain.design)
    weights = chain.fluxes(values) / np.array([led.flux_W for led in design.leds]) / chain.gain(values)
    found = []
    for surface in surfaces:
        for suffix in ("", "_0"):
            shape = rendered.felt(chain.design, design, surface, suffix)
            layers = renderer.render(shape, quality="standard", samples=PATHS, seed=seed).radiance
            pixels = retake.charge(chain.design, layers, weights, (1, 1))
            found.append(retake.average(whole_blocks(pixels, BLOCK), BLOCK))
    return np.asarray(found, float).reshape(len(surfaces), 2, *found[0].shape)


def teller(
    estimator: Estimator, seen: Floats, values: dict[str, float]
) -> Callable[[Floats], tuple[Floats, Floats]]:
    """What the model's fit makes of a change of pictures, to first order, and its sd: d, h, E."""
    sight, prior, chain = estimator.sight, estimator.prior, estimator.chain
    single = seen.astype(np.float32)
    slopes = fitting.jacobian(chain, sight.features, prior, prior.unknowns(values))[1]
    noise = fitting.covariance(
        chain, sight.features, single, chain.gain(values), 1, prior.pattern, rounded=True
    )
    weighted = np.linalg.solve(noise + sight.off(single), slopes.T)
    covariance = np.linalg.inv(slopes @ weighted + prior.precision)

    def told(change: Floats) -> tuple[Floats, Floats]:
        features = sight.told((seen + change).astype(np.float32)) - sight.told(single)
        shift = covariance @ (weighted.T @ features)
        return np.asarray(shift[:3]), np.asarray(np.sqrt(np.diag(covariance))[:3])

    return told
