"""What one layout of a sensor can tell: expected pictures, their derivatives, bounds and other objectives.

Pictures are computed on coarse pixels, each of which stands for `Evaluation.block` pixels of the camera that
see the same: counts are those of one true pixel, and information is multiplied by their number.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.information import Information, bound, inform
from twin import coarse as pixels
from twin import objectives, touches
from twin.bench import Bench, Work, optical_key
from twin.complaint import DesignError, shown
from twin.conflicts import black, colourless, straight
from twin.design import Design, parse_design
from twin.exposure import REFERENCE_FRAMES
from twin.fields import number_at, put, tables_of
from twin.forward import Unknown
from twin.layers import Lit
from twin.unknowns import LED_FLUX, UNKNOWNS, check_unknown, expand

if TYPE_CHECKING:
    from fem import Emulator

__all__ = [
    "LED_FLUX",
    "UNKNOWNS",
    "Bench",
    "Evaluation",
    "Judged",
    "Layout",
    "Protocol",
    "check",
    "check_unknown",
    "evaluate",
    "expand",
    "optical_key",
]

Singles = NDArray[np.float32]


MOST_BYTES = 400_000_000
"""Largest `Judged.layer_jacobian`: larger ones are left out."""


@dataclass(frozen=True)
class Protocol:
    """How the sensor is used.

    Attributes
    ----------
    indentation_mm : press levels.
    positions_mm : centres of the sensor at which it is pressed, over the specimen, minus the first guess of
        the inclusion's place; every level is taken at every position.
    frames : exposures that are averaged into each picture.
    """

    indentation_mm: tuple[float, ...]
    positions_mm: tuple[tuple[float, float], ...] = ((0.0, 0.0),)
    frames: int = 1


@dataclass(frozen=True)
class Layout:
    """One sensor with its protocol; ``values`` are the study's fields and what this trial took."""

    design: Design
    protocol: Protocol
    values: dict[str, float | int | str]


@dataclass(frozen=True)
class Judged:
    """What the pictures of one inclusion tell.

    Pictures are ordered by position, then level: for each the picture, then its reference.

    Attributes
    ----------
    mean : (pictures, rows, columns[, 3]) counts of one true pixel, without rounding.
    layers : (pictures, n_led, rows, columns[, 3]) counts from each LED alone, without offset and full well.
    names : of the p unknowns.
    jacobian : (p, pictures, rows, columns[, 3]) counts per unit of each unknown, per e-fold where relative.
    layer_jacobian : (p, pictures, n_led, rows, columns[, 3]) the same of each layer; of a LED's flux its own
        layer, of what the camera does after the light zero.
    information : of all pictures together, with the protocol's frames.
    sd : prior-included bound of each unknown.
    """

    inclusion: fem.Inclusion
    mean: Singles
    layers: Singles
    names: tuple[str, ...]
    jacobian: Singles
    layer_jacobian: Singles | None
    information: Information
    sd: dict[str, float]


@dataclass(frozen=True)
class Evaluation:
    """All that was found about a layout; `objectives` by the names of `twin.objectives.OBJECTIVES`.

    ``block`` is the number of true pixels that a coarse one stands for; ``camera`` is the design on the
    coarse pixels: its counts, noise and full well are those of one true pixel.
    """

    layout: Layout
    unknowns: tuple[Unknown, ...]
    judged: tuple[Judged, ...]
    objectives: dict[str, float]
    seconds: dict[str, float]
    block: float
    camera: Design


