"""The rules of the house that a reader can rely on: who imports whom, and how long a file may be."""

import ast
import re
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ROOMS = ("assets", "estimation", "fem", "scenes", "twin")

# What each room may import besides the standard library and itself. Only twin knows the others.
ALLOWED = {
    "assets": set(),
    "estimation": {"numpy", "scipy", "torch", "zuko"},
    "fem": {"numpy", "pydantic", "pyvista", "scipy", "skfem", "threadpoolctl"},
    "scenes": {"drjit", "mitsuba", "numpy", "OpenEXR", "PIL", "pydantic"}
    | {"pyvista", "scipy", "threadpoolctl", "trimesh"},
    "twin": {"assets", "estimation", "fem", "scenes"}
    | {"dask", "distributed", "drjit", "matplotlib", "mitsuba", "mpl_toolkits", "numpy", "OpenEXR"}
    | {
        "optuna",
        "pandas",
        "PIL",
        "psutil",
        "pyarrow",
        "pydantic",
        "pydantic_core",
        "pyvista",
        "rich",
        "safetensors",
        "scipy",
    }
    | {"skfem", "threadpoolctl", "torch", "trimesh"},
}
MAX_LINES = 400


def sources(*folders: str) -> list[Path]:
    """Python files of these folders."""
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def imported(tree: ast.AST) -> Iterator[str]:
    """Top-level names of everything that a file imports, at its top or inside a function."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name.split(".")[0] for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.level == 0:
            yield (node.module or "").split(".")[0]
        elif isinstance(node, ast.Call) and ast.unparse(node.func).endswith(("import_module", "__import__")):
            name = node.args[0] if node.args else None
            if isinstance(name, ast.Constant) and isinstance(name.value, str):
                yield name.value.split(".")[0]


def foreign(room: str, source: str) -> set[str]:
    """Names that a file of `room` with this source must not import."""
    return set(imported(ast.parse(source))) - ALLOWED[room] - {room} - set(sys.stdlib_module_names)


@pytest.mark.parametrize("room", ROOMS)
def test_rooms_import_what_they_may(room: str) -> None:
    files = sources(room)
    assert files, f"{room} has no Python file: has it moved?"
    wrong = {
        str(path.relative_to(ROOT)): sorted(names)
        for path in files
        if (names := foreign(room, path.read_text(encoding="utf-8")))
    }
    assert not wrong, f"{room} may import {sorted(ALLOWED[room])}, but: {wrong}"


def test_the_rule_itself() -> None:
    """A sibling is caught wherever it hides, and nobody but twin's own files may import twin."""
    for room in ("fem", "scenes", "estimation"):
        assert not {"twin", "fem", "scenes", "estimation"} & ALLOWED[room]
    assert foreign("fem", "def f():\n    from scenes.bsdf import law") == {"scenes"}
    assert foreign("scenes", "import importlib\nimportlib.import_module('twin.design')") == {"twin"}
    assert foreign("estimation", "import numpy as np, fem.press") == {"fem"}
    assert foreign("fem", "from .mesh import grid\nfrom fem import press\nimport json, skfem") == set()


def test_files_are_short() -> None:
    """One idea per file: about 200 lines, 400 at most."""
    lengths = {
        str(path.relative_to(ROOT)): len(path.read_text(encoding="utf-8").splitlines())
        for path in sources(*ROOMS, "tests")
    }
    assert not {name: n for name, n in lengths.items() if n > MAX_LINES}


def test_every_cited_key_has_its_source() -> None:
    """`references.bib` holds each key once, sorted, and every key that the code or a design cites."""
    keys = [
        line.split("{")[1].rstrip(",\n")
        for line in (ROOT / "assets" / "references.bib").read_text(encoding="utf-8").splitlines()
        if line.startswith("@")
    ]
    assert len(keys) == len(set(keys))
    assert keys == sorted(keys)
    cited = {
        key
        for path in (*sources(*ROOMS), *(ROOT / "assets").rglob("*.toml"))
        for key in re.findall(r"(?:key|\[)[\s]*([a-z]+[12]\d{3})\b", path.read_text(encoding="utf-8"))
    }
    assert cited
    assert cited <= set(keys)
