"""What the command line accepts: flags, their units, and one plain line for what it does not."""

from __future__ import annotations

import argparse
import math
import re
import sys
from collections.abc import Callable
from typing import Any, NoReturn

from twin.complaint import shown
from twin.presses import Mechanics, Quality
from twin.simulation import LEAST_NOISE, Device

QUALITIES = Quality.__args__  # type: ignore[attr-defined]
MECHANICS = Mechanics.__args__  # type: ignore[attr-defined]
DEVICES = Device.__args__  # type: ignore[attr-defined]

_DEMO = """\
Press the paper's sensor 2 mm into a slab with an inclusion of Table I (number 9: 10 mm across, its top
5 mm deep, 100 kPa) and write the picture, the fields behind it and a page to look at, overview.png.

example:
  twin demo --out tsis-demo
"""

_SIMULATE = """\
Press a sensor on a slab of tissue and write the picture that its camera takes: one frame, or one for each
press level in OUT/00, OUT/01, ... Lengths are mm, moduli kPa, forces N.

examples:
  twin simulate --size 10 --depth 5 --modulus 100 --out out
  twin simulate tsis --size 8 --depth 5 --modulus 120 --indentation 1 2 3 --seed 7 --out levels
  twin simulate tsis --size 10 --depth 5 --modulus 100 --offset 3 0 --tilt 0 2 --out tilted
  twin simulate my-sensor.toml --no-inclusion --force 0.5 --mechanics linear --out flat
  twin simulate --size 9 --depth 6 --modulus 80 --mechanics emulator --emulator tsis --out quick
  twin simulate --size 9 --depth 6 --modulus 80 --mechanics multipoles --out small-strain
"""

_CHECK = """\
Look a sensor over, on its press and a standard inclusion (10 mm across, 5 mm deep, 100 kPa), at preview
quality: where each LED's light goes, in per cent of what it emits; exposure; signal over noise; and what is
wrong, errors first, each with why it matters and what to change. Exit status 0 also where something is wrong;
2 where the design cannot be read. With --out, check.json and check.png: sample light paths and the balance.

examples:
  twin check tsis
  twin check my-sensor.toml --indentation 3 --out checked
  twin check tsis --json | jq .findings
"""

_EXPORT = """\
Press a sensor on a slab of tissue and write it for other programs; no light is computed. Lengths are mm,
moduli kPa.
  --vtu      displacement, stress and materials throughout, which ParaView opens
  --ccx      the same press, with and without the inclusion, as input decks of CalculiX
  --mitsuba  the scene as XML, PLY and a table, which the stock mitsuba package loads with mi.load_file; our
             plugins are registered by one import after mi.set_variant("llvm_ad_mono"): import scenes.plugins
  --stl      guide, contact surface and glass as meshes
  --ply      the same, with pressure and real contact fraction at the contact surface's vertices

examples:
  twin export --size 10 --depth 5 --modulus 100 --indentation 2 --vtu press.vtu
  twin export my-sensor.toml --no-inclusion --tilt 0 3 --mechanics linear --vtu tilted.vtu
  twin export tsis --size 10 --depth 5 --modulus 100 --indentation 1 2 3 --ccx decks
  twin export tsis --size 10 --depth 5 --modulus 100 --mitsuba scene
  twin export tsis --no-inclusion --ply meshes
"""

_EMULATE = """\
Learn the contact field of a design's sensor, so that a press takes milliseconds: solve many specimens
around the design's, fit, and say how far held-out ones are off. What was solved is kept in FILE.npz.samples:
the same command goes on with it, also after Ctrl-C.

With --light, what is learned is light that has walked far through the guide, as a function of the press. It
carries nearly all noise of Monte Carlo; pictures that take it (`twin corpus plan --traced`) have none.

examples:
  twin emulate tsis --minutes 30 --out emulators/tsis.npz
  twin emulate tsis --light --out emulators/tsis.light.npz
  twin emulate my-sensor.toml --samples 400 --workers 2 --out mine.npz
"""

_SCHEMA = """\
Print the JSON schema of a design file. An editor that knows it completes and checks designs.

example:
  twin schema > schema.json     and in the design's first line:  #:schema ./schema.json
"""


class Parser(argparse.ArgumentParser):
    """An argument parser that answers a mistake with one line and exit status 2."""

    def error(self, message: str) -> NoReturn:
        self.exit(2, f"{self.prog}: {_plain(message)}\n")


def parse(argv: list[str] | None) -> argparse.Namespace:
    """Return the arguments, or leave with status 2 and one line on stderr."""
    return _parser().parse_args(sys.argv[1:] if argv is None else argv)


