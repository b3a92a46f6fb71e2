"""Press to picture: mechanics, light, camera and scalars in one call."""

from __future__ import annotations

import operator
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, SupportsIndex, TypedDict, Unpack, overload

import numpy as np

import fem
from estimation import scalars
from fem.model import check as check_mechanics
from twin.complaint import DesignError, shown
from twin.design import Design, load_design
from twin.frame import Frame

if TYPE_CHECKING:
    from fem import Press
    from scenes import Renderer, Rendering

Quality = Literal["preview", "standard", "reference"]
Device = Literal["auto", "cpu", "cuda"]
Progress = Callable[[str, float], None]
"""Called with the name of the stage that runs now and the share of all work that is done, 0 to 1."""

MIN_FORCE_N = 1e-4
"""Smallest press by force: far below what any camera sees."""

REFERENCE_FRAMES = 16
"""Noisy frames whose mean is the camera's reference."""

# Purposes of random numbers: children of the seed, so that one more draw for one leaves the others alone.
_LIGHT, _PICTURE, _REFERENCE = range(3)


@dataclass(frozen=True)
class _Work:
    """How much is done: mechanics once, then light for each level."""

    progress: Progress
    levels: int
    # Seconds that mechanics and one level's light take on two cores; only to estimate the time left.
    mechanics: float = 6.0
    light: float = 8.0

    def tell(self, stage: str, mechanics: float, levels: float = 0.0) -> None:
        """Pass on which stage runs now, with the share of the mechanics and the number of levels done."""
        done = self.mechanics * mechanics + self.light * levels
        self.progress(stage, done / (self.mechanics + self.light * self.levels))


