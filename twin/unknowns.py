"""What is not known of a sensor and its press: which of it the pictures are modelled to depend on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from twin.complaint import DesignError, shown
from twin.design import Design
from twin.forward import PAPER_UNKNOWNS, Unknown
from twin.touches import touches_contact

LED_FLUX = "leds.*.flux_W"
"""As an unknown: the flux of every LED, each by itself."""

UNKNOWNS = (*PAPER_UNKNOWNS, Unknown(LED_FLUX, 0.01, relative=True))
"""`forward.PAPER_UNKNOWNS`, and LEDs that drift by a per cent between calibration and use."""


def expand(design: Design, unknowns: Sequence[Unknown]) -> tuple[Unknown, ...]:
    """Return the unknowns one by one, `LED_FLUX` for each LED; raises `DesignError` for others than these."""
    every: list[Unknown] = []
    for unknown in unknowns:
        names = [unknown.name]
        if unknown.name == LED_FLUX:
            names = [f"leds.{number}.flux_W" for number in range(len(design.leds))]
        every += [replace(unknown, name=name) for name in names]
    for unknown in every:
        check_unknown(unknown)
    names = [unknown.name for unknown in every]
    for name in names:
        if names.count(name) > 1:
            raise DesignError("unknowns", f"{name} twice", "each once")
    return tuple(every)


_COUNTING = ("gain_e_per_dn", "offset_dn", "exposure_ms", "quantum_efficiency", "ambient", "dark_current_e_s")


def check_unknown(unknown: Unknown) -> None:
    """Raise `DesignError` for an unknown whose effect on the pictures is not modelled."""
    camera = unknown.name.removeprefix("camera.") if unknown.name.startswith("camera.") else None
    flux = unknown.name.startswith("leds.") and unknown.name.endswith(".flux_W")
    if not (touches_contact(unknown.name) or camera in _COUNTING or flux):
        allowed = (
            "size_mm, depth_mm, modulus_kPa, offset_x_mm, offset_y_mm, press.indentation_mm, "
            "specimen.modulus_kPa, specimen.thickness_mm, specimen.poisson, surface.rms_slope, "
            "surface.kappa, waveguide.layers.N.modulus_kPa, leds.*.flux_W, "
            f"camera.{', camera.'.join(_COUNTING)}"
        )
        raise DesignError("unknowns", shown(unknown.name), allowed)
    if not 0 < unknown.sd < np.inf:
        raise DesignError(f"unknowns.{unknown.name}.sd", shown(unknown.sd), "a number > 0")
