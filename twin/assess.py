"""How well an estimator does on samples that it has not seen, beside the bound of its own forward model.

Pictures of one exposure are the stored ones, as the camera took them; means of many are taken of the stored
light, rounded exposures each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

import fem
from estimation.posterior import REFERENCE_FRAMES
from twin import retake
from twin.corpus import Corpus
from twin.estimates import NAMES
from twin.estimator import Estimator
from twin.received import Received

if TYPE_CHECKING:
    from twin.train import Seen

Floats = NDArray[np.float64]

FRAMES = (1, 100)
LEAST_MM, LARGE_MM = 4.0, 8.0
"""Sizes from which an inclusion counts as seen, and from which its modulus should show."""
_DRAWS = 2000
_BINS = 20  # of ranks


def assess(
    estimator: Estimator,
    source: Corpus,
    seen: Seen,
    levels: Sequence[int],
    seed: int,
    tell: Callable[[float], None],
) -> dict[str, Any]:
    """Return figures of an estimator on held-out samples, by exposures."""
    there = np.flatnonzero(~seen.blank)
    truth = np.array([[seen.values[row][name] for name in NAMES] for row in there])
    found: dict[str, Any] = {"samples": len(there), "blanks": int(seen.blank.sum())}
    if not len(there):
        return found
    for frames in FRAMES[:1]:  # means of many take minutes: `twin assess`
        pictures = np.stack([stored(estimator, source, int(n), levels) for n in seen.numbers])
        features = estimator.features(pictures)
        unit = estimator.network.sample(features[there], frames, _DRAWS, seed)
        drawn = estimator.unscaled(unit)[..., : len(NAMES)]
        lowest = np.full((len(there), len(NAMES)), np.nan)
        for place, row in enumerate(there):
            try:
                least, _ = estimator.limits(seen.values[row], frames)
                lowest[place] = np.sqrt(np.diag(least)[: len(NAMES)])
            except fem.NotModelled:
                continue
            tell(place / len(there))
        presence = estimator.network.present(features, frames)
        found[str(frames)] = {
            **figures(summed_up(drawn, truth), truth, lowest, estimator.prior.ranges),
            "presence": found_or_not(presence, seen.blank, truth),
        }
    return found


def stored(estimator: Estimator, source: Corpus, number: int, levels: Sequence[int]) -> NDArray[np.float32]:
    """Return a sample's coarse pictures as the camera took them."""
    images = np.stack([source.image(number, level) for level in levels]).astype(np.float32)
    references = np.stack([source.reference(number, level) for level in levels])
    frames = source.design.camera.frames
    received = Received(images, references, frames, max(frames, REFERENCE_FRAMES), estimator.card["bits"], ())
    return estimator.coarse(received)


def averaged(
    estimator: Estimator, source: Corpus, number: int, levels: Sequence[int], frames: int, seed: int
) -> NDArray[np.float32]:
    """Return a sample's coarse pictures as means of so many exposures, taken anew."""
    design, rng = source.design_of(number), np.random.default_rng([seed, number, frames])
    count = max(frames, REFERENCE_FRAMES)
    images = [retake.mean_of(design, source.layers(number, level), frames, rng) for level in levels]
    plain = [retake.mean_of(design, source.reference_layers(number, level), count, rng) for level in levels]
    bits = estimator.card["bits"]
    return estimator.coarse(Received(np.stack(images), np.stack(plain), frames, count, bits, ()))


@dataclass(frozen=True)
class Answers:
    """Posteriors of n inclusions in short, (n, 3) each.

    Attributes
    ----------
    mean, sd, low, high : of the posterior; low and high are the ends of the central 90 %.
    rank : share of the posterior below the truth.
    """

    mean: Floats
    sd: Floats
    low: Floats
    high: Floats
    rank: Floats


def summed_up(drawn: Floats, truth: Floats) -> Answers:
    """Return samples (n, s, 3) of posteriors in short."""
    low, high = np.percentile(drawn, [5.0, 95.0], axis=1)
    rank = (drawn < truth[:, None]).mean(axis=1)
    return Answers(drawn.mean(axis=1), drawn.std(axis=1), low, high, rank)


