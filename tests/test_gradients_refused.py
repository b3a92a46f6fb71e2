"""What `scenes.gradients` cannot differentiate it refuses, in one line, before anything is computed."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import pytest
from sensors import paper_sensor

from scenes.sensor import Lower, Sensor
from scenes.skin import Skin
from scenes.surface import flat

ONE = paper_sensor(columns=16, rows=16, pixel_um=(403.0, 300.0))


def lit_by(**changes: object) -> Sensor:
    """With one LED, changed."""
    return replace(ONE, leds=(replace(ONE.leds[0], **changes),))  # type: ignore[arg-type]


BELOW = replace(lit_by(side="below"), skin=Skin(contact="full"))
PAINTED = replace(lit_by(), guide=replace(ONE.guide, walls="absorbing"))
CROSSED = replace(
    lit_by(coupling="embedded"),
    guide=replace(ONE.guide, lower=(Lower(thickness_mm=5.0, refractive_index=1.5),)),
)


@cache
def _renderer(sensor: Sensor) -> Any:
    from scenes.render import Renderer

    return Renderer(sensor, device="cpu")


@pytest.mark.parametrize(
    ("sensor", "parameter", "says"),
    [
        (BELOW, "leds.power", "allowed: leds.flux_W"),
        (BELOW, "leds.exponent", "allowed: 'power'"),
        (BELOW, "leds.z_mm", "allowed: LEDs at the sides"),
        (PAINTED, "leds.along_mm", "allowed: LEDs at the sides, embedded or before polished walls"),
        (BELOW, "pressure", "where skin.contact is 'rough'"),
        (lit_by(flux_W=0.0), "leds.flux_W", "received flux_W = 0; allowed: more than 0"),
        (CROSSED, "leds.z_mm", "no face between layers crosses an LED's disc"),
    ],
)
def test_what_a_sensor_has_not_is_refused(variant: str, sensor: Sensor, parameter: str, says: str) -> None:
    from scenes.gradients import gradients

    with pytest.raises(ValueError, match=says) as refused:
        gradients(_renderer(sensor), flat(sensor.guide.width_mm, 1.0), [parameter])
    assert "\n" not in str(refused.value)
