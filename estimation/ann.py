"""The paper's inversion: a multi-layer network from three scalars to size, depth and modulus.

The paper ([lee2011], section III.D) trains a multi-layered network with the scaled conjugate gradient
algorithm and averages 100 estimates per inclusion; it tells neither layers nor how training ended. Here:
tanh layers and a linear one, inputs and outputs standardised over the samples that a network may see, mean
squared error, training stopped when the loss on a validation split no longer falls, the best weights kept.

Networks are members of a batch: every repeat and every fold of a leave-one-out is trained at once, each by
its own scaled conjugate gradient, as products of (members, samples, units) arrays. The same call gives the
same bytes; a member depends, but for rounding, on the seed, the sample left out and its repeat alone.
Nothing here knows what inputs mean: logarithms, where they help, are the caller's.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from estimation.scg import advance, start

Floats = NDArray[np.float64]

_BLOCK = 400  # members trained together, for the memory


@dataclass(frozen=True)
class Settings:
    """How networks are built and trained.

    Attributes
    ----------
    hidden : units of each tanh layer, first to last.
    validation : share of the samples that stop the training, 0 to 0.5; with 0 it runs for `steps`.
    patience : steps without a lower validation loss after which a member ends.
    steps : at most.
    decay : weight of the mean squared network weight (without biases) in the loss, >= 0.
    """

    hidden: tuple[int, ...] = (10, 10)
    validation: float = 0.15
    patience: int = 50
    steps: int = 1000
    decay: float = 0.0

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden: received {self.hidden!r}; allowed one or more numbers of units >= 1")
        if not 0 <= self.validation <= 0.5:
            raise ValueError(f"validation: received {self.validation!r}; allowed 0 to 0.5")
        if self.patience < 1 or self.steps < 1:
            raise ValueError(f"patience, steps: received {self.patience}, {self.steps}; allowed 1 or more")
        if not 0 <= self.decay < np.inf:
            raise ValueError(f"decay: received {self.decay!r}; allowed a number >= 0")


@dataclass(frozen=True)
class Ensemble:
    """Trained networks, b members from p inputs to q outputs; plain numbers.

    Attributes
    ----------
    sizes : units of every layer, (p, *hidden, q).
    weights : (b, n) float64: layer by layer the matrix (from, to), row by row, then the biases.
    input_mean, input_sd, output_mean, output_sd : (b, p) and (b, q), of what each member was trained on.
    train_loss, validation_loss : (b,) mean squared error of the standardised outputs; NaN where no split.
    steps : (b,) after which the kept weights were reached.
    """

    sizes: tuple[int, ...]
    weights: Floats
    input_mean: Floats
    input_sd: Floats
    output_mean: Floats
    output_sd: Floats
    train_loss: Floats
    validation_loss: Floats
    steps: NDArray[np.int64]

    def rows(self, members: slice) -> Ensemble:
        """Some of the members."""
        return Ensemble(self.sizes, *(getattr(self, field.name)[members] for field in fields(self)[1:]))

    def predict(self, inputs: ArrayLike) -> Floats:
        """Every member's outputs (b, m, q) at inputs (m, p); their mean over b is the estimate."""
        x = np.asarray(inputs, np.float64)
        if x.ndim != 2 or x.shape[1] != self.sizes[0] or not np.isfinite(x).all():
            raise ValueError(f"inputs: received shape {x.shape}; allowed (samples, {self.sizes[0]}), finite")
        scaled = (x - self.input_mean[:, None]) / self.input_sd[:, None]
        with torch.no_grad():
            found = _forward(torch.from_numpy(self.weights), torch.from_numpy(scaled), self.sizes).numpy()
        return np.asarray(found * self.output_sd[:, None] + self.output_mean[:, None])


def train(
    inputs: ArrayLike,
    outputs: ArrayLike,
    *,
    repeats: int = 100,
    seed: int = 0,
    left_out: Sequence[int] | None = None,
    settings: Settings | None = None,
) -> Ensemble:
    """Train `repeats` networks on all samples, or so many for each sample that is left out.

    Parameters
    ----------
    inputs, outputs : (n, p), (n, q) finite; a column that does not vary is left unscaled.
    repeats : networks that differ in first weights and validation split.
    seed : 0 or more.
    left_out : k samples; member f * repeats + r is trained without sample left_out[f].

    Raises
    ------
    ValueError
        If shapes or numbers do not fit, in one line.
    """
    settings = settings or Settings()
    x, y = _samples(inputs, outputs)
    folds = [None] if left_out is None else [int(i) for i in left_out]
    if repeats < 1 or seed < 0 or not folds or any(f is not None and not 0 <= f < len(x) for f in folds):
        allowed = f"1 or more, 0 or more, samples 0 to {len(x) - 1}"
        raise ValueError(
            f"repeats, seed, left_out: received {repeats}, {seed}, {left_out}; allowed {allowed}"
        )
    sizes = (x.shape[1], *settings.hidden, y.shape[1])
    members = [(f, r) for f in folds for r in range(repeats)]
    with _one_thread():
        parts = [
            _train_block(x, y, members[i : i + _BLOCK], seed, sizes, settings)
            for i in range(0, len(members), _BLOCK)
        ]
    joined = {
        field.name: np.concatenate([getattr(part, field.name) for part in parts])
        for field in fields(Ensemble)[1:]
    }
    return Ensemble(sizes, **joined)


