"""What a press is expected to look like, and how that changes with everything that is not known.

The pictures are those that a sensor's owner has: one per press level, and the reference without inclusion
beside it. Derivatives are central differences over a step that is far below the prior, with the same light
seed on both sides. Where only mechanics, roughness or the camera change, light that walked through the guide
is taken from the middle (`Renderer.render(traced=...)`), so that the differences carry no noise of their own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.information import Information, Noise, inform
from twin import presses
from twin.complaint import DesignError, shown
from twin.design import Design, parse_design
from twin.exposure import expected_counts, light_seed
from twin.fields import number_at, put, tables_of

if TYPE_CHECKING:
    from fem import Emulator
    from scenes import SpectralRenderer

Floats = NDArray[np.float64]

INCLUSION = ("size_mm", "depth_mm", "modulus_kPa", "offset_x_mm", "offset_y_mm")
DEPTH = "press.indentation_mm"
"""All press depths together: with a relative prior, their scale."""
_STEP = 0.1  # of the prior's sd, at most
_MOST = {"size_mm": 0.1, "depth_mm": 0.1, "modulus_kPa": 2.0, "offset_x_mm": 0.1, "offset_y_mm": 0.1}
_MOST_RELATIVE, _MOST_OF_INCLUSION = 0.02, 0.1


@dataclass(frozen=True)
class Unknown:
    """Something that the pictures depend on and nobody knows exactly.

    Attributes
    ----------
    name : one of `INCLUSION`, a dotted number of the design ("specimen.modulus_kPa"), or `DEPTH`.
    sd : standard deviation of what is known before; relative to its value where `relative`.
    relative : the unknown is the value's logarithm.
    """

    name: str
    sd: float
    relative: bool = False


PAPER_UNKNOWNS = (
    Unknown("size_mm", 3.2),
    Unknown("depth_mm", 2.3),
    Unknown("modulus_kPa", 23.0),
    Unknown("offset_x_mm", 1.0),
    Unknown("offset_y_mm", 1.0),
    Unknown("specimen.modulus_kPa", 0.05, relative=True),
    Unknown("specimen.thickness_mm", 1.0),
    Unknown("camera.gain_e_per_dn", 0.01, relative=True),
    Unknown("surface.rms_slope", 0.10, relative=True),
    Unknown(DEPTH, 0.01, relative=True),
)
"""The paper's box as a normal prior, and what a careful owner does not know."""


@dataclass(frozen=True)
class Expected:
    """Mean counts of the pictures of a press, and how they change.

    Attributes
    ----------
    names : of the p unknowns.
    mean : (pictures, rows, columns[, 3]) counts; for each press level the picture, then its reference.
    jacobian : (p, pictures, rows, columns[, 3]) counts per unit of each unknown, per e-fold where relative.
    """

    names: tuple[str, ...]
    mean: Floats
    jacobian: Floats


def expected(
    design: Design,
    inclusion: fem.Inclusion,
    levels: Sequence[float],
    unknowns: Sequence[Unknown] = PAPER_UNKNOWNS,
    *,
    emulator: Emulator,
    quality: presses.Quality = "preview",
    seed: int = 0,
    again: bool = True,
    progress: Callable[[float], None] | None = None,
) -> Expected:
    """Return the expected pictures of a press and their derivatives.

    Parameters
    ----------
    levels : press depths, mm.
    emulator : of the design's mechanics.
    quality : of the light.
    again : take traced light from the middle where the optics stay; False traces it for every picture.

    Raises
    ------
    DesignError, fem.NotModelled
        For unknowns that the design does not have, and specimens that the emulator does not know.
    """
    stage = _Stage(design, inclusion, tuple(levels), emulator, quality, light_seed(seed))
    values = [stage.value(unknown.name) for unknown in unknowns]  # complaints come before any light
    steps = [step_of(unknown, value) for unknown, value in zip(unknowns, values, strict=True)]
    middle = stage.pictures((), None)
    if again:  # the middle, too, as the pictures beside it are made
        middle = replace(middle, mean=stage.pictures((), middle).mean)
    slopes = []
    for number, (unknown, value, step) in enumerate(zip(unknowns, values, steps, strict=True)):

        def at(to: float, name: str = unknown.name) -> Floats:
            return stage.pictures(((name, to),), middle if again else None).mean

        slopes.append(slope_of(at, unknown, value, step, middle.mean))
        if progress is not None:
            progress((number + 1) / len(unknowns))
    return Expected(tuple(unknown.name for unknown in unknowns), middle.mean, np.stack(slopes))


def information(
    expectation: Expected, unknowns: Sequence[Unknown], design: Design, *, frames: int = 1
) -> Information:
    """Return what these pictures tell about the unknowns, with what was known before.

    ``frames`` exposures of the picture are averaged; the reference is the mean of at least 16.
    """
    noise, many = noise_of(design, frames), noise_of(design, max(frames, 16))
    pictures = [
        (expectation.jacobian[:, number], expectation.mean[number], many if number % 2 else noise)
        for number in range(len(expectation.mean))
    ]
    return inform(expectation.names, pictures, np.array([unknown.sd for unknown in unknowns]))


def noise_of(design: Design, frames: int = 1) -> Noise:
    """Return the camera's noise in counts; its fixed pattern counts as calibrated."""
    camera = design.camera
    dark_e = camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2
    return Noise(
        shot=1.0 / camera.gain_e_per_dn,
        read_dn=float(np.sqrt(camera.read_noise_e**2 + dark_e)) / camera.gain_e_per_dn,
        offset_dn=camera.offset_dn + dark_e / camera.gain_e_per_dn,
        bits=camera.bits,
        frames=frames,
    )


