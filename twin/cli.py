"""The command line: ``twin demo``, ``simulate``, ``check``, ``export``, ``emulate``, ``corpus``,
``map``, ``replicate``, ``train``, ``estimate``, ``explore``, ``schema``.

Exit status 0: done; 1: the machine failed (a full disk); 2: bad input, one line on stderr; 130: interrupted.
Nothing slow is imported until the input has been checked.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import sys
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path

from pydantic import TypeAdapter, ValidationError

import fem
from scenes.backend import BackendError
from scenes.sensor import NotModelled
from twin import interrupt
from twin.arguments import parse
from twin.complaint import DesignError, from_validation
from twin.design import Design, design_schema, load_design
from twin.frame import fill, holds_frames, versions
from twin.simulation import Options, check, simulate
from twin.stage import staged

DEMO_INCLUSION = fem.Inclusion(size=10.0, depth=5.0, modulus=100.0)
"""Table I, number 9: clear in the picture, in the middle of the paper's range."""

# Share of a run's time before its files are written: it only shapes the estimate of the time left.
_SIMULATION_SHARE = 0.9

# The dotted names of values that were given as flags.
_FLAGS = {
    "inclusion.size": "--size",
    "inclusion.depth": "--depth",
    "inclusion.modulus": "--modulus",
    "inclusion.offset": "--offset",
    "inclusion.stretch": "--stretch",
    "press.indentation_mm": "--indentation",
    "press.force_N": "--force",
    "press.tilt_deg": "--tilt",
    "press.position_mm": "--position",
    "mechanics": "--mechanics",
    "emulator": "--emulator",
    "vtu": "--vtu",
    "ccx": "--ccx",
    "mitsuba": "--mitsuba",
    "stl": "--stl",
    "ply": "--ply",
    "out": "--out",
    "device": "--device",
    "count": "--count",
    "corpus": "CORPUS",
}


# Verbs that go on, when they are called again, where they were cut off.
_RESUMED = ("assess", "calibrate", "corpus", "emulate", "explore", "replicate", "train")

# Rooms whose own errors are one line for the user.
_ROOMS = ("fem.", "scenes.", "estimation.", "twin.")


def main(argv: list[str] | None = None) -> int:
    """Run the command line and return its exit status."""
    try:
        arguments = parse(argv)
    except SystemExit as stop:  # argparse leaves this way, for --help too
        return int(stop.code or 0)
    name = " ".join(["twin", *filter(None, (arguments.verb, getattr(arguments, "action", None)))])
    try:
        with interrupt.guarded():
            try:
                return _run(arguments)
            except Exception:  # an extension may turn the interrupt that it met into an error of its own
                interrupt.stop_if_asked()
                raise
    except (DesignError, fem.NotModelled, fem.NotConverged, NotModelled, BackendError) as error:
        return _fail(name, _with_flags(str(error)), 2)
    except KeyboardInterrupt:
        return _fail(name, f"interrupted; {_left_by(arguments.verb)}", 130)
    except ChildProcessError as error:
        return _fail(name, f"{error}; {_left_by(arguments.verb)}", 1)
    except BrokenPipeError:  # `twin schema | head`
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115 (Python flushes it on its way out)
        return 0
    except OSError as error:
        return _fail(name, f"nothing was written: {error}", 1)
    except MemoryError:
        return _fail(name, "nothing was written: not enough memory", 1)
    except ValueError as error:
        if not type(error).__module__.startswith(_ROOMS):  # a mistake of this program: show where
            raise
        return _fail(name, _with_flags(str(error)), 1 if isinstance(error.__cause__, OSError) else 2)


def _left_by(verb: str) -> str:
    return "what is finished stays" if verb in _RESUMED else "nothing was written"


