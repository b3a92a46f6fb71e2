"""Which layouts are tried: grids and Latin hypercubes drawn beforehand, and Optuna's samplers."""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from twin import layout_fields
from twin.complaint import DesignError
from twin.design import Design
from twin.layout_study import Axis, LayoutStudy

if TYPE_CHECKING:
    import optuna

Axes = Mapping[str, Axis]


_MOST_DRAWS = 100  # until a layout that was tried before is taken all the same: there may be no other


def ask(
    study: LayoutStudy, design: Design, optuna_study: optuna.Study, number: int, worker: str
) -> optuna.Trial:
    """Return the trial of this number, signed by a worker: a layout that none before it was.

    Genetic search draws the same values again and again, and different ones may make the same sensor (one LED
    is alone on its side, however many are to share it): such a draw is given up and counts as nothing. What
    was planned beforehand is taken as it is.
    """
    from optuna.trial import TrialState

    before = optuna_study.get_trials(deepcopy=False)
    lost = [one.state == TrialState.FAIL and "reason" not in one.user_attrs for one in before]
    taken = {one.user_attrs.get("makes") for one, gone in zip(before, lost, strict=True) if not gone}
    given_up = sum(_REPEATS in trial.user_attrs for trial in before)
    known = distributions(layout_fields.axes_of(study), design)
    for draw in range(_MOST_DRAWS):
        optuna_study.sampler = sampler(study, number + given_up + draw)
        trial = optuna_study.ask(known)
        makes = _makes(study, design, trial.params)
        drawn = not {"again", "planned"} & set(trial.user_attrs)
        if not drawn or makes not in taken or draw == _MOST_DRAWS - 1:
            break
        trial.set_user_attr(_REPEATS, True)
        optuna_study.tell(trial, state=TrialState.FAIL)
    trial.set_user_attr("makes", makes)
    trial.set_user_attr("worker", worker)
    return trial


_REPEATS = "repeats another"


def _makes(study: LayoutStudy, design: Design, values: Mapping[str, layout_fields.Value]) -> str:
    """A short name of the sensor and protocol that values make; of the values where they make none."""
    try:
        made = layout_fields.layout(study, design, values)
        told = repr((made.design, made.protocol))
    except DesignError:
        told = repr(sorted(values.items()))
    return hashlib.sha256(told.encode()).hexdigest()[:16]


def sampler(study: LayoutStudy, number: int) -> optuna.samplers.BaseSampler:
    """What chooses the layout of this number: its draws depend on the seed, the number and what is known."""
    import optuna

    told = hashlib.sha256(repr((study.seed, number)).encode()).digest()
    seed = int.from_bytes(told[:4], "little")
    if study.search.method == "nsga2":
        return optuna.samplers.NSGAIISampler(
            population_size=study.search.population, seed=seed, constraints_func=_constraints
        )
    if study.search.method == "tpe":
        return optuna.samplers.TPESampler(seed=seed, multivariate=True, constraints_func=_constraints)
    return optuna.samplers.RandomSampler(seed=seed)


def distributions(axes: Axes, design: Design) -> dict[str, optuna.distributions.BaseDistribution]:
    """What Optuna knows of the fields."""
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    found: dict[str, optuna.distributions.BaseDistribution] = {}
    for name, one in axes.items():
        if one.choices is not None:
            found[name] = CategoricalDistribution([layout_fields.said(choice) for choice in one.choices])
            continue
        assert one.range is not None
        low, high = one.range
        if layout_fields.whole(name, design):
            found[name] = IntDistribution(int(low), int(high), log=one.log)
        else:
            found[name] = FloatDistribution(low, high, log=one.log)
    return found


def _constraints(trial: optuna.trial.FrozenTrial) -> list[float]:
    return list(trial.user_attrs.get("constraints", ()))


def planned(
    study: LayoutStudy, axes: Axes, design: Design, trials: int
) -> Iterator[dict[str, layout_fields.Value]]:
    """The layouts of a grid, the first field slowest, or of a Latin hypercube, as many as are wanted."""
    if study.search.method == "grid":
        each = [_points(one, layout_fields.whole(name, design)) for name, one in axes.items()]
        for values in itertools.islice(itertools.product(*each), trials):
            yield dict(zip(axes, values, strict=True))
        return
    from scipy.stats import qmc

    count = study.search.trials or trials
    drawn = qmc.LatinHypercube(len(axes), rng=np.random.default_rng(study.seed)).random(count)
    for row in drawn[:trials]:
        yield {
            name: _at(one, layout_fields.whole(name, design), float(share))
            for (name, one), share in zip(axes.items(), row, strict=True)
        }


def _at(one: Axis, integer: bool, share: float) -> layout_fields.Value:
    """The value at a share, 0 to 1, of a field's range or of its choices."""
    if one.choices is not None:
        return layout_fields.said(one.choices[min(int(share * len(one.choices)), len(one.choices) - 1)])
    assert one.range is not None
    low, high = one.range
    if integer:
        return int(min(low + int(share * (high - low + 1)), high))
    if one.log:
        return float(low * (high / low) ** share)
    return float(low + share * (high - low))


def _points(one: Axis, integer: bool) -> list[layout_fields.Value]:
    """The values of a field in a grid."""
    if one.choices is not None:
        return [layout_fields.said(choice) for choice in one.choices]
    assert one.range is not None
    low, high = one.range
    values = np.geomspace(low, high, one.points) if one.log else np.linspace(low, high, one.points)
    if integer:
        return sorted({round(value) for value in values})
    return [float(value) for value in values]


def grid_size(axes: Axes, study: LayoutStudy, design: Design) -> int:
    """Number of layouts of a grid; raises `DesignError` where a grid is asked for that is too large."""
    sizes = [len(_points(one, layout_fields.whole(name, design))) for name, one in axes.items()]
    total = int(np.prod([float(size) for size in sizes]))
    if study.search.method == "grid" and total > 100_000:
        raise DesignError("fields", f"{total} combinations", "at most 100000 in a grid")
    return total
