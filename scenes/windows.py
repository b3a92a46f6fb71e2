"""Windows in painted walls, before LEDs in air: where light comes in, and the paint leaves off."""

from __future__ import annotations

from collections.abc import Iterator

import drjit as dr
import mitsuba as mi

from .build import led_frame
from .faces import WALL, Meeting
from .sensor import Sensor


def painted(sensor: Sensor, met: Meeting, active: mi.Bool) -> mi.Bool:
    """Where walls are painted: all over, but for the windows before LEDs in air."""
    found = active & (met.kind == WALL)
    for _, window in _windows(sensor, met):
        found = found & ~window
    return found


def by_own_window(sensor: Sensor, number: mi.UInt32, met: Meeting) -> mi.Bool:
    """Where light of these LEDs may enter that `direct` gathers: in painted walls, by its own window."""
    if sensor.guide.walls == "polished":
        return mi.Bool(True)
    found = mi.Bool(False)
    for k, window in _windows(sensor, met):
        found = found | ((number == k) & window)
    return found


def _windows(sensor: Sensor, met: Meeting) -> Iterator[tuple[int, mi.Bool]]:
    """Numbers of the LEDs beside the guide in air, and what is within their windows."""
    for k, led in enumerate(sensor.leds):
        if led.coupling == "air" and led.side != "below":
            centre, axis, _ = led_frame(led, sensor.guide.width_mm / 2)
            middle = mi.Point3f(*(centre + led.gap_mm * axis).tolist())
            yield k, dr.squared_norm(met.p - middle) <= led.window_mm**2
