"""Explore layouts: which ones are tried next, by whom, and what is recorded of each.

The storage is Optuna's, so that processes and machines share one study and `optuna-dashboard` opens it. A
process that works holds a lock on a file of its own, which the system takes back however the process ends:
what a dead one had under way is found by that and tried again.
"""

from __future__ import annotations

import itertools
import shutil
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import fem
from scenes.sensor import NotModelled
from twin import evaluate as judging
from twin import explore_folder, explored, layout_fields, learned, presses, proposals
from twin.alive import alive, locked
from twin.complaint import DesignError, shown
from twin.design import Design, load_design, shipped_designs
from twin.evaluate import Bench, Evaluation, Layout
from twin.explore_folder import BASE, BASELINE, DATABASE, KEPT, STUDY, TRIALS, WORKERS
from twin.explore_folder import HEAD as HEAD
from twin.kept import Kept
from twin.layout_study import Axis, LayoutStudy, Limit, Source, limits, load, parse
from twin.proposals import grid_size

if TYPE_CHECKING:
    import optuna

LOST_S = 3600.0
"""After so long a trial of another machine, of which no lock can be seen, counts as lost."""


@dataclass(frozen=True)
class Exploration:
    """A study with its folder, its design and its storage."""

    folder: Path
    study: LayoutStudy
    design: Design
    url: str
    trials: int
    emulator: Path | None

    @property
    def axes(self) -> dict[str, Axis]:
        """What each field may be."""
        return layout_fields.axes_of(self.study)

    @property
    def limits(self) -> list[Limit]:
        """The constraints."""
        return limits(self.study.constraints)


@dataclass(frozen=True)
class Progress:
    """How far an exploration is: layouts with numbers, ones that cannot be, under way, and wanted."""

    complete: int
    infeasible: int
    running: int
    wanted: int

    @property
    def done(self) -> int:
        """Layouts that nobody needs to look at again."""
        return self.complete + self.infeasible


def prepare(
    study: str | Path,
    out: str | Path,
    *,
    trials: int | None = None,
    storage: str | None = None,
    emulator: str | Path | None = None,
) -> Exploration:
    """Return an exploration in a folder, a new one or the one that is there with the same study.

    Raises
    ------
    DesignError
        In one line: for a study that cannot be, another study's folder, a storage that cannot be opened.
    """
    source, folder = load(study), Path(out)
    before = explore_folder.earlier(folder, source.text)
    if before is None:
        found = checked(source, trials, emulator)
    else:
        storage, trials = storage or before.storage, trials or before.trials
        found = checked(source, trials, emulator or before.emulator)
        if emulator is None and before.emulator is None:  # one that came since would judge otherwise
            found = replace(found, emulator=None)
    url = storage or explore_folder.own_database(folder)
    made = replace(found, folder=folder, url=url)
    head = explore_folder.head_of(made.design, storage, made.trials, made.emulator)
    if before is not None:
        explore_folder.check_same(folder, before, head, made.design)
    with explore_folder.making(folder):
        optuna_study = opened(made)
        if before is not None and url != (before.storage or explore_folder.own_database(folder)):
            explore_folder.check_moved(folder, before, url, len(optuna_study.get_trials(deepcopy=False)))
        explore_folder.write(folder, source.text, made.design, head)
    _enqueue(made, optuna_study)
    return made


def reopened(folder: Path) -> Exploration:
    """Return the exploration of a folder that `prepare` made."""
    study = parse((folder / STUDY).read_text(encoding="utf-8"), str(folder / STUDY))
    head = explore_folder.head(folder)
    url = head.storage or explore_folder.own_database(folder)
    emulator = Path(head.emulator) if head.emulator else None
    return Exploration(folder, study, load_design(folder / BASE), url, head.trials, emulator)


def checked(source: Source, trials: int | None, emulator: str | Path | None) -> Exploration:
    """Return what a study means, without a folder; raises `DesignError` for one that cannot be."""
    study = source.study
    try:
        name = study.design
        design = load_design(name if name in shipped_designs() else source.folder / name)
        base = layout_fields.base(study, design)
        axes = layout_fields.axes(study, design)
        judging.check(base, study.balls())
        judging.expand(base.design, study.unknown())
        for field, one in axes.items():
            _possible(study, design, field, one)
        file = _emulator(source, design, emulator, axes)
        whole = grid_size(axes, study, design)
    except DesignError as error:
        raise error.renamed(source=error.source or source.name) from None
    number = trials or study.search.trials or whole
    if study.search.method == "grid":
        number = min(number, whole)
    return Exploration(Path(), study, design, "", number, file)


def _possible(study: LayoutStudy, design: Design, field: str, one: Axis) -> None:
    """Raise where no value of a field makes a sensor that can be."""
    refused = None
    for value in layout_fields.some(one, layout_fields.whole(field, design)):
        try:
            made = layout_fields.layout(study, design, {field: layout_fields.said(value)})
            judging.check(made, study.balls())
            return
        except DesignError as error:
            refused = error
    others = set(study.fields) - {field}
    if refused is not None and not others:
        raise refused
    if refused is not None and refused.field.split(".")[-1] == field.split(".")[-1]:
        raise refused