def _parser() -> Parser:
    # which take their readers from here
    from twin import corpus_arguments, estimate_arguments, explore_cli, study_arguments

    parser = Parser(
        prog="twin",
        description="Digital twin of the tactile sensation imaging system: from press to picture.",
        epilog="Start with: twin demo",
        allow_abbrev=False,
    )
    parser.add_argument("--version", action="store_true", help="print the version and stop")
    verbs = parser.add_subparsers(dest="verb", metavar="VERB", title="verbs")

    demo = add_verb(verbs, "demo", "the main job on the shipped design and an inclusion of the paper", _DEMO)
    _add_run_flags(demo, out="tsis-demo")

    simulate = add_verb(verbs, "simulate", "one picture, or one per press level", _SIMULATE)
    simulate.add_argument(
        "design", metavar="DESIGN", nargs="?", default="tsis", help="name or TOML file (default tsis)"
    )
    _add_inclusion_flags(simulate)
    _add_pose_flags(simulate, "multipoles", "emulator")
    simulate.add_argument(
        "--emulator",
        metavar="FILE.npz",
        help="for --mechanics emulator (default emulators/DESIGN.npz, else the one that ships)",
    )
    simulate.add_argument(
        "--traced",
        metavar="FILE.npz",
        help="traced light without noise, of `twin emulate DESIGN --light`; tsis ships",
    )
    press = simulate.add_mutually_exclusive_group()
    _add_depths(press)
    press.add_argument(
        "--force", type=number(above=0.0), nargs="+", metavar="N", help="press forces instead of depths"
    )
    _add_run_flags(simulate)

    check = add_verb(verbs, "check", "where the light goes, exposure, signal, mistakes: with advice", _CHECK)
    check.add_argument(
        "design", metavar="DESIGN", nargs="?", default="tsis", help="name or TOML file (default tsis)"
    )
    _add_mechanics_flag(check, default="linear")
    check.add_argument(
        "--indentation",
        type=number(above=0.0),
        metavar="MM",
        help="depth of the press (default: the design's deepest)",
    )
    check.add_argument("--json", action="store_true", help="print JSON instead of tables")
    check.add_argument("--out", metavar="DIR", help="new folder for check.json and check.png")
    _add_light_flags(check)

    export = add_verb(verbs, "export", "a press as files for ParaView, CalculiX, Mitsuba", _EXPORT)
    export.add_argument(
        "design", metavar="DESIGN", nargs="?", default="tsis", help="name or TOML file (default tsis)"
    )
    _add_inclusion_flags(export)
    _add_pose_flags(export)
    _add_depths(export)
    kind = export.add_mutually_exclusive_group()
    kind.add_argument("--vtu", metavar="FILE.vtu", help="volume results of one press, for ParaView")
    kind.add_argument("--ccx", metavar="DIR", help="input decks for CalculiX, one step per press depth")
    kind.add_argument("--mitsuba", metavar="DIR", help="one press as a scene for the stock mitsuba package")
    kind.add_argument("--stl", metavar="DIR", help="one press as STL meshes")
    kind.add_argument("--ply", metavar="DIR", help="one press as PLY meshes with fields")
    _add_quality_flag(export)

    emulate = add_verb(verbs, "emulate", "an emulator of a sensor's contact field", _EMULATE)
    emulate.add_argument("design", metavar="DESIGN", nargs="?", default="tsis", help="name or TOML file")
    _add_mechanics_flag(emulate)
    emulate.add_argument(
        "--minutes", type=number(above=0.0), metavar="MIN", help="time to solve for (default 30)"
    )
    emulate.add_argument("--samples", type=whole, metavar="N", help="stop at so many samples")
    emulate.add_argument(
        "--light", action="store_true", help="learn the traced light of presses instead (40 min on 2 cores)"
    )
    emulate.add_argument(
        "--emulator",
        metavar="FILE.npz",
        help="with --light: of the mechanics (default emulators/DESIGN.npz, else the one that ships)",
    )
    emulate.add_argument("--workers", type=whole, metavar="N", help="processes (default: all cores)")
    emulate.add_argument("--seed", type=whole, default=0, metavar="N", help="of the samples (default 0)")
    emulate.add_argument("--out", metavar="FILE.npz", help="the file to write")

    corpus_arguments.add(verbs)
    study_arguments.add(verbs)
    estimate_arguments.add(verbs)
    explore_cli.add(verbs)
    add_verb(verbs, "schema", "the JSON schema of a design file", _SCHEMA)
    return parser


def add_verb(verbs: Any, name: str, summary: str, text: str) -> Parser:
    """Add a verb, or an action of one, with its --help."""
    verb: Parser = verbs.add_parser(
        name,
        help=summary,
        description=text,
        formatter_class=argparse.RawDescriptionHelpFormatter,
        allow_abbrev=False,
    )
    return verb


def _add_inclusion_flags(parser: Parser) -> None:
    above_zero = number(above=0.0)
    parser.add_argument("--size", type=above_zero, metavar="MM", help="diameter of the inclusion")
    parser.add_argument("--depth", type=above_zero, metavar="MM", help="depth of the inclusion's top")
    parser.add_argument("--modulus", type=above_zero, metavar="KPA", help="its Young's modulus")
    _add_pair(parser, "--offset", "inclusion minus probe centre, mm (default 0 0)")
    parser.add_argument(
        "--stretch",
        type=above_zero,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="ellipsoid: diameters along x, y, z over --size (default 1 1 1)",
    )
    parser.add_argument("--no-inclusion", action="store_true", help="homogeneous tissue")


