"""What the verbs of learned estimators accept: ``twin train``, ``calibrate``, ``assess`` and ``estimate``."""

from __future__ import annotations

import argparse
from typing import Any

from twin.arguments import add_device, add_verb, number, whole

_TRAIN = """\
Learn from a corpus to tell an inclusion's size, depth and modulus from pictures, with how sure that is, and
whether there is one at all. Writes MODEL.safetensors and MODEL.json, a card of what it was trained for and of
how well it does on samples that it has not seen (those of a group named test). What is done is kept beside
them, in MODEL.parts: the same command goes on with it, also after Ctrl-C.

examples:
  twin train corpora/train --out models/tsis
  twin train corpora/train --levels 0 2 --minutes 40 --seed 1 --out models/two-levels
  twin train corpora/train --device cuda --out models/tsis
"""

_ASSESS = """\
Answer every inclusion of a corpus that a model has not seen (its group named test, else all), from one
exposure and from the mean of 100, by the network and refined by rendering, and compare with the truth and
with the smallest error that the pictures allow. Writes report.html, assessment.json and assessment.png. A
corpus of the same sensor made by full solves or with other light tells what a mismatch costs. Half a minute
a sample and core; every answer is kept: the same command goes on, also after Ctrl-C. With --curve, a learning
curve of the light map, which the report of the same DIR shows, too.

examples:
  twin assess models/tsis corpora/pictures --out assessed
  twin assess models/tsis corpora/pictures --averaged 100 --out assessed
  twin assess tsis corpora/held-out --as-trained --single 0 --out averaged
  twin assess models/tsis corpora/pictures --quick --out quick
  twin assess models/tsis corpora/solved --samples 20 --out mismatch
  twin assess tsis corpora/held-out --as-trained --out matched
  twin assess models/tsis corpora/pictures --curve --out assessed
"""

_CALIBRATE = """\
Teach a model what a corpus of known inclusions is beyond its own emulator, learned light and coarse meshes:
full solves with light of their own, of the sensor that the model was trained for. The corpus varies what the
model's own did; two dozen inclusions all over the ranges will do. What is not foretold after that goes into
the intervals, and pictures of that kind are no longer refused as unlike the model's. Ten seconds a sample and
core, kept in MODEL.parts: the same command goes on, also after Ctrl-C. No inclusion that the model is to be
tested on may be in the corpus.

examples:
  twin corpus plan my-solves.toml --mechanics finite --light standard --out corpora/solved
  twin corpus run corpora/solved
  twin calibrate models/tsis corpora/solved --out models/tsis-solved
"""

_ESTIMATE = """\
Tell an inclusion from pictures of a trained model's sensor: size, depth and modulus with 90 % intervals, and
the probability that there is one. Pictures that the model cannot take, or that are unlike those that it was
trained for, are refused in one line. The network's answer is refined by rendering the most probable
inclusion, some 20 seconds, where that explains the pictures. With --out: estimate.json, and overview.png to
look at.

MODEL is a file of `twin train`, or tsis: the model that ships, of the design tsis pressed by 1, 2 and 2.9 mm,
calibrated for full solves (ESTIMATE.md).

FRAME is a folder of `twin simulate` (one press level or all), or a camera's PNG file of 8 or 16 bits, one for
each of the model's press levels in order; these need --reference: the same presses without inclusion, in the
same order. A camera below the sensor sees the mirror image, which --flip turns round. With --frames N each
level has N exposures, those of the first level first; references may be several for each level, too. Give
exposures as they were taken: a mean that was rounded to whole counts is biased where it is dark.

examples:
  twin simulate tsis --size 10 --depth 5 --modulus 100 --indentation 1 2 2.9 --out levels
  twin estimate tsis levels --out estimate
  twin estimate tsis 1mm.png 2mm.png 3mm.png --reference r1.png r2.png r3.png --flip --out found
  twin estimate my.safetensors 1mm-*.png 2mm-*.png 3mm-*.png --frames 10 --reference r?mm-*.png --flip
"""

_MODEL = "what twin train wrote, FILE.safetensors, or tsis, which ships"