def _emulator(
    source: Source, design: Design, given: str | Path | None, axes: Mapping[str, Axis]
) -> Path | None:
    """The emulator's file: given, the study's, or the design's own; None where a field moves mechanics."""
    study = source.study
    kinds = [layout_fields.kind_of(study, design, name, one) for name, one in axes.items()]
    if "mechanical" in kinds:
        if given is not None or study.emulator is not None:
            moves = next(n for n, k in zip(axes, kinds, strict=True) if k == "mechanical")
            raise DesignError("emulator", f"it with {moves}, which changes the mechanics", "none")
        return None
    named = given or study.emulator
    file = learned.usual_emulator(design.name)
    if named:
        file = learned.emulator_file(named, Path() if given else source.folder)
    if named is None and not file.exists():
        return None
    made = layout_fields.base(study, design)
    known = presses.emulator_of(made.design, file)
    places = [
        replace(ball, offset=(ball.offset[0] - x, ball.offset[1] - y))
        for ball in study.balls()
        for x, y in made.protocol.positions_mm
    ]
    for ball in places:
        try:
            presses.check_emulated(made.design, ball, made.protocol.indentation_mm, known)
        except fem.NotModelled as error:
            if named is None:  # nobody asked for this one
                return None
            field, _, rest = str(error).partition(": received ")
            received, _, allowed = rest.partition("; allowed ")
            raise DesignError(field, received, allowed or "what the emulator knows") from None
    return file


def opened(exploration: Exploration) -> optuna.Study:
    """Return Optuna's study, made where it is new; raises `DesignError` for a storage that cannot be."""
    import optuna

    optuna.logging.set_verbosity(optuna.logging.ERROR)
    warnings.filterwarnings("ignore", category=optuna.exceptions.ExperimentalWarning)
    study = exploration.study
    try:
        options = {"connect_args": {"timeout": 120}} if exploration.url.startswith("sqlite") else {}
        with locked(exploration.folder / WORKERS / explore_folder.LOCK):
            storage = optuna.storages.RDBStorage(exploration.url, engine_kwargs=options)
            return optuna.create_study(
                storage=storage,
                study_name=study.name,
                directions=list(study.objectives.values()),
                load_if_exists=True,
            )
    except Exception as error:  # SQLAlchemy's and its drivers' many ways to say no
        place = explore_folder.hidden(exploration.url)
        reason = " ".join(str(error).replace(exploration.url, place).split())[:120]
        if exploration.url == explore_folder.own_database(exploration.folder):
            received = f"{shown(str(exploration.folder))}, whose {DATABASE} does not open ({reason})"
            raise DesignError("--out", received, "a folder whose database Optuna opens") from None
        allowed = "a URL that SQLAlchemy opens (sqlite:///FILE, postgresql://..., mysql+pymysql://...)"
        raise DesignError("--storage", f"{place} ({reason})", allowed) from None


def work(
    exploration: Exploration,
    *,
    evaluate: Callable[..., Evaluation] = judging.evaluate,
    go_on: Callable[[], bool] = lambda: True,
) -> int:
    """Try layouts until all are there, and return how many were tried; other processes may do the same."""
    optuna_study = opened(exploration)
    bench = Bench(Kept(exploration.folder / KEPT))
    emulator = None
    if exploration.emulator is not None:
        emulator = presses.emulator_of(exploration.design, exploration.emulator)
    options = {"emulator": emulator, "bench": bench, "evaluate": evaluate}
    tried = 0
    with alive(exploration.folder / WORKERS) as me:
        with locked(exploration.folder / WORKERS / "baseline.lock", wait=False) as mine:
            if mine and explored.read(exploration.folder / BASELINE) is None:
                base = layout_fields.base(exploration.study, exploration.design)
                found = _evaluated(exploration, base, **options)
                explored.write_trial(exploration.folder / BASELINE, found, {}, None)
        while go_on() and (trial := _next(exploration, optuna_study, me)) is not None:
            _try(exploration, optuna_study, trial, **options)
            tried += 1
            if tried % 20 == 0:
                _give_back()
    return tried


def progress(exploration: Exploration, optuna_study: optuna.Study | None = None) -> Progress:
    """Return how far an exploration is."""
    from optuna.trial import TrialState

    optuna_study = optuna_study or opened(exploration)
    trials = optuna_study.get_trials(deepcopy=False)
    return Progress(
        sum(trial.state == TrialState.COMPLETE for trial in trials),
        sum(trial.state == TrialState.FAIL and "reason" in trial.user_attrs for trial in trials),
        sum(trial.state == TrialState.RUNNING for trial in trials),
        exploration.trials,
    )


