"""What ``twin corpus`` accepts: one function for each of its actions, which `add` lists."""

from __future__ import annotations

import argparse
from typing import Any

from twin.arguments import MECHANICS, QUALITIES, Parser, choice, number, whole

_CORPUS = """\
Corpora: thousands of labelled pictures to train on, resumable and verifiable. See CORPORA.md.

examples:
  twin corpus plan paper --out corpora/paper
"""

_PLAN = """\
Freeze a study into a plan: which specimens, presses and sensors, every random number of them drawn and
recorded, in DIR/plan.json and DIR/samples.parquet. STUDY is a shipped one (paper, quick, training) or a TOML
file. Then a sample or two are really simulated, to say how long the run will take and how large it will be.

examples:
  twin corpus plan paper --out corpora/paper
  twin corpus plan training --emulator emulators/tsis.npz --frames 1000000 --out corpora/training
  twin corpus plan my-study.toml --count 3 --quality preview --no-probe --out corpora/trial
"""


def add(verbs: Any) -> None:
    """Add the verb and its actions to the parser of `twin.arguments`."""
    corpus = _parser(verbs, "corpus", "training corpora: plan", _CORPUS)
    actions = corpus.add_subparsers(dest="action", metavar="ACTION", title="actions", required=True)
    _add_plan(actions)


def _parser(place: Any, name: str, summary: str, text: str) -> Parser:
    parser: Parser = place.add_parser(
        name,
        help=summary,
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    return parser


def _add_plan(actions: Any) -> None:
    plan = _parser(actions, "plan", "freeze a study; how long and how large it will be", _PLAN)
    plan.add_argument("study", metavar="STUDY", help="name of a shipped study, or a TOML file")
    plan.add_argument("--out", metavar="DIR", help="new folder for the corpus")
    plan.add_argument("--seed", type=whole, metavar="N", help="of all random numbers (default: the study's)")
    plan.add_argument(
        "--mechanics",
        type=choice(*MECHANICS, "emulator"),
        metavar="M",
        help=", ".join((*MECHANICS, "emulator")) + " (default: the study's)",
    )
    plan.add_argument("--emulator", metavar="FILE.npz", help="for emulator (default emulators/DESIGN.npz)")
    for flag, of in (("--quality", "the mechanics"), ("--light", "the light")):
        words = f"{', '.join(QUALITIES)}: of {of} (default: the study's)"
        plan.add_argument(flag, type=choice(*QUALITIES), metavar="Q", help=words)
    plan.add_argument("--count", type=whole, metavar="N", help="only the first N samples of every group")
    plan.add_argument("--no-probe", action="store_true", help="simulate nothing, estimate nothing")
    plan.add_argument(
        "--workers",
        type=number(above=0.0),
        default=2.0,
        metavar="N",
        help="cores to estimate for (default 2)",
    )
    plan.add_argument(
        "--frames", type=whole, metavar="N", help="also say what a corpus of N frames of this kind would take"
    )
