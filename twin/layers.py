"""Radiance from each LED of the pictures of a press, and how it changes with what is not known.

One `Lighting` is one sensor's light. What presses share is computed once: the scene, the light gathered at a
press level (`scenes.tangent`), the picture of plain tissue there.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from scenes.surface import OpticalSurface
from twin.design import Design
from twin.forward import Unknown
from twin.touches import Touch, knows_inclusion, surface_of, touches_contact

if TYPE_CHECKING:
    from scenes import SpectralRenderer

Floats = NDArray[np.float64]
Singles = NDArray[np.float32]

_SEED_STEP = 0x9E3779B1  # of bands, as `scenes.spectral` has it
_SEEDS = 2**26


@dataclass(frozen=True)
class Lit:
    """Radiance of the picture of a press and of its reference, W m⁻² sr⁻¹.

    Attributes
    ----------
    layers : (2, n_led, rows, columns[, 3]), with the inclusion and without.
    slopes : (q, 2, n_led, rows, columns[, 3]) per unit of each of the unknowns that move the contact.
    names : of those q unknowns.
    """

    layers: Singles
    slopes: Singles
    names: tuple[str, ...]


@dataclass
class _Place:
    """What the presses of one level share, for each band."""

    straight: list[Any]
    plain_traced: list[Floats]
    plain_layers: Floats
    plain_slopes: dict[str, Floats] = field(default_factory=dict)


@dataclass
class Lighting:
    """The light of one sensor.

    Attributes
    ----------
    design : with the camera's pixels as they are to be computed.
    quality : "preview" or "standard".
    seed : of the light, as of `exposure.light_seed`.
    samples : light paths per LED, 0 for the quality's.
    """

    design: Design
    quality: str = "preview"
    seed: int = 0
    samples: int = 0
    seconds: float = 0.0
    pictures: int = 0
    _spectral: SpectralRenderer | None = None
    _places: dict[float, _Place] = field(default_factory=dict)

    def lit(
        self,
        touch: Touch,
        level: float,
        unknowns: Sequence[Unknown],
        progress: Callable[[float], None] | None = None,
    ) -> Lit:
        """Return the light of a press; presses of one level share their reference.

        Raises
        ------
        scenes.sensor.NotModelled
            For LEDs that the pressed rim would shade, in one line.
        """
        began = time.perf_counter()
        moving = [unknown for unknown in unknowns if touches_contact(unknown.name)]
        place = self._place(touch, level, moving)
        shape = surface_of(self.design, touch.fields)
        traced = self._traced(shape, place.straight)
        layers = self._picture(shape, place.straight, traced)
        slopes = []
        for number, unknown in enumerate(moving):
            slope = self._slope(touch, unknown, 0, layers, place.straight, traced)
            other = place.plain_slopes.get(unknown.name)
            slopes.append(np.stack([slope, np.zeros_like(slope) if other is None else other]))
            if progress is not None:
                progress((number + 1) / len(moving))
        self.seconds += time.perf_counter() - began
        both = np.stack([layers, place.plain_layers])
        return Lit(
            both.astype(np.float32),
            np.stack(slopes).astype(np.float32) if slopes else np.zeros((0, *both.shape), np.float32),
            tuple(unknown.name for unknown in moving),
        )

    @property
    def levels(self) -> tuple[float, ...]:
        """Levels that were lit."""
        return tuple(self._places)

    def seen(self, fields: Floats, level: float) -> Floats:
        """Radiance (n_led, rows, columns[, 3]) of another contact (4, n, n) of a level that was lit, with
        the light that was traced for plain tissue."""
        began, place = time.perf_counter(), self._places[level]
        found = self._picture(surface_of(self.design, fields), place.straight, place.plain_traced)
        self.seconds += time.perf_counter() - began
        return found

    def plain(self, level: float) -> Floats:
        """Radiance (n_led, rows, columns[, 3]) of plain tissue at a level that was lit."""
        return self._places[level].plain_layers

    def _place(self, touch: Touch, level: float, moving: Sequence[Unknown]) -> _Place:
        if level not in self._places:
            renderers = self.spectral.renderers
            from scenes import tangent  # only now: see scenes.backend

            shape = surface_of(self.design, touch.plain)
            straight = [tangent.gathered(renderer, shape) for renderer in renderers]
            traced = self._traced(shape, straight)
            self._places[level] = _Place(straight, traced, self._picture(shape, straight, traced))
        place = self._places[level]
        for unknown in moving:
            if unknown.name not in place.plain_slopes and not knows_inclusion(unknown.name):
                found = self._slope(touch, unknown, 1, place.plain_layers, place.straight, place.plain_traced)
                place.plain_slopes[unknown.name] = found
        return place

    def _slope(
        self,
        touch: Touch,
        unknown: Unknown,
        plain: int,
        layers: Floats,
        straight: list[Any],
        traced: list[Floats],
    ) -> Floats:
        """The picture beside minus the picture, over the step: central in the mechanics by its slopes."""
        fields, step = (touch.plain if plain else touch.fields), touch.steps[unknown.name]
        there = surface_of(self.design, fields + step * touch.slopes[unknown.name][plain])
        return (self._picture(there, straight, traced) - layers) / step

    @property
    def spectral(self) -> SpectralRenderer:
        """The sensor's scenes, loaded when they are first asked for."""
        if self._spectral is None:
            from scenes import SpectralRenderer

            design = self.design
            self._spectral = SpectralRenderer(
                design.sensor(), count=design.light.bands, at=design.sensor, device="cpu"
            )
        return self._spectral

    def _traced(self, shape: OpticalSurface, straight: list[Any]) -> list[Floats]:
        from scenes import tangent
        from scenes.render import PATHS_PER_LED

        whole, found = self.samples or PATHS_PER_LED[self.quality], []
        for number, (renderer, band) in enumerate(
            zip(self.spectral.renderers, self.spectral.bands, strict=True)
        ):
            seed = (self.seed + number * _SEED_STEP) % _SEEDS if number else self.seed
            paths = max(whole // band.parts, 2)
            found.append(tangent.traced(renderer, shape, straight[number], seed, self.quality, paths))
        return found

    def _picture(self, shape: OpticalSurface, straight: list[Any], traced: list[Floats]) -> Floats:
        """Radiance of each LED, (n_led, rows, columns[, 3]), all bands together."""
        from scenes import tangent

        self.pictures += 1
        renderers, spectral = self.spectral.renderers, self.spectral
        each = [
            tangent.picture(renderer, shape, straight[number], traced[number])
            for number, renderer in enumerate(renderers)
        ]
        return np.asarray(spectral.together(each))