def add(verbs: Any) -> None:
    """Add the verbs to the parser of `twin.arguments`."""
    train = add_verb(verbs, "train", "learn to estimate inclusions from the pictures of a corpus", _TRAIN)
    train.add_argument("corpus", metavar="CORPUS", help="folder of a finished corpus")
    train.add_argument("--out", metavar="MODEL", help="model to write, without its ending")
    train.add_argument(
        "--levels", type=whole, nargs="+", metavar="N", help="press levels to use, from 0 (default: all)"
    )
    train.add_argument(
        "--minutes", type=number(above=0.0), default=20.0, metavar="MIN", help="time to train (default 20)"
    )
    train.add_argument(
        "--samples",
        type=whole,
        metavar="N",
        help="samples that light is learned from, at most (default: all)",
    )
    train.add_argument(
        "--imagined", type=whole, metavar="N", help="specimens that the network is shown (default 16000)"
    )
    train.add_argument("--seed", type=whole, default=0, metavar="N", help="of all random numbers (default 0)")
    add_device(train, "what the network is trained on")
    _add_lean(train)

    assess = add_verb(verbs, "assess", "how well a model tells inclusions that it has not seen", _ASSESS)
    assess.add_argument("model", metavar="MODEL", help=_MODEL)
    assess.add_argument("corpus", metavar="CORPUS", help="folder of a finished corpus")
    assess.add_argument("--out", metavar="DIR", help="folder for the assessment")
    assess.add_argument("--samples", type=whole, metavar="N", help="at most so many (default: all)")
    assess.add_argument(
        "--single",
        type=whole,
        metavar="N",
        help="answer single exposures of at most so many (default: all)",
    )
    assess.add_argument(
        "--averaged",
        type=whole,
        metavar="N",
        help="answer means of 100 exposures, which take far longer, of at most so many (default: all)",
    )
    assess.add_argument(
        "--curve",
        action="store_true",
        help="instead: how well light learned from 40, 80, ... of the corpus's samples does",
    )
    assess.add_argument("--quick", action="store_true", help="the network alone, without rendering")
    assess.add_argument(
        "--as-trained",
        action="store_true",
        help="a calibrated model as it was before twin calibrate, for pictures of its own chain",
    )
    assess.add_argument("--workers", type=whole, metavar="N", help="processes (default: one for each core)")
    assess.add_argument(
        "--seed", type=whole, default=0, metavar="N", help="of all random numbers (default 0)"
    )

    calibrate = add_verb(verbs, "calibrate", "teach a model what known inclusions are beyond it", _CALIBRATE)
    calibrate.add_argument("model", metavar="MODEL", help=_MODEL)
    calibrate.add_argument("corpus", metavar="CORPUS", help="folder of a finished corpus")
    calibrate.add_argument("--out", metavar="MODEL", help="model to write, without its ending")
    calibrate.add_argument("--samples", type=whole, metavar="N", help="the first so many (default: all)")
    calibrate.add_argument(
        "--workers", type=whole, metavar="N", help="processes (default: one for each core)"
    )
    _add_lean(calibrate)

    estimate = add_verb(verbs, "estimate", "an inclusion from pictures, with how sure that is", _ESTIMATE)
    estimate.add_argument("model", metavar="MODEL", help=_MODEL)
    estimate.add_argument("frames", metavar="FRAME", nargs="+", help="folder of twin simulate, or PNG file")
    estimate.add_argument(
        "--reference", metavar="FILE", nargs="+", default=[], help="PNG files of the press without inclusion"
    )
    estimate.add_argument(
        "--frames",
        dest="exposures",
        type=whole,
        default=1,
        metavar="N",
        help="FRAMEs of each press level, to be averaged (default 1)",
    )
    estimate.add_argument(
        "--quick",
        action="store_true",
        help="without rendering: by the network, or a fit where MODEL is calibrated (2 s instead of 20)",
    )
    estimate.add_argument("--flip", action="store_true", help="the files are seen from below, mirrored")
    estimate.add_argument("--out", metavar="DIR", help="new folder for estimate.json and overview.png")
    estimate.add_argument(
        "--samples", type=whole, default=4000, metavar="N", help="of the posterior (default 4000)"
    )
    estimate.add_argument(
        "--seed", type=whole, default=0, metavar="N", help="of the posterior's samples (default 0)"
    )


def _add_lean(verb: argparse.ArgumentParser) -> None:
    verb.add_argument(
        "--lean",
        action="store_true",
        help="leave out emulator and learned light, which must be those that ship: a smaller file, which "
        "versions with the same can read",
    )
