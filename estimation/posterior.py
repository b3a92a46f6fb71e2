"""Posterior of a few bounded parameters from features: a normalising flow, trained on simulated pairs.

Neural posterior estimation (Papamakarios and Murray 2016; [papamakarios2016]): the flow that makes the true
parameters of simulated pictures most likely is the posterior under the prior that they were drawn from.
Spline flow after Durkan et al. 2019 ([durkan2019]), from the package zuko. Beside it, a small network gives
the probability that there is an inclusion at all.

Features come in noise-free parts, so that every batch has noise, brightness and model error of its own.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import zuko
from numpy.typing import NDArray
from torch import Tensor, nn

Single = NDArray[np.float32]

_EDGE = 1e-3  # of a range, so that its ends are finite on the flow's scale
_SCALE = 1.8  # standard deviation of the logistic distribution: what a uniform prior is there
_LARGEST = 1024  # of a network from a file, so that none takes all memory
MOST_FRAMES = 128
REFERENCE_FRAMES = 16


@dataclass(frozen=True)
class Simulated:
    """Specimens as features (see `estimation.features`), n of them.

    Attributes
    ----------
    unit : (n, p) parameters, 0 to 1 over their ranges.
    present, absent : (n, k) features without noise, with the inclusion and of the same press without.
    noise, reference_noise : (n, draws, k) features of noise of one exposure of the pictures, and of one of
        the references.
    stays : (n, draws, k) features of noise that further exposures do not average out.
    error : (m, k) features of errors of the forward model; what is added has their covariance and sizes.
    """

    unit: Single
    present: Single
    absent: Single
    noise: Single
    reference_noise: Single
    stays: Single
    error: Single

    def batch(
        self, rows: NDArray[np.integer], rng: np.random.Generator, frames: NDArray[np.floating], empty: bool
    ) -> Single:
        """Noisy features (len(rows), k) of pictures that are means of ``frames`` exposures each."""
        found = (self.absent if empty else self.present)[rows].copy()
        references = np.maximum(frames, REFERENCE_FRAMES)
        once = np.ones_like(frames)
        pools = ((self.noise, frames), (self.reference_noise, references), (self.stays, once))
        for pool, count in pools:
            draw = rng.integers(pool.shape[1], size=len(rows))
            sign = _signs(rng, len(rows)) / np.sqrt(count, dtype=np.float32)
            found += pool[rows, draw] * sign[:, None].astype(np.float32)
        if len(self.error):
            # mixtures of all, as large as any: a few hundred themselves would be learned by heart
            mixture = rng.standard_normal((len(rows), len(self.error)), np.float32)
            size = np.sqrt((self.error**2).sum(axis=1))
            scale = size[rng.integers(len(size), size=len(rows))] / max(np.sqrt((size**2).mean()), 1e-12)
            found += mixture @ self.error * (scale / np.sqrt(len(size)))[:, None].astype(np.float32)
        return found


def _signs(rng: np.random.Generator, n: int) -> Single:
    return np.asarray(2.0 * rng.integers(2, size=n) - 1.0, np.float32)


class _Body(nn.Module):
    """Features and exposures to a context."""

    def __init__(self, k: int, width: int, depth: int, out: int) -> None:
        super().__init__()
        self.first = nn.Linear(2 * k + 1, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.SiLU(), nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
            for _ in range(depth)
        )
        self.last = nn.Sequential(nn.SiLU(), nn.Linear(width, out))

    def forward(self, x: Tensor) -> Tensor:
        h = self.first(x)
        for block in self.blocks:
            h = h + block(h)
        out: Tensor = self.last(h)
        return out


class Posterior(nn.Module):
    """What is known of p parameters, 0 to 1 each, and whether there is anything, from k features."""

    spread: Tensor

    def __init__(self, k: int, p: int, *, width: int = 256, depth: int = 3, context: int = 64) -> None:
        """Make an untrained network; its size is `size`."""
        super().__init__()
        self.size = {"k": k, "p": p, "width": width, "depth": depth, "context": context}
        self.register_buffer("spread", torch.ones(k))
        self.body = _Body(k, width, depth, context)
        self.flow = zuko.flows.NSF(p, context, bins=8, transforms=3, hidden_features=(128, 128))
        self.presence = _Body(k, width // 2, 2, 1)

    def inputs(self, features: Tensor, frames: Tensor) -> Tensor:
        """Features over their spread, and squashed over the noise, so that neither is lost; (n, 2 k + 1)."""
        parts = [features / self.spread, torch.asinh(features / 3.0) / 3.0, torch.log10(frames)[:, None]]
        return torch.cat(parts, dim=1)

    def loss(self, unit: Tensor, features: Tensor, frames: Tensor) -> Tensor:
        """Mean of minus the log probability of the parameters, on the flow's scale."""
        found: Tensor = self.flow(self.body(self.inputs(features, frames))).log_prob(_stretched(unit))
        return -found.mean()

    def presence_logit(self, features: Tensor, frames: Tensor) -> Tensor:
        """Log odds that there is an inclusion, where half of all specimens have one, (n,)."""
        found: Tensor = self.presence(self.inputs(features, frames))[:, 0]
        return found

    @torch.no_grad()
    def sample(self, features: Single, frames: float, count: int, seed: int) -> NDArray[np.float64]:
        """Samples (n, count, p), 0 to 1, of the posteriors of features (n, k)."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            x = torch.from_numpy(np.atleast_2d(features))
            context = self.body(self.inputs(x, torch.full((len(x),), float(frames))))
            drawn = self.flow(context).sample((count,))
        return np.asarray(_squeezed(drawn).transpose(0, 1).double().numpy())

    @torch.no_grad()
    def present(self, features: Single, frames: float) -> NDArray[np.float64]:
        """Probability that there is an inclusion, (n,), where half of all specimens have one."""
        x = torch.from_numpy(np.atleast_2d(features))
        logit = self.presence_logit(x, torch.full((len(x),), float(frames)))
        return np.asarray(torch.sigmoid(logit).double().numpy())


def _stretched(unit: Tensor) -> Tensor:
    inner = _EDGE + (1.0 - 2.0 * _EDGE) * unit
    return torch.logit(inner) / _SCALE


def _squeezed(flow: Tensor) -> Tensor:
    return ((torch.sigmoid(flow * _SCALE) - _EDGE) / (1.0 - 2.0 * _EDGE)).clamp(0.0, 1.0)


class DeviceError(ValueError):
    """Torch cannot run on what was asked for; the message is one line."""


def device_of(name: str) -> str:
    """Return "cpu" or "cuda", for these or "auto": a GPU where torch sees one.

    Raises `DeviceError` for another name, and for "cuda" without a GPU.
    """
    if name not in ("auto", "cpu", "cuda"):
        raise DeviceError(f"device: received {name!r}; allowed: 'auto', 'cpu', 'cuda'")
    there = torch.cuda.is_available()
    if name == "cuda" and not there:
        built = torch.version.cuda or "the CPU"
        raise DeviceError(
            f"device: received 'cuda', but torch {torch.__version__}, built for {built}, sees no GPU; "
            "allowed here: 'auto', 'cpu'"
        )
    return "cuda" if there and name != "cpu" else "cpu"


@dataclass
class Training:
    """A posterior in training, which can be stopped and go on, on another device, too."""

    network: Posterior
    optimiser: torch.optim.Optimizer
    step: int = 0
    best: float = math.inf

    @staticmethod
    def begin(simulated: Simulated, seed: int, device: str = "cpu", **size: int) -> Training:
        """Make a network for these features, on a device of `device_of`; it begins alike on all."""
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(seed)
            network = Posterior(simulated.present.shape[1], simulated.unit.shape[1], **size)
        network.spread.copy_(torch.from_numpy(simulated.present.std(axis=0) + np.float32(1.0)))
        network.to(device)
        return Training(network, torch.optim.AdamW(network.parameters(), lr=1e-3, weight_decay=1e-4))

    def state(self) -> dict[str, Tensor]:
        """Return all tensors that going on needs, by name, in the CPU's memory."""
        found = {f"network.{name}": value for name, value in self.network.state_dict().items()}
        for number, one in self.optimiser.state_dict()["state"].items():
            found |= {f"optimiser.{number}.{name}": value for name, value in one.items()}
        return _kept(found)

    def restore(self, state: Mapping[str, Tensor], said: Mapping[str, Any]) -> None:
        """Go back to `state`, at the step and best loss that ``said`` tells."""
        parts = {n.removeprefix("network."): v for n, v in state.items() if n.startswith("network.")}
        self.network.load_state_dict(parts)
        whole = self.optimiser.state_dict()
        slots: dict[int, dict[str, Tensor]] = {}
        for name, value in state.items():
            if name.startswith("optimiser."):
                _, number, what = name.split(".")
                slots.setdefault(int(number), {})[what] = value
        self.optimiser.load_state_dict({**whole, "state": slots})
        self.step, self.best = int(said["step"]), float(said["best"])


