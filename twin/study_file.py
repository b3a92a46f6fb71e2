"""Study files: which ship, and reading one as text and as TOML, whatever its kind."""

from __future__ import annotations

import re
import tomllib
from importlib.resources import files
from pathlib import Path
from typing import Any

from twin.complaint import DesignError, shown
from twin.texts import read_text

MAX_TEXT = 1_000_000
"""Longest study file, characters."""


def shipped_studies(kind: str = "corpus") -> list[str]:
    """Return the names of the studies of a kind that come with the package."""
    found = [entry for entry in files("assets").joinpath("studies").iterdir() if entry.name.endswith(".toml")]
    line = re.compile(rf'^kind\s*=\s*"{kind}"', re.MULTILINE)
    of_kind = (entry.name for entry in found if line.search(entry.read_text(encoding="utf-8")))
    return sorted(name.removesuffix(".toml") for name in of_kind)


def read_study(name: str, kind: str) -> tuple[str, Path]:
    """Return the text of a shipped study of any kind, or of a file, and the folder that it lies in.

    Raises
    ------
    DesignError
        One line, with the shipped studies of this kind.
    """
    place = Path(name)
    if name in (*shipped_studies("corpus"), *shipped_studies("layout")):
        place = Path(str(files("assets").joinpath("studies", f"{name}.toml")))
    allowed = f"a shipped study ({', '.join(shipped_studies(kind))}) or a TOML file that can be read"
    try:
        if not name or not place.is_file():
            raise DesignError("STUDY", shown(name), allowed)
        return read_text(place, MAX_TEXT, name), place.parent
    except DesignError:
        raise
    except (OSError, ValueError):
        raise DesignError("STUDY", shown(name), allowed) from None


def study_tables(text: str, source: str) -> dict[str, Any]:
    """Return the tables of a TOML text; ``source`` names it in the error."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        message, _, place = str(error).rpartition(" (at ")
        received = f"text that is not TOML ({message})"
        raise DesignError(place.rstrip(")") or "the file", received, "TOML", source=source) from None
    except RecursionError:
        raise DesignError("the file", "tables nested too deep", "a few levels", source=source) from None
    except ValueError:  # Python reads no integer of thousands of digits
        raise DesignError("the file", "a number that is too long", "numbers", source=source) from None
