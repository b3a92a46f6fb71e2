"""Our Mitsuba plugins, registered by one import: `import scenes.plugins`, after a variant is set.

`frustrated_tir` (BSDF) is the contact surface, `tsis_pinhole` (sensor) the camera. They are written for one
wavelength at a time: the variants `llvm_ad_mono` and `cuda_ad_mono`.
"""

from __future__ import annotations

import mitsuba as mi

from .backend import VARIANTS

if mi.variant() not in VARIANTS.values():
    raise ImportError(
        f"scenes.plugins: received Mitsuba's variant {mi.variant()!r}; allowed, to be set before it: "
        + ", ".join(sorted(VARIANTS.values()))
    )

from . import bsdf, pinhole

TYPES = {"frustrated_tir": mi.ObjectType.BSDF, "tsis_pinhole": mi.ObjectType.Sensor}
"""What each plugin is, by its name in a scene file."""

__all__ = ["TYPES", "bsdf", "pinhole"]
