"""Both kinds of light in Mitsuba's polarised variant, which takes a process of its own.

    python tests/polarised_process.py CASE PASSES PATHS

Prints a JSON line: per quantity the error of the unpolarised model, per cent, and its standard error from
independent passes.
"""

from __future__ import annotations

import dataclasses
import json
import sys

import numpy as np
from sensors import HALF_MM, bump, domed, paper_sensor

from scenes import backend, surface
from scenes.sensor import Sensor
from scenes.skin import Sheet

COARSE = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
BLOB, BACKGROUND = (slice(26, 35), slice(44, 52)), (slice(26, 35), slice(17, 25))
BESIDE = (slice(26, 35), slice(0, 8))  # 2 mm before the LED at -x
SPOT = slice(42, 58)  # 4 mm of the contact surface, in cells


def sensor(case: str) -> Sensor:
    """Of a case, "COUPLING[, WHAT]": how LEDs are coupled, and what differs from the paper's sensor."""
    coupling, _, what = case.partition(", ")
    base = paper_sensor(coupling if coupling == "embedded" else "air", **COARSE)
    if what == "black walls":
        return dataclasses.replace(base, guide=dataclasses.replace(base.guide, walls="absorbing"))
    if what == "tissue 1.36":
        return dataclasses.replace(base, tissue=dataclasses.replace(base.tissue, refractive_index=1.36))
    sheet = Sheet(thickness_mm=0.5, modulus_kPa=100.0)
    skins = {
        "full contact": {"contact": "full"},
        "water film": {"gap_index": 1.33},
        "sheet": {"sheet": sheet},
    }
    return dataclasses.replace(base, skin=dataclasses.replace(base.skin, **skins.get(what, {})))


def main() -> None:
    case, passes, paths = sys.argv[1], int(sys.argv[2]), int(sys.argv[3])
    variant = backend.use_polarised("cpu")
    from scenes.polarised import Polarised

    press = domed() if case.startswith("domed") else surface.resample(bump(), 2 * HALF_MM)
    both = Polarised(sensor(case), press)
    off: dict[str, list[float]] = {}
    sums = []
    for seed in range(passes):
        found = both.compare(paths, seed + 1)
        picture, faces, entered = (
            one.sum(axis=1, dtype=np.float64) for one in (found.radiance, found.through, found.entered)
        )
        sums.append(found.sinks.sum(axis=(1, 2)) / sum(led.flux_W for led in both.sensor.leds))
        for name, (plain, polarised) in {
            "blob": picture[:, *BLOB].mean(axis=(1, 2)),
            "background": picture[:, *BACKGROUND].mean(axis=(1, 2)),
            "beside an LED": picture[:, *BESIDE].mean(axis=(1, 2)),
            "picture": picture.mean(axis=(1, 2)),
            "blob over background": picture[:, *BLOB].mean(axis=(1, 2))
            / picture[:, *BACKGROUND].mean(axis=(1, 2)),
            "faces before the camera, blob": faces[:, *BLOB].mean(axis=(1, 2)),
            "faces before the camera, corner": faces[:, :6, :6].mean(axis=(1, 2)),
            "entering, under the blob": entered[:, SPOT, SPOT].sum(axis=(1, 2)),
            "entering, all": entered.sum(axis=(1, 2)),
            "entering, 2.5 mm beside the LED at -y": entered[:, :10].sum(axis=(1, 2)),
        }.items():
            off.setdefault(name, []).append(float(100.0 * (plain / polarised - 1.0)))
    table = {name: (np.mean(one), np.std(one, ddof=1) / np.sqrt(passes)) for name, one in off.items()}
    print(json.dumps({"variant": variant, "sinks": np.mean(sums, axis=0).tolist(), "off": table}))


if __name__ == "__main__":
    main()
