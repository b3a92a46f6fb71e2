"""`twin calibrate`: how far pictures of known inclusions are from what a model renders for them.

The emulator, the learned light and the meshes behind them are off by about a per cent, ten times the noise of
a picture: an estimator that trusts its chain is sure of nonsense where pictures come from elsewhere. What a
few dozen pictures are off by is taken for a normal error of all that follow, the model's discrepancy (Kennedy
and O'Hagan 2001; [kennedy2001]).
"""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from estimation.features import compress
from twin import retake
from twin.assessing import Sample, levels_of, loaded, one_thread, opened, values_of
from twin.block_noise import mean_variance
from twin.chain import BLOCK, whole_blocks
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.discrepancy import alike, error_of, evened, told_by
from twin.estimator import Estimator, Sight
from twin.estimator_file import emulator_of, file_of, load_estimator, save_estimator, shares_of
from twin.fitting import inside, reachable
from twin.frame import versions
from twin.imagined import Brightness, pictures
from twin.planned import Plan
from twin.pooled import each
from twin.rendered import rendered
from twin.train import LIKE, likeness_of

Floats = NDArray[np.float64]
Single = NDArray[np.float32]

LEAST = 12
"""Samples that a calibration needs."""
_NEAR = 1.5  # blocks over which squared differences are averaged: few samples tell each block's badly


