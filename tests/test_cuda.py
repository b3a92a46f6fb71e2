"""What a CUDA GPU computes is what the CPU does. Skipped where there is none."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from estimation.posterior import Training, _loss, device_of, restored, train
from scenes import backend

HERE = Path(__file__).parent
PROGRAM = HERE / "light_process.py"
light = pytest.mark.skipif(
    backend._cuda_fault() != "", reason="this machine has no CUDA GPU that traces rays"
)
learning = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA GPU")


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, np.ndarray]]:
    found = {}
    for device in ("cpu", "cuda"):
        place = tmp_path_factory.mktemp(device) / "pictures.npz"
        path = os.pathsep.join([str(HERE), str(HERE.parent), os.environ.get("PYTHONPATH", "")])
        environment = {**os.environ, "PYTHONPATH": path}
        subprocess.run([sys.executable, PROGRAM, device, place], env=environment, check=True)
        with np.load(place, allow_pickle=False) as file:
            found[device] = dict(file)
    return found


@light
@pytest.mark.parametrize("coupling", ["air", "embedded"])
@pytest.mark.parametrize("quality", ["preview", "standard"])
def test_pictures_are_the_cpus(both, coupling, quality):
    """The same paths, but for those that rounding sends another way."""
    cpu, cuda = (both[device][f"{coupling}.{quality}"].astype(float) for device in ("cpu", "cuda"))
    off = np.sqrt(np.mean((cuda - cpu) ** 2)) / cpu.mean()
    noise = both["cpu"][f"{coupling}.{quality}.noise"]
    print(f"\n{coupling}, {quality}: {100 * off:.4f} % rms of a pixel, noise {noise:.2f} %")
    assert off < 1e-3


@light
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_every_ray_followed_is_the_same_light(both, coupling):
    cpu, cuda = (both[device][f"{coupling}.reference"].astype(float) for device in ("cpu", "cuda"))
    noise = 0.01 * both["cpu"][f"{coupling}.reference.noise"] / np.sqrt(cpu[0].size)
    print(f"\n{coupling}: {100 * (cuda.mean() / cpu.mean() - 1):+.3f} %, noise {100 * noise:.3f} %")
    assert cuda.mean() == pytest.approx(cpu.mean(), rel=4.0 * noise)


@light
@pytest.mark.parametrize("coupling", ["air", "embedded"])
def test_the_same_seed_gives_the_same_bytes(both, coupling):
    assert np.array_equal(both["cuda"][f"{coupling}.preview"], both["cuda"][f"{coupling}.again"])


@learning
def test_a_network_is_trained_as_on_the_cpu_and_goes_on_there():
    """The same losses at the start, and a training that began on the GPU ends on the CPU."""
    from test_posterior import TINY, linear

    told, rows = linear(400), np.arange(200)
    made = {device: Training.begin(told, 4, device, **TINY) for device in ("cpu", "cuda")}
    loss = {d: float(_loss(one.network, told, rows, np.random.default_rng(1))) for d, one in made.items()}
    assert loss["cuda"] == pytest.approx(loss["cpu"], rel=1e-4)
    kept: list[tuple] = []
    one = made["cuda"]

    def keep(best: dict) -> None:
        kept.append((one.state(), {"step": one.step, "best": one.best}, best))

    train(one, told, steps=40, batch=64, every=20, keep=keep)
    state, said, best = kept[0]
    assert all(value.device.type == "cpu" for value in (*state.values(), *best.values()))
    again = Training.begin(told, 4, "cpu", **TINY)
    again.restore(state, said)
    ended = train(again, told, steps=40, batch=64, every=20, best=best)
    drawn = restored(again.network.size, ended).sample(told.present[:5], 1.0, 10, 0)
    assert np.isfinite(drawn).all()


def test_a_device_that_is_not_there_is_refused_in_one_line():
    assert device_of("cpu") == "cpu"
    assert device_of("auto") == ("cuda" if torch.cuda.is_available() else "cpu")
    with pytest.raises(ValueError, match=r"^device: received 'tpu'; allowed: 'auto', 'cpu', 'cuda'$"):
        device_of("tpu")


@pytest.mark.skipif(torch.cuda.is_available(), reason="torch sees a CUDA GPU")
def test_a_gpu_that_is_not_there_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"^device: received 'cuda', but torch .* sees no GPU; allowed here"):
        device_of("cuda")
