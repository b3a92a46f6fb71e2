"""From what nobody knows to the coarse pictures that are expected: emulated contact, learned light, camera.

A press takes milliseconds, so that an estimator can look at as many specimens as it likes. What may be
unknown is what a corpus can vary without another emulator or another light: the inclusion and its offset, the
specimen's stiffness and thickness, the skin's slope, the depth of each press, LED powers, the camera's gain.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

import fem
from estimation.light_map import LightMap
from fem.emulator import fields_of
from scenes.camera import fixed_pattern
from scenes.contact import real_contact
from twin import presses, retake
from twin.design import Design
from twin.study import PARAMETERS

Single = NDArray[np.float32]

BLOCK = (12, 12)
"""Rows and columns of pixels that make one of a coarse picture."""

FIELDS = ("specimen.modulus_kPa", "specimen.thickness_mm", "surface.rms_slope", "camera.gain_e_per_dn")
"""Numbers of a design that may vary, besides `press.indentation_mm.*` and `leds.*.flux_W`."""


@dataclass(frozen=True)
class Chain:
    """A sensor, its emulator, and the light map learned for it.

    Attributes
    ----------
    design : what does not vary; its press levels are the nominal ones.
    light : from a contact (`contact`) to electrons per watt, (n_led, r, c), of a block's pixels.
    """

    design: Design
    emulator: fem.Emulator
    light: LightMap

    @property
    def levels(self) -> int:
        return len(self.design.press.indentation_mm)

    @cached_property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the coarse picture."""
        return self.light.shape[-2], self.light.shape[-1]

    @cached_property
    def dark_dn(self) -> float:
        """Counts without light at a gain of 1 electron per count: the dark charge, electrons."""
        camera = self.design.camera
        return camera.dark_current_e_s * camera.exposure_ms * 1e-3 * camera.binning**2

    @cached_property
    def pattern_dn(self) -> Single:
        """Dark offsets of the camera's pixels, (r, c) counts, as a dark frame tells them."""
        _, offset = fixed_pattern(self.design.camera)
        return retake.average(whole_blocks(offset), BLOCK) / np.float32(self.design.camera.gain_e_per_dn)

    def inputs(
        self, many: Sequence[Mapping[str, float]], blank: Sequence[bool] | None = None
    ) -> NDArray[np.float64]:
        """Return the light map's inputs (n, levels, 2, k); see `contacts`."""
        found = contacts(self.design, self.emulator, many, blank)
        return self.light.inputs(found.reshape(-1, found.shape[-1])).reshape(*found.shape[:3], -1)

    def fluxes(self, values: Mapping[str, float]) -> Single:
        """Return the LEDs' power, (n_led,) W."""
        return np.array(
            [values.get(f"leds.{n}.flux_W", led.flux_W) for n, led in enumerate(self.design.leds)], np.float32
        )

    def gain(self, values: Mapping[str, float]) -> float:
        """Return electrons per count."""
        return float(values.get("camera.gain_e_per_dn", self.design.camera.gain_e_per_dn))


def contacts(
    design: Design,
    emulator: fem.Emulator,
    many: Sequence[Mapping[str, float]],
    blank: Sequence[bool] | None = None,
) -> Single:
    """Return contacts (n, levels, 2, d) of pictures and references: real contact fraction and displacement in
    mm at the emulator's nodes.

    Each of the ``many`` holds `PARAMETERS` unless it is blank, and any of the design's numbers by name.
    Raises `fem.NotModelled` outside of the emulator.
    """
    sensors, cases = [], []
    for number, values in enumerate(many):
        here, depths = seen_by(design, values)
        inclusion = None
        if blank is None or not blank[number]:
            size, depth, modulus, x, y = (float(values[name]) for name in PARAMETERS)
            inclusion = fem.Inclusion(size, depth, modulus, (x, y))
        presses.check_emulated(here, inclusion, depths, emulator)
        sensors.append((here.surface, here.effective_modulus_kPa))
        cases.append((here.slab(), inclusion, depths))
    found = np.empty((len(cases), len(design.press.indentation_mm), 2, 4 * len(emulator.x) ** 2), np.float32)
    for number, (pressed, (skin, modulus)) in enumerate(
        zip(fields_of(emulator, cases), sensors, strict=True)
    ):
        for level, fields in enumerate(pressed):
            for place, suffix in enumerate(("", "_0")):
                fraction = real_contact(fields["pressure" + suffix], skin, modulus).ravel()
                found[number, level, place, : fraction.size] = fraction
                found[number, level, place, fraction.size :] = fields["displacement" + suffix].ravel()
    return found


def seen_by(design: Design, values: Mapping[str, float]) -> tuple[Design, list[float]]:
    """Return the design with these numbers of its own in it, and its press depths, mm."""
    tissue, skin = design.specimen, design.surface
    made = replace(
        design,
        specimen=replace(
            tissue,
            modulus_kPa=float(values.get("specimen.modulus_kPa", tissue.modulus_kPa)),
            thickness_mm=float(values.get("specimen.thickness_mm", tissue.thickness_mm)),
        ),
        surface=replace(skin, rms_slope=float(values.get("surface.rms_slope", skin.rms_slope))),
    )
    nominal = enumerate(design.press.indentation_mm)
    return made, [float(values.get(f"press.indentation_mm.{level}", depth)) for level, depth in nominal]


def coarse_charges(design: Design, layers: NDArray[np.floating]) -> Single:
    """Return electrons of a block's pixels from each LED, (n_led, r, c), of layers (n_led, rows, columns)."""
    pixels = retake.charges(design, np.asarray(layers), (1, 1))
    return np.stack([retake.average(whole_blocks(one), BLOCK) for one in pixels])


def whole_blocks(picture: NDArray[np.floating], block: tuple[int, int] = BLOCK) -> Single:
    """Leave out rows and columns beyond the last whole block."""
    rows, columns = (side // size * size for side, size in zip(picture.shape, block, strict=True))
    return np.asarray(picture[:rows, :columns], np.float32)