def calibrate(
    model: str | Path,
    corpus: str | Path,
    out: str | Path,
    *,
    samples: int | None = None,
    workers: int | None = None,
    lean: bool = False,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> str:
    """Write a model that also knows how far pictures of a corpus are from its own, as OUT.safetensors and
    OUT.json; say how far that is.

    Parameters
    ----------
    samples : the first so many; all by default.
    lean : as of `twin.estimator_file.save_estimator`.

    Raises
    ------
    DesignError
        In one line: for another sensor, too few samples, a model that renders nothing, and a corpus whose
        samples share their light paths.
    fem.NotModelled
        In one line, for a sample that the model's emulator does not know.
    """
    source, estimator, place = Corpus(corpus), load_estimator(model), Path(f"{out}.safetensors")
    if place.resolve() == file_of(model).resolve():
        raise DesignError("--out", shown(str(out)), "another place than the model's own")
    if not estimator.traced:
        allowed = "one that was trained on a corpus with --traced"
        raise DesignError("MODEL", "one without learned light", allowed, source=str(model))
    if lean:
        shares_of(emulator_of(model), estimator.traced)
    check_paths(source.plan)
    levels = levels_of(source, estimator)
    numbers = [int(n) for n in source.samples if source.plan.inclusion(int(n)) is not None][:samples]
    if len(numbers) < LEAST:
        raise DesignError("samples", shown(len(numbers)), f"{LEAST} or more inclusions", source=source.name)
    made_of = ("of the whole design", estimator.card["sha256"], source.plan.digest, versions())
    key = hashlib.sha256(repr(made_of).encode()).hexdigest()
    folder = place.with_name(place.stem + ".parts") / f"rendered-{key[:16]}"
    folder.mkdir(parents=True, exist_ok=True)
    tasks = [Sample(str(model), str(corpus), number, folder / f"{number:06d}.npz") for number in numbers]
    left = [task for task in tasks if not task.place.is_file()]

    def share(count: int) -> None:
        progress("samples", 1.0 - (len(left) - count) / len(tasks))

    share(0)
    each(compare, left, workers or os.cpu_count() or 1, one_thread, share)
    values = [values_of(source, estimator, number, levels) for number in numbers]
    seen, own = (np.stack(each_of) for each_of in zip(*map(_read, tasks), strict=True))
    tared, off = own[:, :, 0] - own[:, :, 1], seen - own
    shares = [
        np.sqrt((off[:, :, 1] ** 2).mean(axis=(2, 3))) / own[:, :, 1].mean(axis=(2, 3)),
        np.sqrt(((off[:, :, 0] - off[:, :, 1]) ** 2).mean(axis=(2, 3))) / tared.max(axis=(2, 3)),
    ]
    reference, of_tared = (100.0 * float(np.sqrt((one**2).mean())) for one in shares)
    made = calibrated(estimator, values, seen, own)
    card = {
        **estimator.card,
        "name": place.stem,
        "calibrated": {
            "corpus": source.name,
            "samples": len(numbers),
            "off_percent": {"references": reference, "tared": of_tared},
        },
    }
    save_estimator(replace(made, card=card), emulator_of(model), place, lean=lean)
    return (
        f"{len(numbers)} inclusions of {source.name}: references are off by {reference:.2f} % of their mean, "
        f"tared pictures by {of_tared:.2f} % of their maximum (root mean square)\nmodel: {place}"
    )


def check_paths(plan: Plan) -> None:
    """Raise `DesignError` where samples share their light paths: what those are off by would pass for what is
    off everywhere, and that of other paths for nothing."""
    if plan.traced is None and plan.light_seed == "shared":
        raise DesignError("light_seed", shown(plan.light_seed), '"own"', source=plan.name)


def calibrated(estimator: Estimator, values: list[dict[str, float]], seen: Single, own: Single) -> Estimator:
    """Return the estimator that knows of differences between pictures of the corpus and what it renders, both
    (n, levels, 2, r, c) expected counts above black, for n specimens' values.

    What they are off by every time is taken out of pictures. Fits look less where the rest is: new features
    weigh each block by its noise and by what it is off.
    """
    chain, specimens = estimator.chain, _drawn(estimator)
    bright = Brightness.of(chain, specimens)
    many = pictures(chain, chain.inputs(specimens), bright)
    mapped = pictures(chain, chain.inputs(values), Brightness.of(chain, values))
    noise = mean_variance(chain.design, many, bright.gain, 1.0).mean(axis=0)
    flat, share = alike(seen, own)
    level = evened(seen, flat, share)
    off = level - own
    apart = np.stack([off[:, :, 0] - off[:, :, 1], off[:, :, 1]], axis=2)
    missed = gaussian_filter((apart**2).mean(axis=0), (0.0, 0.0, _NEAR, _NEAR))
    features = compress(many, np.sqrt(np.stack([noise.sum(axis=1), noise[:, 1]], axis=1) + missed))
    sight = Sight(features, error_of(features, mapped, own), told_by(features, level, own, flat, share))
    novelty = likeness_of(chain, chain.inputs(specimens), specimens, seen - mapped, 0)
    return replace(estimator, calibration=sight, novelty=novelty)


def _drawn(estimator: Estimator) -> list[dict[str, float]]:
    """Specimens of the estimator's prior."""
    prior, rng = estimator.prior, np.random.default_rng(12)
    low, high = prior.ranges.T
    unknowns = rng.standard_normal((LIKE, len(prior.middle)))
    unknowns[:, :5] = low + (high - low) * rng.random((LIKE, 5))
    return [reachable(estimator.chain, prior.values(inside(prior, x))) for x in unknowns]


def _read(task: Sample) -> tuple[Single, Single]:
    with np.load(task.place, allow_pickle=False) as file:
        return file["seen"], file["rendered"]


def compare(task: Sample) -> None:
    """Keep what a corpus has of a sample, without noise, beside what the model renders; runs in a worker."""
    estimator, source = loaded(task.model), opened(task.corpus)
    levels = levels_of(source, estimator)
    design = source.design_of(task.number)

    def coarse(layers: Single) -> Single:
        charge = retake.charge(design, layers, None, (1, 1)) / np.float32(design.camera.gain_e_per_dn)
        return retake.average(whole_blocks(charge), BLOCK)

    seen = [
        [coarse(layers(task.number, level)) for layers in (source.layers, source.reference_layers)]
        for level in levels
    ]
    values = values_of(source, estimator, task.number, levels)
    own = rendered(estimator.chain, estimator.traced, values, threads=1)
    part = task.place.with_name(f".{task.place.name}.{os.getpid()}.part.npz")
    np.savez(part, seen=np.asarray(seen, np.float32), rendered=own)
    os.replace(part, task.place)
