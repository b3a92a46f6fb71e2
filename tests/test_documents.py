"""Commands that the documents tell readers to run name tests that there are."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
DOCUMENTS = sorted(path for path in ROOT.glob("*.md") if path.name != "CHANGELOG.md")
COMMAND = re.compile(r"`[^`]*\bpytest [^`]*`")
WORD = re.compile(r"[a-z_]{3,}")


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: path.name)
def test_named_tests_exist(document: Path) -> None:
    """Every file, and every word that `-k` selects by stands in it."""
    for command in COMMAND.findall(document.read_text(encoding="utf-8")):
        command = " ".join(command.split())
        paths = [ROOT / name for name in re.findall(r"tests/\S+?\.py", command)]
        for path in paths:
            assert path.is_file(), command
        source = "".join(path.read_text(encoding="utf-8") for path in paths).lower()
        chosen = re.search(r'-k ("[^"]+"|\w+)', command)
        words = WORD.findall(chosen.group(1).lower()) if chosen else []
        for word in {*words} - {"and", "not"}:
            assert not source or word in source, command


def test_there_is_something_to_check() -> None:
    accuracy = (ROOT / "ACCURACY.md").read_text(encoding="utf-8")
    assert len(COMMAND.findall(accuracy)) > 50
