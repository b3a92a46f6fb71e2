"""Expected coarse pictures by the light transport itself: what the chain's light map stands in for.

A light map that was learned from a few hundred presses is as far off as the noise of one exposure. Seconds of
rendering at one specimen tell by how much it is off there, and nearby it is off by nearly the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import fem
from scenes.traced import TracedLight
from twin import presses, retake
from twin.chain import BLOCK, Chain, seen_by
from twin.design import Design
from twin.study import PARAMETERS

Single = NDArray[np.float32]

_BINNED = (
    2  # pixels a side that are rendered as one: blocks' means change by 0.005 % (`tests/test_rendered.py`)
)


def rendered(
    chain: Chain, traced: Sequence[TracedLight], values: Mapping[str, float], *, threads: int | None = None
) -> Single:
    """Return expected counts above black, (levels, 2, r, c), of one specimen; values as of `chain.contacts`.

    Raises `fem.NotModelled` outside of the emulator or of the learned light.
    """
    from scenes import SpectralRenderer, backend

    backend.use("cpu")
    import drjit as dr

    if threads is not None:
        dr.set_thread_count(threads)
    design, depths = seen_by(chain.design, values)
    size, depth, modulus, x, y = (float(values[name]) for name in PARAMETERS)
    inclusion = fem.Inclusion(size, depth, modulus, (x, y))
    presses.check_emulated(design, inclusion, depths, chain.emulator)
    design, binned = coarser(design)
    renderer = SpectralRenderer(design.sensor(), count=design.light.bands, at=design.sensor, device="cpu")
    flux = np.array([led.flux_W for led in design.leds])
    weights = chain.fluxes(values) / flux / chain.gain(values) / binned**2
    block = BLOCK[0] // binned, BLOCK[1] // binned
    found = []
    for press in presses.emulated(design, inclusion, depths, chain.emulator):
        pair = []
        for field in ("pressure", "pressure_0"):
            layers = renderer.render(
                press.surface, field=field, quality="preview", traced=tuple(traced)
            ).radiance
            pixels = retake.charge(design, layers, weights, (1, 1))
            rows, columns = (side // cells * cells for side, cells in zip(pixels.shape, block, strict=True))
            pair.append(retake.average(pixels[:rows, :columns], block))
        found.append(pair)
    return np.asarray(found, np.float32)


def coarser(design: Design) -> tuple[Design, int]:
    """Return a design whose camera bins pixels, where that leaves blocks whole, and how many a side."""
    camera, binned = design.camera, _BINNED
    if any(side % binned for side in (*camera.shape, *BLOCK)):
        return design, 1
    return replace(design, camera=replace(camera, binning=binned * camera.binning)), binned
