"""Pictures on one device, which takes a process of its own: Mitsuba keeps the first variant it was given.

    python tests/light_process.py DEVICE PICTURES.npz
    python tests/light_process.py DEVICE

The first writes small pictures; the second prints a JSON line: seconds that pictures of `tsis` take.
"""

from __future__ import annotations

import json
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from sensors import bump, paper_sensor

COARSE = {"columns": 96, "rows": 61, "pixel_um": (67.2, 78.4)}
PATHS = {"preview": 2**16, "standard": 2**18, "reference": 2**16}
TIMED = {"standard": 2**20, "reference": 2**18}
_REPEATS = 3


def pictures(device: str) -> dict[str, Any]:
    """Radiance and noise, per cent, by coupling and quality; each preview twice."""
    from scenes import Renderer

    found: dict[str, Any] = {}
    for coupling in ("air", "embedded"):
        renderer = Renderer(paper_sensor(coupling, **COARSE), device=device)
        for quality, samples in PATHS.items():
            made = renderer.render(bump(), quality=quality, samples=samples, seed=3)
            found[f"{coupling}.{quality}"] = made.radiance
            found[f"{coupling}.{quality}.noise"] = made.noise_percent
        again = renderer.render(bump(), quality="preview", samples=PATHS["preview"], seed=3)
        found[f"{coupling}.again"] = again.radiance
    return found


def seconds(device: str) -> dict[str, float]:
    """Of pictures of `tsis` at full size, the median after a first one, and of its network's steps."""
    from scenes import Renderer
    from twin import load_design

    renderer = Renderer(load_design("tsis").sensor(), device=device)
    found = {}
    for quality, samples in TIMED.items():
        found[quality] = _timed(lambda q=quality, n=samples: renderer.render(bump(), quality=q, samples=n))
    return found | training(device)


def training(device: str, batch: int = 512, steps: int = 100) -> dict[str, float]:
    """Seconds of a hundred steps of a posterior of the size of that of `tsis`."""
    import torch

    from estimation.posterior import Simulated, Training, train

    rng = np.random.default_rng(1)
    n, k, p = 4000, 96, 5
    parts = [rng.standard_normal(shape).astype(np.float32) for shape in ((n, k), (n, k))]
    parts += [rng.standard_normal((n, 4, k)).astype(np.float32) for _ in range(3)]
    error = rng.standard_normal((480, k)).astype(np.float32)
    told = Simulated(rng.random((n, p)).astype(np.float32), *parts, error)
    made = Training.begin(told, 0, device)
    train(made, told, steps=10, batch=batch)

    def on() -> None:
        train(made, told, steps=made.step + steps, batch=batch)
        if device == "cuda":
            torch.cuda.synchronize()

    return {f"{steps} steps": _timed(on)}


def _timed(work: Callable[[], Any]) -> float:
    work()
    found = []
    for _ in range(_REPEATS):
        start = time.perf_counter()
        work()
        found.append(time.perf_counter() - start)
    return statistics.median(found)


if __name__ == "__main__":
    if len(sys.argv) > 2:
        np.savez(Path(sys.argv[2]), **pictures(sys.argv[1]))
    else:
        print(json.dumps(seconds(sys.argv[1])))
