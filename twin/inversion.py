"""The paper's estimation on a corpus: picture's scalars, back through the mapping, into the network.

The paper ([lee2011], sections III.C, III.D and IV) maps the three scalars of a picture to those of the
surface by one line each, and asks a network that was trained on scalars of the surface for size, depth and
modulus. It tells two protocols apart badly; both are here:

- **125/9**: networks are trained on the random inclusions and asked for the nine phantoms, which they never
  saw;
- **leave-one-out**: for each phantom, networks are trained on all other samples, phantoms included, and the
  mapping leaves it out too where phantoms are what it is fitted to.

What the lines are fitted to is a choice of its own: to the random inclusions, or to the phantoms as the paper
did, which then test a mapping that they have fitted (not in the leave-one-out).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation import paper
from estimation.regression import fit_line
from twin.complaint import DesignError

if TYPE_CHECKING:
    import pandas

    from estimation.ann import Ensemble, Settings

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]

SURFACE = ("fem_tared_max_mm", "fem_tared_total_mm3", "fem_tared_area_mm2")
PICTURE = ("tsis_tared_max_dn", "tsis_tared_total_dn", "tsis_tared_area_px")

FEWEST = 12
"""Random inclusions that a network is trained on, at least."""

SPOT_PX = 9
"""Pixels above k that make a spot: as many as the maximum is the mean of."""

Mapping = Literal["lines", "joint", "network", "none"]
Source = Literal["box", "phantoms"]


@dataclass(frozen=True)
class Scalars:
    """What one press level of a corpus gives to the estimation.

    Attributes
    ----------
    truth : (n, 3) size mm, depth mm, modulus kPa.
    surface : (n, 3) maximum mm, total mm³, area mm² of the tared surface.
    picture : (n, 3) maximum counts, total counts, area pixels of the tared picture.
    sample : (n,) numbers in the corpus.
    phantoms : (9,) places of the inclusions of Table I, in its order.
    level_mm : nominal press level; more than one where levels are put side by side.
    """

    truth: Floats
    surface: Floats
    picture: Floats
    sample: Ints
    phantoms: Ints
    level_mm: tuple[float, ...]

    @cached_property
    def box(self) -> Ints:
        """Places of the random inclusions."""
        return np.setdiff1d(np.arange(len(self.truth)), self.phantoms)

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(n,) whether the (first) picture shows a spot."""
        return np.asarray(self.picture[:, 2] >= SPOT_PX)


def scalars_of(table: pandas.DataFrame, level: int, level_mm: float, source: str = "corpus") -> Scalars:
    """Take a press level out of an index. Raises `DesignError` if what is needed is not there."""
    missing = [name for name in (*SURFACE, *PICTURE) if name not in table.columns]
    if missing:
        raise DesignError(
            "index.parquet", f"no column {missing[0]}", "the scalars of surface and picture", source=source
        )
    rows = table[(table["level"] == level) & ~table["blank"]]
    truth = rows[list(paper.PARAMETERS)].to_numpy(np.float64)
    wanted = paper.true_inclusions()
    at = []
    for number, one in enumerate(wanted, 1):
        (found,) = np.nonzero(np.abs(truth - one).max(axis=1) < 1e-6)
        if not len(found):
            size, depth, modulus = one
            received = (
                f"no sample of {size:g} mm, {depth:g} mm deep, {modulus:g} kPa (Table I, number {number})"
            )
            raise DesignError(
                "corpus", received, "the nine phantoms of the paper (twin corpus plan paper)", source=source
            )
        at.append(int(found[0]))
    if len(rows) - 9 < FEWEST:
        received = f"{max(len(rows) - 9, 0)} samples besides the phantoms"
        raise DesignError("corpus", received, f"{FEWEST} or more to train on", source=source)
    return Scalars(
        truth,
        rows[list(SURFACE)].to_numpy(np.float64),
        rows[list(PICTURE)].to_numpy(np.float64),
        rows["sample"].to_numpy(np.int64),
        np.array(at),
        (level_mm,),
    )


