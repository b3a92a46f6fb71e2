"""Estimates from pictures of reference light, which follows every ray: the paper's phantoms by full solves.

TWIN_MODEL=tsis TWIN_KEPT=out/followed pytest -m slow -s tests/bench/test_reference_light.py

Its paths are noise that no camera has, so what they make of a block of pixels is told by independent passes
and put into the fit: posteriors are as wide as that asks for. All pictures of a pass follow the same random
choices, which takes most of it out of what inclusions change, and press and sensor are alike in their four
quarters, so that pictures are folded. A pass of two phantoms takes a minute of a core; passes are kept in
TWIN_KEPT for this design, its light and mechanics, and TWIN_PASSES asks for more.
"""

import hashlib
import os
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista as pv
from numpy.typing import NDArray
from scipy import linalg
from scipy.ndimage import uniform_filter

import fem
from estimation.features import Features
from estimation.posterior import REFERENCE_FRAMES
from fem import solving
from scenes.traced import LIGHT
from twin import presses, rendered, retake
from twin.chain import BLOCK, Chain, whole_blocks
from twin.design import Design
from twin.discrepancy import shrunk
from twin.estimator import Estimator, black
from twin.estimator_file import load_estimator
from twin.refining import refine

pytestmark = [
    pytest.mark.slow,
    pytest.mark.timeout(6 * 3600),
    pytest.mark.skipif(  # one alone is an error
        not {"TWIN_MODEL", "TWIN_KEPT"} & set(os.environ), reason="needs TWIN_MODEL and TWIN_KEPT"
    ),
]
Floats = NDArray[np.float64]
PHANTOMS = ((10.0, 5.0, 100.0), (7.0, 4.0, 100.0))
PASSES, PATHS = int(os.environ.get("TWIN_PASSES", "30")), 2**18
NEAR = 5  # blocks a side that a block's noise is told from


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return load_estimator(os.environ["TWIN_MODEL"])


@pytest.fixture(scope="module")
def passes(estimator: Estimator) -> Floats:
    """Charges of blocks (passes, phantoms, levels, 2, r, c), electrons, each of its own random choices."""
    design = estimator.chain.design
    made = repr((design, PHANTOMS, PATHS, LIGHT, solving._FORMAT))
    kept = Path(os.environ["TWIN_KEPT"]) / hashlib.sha256(made.encode()).hexdigest()[:16]
    four = {(side, design.leds[0].flux_W) for side in ("+x", "-x", "+y", "-y")}
    assert {(led.side, led.flux_W) for led in design.leds} == four, "for pictures of four quarters alike"
    kept.mkdir(parents=True, exist_ok=True)
    surfaces = [one for phantom in PHANTOMS for one in solved(design, phantom, kept)]
    places = [kept / f"pass-{seed}.npy" for seed in range(1, PASSES + 1)]
    new, begin = [number for number, place in enumerate(places) if not place.is_file()], time.time()
    for done, number in enumerate(new, start=1):
        part = places[number].with_suffix(f".{os.getpid()}.part")
        with part.open("wb") as file:
            np.save(file, followed(design, surfaces, number + 1))
        os.replace(part, places[number])
        left = (time.time() - begin) * (len(new) - done) / done
        print(f"pass {done} of {len(new)}, {left / 60:.0f} minutes left", flush=True)
    found = np.array([np.load(place, allow_pickle=False) for place in places], float)
    return found.reshape(PASSES, len(PHANTOMS), -1, 2, *found.shape[-2:])


def solved(design: Design, phantom: tuple[float, float, float], kept: Path) -> list[pv.PolyData]:
    """Pressed surfaces of a phantom, one for each level, by finite elements."""
    depths = design.press.indentation_mm
    places = [kept / f"{'-'.join(f'{value:g}' for value in phantom)}-{depth:g}.vtp" for depth in depths]
    if not all(place.is_file() for place in places):
        found = presses.solved(design, fem.Inclusion(*phantom), depths, estimate=False, pictured=True)
        for place, one in zip(places, found, strict=True):
            one.surface.save(place)
    return [pv.read(place) for place in places]


def followed(design: Design, surfaces: list[pv.PolyData], seed: int) -> NDArray[np.float32]:
    """Charges of blocks of picture and reference of each surface, (n, 2, r, c)."""
    renderer, found, plain = rendered.renderer_of(design), [], dict[bytes, NDArray[np.float32]]()
    for surface in surfaces:
        same = np.asarray(surface["pressure_0"]).tobytes()  # phantoms that share their plain tissue
        for suffix in ("", "_0"):
            if suffix and same in plain:
                found.append(plain[same])
                continue
            shape = rendered.felt(design, design, surface, suffix)
            layers = renderer.render(shape, quality="reference", samples=PATHS, seed=seed).radiance
            whole = layers.sum(axis=0, dtype=np.float64)
            whole = 0.25 * sum(whole[::up, ::along] for up in (1, -1) for along in (1, -1))
            pixels = retake.charge(design, whole[None].astype(np.float32), None, (1, 1))
            found.append(retake.average(whole_blocks(pixels, BLOCK), BLOCK))
        plain[same] = found[-1]
    return np.array(found).reshape(len(surfaces), 2, *found[0].shape)


