"""A flow against the posterior in closed form: linear pictures, normal noise, two parameters."""

import numpy as np
import pytest
import torch

from estimation.posterior import Simulated, Training, restored, train

SLOPES = np.array([[6.0, 2.0, -1.0, 0.5], [1.0, 4.0, 3.0, -2.0]], np.float32)
torch.set_num_threads(1)
TINY = {"width": 64, "depth": 2, "context": 16}


def linear(n: int = 3000, noise: float = 1.0) -> Simulated:
    rng = np.random.default_rng(0)
    unit = rng.random((n, 2)).astype(np.float32)
    features = (10.0 * (unit - 0.5)) @ SLOPES
    draws = noise * rng.standard_normal((n, 4, 4)).astype(np.float32)
    none = np.zeros((n, 1, 4), np.float32)
    return Simulated(unit, features, np.zeros_like(features), draws, none, none, np.zeros((0, 4), np.float32))


@pytest.fixture(scope="module")
def trained() -> torch.nn.Module:
    told = linear()
    training = Training.begin(told, 0, **TINY)
    return restored(training.network.size, train(training, told, steps=4000, batch=256))


@pytest.mark.slow
@pytest.mark.parametrize("frames", [1, 16])
def test_widths_are_those_of_the_closed_form(trained, frames):
    covariance = np.linalg.inv(100.0 * SLOPES @ SLOPES.T * frames)
    rng = np.random.default_rng(1)
    unit = 0.2 + 0.6 * rng.random((200, 2))
    seen = 10.0 * (unit - 0.5) @ SLOPES + rng.standard_normal((200, 4)) / np.sqrt(frames)
    drawn = trained.sample(seen.astype(np.float32), frames, 800, 0)
    away = (drawn.mean(axis=1) - unit) / np.sqrt(np.diag(covariance))
    assert np.all(np.abs(np.sqrt((away**2).mean(axis=0)) - 1.0) < 0.3)
    # of what intervals are made; a variance is that of the flow's far tails, after so short a training
    low, high = np.percentile(drawn, [15.87, 84.13], axis=1)
    spread = 0.5 * np.sqrt(((high - low) ** 2).mean(axis=0) / np.diag(covariance))
    assert np.all(np.abs(spread - 1.0) < 0.15)


@pytest.mark.slow
def test_intervals_cover(trained):
    rng = np.random.default_rng(2)
    unit = rng.random((600, 2))
    seen = 10.0 * (unit - 0.5) @ SLOPES + rng.standard_normal((600, 4))
    drawn = trained.sample(seen.astype(np.float32), 1, 500, 0)
    low, high = np.percentile(drawn, [5.0, 95.0], axis=1)
    assert np.all(np.abs(((unit >= low) & (unit <= high)).mean(axis=0) - 0.9) < 0.06)


@pytest.mark.slow
def test_nothing_there_is_told(trained):
    rng = np.random.default_rng(3)
    noise = rng.standard_normal((300, 4)).astype(np.float32)
    far = (np.array([4.0, -4.0]) @ SLOPES + noise).astype(np.float32)
    assert trained.present(far, 1).min() > 0.9
    assert np.median(trained.present(noise, 1)) < 0.5


def test_stopped_and_gone_on_with_is_as_if_never_stopped():
    told = linear(200)
    whole = Training.begin(told, 4, **TINY)
    wanted = train(whole, told, steps=40, batch=32, every=20)
    first = Training.begin(told, 4, **TINY)
    kept: list[tuple[dict, dict, dict]] = []

    def keep(best: dict) -> None:
        kept.append((first.state(), {"step": first.step, "best": first.best}, best))
        if len(kept) == 1:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train(first, told, steps=40, batch=32, every=20, keep=keep)
    state, said, best = kept[0]
    again = Training.begin(told, 4, **TINY)
    again.restore(state, said)
    found = train(again, told, steps=40, batch=32, every=20, best=best)
    assert all(torch.equal(wanted[name], found[name]) for name in wanted)


def test_another_networks_state_is_refused():
    state = Training.begin(linear(100), 0, **TINY).network.state_dict()
    with pytest.raises(ValueError, match="network: received another"):
        restored({"k": 5, "p": 2, **TINY}, state)


def test_errors_of_the_model_have_their_covariance_and_are_never_the_same() -> None:
    rng = np.random.default_rng(3)
    error = (rng.standard_normal((60, 4)) @ np.diag([3.0, 1.0, 0.3, 2.0])).astype(np.float32)
    told = linear(50, noise=0.0)
    many = Simulated(*(getattr(told, name) for name in list(vars(told))[:-1]), error)
    rows = np.zeros(40_000, int)
    drawn = many.batch(rows, rng, np.ones(len(rows), np.float32), empty=True)
    expected = error.T @ error / len(error)
    assert np.cov(drawn.T) == pytest.approx(expected, abs=0.04 * float(np.trace(expected)))
    assert len(np.unique(drawn.round(5), axis=0)) == len(drawn)
