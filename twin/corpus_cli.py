"""What ``twin corpus ACTION`` does: one function for each action, which `_ACTIONS` lists."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable

from twin import interrupt
from twin.complaint import DesignError


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

        def tell(stage: str, done: float) -> None:
            interrupt.stop_if_asked()
            report(stage, done)

        plan = freeze(
            arguments.study,
            arguments.out,
            seed=arguments.seed,
            mechanics=arguments.mechanics,
            emulator=arguments.emulator,
            quality=arguments.quality,
            light=arguments.light,
            count=arguments.count,
            progress=tell,
        )
    print(described(plan), flush=True)
    if arguments.no_probe:
        return 0
    try:
        with Reporter() as report:
            cost = measure(plan, tell)
    except KeyboardInterrupt:
        print("twin corpus plan: interrupted in the probe; the plan is written", file=sys.stderr)
        return 130
    print(projected(plan, cost, len(plan) * len(plan.indentation_mm), arguments.workers))
    if arguments.frames is not None:
        print(projected(plan, cost, arguments.frames, arguments.workers))
    return 0


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {"plan": _plan}
