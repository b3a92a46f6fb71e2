"""A trained model before strange pictures and another camera. Give a model and its corpus:

TWIN_MODEL=models/tsis TWIN_CORPUS=corpora/pictures pytest -m slow -s tests/bench/test_trained_model.py
"""

import os
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from aliens import aliens
from numpy.typing import NDArray
from other_camera import real_camera

import twin
from twin import likeness
from twin.assess import averaged, stored
from twin.assessing import levels_of, values_of
from twin.complaint import DesignError
from twin.estimates import NAMES
from twin.estimator import Estimator, black
from twin.estimator_file import load_estimator
from twin.fitting import covariance, differences, jacobian
from twin.received import Received
from twin.rendered import rendered
from twin.sound import check_exposure, check_pair
from twin.train import TEST

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(  # one alone is an error
        not {"TWIN_MODEL", "TWIN_CORPUS"} & set(os.environ), reason="needs TWIN_MODEL and TWIN_CORPUS"
    ),
]
VALID, ANSWERED = 200, int(os.environ.get("TWIN_SAMPLES", "12"))


@pytest.fixture(scope="module")
def estimator() -> Estimator:
    return load_estimator(os.environ["TWIN_MODEL"])


@pytest.fixture(scope="module")
def corpus() -> twin.Corpus:
    return twin.Corpus(os.environ["TWIN_CORPUS"])


def held_out(corpus: twin.Corpus) -> list[int]:
    return [int(n) for n in corpus.samples if corpus.plan.group(int(n)) == TEST]


def own(corpus: twin.Corpus, number: int) -> Received:
    levels = range(corpus.levels)
    images = np.stack([corpus.image(number, level) for level in levels]).astype(np.float32)
    references = np.stack([corpus.reference(number, level) for level in levels]).astype(np.float32)
    names = tuple(f"{number}/{level}" for level in levels)
    return Received(images, references, 1, 16, corpus.design.camera.bits, names)


def another(corpus: twin.Corpus, number: int) -> Received:
    """The same light through a camera with other noise that stands 1 % off in all ways."""
    levels = range(corpus.levels)
    lit = np.stack([corpus.radiance(number, level).sum(0) for level in levels])
    plain = np.stack([corpus.reference_radiance(number, level).sum(0) for level in levels])
    return real_camera(corpus.design_of(number), lit, plain, number)


def truth(corpus: twin.Corpus, number: int) -> NDArray[np.float64] | None:
    inclusion = corpus.plan.inclusion(number)
    return None if inclusion is None else np.array([corpus.plan.parameters(number)[name] for name in NAMES])


def refused(estimator: Estimator, received: Received) -> bool:
    """Whether `twin estimate` refuses pictures: for themselves, or as unlike this sensor's."""
    try:
        for stack in (received.images, received.references):
            for picture in stack:
                check_exposure(picture, received.bits, "picture")
        check_pair(received)
    except DesignError:
        return True
    seen = estimator.coarse(received) + black(estimator.chain)
    like, _ = likeness.likeness(estimator.novelty, seen[:, 0], seen[:, 1])
    return bool(like < estimator.card["refuse_below"])


def test_valid_pictures_are_taken_and_others_refused(estimator: Estimator, corpus: twin.Corpus) -> None:
    numbers = held_out(corpus)[:VALID]
    valid = [refused(estimator, own(corpus, number)) for number in numbers]
    moved = [refused(estimator, another(corpus, number)) for number in numbers[::4]]
    large = next(n for n in numbers if (size := truth(corpus, n)) is not None and size[0] > 7.0)
    strange = list(aliens(own(corpus, large)))
    found = Counter(one.family for one in strange if refused(estimator, one.received))
    print(
        f"\nrefused: {sum(valid)} of {len(valid)} valid, {sum(moved)} of {len(moved)} of another camera, "
        f"{found.total()} of {len(strange)} strange ones: {dict(found)}"
    )
    assert sum(valid) <= 0.02 * len(valid) and sum(moved) <= 0.02 * len(moved)
    assert found.total() >= 0.95 * len(strange)


@pytest.mark.timeout(3600)
def test_noise_alone_explains_what_is_not_rendered_at_the_truth(
    estimator: Estimator, corpus: twin.Corpus
) -> None:
    """Chi-square per feature of a corpus of the model's own chain, of one exposure and means of 100, with
    what rounding does to dim blocks taken as known and as noise; five seconds a sample."""
    own = replace(estimator, calibration=None)
    chain, features, levels = own.chain, own.sight.features, levels_of(corpus, own)
    found: dict[tuple[int, bool], list[float]] = {}
    numbers = [number for number in held_out(corpus) if truth(corpus, number) is not None][: 2 * ANSWERED]
    for number in numbers:
        values = values_of(corpus, own, number, levels)
        light, gain = rendered(chain, own.traced, values), chain.gain(values)
        known_light = rendered(chain, own.traced, values, rounded=True)
        for frames in (1, 100):
            if frames == 1:
                seen = stored(own, corpus, number, levels)
            else:
                seen = averaged(own, corpus, number, levels, frames, 0)
            for known in (False, True):
                told = known_light if known else light
                noise = covariance(chain, features, light, gain, frames, rounded=known)
                left = (features(seen[None]) - features(told[None]))[0].astype(np.float64)
                share = left @ np.linalg.solve(noise, left) / len(left)
                found.setdefault((frames, known), []).append(float(share))
    spread = np.sqrt(2.0 / (len(numbers) * len(features.spread)))
    for (frames, known), shares in found.items():
        print(
            f"{frames} exposures, rounding {'known' if known else 'as noise'}: {np.mean(shares):.3f} of "
            f"{len(shares)}, by chance 1 +- {spread:.3f}; the worst {max(shares):.2f}"
        )
    for frames in (1, 100):
        assert abs(np.mean(found[frames, True]) - 1.0) < 4.0 * spread


