"""What ``twin map`` and ``twin replicate`` do."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from twin.complaint import DesignError

if TYPE_CHECKING:
    pass


def run(arguments: argparse.Namespace) -> int:
    """Run the verb of a parsed command line and return the exit status."""
    return {"map": _map, "replicate": _replicate}[arguments.verb](arguments)


def _map(arguments: argparse.Namespace) -> int:
    if len({Path(path).resolve() for path in arguments.corpora}) < len(arguments.corpora):
        raise DesignError("corpus", "the same folder twice", "different ones")
    from twin import mapping_report
    from twin.mapping_text import told
    from twin.reporting import Reporter

    with Reporter() as report:
        found = mapping_report.study(arguments.corpora, arguments.level, arguments.raw, report)
        if arguments.out is not None:
            mapping_report.write(found, arguments.out)
    print(told(found))
    if arguments.out is not None:
        print(f"look at: {Path(arguments.out) / 'report.html'}")
    return 0


def _replicate(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the folder to make for the report")
    for flag in ("quick", "emulator", "solve", "workers"):
        if arguments.corpus is not None and getattr(arguments, flag):
            raise DesignError(f"--{flag}", "it with --corpus", "one of them: that corpus is finished")
    if arguments.solve and arguments.emulator is not None:
        raise DesignError("--solve", "it with --emulator", "one of them")
    if arguments.workers == 0:
        raise DesignError("--workers", "0", "an integer > 0")
    from twin import replicate
    from twin.reporting import Reporter
    from twin.run import Stopped

    try:
        with Reporter() as report:
            found = replicate.replicate(
                arguments.out,
                corpus=arguments.corpus,
                quick=arguments.quick,
                seed=arguments.seed,
                emulator=arguments.emulator,
                solve=arguments.solve,
                workers=arguments.workers,
                progress=report,
            )
    except Stopped as error:
        print(f"twin replicate: {' '.join(str(error).split())}", file=sys.stderr)
        return 1
    print(found)
    print(f"look at: {Path(arguments.out) / 'report.html'}")
    return 0
