"""The scalars of a corpus at other thresholds k, from its stored pictures and displacements.

A record holds what the design's k gives. The picture's own scalars are taken again from the stored counts,
and are exact. The surface's area is counted from `displacement.z`, which covers the camera's field of view
only, in half floats: it misses what lies outside the picture, and grains of up to 0.5 µm (at presses below
1 mm in depth of the surface) blur its edge. How far it is from the record at the design's k is told beside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation import scalars
from scenes import exr
from twin.corpus_files import inside
from twin.frame import grey

if TYPE_CHECKING:
    from twin.corpus import Corpus

Floats = NDArray[np.float64]

PICTURE_STEPS = (0.3, 0.5, 0.7, 1.0, 1.4, 2.0)
SURFACE_STEPS = (0.5, 1.0, 2.0, 4.0)
"""Thresholds that are tried, as shares of the design's."""

SIGMAS = 5.0
"""A threshold so many standard deviations of a pixel's noise up: one in 3.5 million passes by noise."""


@dataclass(frozen=True)
class Swept:
    """Scalars of some samples at other thresholds, at one press level.

    Attributes
    ----------
    level : number of the press level.
    sample : (n,) numbers.
    picture_k : (p,) counts; surface_k : (s,) µm.
    max_dn, area_px : (n, p) of the tared picture.
    area_mm2 : (n, s) of the tared displacement, within the field of view.
    noise_dn : standard deviation of a pixel of the tared picture, counts, median over samples.
    surface_error : median over samples of |area_mm2 at the design's k / the record's - 1|, of those that
        keep clear of the picture's edge; NaN where none does.
    """

    level: int
    sample: NDArray[np.int64]
    picture_k: Floats
    surface_k: Floats
    max_dn: Floats
    area_px: Floats
    area_mm2: Floats
    noise_dn: float
    surface_error: float


def sweep(
    corpus: Corpus,
    level: int,
    *,
    most: int = 150,
    picture_k: Sequence[float] | None = None,
    surface: bool = True,
    samples: ArrayLike | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Swept:
    """Take the scalars of at most so many samples, evenly spread, at other thresholds.

    Parameters
    ----------
    picture_k : counts (default `PICTURE_STEPS` times the design's).
    surface : whether the surface's area is counted again too.
    samples : numbers, instead of those that are not blank.
    progress : called with the samples that are done and all of them.
    """
    first = corpus.table.iloc[:: corpus.levels]
    solid = first["sample"].to_numpy(np.int64)[~first["blank"].to_numpy(bool)]
    chosen = np.asarray(solid if samples is None else samples, np.int64)
    if len(chosen) > most:
        chosen = chosen[np.unique(np.rint(np.linspace(0, len(chosen) - 1, most)).astype(int))]
    signal = corpus.design.signal
    counts = np.asarray(picture_k if picture_k is not None else [s * signal.counts for s in PICTURE_STEPS])
    depths = np.array([s * signal.displacement_um for s in SURFACE_STEPS] if surface else [])
    most_dn, pixels, area = (np.zeros((len(chosen), len(k))) for k in (counts, counts, depths))
    noise = np.zeros(len(chosen))
    for n, sample in enumerate(chosen):
        tared = grey(corpus.tared(int(sample), [level])[0]).astype(np.float64)
        noise[n] = _noise(tared)
        for i, k in enumerate(counts):
            found = scalars(tared, float(k))
            most_dn[n, i], pixels[n, i] = found["max_dn"], found["area_px"]
        if surface:
            pushed = reference_displacement(corpus, int(sample), level) - corpus.field(
                int(sample), level, "displacement.z"
            )
            area[n] = [_area_mm2(corpus, pushed, 1e-3 * k) for k in depths]
        if progress is not None:
            progress(n + 1, len(chosen))
    return Swept(
        level=level,
        sample=chosen,
        picture_k=counts.astype(np.float64),
        surface_k=depths,
        max_dn=most_dn,
        area_px=pixels,
        area_mm2=area,
        noise_dn=float(np.median(noise)),
        surface_error=_surface_error(corpus, level, chosen, area) if surface else np.nan,
    )


def reference_displacement(corpus: Corpus, sample: int, level: int) -> NDArray[np.float32]:
    """Return `displacement.z` of the press without inclusion, mm, (rows, columns)."""
    name = corpus.cell("reference", corpus.row(sample, level))

    def read() -> NDArray[Any]:
        return exr.read_exr(inside(corpus.path, name))["displacement.z"].astype(np.float32)

    return corpus.kept(name, "displacement.z", read)


def _area_mm2(corpus: Corpus, pushed: NDArray[Any], k_mm: float) -> float:
    camera = corpus.design.camera
    return float((pushed > k_mm).mean() * camera.field_of_view_mm * camera.field_height_mm)


def _noise(tared: Floats) -> float:
    """Standard deviation of a pixel, from differences of neighbours, between which light changes little."""
    apart = np.diff(tared, axis=1)
    return float(1.4826 * np.median(np.abs(apart - np.median(apart))) / np.sqrt(2.0)) or float(
        apart.std() / np.sqrt(2.0)
    )


def _surface_error(corpus: Corpus, level: int, chosen: NDArray[np.int64], area: Floats) -> float:
    rows = [corpus.row(int(sample), level) for sample in chosen]
    told = corpus.table["fem_tared_area_mm2"].to_numpy(np.float64)[rows]
    camera = corpus.design.camera
    inner = np.pi / 4 * min(camera.field_of_view_mm, camera.field_height_mm) ** 2
    clear = (told > 0.05 * inner) & (told < 0.6 * inner)
    found = area[:, list(SURFACE_STEPS).index(1.0)]
    return float(np.median(np.abs(found[clear] / told[clear] - 1.0))) if clear.any() else float("nan")
