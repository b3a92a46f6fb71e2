"""The paper's mapping read off a corpus: what the surface does against what the picture shows, by a line.

For each press level, tared and raw, the three scalars of the picture are regressed on those of the contact
surface ([lee2011], section III.C, Fig. 5), in their units and divided by the largest of the corpus. Blanks
have nothing to map. A sample whose picture has no pixel above k has no maximum and no area: such samples are
counted, and left out of these two lines.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from estimation.adequacy import Adequacy, judge_line
from estimation.regression import Line, fit_line
from twin.complaint import DesignError

if TYPE_CHECKING:
    import pandas

    from twin.corpus import Corpus

Floats = NDArray[np.float64]

MOST = 3000
"""Samples that are mapped: of more, so many at even distances."""

FEWEST = 8
"""Samples with an inclusion that a mapping takes."""


@dataclass(frozen=True)
class Pair:
    """One scalar: its columns of the index after ``fem_KIND_`` and ``tsis_KIND_``, and words for axes."""

    name: str
    surface: str
    picture: str
    factor: float
    """From the index's unit to the one that is shown."""
    surface_unit: str
    picture_unit: str
    picture_factor: float = 1.0


PAIRS = (
    Pair("max", "max_mm", "max_dn", 1e3, "µm", "counts"),
    Pair("total", "total_mm3", "total_dn", 1.0, "mm³", "10⁶ counts", 1e-6),
    Pair("area", "area_mm2", "area_px", 1.0, "mm²", "10³ px", 1e-3),
)


@dataclass(frozen=True)
class Mapped:
    """One scalar of one press level of one corpus.

    Attributes
    ----------
    corpus : its label.
    level_mm : nominal press level.
    kind : "tared" or "raw".
    pair : which scalar.
    sample : (n,) numbers of those that are mapped.
    x, y : (n,) surface and picture, in the pair's units.
    unseen : samples without a pixel above k, left out (of max and area).
    fit : line, parabola and monotone fit compared; None where there is nothing to fit, see `why`.
    why : the verdict, or why there is none.
    """

    corpus: str
    level_mm: float
    kind: str
    pair: Pair
    sample: NDArray[np.int64]
    x: Floats
    y: Floats
    unseen: int
    fit: Adequacy | None
    why: str

    @property
    def normalised(self) -> Line | None:
        """The line of both scalars divided by their largest, as the paper's graphs are."""
        if self.fit is None or not (self.x.max() > 0 and self.y.max() > 0):
            return None
        return fit_line(self.x / self.x.max(), self.y / self.y.max())

    def row(self) -> dict[str, Any]:
        """All numbers under fixed names: the pair's units, errors of the picture in % of its span."""
        head = {
            "corpus": self.corpus,
            "level_mm": self.level_mm,
            "kind": self.kind,
            "scalar": self.pair.name,
            "surface_unit": self.pair.surface_unit,
            "picture_unit": self.pair.picture_unit,
            "samples": len(self.x),
            "unseen": self.unseen,
        }
        return head | _numbers(self.fit, self.normalised) | {"verdict": self.why}


def _numbers(fit: Adequacy | None, normal: Line | None) -> dict[str, Any]:
    """The figures of a fit, all None where there is none."""
    line = None if fit is None else fit.line
    low, high = ("low", "high")
    found: dict[str, Any] = {}
    for prefix, one in (("", line), ("normalised_", normal)):
        for name in ("slope", "intercept", "r2"):
            found[prefix + name] = None if one is None else getattr(one, name)
            ends = (None, None) if one is None else getattr(one, f"{name}_interval")
            found |= {f"{prefix}{name}_{end}": value for end, value in zip((low, high), ends, strict=True)}
    span = None if line is None or fit is None else line.left_out_rmse / fit.error
    for name in ("linear", "quadratic", "monotone"):
        found[f"left_out_{name}_percent"] = None if fit is None else 100.0 * fit.left_out[name] / (span or 1)
    found["left_out_surface"] = (
        None if line is None or not line.slope else line.left_out_rmse / abs(line.slope)
    )
    found |= {
        "residual_sd": None if line is None else line.residual_sd,
        "p_bend": None if fit is None else fit.p,
        "bow_percent": None if fit is None else 100.0 * fit.bow,
        "adequate": None if fit is None else fit.adequate,
        "best": None if fit is None else fit.best,
        "range_from": None if fit is None or fit.range is None else fit.range[0],
        "range_to": None if fit is None or fit.range is None else fit.range[1],
        "range_samples": None if fit is None else fit.range_count,
    }
    return found