def _next(exploration: Exploration, optuna_study: optuna.Study, me: str) -> optuna.Trial | None:
    """The next layout, None where as many as wanted are done or under way."""
    with locked(exploration.folder / WORKERS / "queue.lock"):
        _recover(exploration, optuna_study)
        now = progress(exploration, optuna_study)
        if now.done + now.running >= exploration.trials:
            return None
        return proposals.ask(exploration.study, exploration.design, optuna_study, now.done + now.running, me)


def _recover(exploration: Exploration, optuna_study: optuna.Study) -> None:
    """Put the layouts of workers that are dead into the queue again, and give up their trials.

    In this order, and each once: a process may be killed between any two commits. A planned layout is taken
    from the plan, because its trial may have got only some of its values; a drawn one is drawn again.
    """
    from optuna.trial import TrialState

    trials = optuna_study.get_trials(deepcopy=False)
    again = {trial.user_attrs.get("again") for trial in trials}
    for trial in trials:
        if trial.state != TrialState.RUNNING or not _dead(exploration, trial):
            continue
        number, values = trial.user_attrs.get("planned"), trial.params
        if number is not None:
            values = next(itertools.islice(planned(exploration), number, None))
        if trial.number not in again and len(values) == len(exploration.axes):
            marks = {"again": trial.number} | ({} if number is None else {"planned": number})
            optuna_study.enqueue_trial(values, user_attrs=marks)
        # another machine, which does not see this one's lock, may have been quicker
        with suppress(Exception):
            optuna_study.tell(trial.number, state=TrialState.FAIL)


def _dead(exploration: Exploration, trial: optuna.trial.FrozenTrial) -> bool:
    """Whether nobody works on a trial any more."""
    worker = trial.user_attrs.get("worker")
    file = exploration.folder / WORKERS / f"{worker}.lock"
    if worker is not None and file.exists():
        with locked(file, wait=False) as free:
            return free
    started = trial.datetime_start
    if worker is None:  # between asking and signing, which the queue's lock makes one step on one machine
        return exploration.url.startswith("sqlite")
    from datetime import datetime

    return started is not None and (datetime.now() - started).total_seconds() > LOST_S


def _try(exploration: Exploration, optuna_study: optuna.Study, trial: optuna.Trial, **options: Any) -> None:
    """Evaluate one layout and record it: complete with its objectives, or infeasible with its reason."""
    from optuna.trial import TrialState

    study = exploration.study
    folder = exploration.folder / TRIALS / f"{trial.number:04d}"
    values = dict(trial.params)
    try:
        layout = layout_fields.layout(study, exploration.design, values)
        known = judging.objectives.beforehand(layout.design, layout.protocol)
        for limit in exploration.limits:
            if limit.name in known and limit.excess(known[limit.name]) > 0:
                allowed = f"what the constraint {limit.text!r} says"
                raise DesignError(limit.name, f"{known[limit.name]:g}", allowed)
        found = _evaluated(exploration, layout, **options)
    except (DesignError, fem.NotModelled, NotModelled, fem.NotConverged) as error:
        reason = " ".join(str(error).split())
        explored.write_infeasible(folder, reason, values, trial.number)
        trial.set_user_attr("reason", reason)
        optuna_study.tell(trial, state=TrialState.FAIL)
        return
    explored.write_trial(folder, found, values, trial.number)
    trial.set_user_attr("objectives", found.objectives)  # at once: every attribute is a commit of its own
    if exploration.limits:
        excess = [limit.excess(found.objectives[limit.name]) for limit in exploration.limits]
        trial.set_user_attr("constraints", excess)
    optuna_study.tell(trial, [found.objectives[name] for name in study.objectives])


def _evaluated(exploration: Exploration, layout: Layout, **options: Any) -> Evaluation:
    study, evaluate = exploration.study, options.pop("evaluate")
    return evaluate(
        layout,
        study.balls(),
        study.unknown(),
        quality=study.quality,
        seed=study.seed,
        fill=study.exposure_fill,
        **options,
    )


def planned(exploration: Exploration) -> Iterator[dict[str, layout_fields.Value]]:
    """The layouts of a grid or of a Latin hypercube."""
    return proposals.planned(exploration.study, exploration.axes, exploration.design, exploration.trials)


def _enqueue(exploration: Exploration, optuna_study: optuna.Study) -> None:
    """Put the layouts of a grid or a Latin hypercube into the queue, each once, whoever comes first."""
    method = exploration.study.search.method
    if method not in ("grid", "latin"):
        return
    with locked(exploration.folder / WORKERS / "queue.lock"):
        trials = optuna_study.get_trials(deepcopy=False)
        there = {trial.user_attrs.get("planned") for trial in trials}
        for number, values in enumerate(planned(exploration)):
            if number not in there:
                optuna_study.enqueue_trial(values, user_attrs={"planned": number})


def _give_back() -> None:
    from twin.labour import give_back

    give_back()


def clean(exploration: Exploration) -> None:
    """Remove what only an exploration under way needs."""
    shutil.rmtree(exploration.folder / KEPT, ignore_errors=True)
