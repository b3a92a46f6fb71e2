"""`twin replicate`: the paper's numbers from a corpus, beside what the paper printed.

Everything is a function of the corpus, the seed and the settings below; what is simulated on the way (2-D
solutions, one cut for Fig. 4) is deterministic. Estimates of a phantom are means over the repeats.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from twin import inversion, thresholds
from twin.complaint import DesignError
from twin.earlier import Earlier, earlier
from twin.inversion import Scalars, Variant

if TYPE_CHECKING:
    from estimation.ann import Settings
    from twin.corpus import Corpus

Floats = NDArray[np.float64]

MAIN_MM = 2.0
"""Press level of the main tables, where the corpus has it: the paper gives none."""

LARGE = np.array([1, 2, 3, 4, 5, 6, 7, 8])
"""Places in Table I of the phantoms of 7 mm and more."""

FEWEST_SEEN = 10
"""Random inclusions whose pictures must show a spot."""

FROM_MM = 4.0
"""Smallest of the random inclusions that chains are judged by: smaller ones hardly show."""

GOAL = {"size_mm": 0.6, "depth_mm": 0.8}
"""Root mean squared errors, mm, that three scalars should reach on the large phantoms."""

VARIANTS = (
    inversion.PLAIN,
    Variant("paper-phantoms", "the paper's chain, lines through the nine phantoms", source="phantoms"),
    Variant("paper-logs", "a line per scalar, network on logarithms", logs=True),
    Variant("paper-split", "a line per scalar, E with a network of its own", split=True),
    Variant("joint", "each surface scalar linear in all three of the picture", "joint"),
    Variant("joint-split", "joint linear map, E with a network of its own", "joint", split=True),
    Variant(
        "joint-logs-split",
        "joint map and network between logarithms, E with a network of its own",
        "joint",
        logs=True,
        split=True,
    ),
    Variant("picture", "no mapping: network trained on the picture's scalars", "network"),
    Variant("picture-split", "no mapping, E with a network of its own", "network", split=True),
    Variant(
        "picture-logs-split",
        "no mapping, logarithms, E with a network of its own",
        "network",
        logs=True,
        split=True,
    ),
    Variant("surface", "no picture: the network gets the surface's true scalars", "none"),
    Variant(
        "surface-logs-split",
        "no picture, logarithms, E with a network of its own",
        "none",
        logs=True,
        split=True,
    ),
)

CANDIDATES = tuple(one.name for one in VARIANTS if one.mapping != "none" and one.source == "box")
"""Chains that `chosen` is taken from: what can be asked of an unknown inclusion's picture."""


@dataclass(frozen=True)
class Run:
    """One chain on the nine phantoms.

    Attributes
    ----------
    variant : which.
    protocol : "125/9" or "leave-one-out".
    level_mm : nominal press levels whose scalars it takes.
    k_dn : threshold of the picture, counts.
    estimate : (9, 3) mean over the repeats.
    spread : (9, 3) standard deviation over the repeats.
    """

    variant: Variant
    protocol: str
    level_mm: tuple[float, ...]
    k_dn: float
    estimate: Floats
    spread: Floats


@dataclass(frozen=True)
class Crossed:
    """One chain on the random inclusions, cross-validated.

    Attributes
    ----------
    estimate, truth : (n, 3).
    rmse : (3,) over those of `FROM_MM` and more, as all below.
    half_width : (3,) of an interval around the estimate that holds 90 % of the truths.
    explained : (3,) share of the variance that the estimates explain, below 0 where worse than the mean.
    """

    variant: Variant
    level_mm: tuple[float, ...]
    k_dn: float
    estimate: Floats
    truth: Floats
    rmse: Floats
    half_width: Floats
    explained: Floats


