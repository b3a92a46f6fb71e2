"""What ``twin explore`` accepts and does."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING, Any

from twin.arguments import add_verb, number, whole
from twin.complaint import DesignError
from twin.stage import staged_file

if TYPE_CHECKING:
    from twin.explore import Exploration

_EXPLORE = """\
Explore layouts of a sensor and ways to use it: which can tell most about an inclusion's size, depth and
modulus? A study file names the fields that vary, the objectives, the constraints and the search; EXPLORE.md
says how. Results come into DIR: study.db (Optuna's: optuna-dashboard opens it), a folder for each layout
under trials, the study's own layout under baseline, and report.html. The same command goes on where it was
cut off; more processes may work on the same DIR, and on other machines with --storage.

examples:
  twin explore leds --out leds --plan
  twin explore protocol --out protocol --emulator tsis
  twin explore my-study.toml --out found --trials 200 --workers 8
  twin explore my-study.toml --out found --storage postgresql://user@host/studies
  twin explore surface --out surface --confirm 20
"""


def add(verbs: Any) -> None:
    """Add the verb to the parser of `twin.arguments`."""
    verb = add_verb(verbs, "explore", "layouts searched for what they can tell", _EXPLORE)
    verb.add_argument("study", metavar="STUDY", help="a shipped study or a TOML file")
    verb.add_argument("--out", metavar="DIR", help="folder for the results, new or to go on with")
    verb.add_argument("--trials", type=whole, metavar="N", help="layouts to try (default: the study's)")
    verb.add_argument("--workers", type=whole, metavar="N", help="processes (default: all cores)")
    verb.add_argument("--storage", metavar="URL", help="database of the study (default DIR/study.db)")
    verb.add_argument(
        "--emulator",
        metavar="FILE.npz",
        help="of the design's mechanics (default emulators/DESIGN.npz, else the one that ships)",
    )
    verb.add_argument("--plan", action="store_true", help="say what each field changes and how long it takes")
    verb.add_argument(
        "--confirm",
        type=number(above=0.0),
        metavar="MINUTES",
        help="then bounds of the base and of the layout that tells E best in light followed ray by ray",
    )


def run(arguments: argparse.Namespace) -> int:
    """Run the verb of a parsed command line and return the exit status."""
    for flag in ("trials", "workers"):
        if getattr(arguments, flag) == 0:
            raise DesignError(f"--{flag}", "0", "an integer > 0")
    workers = arguments.workers or os.cpu_count() or 1
    from twin import explore, explore_crew, explore_words
    from twin.layout_study import load

    if arguments.plan:
        found = explore.checked(load(arguments.study), arguments.trials, arguments.emulator)
        print(explore_crew.planned(found, explore_crew.measure(found), workers))
        return 0
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the folder for the results")
    found = explore.prepare(
        arguments.study,
        arguments.out,
        trials=arguments.trials,
        storage=arguments.storage,
        emulator=arguments.emulator,
    )
    from twin.headway import Headway, layouts

    with Headway(layouts) as tell:
        try:
            state = explore_crew.run(found, workers, tell)
        except explore_crew.Broken as error:
            print(f"twin explore: {' '.join(str(error).split())}", file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            tell.close()
            print("twin explore: interrupted; what is finished stays, run again continues", file=sys.stderr)
            return 130
    many = "1 layout" if state.complete == 1 else f"{state.complete} layouts"
    print(f"{many} judged, {state.infeasible} that cannot be: {arguments.out}")
    for line in explore_words.findings(found):
        print(line)
    from twin import explore_report

    if state.complete:
        print(f"look at: {explore_report.write(found.folder)}")
    if state.done >= state.wanted:  # the report uses what is kept
        explore.clean(found)
    if arguments.confirm and state.complete:
        _confirm(found, arguments.confirm)
    return 0


def _confirm(found: Exploration, minutes: float) -> None:
    """Print the bounds of the base and the best layout in light followed ray by ray; DIR/confirmed.json."""
    from twin import confirm, explore_report, explore_words, layout_fields, presses
    from twin.reporting import Reporter

    best = explore_words.best(found, "bound_modulus_kPa")
    if best is None:
        return
    study, design = found.study, found.design
    layouts = [layout_fields.base(study, design), layout_fields.layout(study, design, best["values"])]
    names = ["the baseline", f"trial {best['number']}"]
    emulator = None if found.emulator is None else presses.emulator_of(design, found.emulator)
    with Reporter() as tell:
        tell("judging both again", 0.0)
        of_study = emulator, study.exposure_fill, study.quality, study.seed
        both = [confirm.Follower(one, study.balls(), study.unknown(), *of_study) for one in layouts]
        answers = confirm.compare(both, minutes, lambda done: tell("following light", done))
    for line in confirm.in_words(names, answers):
        print(line)
    with staged_file(str(found.folder / explore_report.CONFIRMED), "--out", ".json") as part:
        part.write_text(confirm.record(names, answers), encoding="utf-8")
    explore_report.write(found.folder)
