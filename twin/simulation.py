"""Press to picture: mechanics, light, camera and scalars in one call."""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, SupportsIndex, TypedDict, Unpack, overload

import fem
from twin import presses
from twin.complaint import DesignError, shown
from twin.conflicts import colourless
from twin.design import Design, load_design
from twin.exposure import (
    how_pressed,
    light_seed,
    mechanics_facts,
    picture_facts,
    reference_frames,
    seen_pressure,
    take,
    take_reference,
)
from twin.frame import Frame
from twin.light_bias import bias_of
from twin.presses import Mechanics, Quality

if TYPE_CHECKING:
    from fem import Emulated, Emulator, Press
    from scenes import Rendering, SpectralRenderer
    from scenes.traced import TracedLight

LEAST_NOISE = 1e-3
"""Least noise of light that may be asked for, per cent: a million times the time of 1 %."""

Device = Literal["auto", "cpu", "cuda"]
Progress = Callable[[str, float], None]
"""Called with the name of the stage that runs now and the share of all work that is done, 0 to 1."""


@dataclass(frozen=True)
class _Work:
    """How much is done: mechanics of all levels, then light for each level."""

    progress: Progress
    levels: int
    # Seconds that the mechanics and one level's light take on two cores; only to estimate the time left.
    mechanics: float
    light: float = 8.0

    def tell(self, stage: str, mechanics: float, levels: float = 0.0) -> None:
        """Pass on which stage runs now, with the share of the mechanics and the number of levels done."""
        done = self.mechanics * mechanics + self.light * levels
        self.progress(stage, done / (self.mechanics + self.light * self.levels))


class _Light(TypedDict):
    """How to light a press; the same with and without the inclusion, so that their noise cancels."""

    quality: Quality
    noise: float | None
    traced: tuple[TracedLight, ...] | None
    seed: int


class Options(TypedDict, total=False):
    """What `simulate` takes beside the press, for whichever form of it."""

    mechanics: Mechanics | Literal["emulator", "multipoles"] | None
    emulator: Emulator | str | Path | None
    tilt: Sequence[float] | None
    position: Sequence[float] | None
    quality: Quality
    noise: float | None
    traced: str | Path | None
    seed: SupportsIndex
    device: Device
    progress: Progress | None


@overload
def simulate(
    design: Design | str | Path,
    inclusion: fem.Inclusion | None,
    indentation: Sequence[float],
    **options: Unpack[Options],
) -> list[Frame]: ...
@overload
def simulate(
    design: Design | str | Path,
    inclusion: fem.Inclusion | None,
    *,
    force: Sequence[float],
    **options: Unpack[Options],
) -> list[Frame]: ...
@overload
def simulate(
    design: Design | str | Path,
    inclusion: fem.Inclusion | None,
    indentation: float | None = None,
    *,
    force: float | None = None,
    **options: Unpack[Options],
) -> Frame: ...
def simulate(
    design: Design | str | Path,
    inclusion: fem.Inclusion | None,
    indentation: float | Sequence[float] | None = None,
    *,
    force: float | Sequence[float] | None = None,
    mechanics: Mechanics | Literal["emulator", "multipoles"] | None = None,
    emulator: Emulator | str | Path | None = None,
    tilt: Sequence[float] | None = None,
    position: Sequence[float] | None = None,
    quality: Quality = "standard",
    noise: float | None = None,
    traced: str | Path | None = None,
    seed: SupportsIndex = 0,
    device: Device = "auto",
    progress: Progress | None = None,
) -> Frame | list[Frame]:
    """Return the frame that the sensor delivers, or a list of them for a sequence of press levels.

    Parameters
    ----------
    design : a `Design`, the name of a shipped one, or the path of a TOML file.
    inclusion : what lies in the tissue; None for homogeneous tissue.
    indentation : depth that the glass moves towards the chest wall, mm; by default the first of the design.
    force : force on the glass instead, N, along the sensor's axis.
    mechanics : "finite" strain or "linear" elasticity, instead of the design's; or "multipoles": the latter
        of spheres in plain tissue that is solved once; or "emulator": what one learned from many solves.
    emulator : with mechanics "emulator", a `fem.Emulator` or its file, by default "emulators/NAME.npz" with
        the design's name; see `twin emulate`.
    tilt : turn of the sensor about x, then y, degrees, instead of the design's.
    position : centre of the sensor minus that of the specimen, mm, instead of the design's.
    quality : "preview", "standard" or "reference", for mechanics and light alike.
    noise : go on with the light until its noise is at most this, rms of a pixel in per cent of the mean.
    traced : file of `twin emulate --light`: light that walked far is taken from it and leaves no noise.
    seed : of the light's and the camera's random numbers. One level's frame does not depend on the others,
        but for the last digits of its mechanics, which are found on one way through all levels.
    device : "auto" (a CUDA GPU where there is one), "cpu" or "cuda".

    Raises
    ------
    DesignError, fem.NotModelled, fem.NotConverged, scenes.sensor.NotModelled, scenes.backend.BackendError
        In one line: what was received and what is allowed.
    """
    design = design if isinstance(design, Design) else load_design(design)
    solves = {"emulator": None, "multipoles": "linear"}.get(str(mechanics), mechanics)
    design = design.pressed(mechanics=solves, tilt_deg=tilt, position_mm=position)
    levels, by_force, several = presses.levels_of(design, indentation, force)
    check(design, inclusion, levels, by_force=by_force)
    seed = _seed(seed)
    if noise is not None and not LEAST_NOISE <= noise < float("inf"):
        raise DesignError("noise", shown(noise), f"a number >= {LEAST_NOISE:g}, per cent")
    coloured = design.specimen.inclusion is not None
    if coloured and quality != "reference":
        colourless(design, f"{quality} quality")
    if coloured and mechanics in ("emulator", "multipoles"):
        colourless(design, f"mechanics {mechanics}, which do not tell where the inclusion goes")
    light = None
    if traced is not None:
        if quality == "reference" or noise is not None:
            given = "it with reference quality" if noise is None else "it with noise"
            raise DesignError("traced", given, "it with preview or standard light, which then has no noise")
        from twin.learn_light import light_of

        light = light_of(traced)
    pressed: Sequence[Press | Emulated] | None = None
    if mechanics == "emulator":
        known = presses.emulator_of(design, emulator)
        pressed = presses.emulated(design, inclusion, levels, known, by_force=by_force)
    elif emulator is not None:
        raise DesignError("emulator", "it with other mechanics", 'it with mechanics "emulator" only')
    elif mechanics == "multipoles":
        pressed = presses.expanded(design, inclusion, levels, by_force=by_force, quality=quality)
    from scenes import SpectralRenderer

    renderer = SpectralRenderer(
        design.sensor(), count=design.light.bands, at=design.sensor, device=device, coloured=coloured
    )
    seconds = _seconds(design, len(levels)) if pressed is None else 0.0
    work = _Work(progress or (lambda stage, done: None), len(levels), seconds)
    if pressed is None:
        pressed = presses.solved(
            design,
            inclusion,
            levels,
            by_force=by_force,
            quality=quality,
            pictured=True,
            progress=lambda stage, share: work.tell("mechanics", share),
        )
    frames = []
    for number, (level, press) in enumerate(zip(levels, pressed, strict=True)):
        stage = "light" if len(levels) == 1 else f"light {number + 1} of {len(levels)}"

        def tell(share: float, stage: str = stage, number: int = number) -> None:
            work.tell(stage, 1.0, number + share)

        tell(0.0)
        options: _Light = {"quality": quality, "noise": noise, "traced": light, "seed": light_seed(seed)}
        frames.append(_frame(design, inclusion, press, renderer, options, seed, level, tell))
    return frames if several else frames[0]


