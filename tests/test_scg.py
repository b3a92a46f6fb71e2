"""Møller's scaled conjugate gradient: quadratics in n steps, Rosenbrock, a regression against SciPy's CG."""

import numpy as np
import pytest
import torch
from scipy.optimize import minimize

from estimation.scg import SCG, advance, start

torch.set_default_dtype(torch.float32)  # nothing here may rely on another default
DOUBLE = torch.float64


def quadratic(n: int, condition: float, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Symmetric positive definite matrix of this condition, and its minimum."""
    rng = np.random.default_rng(seed)
    q, _ = np.linalg.qr(rng.normal(size=(n, n)))
    matrix = q @ np.diag(np.geomspace(1, condition, n)) @ q.T
    return torch.tensor(matrix), torch.tensor(rng.normal(size=n))


def run(optimiser: SCG, loss, steps: int) -> tuple[list[float], int]:
    """Losses after each step, and how often the gradient was computed."""
    calls = 0

    def closure():
        nonlocal calls
        calls += 1
        optimiser.zero_grad()
        value = loss()
        value.backward()
        return value

    found = []
    for _ in range(steps):
        found.append(float(optimiser.step(closure)))
        if optimiser.done:
            break
    return found, calls


@pytest.mark.parametrize(("n", "condition"), [(2, 1e3), (6, 1e2), (12, 30.0)])
def test_a_quadratic_takes_n_steps(n, condition):
    """Conjugate directions: the gradient is zero but for rounding after n steps, and not before the last."""
    matrix, minimum = quadratic(n, condition, seed=n)
    w = torch.zeros(n, dtype=DOUBLE, requires_grad=True)
    # differences of a linear gradient are exact over any step; over a short one their rounding is large
    losses, calls = run(
        SCG([w], sigma=1.0, scale=1e-15), lambda: (w - minimum) @ matrix @ (w - minimum) / 2, n
    )
    first = float(minimum @ matrix @ minimum / 2)
    assert losses[-1] < 1e-13 * first
    assert losses[-2] > 1e-10 * first
    assert calls == 2 * n + 1
    assert torch.allclose(w.detach(), minimum, atol=1e-6)


def test_steps_are_those_of_conjugate_gradients():
    """On a quadratic the weights follow Hestenes and Stiefel's linear method step by step."""
    matrix, minimum = quadratic(8, 50.0, seed=1)
    w = torch.zeros(8, dtype=DOUBLE, requires_grad=True)
    optimiser = SCG([w], scale=1e-15)
    x, r = torch.zeros(8, dtype=DOUBLE), matrix @ minimum
    p = r
    for _ in range(6):
        alpha = (r @ r) / (p @ matrix @ p)
        x, after = x + alpha * p, r - alpha * matrix @ p
        p, r = after + (after @ after) / (r @ r) * p, after
        run(optimiser, lambda: (w - minimum) @ matrix @ (w - minimum) / 2, 1)
        assert torch.allclose(w.detach(), x, rtol=1e-6, atol=1e-8)


def test_scale_follows_the_comparison():
    """A quadratic keeps every promise: Δ = 1, so λ falls by 4 each step; the loss never rises."""
    matrix, minimum = quadratic(5, 10.0, seed=3)
    w = torch.zeros(5, dtype=DOUBLE, requires_grad=True)
    optimiser = SCG([w], scale=1e-6)
    for k in range(1, 5):
        run(optimiser, lambda: (w - minimum) @ matrix @ (w - minimum) / 2, 1)
        assert float(optimiser.state[w]["scale"][0]) == pytest.approx(1e-6 / 4**k, rel=1e-12)


def test_negative_curvature_is_turned_round():
    """At the top of a double well the curvature is -1: step 4 of the algorithm, and down into a well."""
    w = torch.tensor([0.05, -0.03], dtype=DOUBLE, requires_grad=True)
    losses, _ = run(SCG([w]), lambda: ((w**2 - 1) ** 2).sum() / 4, 60)
    assert (np.diff([0.5, *losses]) <= 0).all()
    assert losses[-1] < 1e-14
    assert w.detach().abs().tolist() == pytest.approx([1, 1], abs=1e-6)


def rosenbrock(x: torch.Tensor) -> torch.Tensor:
    return (100 * (x[1:] - x[:-1] ** 2) ** 2 + (1 - x[:-1]) ** 2).sum()


@pytest.mark.parametrize(("begin", "steps"), [([-1.2, 1.0], 300), ([-1.2, 1.0, -1.2, 1.0], 600)])
def test_rosenbrock(begin, steps):
    x = torch.tensor(begin, dtype=DOUBLE, requires_grad=True)
    losses, calls = run(SCG([x]), lambda: rosenbrock(x), steps)
    assert (np.diff(losses) <= 0).all()
    assert x.detach().tolist() == pytest.approx([1.0] * len(begin), abs=1e-5)
    assert calls < 2 * steps


def test_a_small_network_against_scipys_conjugate_gradients():
    """Six tanh units on 40 points: a loss as low as SciPy's CG, with at most 1.5 times the gradients."""
    rng = np.random.default_rng(4)
    x = torch.tensor(np.linspace(-2, 2, 40))[:, None]
    y = torch.sin(2 * x) + 0.05 * torch.tensor(rng.normal(size=(40, 1)))
    begin = torch.tensor(rng.normal(size=19))

    def loss_of(w: torch.Tensor) -> torch.Tensor:
        hidden = torch.tanh(x * w[:6] + w[6:12])
        return ((hidden @ w[12:18, None] + w[18] - y) ** 2).mean() + 1e-4 * (w**2).sum()

    def value(w: np.ndarray) -> tuple[float, np.ndarray]:
        at = torch.tensor(w, requires_grad=True)
        loss = loss_of(at)
        loss.backward()
        return float(loss.detach()), at.grad.numpy()

    theirs = minimize(value, begin.numpy(), jac=True, method="CG", options={"gtol": 1e-4, "maxiter": 2000})
    w = begin.clone().requires_grad_()
    optimiser, calls = SCG([w]), 0
    for _ in range(2000):
        calls += run(optimiser, lambda: loss_of(w), 1)[1]
        if np.abs(value(w.detach().numpy())[1]).max() < 1e-4:
            break
    ours = float(loss_of(w).detach())
    print(f"SCG {ours:.6f} with {calls} gradients, SciPy's CG {theirs.fun:.6f} with {theirs.njev}")
    assert ours <= theirs.fun * 1.02
    assert calls <= 1.5 * theirs.njev


def test_rows_do_not_see_each_other():
    """Three problems at once end where each ends alone; those that are done stay."""
    begin = torch.tensor([[-1.2, 1.0], [1.0, 1.0], [3.0, -2.0]], dtype=DOUBLE)

    def evaluate(w: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        at = w.detach().clone().requires_grad_()
        loss = 100 * (at[:, 1] - at[:, 0] ** 2) ** 2 + (1 - at[:, 0]) ** 2
        loss.sum().backward()
        return loss.detach(), at.grad

    together = start(begin, evaluate)
    assert together.done.tolist() == [False, True, False]
    for _ in range(40):
        together = advance(together, evaluate)
    for i in (0, 2):
        alone = start(begin[i : i + 1], evaluate)
        for _ in range(40):
            alone = advance(alone, evaluate)
        assert torch.equal(alone.weights[0], together.weights[i])
    assert together.weights[1].tolist() == [1.0, 1.0]


def test_losses_that_are_not_finite_are_stepped_back_from():
    """log x has no value below 0: the first step goes there, x - log x is minimised still."""
    x = torch.tensor([20.0], dtype=DOUBLE, requires_grad=True)
    run(SCG([x]), lambda: (x - torch.log(x)).sum(), 200)
    assert float(x.detach()) == pytest.approx(1.0, abs=1e-5)


def test_state_is_kept_in_a_checkpoint():
    """Ten steps are five, a saved and loaded state, and five more."""
    begin = torch.tensor([-1.2, 1.0], dtype=DOUBLE)
    one, two = (begin.clone().requires_grad_() for _ in range(2))
    run(SCG([one]), lambda: rosenbrock(one), 10)
    first = SCG([two])
    run(first, lambda: rosenbrock(two), 5)
    second = SCG([two])
    second.load_state_dict(first.state_dict())
    run(second, lambda: rosenbrock(two), 5)
    assert torch.equal(one.detach(), two.detach())


@pytest.mark.parametrize("wrong", [{"sigma": 0.0}, {"scale": -1.0}])
def test_mistakes_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        SCG([torch.zeros(2, requires_grad=True)], **wrong)
