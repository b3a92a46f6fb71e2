"""What ``twin corpus ACTION`` does: one function for each action, which `_ACTIONS` lists."""

from __future__ import annotations

import argparse
from collections.abc import Callable

from twin.complaint import DesignError


def run(arguments: argparse.Namespace) -> int:
    """Run the action of a parsed command line and return the exit status."""
    return _ACTIONS[arguments.action](arguments)


def _plan(arguments: argparse.Namespace) -> int:
    if arguments.out is None:
        raise DesignError("--out", "nothing", "the folder to make for the corpus")
    return 0


_ACTIONS: dict[str, Callable[[argparse.Namespace], int]] = {"plan": _plan}