def beside(levels: Sequence[Scalars]) -> Scalars:
    """Put press levels side by side: three times as many scalars of the same samples."""
    first = levels[0]
    return replace(
        first,
        surface=np.hstack([level.surface for level in levels]),
        picture=np.hstack([level.picture for level in levels]),
        level_mm=tuple(depth for level in levels for depth in level.level_mm),
    )


@dataclass(frozen=True)
class Variant:
    """One way to run the chain.

    Attributes
    ----------
    name, words : key, and what it is.
    mapping : "lines", one per scalar; "joint", each of the surface's from all of the picture's, linearly;
        "network", none: the network is trained on the picture's; "none": the network gets the surface's own,
        as if the picture told them exactly.
    source : what the mapping is fitted to.
    logs : whether network and joint mapping take logarithms.
    split : whether the modulus has networks of its own: what it cannot tell stops the others' training early.
    """

    name: str
    words: str
    mapping: Mapping = "lines"
    source: Source = "box"
    logs: bool = False
    split: bool = False

    @property
    def targets(self) -> tuple[tuple[int, ...], ...]:
        """Which parameters each network tells."""
        return ((0, 1), (2,)) if self.split else ((0, 1, 2),)


PLAIN = Variant("paper", "the paper's chain: a line per scalar, network on surface scalars")


