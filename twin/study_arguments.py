"""What the verbs that study a finished corpus accept: ``twin map`` and ``twin replicate``."""

from __future__ import annotations

from typing import Any

from twin.arguments import add_verb, number, whole

_MAP = """\
Validate the mapping from the contact surface to the picture on one corpus or several: the paper's three
regressions (maximum, total, area) at every press level, tared and raw, with intervals; whether a line is
adequate, where it holds, and how it moves with press level and threshold. Several corpora (another LED
coupling, another surface) are compared. With --out: report.html, map.csv, thresholds.csv, map.json.

examples:
  twin map corpora/paper --out mapping
  twin map corpora/paper --level 2
  twin map corpora/air corpora/embedded --out compared
"""

_REPLICATE = """\
The source paper from one command: its Tables I to III, Figs. 3(c), 4 and 5, both protocols, constant
predictors and earlier methods, beside what it printed. Without --corpus the paper's set is simulated first,
into OUT/corpus (again continues where it was cut off): about half an hour on two cores, by the emulator that
ships; about an hour with --solve, by finite elements; --quick is a smaller one at preview quality. Writes
report.html, estimates.csv, errors.csv and replicate.json into OUT.

examples:
  twin replicate --out replica
  twin replicate --solve --out replica
  twin replicate --quick --out replica
  twin replicate --corpus corpora/paper --out replica
"""


def add(verbs: Any) -> None:
    """Add both verbs to the parser of `twin.arguments`."""
    mapping = add_verb(verbs, "map", "the surface-to-picture mapping of a corpus, validated", _MAP)
    mapping.add_argument(
        "corpora", metavar="CORPUS", nargs="+", help="folder of a corpus; several are compared"
    )
    mapping.add_argument("--out", metavar="DIR", help="new folder for the report")
    mapping.add_argument("--level", type=number(above=0.0), metavar="MM", help="only this press level")
    mapping.add_argument(
        "--raw", action="store_true", help="figures and verdict of raw scalars, not tared ones"
    )

    replicate = add_verb(
        verbs, "replicate", "the source paper, table by table and figure by figure", _REPLICATE
    )
    replicate.add_argument("--out", metavar="DIR", help="new folder for the report, and for the corpus")
    replicate.add_argument("--corpus", metavar="DIR", help="a finished corpus with the nine phantoms")
    replicate.add_argument(
        "--quick", action="store_true", help="fewer samples at preview quality, one press level"
    )
    replicate.add_argument(
        "--seed", type=whole, default=0, metavar="N", help="of all random numbers (default 0)"
    )
    replicate.add_argument(
        "--emulator", metavar="FILE.npz", help="simulate the corpus by this emulator (default tsis)"
    )
    replicate.add_argument("--solve", action="store_true", help="simulate the corpus by finite elements")
    replicate.add_argument(
        "--workers", type=whole, metavar="N", help="processes to simulate with (default: all cores)"
    )
