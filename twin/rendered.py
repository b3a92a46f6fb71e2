"""Expected coarse pictures by the light transport itself: what the chain's light map stands in for.

A light map that was learned from a few hundred presses is as far off as the noise of one exposure. Seconds of
rendering at one specimen tell by how much it is off there, and nearby it is off by nearly the same.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import pyvista as pv
from numpy.typing import NDArray

import fem
from scenes.surface import OpticalSurface, resample
from scenes.traced import TracedLight
from twin import presses, retake
from twin.block_noise import rounding
from twin.chain import BLOCK, Chain, seen_by, whole_blocks
from twin.design import Design
from twin.study import PARAMETERS

if TYPE_CHECKING:
    from scenes import SpectralRenderer

Single = NDArray[np.float32]


_BINNED = 2
"""Pixels a side that quick pictures take as one."""


def rendered(
    chain: Chain,
    traced: Sequence[TracedLight],
    values: Mapping[str, float],
    *,
    threads: int | None = None,
    quick: bool = False,
    rounded: bool = False,
) -> Single:
    """Return expected counts above black, (levels, 2, r, c), of one specimen; values as of `chain.contacts`.

    With ``rounded``, with what rounding does to them, in exposures and means of many alike.

    With ``quick``, in a fifth of the time, pictures without references, (levels, 1, r, c), of binned pixels
    and on coarse maps of light. They are off by 0.15 %, but by the same for specimens that are alike: what
    they change by is right to 0.12 % (`tests/test_rendered.py`).

    Raises `fem.NotModelled` outside of the emulator or of the learned light.
    """
    from scenes import backend

    backend.use("cpu")
    import drjit as dr

    if threads is not None:
        dr.set_thread_count(threads)
    design, depths = seen_by(chain.design, values)
    size, depth, modulus, x, y = (float(values[name]) for name in PARAMETERS)
    inclusion = fem.Inclusion(size, depth, modulus, (x, y))
    presses.check_emulated(design, inclusion, depths, chain.emulator)
    seen_by_camera, binned = coarser(chain.design) if quick else (chain.design, 1)
    renderer = renderer_of(seen_by_camera)
    block = BLOCK[0] // binned, BLOCK[1] // binned
    flux = np.array([led.flux_W for led in design.leds])
    gain = chain.gain(values)
    weights = chain.fluxes(values) / flux / gain / binned**2
    found = []
    for press in presses.emulated(design, inclusion, depths, chain.emulator):
        pair = []
        for suffix in ("",) if quick else ("", "_0"):
            shape = felt(chain.design, design, press.surface, suffix)
            layers = renderer.render(shape, quality="preview", traced=tuple(traced), coarse=quick).radiance
            pixels = retake.charge(seen_by_camera, layers, weights, (1, 1))
            if rounded and not quick:
                pixels = pixels + retake.rounding(chain.design, pixels, gain)
            pair.append(retake.average(whole_blocks(pixels, block), block))
        found.append(pair)
    seen = np.asarray(found, np.float32)
    return seen + rounding(chain.design, seen, np.array(gain)) if rounded and quick else seen


def coarser(design: Design) -> tuple[Design, int]:
    """Return a design whose camera bins pixels, where that leaves blocks whole, and how many a side."""
    camera = design.camera
    if any(side % _BINNED for side in (*camera.shape, *BLOCK)):
        return design, 1
    return replace(design, camera=replace(camera, binning=_BINNED * camera.binning)), _BINNED


def felt(base: Design, design: Design, surface: pv.PolyData, suffix: str = "") -> OpticalSurface:
    """Return a contact surface under the skin and tissue of one design, as the scene of another is to have
    it: what they change in the contact's law is a share of the pressure. ``suffix`` is that of fields."""
    shape = resample(surface, base.waveguide.width_mm, suffix=suffix)
    return replace(shape, pressure_kPa=np.float64(_yields(base) / _yields(design)) * shape.pressure_kPa)


@lru_cache(maxsize=2)
def renderer_of(design: Design) -> SpectralRenderer:
    """Return the scene of a design, built once: skin and tissue that vary are told by `felt`."""
    from scenes import SpectralRenderer

    return SpectralRenderer(design.sensor(), count=design.light.bands, at=design.sensor, device="cpu")


def _yields(design: Design) -> float:
    """The pressure that the contact's law measures others by, kPa: E* h' / κ."""
    surface = design.surface
    return float(design.effective_modulus_kPa * surface.rms_slope / surface.kappa)
