"""A calibrated model before pictures with and without inclusion that it did not make. Give it and a corpus of
full solves; the shipped one and sixteen other inclusions:

TWIN_MODEL=tsis TWIN_CORPUS=corpora/phantoms pytest -m slow -s tests/bench/test_presence.py
"""

import os

import numpy as np
import pytest

import twin
from twin.estimator import exposures
from twin.estimator_file import load_estimator
from twin.exposure import take
from twin.received import Received

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(  # one alone is an error
        not {"TWIN_MODEL", "TWIN_CORPUS"} & set(os.environ), reason="needs TWIN_MODEL and TWIN_CORPUS"
    ),
]


def test_inclusions_are_told_from_none() -> None:
    """Without one is an exposure of the reference's light."""
    estimator, corpus = load_estimator(os.environ["TWIN_MODEL"]), twin.Corpus(os.environ["TWIN_CORPUS"])
    levels, told = range(corpus.levels), []
    for number in map(int, corpus.samples):
        references = np.stack([corpus.reference(number, level) for level in levels]).astype(np.float32)
        with_it = [corpus.image(number, level) for level in levels]
        design, seeds = corpus.design_of(number), iter(range(100, 200))
        plain = [take(design, corpus.reference_radiance(number, level), next(seeds), 1.0) for level in levels]
        chances = []
        for pictures in (with_it, plain):
            received = Received(
                np.stack(pictures).astype(np.float32), references, 1, 16, 8, ("",) * len(levels)
            )
            seen, frames = estimator.coarse(received), exposures(received)
            features = estimator.features(seen[None])
            start = estimator.unscaled(estimator.network.sample(features, frames, 1000, 0)[0]).mean(axis=0)
            network = float(estimator.network.present(features, frames)[0])
            chances += [estimator.presence(seen, frames, start), network]
        print(number, "with {:.3g}, network {:.3g}; without {:.3g}, network {:.3g}".format(*chances))
        told.append(chances)
    there, _, absent, _ = np.transpose(told)
    assert there.min() > 0.999 and absent.max() < 0.001