def step_of(unknown: Unknown, value: float) -> float:
    """Half the distance of the central difference, in the unknown's own unit."""
    if not unknown.sd > 0:
        raise DesignError(f"unknowns.{unknown.name}.sd", shown(unknown.sd), "a number > 0")
    if unknown.relative:
        return min(_STEP * unknown.sd, _MOST_RELATIVE)
    most = _MOST[unknown.name] if unknown.name in _MOST else _MOST_RELATIVE * abs(value)
    if unknown.name in INCLUSION[:3]:  # an inclusion has a size, a depth and a modulus above 0
        most = min(most, _MOST_OF_INCLUSION * value)
    return min(_STEP * unknown.sd, most)


def slope_of(
    at: Callable[[float], Floats], unknown: Unknown, value: float, step: float, middle: Floats
) -> Floats:
    """Slope of a field by a central difference; where one side is refused by three points on the other.

    Parameters
    ----------
    at : the field where the unknown has a value.
    middle : the field where it has its own.

    Raises
    ------
    DesignError, fem.NotModelled
        Where both sides are refused.
    """
    refused = DesignError, fem.NotModelled
    low, high = _ends(unknown, value, step)
    try:
        return (at(high) - at(low)) / (2.0 * step)
    except refused:
        lower, higher = _ends(unknown, value, 2.0 * step)
        try:
            one, two, sign = at(low), at(lower), 1.0
        except refused:
            one, two, sign = at(high), at(higher), -1.0
        return sign * (3.0 * middle - 4.0 * one + two) / (2.0 * step)


def _ends(unknown: Unknown, value: float, step: float) -> tuple[float, float]:
    if unknown.relative:
        return float(value * np.exp(-step)), float(value * np.exp(step))
    return value - step, value + step


@dataclass(frozen=True)
class _Middle:
    """Mean counts of each picture, and light that was traced for it."""

    mean: Floats
    traced: list[Any]


@dataclass
class _Stage:
    """One sensor and press, of which single numbers are changed."""

    design: Design
    inclusion: fem.Inclusion
    levels: tuple[float, ...]
    emulator: Emulator
    quality: Any
    seed: int
    _kept: tuple[Any, SpectralRenderer] | None = None

    def value(self, name: str) -> float:
        """Return what an unknown is expected to be."""
        if name in INCLUSION:
            ball = self.inclusion
            return float(
                dict(zip(INCLUSION, (ball.size, ball.depth, ball.modulus, *ball.offset), strict=True))[name]
            )
        if name == DEPTH:
            return 1.0
        found = number_at(tables_of(self.design), name, "unknowns")
        if found is None:
            raise DesignError("unknowns", shown(name), "a number that the design holds")
        return found

    def pictures(self, changes: tuple[tuple[str, float], ...], middle: _Middle | None) -> _Middle:
        """Return the mean counts with some numbers changed, and the light that was traced for each."""
        ball = {name: value for name, value in changes if name in INCLUSION}
        scale = dict(changes).get(DEPTH, 1.0)
        fields = [(name, value) for name, value in changes if name not in INCLUSION and name != DEPTH]
        design = parse_design(put(tables_of(self.design), fields)) if fields else self.design
        pressed = presses.emulated(
            design, self._inclusion(ball), [scale * level for level in self.levels], self.emulator
        )
        renderer, same = self._renderer(design)
        means: list[Floats] = []
        found: list[Any] = []
        for number, press in enumerate(pressed):
            for field in ("pressure", "pressure_0"):
                place = 2 * number + (field == "pressure_0")
                if middle is not None and place % 2 and ball:
                    means.append(middle.mean[place])  # nothing of the inclusion is in the reference
                    continue
                before = middle.traced[place] if middle is not None and same else None
                seen = renderer.render(
                    press.surface, field=field, quality=self.quality, seed=self.seed, traced=before
                )
                means.append(expected_counts(design, seen.radiance))
                found.append(seen.traced)
        return _Middle(np.stack(means), found)

    def _inclusion(self, ball: dict[str, float]) -> fem.Inclusion:
        names = {"size_mm": "size", "depth_mm": "depth", "modulus_kPa": "modulus"}
        changed: dict[str, Any] = {names[name]: value for name, value in ball.items() if name in names}
        x, y = self.inclusion.offset
        changed["offset"] = (ball.get("offset_x_mm", x), ball.get("offset_y_mm", y))
        return replace(self.inclusion, **changed)

    def _renderer(self, design: Design) -> tuple[SpectralRenderer, bool]:
        """Return a scene for the design, and whether light that was traced in the middle serves there."""
        from scenes import SpectralRenderer

        sensor = design.sensor()
        middle = self.design.sensor()
        # These decide how much of the surface touches, which light meets after it was traced.
        skin = replace(sensor.skin, rms_slope=middle.skin.rms_slope, kappa=middle.skin.kappa)
        modulus = middle.effective_modulus_kPa
        same = replace(sensor, camera=middle.camera, effective_modulus_kPa=modulus, skin=skin) == middle
        if self._kept is None or self._kept[0] != sensor:
            made = SpectralRenderer(sensor, count=design.light.bands, at=design.sensor, device="cpu")
            if self._kept is not None:
                return made, same
            self._kept = (sensor, made)
        return self._kept[1], same