def _add_pose_flags(parser: Parser, *more: str) -> None:
    _add_mechanics_flag(parser, *more)
    _add_pair(parser, "--tilt", "turn of the sensor about x, then y, degrees (default: the design's)")
    _add_pair(parser, "--position", "sensor's centre minus the specimen's, mm (default: the design's)")


def _add_mechanics_flag(parser: Parser, *more: str, default: str | None = None) -> None:
    words = " or ".join(MECHANICS) + " strain" + "".join(f", or {word}" for word in more)
    parser.add_argument(
        "--mechanics",
        type=choice(*MECHANICS, *more),
        default=default,
        metavar="M",
        help=f"{words} (default: {default or 'the design' + chr(39) + 's'})",
    )


def _add_depths(place: Any) -> None:
    place.add_argument(
        "--indentation",
        type=number(above=0.0),
        nargs="+",
        metavar="MM",
        help="press depths (default: the design's)",
    )


def _add_pair(parser: Parser, flag: str, text: str) -> None:
    parser.add_argument(flag, type=number(), nargs=2, metavar=("X", "Y"), help=text)


def _add_quality_flag(parser: Parser, more: str = "") -> None:
    text = ", ".join(QUALITIES) + f" (default standard{more})"
    parser.add_argument("--quality", type=choice(*QUALITIES), default="standard", metavar="Q", help=text)


def _add_run_flags(parser: Parser, out: str | None = None) -> None:
    default = "" if out is None else f" (default {out})"
    parser.add_argument("--out", metavar="DIR", default=out, help="new folder for the results" + default)
    _add_quality_flag(parser, "; reference follows every ray: many minutes")
    parser.add_argument(
        "--noise",
        type=number(least=LEAST_NOISE),
        metavar="PERCENT",
        help="compute light until its noise (rms of a pixel, of the mean) is there (default: the quality's)",
    )
    _add_light_flags(parser)


def _add_light_flags(parser: Parser) -> None:
    parser.add_argument(
        "--seed", type=whole, default=0, metavar="N", help="of all random numbers (default 0)"
    )
    add_device(parser, "what the light is computed on")


def add_device(parser: Parser, what: str) -> None:
    """Add the flag for what is computed on a GPU where there is one."""
    parser.add_argument(
        "--device",
        type=choice(*DEVICES),
        default="auto",
        metavar="D",
        help=f"{what}: {', '.join(DEVICES)} (default auto)",
    )


def number(*, above: float = -math.inf, least: float = -math.inf) -> Callable[[str], float]:
    """Return a reader of finite numbers, for argparse."""
    allowed = "a finite number" if above == -math.inf else f"a finite number > {above:g}"
    allowed += "" if least == -math.inf else f" >= {least:g}"

    def read(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not (above < value < math.inf and value >= least):
            raise argparse.ArgumentTypeError(f"received {shown(text)}; allowed {allowed}")
        return value

    return read


def whole(text: str) -> int:
    """Read an integer from 0 to 2**63 - 1, for argparse."""
    if not re.fullmatch(r"[0-9]{1,19}", text) or int(text) >= 2**63:
        raise argparse.ArgumentTypeError(f"received {shown(text)}; allowed an integer from 0 to 2**63 - 1")
    return int(text)


def choice(*choices: str) -> Callable[[str], str]:
    """Return a reader of one of several words, for argparse."""

    def read(text: str) -> str:
        if text not in choices:
            words = ", ".join(choices)
            raise argparse.ArgumentTypeError(f"received {shown(text)}; allowed one of {words}")
        return text

    return read


_REWORDED = (
    (r"argument (\S+): (received .*)", r"\1: \2"),
    (r"argument (\S+): invalid choice: (.*) \(choose from (.*)\)", r"\1: received \2; allowed one of \3"),
    (r"argument (\S+): expected one argument", r"\1: received no value; allowed one"),
    (r"argument (\S+): expected at least one argument", r"\1: received no value; allowed one or more"),
    (r"argument (\S+): expected (\d+) arguments", r"\1: received another number of values; allowed \2"),
    (
        r"argument (\S+): not allowed with argument (\S+)",
        r"\1: received together with \2; allowed one of them",
    ),
    (r"the following arguments are required: (.*)", r"\1: received nothing; allowed what --help lists"),
    (r"unrecognized arguments: (.*)", r"received what it does not know: \1; allowed what --help lists"),
)


# A word where press levels belong is most likely the design, given too late.
_LATE_DESIGN = r"(--indentation|--force): received '([^\d'][^']*)';.*"


def _plain(message: str) -> str:
    """Return one of argparse's messages in this program's words."""
    message = " ".join(message.split())
    for pattern, words in _REWORDED:
        found = re.fullmatch(pattern, message)
        if found:
            message = found.expand(words)
            break
    late = re.fullmatch(_LATE_DESIGN, message)
    if late and late[2].lower() not in ("nan", "inf") and not late[2].startswith(("-", "+", ".")):
        message += f" (DESIGN goes first: twin simulate {late[2]} {late[1]} ...)"
    return message
