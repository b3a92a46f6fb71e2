"""What a layout study has found, read from its folder: trials, the front, winners, what mattered.

    DIR/study.toml, DIR/baseline/, DIR/trials/NNNN/{evaluation.json, pictures.npz, design.toml}

Nothing else is read, and nothing is computed anew but figures of merit.
"""

from __future__ import annotations

import json
import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import rankdata

from estimation.budget import Budget, error_budget
from estimation.information import Information
from twin.complaint import DesignError, shown
from twin.objectives import OBJECTIVES

Floats = NDArray[np.float64]
Value = float | int | str

WANTED = ("size_mm", "depth_mm", "modulus_kPa")
_LIMIT = re.compile(r"\s*([A-Za-z_]+)\s*(<=|>=)\s*([-+0-9.eE]+)\s*")
_FEWEST = 8  # trials below which nothing is said of importance


@dataclass(frozen=True)
class Trial:
    """One layout that was tried, or the baseline (number -1).

    Attributes
    ----------
    values : the study's fields.
    objectives : all that are known; empty where `reason` says why it could not be.
    told : `evaluation.json` as it is.
    """

    number: int
    folder: Path
    values: dict[str, Value]
    objectives: dict[str, float]
    reason: str | None
    told: dict[str, Any]

    @property
    def name(self) -> str:
        """How the report calls it."""
        return "baseline" if self.number < 0 else f"trial {self.number}"

    @property
    def design_toml(self) -> str:
        """Its design, ready for `twin simulate`."""
        return (self.folder / "design.toml").read_text(encoding="utf-8")

    def pictures(self, inclusion: int = 0) -> tuple[Floats, dict[str, Floats]]:
        """Mean counts (pictures, rows, columns[, 3]) of one inclusion, and the slopes of d, h and E."""
        with np.load(self.folder / "pictures.npz", allow_pickle=False) as held:
            names = [str(name) for name in held["jacobian_names"]]
            slopes = np.asarray(held[f"jacobian_{inclusion}"], np.float64)
            return np.asarray(held[f"mean_{inclusion}"], np.float64), dict(zip(names, slopes, strict=True))

    def informations(self) -> list[Information]:
        """What the pictures of each inclusion told."""
        with np.load(self.folder / "pictures.npz", allow_pickle=False) as held:
            names = tuple(str(name) for name in held["names"])
            count = sum(name.startswith("fisher_") for name in held.files)
            return [Information(names, held[f"fisher_{k}"], held[f"prior_{k}"]) for k in range(count)]

    def budgets(self) -> list[Budget]:
        """The error budget of d, h and E (of those that are asked for) for each inclusion."""
        found = self.informations()
        wanted = [name for name in WANTED if name in found[0].names]
        return [error_budget(one, wanted) for one in found] if wanted else []


@dataclass(frozen=True)
class Results:
    """A study's results.

    Attributes
    ----------
    question, constraints : as the study has them.
    objectives : those it searched by, and which way is better.
    trials, infeasible : that could be judged and meet the constraints; and the others.
    front, winners : places in `trials`.
    """

    folder: Path
    name: str
    description: str
    question: str
    constraints: tuple[str, ...]
    objectives: dict[str, str]
    baseline: Trial
    trials: tuple[Trial, ...]
    infeasible: tuple[Trial, ...]
    front: tuple[int, ...]
    winners: tuple[int, ...]

    def best(self) -> list[Trial]:
        """The winners."""
        return [self.trials[place] for place in self.winners]

    def fields(self) -> list[str]:
        """Fields that the study varies."""
        return list(dict.fromkeys(name for trial in self.trials for name in trial.values))


@dataclass(frozen=True)
class Importance:
    """Share of each field in what an objective does, adding to 1; `way` says how it was found."""

    objective: str
    share: dict[str, float]
    way: str


def read(folder: str | Path) -> Results:
    """Return the results of a study's folder; raises `DesignError` where there are none."""
    place = Path(folder)
    try:
        study = tomllib.loads((place / "study.toml").read_text(encoding="utf-8"))
        baseline = _trial(place / "baseline", -1)
        given = tomllib.loads(baseline.design_toml)
    except OSError as missing:
        raise DesignError(
            "DIR", shown(str(folder)), f"a folder of `twin explore` ({missing.strerror})"
        ) from None
    every = []
    for one in sorted((place / "trials").glob("[0-9]*")):
        if (one / "evaluation.json").is_file():  # the last file to appear
            every.append(_trial(one, int(one.name)))
    used = {"protocol": baseline.told.get("protocol", {})}
    layers = given.get("waveguide", {}).get("layers", [])
    whole = {
        "leds": len(given.get("leds", [])),
        "power_W": sum(led.get("flux_W", 0.0) for led in given.get("leds", [])),
        "sheet_mm": given.get("surface", {}).get("sheet", {}).get("thickness_mm", 0.0),
        "layers": [[layer.get("thickness_mm"), layer.get("modulus_kPa")] for layer in layers],
    }
    own: dict[str, Value] = {}
    for name in study.get("fields", {}):
        value = _given(given | used | {"layout": whole}, str(name).split("."))
        if value is not None:
            own[name] = value
    baseline = replace(baseline, values=own | baseline.values)
    constraints = tuple(str(text) for text in study.get("constraints", ()))
    limits = [limit for text in constraints if (limit := _LIMIT.fullmatch(text))]
    every = [_held_to(trial, limits) for trial in every]
    done = tuple(trial for trial in every if trial.reason is None)
    ways = searched(study)
    losses = loss(done, ways)
    along = front(losses)
    return Results(
        place,
        str(study.get("name", place.name)),
        str(study.get("description", "")),
        str(study.get("question", "")),
        constraints,
        ways,
        baseline,
        done,
        tuple(trial for trial in every if trial.reason is not None),
        along,
        winners(losses, along),
    )


