"""What a layout's LEDs are worth one by one, from light that an exploration kept: nothing is rendered again.

The baseline's and the best layout's findings stand in leds.json of their folders.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin import lamp_settings, lamps
from twin.evaluate import Bench, Evaluation, evaluate
from twin.report import write_json

if TYPE_CHECKING:
    from scenes.led import Led

Floats = NDArray[np.float64]

FILE = "leds.json"
TOLERANCE = 0.1
"""Flux of LEDs of one bin, over the nominal one, less 1."""
_MOST_LEDS = 16


def findings(evaluation: Evaluation) -> dict[str, Any] | None:
    """Return settings of the LEDs and what each is worth; None where there is nothing to re-weight by, or an
    LED that has failed.

    Bounds are root mean squares over the inclusions, of `lamps.WANTED` (those that are unknown), in order.
    """
    names = tuple(name for name in lamps.WANTED if name in evaluation.judged[0].names)
    if any(one.layer_jacobian is None for one in evaluation.judged) or not names:
        return None
    if set(evaluation.judged[0].names) <= set(lamps.WANTED):  # re-weighting wants a nuisance
        return None
    given = lamps.lamps_of(evaluation)
    count = given[0].count
    if count > _MOST_LEDS or not given[0].flux_W.all():
        return None
    ones = np.ones(count)
    best = lamp_settings.optimise(given, names)
    rows = [_row("as designed", best.before, names), _row("best at the same power", best.best, names)]
    if count > 1:
        turns = lamp_settings.optimise(given, names, sequential=True).best
        rows.append(_row(f"one after the other, {count} pictures", turns, names))
        same = _rms(lamps.bounds(given, ones, names, times=count))[0]
        rows.append({**rows[0], "words": f"all at once, {count} times the exposures", "sd": same})
    dark = _rms(lamp_settings.failures(given, ones, names)) if count > 1 else np.zeros((0, len(names)))
    spread = np.quantile(_rms(lamp_settings.binning(given, ones, TOLERANCE, names)), [0.05, 0.95], axis=0)
    places = [_place(led) for led in evaluation.layout.design.leds]
    return {
        "names": names,
        "leds": places,
        "settings": rows,
        "dark": dark,
        "tolerance": TOLERANCE,
        "binning": spread,
    }


def _place(led: Led) -> str:
    """Where an LED is, in words."""
    if led.side == "below":
        return f"below at ({led.x_mm:.3g}, {led.y_mm:.3g}) mm"
    return f"{led.side} at {led.along_mm:.3g} mm, {led.coupling}"


def _row(words: str, setting: lamp_settings.Setting, names: tuple[str, ...]) -> dict[str, Any]:
    return {
        "words": words,
        "intensity": setting.intensity,
        "power_W": setting.power_W,
        "full": setting.full,
        "sd": _rms(setting.sd[None])[0],
    }


def _rms(sd: Floats) -> Floats:
    """Root mean square over inclusions, (s, w) of (s, inclusions, w)."""
    return np.asarray(np.sqrt((sd**2).mean(axis=1)))


def read(folder: Path) -> dict[str, Any] | None:
    """Return the findings of a layout's folder, None where there are none."""
    try:
        found = json.loads((folder / FILE).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return found if isinstance(found, dict) else None


def find(exploration_folder: Path, trials: list[tuple[Path, dict[str, Any] | None]]) -> None:
    """Write leds.json into folders of layouts that have none: (folder, values; None for the baseline).

    Light and contact come from what the exploration kept, and are computed again where that is gone.
    """
    from twin import explore, layout_fields, presses
    from twin.kept import Kept

    wanted = [(place, values) for place, values in trials if not (place / FILE).exists()]
    if not wanted or not (exploration_folder / explore.HEAD).is_file():
        return
    exploration = explore.reopened(exploration_folder)
    study, bench = exploration.study, Bench(Kept(exploration_folder / explore.KEPT))
    emulator = None
    if exploration.emulator is not None:
        emulator = presses.emulator_of(exploration.design, exploration.emulator)
    for place, values in wanted:
        layout = (
            layout_fields.base(study, exploration.design)
            if values is None
            else layout_fields.layout(study, exploration.design, values)
        )
        found = evaluate(
            layout,
            study.balls(),
            study.unknown(),
            emulator=emulator,
            quality=study.quality,
            seed=study.seed,
            fill=study.exposure_fill,
            detection=False,
            bench=bench,
        )
        told = findings(found)
        if told is not None:
            write_json(place / FILE, told)