def leave_one_out(
    inputs: ArrayLike,
    outputs: ArrayLike,
    left_out: Sequence[int],
    *,
    repeats: int = 100,
    seed: int = 0,
    settings: Settings | None = None,
    queries: ArrayLike | None = None,
) -> Floats:
    """Predictions (k, repeats, q) for k samples, each by networks that never saw it.

    Parameters
    ----------
    left_out : k samples, each of which is left out once.
    queries : (k, p) what to ask instead of these samples' own inputs, such as what a picture gave.
    """
    x = np.asarray(inputs, np.float64)
    asked = x[list(left_out)] if queries is None else np.asarray(queries, np.float64)
    if len(asked) != len(left_out):
        raise ValueError(
            f"queries: received {len(asked)} rows; allowed {len(left_out)}, one per sample left out"
        )
    members = train(x, outputs, repeats=repeats, seed=seed, left_out=left_out, settings=settings)
    folds = [members.rows(slice(f * repeats, (f + 1) * repeats)) for f in range(len(asked))]
    return np.stack([fold.predict(asked[f : f + 1])[:, 0] for f, fold in enumerate(folds)])


@dataclass(frozen=True)
class _Data:
    """Standardised samples of every member (b, n, p), (b, n, q), and weights (b, n) of fit and validation."""

    x: Tensor
    y: Tensor
    fit: Tensor
    check: Tensor

    def rows(self, index: Tensor) -> _Data:
        return _Data(self.x[index], self.y[index], self.fit[index], self.check[index])


@dataclass
class _Best:
    """The best weights so far of every member, and what they reached; filled in as training goes."""

    weights: Tensor
    fit: Tensor
    check: Tensor
    steps: Tensor


@contextmanager
def _one_thread() -> Iterator[None]:
    """The arrays are small: a second thread gains a third on an idle core and costs 5 times on a busy one."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _train_block(
    x: Floats,
    y: Floats,
    members: list[tuple[int | None, int]],
    seed: int,
    sizes: tuple[int, ...],
    settings: Settings,
) -> Ensemble:
    """Train some members, (fold, repeat) each, together."""
    draws = [_draw(len(x), f, [seed, 0 if f is None else f + 1, r], sizes, settings) for f, r in members]
    weights, fit, check = (np.stack(parts) for parts in zip(*draws, strict=True))
    seen = fit + check
    (x_mean, x_sd), (y_mean, y_sd) = _moments(x, seen), _moments(y, seen)
    data = _Data(
        torch.from_numpy((x - x_mean[:, None]) / x_sd[:, None]),
        torch.from_numpy((y - y_mean[:, None]) / y_sd[:, None]),
        torch.from_numpy(fit / fit.sum(axis=1, keepdims=True)),
        torch.from_numpy(check / np.maximum(check.sum(axis=1, keepdims=True), 1.0)),
    )
    best = _descend(torch.from_numpy(weights), data, sizes, settings)
    checked = best.check.numpy() if settings.validation else np.full(len(weights), np.nan)
    moments = x_mean, x_sd, y_mean, y_sd
    return Ensemble(sizes, best.weights.numpy(), *moments, best.fit.numpy(), checked, best.steps.numpy())


class _Losses:
    """Loss and gradient of members for `advance`; remembers the last evaluation's two errors."""

    def __init__(self, data: _Data, sizes: tuple[int, ...], decay: float) -> None:
        self.data, self.sizes, self.decay = data, sizes, decay
        self.fit = self.check = data.fit[:, 0]

    def __call__(self, weights: Tensor) -> tuple[Tensor, Tensor]:
        at = weights.detach().requires_grad_()
        with torch.enable_grad():
            square = ((_forward(at, self.data.x, self.sizes) - self.data.y) ** 2).mean(dim=2)
            fit = (square * self.data.fit).sum(dim=1)
            loss = fit + self.decay * _size(at, self.sizes) if self.decay else fit
            (gradient,) = torch.autograd.grad(loss.sum(), at)
        self.fit = fit.detach()
        self.check = (square.detach() * self.data.check).sum(dim=1)
        return loss.detach(), gradient