def _run(arguments: argparse.Namespace) -> int:
    if arguments.version:
        print(f"twin {versions()['tsis-twin']}")
    elif arguments.verb == "schema":
        print(json.dumps(design_schema(), indent=2, ensure_ascii=False), flush=True)
    elif arguments.verb == "demo":
        design = load_design("tsis")
        _simulate(arguments, design, DEMO_INCLUSION, design.press.indentation_mm)
    elif arguments.verb == "simulate":
        options = Options()
        if arguments.emulator is not None and arguments.mechanics != "emulator":
            raise DesignError("--emulator", "it with other mechanics", "it with --mechanics emulator only")
        if arguments.mechanics in ("emulator", "multipoles"):
            options = Options(mechanics=arguments.mechanics, emulator=arguments.emulator)
            arguments.mechanics = None
        options["traced"] = arguments.traced
        design, inclusion = _pressed(arguments), _inclusion(arguments)
        levels = arguments.force or arguments.indentation or design.press.indentation_mm
        _simulate(arguments, design, inclusion, levels, bool(arguments.force), options)
    elif arguments.verb == "check":
        _check(arguments)
    elif arguments.verb == "export":
        _export(arguments, _pressed(arguments), _inclusion(arguments))
    elif arguments.verb == "emulate":
        _emulate(arguments)
    elif arguments.verb == "corpus":
        from twin import corpus_cli

        return corpus_cli.run(arguments)
    elif arguments.verb in ("map", "replicate"):
        from twin import study_cli

        return study_cli.run(arguments)
    elif arguments.verb in ("train", "calibrate", "assess", "estimate"):
        from twin import estimate_cli

        return estimate_cli.run(arguments)
    elif arguments.verb == "explore":
        from twin import explore_cli

        return explore_cli.run(arguments)
    else:
        parse(["--help"])
    return 0


def _simulate(
    arguments: argparse.Namespace,
    design: Design,
    inclusion: fem.Inclusion | None,
    levels: Sequence[float],
    by_force: bool = False,
    mechanics: Options | None = None,
) -> None:
    if arguments.out is None:
        raise DesignError("out", "nothing", "the folder to make for the results")
    check(design, inclusion, levels, by_force=by_force)
    from twin.reporting import Reporter, summarise

    with staged(arguments.out, holds_frames) as folder, Reporter() as report:
        options = Options(
            quality=arguments.quality,
            noise=arguments.noise,
            seed=arguments.seed,
            device=arguments.device,
            progress=lambda stage, done: report(stage, _SIMULATION_SHARE * done),
            **(mechanics or {}),
        )
        if by_force:
            frames = simulate(design, inclusion, force=levels, **options)
        else:
            frames = simulate(design, inclusion, levels, **options)
        report("files", 1.0)
        fill(frames, folder)
        interrupt.stop_if_asked()
    summarise(frames, Path(arguments.out))


def _check(arguments: argparse.Namespace) -> None:
    from twin import findings, prescription

    try:
        design = load_design(arguments.design).pressed(mechanics=arguments.mechanics)
    except DesignError as error:
        if not error.conflicts:
            raise
        # every value can be read, but some do not fit: that is what a doctor is for
        found = findings.from_conflicts(error.conflicts)
        prescription.show(None, found, str(arguments.design), as_json=arguments.json)
        if arguments.out is not None:
            with staged(arguments.out, prescription.holds_checkup) as place:
                prescription.fill(None, found, str(arguments.design), place)
        return
    from twin import doctor
    from twin.reporting import Reporter

    with ExitStack() as stack:
        folder: Path | None = None
        if arguments.out is not None:
            folder = stack.enter_context(staged(arguments.out, prescription.holds_checkup))
        report = stack.enter_context(Reporter())
        checkup = doctor.check_up(
            design,
            arguments.indentation,
            seed=arguments.seed,
            device=arguments.device,
            progress=lambda stage, done: report(stage, _SIMULATION_SHARE * done),
        )
        found = findings.findings(checkup)
        if folder is not None:
            report("files", 1.0)
            prescription.fill(checkup, found, design.name, folder)
        interrupt.stop_if_asked()
    prescription.show(checkup, found, design.name, as_json=arguments.json)
    if arguments.out is not None and not arguments.json:
        print(f"look at: {Path(arguments.out) / prescription.PICTURE}")