def evaluate(
    layout: Layout,
    inclusions: Sequence[fem.Inclusion],
    unknowns: Sequence[Unknown] = UNKNOWNS,
    *,
    emulator: Emulator | None = None,
    quality: str = "preview",
    seed: int = 0,
    detection: bool = True,
    fill: float | None = None,
    bench: Bench | None = None,
    progress: Callable[[float], None] | None = None,
) -> Evaluation:
    """Return what a layout can tell about each of the inclusions.

    Parameters
    ----------
    inclusions : offsets are from the first of the protocol's places.
    unknowns : what nobody knows exactly, with what is known before; see `check_unknown`.
    emulator : of the design's mechanics; without, presses are solved on a coarse mesh at small strain.
    quality : of the light, "preview" or "standard".
    fill : set the exposure so that the brightest thousandth of all these pictures begins at this share of the
        camera's range, instead of the design's exposure; `Evaluation.layout` has it.
    detection : also find the depth at which a standard lump is found (a few pictures more).
    bench : keeps what layouts share; without, nothing is kept.

    Raises
    ------
    DesignError, fem.NotModelled, scenes.sensor.NotModelled
        For layouts that cannot be, in one line.
    """
    bench = bench or Bench()
    tell = progress or (lambda done: None)
    design, protocol = layout.design, layout.protocol
    small, block = pixels.coarse(design, bench.cell_mm)
    every = expand(design, unknowns)
    check(layout, inclusions)
    presses = [(place, level) for place in protocol.positions_mm for level in protocol.indentation_mm]
    seconds = {"mechanics": 0.0, "light": 0.0, "information": 0.0}
    work = Work(small, every, emulator, quality, seed, bench, seconds, inclusions[0])
    light: list[list[Lit]] = []
    for number, inclusion in enumerate(inclusions):
        light.append([])
        for done, (place, level) in enumerate(presses):
            light[-1].append(work.lit(inclusion, level, place))
            tell((number + (done + 1) / len(presses)) / len(inclusions))
    began = time.perf_counter()
    if fill is not None:
        design = _exposed(design, small, fill, [one.layers for lit in light for one in lit])
        layout, small = replace(layout, design=design), pixels.coarse(design, bench.cell_mm)[0]
        work.design = small
    judged = [
        judge(small, block, protocol, inclusion, every, lit)
        for inclusion, lit in zip(inclusions, light, strict=True)
    ]
    seconds["information"] += time.perf_counter() - began
    found = objectives.optical(small, protocol, judged, block)
    if detection:
        found["detection_depth_mm"] = _detection(work, protocol, judged[0], block, inclusions[0])
    return Evaluation(layout, every, tuple(judged), found, seconds, block, small)


_BRIGHT = 99.9  # per cent of pixels that are to be below


def _exposed(design: Design, small: Design, fill: float, radiance: Sequence[NDArray[Any]]) -> Design:
    """The design with the exposure at which its brightest pixels fill that share of the range."""
    camera = small.camera
    top = min(camera.full_well_e, (2**camera.bits - 1 - camera.offset_dn) * camera.gain_e_per_dn)
    planes = 2 if camera.colour == "mono" else 3
    layers = [
        pixels.counted(small, one).layers.sum(axis=-planes - 1) + pixels.stray(small) for one in radiance
    ]
    bright = max(float(np.percentile(one, _BRIGHT)) for one in layers) * camera.gain_e_per_dn
    if bright <= 0.0:
        raise DesignError("leds", "no light that reaches the camera", "LEDs that shine")
    exposure = float(np.clip(design.camera.exposure_ms * fill * top / bright, 1e-3, 1e5))
    return replace(design, camera=replace(design.camera, exposure_ms=float(f"{exposure:.4g}")))


def check(layout: Layout, inclusions: Sequence[fem.Inclusion]) -> None:
    """Raise `DesignError` where a press of the protocol cannot be."""
    if not inclusions:
        raise DesignError("inclusions", "none", "at least one")
    colourless(layout.design, "a layout study")
    black(layout.design, "a layout study")
    straight(layout.design, "a layout study")
    for level in layout.protocol.indentation_mm:
        layout.design.check_indentation(level, "protocol.indentation_mm")
    for inclusion in inclusions:
        for x, y in layout.protocol.positions_mm:
            offset = (inclusion.offset[0] - x, inclusion.offset[1] - y)
            layout.design.check_inclusion(replace(inclusion, offset=offset))


def judge(
    design: Design,
    block: float,
    protocol: Protocol,
    inclusion: fem.Inclusion,
    unknowns: tuple[Unknown, ...],
    lit: Sequence[Lit],
) -> Judged:
    """What the pictures of one inclusion tell, from their light."""
    radiance = np.concatenate([one.layers for one in lit])
    counted = pixels.counted(design, radiance)
    slopes = np.concatenate([one.slopes for one in lit], axis=1)
    moving = lit[0].names
    planes = 2 if design.camera.colour == "mono" else 3
    of_leds = -planes - 1
    keep = len(unknowns) * counted.layers.size * 4 <= MOST_BYTES
    by_layer = np.zeros((len(unknowns), *counted.layers.shape), np.float32) if keep else None
    jacobian = np.empty((len(unknowns), *counted.mean.shape), np.float32)
    for number, unknown in enumerate(unknowns):
        if unknown.name in moving:
            layers = pixels.counted_slopes(design, slopes[moving.index(unknown.name)])
            rest: Any = 0.0
        elif unknown.name.startswith("leds."):
            led = int(unknown.name.split(".")[1])
            flux = design.leds[led].flux_W
            layers, rest = np.zeros_like(counted.layers), 0.0
            at = (slice(None), led)
            layers[at] = counted.layers[at] / (1.0 if unknown.relative else flux)
        else:
            layers, rest = _camera_slope(design, radiance, unknown)
        jacobian[number] = np.where(counted.open, layers.sum(axis=of_leds), 0.0) + rest
        if by_layer is not None:
            by_layer[number] = layers
    noises = noises_of(design, block, protocol)
    pictures = [(jacobian[:, k], counted.mean[k], noises[k % 2]) for k in range(len(counted.mean))]
    names = tuple(unknown.name for unknown in unknowns)
    told = inform(names, pictures, np.array([unknown.sd for unknown in unknowns]))
    sd = dict(zip(names, map(float, bound(told).sd), strict=True))
    mean: Singles = counted.mean.astype(np.float32)
    seen: Singles = counted.layers.astype(np.float32)
    return Judged(inclusion, mean, seen, names, jacobian, by_layer, told, sd)