def train(
    training: Training,
    simulated: Simulated,
    *,
    steps: int = 12_000,
    batch: int = 512,
    every: int = 250,
    seed: int = 0,
    until: float = math.inf,
    best: dict[str, Tensor] | None = None,
    tell: Callable[[int, float], None] | None = None,
    keep: Callable[[dict[str, Tensor]], None] | None = None,
) -> dict[str, Tensor]:
    """Go on to ``steps``, or till the clock (`time.monotonic`) says ``until``; return the best state.

    Every step's random numbers are children of (seed, step), so that one that was stopped comes out as if it
    had not been. The learning rate falls as half a cosine wave, in time where that is short. One specimen in
    twenty is kept aside, and tells which state is best; ``best`` is the best before. ``keep`` takes it
    ``every`` so many steps.
    """
    n = len(simulated.unit)
    aside, rest = np.arange(0, n, 20), np.setdiff1d(np.arange(n), np.arange(0, n, 20))
    network = training.network
    best = best or _kept(network.state_dict())
    began = time.monotonic()
    while training.step < steps and (now := time.monotonic()) < until:
        share = max(training.step / steps, (now - began) / (until - began))
        rate = 1e-3 * 0.5 * (1.0 + math.cos(math.pi * share)) + 1e-6
        for group in training.optimiser.param_groups:
            group["lr"] = rate
        rng = np.random.default_rng([seed, training.step])
        training.optimiser.zero_grad()
        _loss(network, simulated, rng.choice(rest, batch), rng).backward()
        nn.utils.clip_grad_norm_(network.parameters(), 5.0)
        training.optimiser.step()
        training.step += 1
        if training.step % every == 0 or training.step == steps:
            with torch.no_grad():
                rng = np.random.default_rng([seed, 2**31])
                found = float(_loss(network, simulated, np.repeat(aside, 4), rng))
            if found < training.best:
                training.best, best = found, _kept(network.state_dict())
            if keep is not None:
                keep(best)
            if tell is not None:
                tell(training.step, found)
    return best


