"""What ``twin train``, ``calibrate``, ``assess`` and ``estimate`` do."""

from __future__ import annotations

import argparse
from pathlib import Path

from twin.complaint import DesignError, shown


def run(arguments: argparse.Namespace) -> int:
    """Run the verb of a parsed command line and return the exit status."""
    verbs = {"train": _train, "calibrate": _calibrate, "assess": _assess, "estimate": _estimate}
    return verbs[arguments.verb](arguments)


def _train(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the model to write, such as models/tsis")
    levels = arguments.levels
    if levels is not None and len(set(levels)) < len(levels):
        raise DesignError("--levels", shown(levels), "each press level once")
    for flag, value, least in (("--samples", arguments.samples, 30), ("--imagined", arguments.imagined, 100)):
        if value is not None and value < least:
            raise DesignError(flag, str(value), f"an integer >= {least}")
    from twin.reporting import Reporter
    from twin.train import train

    with Reporter() as report:
        written = train(
            arguments.corpus,
            arguments.out.removesuffix(".safetensors"),
            levels=levels,
            minutes=arguments.minutes,
            samples=arguments.samples,
            imagined=arguments.imagined,
            seed=arguments.seed,
            lean=arguments.lean,
            device=arguments.device,
            progress=report,
        )
    print(written)
    return 0


def _calibrate(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the model to write, such as models/tsis-solved")
    for flag, value in (("--samples", arguments.samples), ("--workers", arguments.workers)):
        if value == 0:
            raise DesignError(flag, "0", "an integer >= 1")
    from twin.calibrate import calibrate
    from twin.reporting import Reporter

    with Reporter() as report:
        written = calibrate(
            arguments.model,
            arguments.corpus,
            arguments.out.removesuffix(".safetensors"),
            samples=arguments.samples,
            workers=arguments.workers,
            lean=arguments.lean,
            progress=report,
        )
    print(written)
    return 0


def _assess(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "a folder for the assessment")
    for flag, value in (("--samples", arguments.samples), ("--workers", arguments.workers)):
        if value == 0:
            raise DesignError(flag, "0", "an integer >= 1")
    from twin import assessing, assessing_report, assessment, learning_curve
    from twin.reporting import Reporter

    if arguments.curve:
        for flag, given in (
            ("--samples", arguments.samples),
            ("--single", arguments.single),
            ("--averaged", arguments.averaged),
            ("--quick", arguments.quick),
            ("--as-trained", arguments.as_trained),
            ("--workers", arguments.workers),
            ("--seed", arguments.seed or None),
        ):
            if given is not None and given is not False:
                raise DesignError(
                    flag,
                    "it with --curve",
                    "none of --samples, --single, --averaged, --quick, --as-trained, --workers, --seed",
                )
        with Reporter() as report:
            told = learning_curve.curve(arguments.model, arguments.corpus, arguments.out, progress=report)
        print(learning_curve.words(told))
        print(f"look at: {Path(arguments.out) / assessing_report.REPORT}")
        return 0
    with Reporter() as report:
        record = assessing.assess(
            arguments.model,
            arguments.corpus,
            arguments.out,
            samples=arguments.samples,
            single=arguments.single,
            averaged=arguments.averaged,
            as_trained=arguments.as_trained,
            rendered=not arguments.quick,
            workers=arguments.workers,
            seed=arguments.seed,
            progress=report,
        )
    print(assessment.words(record))
    print(f"look at: {Path(arguments.out) / assessing_report.REPORT}")
    return 0


def _estimate(arguments: argparse.Namespace) -> int:
    for flag, value, least in (("--frames", arguments.exposures, 1), ("--samples", arguments.samples, 100)):
        if value < least:
            raise DesignError(flag, str(value), f"an integer >= {least}")
    from twin import estimate
    from twin.reporting import Reporter

    with Reporter() as report:
        found = estimate.estimate(
            arguments.model,
            arguments.frames,
            references=arguments.reference,
            exposures=arguments.exposures,
            flip=arguments.flip,
            out=arguments.out,
            samples=arguments.samples,
            seed=arguments.seed,
            rendered=not arguments.quick,
            progress=report,
        )
    print(estimate.told(found))
    if arguments.out is not None:
        print(f"look at: {Path(arguments.out) / estimate.PICTURE}")
    return 0