def searched(study: dict[str, Any]) -> dict[str, str]:
    """Return a study's objectives, and which way is better."""
    found = study.get("objectives", {})
    ways = {str(name): str(way) for name, way in found.items() if name in OBJECTIVES}
    return ways or {"bound_modulus_kPa": "minimize"}


def loss(trials: Sequence[Trial], ways: Mapping[str, str]) -> Floats:
    """Return objectives (trials, names) with signs so that less is better; NaN where a trial has none."""
    rows = [
        [
            trial.objectives.get(name, np.nan) * (1.0 if way == "minimize" else -1.0)
            for name, way in ways.items()
        ]
        for trial in trials
    ]
    return np.array(rows, np.float64).reshape(len(trials), len(ways))


def front(losses: Floats) -> tuple[int, ...]:
    """Return the places of trials that none beats in every objective, best of the first one first."""
    known = np.flatnonzero(np.isfinite(losses).all(axis=1))
    kept = []
    for place in known:
        other = losses[known]
        beaten = (other <= losses[place]).all(axis=1) & (other < losses[place]).any(axis=1)
        if not beaten.any():
            kept.append(int(place))
    return tuple(sorted(kept, key=lambda place: (losses[place, 0], place)))


def winners(losses: Floats, along: Sequence[int], most: int = 3) -> tuple[int, ...]:
    """Return up to three places: the best of the first objective, the best compromise, best of the others.

    The compromise is the point of the front that lies nearest to the best of everything, each objective
    scaled to its range along the front. With one objective, the three best.
    """
    if not along:
        return ()
    some = losses[list(along)]
    width = np.ptp(some, axis=0)
    share = (some - some.min(axis=0)) / np.where(width > 0, width, 1.0)
    order = [int(along[0]), int(along[int(np.linalg.norm(share, axis=1).argmin())])]
    order += [int(along[int(some[:, column].argmin())]) for column in range(1, losses.shape[1])]
    if losses.shape[1] == 1:
        finite = np.flatnonzero(np.isfinite(losses[:, 0]))
        order += [int(place) for place in finite[np.argsort(losses[finite, 0], kind="stable")]]
    return tuple(dict.fromkeys(order))[:most]


def importances(results: Results) -> list[Importance]:
    """Return what each field alone did to each objective, as shares of what all of them did."""
    fields = results.fields()
    if len(results.trials) < _FEWEST or not fields:
        return []
    return [_importance(results, fields, name) for name in results.objectives]


def _importance(results: Results, fields: Sequence[str], objective: str) -> Importance:
    """Share of the variance of ranks that lies between a field's values (correlation ratio, less what chance
    gives so many groups: Kelley 1935, [kelley1935]); of numbers that hardly repeat, squared rank correlation.
    """
    target = loss(results.trials, {objective: "minimize"})[:, 0]
    known = np.isfinite(target)
    rank = rankdata(target[known])
    share = {}
    for name in fields:
        values = [trial.values.get(name) for trial, keep in zip(results.trials, known, strict=True) if keep]
        distinct = list(dict.fromkeys(values))
        numbers = all(isinstance(value, int | float) for value in values)
        if len(distinct) < 2 or np.ptp(rank) == 0:
            share[name] = 0.0
        elif numbers and 2 * len(distinct) > len(values):
            share[name] = float(np.corrcoef(rankdata(np.array(values, np.float64)), rank)[0, 1] ** 2)
        else:
            groups = [rank[[value == one for value in values]] for one in distinct]
            within = sum(float(((group - group.mean()) ** 2).sum()) for group in groups)
            within /= max(len(rank) - len(groups), 1)
            share[name] = max(0.0, 1.0 - within / float(rank.var(ddof=1)))
    total = sum(share.values()) or 1.0
    ordered = dict(sorted(((name, value / total) for name, value in share.items()), key=lambda x: -x[1]))
    return Importance(objective, ordered, f"variance of ranks ({int(known.sum())} trials)")


def _given(tables: Any, path: Sequence[str]) -> Value | None:
    """What a dotted name means in a design and its protocol; a star: what all have, None if they differ."""
    if not path:
        return tables if isinstance(tables, str | int | float) else json.dumps(tables)
    if isinstance(tables, list):
        inside = tables if path[0] == "*" else tables[int(path[0]) :][:1] if path[0].isdigit() else []
        found = [_given(one, path[1:]) for one in inside]
        return found[0] if found and all(value == found[0] for value in found) else None
    return _given(tables[path[0]], path[1:]) if isinstance(tables, dict) and path[0] in tables else None


def _held_to(trial: Trial, limits: Sequence[re.Match[str]]) -> Trial:
    """The trial, with its reason where it misses a constraint."""
    for limit in limits:
        found = trial.objectives.get(limit[1])
        if found is None or trial.reason is not None:
            continue
        if (found > float(limit[3])) if limit[2] == "<=" else (found < float(limit[3])):
            return replace(trial, reason=f"constraint {limit[0].strip()}: {limit[1]} is {found:.3g}")
    return trial


def _trial(folder: Path, number: int) -> Trial:
    told = json.loads((folder / "evaluation.json").read_text(encoding="utf-8"))
    complete = told.get("state", "complete") == "complete"
    objectives = {
        str(name): float(value) for name, value in told.get("objectives", {}).items() if value is not None
    }
    values = {str(name): value for name, value in told.get("values", {}).items()}
    reason = None if complete else str(told.get("reason", "no reason given"))
    return Trial(number, folder, values, objectives if complete else {}, reason, told)
