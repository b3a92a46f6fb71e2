"""Press to picture: mechanics, light, camera and scalars in one call."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, TypedDict, Unpack, overload

import numpy as np

import fem
from estimation import scalars
from twin.complaint import DesignError, shown
from twin.design import Design, load_design
from twin.frame import Frame

if TYPE_CHECKING:
    import pyvista

    from fem import Press
    from scenes import Renderer, Rendering

Quality = Literal["preview", "standard", "reference"]
Device = Literal["auto", "cpu", "cuda"]
Progress = Callable[[str, float], None]
"""Called with the name of the stage that runs now and the share of all work that is done, 0 to 1."""

REFERENCE_FRAMES = 16
"""Noisy frames whose mean is the camera's reference."""

# Purposes of random numbers: children of the seed, so that one more draw for one leaves the others alone.
_LIGHT, _PICTURE, _REFERENCE = range(3)

# Seconds that mechanics and one rendering take on two cores: they only shape the estimate of the time left.
_MECHANICS_COST, _LIGHT_COST = 6.0, 8.0


class Options(TypedDict, total=False):
    """What `simulate` takes beside the press, for whichever form of it."""

    quality: Quality
    seed: int
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
    seed: int = 0,
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
    if not isinstance(seed, int) or isinstance(seed, bool) or seed < 0:
        raise DesignError("seed", shown(seed), "an integer >= 0")
    tell = progress or (lambda stage, done: None)

    from scenes import Renderer

    renderer = Renderer(design.sensor(), device=device)
    # Linear mechanics: one solve at a unit load serves every level, whose bytes then do not depend on the others.
    total = _MECHANICS_COST + _LIGHT_COST * len(levels)
    tell("mechanics", 0.0)
    load: dict[str, Any] = {"force": 1.0} if by_force else {"indentation": 1.0}
    unit = fem.press(design.probe(), design.slab(), inclusion, quality=quality, **load)
    if by_force:
        _check_forces(design, unit, levels)
    frames = []
    for number, level in enumerate(levels):
        tell(f"light {number + 1} of {len(levels)}", (_MECHANICS_COST + number * _LIGHT_COST) / total)
        frames.append(_frame(design, inclusion, scaled(unit, level), renderer, quality, seed, level))
    tell("done", 1.0)
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
    fem.check(design.probe(), design.slab(), inclusion)
    for level in levels:
        if not by_force:
            design.check_indentation(level)
        elif not 0.0 < level < np.inf:
            raise DesignError("press.force_N", shown(level), "a finite number > 0")


def scaled(press: Press, factor: float) -> Press:
    """Return the press under ``factor`` times its load: small strain is linear, contact stays closed."""
    names = {entry.name for entry in dataclasses.fields(press)}
    loads = [name for name in names if name.endswith(("_mm", "_N", "_kPa"))]
    return dataclasses.replace(
        press,
        surface=_scaled_fields(press.surface, factor),
        cut=_scaled_fields(press.cut, factor),
        **{name: factor * getattr(press, name) for name in loads},
    )


def _scaled_fields(mesh: pyvista.PolyData, factor: float) -> pyvista.PolyData:
    copy = mesh.copy()
    for name in copy.point_data:
        if name.startswith(("displacement", "pressure")):
            copy.point_data[name] = factor * np.asarray(mesh.point_data[name])
    return copy


def _levels(
    design: Design, indentation: float | Sequence[float] | None, force: float | Sequence[float] | None
) -> tuple[list[float], bool, bool]:
    """Return the press levels (mm or N), whether they are forces, and whether a list of frames is wanted."""
    if indentation is not None and force is not None:
        raise DesignError("press", "both indentation and force", "one of them")
    given = force if force is not None else indentation
    if given is None:
        given = design.press.indentation_mm[0]
    several = isinstance(given, Sequence | np.ndarray)
    field = "press.force_N" if force is not None else "press.indentation_mm"
    try:
        levels = [float(level) for level in given] if several else [float(given)]  # type: ignore[union-attr, arg-type]
    except (TypeError, ValueError):
        raise DesignError(field, shown(given), "a number > 0, or a list of them") from None
    if not levels:
        raise DesignError(field, "no level", "at least one number > 0")
    return levels, force is not None, several


def _check_forces(design: Design, unit: Press, levels: Sequence[float]) -> None:
    deepest = design.max_indentation_mm
    most = deepest / max(unit.indentation_mm, unit.indentation_0_mm)
    for force in levels:
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
) -> Frame:
    start = time.perf_counter()
    camera, wavelength, k = design.camera, design.light.wavelength_nm, design.signal.counts
    light = int(_random(seed, _LIGHT).generate_state(1)[0])  # the same with and without: their noise cancels

    def render(field: str) -> Rendering:
        return renderer.render(press.surface, field=field, quality=quality, seed=light)

    def expose(rendering: Rendering, purpose: int, frames: int) -> np.ndarray:
        from scenes.camera import expose

        rng = np.random.Generator(np.random.PCG64(_random(seed, purpose, round(level * 1e6))))
        return expose(
            camera, rendering.radiance.sum(axis=0, dtype=np.float64), wavelength, rng, frames=frames
        )

    lit = render("pressure")
    unlit = render("pressure_0") if inclusion is not None else lit
    image = expose(lit, _PICTURE, 1)
    reference = expose(unlit, _REFERENCE, REFERENCE_FRAMES).astype(np.float32)
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
        },
    )


def _random(seed: int, *purpose: int) -> np.random.SeedSequence:
    """Return the child of the seed for one purpose, and for one press level where it is named (µm or µN)."""
    return np.random.SeedSequence(seed, spawn_key=purpose)