def figures(answers: Answers, truth: Floats, limits: Floats, ranges: Floats) -> dict[str, Any]:
    """Return how well posteriors tell, beside truth and bounds (n, 3) and ranges (5, 2).

    Root mean square errors of the mean; share of the variance explained that the bound allows; covering of
    90 % intervals; chi-square test of the truth's ranks (Talts et al. 2018; [talts2018]).
    """
    error = answers.mean - truth
    inside = (truth >= answers.low) & (truth <= answers.high)
    prior = (ranges[: len(NAMES), 1] - ranges[: len(NAMES), 0]) / np.sqrt(12.0)
    found: dict[str, Any] = {}
    for name, rows in (
        ("4 mm and more", truth[:, 0] >= LEAST_MM),
        ("8 mm and more", truth[:, 0] >= LARGE_MM),
    ):
        if not rows.any():
            continue
        rmse, least = _rms(error[rows]), _rms(limits[rows])
        found[name] = {
            "samples": int(rows.sum()),
            "rmse": _named(rmse),
            "bias": _named(error[rows].mean(axis=0)),
            "bound": _named(least),
            "over_bound": _named(rmse / least),
            "explained": _named((prior**2 - rmse**2) / (prior**2 - least**2)),
            "posterior_sd": _named(_rms(answers.sd[rows])),
        }
    counts = [np.histogram(answers.rank[:, place], _BINS, (0.0, 1.0))[0] for place in range(len(NAMES))]
    found["covered_90"] = _named(inside.mean(axis=0))
    found["rank_p"] = _named(np.array([stats.chisquare(count).pvalue for count in counts]))
    return found


def found_or_not(presence: Floats, blank: NDArray[np.bool_], truth: Floats) -> dict[str, Any]:
    """Area under the curve of all held-out samples, and share of inclusions found at 5 % false alarms."""
    empty, full = presence[blank], presence[~blank]
    if not len(empty) or not len(full):
        return {}
    area = float((full[:, None] > empty).mean() + 0.5 * (full[:, None] == empty).mean())
    line = float(np.percentile(empty, 95.0))
    sizes = (("2 to 4 mm", 2.0, 4.0), ("4 to 8 mm", 4.0, 8.0), ("8 mm and more", 8.0, np.inf))
    found = {
        name: float((full[(truth[:, 0] >= low) & (truth[:, 0] < high)] > line).mean())
        for name, low, high in sizes
        if ((truth[:, 0] >= low) & (truth[:, 0] < high)).any()
    }
    return {"area": area, "found_at_5_percent": found}


def _rms(values: Floats) -> Floats:
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=0)))


def _named(values: NDArray[Any]) -> dict[str, float]:
    return {name: float(value) for name, value in zip(NAMES, values, strict=True)}


def words(metrics: dict[str, Any], model: str) -> str:
    """Return what a person wants to know of a trained estimator, several lines."""
    lines = []
    for frames in FRAMES:
        one = metrics.get(str(frames))
        if one is None:
            continue
        for name in ("4 mm and more", "8 mm and more"):
            part = one.get(name)
            if part is None:  # none that large was held out
                continue
            words = ", ".join(
                f"{short} {part['rmse'][key]:.3g} (bound {part['bound'][key]:.3g})"
                for short, key in zip(("d", "h", "E"), NAMES, strict=True)
            )
            lines.append(
                f"{frames} exposure{'s' * (frames > 1)}, {part['samples']} held-out inclusions of {name}: "
                f"RMSE {words}; E explained {100 * part['explained']['modulus_kPa']:.0f} %"
            )
        covered = ", ".join(f"{100 * value:.0f} %" for value in one["covered_90"].values())
        lines.append(f"  90 % intervals cover {covered} (d, h, E)")
        if one["presence"]:
            lines.append(f"  inclusion or none: area under the curve {one['presence']['area']:.3f}")
    return "\n".join([*lines, f"model: {model}"])
