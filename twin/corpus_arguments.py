"""What ``twin corpus`` accepts: one function for each of its actions, which `add` lists."""

from __future__ import annotations

from typing import Any, get_args

from twin.arguments import QUALITIES, add_verb, choice, number, whole
from twin.study import CorpusMechanics

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
  twin corpus plan training --frames 1000000 --out corpora/training
  twin corpus plan my-study.toml --count 3 --quality preview --no-probe --out corpora/trial
"""

_RUN = """\
Make every sample of the plan in DIR that is not there yet; also after a run that was cut off, and those that
failed before. A sample that fails is tried again, then recorded in DIR/failed, and stops no other.

Workers are processes of one thread on this machine, or those of a Dask scheduler that see DIR under the same
path: start `dask scheduler` once and `dask worker ADDRESS --nthreads 1` wherever there is a core.

Exit status: 0 all there, 1 some failed or the disk is full, 2 bad input, 130 interrupted.

examples:
  twin corpus run corpora/paper
  twin corpus run corpora/paper --workers 2
  twin corpus run corpora/paper --scheduler tcp://127.0.0.1:8786
"""

_STATUS = """\
Say what of a corpus is there, what is missing, what failed and why. Reads only.

examples:
  twin corpus status corpora/paper
  twin corpus status corpora/paper --json
"""

_VERIFY = """\
Read every file of a corpus and compare it with its SHA-256, the frames with the plan, the index with the
frames; then simulate a few random samples again and compare the bytes. Names whatever is wrong, a line each,
and exits 1.

examples:
  twin corpus verify corpora/paper
  twin corpus verify corpora/paper --resimulate 10 --workers 2
  twin corpus verify corpora/paper --repair; twin corpus run corpora/paper
"""


_EXPORT = """\
Write what is finished in the format of other people's training code, into a new folder, all or nothing:
webdataset (tar shards, one entry per sample), hf (Parquet shards with pictures inside, for
datasets.load_dataset) or png (folders of pictures, metadata.csv and metadata.jsonl).

examples:
  twin corpus export corpora/paper --format webdataset --out exports/paper --shape 246 384
  twin corpus export corpora/paper --format hf --out exports/paper-hf --shards 8
"""

_CARD = """\
Write the corpus's card: README.md and figures (pictures, histograms, correlation of surface and picture,
noise and error) of what is finished.

examples:
  twin corpus card corpora/paper
"""


def add(verbs: Any) -> None:
    """Add the verb and its actions to the parser of `twin.arguments`."""
    corpus = add_verb(verbs, "corpus", "training corpora: plan, run, status, verify, export, card", _CORPUS)
    actions = corpus.add_subparsers(dest="action", metavar="ACTION", title="actions", required=True)
    _add_plan(actions)
    _add_run(actions)
    _add_status(actions)
    _add_verify(actions)
    _add_export(actions)
    _add_card(actions)


def _add_plan(actions: Any) -> None:
    plan = add_verb(actions, "plan", "freeze a study; how long and how large it will be", _PLAN)
    plan.add_argument("study", metavar="STUDY", help="name of a shipped study, or a TOML file")
    plan.add_argument("--out", metavar="DIR", help="new folder for the corpus")
    plan.add_argument("--seed", type=whole, metavar="N", help="of all random numbers (default: the study's)")
    plan.add_argument(
        "--mechanics",
        type=choice(*get_args(CorpusMechanics)),
        metavar="M",
        help=", ".join(get_args(CorpusMechanics)) + " (default: the study's)",
    )
    plan.add_argument(
        "--emulator",
        metavar="FILE.npz",
        help="for emulator (default emulators/DESIGN.npz, else the one that ships)",
    )
    plan.add_argument(
        "--traced",
        metavar="FILE.npz",
        help="traced light without noise, of `twin emulate DESIGN --light`; tsis ships",
    )
    for flag, of in (("--quality", "the mechanics"), ("--light", "the light")):
        words = f"{', '.join(QUALITIES)}: of {of} (default: the study's)"
        plan.add_argument(flag, type=choice(*QUALITIES), metavar="Q", help=words)
    plan.add_argument(
        "--paths",
        type=whole,
        metavar="N",
        help="light paths from each LED; four times as many halve their noise (default: the quality's)",
    )
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


def _add_run(actions: Any) -> None:
    run = add_verb(actions, "run", "make what is missing", _RUN)
    run.add_argument("directory", metavar="DIR", help="folder of the corpus")
    run.add_argument(
        "--workers", type=whole, metavar="N", help="processes on this machine (default: one per core)"
    )
    run.add_argument(
        "--scheduler", metavar="ADDRESS", help="a Dask scheduler, as tcp://127.0.0.1:8786, instead"
    )
    run.add_argument(
        "--retries", type=whole, default=1, metavar="N", help="for a sample that fails (default 1)"
    )


def _add_status(actions: Any) -> None:
    status = add_verb(actions, "status", "what is there, missing, failed and why", _STATUS)
    status.add_argument("directory", metavar="DIR", help="folder of the corpus")
    status.add_argument("--json", action="store_true", help="as JSON on stdout")


def _add_verify(actions: Any) -> None:
    verify = add_verb(actions, "verify", "hashes, index and a few samples made again", _VERIFY)
    verify.add_argument("directory", metavar="DIR", help="folder of the corpus")
    verify.add_argument(
        "--resimulate", type=whole, default=2, metavar="N", help="random samples to make again (default 2)"
    )
    verify.add_argument("--seed", type=whole, default=0, metavar="N", help="which ones (default 0)")
    verify.add_argument(
        "--workers", type=whole, metavar="N", help="processes to make them (default: one per core)"
    )
    verify.add_argument(
        "--repair", action="store_true", help="remove what is damaged, so that run makes it again"
    )


def _add_export(actions: Any) -> None:
    export = add_verb(actions, "export", "WebDataset, Hugging Face or PNG", _EXPORT)
    export.add_argument("directory", metavar="DIR", help="folder of the corpus")
    formats = ("webdataset", "hf", "png")
    export.add_argument("--format", type=choice(*formats), metavar="F", help=", ".join(formats))
    export.add_argument("--out", metavar="OUT", help="new folder for the export")
    export.add_argument(
        "--shape",
        type=whole,
        nargs=2,
        metavar=("ROWS", "COLUMNS"),
        help="smaller pictures, means of whole pixels",
    )
    export.add_argument(
        "--shards", type=whole, metavar="N", help="files of webdataset and hf (default: by size)"
    )


def _add_card(actions: Any) -> None:
    card = add_verb(actions, "card", "README.md and figures of what is there", _CARD)
    card.add_argument("directory", metavar="DIR", help="folder of the corpus")
