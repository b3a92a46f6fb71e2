"""Light gathered pixel by pixel before tissue that gives it back where it came in, against the same paths
followed ray by ray."""

from __future__ import annotations

import numpy as np
import pytest
from sensors import bump, dense, paper_sensor

COARSE = {"columns": 24, "rows": 16, "pixel_um": (268.8, 301.35)}


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_gathered_light_is_what_rays_count_in_the_same_pixels(variant: str, coupling: str) -> None:
    """All of it within 0.5 %; each pixel within its noise, and that falls."""
    from scenes import Renderer, exact, local, surface, transport
    from scenes.build import put_surface

    sensor = dense(paper_sensor(coupling, **COARSE))  # type: ignore[arg-type]
    renderer = Renderer(sensor, "cpu")
    put_surface(renderer.scene, sensor, surface.resample(bump(), sensor.guide.width_mm))
    ground = transport.survey(renderer.scene, sensor)
    parts = (renderer.scene, sensor, renderer.table, renderer.rays)
    straight = local.straight(*parts)
    assert straight.shape == (4, 16, 24) and (straight >= 0.0).all()

    def pictures(**how: object) -> np.ndarray:
        runs = [exact.exact(*parts, ground, 2**15, seed, local=True, **how)[0] for seed in range(6)]  # type: ignore[arg-type]
        return np.sum(runs, axis=1)[:, 2:-2, 3:-3]

    followed, gathered = pictures(), pictures(gathered=straight)
    means = [runs.mean(axis=(1, 2)) for runs in (followed, gathered)]
    error = np.hypot(*(mean.std(ddof=1) / np.sqrt(len(mean)) for mean in means)) / means[0].mean()
    off = means[1].mean() / means[0].mean() - 1.0
    noise = [np.sqrt(runs.var(axis=0, ddof=1).mean()) for runs in (followed, gathered)]
    print(f"{coupling}: {100 * off:+.2f} ± {100 * error:.2f} %, noise {noise[0] / noise[1]:.1f} times less")
    assert error < 6e-3
    assert abs(off) < 5e-3 + 2.5 * error
    each = np.sqrt((followed.var(axis=0, ddof=1) + gathered.var(axis=0, ddof=1)) / len(followed))
    far = np.abs(followed.mean(axis=0) - gathered.mean(axis=0)) / np.maximum(each, 1e-30)
    assert np.sqrt(np.mean(far**2)) < 1.6  # of 6 runs each: Student's t with 10 degrees has 1.1
    assert noise[1] < noise[0] / 1.3


def test_only_local_light_takes_it(variant: str) -> None:
    from scenes import Renderer, exact

    sensor = paper_sensor("air", **COARSE)  # type: ignore[arg-type]
    renderer = Renderer(sensor, "cpu")
    parts = (renderer.scene, sensor, renderer.table, renderer.rays, np.zeros((200, 200)))
    with pytest.raises(ValueError, match="gathered: received some without local"):
        exact.exact(*parts, 2**8, 0, gathered=np.zeros((4, 16, 24)))