def _descend(weights: Tensor, data: _Data, sizes: tuple[int, ...], settings: Settings) -> _Best:
    """Train all members; those that have ended leave the batch."""
    losses = _Losses(data, sizes, settings.decay)
    state = start(weights, losses)
    best = _Best(
        weights.clone(),
        losses.fit.clone(),
        losses.check.clone(),
        torch.zeros(len(weights), dtype=torch.int64),
    )
    who = torch.arange(len(weights))
    for step in range(1, settings.steps + 1):
        before = state.done
        state = advance(state, losses)
        taken = state.fresh & ~before
        better = taken & (
            losses.check < best.check[who] if settings.validation else losses.fit < best.fit[who]
        )
        at = who[better]
        best.weights[at], best.steps[at] = state.weights[better], step
        best.fit[at], best.check[at] = losses.fit[better], losses.check[better]
        ended = state.done
        if settings.validation:
            ended = ended | (step - best.steps[who] >= settings.patience)
        if bool(ended.all()):
            break
        # Copies cost: the batch shrinks only when a tenth of it has ended.
        state = replace(state, done=ended)
        if int(ended.sum()) * 10 >= len(who):
            keep = torch.nonzero(~ended)[:, 0]
            state, who = state.rows(keep), who[keep]
            losses = _Losses(losses.data.rows(keep), sizes, settings.decay)
    return best


def _forward(weights: Tensor, x: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Outputs (b, m, q) of members with weights (b, n) at standardised inputs (b, m, p)."""
    place, layers = 0, len(sizes) - 1
    for i, (many, few) in enumerate(pairwise(sizes)):
        matrix = weights[:, place : place + many * few].reshape(-1, many, few)
        bias = weights[:, place + many * few : place + (many + 1) * few]
        place += (many + 1) * few
        x = torch.baddbmm(bias[:, None], x, matrix)
        x = torch.tanh(x) if i < layers - 1 else x
    return x


def _size(weights: Tensor, sizes: tuple[int, ...]) -> Tensor:
    """Mean squared weight of each member, (b,), without biases."""
    place, total, count = 0, torch.zeros(len(weights), dtype=weights.dtype), 0
    for many, few in pairwise(sizes):
        total = total + (weights[:, place : place + many * few] ** 2).sum(dim=1)
        place, count = place + (many + 1) * few, count + many * few
    return total / count


def _draw(
    count: int, left: int | None, key: list[int], sizes: tuple[int, ...], settings: Settings
) -> tuple[Floats, Floats, Floats]:
    """First weights (n,), and which of the samples a member is fitted to and checked on, (count,) 0 or 1."""
    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence(key)))
    parts = []
    for many, few in pairwise(sizes):
        parts += [rng.standard_normal(many * few) / np.sqrt(many), 0.5 * rng.standard_normal(few)]
    allowed = np.array([i for i in range(count) if i != left])
    checks = round(settings.validation * len(allowed))
    if settings.validation:
        checks = min(max(checks, 1), len(allowed) - 1)
    split = rng.permutation(allowed)
    fit, check = np.zeros(count), np.zeros(count)
    check[split[:checks]], fit[split[checks:]] = 1.0, 1.0
    return np.concatenate(parts), fit, check


def _moments(values: Floats, seen: Floats) -> tuple[Floats, Floats]:
    """Mean and standard deviation (b, p) over the samples (n, p) that each member may see (b, n)."""
    share = seen / seen.sum(axis=1, keepdims=True)
    mean = share @ values
    variance = np.einsum("bn,bnp->bp", share, (values - mean[:, None]) ** 2)
    flat = variance <= (1e-12 * np.abs(mean)) ** 2
    return mean, np.sqrt(np.where(flat, 1.0, variance))


def _samples(inputs: ArrayLike, outputs: ArrayLike) -> tuple[Floats, Floats]:
    x, y = np.asarray(inputs, np.float64), np.asarray(outputs, np.float64)
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or len(x) < 4:
        raise ValueError(
            f"inputs, outputs: received shapes {x.shape}, {y.shape}; allowed (n, p), (n, q), n >= 4"
        )
    if not (np.isfinite(x).all() and np.isfinite(y).all()):
        raise ValueError("inputs, outputs: received NaN or infinity; allowed finite numbers")
    return x, y
