"""`twin corpus verify` names whatever is wrong, and `run` makes again what it removed."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from corpora import hashes

from scenes import exr
from twin import index, store
from twin.cli import main
from twin.plan import load_plan
from twin.verify import verify


@pytest.fixture
def corpus(finished_corpus: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_corpus, tmp_path / "c"))


def found(corpus: Path) -> list[str]:
    report = verify(corpus, resimulate=0)
    assert report.good == (not report.problems)
    return report.lines


def flip(path: Path, at: float = 0.5) -> None:
    data = bytearray(path.read_bytes())
    data[int(at * len(data))] ^= 1
    path.write_bytes(data)


def test_a_whole_corpus_is_good_and_comes_out_again(corpus, capsys):
    before = {path: path.stat().st_mtime_ns for path in corpus.rglob("*")}
    assert main(["corpus", "verify", str(corpus), "--resimulate", "2", "--workers", "1"]) == 0
    (line,) = capsys.readouterr().out.splitlines()
    assert line == "all good: 4 of 4 samples, 20 files hashed, 2 samples made again bit for bit"
    assert {path: path.stat().st_mtime_ns for path in corpus.rglob("*")} == before


def shared(corpus: Path, suffix: str) -> Path:
    return sorted((corpus / "references").glob(f"*{suffix}"))[0]


def edit(corpus: Path, change: Callable[[list[dict]], object]) -> None:
    """Change index.parquet as somebody would who knows how."""
    table = pq.read_table(corpus / index.FILE)
    rows = table.to_pylist()
    change(rows)
    pq.write_table(pa.Table.from_pylist(rows, schema=table.schema), corpus / index.FILE)


def replace(path: Path, old: str, new: str) -> None:
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new))


SECOND = Path("samples/000/000002")

DAMAGE: dict[str, tuple[Callable[[Path], object], str]] = {
    "flipped byte of an EXR": (lambda c: flip(c / SECOND / "1.exr"), "000002/1.exr: has changed"),
    "flipped byte of a head": (lambda c: flip(c / SECOND / "1.exr", 0.01), "000002/1.exr: has changed"),
    "flipped byte of a PNG": (lambda c: flip(c / SECOND / "0.png"), "000002/0.png: has changed: its SHA-256"),
    "EXR cut short": (
        lambda c: os.truncate(c / SECOND / "1.exr", 5000),
        "1.exr: has changed: EXR file is cut",
    ),
    "EXR of no bytes": (
        lambda c: os.truncate(c / SECOND / "1.exr", 0),
        "000002/1.exr: has changed: not an EXR",
    ),
    "PNG cut short": (lambda c: os.truncate(c / SECOND / "1.png", 70), "000002/1.png: has changed"),
    "deleted picture": (lambda c: (c / SECOND / "1.png").unlink(), "000002/1.png: is missing"),
    "deleted note": (lambda c: (c / SECOND / "sample.json").unlink(), "sample.json: cannot be read"),
    "deleted sample": (lambda c: shutil.rmtree(c / SECOND), "000002: sample 2 is missing"),
    "link for a picture": (
        lambda c: ((c / SECOND / "1.png").unlink(), (c / SECOND / "1.png").symlink_to("0.png")),
        "000002/1.png: is not a plain file",
    ),
    "folder for a picture": (
        lambda c: ((c / SECOND / "1.png").unlink(), (c / SECOND / "1.png").mkdir()),
        "000002/1.png: is not a plain file",
    ),
    "pipe for a picture": (
        lambda c: ((c / SECOND / "1.png").unlink(), os.mkfifo(c / SECOND / "1.png")),
        "000002/1.png: is not a plain file",
    ),
    "link for a sample": (
        lambda c: (shutil.move(c / SECOND, c.parent / "s"), (c / SECOND).symlink_to(c.parent / "s")),
        "000002: sample 2 is a link",
    ),
    "strange file in a sample": (
        lambda c: (c / SECOND / "x\n.sh").touch(),
        r"000002/'x\n.sh': is not one of",
    ),
    "strange file": (lambda c: (c / "run.sh").touch(), "'run.sh': is not a corpus's"),
    "strange sample": (lambda c: (c / "samples/000/000004").mkdir(), "'000004': is no sample of the plan"),
    "sample in another folder": (
        lambda c: shutil.copytree(c / SECOND, c / "samples/001/000002"),
        "samples/001/'000002': is no sample",
    ),
    "strange folder": (
        lambda c: (c / "samples/\x1b[2J").mkdir(),
        r"samples/'\x1b[2J': is not a corpus's",
    ),
    "temporary folder": (lambda c: (c / "samples/000/.000001.5.part").mkdir(), "000001.5.part: is temporary"),
    "flipped byte of a reference": (lambda c: flip(shared(c, ".exr")), ".exr: has changed"),
    "deleted reference": (lambda c: shared(c, ".png").unlink(), ".png: is missing"),
    "strange reference": (
        lambda c: (c / "references/0123456789abcdef.exr").touch(),
        "references/'0123456789abcdef.exr': belongs to no sample",
    ),
    "edited row": (
        lambda c: edit(c, lambda rows: rows[5].update(fem_tared_max_mm=0.5)),
        "index.parquet: sample 2 level 1: fem_tared_max_mm is 0.5, its files say",
    ),
    "edited label": (
        lambda c: edit(c, lambda rows: rows[5].update(size_mm=rows[5]["size_mm"] + 1e-9)),
        "index.parquet: sample 2 level 1: size_mm is",
    ),
    "edited hash": (
        lambda c: edit(c, lambda rows: rows[5].update(sha256_exr="0" * 64)),
        "index.parquet: sample 2 level 1: sha256_exr is",
    ),
    "edited path": (
        lambda c: edit(c, lambda rows: rows[5].update(png="../../x.png")),
        "index.parquet: sample 2 level 1: png is '../../x.png'",
    ),
    "deleted row": (lambda c: edit(c, lambda rows: rows.pop(5)), "sample 2 level 1 is not in it"),
    "row twice": (
        lambda c: edit(c, lambda rows: rows.__setitem__(4, rows[5])),
        "index.parquet: sample 2 level 1 is there twice",
    ),
    "deleted index": (lambda c: (c / index.FILE).unlink(), "index.parquet: cannot be read (No such file"),
    "flipped byte of the index": (lambda c: flip(c / index.FILE, 0.99), "index.parquet: "),
    "flipped byte of the samples": (lambda c: flip(c / "samples.parquet"), "samples.parquet"),
    "flipped byte of the emulator": (lambda c: flip(c / "emulator.npz"), "emulator.npz"),
    "edited plan": (
        lambda c: (c / "plan.json").write_text(
            (c / "plan.json").read_text().replace('"description": ""', '"description": "x"')
        ),
        "index.parquet: cannot be read (of another plan.json)",
    ),
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damage_is_named(corpus, damage):
    spoil, wanted = DAMAGE[damage]
    spoil(corpus)
    lines = found(corpus)
    assert any(wanted in line for line in lines), lines
    assert all("\n" not in line for line in lines)
    if not wanted.startswith(("index", "samples.", "emulator", ".exr", ".png")):
        assert len(lines) == 1, lines  # and nothing else is blamed


def test_a_frame_whose_hashes_were_changed_too_is_found_by_its_plan(corpus):
    """Of another label, with sample.json and index to match."""
    place = corpus / SECOND / "0.exr"
    record = store.read_record(place)
    record["parameters"]["size_mm"] = 7.0
    write_again(corpus, place, exr.read_exr(place), record)
    (line,) = found(corpus)
    assert line.startswith("samples/000/000002/0.exr: record: parameters is {")


def write_again(corpus: Path, place: Path, planes: dict[str, np.ndarray], record: dict) -> None:
    """Write a frame of other pixels or text, its hash in sample.json, and the index."""
    half = {name for name in planes if not name.startswith("counts")}
    exr.write_exr(place, planes, {"record": store.dumped(record)}, half=half)
    note = json.loads((place.parent / store.SAMPLE).read_text())
    note["sha256"][place.name] = store.sha256(place)
    (place.parent / store.SAMPLE).write_text(json.dumps(note))
    index.build(corpus, load_plan(corpus), store.sha256(corpus / "plan.json"))


@pytest.mark.slow
def test_pixels_whose_hashes_were_changed_too_are_found_when_made_again(corpus, capsys):
    """One pixel, one part in a thousand, and everything else as if it had always been so."""
    place = corpus / SECOND / "0.exr"
    planes = exr.read_exr(place)
    planes["led.0"][10, 10] *= 1.002
    write_again(corpus, place, planes, store.read_record(place))
    assert not found(corpus)
    assert main(["corpus", "verify", str(corpus), "--resimulate", "4", "--workers", "1"]) == 1
    first, last = capsys.readouterr().out.splitlines()
    assert first == "samples/000/000002/0.exr: comes out otherwise"
    assert last.startswith("1 problems: 4 of 4 samples")


def test_repair_removes_what_is_damaged_and_run_makes_it_again(corpus, finished_corpus, capsys):
    flip(corpus / SECOND / "0.png")
    flip(shared(corpus, ".exr"))
    (corpus / "samples/000/000003/x").touch()
    os.truncate(corpus / index.FILE, 100)
    report = verify(corpus, resimulate=0, repair=True)
    assert report.removed == [0, 2, 3] and not report.good  # 0: the first that needs the reference
    assert len(list((corpus / "references").iterdir())) == 2
    lines = found(corpus)
    assert lines[0] == "samples: 3 of 4 are not made, 0 of them failed; the first is 0"
    assert all(line.startswith("references/") and line.endswith("is missing") for line in lines[1:])
    assert main(["corpus", "run", str(corpus), "--workers", "1"]) == 0
    assert not found(corpus)
    assert hashes(corpus) == hashes(finished_corpus)


def test_many_problems_are_counted(corpus):
    for number in range(150):
        (corpus / f"strange{number}").touch()
    lines = found(corpus)
    assert len(lines) == 101 and lines[-1] == "... and 50 more"