@pytest.mark.timeout(3600)
def test_two_rendered_pictures_make_the_bound_right(estimator: Estimator, corpus: twin.Corpus) -> None:
    """Against the bound with each derivative rendered, of means of 100; two minutes an inclusion."""
    own = replace(estimator, calibration=None)
    chain, features, prior = own.chain, own.sight.features, own.prior
    levels, mapped, made = levels_of(corpus, own), [], []
    for number in held_out(corpus):
        true = truth(corpus, number)
        if true is None or true[0] < 4.0:
            continue
        values = values_of(corpus, own, number, levels)
        ends, apart = differences(prior, prior.unknowns(values))
        seen = np.stack([rendered(chain, own.traced, prior.values(end), rounded=True) for end in ends])
        told = features(seen).astype(np.float64)
        slopes = (told[1::2] - told[::2]) / apart[:, None]
        light = rendered(chain, own.traced, values)
        noise = covariance(chain, features, light, chain.gain(values), 100, rounded=True)
        least = np.linalg.inv(slopes @ np.linalg.solve(noise, slopes.T) + prior.precision)
        right = np.sqrt(np.diag(least)[: len(NAMES)])
        for more, found in ((0.0, mapped), (own.more_along_valley(values), made)):
            found.append(np.sqrt(np.diag(own.limits(values, 100, more)[0])[: len(NAMES)]) / right)
        print(number, true.round(2), right.round(4), mapped[-1].round(3), made[-1].round(3), flush=True)
        if len(made) == ANSWERED // 2:
            break
    assert np.all(np.abs(np.array(made) - 1.0) < 0.06)


@pytest.mark.timeout(3600)
def test_fits_to_means_find_what_is_most_probable_to_first_order_at_the_truth(
    estimator: Estimator, corpus: twin.Corpus
) -> None:
    """An answer that knows the truth and is one linear step from it, with what pictures change by along the
    valley rendered: what noise moves it by, the fit is to be moved by, too. Moduli are compared by -1/E, in
    which the valley is even. Half a minute an inclusion."""
    own = replace(estimator, calibration=None)
    chain, features, prior = own.chain, own.sight.features, own.prior
    levels, found = levels_of(corpus, own), []
    for number in held_out(corpus):
        true = truth(corpus, number)
        if true is None or true[0] < 5.0 or not 50.0 < true[2] < 100.0:  # ends of the ranges bend answers
            continue
        values = values_of(corpus, own, number, levels)
        x = prior.unknowns(values)
        seen = averaged(own, corpus, number, levels, 100, 0)
        light = rendered(chain, own.traced, values, rounded=True)
        _, slopes = jacobian(chain, features, prior, x)
        slopes[2] += own.more_along_valley(values)
        noise = covariance(chain, features, light, chain.gain(values), 100, rounded=True)
        weighted = np.linalg.solve(noise, slopes.T).T
        bound = np.linalg.inv(weighted @ slopes.T + prior.precision)
        left = (features(seen[None]) - features(light[None]))[0].astype(np.float64)
        step = (bound @ (weighted @ left - prior.precision @ (x - prior.middle)))[: len(NAMES)]
        start = own.unscaled(own.network.sample(features(seen[None]), 100, 1000, 0)[0]).mean(axis=0)
        told = own.refined(seen, 100, start)
        assert told is not None and told.explains
        drawn, even = told.samples[:, : len(NAMES)].copy(), true.copy()
        step[2] /= true[2] ** 2
        drawn[:, 2], even[2] = -1.0 / drawn[:, 2], -1.0 / true[2]
        spread = drawn.std(axis=0)
        found.append((step / spread, (drawn.mean(axis=0) - even) / spread))
        print(number, true.round(2), *(one.round(2) for one in found[-1]), flush=True)
        if len(found) == 2 * ANSWERED:
            break
    first, fits = np.array(found).swapaxes(0, 1)
    apart = np.sqrt(np.mean((fits - first) ** 2, axis=0))
    print(
        f"{len(found)} inclusions: fits are {apart.round(3)} sd from first order rms, "
        f"{np.sqrt(np.mean(fits**2, axis=0)).round(2)} from the truth"
    )
    assert np.all(apart < 0.25)


@pytest.mark.timeout(3600)
def test_another_camera_that_stands_off_is_within_twice_the_error(
    estimator: Estimator, corpus: twin.Corpus
) -> None:
    """On the same inclusions; half a minute each for its own camera, a minute for the other."""
    off: dict[str, list[NDArray[np.float64]]] = {"own": [], "another": []}
    for number in held_out(corpus):
        true = truth(corpus, number)
        if true is None or true[0] < 4.0:
            continue
        for name, received in (("own", own(corpus, number)), ("another", another(corpus, number))):
            answer = estimator.estimate(received, samples=2000)
            off[name].append(answer.mean - true)
            print(number, name, true.round(2), off[name][-1].round(3), answer.method, flush=True)
        if len(off["own"]) == ANSWERED:
            break
    one, other = (np.sqrt((np.array(errors) ** 2).mean(axis=0)) for errors in off.values())
    print(
        f"RMSE of {ANSWERED}: own {one.round(3)}, another {other.round(3)}, ratios {(other / one).round(2)}"
    )
    assert np.all(other < 2.0 * one)
