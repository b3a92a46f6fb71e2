"""The paper's own tables, and the errors that follow from them."""

import numpy as np
import pytest

from estimation.paper import (
    PARAMETERS,
    RANGES,
    bias,
    constant,
    errors,
    mae,
    prior_mean,
    published_errors,
    published_estimates,
    rmse,
    true_inclusions,
)


def test_table_three_holds_mean_absolute_errors():
    """MAE of Table II against Table I is what the paper prints as RMSE, but for its last digits."""
    truth, estimate = true_inclusions(), published_estimates()
    assert mae(truth, estimate).round(2).tolist() == [1.25, 2.10, 28.60]
    assert rmse(truth, estimate)[:2].round(2).tolist() == [1.51, 2.45]
    assert rmse(truth, estimate)[2].round(1) == 31.3
    assert np.abs(mae(truth, estimate) - published_errors()).max() < 0.06
    assert (rmse(truth, estimate) > 1.09 * published_errors()).all()


def test_the_mean_of_the_truths_beats_the_paper_on_depth_and_modulus():
    truth, estimate = true_inclusions(), published_estimates()
    flat = rmse(truth, constant(truth))
    assert flat.round(2).tolist()[:2] == [2.90, 2.36] and flat[2].round(1) == 24.9
    assert flat == pytest.approx(truth.std(axis=0))
    assert (flat < rmse(truth, estimate)).tolist() == [False, True, True]


def test_the_prior_mean_as_a_constant():
    truth = true_inclusions()
    assert prior_mean().tolist() == [7.5, 8.0, 80.0]
    assert rmse(truth, constant(truth, prior_mean()))[2] == pytest.approx(30.0, abs=0.05)


def test_the_phantoms_lie_in_the_box_and_apart():
    truth = true_inclusions()
    assert truth.shape == (9, 3) and len({tuple(row) for row in truth}) == 9
    for column, name in zip(truth.T, PARAMETERS, strict=True):
        assert RANGES[name][0] <= column.min() and column.max() <= RANGES[name][1]


def test_errors_in_closed_form():
    """Errors of 3 and -4 in one column, 1 and 1 in the other; MSE is bias² plus variance."""
    truth, estimate = np.array([[1.0, 5.0], [10.0, 6.0]]), np.array([[4.0, 6.0], [6.0, 7.0]])
    found = errors(truth, estimate)
    assert found.mae.tolist() == [3.5, 1.0]
    assert found.rmse == pytest.approx([np.sqrt(12.5), 1.0])
    assert found.bias.tolist() == [-0.5, 1.0] == bias(truth, estimate).tolist()
    assert found.rmse**2 == pytest.approx(found.bias**2 + (estimate - truth).std(axis=0) ** 2)


@pytest.mark.parametrize("shape", [(8, 3), (9,), (0, 3)])
def test_shapes_that_do_not_fit_are_refused(shape):
    with pytest.raises(ValueError, match="estimate"):
        mae(true_inclusions(), np.zeros(shape))