class Options(TypedDict, total=False):
    """What `simulate` takes beside the press, for whichever form of it."""

    quality: Quality
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
    quality: Quality = "standard",
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
    force : force on the glass instead, N.
    quality : "preview", "standard" or "reference", for mechanics and light alike.
    seed : of the light's and the camera's random numbers. One level's frame does not depend on the others.
    device : "auto" (a CUDA GPU where there is one), "cpu" or "cuda".

    Raises
    ------
    DesignError, fem.NotModelled, scenes.backend.BackendError
        In one line: what was received and what is allowed.
    """
    design = design if isinstance(design, Design) else load_design(design)
    levels, by_force, several = _levels(design, indentation, force)
    check(design, inclusion, levels, by_force=by_force)
    seed = _seed(seed)
    from scenes import Renderer

    renderer = Renderer(design.sensor(), device=device)
    work = _Work(progress or (lambda stage, done: None), len(levels))
    frames = []
    for number, level in enumerate(levels):
        # The mechanics are linear and `fem.press` keeps its last solution: further levels only scale it.
        press = fem.press(
            design.probe(),
            design.slab(),
            inclusion,
            **{"force" if by_force else "indentation": level},
            quality=quality,
            progress=lambda stage, share: work.tell("mechanics", share),
        )
        if by_force:
            _check_depth(design, press, levels)
        stage = "light" if len(levels) == 1 else f"light {number + 1} of {len(levels)}"

        def tell(share: float, stage: str = stage, number: int = number) -> None:
            work.tell(stage, 1.0, number + share)

        tell(0.0)
        frames.append(_frame(design, inclusion, press, renderer, quality, seed, level, tell))
    return frames if several else frames[0]


def check(
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float] = (),
    *,
    by_force: bool = False,
) -> None:
    """Raise, before any work is done, if the press cannot be simulated: levels are mm, or N ``by_force``."""
    if inclusion is not None:
        design.check_inclusion(inclusion)
    check_mechanics(design.probe(), design.slab(), inclusion)
    for level in levels:
        if not by_force:
            design.check_indentation(level)
        elif not MIN_FORCE_N <= level < np.inf:
            raise DesignError("press.force_N", shown(level), f"a finite number >= {MIN_FORCE_N:g} N")


def _seed(seed: SupportsIndex) -> int:
    """Return any kind of integer, numpy's too, as Python's own."""
    try:
        if isinstance(seed, bool) or operator.index(seed) < 0:
            raise TypeError
    except TypeError:
        raise DesignError("seed", shown(seed), "an integer >= 0") from None
    return operator.index(seed)


def _levels(
    design: Design, indentation: float | Sequence[float] | None, force: float | Sequence[float] | None
) -> tuple[list[float], bool, bool]:
    """Return the press levels (mm or N), whether they are forces, and whether a list of frames is wanted."""
    if indentation is not None and force is not None:
        raise DesignError("press", "both indentation and force", "one of them")
    given = force if force is not None else indentation
    if given is None:
        given = design.press.indentation_mm[0]
    several = isinstance(given, Sequence) or np.ndim(given) > 0
    field = "press.force_N" if force is not None else "press.indentation_mm"
    try:
        each = list(given) if several else [given]  # type: ignore[arg-type]
        if isinstance(given, str | bytes) or any(isinstance(level, bool | np.bool_ | str) for level in each):
            raise TypeError
        if any(np.ndim(level) for level in each):
            raise TypeError
        levels = [float(level) for level in each]  # type: ignore[arg-type]
    except (TypeError, ValueError):
        raise DesignError(field, shown(given), "a number > 0, or a list of them") from None
    if not levels:
        raise DesignError(field, "no level", "at least one number > 0")
    return levels, force is not None, several


def _check_depth(design: Design, press: Press, forces: Sequence[float]) -> None:
    """Raise `DesignError` if one of the forces presses deeper than is allowed; depth goes with force."""
    deepest = design.max_indentation_mm
    most = deepest * press.force_N / max(press.indentation_mm, press.indentation_0_mm)
    for force in forces:
        if force > most:
            allowed = f"a number > 0 and <= {most:.4g} N, which presses {deepest:g} mm deep"
            raise DesignError("press.force_N", shown(force), allowed)


def _frame(
    design: Design,
    inclusion: fem.Inclusion | None,
    press: Press,
    renderer: Renderer,
    quality: Quality,
    seed: int,
    level: float,
    tell: Callable[[float], None],
) -> Frame:
    start = time.perf_counter()
    camera, wavelength, k = design.camera, design.light.wavelength_nm, design.signal.counts
    # The same with and without the inclusion, so that their noise cancels; 26 bits leave room for the LEDs.
    light = int(_random(seed, _LIGHT).generate_state(1)[0]) >> 6

    def render(field: str, before: float) -> Rendering:
        return renderer.render(
            press.surface,
            field=field,
            quality=quality,
            seed=light,
            progress=lambda share: tell(before + 0.5 * share),
        )

    def expose(rendering: Rendering, purpose: int, frames: int) -> np.ndarray:
        from scenes.camera import expose

        rng = np.random.Generator(np.random.PCG64(_random(seed, purpose, round(level * 1e6))))
        return expose(
            camera, rendering.radiance.sum(axis=0, dtype=np.float64), wavelength, rng, frames=frames
        )

    lit = render("pressure", 0.0)
    unlit = render("pressure_0", 0.5) if inclusion is not None else lit
    image = expose(lit, _PICTURE, 1)
    reference = expose(unlit, _REFERENCE, REFERENCE_FRAMES).astype(np.float32)
    tell(1.0)
    return Frame(
        design=design,
        inclusion=inclusion,
        press={"indentation_mm": press.indentation_mm, "force_N": press.force_N},
        seed=seed,
        image=image,
        reference=reference,
        radiance=lit.radiance,
        pressure=lit.pressure,
        displacement_z=lit.displacement_z,
        surface=press.surface,
        cut=press.cut,
        fem={
            **fem.scalars(press.surface, design.signal.displacement_um),
            "min_pressure_kPa": press.min_pressure_kPa,
            "dof": press.dof,
            "seconds": press.seconds,
        },
        tsis={
            "raw": scalars(image, k),
            "tared": scalars(image.astype(np.float64) - reference, k),
            "seconds": time.perf_counter() - start,
            "noise_percent": lit.noise_percent,
            "saturated_percent": _saturated_percent(design, image, lit.radiance),
        },
    )


def _saturated_percent(design: Design, image: np.ndarray, radiance: np.ndarray) -> float:
    """Return the share of pixels at the converter's last count or at the full well, per cent.

    ``image`` is (rows, columns) counts, ``radiance`` (n_led, rows, columns) W m⁻² sr⁻¹.
    """
    from scenes.camera import mean_counts

    camera = design.camera
    well = camera.offset_dn + camera.full_well_e / camera.gain_e_per_dn
    mean = mean_counts(camera, radiance.sum(axis=0, dtype=np.float64), design.light.wavelength_nm)
    full = (image >= 2**camera.bits - 1) | (mean >= well * (1 - 1e-12))
    return 100.0 * float(full.mean())


def _random(seed: int, *purpose: int) -> np.random.SeedSequence:
    """Return the child of the seed for one purpose, and for one press level where it is named (µm or µN)."""
    return np.random.SeedSequence(seed, spawn_key=purpose)