def noises_of(design: Design, block: float, protocol: Protocol) -> tuple[Any, Any]:
    """Noise of a picture and of its reference, which is the mean of at least 16 exposures."""
    return (
        pixels.noise(design, block, protocol.frames),
        pixels.noise(design, block, max(protocol.frames, REFERENCE_FRAMES)),
    )


def _camera_slope(design: Design, radiance: NDArray[Any], unknown: Unknown) -> tuple[Any, Any]:
    """Slopes of the LEDs' counts to a number of the camera, and of the rest: dark, ambient, offset, well."""
    tables = tables_of(design)
    value = number_at(tables, unknown.name, "unknowns")
    if value is None or (unknown.relative and value == 0.0):
        raise DesignError(
            "unknowns", f"{unknown.name} = {shown(value)}", "a number that the design holds, > 0"
        )
    step = 1e-3 if unknown.relative else 1e-3 * max(abs(value), 1e-3)
    ends, found = [], []
    for way in (-step, step):
        end = value * np.exp(way) if unknown.relative else value + way
        try:
            there = parse_design(put(tables, [(unknown.name, float(end))]))
        except DesignError:  # the value is as far as a design may go: a slope to one side
            way, there = 0.0, design
        ends.append(way)
        found.append(pixels.counted(there, radiance))
    (low, high), apart = found, ends[1] - ends[0]
    planes = 2 if design.camera.colour == "mono" else 3
    layers = (high.layers - low.layers) / apart
    whole = (high.mean - low.mean) / apart
    both = low.open & high.open
    return layers, whole - np.where(both, layers.sum(axis=-planes - 1), 0.0)


def _detection(work: Work, protocol: Protocol, judged: Judged, block: float, near: fem.Inclusion) -> float:
    """Depth at which the standard lump is found by all levels at the first place."""
    design, depths = work.design, work.depths()
    if len(depths) < 2:
        return 0.0
    plain, lumps = zip(*(work.standard(level, near) for level in protocol.indentation_mm), strict=True)
    began = time.perf_counter()
    lit, reference = (_patchy(noise, work.bench.cell_mm) for noise in noises_of(design, block, protocol))
    share = (objectives.STANDARD[0] / objectives.PRESSED[0]) ** 3
    kept = [k for k, unknown in enumerate(work.unknowns) if not touches.knows_inclusion(unknown.name)]
    prior = np.array([work.unknowns[k].sd for k in kept])
    means = [pixels.counted(design, one).mean for one in plain]
    # of plain tissue, as of the references beside the pictures of any inclusion
    slopes = [np.asarray(judged.jacobian[kept, 2 * k + 1], np.float64) for k in range(len(plain))]
    found = []
    for number in range(len(depths)):
        lump = [pixels.counted(design, one[number]).mean for one in lumps]
        lump = [base + share * (one - base) for base, one in zip(means, lump, strict=True)]
        pairs = [*means, *means], [*lump, *means], [lit] * len(means) + [reference] * len(means)
        found.append(objectives.deflection_of(*pairs, [*slopes, *slopes], prior))
    work.seconds["information"] += time.perf_counter() - began
    middles = [depth + objectives.PRESSED[0] / 2 for depth in depths]
    return objectives.reach(middles, found, objectives.STANDARD[0])


def _patchy(noise: Any, cell_mm: float) -> Any:
    """Patches as errors of single coarse pixels, which weigh as much together."""
    return replace(noise, fixed_share=objectives.PATCHY * objectives.PATCH_MM / cell_mm)
