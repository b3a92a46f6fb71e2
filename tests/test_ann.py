"""The paper's network: what it must learn, what it must not see, and that a seed decides all."""

import time

import numpy as np
import pytest
import torch

import estimation.ann as ann
from estimation.ann import Settings, leave_one_out, train

BRIEF = Settings(hidden=(6,), patience=20, steps=60)


def specimens(count: int, seed: int) -> np.ndarray:
    """Size, depth (mm) and modulus (kPa) over the paper's box, (count, 3)."""
    return np.random.default_rng(seed).uniform([2, 4, 40], [13, 12, 120], (count, 3))


def scalars(truth: np.ndarray) -> np.ndarray:
    """Maximum, total and area (n, 3) of a made-up signal d³ (c - 1)/(c + 1.5) that spreads with the depth."""
    d, h, modulus = truth.T
    source, centre, c = d**3, h + d / 2, modulus / 5
    source = source * (c - 1) / (c + 1.5)
    peak = source / centre**3
    return np.stack([peak, source / centre, centre**2 * np.log1p(30 * peak)], axis=1)


def test_network_is_the_formula_written_out():
    """Outputs of one member against plain numpy: tanh(x W1 + b1) W2 + b2 between the standardisations."""
    truth = specimens(30, 0)
    made = train(scalars(truth), truth, repeats=3, settings=BRIEF)
    assert made.sizes == (3, 6, 3) and made.weights.shape == (3, 3 * 6 + 6 + 6 * 3 + 3)
    w = made.weights[1]
    w1, b1, w2, b2 = w[:18].reshape(3, 6), w[18:24], w[24:42].reshape(6, 3), w[42:]
    x = (scalars(truth) - made.input_mean[1]) / made.input_sd[1]
    by_hand = (np.tanh(x @ w1 + b1) @ w2 + b2) * made.output_sd[1] + made.output_mean[1]
    assert made.predict(scalars(truth))[1] == pytest.approx(by_hand, rel=1e-12)


def test_size_and_depth_are_learned_where_scalars_tell_them():
    """125 train, 60 test: log scalars give d and h within 0.15 of their spread; E they cannot."""
    truth, unseen = specimens(125, 1), specimens(60, 2)
    made = train(np.log(scalars(truth)), truth, repeats=10, settings=Settings(), seed=1)
    error = made.predict(np.log(scalars(unseen))).mean(axis=0) - unseen
    rmse, spread = np.sqrt((error**2).mean(axis=0)), unseen.std(axis=0)
    assert (rmse[:2] < 0.15 * spread[:2]).all()
    assert 0.5 * spread[2] < rmse[2] < 1.3 * spread[2]


def test_the_mean_of_repeats_is_no_worse_than_they_are():
    """Jensen: the squared error of the mean estimate is at most the mean squared error of its members."""
    truth, unseen = specimens(60, 3), specimens(40, 4)
    every = train(scalars(truth), truth, repeats=8, settings=BRIEF).predict(scalars(unseen)) - unseen
    assert ((every.mean(axis=0) ** 2).mean(axis=0) <= (every**2).mean(axis=(0, 1)) * (1 + 1e-12)).all()


def test_a_seed_decides_all(monkeypatch):
    """The same bytes again; but for rounding, the same members whatever is trained beside them."""
    truth = specimens(40, 5)
    x = scalars(truth)
    first = train(x, truth, repeats=5, seed=7, settings=BRIEF)
    assert np.array_equal(first.weights, train(x, truth, repeats=5, seed=7, settings=BRIEF).weights)
    more = train(x, truth, repeats=7, seed=7, settings=BRIEF)
    assert first.predict(x) == pytest.approx(more.predict(x)[:5], rel=1e-6)
    assert not np.allclose(first.weights, train(x, truth, repeats=5, seed=8, settings=BRIEF).weights)
    monkeypatch.setattr(ann, "_BLOCK", 2)
    blocks = train(x, truth, repeats=5, seed=7, settings=BRIEF)
    assert first.predict(x) == pytest.approx(blocks.predict(x), rel=1e-6)
    assert len({tuple(w) for w in first.weights}) == 5


def test_threads_do_not_matter():
    truth, found, before = specimens(40, 5), [], torch.get_num_threads()
    try:
        for threads in (1, 2):
            torch.set_num_threads(threads)
            found.append(train(scalars(truth), truth, repeats=3, settings=BRIEF).weights)
            assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert np.array_equal(*found)