def open_corpus(path: str | Path) -> Corpus:
    """Open a corpus that can be mapped. Raises `DesignError` in one line."""
    from twin.corpus import Corpus

    corpus = Corpus(path)
    solid = int((~corpus.table["blank"].to_numpy()[:: corpus.levels]).sum())
    if solid < FEWEST:
        received = f"{solid} finished samples with an inclusion"
        raise DesignError("corpus", received, f"{FEWEST} or more", source=str(corpus.path))
    return corpus


def chosen_levels(corpus: Corpus, level_mm: float | None) -> list[int]:
    """Return all press levels, or the one asked for by its nominal depth. Raises `DesignError`."""
    if level_mm is None:
        return list(range(corpus.levels))
    for step, depth in enumerate(corpus.indentation_mm):
        if abs(depth - level_mm) <= 1e-6:
            return [step]
    known = ", ".join(f"{depth:g}" for depth in corpus.indentation_mm)
    raise DesignError("--level", f"{level_mm:g} mm", f"one of {known} mm", source=str(corpus.path))


def map_corpus(corpus: Corpus, label: str, level_mm: float | None = None) -> list[Mapped]:
    """Map all scalars of all press levels (or of one), tared and raw."""
    found = []
    for level in chosen_levels(corpus, level_mm):
        table = corpus.table
        rows = table[(table["level"] == level) & ~table["blank"]]
        if len(rows) > MOST:
            rows = rows.iloc[np.rint(np.linspace(0, len(rows) - 1, MOST)).astype(int)]
        for kind in ("tared", "raw"):
            found += [map_pair(rows, label, corpus.indentation_mm[level], kind, pair) for pair in PAIRS]
    return found


def map_pair(rows: pandas.DataFrame, label: str, level_mm: float, kind: str, pair: Pair) -> Mapped:
    """Map one scalar over rows of the index, one per sample."""
    x = rows[f"fem_{kind}_{pair.surface}"].to_numpy(np.float64) * pair.factor
    y = rows[f"tsis_{kind}_{pair.picture}"].to_numpy(np.float64) * pair.picture_factor
    seen = np.ones(len(x), bool)
    if pair.name != "total":
        seen = rows[f"tsis_{kind}_area_px"].to_numpy(np.float64) > 0
    sample = rows["sample"].to_numpy(np.int64)[seen]
    fit, why = judged(x[seen], y[seen])
    return Mapped(label, level_mm, kind, pair, sample, x[seen], y[seen], int((~seen).sum()), fit, why)


def judged(x: Floats, y: Floats) -> tuple[Adequacy | None, str]:
    """Compare the fits, or say why there is nothing to compare."""
    if len(x) < FEWEST:
        return None, f"nothing to fit: {len(x)} samples with a pixel above k"
    for words, values in (("surface", x), ("picture", y)):
        if np.ptp(values) <= 1e-9 * np.abs(values).max():
            return None, f"nothing to fit: the {words}'s scalar is the same for all samples"
        if len(np.unique(values)) < 3:
            return None, f"nothing to fit: the {words}'s scalar has two different values only"
    fit = judge_line(x, y)
    return fit, fit.why


def labels(corpora: Sequence[Corpus]) -> list[str]:
    """Return a short different name for each corpus."""
    names = [corpus.name for corpus in corpora]
    if len(set(names)) == len(names):
        return names
    folders = [corpus.path.resolve().name for corpus in corpora]
    if len(set(folders)) == len(folders):
        return folders
    return [f"{name} {number}" for number, name in enumerate(folders, 1)]