def mapped(data: Scalars, variant: Variant, rows: Ints) -> Callable[[ArrayLike], Floats]:
    """Return the map from pictures' scalars (m, p) to the network's inputs (m, p), fitted to some samples.

    A line per scalar: picture on surface as in Fig. 5, read backwards; nothing is below zero. Joint: least
    squares of the surface's scalars on all of the picture's, each sample weighted by one over the surface's
    scalar, so that relative errors count; between logarithms unweighted. Maximum and area, and all of a joint
    map, are fitted to samples that are seen (`SPOT_PX`).
    """
    if variant.mapping == "joint":
        return _jointly(data, variant, rows[(data.picture[rows, 2::3] >= SPOT_PX).all(axis=1)])
    picture, surface = data.picture[rows], data.surface[rows]
    lines = []
    for column in range(picture.shape[1]):
        area = picture[:, 3 * (column // 3) + 2]
        there = np.ones(len(rows), bool) if column % 3 == 1 else area >= SPOT_PX
        lines.append(fit_line(surface[there, column], picture[there, column]))

    def back(asked: ArrayLike) -> Floats:
        given = np.asarray(asked, np.float64)
        found = np.stack([line.inverse(given[:, i]) for i, line in enumerate(lines)], axis=1)
        return _scale(variant, np.maximum(found, 0.0), data.surface)

    return back


def _jointly(data: Scalars, variant: Variant, rows: Ints) -> Callable[[ArrayLike], Floats]:
    def matrix(picture: Floats) -> Floats:
        return np.column_stack([np.ones(len(picture)), _scale(variant, picture, data.picture)])

    x, y = matrix(data.picture[rows]), _scale(variant, data.surface[rows], data.surface)
    unit = np.ones_like(y) if variant.logs else np.maximum(y, _lift(data.surface))
    found = np.stack(
        [np.linalg.lstsq(x / unit[:, [j]], y[:, j] / unit[:, j], rcond=None)[0] for j in range(y.shape[1])],
        axis=1,
    )

    def back(asked: ArrayLike) -> Floats:
        told = matrix(np.asarray(asked, np.float64)) @ found
        return told if variant.logs else np.maximum(told, 0.0)

    return back


def inputs(data: Scalars, variant: Variant) -> Floats:
    """What the network is trained on, (n, p)."""
    if variant.mapping == "network":
        return _scale(variant, data.picture, data.picture)
    return _scale(variant, data.surface, data.surface)


def queries(data: Scalars, variant: Variant, asked: Ints, left_out: bool) -> Floats:
    """What the network is asked for some samples (m, p); each out of its own mapping with `left_out`."""
    if variant.mapping in ("none", "network"):
        return inputs(data, variant)[asked]
    rows = data.box if variant.source == "box" else data.phantoms
    if not left_out:
        return mapped(data, variant, rows)(data.picture[asked])
    return np.vstack([mapped(data, variant, rows[rows != one])(data.picture[[one]]) for one in asked])


def estimate(
    data: Scalars,
    variant: Variant,
    *,
    left_out: bool,
    repeats: int = 100,
    seed: int = 0,
    settings: Settings | None = None,
    cache: dict[tuple[object, ...], Ensemble] | None = None,
) -> Floats:
    """Estimate the nine phantoms, (repeats, 9, 3).

    With `left_out` each by networks that saw all other samples, else by networks that saw the random ones.
    `cache` keeps networks for other variants that are trained on the same.
    """
    asked = queries(data, variant, data.phantoms, left_out)
    found = np.empty((repeats, len(asked), 3))
    for targets in variant.targets:
        members = _networks(data, variant, targets, left_out, repeats, seed, settings, cache)
        if not left_out:
            found[..., targets] = members.predict(asked)
            continue
        for fold in range(len(asked)):
            part = members.rows(slice(fold * repeats, (fold + 1) * repeats))
            found[:, fold, targets] = part.predict(asked[fold : fold + 1])[:, 0]
    return found


def crossed(
    data: Scalars,
    variant: Variant,
    *,
    folds: int = 5,
    repeats: int = 6,
    seed: int = 0,
    settings: Settings | None = None,
) -> Floats:
    """Estimate every random inclusion by networks and lines that never saw it, (n_box, 3).

    Cross-validated: the random inclusions fall into so many folds at random.
    """
    from estimation.ann import train

    rng = np.random.Generator(np.random.Philox(np.random.SeedSequence([seed, 5])))
    order = rng.permutation(len(data.box))
    x = inputs(data, variant)
    found = np.empty((len(data.box), 3))
    for fold in range(folds):
        held = np.sort(order[fold::folds])
        kept = np.setdiff1d(data.box, data.box[held])
        if variant.mapping in ("none", "network"):
            asked = x[data.box[held]]
        else:
            asked = mapped(data, variant, kept)(data.picture[data.box[held]])
        for targets in variant.targets:
            y = data.truth[kept][:, targets]
            members = train(x[kept], y, repeats=repeats, seed=seed, settings=settings)
            found[held[:, None], list(targets)] = members.predict(asked).mean(axis=0)
    return found


def _networks(
    data: Scalars,
    variant: Variant,
    targets: tuple[int, ...],
    left_out: bool,
    repeats: int,
    seed: int,
    settings: Settings | None,
    cache: dict[tuple[object, ...], Ensemble] | None,
) -> Ensemble:
    """Train on the random inclusions, or on all but each of the phantoms."""
    from estimation.ann import train

    kind = variant.mapping if variant.mapping == "network" else "surface"
    key = (kind, variant.logs, targets, data.level_mm, left_out, repeats, seed)
    if cache is not None and key in cache:
        return cache[key]
    x, y = inputs(data, variant), data.truth[:, targets]
    if left_out:
        places = data.phantoms.tolist()
        found = train(x, y, repeats=repeats, seed=seed, left_out=places, settings=settings)
    else:
        found = train(x[data.box], y[data.box], repeats=repeats, seed=seed, settings=settings)
    if cache is not None:
        cache[key] = found
    return found


def _scale(variant: Variant, values: Floats, all_of: Floats) -> Floats:
    """Logarithms, where they are wanted, of values lifted by `_lift`."""
    if not variant.logs:
        return np.asarray(values, np.float64)
    return np.asarray(np.log(np.maximum(values, 0.0) + _lift(all_of)))


def _lift(all_of: Floats) -> Floats:
    """A hundredth of the median over the corpus, (p,)."""
    return 0.01 * np.maximum(np.median(np.abs(all_of), axis=0), 1e-12)
