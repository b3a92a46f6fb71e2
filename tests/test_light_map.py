"""Pictures as a function of the contact: recovered where they are smooth, errors as left out."""

import numpy as np
import pytest

from estimation import light_map
from estimation.light_map import _left_out, learn


def made_up(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Contacts of three hidden numbers, and pictures (2, 3) that are a quadratic of these."""
    hidden = rng.uniform(-1, 1, (n, 3))
    contacts = hidden @ rng.standard_normal((3, 20)) + 2.0
    squares = np.stack([hidden[:, i] * hidden[:, j] for i in range(3) for j in range(i, 3)], axis=1)
    pictures = 1.0 + hidden @ rng.standard_normal((3, 6)) + squares @ rng.standard_normal((6, 6))
    return contacts, pictures.reshape(n, 2, 3)


def test_a_quadratic_is_recovered():
    contacts, pictures = made_up(400, np.random.default_rng(0))
    light, left = learn(contacts[:300], pictures[:300])
    assert np.abs(light(contacts[300:]) - pictures[300:]).max() < 1e-3 * np.abs(pictures).max()
    assert np.sqrt((left**2).mean()) < 1e-3 * np.abs(pictures).max()


def test_what_is_left_out_is_as_if_learned_without_it():
    rng = np.random.default_rng(1)
    points = rng.standard_normal((60, 3))
    kernel = np.exp(-0.5 * ((points[:, None] - points) ** 2).sum(axis=-1)) + 1e-3 * np.eye(60)
    values, groups = rng.standard_normal((60, 4)), np.repeat(np.arange(20), 3)
    inverse = np.linalg.inv(kernel)
    left = _left_out(inverse, inverse @ values, groups)
    for group in (0, 7, 19):
        rows = groups == group
        wanted = kernel[np.ix_(rows, ~rows)] @ np.linalg.solve(kernel[np.ix_(~rows, ~rows)], values[~rows])
        assert np.abs(left[rows] - (values[rows] - wanted)).max() < 1e-9


def test_errors_left_out_are_those_of_new_samples():
    rng = np.random.default_rng(2)
    contacts, pictures = made_up(500, rng)
    pictures = pictures + 0.1 * rng.standard_normal(pictures.shape)
    light, left = learn(contacts[:250], pictures[:250])
    new = light(contacts[250:]) - pictures[250:]
    assert np.sqrt((left**2).mean()) == pytest.approx(np.sqrt((new**2).mean()), rel=0.1)


def test_more_than_length_and_ridge_are_chosen_with(monkeypatch: pytest.MonkeyPatch):
    """All of them are learned from: as well as where all choose, and better than by the first alone."""
    contacts, pictures = made_up(400, np.random.default_rng(4))
    maps = {"all": learn(contacts[:300], pictures[:300])[0], "first": learn(contacts[:60], pictures[:60])[0]}
    monkeypatch.setattr(light_map, "MOST", 60)
    maps["chosen"] = learn(contacts[:300], pictures[:300])[0]
    off = {name: np.abs(one(contacts[300:]) - pictures[300:]).max() for name, one in maps.items()}
    assert off["chosen"] < 3 * off["all"] < off["first"]


def test_too_few_are_refused():
    contacts, pictures = made_up(10, np.random.default_rng(3))
    with pytest.raises(ValueError, match="allowed one each, 20 or more"):
        learn(contacts, pictures)