def test_what_is_left_out_is_not_seen():
    """Its truth and its scalars may be anything: the networks that answer for it are the same bytes."""
    truth = specimens(25, 6)
    x, wrong_x, wrong_y = scalars(truth), scalars(truth), truth.copy()
    wrong_x[3], wrong_y[3] = 1e4, -1e5
    query = x[[3]]
    right = leave_one_out(x, truth, [3], repeats=3, settings=BRIEF)
    wrong = leave_one_out(wrong_x, wrong_y, [3], repeats=3, settings=BRIEF, queries=query)
    assert right.shape == (1, 3, 3)
    assert np.array_equal(right, wrong)
    assert not np.allclose(right, leave_one_out(wrong_x, wrong_y, [4], repeats=3, settings=BRIEF))


def test_every_fold_answers_for_its_own_sample():
    truth = specimens(25, 7)
    x = scalars(truth)
    folds = leave_one_out(x, truth, [2, 20, 11], repeats=2, settings=BRIEF)
    for fold, sample in zip(folds, (2, 20, 11), strict=True):
        alone = leave_one_out(x, truth, [sample], repeats=2, settings=BRIEF)
        assert fold == pytest.approx(alone[0], rel=1e-6)


def test_units_do_not_matter():
    """Scalars and truths in units of powers of two: the same networks, byte for byte."""
    truth = specimens(30, 8)
    x, unit_x, unit_y = (
        scalars(truth),
        np.array([2.0**-12, 2.0**20, 8.0]),
        np.array([2.0**-10, 2.0**10, 0.25]),
    )
    one = train(x, truth, repeats=2, settings=BRIEF).predict(x)
    other = train(x * unit_x, truth * unit_y, repeats=2, settings=BRIEF).predict(x * unit_x)
    assert np.array_equal(one * unit_y, other)


def test_training_stops_where_validation_no_longer_gains():
    """Pure noise: with a validation split the fit ends early, without it goes on into the noise."""
    rng = np.random.default_rng(9)
    x, y = rng.normal(size=(60, 3)), rng.normal(size=(60, 2))
    stopped = train(x, y, repeats=6, settings=Settings(hidden=(20,), patience=10, steps=300))
    free = train(x, y, repeats=6, settings=Settings(hidden=(20,), validation=0.0, steps=300))
    assert (stopped.steps < 60).all() and (free.steps > 100).all()
    assert stopped.train_loss.mean() > 3 * free.train_loss.mean()
    assert np.isnan(free.validation_loss).all() and np.isfinite(stopped.validation_loss).all()


def test_decay_keeps_weights_small():
    truth = specimens(30, 10)
    sizes = [
        np.abs(
            train(scalars(truth), truth, repeats=2, settings=Settings((8,), 0.0, 50, 100, decay)).weights
        ).mean()
        for decay in (0.0, 0.3)
    ]
    assert sizes[1] < 0.7 * sizes[0]


def test_a_scalar_that_never_varies_does_no_harm():
    truth = specimens(20, 11)
    x = scalars(truth)
    x[:, 1] = 5.0
    assert np.isfinite(train(x, truth, repeats=2, settings=BRIEF).predict(x)).all()


@pytest.mark.slow
def test_leave_one_out_of_the_paper_is_affordable():
    """Nine of 134 left out, 100 repeats each: 900 networks of (10, 10) units within 3 minutes on one core."""
    truth = specimens(134, 12)
    begin = time.process_time()
    found = leave_one_out(np.log(scalars(truth)), truth, range(9), repeats=100)
    seconds = time.process_time() - begin
    print(f"900 networks in {seconds:.0f} s")
    assert found.shape == (9, 100, 3) and seconds < 180


@pytest.mark.parametrize(
    ("call", "word"),
    [
        (lambda: Settings(hidden=()), "hidden"),
        (lambda: Settings(validation=0.7), "validation"),
        (lambda: Settings(decay=-1.0), "decay"),
        (lambda: train(np.ones((5, 3)), np.ones((4, 3))), "inputs"),
        (lambda: train(np.full((5, 3), np.nan), np.ones((5, 3))), "NaN"),
        (lambda: train(np.ones((5, 3)), np.ones((5, 3)), left_out=[5]), "left_out"),
        (lambda: train(np.eye(5), np.eye(5), repeats=1, settings=BRIEF).predict(np.ones((2, 4))), "inputs"),
    ],
)
def test_mistakes_are_refused_in_one_line(call, word):
    with pytest.raises(ValueError, match=word) as caught:
        call()
    assert "\n" not in str(caught.value)