def noise_of(features: Features, passes: Floats) -> Floats:
    """Covariance (k, k) that paths give features of one pass.

    ``passes`` (n, levels, 2, r, c) are counts that are alike in their four quarters. What paths do to a block
    is told from those around it, as if they did nothing to others. Passes tell features apart, too, but are
    too few for all of them: their moments are shrunk towards that, or towards louder noise like it.
    """
    n, levels, _, rows, columns = passes.shape
    onto = features.onto.reshape(2 * levels, rows, columns, -1).astype(float)
    onto = sum(onto[:, ::up, ::along] for up in (1, -1) for along in (1, -1))
    onto[:, rows // 2] *= 0.5 if rows % 2 else 1.0  # a middle line is its own mirror image
    onto[:, :, columns // 2] *= 0.5 if columns % 2 else 1.0
    quarter = slice((rows + 1) // 2), slice((columns + 1) // 2)
    left = apart(passes).reshape(n - 1, 2 * levels, rows, columns)
    onto, left = onto[:, *quarter], left[:, :, *quarter]
    each = np.einsum("nirc,njrc->ijrc", left, left) / (n - 1)
    each = uniform_filter(each, (0, 0, NEAR, NEAR), mode="nearest")
    alone = np.einsum("irck,ijrc,jrcl->kl", onto, each, onto, optimize=True)
    told = np.einsum("nirc,irck->nk", left, onto, optimize=True)
    return shrunk(told, [louder * alone for louder in (1.0, 1.5, 2.0, 3.0)])


def apart(passes: Floats) -> Floats:
    """Contrasts (n - 1, ...) of n passes: independent, of the noise of one and without their mean."""
    return np.tensordot(linalg.helmert(len(passes)), passes, 1)


def unlike(features: Features, passes: Floats) -> float:
    """Chi-square per feature of every other pass by the noise that the others tell: 1 where that is right."""
    noise, asked = noise_of(features, passes[::2]), passes[1::2].astype(np.float32)
    told = apart(features(asked).astype(float))
    return float(np.mean(told * np.linalg.solve(noise, told.T).T))


@pytest.mark.parametrize("number", range(len(PHANTOMS)))
def test_phantoms_in_reference_light_are_told(estimator: Estimator, passes: Floats, number: int) -> None:
    """Size and depth within what noise of paths explains, by the model that is calibrated for full solves."""
    chain, sight, prior = estimator.chain, estimator.sight, estimator.prior
    design, truth = chain.design, np.array(PHANTOMS[number])
    charges = passes[:, number]
    counts = charges / design.camera.gain_e_per_dn
    noise, share = noise_of(sight.features, counts), unlike(sight.features, counts)
    print(f"\n{truth}: {len(charges)} passes, chi-square of one by the others' noise {share:.2f} a feature")
    assert 0.8 < share < 1.25, "noise of paths is not as told"

    seen = exposed(chain, charges.mean(axis=0), np.random.default_rng(number))
    always = sight.off(seen) + noise / len(charges)

    def pictures(values: Any, quick: bool = False) -> NDArray[np.float32]:
        return rendered.rendered(chain, estimator.traced, values, quick=quick, rounded=True)

    start = np.concatenate([prior.ranges.mean(axis=1), np.zeros(prior.basis.shape[1])])
    parts = (chain, sight.features, prior, sight.error, sight.told(seen), 1.0, start, pictures)
    refined = refine(*parts, quick=lambda values: pictures(values, quick=True), always=always)
    mean, sd = refined.samples.mean(axis=0)[:3], refined.samples.std(axis=0)[:3]
    low, high = np.percentile(refined.samples, [5.0, 95.0], axis=0)[:, :3]
    misfit = refined.fitted.chi_square / len(sight.features.spread)
    spread = (prior.ranges[:3, 1] - prior.ranges[:3, 0]) / np.sqrt(12.0)
    print(f"  told d, h, E {mean.round(3)}, off by {(mean - truth).round(3)}, sd {sd.round(3)}")
    print(f"  90 % intervals {low.round(2)} to {high.round(2)}; the ranges' sd {spread.round(2)}")
    print(f"  misfit {misfit:.2f}, {refined.renders} rendered")
    assert refined.explains and misfit < 1.5
    assert np.all(np.abs(mean - truth)[:2] < 3.0 * sd[:2])
    assert np.all(sd[:2] < 0.25 * spread[:2]), "paths too noisy to tell anything: TWIN_PASSES=200"


def exposed(chain: Chain, charges: Floats, rng: np.random.Generator) -> NDArray[np.float32]:
    """One exposure of each picture, means of references, of charges (levels, 2, r, c): counts above black."""
    found = np.empty_like(charges)
    for level, pair in enumerate(charges.astype(np.float32)):
        for place, frames in enumerate((1, REFERENCE_FRAMES)):
            found[level, place] = retake.counts(chain.design, pair[place], BLOCK, frames, rng)
    return np.asarray(found - black(chain) - chain.pattern_dn, np.float32)
