"""A finished layout study in a folder, from the made-up pictures of `test_lamps`: no light is computed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from test_lamps import NAMES, NOISE, PRIOR, REFERENCE, TRUTH, fields, picture, slopes_of
from test_simulate import small

import fem
from estimation.information import bound, inform
from twin import explore_leds
from twin.evaluate import Evaluation, Judged, Layout, Protocol
from twin.explored import write_infeasible, write_trial
from twin.forward import Unknown
from twin.objectives import BOUNDS
from twin.report import write_json

STUDY = """
kind = "layout"
name = "{name}"
question = "How many LEDs, and <how bright>?"
description = "Made up & not <b>real</b>."
constraints = ["led_power_W <= 0.2"]
[fields]
"leds.*.flux_W" = [0.004, 0.05]
"protocol.frames" = {{choices = [1, 16]}}
"layout.arrangement" = {{choices = ["around", "one </script><side>"]}}
[objectives]
bound_modulus_kPa = "minimize"
led_power_W = "minimize"
[search]
method = "latin"
trials = 24
"""


def evaluation(flux: float, frames: int, side: str) -> Evaluation:
    """What such LEDs see of two bumps."""
    intensity = flux / 0.01 * (np.ones(4) if side == "around" else np.array([2.0, 0.2, 0.2, 0.2]))
    noises = replace(NOISE, frames=9 * frames), replace(REFERENCE, frames=9 * max(frames, 16))
    judged = []
    for size, depth in ((9.0, 5.0), (7.0, 8.0)):
        truth = TRUTH + np.array([size - 9.0, depth - 5.0, 0, 0, 0, 0])
        mean = picture(truth, intensity)
        slopes = slopes_of(lambda theta, at=truth: picture(theta - TRUTH + at, intensity))
        told = inform(NAMES, [(slopes[:, k], mean[k], noises[k]) for k in (0, 1)], PRIOR)
        sd = dict(zip(NAMES, map(float, bound(told).sd), strict=True))
        share = intensity[:, None, None]
        layers = share * fields(truth, 24)
        by_layer = share * slopes_of(lambda theta, at=truth: fields(theta - TRUTH + at, 24))
        ball = fem.Inclusion(size, depth, 60.0)
        judged.append(Judged(ball, mean, layers, NAMES, slopes, by_layer, told, sd))
    found = {
        name: float(np.sqrt(np.mean([one.sd[unknown] ** 2 for one in judged])))
        for name, unknown in BOUNDS.items()
    }
    found |= {"led_power_W": 4 * flux, "snr": 10 * np.sqrt(frames * flux)}
    found |= {"detection_depth_mm": 9 + 40 * flux}
    design = small()
    design = replace(design, leds=tuple(replace(led, flux_W=flux) for led in design.leds))
    unknowns = tuple(Unknown(name, float(sd)) for name, sd in zip(NAMES, PRIOR, strict=True))
    seconds = {"mechanics": 0.5, "light": 2.0, "information": 0.1}
    layout = Layout(design, Protocol((2.0,), frames=frames), {})
    return Evaluation(layout, unknowns, tuple(judged), found, seconds, 9.0, design)


def write_study(folder: Path, trials: int = 24, name: str = "leds") -> Path:
    """Write the folder of a study; the last two layouts could not be."""
    folder.mkdir(parents=True)
    (folder / "study.toml").write_text(STUDY.format(name=name), encoding="utf-8")
    base = evaluation(0.01, 1, "around")
    write_trial(folder / "baseline", base, {}, None)
    write_json(folder / "baseline" / explore_leds.FILE, explore_leds.findings(base))
    rng = np.random.default_rng(4)
    for number in range(trials):
        flux, frames = float(np.exp(rng.uniform(np.log(0.004), np.log(0.06)))), int(rng.choice([1, 16]))
        side = str(rng.choice(["around", "one </script><side>"]))
        values: dict[str, Any] = {
            "leds.*.flux_W": flux,
            "protocol.frames": frames,
            "layout.arrangement": side,
        }
        place = folder / "trials" / f"{number:04d}"
        if number >= trials - 2:
            write_infeasible(place, "leds.0.z_mm: received 9 <mm>; allowed: below the rim", values, number)
        else:
            write_trial(place, evaluation(flux, frames, side), values, number)
    return folder