def _export(arguments: argparse.Namespace, design: Design, inclusion: fem.Inclusion | None) -> None:
    from twin import export, export_optics
    from twin.reporting import Reporter

    if arguments.ccx is not None:
        levels = arguments.indentation or design.press.indentation_mm
        folder = export.export_decks(design, inclusion, levels, arguments.ccx, quality=arguments.quality)
        print(f"folder: {folder} (README.txt says how to run the decks)")
        return
    levels = arguments.indentation or design.press.indentation_mm
    for kind in export_optics.KINDS:
        if (name := getattr(arguments, kind)) is not None:
            export_optics.check(design, inclusion, levels, kind)
            with Reporter() as report:
                place = export_optics.export(
                    design, inclusion, levels, kind, name, quality=arguments.quality, progress=report
                )
            print(f"folder: {place} (README.txt says what is in it)")
            return
    if arguments.vtu is None:
        flags = "--vtu, --ccx, --mitsuba, --stl, --ply"
        raise DesignError(flags, "nothing", "one of them, with what to write")
    name = arguments.vtu
    export.check(design, inclusion, levels, "vtu", name)
    with Reporter() as report:
        target = export.export(
            design, inclusion, levels, "vtu", name, quality=arguments.quality, progress=report
        )
    print(f"file: {target}")


def _emulate(arguments: argparse.Namespace) -> None:
    from twin.emulate import emulate, summary
    from twin.reporting import Reporter

    if arguments.out is None:
        raise DesignError("--out", "nothing", "the file to write")
    for flag in ("samples", "workers"):
        if getattr(arguments, flag) == 0:
            raise DesignError(f"--{flag}", "0", "an integer > 0")
    design = load_design(arguments.design).pressed(mechanics=arguments.mechanics)
    if arguments.light:
        _learn_light(arguments, design)
        return
    if arguments.emulator is not None:
        raise DesignError("--emulator", "it without --light", "it with --light only")
    with Reporter() as report:
        built = emulate(
            design,
            arguments.out,
            minutes=arguments.minutes,
            samples=arguments.samples,
            workers=arguments.workers,
            seed=arguments.seed,
            progress=lambda stage, done: report("solves" if stage[-1].isdigit() else stage, done),
        )
    print(summary(built, arguments.out))


def _learn_light(arguments: argparse.Namespace, design: Design) -> None:
    from twin import learn_light
    from twin.reporting import Reporter

    if arguments.minutes is not None:
        raise DesignError("--minutes", "it with --light", "--samples")
    with Reporter() as report:
        light = learn_light.learn_light(
            design,
            arguments.out,
            emulator=arguments.emulator,
            samples=arguments.samples or learn_light.PRESSES,
            workers=arguments.workers or os.cpu_count() or 1,
            seed=arguments.seed,
            progress=report,
        )
    print(learn_light.summary(light, arguments.out))


def _pressed(arguments: argparse.Namespace) -> Design:
    design = load_design(arguments.design)
    return design.pressed(
        mechanics=arguments.mechanics, tilt_deg=arguments.tilt, position_mm=arguments.position
    )


def _inclusion(arguments: argparse.Namespace) -> fem.Inclusion | None:
    given = {name: getattr(arguments, name) for name in ("size", "depth", "modulus")}
    for name, value in {**given, "offset": arguments.offset, "stretch": arguments.stretch}.items():
        if arguments.no_inclusion and value is not None:
            raise DesignError(f"--{name}", "it together with --no-inclusion", "one of them")
        if not arguments.no_inclusion and value is None and name in given:
            raise DesignError(f"--{name}", "nothing", "a finite number > 0 (or --no-inclusion)")
    if arguments.no_inclusion:
        return None
    values = {
        **given,
        "offset": tuple(arguments.offset or (0.0, 0.0)),
        "stretch": tuple(arguments.stretch or (1.0, 1.0, 1.0)),
    }
    try:
        return fem.Inclusion(**values)
    except ValidationError as error:
        found = from_validation(error, values, TypeAdapter(fem.Inclusion).json_schema())
        raise found.renamed(f"inclusion.{found.field}") from None


def _with_flags(line: str) -> str:
    field, colon, rest = line.partition(":")
    field = re.sub(r"\.\d+$", "", field)  # one of a flag's several values
    return _FLAGS.get(field, field) + colon + rest


def _fail(name: str, line: str, status: int) -> int:
    print(f"{name}: {' '.join(line.split())}", file=sys.stderr)
    return status