@dataclass(frozen=True)
class Replication:
    """All that the report tells.

    Attributes
    ----------
    trained : random inclusions that networks are trained on.
    repeats, seed : of the networks.
    main_mm : press level of the main tables.
    k_dn, low_k_dn : the design's threshold, and the lowest that noise allows.
    noise_dn : of a pixel of the tared picture, standard deviation.
    levels : (level's mm, k) to its scalars.
    runs : all chains on the phantoms.
    crossed : chains on the random inclusions, main level, both thresholds.
    chosen : the chain (and k) that did best on the random inclusions.
    earlier : the methods before the paper.
    """

    trained: int
    repeats: int
    seed: int
    main_mm: float
    k_dn: float
    low_k_dn: float
    noise_dn: float
    levels: dict[tuple[float, float], Scalars]
    runs: list[Run] = field(default_factory=list)
    crossed: list[Crossed] = field(default_factory=list)
    chosen: tuple[str, float] = ("paper", 0.0)
    earlier: list[Earlier] = field(default_factory=list)

    def run(self, name: str, protocol: str, level_mm: Sequence[float], k_dn: float) -> Run:
        """Return one of the runs."""
        key = (name, protocol, tuple(level_mm), k_dn)
        return next(r for r in self.runs if (r.variant.name, r.protocol, r.level_mm, r.k_dn) == key)

    def best(self) -> Crossed:
        """Return what `chosen` did on the random inclusions."""
        return next(c for c in self.crossed if (c.variant.name, c.k_dn) == self.chosen)


def replicate(
    corpus: Corpus,
    *,
    repeats: int = 100,
    seed: int = 0,
    settings: Settings | None = None,
    progress: Callable[[str, float], None] | None = None,
) -> Replication:
    """Run the paper's chain, its variants and its predecessors on a corpus with the nine phantoms.

    Raises
    ------
    DesignError
        In one line, if the corpus has no phantoms or too few other samples.
    """
    tell = progress or (lambda stage, done: None)
    depths = corpus.indentation_mm
    main = int(np.argmin([abs(depth - MAIN_MM) for depth in depths]))
    source = str(corpus.path)
    k = corpus.design.signal.counts
    first = [inversion.scalars_of(corpus.table, step, mm, source) for step, mm in enumerate(depths)]
    noise, low, lowered = _lowered(corpus, first, main, tell)
    levels = {(data.level_mm[0], k): data for data in first} | {(d.level_mm[0], low): d for d in lowered}
    found = Replication(
        trained=len(first[main].box),
        repeats=repeats,
        seed=seed,
        main_mm=depths[main],
        k_dn=k,
        low_k_dn=low,
        noise_dn=noise,
        levels=levels,
    )
    _check_seen(levels[depths[main], k], k, source)
    ks = list(dict.fromkeys((k, low)))
    for number, one in enumerate(ks):
        for place, name in enumerate(CANDIDATES):
            found.crossed.append(cross(levels[depths[main], one], _variant(name), one, seed, settings))
            tell("cross-validation", (number * len(CANDIDATES) + place + 1) / (len(ks) * len(CANDIDATES)))
    best = min(found.crossed, key=lambda one: float(((one.rmse / one.truth.std(axis=0))[:2] ** 2).sum()))
    found = replace(found, chosen=(best.variant.name, best.k_dn))
    _run_all(found, ks, settings, tell)
    guesses = earlier(
        corpus,
        main,
        first[main].sample[first[main].phantoms],
        levels[depths[main], low].picture[first[main].phantoms],
        repeats=repeats,
        seed=seed,
        settings=settings,
        progress=lambda done: tell("earlier methods", done),
    )
    return replace(found, earlier=guesses)


def cross(
    data: Scalars, variant: Variant, k_dn: float, seed: int, settings: Settings | None = None
) -> Crossed:
    """Cross-validate a chain on the random inclusions."""
    truth = data.truth[data.box]
    guess = inversion.crossed(data, variant, seed=seed, settings=settings)
    off = guess - truth
    large = truth[:, 0] >= FROM_MM
    return Crossed(
        variant=variant,
        level_mm=data.level_mm,
        k_dn=k_dn,
        estimate=guess,
        truth=truth,
        rmse=np.sqrt((off[large] ** 2).mean(axis=0)),
        half_width=np.quantile(np.abs(off[large]), 0.9, axis=0, method="higher"),
        explained=1.0 - (off[large] ** 2).mean(axis=0) / truth[large].var(axis=0),
    )


