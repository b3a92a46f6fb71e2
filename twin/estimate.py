"""``twin estimate``: from a user's files to what is known of the inclusion, in words, JSON and a picture."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from twin import interrupt
from twin.complaint import DesignError, shown
from twin.design import Design, parse_design
from twin.estimates import NAMES, Estimate, decimals, probability
from twin.frame import versions
from twin.received import Received, wanted_of
from twin.receiving import receive
from twin.report import write_json
from twin.stage import has_keys, staged

RECORD, PICTURE = "estimate.json", "overview.png"

_UNKNOWN = 0.8
"""Width of a 90 % interval over that of 90 % of the range, above which the pictures tell nothing."""
_METHODS = {
    "rendered": "refined by rendering the most probable inclusion",
    "network": "by the network alone",
    "fitted": "by the light that was learned, without rendering: its error is known and small here",
    "unrendered": "by a fit of the light that was learned alone; nothing rendered confirms it",
}
_WORDS = {"size_mm": ("size", "mm"), "depth_mm": ("depth", "mm"), "modulus_kPa": ("modulus", "kPa")}


@dataclass(frozen=True, eq=False)
class Found:
    """An estimate, with what it was made of."""

    estimate: Estimate
    received: Received
    card: Mapping[str, Any]
    model: str
    seed: int

    @property
    def design(self) -> Design:
        """The sensor that the model was trained for."""
        return parse_design(dict(self.card["design"]), f"{self.model}: design")

    @property
    def ranges(self) -> Mapping[str, Sequence[float]]:
        """Of each parameter, as trained. Raises `DesignError` where the card does not tell them."""
        ranges = self.card["ranges"]
        for name in NAMES:
            given = ranges.get(name)
            numbers = isinstance(given, list) and [type(end) in (int, float) for end in given] == [True, True]
            if not numbers or not -math.inf < given[0] < given[1] < math.inf:
                allowed = "lowest and highest value"
                raise DesignError(f"ranges.{name}", shown(given), allowed, source="card of the model")
        return ranges


def estimate(
    model: str | Path,
    frames: Sequence[str | Path],
    *,
    references: Sequence[str | Path] = (),
    exposures: int = 1,
    flip: bool = False,
    out: str | Path | None = None,
    samples: int = 4000,
    seed: int = 0,
    rendered: bool = True,
    progress: Callable[[str, float], None] = lambda stage, done: None,
) -> Found:
    """Return what a model knows of the inclusion in a user's pictures.

    Parameters
    ----------
    model : file of a trained estimator, see `twin.estimator_file.load_estimator`.
    frames, references, exposures, flip : as of `twin.receiving.receive`.
    out : folder to make for `RECORD` and `PICTURE`; None for none.
    samples, seed : of the posterior.
    rendered : whether the network's answer is refined by rendering, half a minute.

    Raises `DesignError`, before anything is written, for pictures that cannot be read, do not fit the model,
    or are unlike those that it was trained for.
    """
    if out is None:
        return _estimate(model, frames, references, exposures, flip, samples, seed, rendered, progress)
    with staged(out, holds_estimate) as folder:
        found = _estimate(model, frames, references, exposures, flip, samples, seed, rendered, progress)
        progress("files", 0.8)
        fill(found, folder)
        interrupt.stop_if_asked()
    return found


def _estimate(
    model: str | Path,
    frames: Sequence[str | Path],
    references: Sequence[str | Path],
    exposures: int,
    flip: bool,
    samples: int,
    seed: int,
    rendered: bool,
    progress: Callable[[str, float], None],
) -> Found:
    from twin.estimator_file import load_estimator

    progress("model", 0.0)
    estimator = load_estimator(model)
    progress("pictures", 0.2)
    wanted = wanted_of(estimator.card)
    received = receive(frames, wanted, references=references, exposures=exposures, flip=flip)
    progress("estimate", 0.4)
    answer: Estimate = estimator.estimate(received, samples=samples, seed=seed, rendered=rendered)
    if answer.refused is not None:
        allowed = "pictures like those that the model was trained for"
        raise DesignError(_several(received.names), answer.refused, allowed)
    found = Found(answer, received, estimator.card, str(model), seed)
    _ = found.ranges  # a card without them is refused before anything is said
    return found


def holds_estimate(folder: Path) -> bool:
    """Return whether a folder holds what `fill` wrote, and nothing else."""
    names = {entry.name for entry in folder.iterdir()}
    return names <= {RECORD, PICTURE} and has_keys(folder / RECORD, "presence", "likeness")


def fill(found: Found, folder: Path) -> None:
    """Write the record and the picture into a folder that exists and is empty."""
    from twin.estimate_pictures import Sheet, overview

    camera = found.design.camera
    write_json(folder / RECORD, record(found))
    sheet = Sheet(
        estimate=found.estimate,
        received=found.received,
        ranges=found.ranges,
        field_mm=(camera.field_of_view_mm, camera.field_height_mm),
        indentation_mm=found.card["indentation_mm"],
        refuse_below=float(found.card["refuse_below"]),
        notes=_notes(found),
    )
    overview(sheet, folder / PICTURE)


def record(found: Found) -> dict[str, Any]:
    """Return what `RECORD` says; lengths in mm, moduli in kPa."""
    answer, received = found.estimate, found.received
    parameters = {
        name: {
            "mean": answer.mean[index],
            "sd": answer.covariance[index, index] ** 0.5,
            "interval_90": list(answer.interval[index]),
            "range": list(found.ranges[name]),
            "told": not _unknown(found, index),
        }
        for index, name in enumerate(answer.names)
    }
    return {
        "presence": answer.presence,
        "inclusion": parameters,
        "covariance": answer.covariance,
        "likeness": answer.likeness,
        "method": answer.method,
        "misfit": answer.misfit,
        "pictures": {
            "names": list(received.names),
            "frames": received.frames,
            "reference_frames": received.reference_frames,
        },
        "model": {"file": found.model, "design_sha256": found.card.get("design_sha256")},
        "samples": len(answer.samples),
        "seed": found.seed,
        "versions": versions(),
    }


def told(found: Found) -> str:
    """Return an estimate in a few lines."""
    answer = found.estimate
    chance = f"probability of an inclusion: {probability(answer.presence)}"
    lines = [chance if answer.presence >= 0.5 else f"{chance}; if there is one:"]
    for index, name in enumerate(answer.names):
        word, unit = _WORDS[name]
        digits = decimals(answer.covariance[index, index] ** 0.5)
        below, above = answer.interval[index]
        span = f"{below:.{digits}f} to {above:.{digits}f}"
        line = f"  {word:<8} {answer.mean[index]:6.{digits}f} {unit:<4} 90 %: {span}"
        if _unknown(found, index):
            low, high = found.ranges[name]
            line += f" (trained for {low:g} to {high:g}: these pictures hardly tell)"
        lines.append(line)
    share = 100 * answer.likeness
    lines.append(f"likeness {answer.likeness:.2g}: {share:.2g} % of valid pictures are less like the model's")
    lines.append(f"{_METHODS[answer.method]}; chi-square over features {answer.misfit:.2f}")
    return "\n".join(lines)


def _unknown(found: Found, index: int) -> bool:
    """Whether the pictures have hardly narrowed a parameter."""
    low, high = found.ranges[found.estimate.names[index]]
    below, above = found.estimate.interval[index]
    return bool(above - below > _UNKNOWN * 0.9 * (high - low))


def _notes(found: Found) -> list[str]:
    model = f"model {Path(found.model).name}, design {found.design.name}"
    names = _several(found.received.names)
    return [f"{model}, seed {found.seed}", f"pictures: {names}"]


def _several(names: Sequence[str]) -> str:
    """Names of files, shortened to fit a line."""
    return names[0] if len(names) == 1 else f"{shown(names[0])[1:-1]} and {len(names) - 1} more"
