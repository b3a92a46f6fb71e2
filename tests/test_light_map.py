"""Pictures as a function of the contact: recovered where they are what is assumed, errors as left out."""

import numpy as np
import pytest

from estimation.light_map import count_terms, learn, terms


def made_up(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Contacts of three hidden numbers, and pictures (2, 3) that are a quadratic of these."""
    hidden = rng.standard_normal((n, 3))
    contacts = hidden @ rng.standard_normal((3, 20)) + 2.0
    squares = np.stack([hidden[:, i] * hidden[:, j] for i in range(3) for j in range(i, 3)], axis=1)
    pictures = 1.0 + hidden @ rng.standard_normal((3, 6)) + squares @ rng.standard_normal((6, 6))
    return contacts, pictures.reshape(n, 2, 3)


def test_a_quadratic_is_recovered():
    contacts, pictures = made_up(400, np.random.default_rng(0))
    light, left = learn(contacts[:300], pictures[:300], k=3, curved=3)
    assert np.abs(light(contacts[300:]) - pictures[300:]).max() < 2e-4 * np.abs(pictures).max()
    assert np.abs(left).max() < 2e-4 * np.abs(pictures).max()


def test_what_is_left_out_is_as_if_fitted_without_it():
    rng = np.random.default_rng(1)
    contacts, pictures = made_up(120, rng)
    pictures = pictures + rng.standard_normal(pictures.shape)
    groups = np.repeat(np.arange(40), 3)
    light, left = learn(contacts, pictures, groups, k=3, curved=3)
    design = terms(light.inputs(contacts), 3).astype(float)
    for group in (0, 17, 39):
        rows = groups == group
        gram = design[~rows].T @ design[~rows] + 1e-6 * 120 * np.eye(design.shape[1])
        weights = np.linalg.solve(gram, design[~rows].T @ pictures[~rows].reshape(-1, 6))
        wanted = pictures[rows].reshape(-1, 6) - design[rows] @ weights
        assert np.abs(left[rows].reshape(-1, 6) - wanted).max() < 1e-4


def test_few_samples_take_few_terms():
    contacts, pictures = made_up(40, np.random.default_rng(2))
    light, _ = learn(contacts, pictures)
    assert len(light.weights) == count_terms(light.axes.shape[1], light.curved) <= 20


def test_too_few_are_refused():
    contacts, pictures = made_up(10, np.random.default_rng(3))
    with pytest.raises(ValueError, match="allowed one each, 20 or more"):
        learn(contacts, pictures)