def _run_all(
    found: Replication, ks: Sequence[float], settings: Settings | None, tell: Callable[[str, float], None]
) -> None:
    """All chains at the main level; the plain and the chosen one at every level, and by both protocols."""
    depths = sorted({mm for mm, _ in found.levels})
    name, k_best = found.chosen
    todo: list[tuple[Variant, bool, tuple[float, ...], float]] = []
    for k in ks:
        asked = [one for one in VARIANTS if one.mapping != "none" or k == ks[0]]  # which knows no k
        todo += [(variant, False, (found.main_mm,), k) for variant in asked]
        todo += [(_variant(one), True, (found.main_mm,), k) for one in ("paper", "paper-phantoms")]
    todo.append((_variant(name), True, (found.main_mm,), k_best))
    for mm in depths:
        todo += [(inversion.PLAIN, False, (mm,), k) for k in ks if _shows(found.levels[mm, k])]
        todo += [(_variant(name), False, (mm,), k_best)] * _shows(found.levels[mm, k_best])
    if len(depths) > 1 and all(_shows(found.levels[mm, k_best]) for mm in depths):
        todo += [(_variant(name), False, tuple(depths), k_best)]
    todo = list(dict.fromkeys(todo))
    networks: dict[tuple[object, ...], Any] = {}
    for place, (variant, left_out, some, k) in enumerate(todo):
        data = inversion.beside([found.levels[one, k] for one in some])
        cache = networks if variant.mapping != "network" else None  # its networks know k
        every = inversion.estimate(
            data,
            variant,
            left_out=left_out,
            repeats=found.repeats,
            seed=found.seed,
            settings=settings,
            cache=cache,
        )
        protocol = "leave-one-out" if left_out else "125/9"
        found.runs.append(Run(variant, protocol, some, k, every.mean(axis=0), every.std(axis=0)))
        tell("networks", (place + 1) / len(todo))


def _shows(data: Scalars) -> bool:
    """Whether enough pictures have a spot for lines through random inclusions and through phantoms."""
    return bool(data.seen[data.box].sum() >= FEWEST_SEEN and data.seen[data.phantoms].sum() >= 4)


def _check_seen(data: Scalars, k_dn: float, source: str) -> None:
    if not _shows(data):
        spots = f"{data.seen[data.box].sum()} random inclusions and {data.seen[data.phantoms].sum()} phantoms"
        received = f"a spot above {k_dn:g} counts for {spots} at {data.level_mm[0]:g} mm"
        allowed = f"{FEWEST_SEEN} and 4 or more: lower signal.counts, or press deeper"
        raise DesignError("corpus", received, allowed, source=source)


def _lowered(
    corpus: Corpus, first: Sequence[Scalars], main: int, tell: Callable[[str, float], None]
) -> tuple[float, float, list[Scalars]]:
    """Noise of a pixel, the lowest whole k that it allows, and the scalars at that k."""
    samples = first[main].sample
    probe = thresholds.sweep(corpus, main, most=15, surface=False, samples=samples)
    low = min(float(np.ceil(thresholds.SIGMAS * probe.noise_dn)), corpus.design.signal.counts)
    if low >= corpus.design.signal.counts:
        return probe.noise_dn, corpus.design.signal.counts, list(first)
    found = []
    for step, data in enumerate(first):
        swept = thresholds.sweep(
            corpus,
            step,
            most=len(samples),
            picture_k=[low],
            surface=False,
            samples=data.sample,
            progress=partial(_tell_part, tell, step, len(first)),
        )
        picture = np.column_stack([swept.max_dn[:, 0], data.picture[:, 1], swept.area_px[:, 0]])
        found.append(replace(data, picture=picture))
    return probe.noise_dn, low, found


def _tell_part(tell: Callable[[str, float], None], part: int, parts: int, done: int, total: int) -> None:
    tell("pictures", (part + done / total) / parts)


def _variant(name: str) -> Variant:
    return next(one for one in VARIANTS if one.name == name)
