"""What more samples of a corpus would buy: the model-based estimate with light learned from more and more.

The network needs no more samples, it imagines them; what a corpus teaches is the light map. So that is
learned again from the first 40, 80, 134, ... samples, and the most probable inclusion by it compared with the
truth of samples that none of these maps has seen.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import fem
from twin import assessing_report
from twin.assess import LEAST_MM, stored
from twin.assessing import KEPT, free, levels_of, values_of
from twin.bounding import limits
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.estimates import NAMES
from twin.estimator import Estimator
from twin.estimator_file import load_estimator
from twin.fitting import fit
from twin.report import BLUE, GREY, RED, panels, write_json
from twin.stage import usable
from twin.train import Seen, gather, learn_light, of_levels

RECORD, PICTURE = assessing_report.CURVE, assessing_report.CURVED
SIZES = (40, 80, 134, 250, 500, 1000, 2000)
TESTED = 60
"""Inclusions of `LEAST_MM` and more that are estimated, the last ones of the corpus."""


def curve(
    model: str | Path,
    corpus: str | Path,
    out: str | Path,
    *,
    tested: int = TESTED,
    progress: Callable[[str, float], None] = lambda stage, share: None,
) -> dict[str, Any]:
    """Write `RECORD`, `PICTURE` and a page into a folder, and return the record.

    Raises
    ------
    DesignError
        In one line.
    """
    source, estimator = Corpus(corpus), load_estimator(model)
    levels = levels_of(source, estimator)
    folder = Path(out)
    sizes_mm = [source.plan.parameters(int(n)).get("size_mm") or 0.0 for n in source.samples]
    if sum(size >= LEAST_MM for size in sizes_mm) < tested or len(sizes_mm) < tested + SIZES[0]:
        received = f"{len(sizes_mm)} samples"
        allowed = f"{tested + SIZES[0]} or more, {tested} of them inclusions of {LEAST_MM:g} mm and more"
        raise DesignError("samples", received, allowed, source=source.name)
    with usable("--out", folder):
        if not free(folder):
            raise DesignError("--out", shown(str(folder)), "a new or empty folder, or that of an assessment")
        folder.mkdir(parents=True, exist_ok=True)
        (folder / KEPT).touch()
    parts = folder / f"curve-{estimator.card['sha256'][:16]}"  # contacts are of this model's emulator
    parts.mkdir(exist_ok=True)
    seen = gather(source, estimator.chain.emulator, parts, lambda share: progress("pictures", share))
    seen = Seen(
        seen.numbers,
        [values_of(source, estimator, int(number), levels) for number in seen.numbers],
        seen.blank,
        seen.contacts[:, levels],
        seen.charges[:, levels],
    )
    large = np.array(
        [not b and v["size_mm"] >= LEAST_MM for b, v in zip(seen.blank, seen.values, strict=True)]
    )
    last = np.flatnonzero(large)[-tested:]
    pool = np.arange(last[0])
    sizes = [size for size in SIZES if size <= len(pool)]
    truth = np.array([[seen.values[row][name] for name in NAMES] for row in last])
    pictures = np.stack([stored(estimator, source, int(n), levels) for n in seen.numbers[last]])
    told = estimator.features(pictures)
    start = estimator.unscaled(estimator.network.sample(told, 1, 1000, 0)).mean(axis=1)
    bound = np.full(truth.shape, np.nan)
    for place, row in enumerate(last):
        try:
            # of the fits below, which know of no calibration
            least, _ = limits(estimator.chain, estimator.features, estimator.prior, seen.values[row], 1)
            bound[place] = np.sqrt(np.diag(least)[: len(NAMES)])
        except fem.NotModelled:
            continue
    design, rows = of_levels(source, levels), []
    for number, size in enumerate(sizes):
        most = 2 * size * seen.contacts.shape[1]
        chain, errors = learn_light(design, estimator.chain.emulator, seen.of(pool[:size]), most)
        found = np.empty(truth.shape)
        for place in range(len(last)):
            found[place] = _most_probable(estimator, chain, errors, told[place], start[place])
            progress("fits", (number + (place + 1) / len(last)) / len(sizes))
        rows.append({"samples": size, "rmse": _rms(found - truth).tolist()})
    record = {
        "corpus": source.name,
        "model": estimator.card["sha256"],
        "tested": len(last),
        "parameters": list(NAMES),
        "bound": _rms(bound).tolist(),
        "curve": rows,
    }
    write_json(folder / RECORD, record)
    _draw(record, folder / PICTURE)
    assessing_report.write(folder)
    return record


def _most_probable(
    estimator: Estimator,
    chain: Any,
    errors: NDArray[np.float32],
    told: NDArray[np.float32],
    start: NDArray[np.float64],
) -> NDArray[np.float64]:
    features, prior = estimator.features, estimator.prior
    off = (features(errors) + features.mean @ features.axes.T).astype(np.float64)
    x = np.concatenate([start, np.zeros(prior.basis.shape[1])])
    covariance = off.T @ off / len(off)
    return fit(chain, features, prior, told, 1.0, x, covariance).x[: len(NAMES)]


def _rms(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.sqrt(np.nanmean(values**2, axis=0)))


def words(record: dict[str, Any]) -> str:
    """Return what a person wants to know of it, several lines."""
    lines = [
        f"light learned from so many samples of {record['corpus']}, one exposure: RMSE of {record['tested']} "
        f"inclusions of {LEAST_MM:g} mm and more by the model-based fit alone"
    ]
    head = ("samples", "d / mm", "h / mm", "E / kPa")
    lines.append("".join(f"{one:>10}" for one in head))
    table = [(str(row["samples"]), row["rmse"]) for row in record["curve"]]
    for name, values in [*table, ("bound", record["bound"])]:
        lines.append(f"{name:>10}" + "".join(f"{value:>10.3g}" for value in values))
    return "\n".join(lines)


def _draw(record: dict[str, Any], place: Path) -> None:
    figure, axes = panels(1, 3, 3.2)
    sizes = [row["samples"] for row in record["curve"]]
    labels = ("size d / mm", "depth h / mm", "modulus E / kPa")
    for number, (axis, label) in enumerate(zip(axes, labels, strict=True)):
        rmse = np.array([row["rmse"][number] for row in record["curve"]])
        chance = rmse / np.sqrt(2 * record["tested"])
        axis.errorbar(sizes, rmse, chance, fmt="o-", color=BLUE, capsize=2, label="fit alone")
        axis.set_xscale("log")
        axis.axhline(record["bound"][number], color=RED, lw=1.0, label="bound")
        axis.set(xlabel="samples that light was learned from", ylabel=f"RMSE of {label}")
        axis.set_xticks(sizes, [str(size) for size in sizes])
        axis.minorticks_off()
        axis.set_ylim(0.0, 1.1 * axis.get_ylim()[1])
        axis.grid(color=GREY, alpha=0.3)
    axes[0].legend(frameon=False, fontsize=8)
    figure.savefig(place, dpi=130)
