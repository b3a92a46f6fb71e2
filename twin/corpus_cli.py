"""What ``twin corpus ACTION`` does: one function for each action, which `_ACTIONS` lists."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from twin.complaint import DesignError, shown


def run(arguments: argparse.Namespace) -> int:
    """Run the action of a parsed command line and return the exit status."""
    return _ACTIONS[arguments.action](arguments)


def _plan(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the folder to make for the corpus")
    if arguments.no_probe and arguments.frames is not None:
        raise DesignError("--frames", "it with --no-probe", "one of them")
    from twin.plan import freeze
    from twin.probe import described, measure, projected
    from twin.reporting import Reporter

    with Reporter() as report:
        plan = freeze(
            arguments.study,
            arguments.out,
            seed=arguments.seed,
            mechanics=arguments.mechanics,
            emulator=arguments.emulator,
            traced=arguments.traced,
            quality=arguments.quality,
            light=arguments.light,
            paths=arguments.paths,
            count=arguments.count,
            progress=report,
        )
    print(described(plan), flush=True)
    if arguments.no_probe:
        return 0
    try:
        with Reporter() as report:
            cost = measure(plan, report)
    except KeyboardInterrupt:
        print("twin corpus plan: interrupted in the probe; the plan is written", file=sys.stderr)
        return 130
    print(projected(plan, cost, len(plan) * len(plan.indentation_mm), arguments.workers))
    if arguments.frames is not None:
        print(projected(plan, cost, arguments.frames, arguments.workers))
    return 0


def _run(arguments: argparse.Namespace) -> int:
    for flag in ("workers", "scheduler"):
        if getattr(arguments, flag) in (0, ""):
            raise DesignError(f"--{flag}", shown(getattr(arguments, flag)), "an integer > 0, or nothing")
    if arguments.workers is not None and arguments.scheduler is not None:
        raise DesignError("--workers", "it with --scheduler", "one of them")
    from twin.headway import Headway
    from twin.run import Stopped, run

    with Headway() as tell:
        try:
            state = run(
                arguments.directory,
                arguments.workers,
                arguments.scheduler,
                retries=arguments.retries,
                progress=tell,
            )
        except Stopped as error:
            return _failed("run", str(error))
        except KeyboardInterrupt:
            tell.close()
            print(
                "twin corpus run: interrupted; what is finished stays, run again continues", file=sys.stderr
            )
            return 130
    print(
        f"{state.done} of {state.planned} samples are there, {state.made} of them new: {arguments.directory}"
    )
    for line in state.notes:
        print(line)
    if state.made and state.done == state.planned:
        try:
            _write_card(arguments.directory)
        except DesignError as error:  # somebody's own README.md
            print(f"no card was written: {error}")
    if state.failed:
        return _failed(
            "run", f"{state.failed} samples failed; twin corpus status {arguments.directory} says why"
        )
    return 0


def _status(arguments: argparse.Namespace) -> int:
    from twin.status import as_json, in_words, status

    found = status(arguments.directory)
    print(as_json(found) if arguments.json else in_words(found))
    return 0


def _verify(arguments: argparse.Namespace) -> int:
    if arguments.workers == 0:
        raise DesignError("--workers", "0", "an integer > 0")
    from twin.reporting import Reporter
    from twin.run import Stopped
    from twin.verify import verify

    with Reporter() as report:
        try:
            found = verify(
                arguments.directory,
                resimulate=arguments.resimulate,
                seed=arguments.seed,
                workers=arguments.workers,
                repair=arguments.repair,
                progress=report,
            )
        except Stopped as error:
            return _failed("verify", str(error))
    for line in found.lines:
        print(line)
    print(found.summary, flush=True)
    return 0 if found.good else 1


def _export(arguments: argparse.Namespace) -> int:
    for name, what in (("format", "webdataset, hf or png"), ("out", "the folder to make for the export")):
        if getattr(arguments, name) is None:
            raise DesignError(f"--{name}", "nothing", what)
    from twin.corpus import Corpus
    from twin.exporting import export
    from twin.reporting import Reporter

    corpus = Corpus(arguments.directory)
    with Reporter() as report:
        written = export(
            corpus,
            arguments.out,
            arguments.format,
            shape=None if arguments.shape is None else tuple(arguments.shape),
            shards=arguments.shards,
            progress=_told(report, "samples"),
        )
    size = sum(path.stat().st_size for path in written)
    print(f"{len(corpus)} samples in {len(written)} files, {size / 1e6:.3g} MB: {arguments.out}")
    return 0


def _card(arguments: argparse.Namespace) -> int:
    _write_card(arguments.directory)
    return 0


def _write_card(directory: str) -> None:
    from twin.card import write_card
    from twin.corpus import Corpus
    from twin.reporting import Reporter

    with Reporter() as report:
        written = write_card(Corpus(directory), _told(report, "card"))
    print(f"look at: {written[0]}")


def _told(report: Callable[[str, float], None], stage: str) -> Callable[[int, int], None]:
    return lambda done, total: report(stage, done / total)


def _failed(action: str, line: str) -> int:
    print(f"twin corpus {action}: {' '.join(line.split())}", file=sys.stderr)
    return 1


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {
    "plan": _plan,
    "run": _run,
    "status": _status,
    "verify": _verify,
    "export": _export,
    "card": _card,
}
