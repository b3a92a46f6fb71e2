"""Scaled conjugate gradient (Møller 1993; [moller1993]): no line search, no step to choose.

Each step takes the curvature δ along the direction p from two gradients that lie σ apart, makes it positive
by a scale λ as Levenberg and Marquardt do, steps to the minimum μ/δ of that parabola, and compares the fall
of the loss with what the parabola promised: Δ. A step that does not go up is taken; λ falls where Δ is
above 3/4 and rises where it is below 1/4. The numbered comments are the steps of Møller's algorithm,
and three things go beyond it: a restart after n steps taken (Møller counts refused ones too,
and so may miss one), a restart where p does not descend, and a loss that is not finite counts as a refused
step with Δ = -10.

`advance` takes one step of many independent problems at once, the rows of (b, n) tensors; `SCG` is it for
one problem as an optimiser of torch.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.optim import Optimizer

Evaluate = Callable[[Tensor], tuple[Tensor, Tensor]]
"""Weights (b, n) to losses (b,) and gradients (b, n), row by row."""

_REFUSED = -10.0  # comparison ratio of a step to a loss that is NaN or infinite
_LEAST, _MOST = 1e-15, 1e15  # of the scale λ


@dataclass(frozen=True)
class State:
    """Where b problems of n weights stand.

    Attributes
    ----------
    weights, steepest, direction : (b, n): w, r = -gradient at w, p.
    loss, scale, taken_scale, curvature : (b,): the loss at w; λ; λ̄, the part of λ that δ holds already; δ.
    fresh : (b,) bool, whether δ must be computed anew, which is so after a step that was taken.
    since : (b,) int64, steps taken since the last restart.
    done : (b,) bool: the gradient is zero, or the promised fall is below the rounding of the loss.
    """

    weights: Tensor
    steepest: Tensor
    direction: Tensor
    loss: Tensor
    scale: Tensor
    taken_scale: Tensor
    curvature: Tensor
    fresh: Tensor
    since: Tensor
    done: Tensor

    def rows(self, index: Tensor) -> State:
        """The state of some of the problems."""
        return State(**{field.name: getattr(self, field.name)[index] for field in fields(self)})


def start(weights: Tensor, evaluate: Evaluate, scale: float = 1e-6) -> State:
    """State before the first step (Møller's step 1), with λ = `scale` > 0; one evaluation."""
    loss, gradient = evaluate(weights)
    zero = torch.zeros_like(loss)
    return State(
        weights=weights.clone(),
        steepest=-gradient,
        direction=-gradient,
        loss=loss,
        scale=torch.full_like(loss, scale),
        taken_scale=zero,
        curvature=zero.clone(),
        fresh=torch.ones_like(loss, dtype=torch.bool),
        since=torch.zeros_like(loss, dtype=torch.int64),
        done=_dot(gradient, gradient) == 0,
    )


def advance(state: State, evaluate: Evaluate, sigma: float = 1e-4) -> State:
    """One iteration of every problem not done: two evaluations, or one if all last steps were refused.

    The last evaluation is that at the weights tried; where ``fresh`` is true afterwards, and the problem was
    not done before, they were taken.
    """
    w, r, p, scale = state.weights, state.steepest, state.direction, state.scale
    square = _dot(p, p).clamp_min(torch.finfo(w.dtype).tiny)
    curvature = state.curvature
    if bool((state.fresh & ~state.done).any()):  # 2: second-order information
        apart = sigma / square.sqrt()
        _, gradient = evaluate(w + apart[:, None] * p)
        curvature = torch.where(state.fresh, _dot(p, gradient + r) / apart, curvature)
    curvature = curvature + (scale - state.taken_scale) * square  # 3: scale δ
    negative = curvature <= 0  # 4: make it positive
    taken_scale = torch.where(negative, 2.0 * (scale - curvature / square), state.taken_scale)
    curvature = torch.where(negative, scale * square - curvature, curvature)
    scale = torch.where(negative, taken_scale, scale)
    mu = _dot(p, r)  # 5: step size
    tried = w + (mu / curvature)[:, None] * p
    loss, gradient = evaluate(tried)
    ratio = 2.0 * curvature * (state.loss - loss) / mu**2  # 6: comparison
    finite = torch.isfinite(loss) & torch.isfinite(gradient).all(dim=1)
    ratio = torch.where(finite & torch.isfinite(ratio), ratio, torch.full_like(ratio, _REFUSED))
    taken = (ratio >= 0) & ~state.done  # 7
    after = torch.where(taken[:, None], -gradient, r)
    since = state.since + taken
    beta = (_dot(after, after) - _dot(after, r)) / mu
    onward = after + beta[:, None] * p
    restart = (since >= w.shape[1]) | ~(_dot(onward, after) > 0)
    onward = torch.where(restart[:, None], after, onward)
    changed = torch.where(taken & (ratio >= 0.75), scale / 4.0, scale)
    changed = torch.where(ratio < 0.25, changed + curvature * (1.0 - ratio) / square, changed)  # 8
    least = 4.0 * torch.finfo(w.dtype).eps * state.loss.abs()
    flat = (mu**2 / curvature / 2.0 <= least) | (_dot(after, after) == 0)  # 9
    held = state.done
    return State(
        weights=torch.where(taken[:, None], tried, w),
        steepest=after,
        direction=torch.where(taken[:, None], onward, p),
        loss=torch.where(taken, loss, state.loss),
        scale=torch.where(held, state.scale, changed.clamp(_LEAST, _MOST)),
        taken_scale=torch.where(taken, torch.zeros_like(scale), scale),
        curvature=curvature,
        fresh=torch.where(held, state.fresh, taken),
        since=torch.where(taken & restart, torch.zeros_like(since), since),
        done=held | flat,
    )


class SCG(Optimizer):
    """Møller's algorithm for all parameters together; a step needs a closure that gives the whole loss.

    The closure zeroes gradients, computes the loss of all the data (the same function at every call),
    propagates back and returns it; it is called once or twice a step, and once more at the first. There is
    one group of parameters, and no learning rate.

    Parameters
    ----------
    params : tensors of one dtype; float64 keeps the curvature's digits.
    sigma : distance σ of the two gradients that give the curvature, above 0; Møller: at most 1e-4.
    scale : first λ, above 0; Møller: at most 1e-6.
    """

    def __init__(self, params: Iterable[Tensor], sigma: float = 1e-4, scale: float = 1e-6) -> None:
        for name, value in (("sigma", sigma), ("scale", scale)):
            if not 0 < value < float("inf"):
                raise ValueError(f"{name}: received {value!r}; allowed a number > 0")
        super().__init__(params, {"sigma": sigma, "scale": scale})
        if len(self.param_groups) != 1:
            raise ValueError(f"params: received {len(self.param_groups)} groups; allowed one")

    @property
    def done(self) -> bool:
        """Whether further steps cannot lower the loss by more than its rounding."""
        kept = self.state[self.param_groups[0]["params"][0]]
        return bool(kept) and bool(kept["done"])

    @torch.no_grad()
    def step(self, closure: Callable[[], Any]) -> Tensor:
        """One iteration; returns the loss at the weights that it leaves."""
        group = self.param_groups[0]
        params = group["params"]
        kept = self.state[params[0]]

        def evaluate(weights: Tensor) -> tuple[Tensor, Tensor]:
            torch.nn.utils.vector_to_parameters(weights[0], params)
            with torch.enable_grad():
                loss = closure()
            grads = [torch.zeros_like(q) if q.grad is None else q.grad for q in params]
            flat = torch.cat([grad.reshape(-1) for grad in grads])
            return torch.as_tensor(loss).detach().reshape(1).to(flat.dtype), flat[None].clone()

        if not kept:
            flat = torch.nn.utils.parameters_to_vector(params).detach()[None].clone()
            state = start(flat, evaluate, group["scale"])
        else:
            state = State(**{field.name: kept[field.name] for field in fields(State)})
            # Loading a checkpoint casts all of an optimiser's state to the dtype of its parameters.
            state = replace(state, fresh=state.fresh.bool(), since=state.since.long(), done=state.done.bool())
        if not bool(state.done):
            state = advance(state, evaluate, group["sigma"])
        torch.nn.utils.vector_to_parameters(state.weights[0], params)
        kept.update({field.name: getattr(state, field.name) for field in fields(State)})
        return state.loss[0].clone()


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """Row by row, (b, n) and (b, n) to (b,)."""
    return (a * b).sum(dim=1)