def _seconds(design: Design, levels: int) -> float:
    """About what the mechanics take."""
    return 8.0 if design.mechanics == "linear" else 40.0 + 14.0 * levels


def check(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float] = (),
    *,
    by_force: bool = False,
) -> None:
    """Raise, before any work is done, if the press cannot be simulated: levels are mm, or N ``by_force``."""
    presses.check(design, inclusion, levels, by_force=by_force)


def _seed(seed: SupportsIndex) -> int:
    """Return any kind of integer, numpy's too, as Python's own."""
    try:
        if isinstance(seed, bool) or operator.index(seed) < 0:
            raise TypeError
    except TypeError:
        raise DesignError("seed", shown(seed), "an integer >= 0") from None
    return operator.index(seed)


def _frame(
    design: Design,
    inclusion: fem.Inclusion | None,
    press: Press | Emulated,
    renderer: SpectralRenderer,
    options: _Light,
    seed: int,
    level: float,
    tell: Callable[[float], None],
) -> Frame:
    start = time.perf_counter()

    # only a solved press knows where it carries the inclusion
    place = (
        press.inclusion() if design.specimen.inclusion is not None and isinstance(press, fem.Press) else None
    )

    def render(field: str, before: float) -> Rendering:
        return renderer.render(
            press.surface,
            field=field,
            place=place if field == "pressure" else None,
            **options,
            progress=lambda share: tell(before + 0.5 * share),
        )

    lit = render("pressure", 0.0)
    unlit = render("pressure_0", 0.5) if inclusion is not None else lit
    image = take(design, lit.radiance, seed, level)
    reference = take_reference(design, unlit.radiance, seed, level)
    tell(1.0)
    return Frame(
        design=design,
        inclusion=inclusion,
        press=how_pressed(design, press),
        seed=seed,
        image=image,
        reference=reference,
        radiance=lit.radiance,
        pressure=seen_pressure(lit),
        displacement_z=lit.displacement_z,
        surface=press.surface,
        cut=getattr(press, "cut", None),
        fem={
            **mechanics_facts(design, press),
            "dof": getattr(press, "dof", None),
            "seconds": press.seconds,
        },
        tsis={
            **picture_facts(design, image, reference, lit.radiance),
            "frames": design.camera.frames,
            "reference_frames": reference_frames(design),
            "seconds": time.perf_counter() - start,
            "noise_percent": lit.noise_percent,
            **bias_of(design, options["quality"], learned=options["traced"] is not None),
        },
    )
