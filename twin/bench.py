"""The presses and the light of a layout, and what layouts share of both."""

from __future__ import annotations

import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

import fem
from scenes import ies
from scenes.traced import LIGHT
from scenes.view import SIGHT
from twin import coarse as pixels
from twin import objectives, touches
from twin.design import Design
from twin.exposure import light_seed
from twin.forward import Unknown, step_of
from twin.kept import Arrays, Kept
from twin.layers import Lighting, Lit
from twin.touches import Touch, touches_contact

if TYPE_CHECKING:
    from fem import Emulator


PATHS = 2**19
"""Light paths per LED that judge a layout, at least: at twice as many no bound moves by 5 %
(`tests/test_bound.py`)."""


@dataclass
class Bench:
    """What layouts share: what was computed before, and the sensor whose light is at hand."""

    kept: Kept = field(default_factory=Kept)
    cell_mm: float = pixels.CELL_MM
    samples: int = 0
    _lighting: tuple[Any, Lighting] | None = None

    def paths(self, quality: str) -> int:
        """Light paths per LED: `samples`, or else as many as judging takes."""
        from scenes.render import PATHS_PER_LED

        return self.samples or max(PATHS, PATHS_PER_LED[quality])

    def lighting(self, design: Design, quality: str, seed: int, plain: Any) -> Lighting:
        """Return the light of a sensor on coarse pixels; what the camera makes of it does not count.

        ``plain`` names the mechanics of plain tissue, whose pictures its presses share.
        """
        paths = self.paths(quality)
        key = repr((optical_key(design), quality, seed, paths, plain))
        if self._lighting is None or self._lighting[0] != key:
            self._lighting = None  # its scene goes before the next one comes
            self._lighting = key, Lighting(design, quality, light_seed(seed), paths)
        return self._lighting[1]


def optical_key(design: Design) -> tuple[Any, ...]:
    """All of a sensor that its radiance depends on: not what the camera makes of it."""
    camera = design.camera
    seen = camera.rows, camera.columns, camera.field_of_view_mm, camera.distance_mm, camera.distortion
    response = camera.quantum_efficiency if not isinstance(camera.quantum_efficiency, float) else None
    sensor = design.sensor()
    parts = sensor.guide, sensor.glass, sensor.leds, sensor.skin, sensor.tissue, sensor.effective_modulus_kPa
    box = (design.housing,) if design.housing.reflects else ()
    luminaires = [ies.digest(led.ies) for led in sensor.leds if led.ies is not None]
    lower = (sensor.guide.lower,) if sensor.guide.lower else ()  # not in the guide's own words
    own = camera.colour, response, camera.pixel_um, design.light
    return (*seen, *own, *parts, *box, *lower, *luminaires)


