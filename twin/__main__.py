"""``twin`` and ``python -m twin``: listens for Ctrl-C first, and loads the command line then."""

from __future__ import annotations

import os
import sys

from twin import interrupt


def main() -> int:
    """Run the command line and return its exit status."""
    # A spawned process looks for modules in the current folder first, before it hears where this one looks: a
    # pickle.py in a folder of somebody else's would run.
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        with interrupt.guarded():
            from twin import cli

            return cli.main()
    except KeyboardInterrupt:  # before or after the command line's own care
        print("twin: interrupted; nothing was written", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
