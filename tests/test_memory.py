"""Memory of one process over many frames (minutes)."""

from __future__ import annotations

import dataclasses
import resource
from pathlib import Path

import numpy as np
import pytest
from sensors import bump
from test_simulate import small

FRAMES, SETTLED = 1000, 100
LATEST = 30  # readings whose mean is taken: the heap breathes by 5 % from frame to frame


def resident_MiB() -> float:
    """Resident memory of this process, from Linux's own books."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 2**20


@pytest.mark.slow
@pytest.mark.timeout(7200)
@pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="resident memory is read from /proc")
def test_a_thousand_frames_grow_memory_by_less_than_a_twentieth(variant: str, tmp_path: Path) -> None:
    """From surface to counts on disk, every frame of another press and seed; few light paths, one LED."""
    from scenes import SpectralRenderer, exr
    from twin.exposure import take, take_reference

    whole = small()
    design = dataclasses.replace(whole, leds=whole.leds[:1])
    renderer = SpectralRenderer(design.sensor(), count=1, at=design.sensor, device="cpu")
    pressed, after, resident = bump(), {}, []
    still = np.array(pressed.point_data["displacement"])
    for number in range(1, FRAMES + 1):
        pressed.point_data["displacement"] = (1.0 + 0.3 * np.sin(number)) * still
        lit = renderer.render(pressed, quality="preview", seed=number, samples=2**8)
        image = take(design, lit.radiance, number, 1.0)
        tared = image - take_reference(design, lit.radiance, number, 1.0)
        exr.write_png(tmp_path / "image.png", image)
        assert np.isfinite(tared).all()
        resident.append(resident_MiB())
        if number in (SETTLED, FRAMES // 2, FRAMES):
            after[number] = float(np.mean(resident[-LATEST:]))
            print(f"{number} frames: {after[number]:.1f} MiB", flush=True)
    growth = after[FRAMES] / after[SETTLED] - 1.0
    print(f"growth {100 * growth:+.2f} %")
    assert growth < 0.05