@dataclass
class Work:
    """The presses and the light of one layout."""

    design: Design
    unknowns: tuple[Unknown, ...]
    emulator: Emulator | None
    quality: str
    seed: int
    bench: Bench
    seconds: dict[str, float]
    ground: fem.Inclusion
    """Whose mesh carries the press on plain tissue, where presses are solved."""

    def __post_init__(self) -> None:
        self.moving = [unknown for unknown in self.unknowns if touches_contact(unknown.name)]

    def touch(self, inclusion: fem.Inclusion, level: float, place: tuple[float, float]) -> Touch:
        """The contact, from before or computed now.

        Every solve has its own mesh, whose error in the background would look like a signal: what the
        inclusion adds on its mesh is added to the one background.
        """
        found = self._touch(inclusion, level, place)
        if self.emulator is not None or (inclusion, place) == (self.ground, (0.0, 0.0)):
            return found
        ground = self._touch(self.ground, level, (0.0, 0.0))
        slopes = {}
        for name, slope in found.slopes.items():
            plain = ground.slopes[name][1]
            slopes[name] = np.stack([plain + (slope[0] - slope[1]), plain])
        return Touch(ground.plain + (found.fields - found.plain), ground.plain, slopes, found.steps)

    def _touch(self, inclusion: fem.Inclusion, level: float, place: tuple[float, float]) -> Touch:
        """On its own mesh; a solved one serves at every level."""
        began = time.perf_counter()
        solved = self.emulator is None
        names = [unknown.name for unknown in self.moving]
        steps = {u.name: step_of(u, touches.value_of(self.design, inclusion, u.name)) for u in self.moving}

        def make() -> Arrays:
            at = 1.0 if solved else level
            found = touches.touch(self.design, inclusion, at, place, self.moving, self.emulator)
            slopes = [found.slopes[name] for name in names]
            return {
                "fields": found.fields,
                "plain": found.plain,
                "slopes": np.stack(slopes) if slopes else np.zeros((0, 2, *found.fields.shape), np.float32),
            }

        if solved:
            self.design.check_indentation(level)
        got = self.bench.kept.get(self._key("touch", inclusion, 0.0 if solved else level, place), make)
        by = level if solved else 1.0
        self.seconds["mechanics"] += time.perf_counter() - began
        slopes = {name: by * slope for name, slope in zip(names, got["slopes"], strict=True)}
        return Touch(by * got["fields"], by * got["plain"], slopes, steps)

    def lit(self, inclusion: fem.Inclusion, level: float, place: tuple[float, float]) -> Lit:
        """The light of a press, from before or computed now."""
        names = tuple(unknown.name for unknown in self.moving)

        def make() -> Arrays:
            touch = self.touch(inclusion, level, place)
            began = time.perf_counter()
            found = self.lighting.lit(touch, level, self.moving)
            self.seconds["light"] += time.perf_counter() - began
            return {"layers": found.layers, "slopes": found.slopes}

        got = self.bench.kept.get(self._light_key("lit", inclusion, level, place), make)
        return Lit(got["layers"], got["slopes"], names)

    def standard(self, level: float, near: fem.Inclusion) -> tuple[NDArray[Any], NDArray[Any]]:
        """Radiance of plain tissue, and with the standard lump at each depth, at one level."""
        size, modulus = objectives.PRESSED

        def make() -> Arrays:
            touch = self.touch(near, level, (0.0, 0.0))
            began = time.perf_counter()
            lighting = self.lighting
            if level not in lighting.levels:
                lighting.lit(touch, level, ())
            plain, lumps = lighting.plain(level), []
            self.seconds["light"] += time.perf_counter() - began
            for depth in self.depths():
                ball = fem.Inclusion(size, depth, modulus)
                lump = self.lump(ball, level)
                began = time.perf_counter()
                lumps.append(lighting.seen(lump, level))
                self.seconds["light"] += time.perf_counter() - began
            # as the lumps were made: with the light that was traced for plain tissue
            return {"plain": plain.astype(np.float32), "lumps": np.stack(lumps).astype(np.float32)}

        got = self.bench.kept.get(self._light_key("standard", near, level, (0.0, 0.0)), make)
        return got["plain"], got["lumps"]

    def depths(self) -> list[float]:
        """Depths at which the standard lump is pressed, within the slab."""
        size, deepest = objectives.PRESSED[0], self.design.specimen.thickness_mm
        return [depth for depth in objectives.PRESSED_DEPTHS_MM if depth + size < 0.9 * deepest]

    def lump(self, ball: fem.Inclusion, level: float) -> NDArray[Any]:
        """Contact fields of an inclusion without any slopes."""
        work = replace(self, unknowns=())
        if self.emulator is not None:
            with suppress(fem.NotModelled):  # an emulator of another width or tissue knows some of them only
                return work._touch(ball, level, (0.0, 0.0)).fields
        own = replace(work, emulator=None)._touch(ball, level, (0.0, 0.0))
        return work._touch(self.ground, level, (0.0, 0.0)).plain + (own.fields - own.plain)

    @property
    def lighting(self) -> Lighting:
        plain = self._key("plain", self.ground, 0.0, (0.0, 0.0))
        return self.bench.lighting(self.design, self.quality, self.seed, plain)

    def _key(self, what: str, inclusion: fem.Inclusion, level: float, place: tuple[float, float]) -> Any:
        design = self.design
        known = None if self.emulator is None else (self.emulator.plan, float(self.emulator.pressure.sum()))
        felt = design.effective_modulus_kPa, design.surface.rms_slope, design.surface.kappa
        bodies = design.probe(), design.slab(), inclusion, design.mechanics if known else "linear"
        return what, 2, bodies, felt, known, level, place, self.moving

    def _light_key(
        self, what: str, inclusion: fem.Inclusion, level: float, place: tuple[float, float]
    ) -> Any:
        own = optical_key(self.design), self.quality, self.seed, self.bench.paths(self.quality), LIGHT, SIGHT
        return self._key(what, inclusion, level, place), own, self.ground