def _loss(
    network: Posterior, simulated: Simulated, rows: NDArray[np.integer], rng: np.random.Generator
) -> Tensor:
    frames = np.exp(rng.uniform(0.0, math.log(MOST_FRAMES), len(rows))).round().astype(np.float32)
    there, empty = (simulated.batch(rows, rng, frames, empty=empty) for empty in (False, True))
    arrays = (frames, there, empty, simulated.unit[rows])
    told, there, empty, unit = (torch.from_numpy(one).to(network.spread.device) for one in arrays)
    loss = network.loss(unit, there, told)
    logits = torch.cat([network.presence_logit(there, told), -network.presence_logit(empty, told)])
    return loss + nn.functional.softplus(-logits).mean()


def _kept(state: Mapping[str, Tensor]) -> dict[str, Tensor]:
    return {name: value.detach().cpu().clone() for name, value in state.items()}


def restored(size: Mapping[str, Any], state: Mapping[str, Tensor]) -> Posterior:
    """Return the network of this size and state. Raises ValueError if they do not fit."""
    sides = {name: int(value) for name, value in size.items()}
    if not all(1 <= side <= _LARGEST for side in sides.values()):
        raise ValueError(f"network: received {sides}; allowed 1 to {_LARGEST} each")
    network = Posterior(**sides)
    try:
        network.load_state_dict(dict(state))
    except RuntimeError as error:
        raise ValueError(
            f"network: received another than its size says ({str(error).splitlines()[0]})"
        ) from None
    network.eval()
    return network
