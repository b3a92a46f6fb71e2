"""What the tests of corpora share: a small sensor, its study, and a finished corpus of a few samples."""

from __future__ import annotations

import json
import tomllib
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from twin import store

STUDY = """\
kind = "corpus"
name = "tiny"
design = "{design}"
quality = "preview"
mechanics = "{mechanics}"
{emulator}
indentation_mm = {levels}
[[samples]]
name = "tiny"
sampler = "uniform"
count = {count}
[samples.inclusion]
size_mm = [6, 12]
depth_mm = [4, 6]
modulus_kPa = [40, 120]
"""


@cache
def _tables(leds: int, rows: int) -> dict[str, Any]:
    design = tomllib.loads(files("assets").joinpath("designs", "tsis.toml").read_text(encoding="utf-8"))
    design["leds"] = design["leds"][:leds]
    camera = design["camera"]
    camera |= {"rows": rows, "columns": rows * 4 // 3, "pixel_um": [8.4 * 768 / (rows * 4 // 3), 9.8 * 492 / rows]}
    return design


def _toml(tables: dict[str, Any]) -> str:
    """A design's tables as TOML: numbers, texts and lists of numbers are written as JSON writes them."""
    lines = [f"{key} = {json.dumps(value)}" for key, value in tables.items() if not _nested(value)]
    for key, value in tables.items():
        for one in value if _nested(value) and isinstance(value, list) else [value] if _nested(value) else []:
            lines.append(f"[[{key}]]" if isinstance(value, list) else f"[{key}]")
            for name, inner in one.items():
                if _nested(inner):
                    for layer in inner:
                        lines.append(f"[[{key}.{name}]]")
                        lines += [f"{field} = {json.dumps(number)}" for field, number in layer.items()]
                else:
                    lines.append(f"{name} = {json.dumps(inner)}")
    return "\n".join(lines) + "\n"


def _nested(value: Any) -> bool:
    return isinstance(value, dict) or (isinstance(value, list) and bool(value) and isinstance(value[0], dict))


def freeze_tiny(
    folder: Path,
    count: int = 3,
    levels: tuple[float, ...] = (2.0,),
    *,
    leds: int = 1,
    rows: int = 48,
    emulator: Path | None = None,
    more: str = "",
) -> Path:
    """Freeze a corpus of a small camera (rows x 4/3 rows) and few LEDs; return its folder."""
    from twin.plan import freeze

    folder.mkdir(parents=True, exist_ok=True)
    tables = _tables(leds, rows)
    if emulator is None:
        tables = {**tables, "mechanics": "linear"}
    (folder / "small.toml").write_text(_toml(tables), encoding="utf-8")
    text = STUDY.format(
        design="small.toml",
        mechanics="emulator" if emulator else "linear",
        emulator=f'emulator = "{emulator}"' if emulator else "",
        levels=list(levels),
        count=count,
    )
    (folder / "study.toml").write_text(text + more, encoding="utf-8")
    freeze(folder / "study.toml", folder / "corpus")
    return folder / "corpus"


def hashes(corpus: Path) -> dict[str, str]:
    """SHA-256 of every picture of a corpus, by its path from the corpus."""
    return {
        path.relative_to(corpus).as_posix(): store.sha256(path)
        for folder in ("samples", "references")
        for path in sorted((corpus / folder).rglob("*.*"))
        if path.is_file() and path.name != store.SAMPLE
    }
