"""``twin train`` from a corpus to a model that answers, on a small camera with a made-up emulator."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from corpora import freeze_tiny, make_up_emulator
from scipy.ndimage import gaussian_filter

import twin
from twin import index, sample, store
from twin.block_noise import mean_variance
from twin.calibrate import _drawn, calibrate, calibrated, check_paths
from twin.complaint import DesignError
from twin.discrepancy import Discrepancy
from twin.estimator import Estimator, Sight, black
from twin.estimator_file import emulator_of, load_estimator, save_estimator
from twin.imagined import Brightness, pictures
from twin.likeness import likeness
from twin.plan import load_plan
from twin.received import Received
from twin.train import train

pytestmark = pytest.mark.slow

MORE = """
offset_x_mm = [-1, 1]
offset_y_mm = [-1, 1]
[[samples]]
name = "test"
sampler = "uniform"
count = 8
blanks = 0.25
[samples.inclusion]
size_mm = [6, 12]
depth_mm = [4, 6]
modulus_kPa = [40, 120]
offset_x_mm = [-1, 1]
offset_y_mm = [-1, 1]
[randomise."camera.gain_e_per_dn"]
distribution = "lognormal"
sd = 0.02
"""


@pytest.fixture(scope="module")
def corpus(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("corpus")
    emulator = make_up_emulator(folder / "made-up.npz")
    place = freeze_tiny(folder, 36, (1.0, 2.0), emulator=emulator, rows=96, leds=1, more=MORE)
    plan = load_plan(place)
    for number in range(len(plan)):
        sample.make(plan, number, place)
    index.build(place, plan, store.sha256(place / "plan.json"))
    return place


@pytest.fixture(scope="module")
def model(corpus, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("models") / "tiny"
    assert "held-out" in train(corpus, out, minutes=0.3, imagined=400, workers=1)
    return out.with_suffix(".safetensors")


def received(corpus: Path, number: int) -> Received:
    read = twin.Corpus(corpus)
    images = np.stack([read.image(number, level) for level in range(2)]).astype(np.float32)
    references = np.stack([read.reference(number, level) for level in range(2)])
    return Received(images, references, 1, 16, 8, ("1", "2"))


def test_it_answers_and_says_the_same_twice(corpus, model):
    estimator = load_estimator(model)
    assert isinstance(estimator, Estimator)
    first, again = (estimator.estimate(received(corpus, 40), samples=500, seed=3) for _ in range(2))
    low, high = estimator.prior.ranges[:3].T
    assert np.all((first.samples >= low) & (first.samples <= high))
    assert np.array_equal(first.samples, again.samples) and 0.0 <= first.presence <= 1.0
    assert first.observed.shape == first.predicted.shape == (2, 8, 10)


def test_the_card_tells_how_well_it_does(model):
    card = json.loads(model.with_suffix(".json").read_text(encoding="utf-8"))
    assert card["samples"]["learned"] == 36 and card["metrics"]["samples"] == 6
    part = card["metrics"]["1"]["4 mm and more"]
    assert part["rmse"]["size_mm"] > 0.5 * part["bound"]["size_mm"] > 0.0


def test_what_was_done_is_not_done_again(corpus, model):
    kept = next((model.parent / "tiny.parts").glob("pictures-*.npz"))
    before = kept.stat().st_mtime_ns
    said = json.loads(model.with_suffix(".json").read_text(encoding="utf-8"))
    train(corpus, model.with_suffix(""), minutes=0.3, imagined=400, workers=1)
    again = json.loads(model.with_suffix(".json").read_text(encoding="utf-8"))
    assert again["sha256"] == said["sha256"] and kept.stat().st_mtime_ns == before


def test_files_of_a_stranger_are_refused(model, tmp_path):
    data, card = model.read_bytes(), model.with_suffix(".json").read_text(encoding="utf-8")
    place = tmp_path / "m.safetensors"

    def refused(arrays: bytes, said: str, match: str) -> None:
        place.write_bytes(arrays)
        place.with_suffix(".json").write_text(said, encoding="utf-8")
        with pytest.raises(DesignError, match=match):
            load_estimator(place)

    turned = bytearray(data)
    turned[-1] ^= 1
    refused(bytes(turned), card, "sha256")
    refused(data[:1000], card, "sha256")
    refused(data, "{}", "format is not")
    refused(data, card.replace('"refuse_below"', '"other"'), "refuse_below")
    other = json.loads(card)
    other["features"][0] = 7
    refused(data, json.dumps(other), "do not fit")
    refused(data, card.replace('"width": 256', '"width": 1000000000'), "network: received")


def test_a_corpus_that_cannot_teach_is_refused(tmp_path):
    place = freeze_tiny(tmp_path, 3, (1.0,))
    index.build(place, load_plan(place), store.sha256(place / "plan.json"))
    with pytest.raises(DesignError):
        train(place, tmp_path / "m", minutes=0.1)


def test_a_corpus_of_few_samples_is_refused_before_any_is_read(finished_corpus, tmp_path):
    with pytest.raises(DesignError, match="samples: received 4 samples; allowed 30 or more"):
        train(finished_corpus, tmp_path / "m", minutes=0.1)
    assert list(tmp_path.iterdir()) == []


def test_only_a_model_that_renders_is_calibrated(corpus, model, tmp_path):
    with pytest.raises(DesignError, match="without learned light"):
        calibrate(model, corpus, tmp_path / "m")
    assert list(tmp_path.iterdir()) == []


def test_samples_of_the_same_light_paths_calibrate_nothing(tmp_path):
    plan = load_plan(freeze_tiny(tmp_path, 3, (1.0,)))
    check_paths(replace(plan, head=replace(plan.head, light_seed="own")))
    with pytest.raises(DesignError, match=r"light_seed: received 'shared'; allowed \"own\""):
        check_paths(plan)


def test_known_pictures_tell_how_far_others_are_off(model):
    """Pictures with a ripple of their own strength in each, as another solver's would have: as trained, fits
    are far surer than right and the pictures strange; 24 known ones mend both for 12 others."""
    estimator = load_estimator(model)
    chain, prior = estimator.chain, estimator.prior
    many = _drawn(estimator)[:36]
    bright = Brightness.of(chain, many)
    own, rng = pictures(chain, chain.inputs(many), bright), np.random.default_rng(4)
    smooth = gaussian_filter(rng.standard_normal(own.shape[1:]), (0.0, 0.0, 1.0, 1.0))
    noise = np.sqrt(mean_variance(chain.design, own, bright.gain, 100.0).mean(axis=(0, 2), keepdims=True))
    strength = rng.standard_normal((len(many), 1, 1, 1, 1))
    own += noise * rng.standard_normal(own.shape)  # the light map's own error
    seen = (own + 20.0 * strength * noise * smooth / smooth.std()).astype(np.float32)
    made = calibrated(estimator, many[:24], seen[:24], own[:24])

    def judged(one: Estimator) -> tuple[float, float]:
        off, like = [], []
        for values, picture in zip(many[24:], seen[24:], strict=True):
            truth = prior.unknowns(values)
            found = one.fitted(picture, 100.0, truth[:5])
            off.append((found.x - truth) / np.sqrt(np.diag(found.covariance)))  # whichever it pulls at
            counts = picture + black(chain)
            like.append(likeness(one.novelty, counts[:, 0], counts[:, 1])[0])
        return float(np.sqrt(np.mean(np.square(off)))), float(np.median(like))

    before, after = judged(estimator), judged(made)
    assert before[0] > 3.0 and 0.4 < after[0] < 1.6
    assert before[1] < 0.005 < after[1]


def test_a_calibrated_model_is_kept_and_read(model, tmp_path):
    """Features of their own with noise by blocks, and what they are off by; a stranger's are checked."""
    estimator = load_estimator(model)
    shape = estimator.features.shape
    noise = np.ones(shape, np.float32) * estimator.features.noise
    flat = 1.0 + 0.1 * np.random.default_rng(1).random((shape[0], *shape[2:]), np.float32)
    share = np.full(shape[0], 0.9, np.float32)
    sight = Sight(
        replace(estimator.features, noise=noise),
        estimator.error,
        Discrepancy(2.0 * estimator.error, estimator.error, flat, share),
    )
    place = tmp_path / "m.safetensors"
    save_estimator(replace(estimator, calibration=sight), emulator_of(model), place)
    again = load_estimator(place).calibration
    assert again is not None and again.discrepancy is not None
    inclusion = np.stack([np.full((2, 2), 3.0), np.zeros((2, 2))])[None]
    assert np.allclose(again.off(inclusion), (2.0 + 3.0) * estimator.error)
    pictures = np.random.default_rng(0).random((2, *shape), np.float32)
    assert np.array_equal(again.features(pictures), estimator.features(pictures))
    plain = pictures[0, :, 1]
    level = again.without(flat[:, None] * np.stack([plain + share[:, None, None], plain], axis=1))
    assert np.allclose(level[:, 1], plain) and np.allclose(level[:, 0] - level[:, 1], 1.0, atol=1e-5)
    for change in ({"tared": np.eye(3)}, {"flat": flat[:1]}, {"share": share[:1]}, {"flat": 0 * flat}):
        wrong = replace(sight, discrepancy=replace(sight.discrepancy, **change))
        save_estimator(replace(estimator, calibration=wrong), emulator_of(model), place)
        with pytest.raises(DesignError, match="do not fit"):
            load_estimator(place)
