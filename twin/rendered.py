"""Expected coarse pictures by the light transport itself: what the chain's light map stands in for.

A light map that was learned from a few hundred presses is as far off as the noise of one exposure. Seconds of
rendering at one specimen tell by how much it is off there, and nearby it is off by nearly the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

import fem
from scenes.traced import TracedLight
from twin import presses, retake
from twin.chain import BLOCK, Chain, seen_by, whole_blocks
from twin.study import PARAMETERS

Single = NDArray[np.float32]


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
    renderer = SpectralRenderer(design.sensor(), count=design.light.bands, at=design.sensor, device="cpu")
    flux = np.array([led.flux_W for led in design.leds])
    weights = chain.fluxes(values) / flux / chain.gain(values)
    found = []
    for press in presses.emulated(design, inclusion, depths, chain.emulator):
        pair = []
        for field in ("pressure", "pressure_0"):
            layers = renderer.render(
                press.surface, field=field, quality="preview", traced=tuple(traced)
            ).radiance
            pixels = retake.charge(design, layers, weights, (1, 1))
            pair.append(retake.average(whole_blocks(pixels), BLOCK))
        found.append(pair)
    return np.asarray(found, np.float32)
