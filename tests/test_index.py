"""index.parquet: made from the frames alone, and always the same."""

from __future__ import annotations

import json
import math
import shutil
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from estimation import scalars
from scenes import exr
from twin import index, store
from twin.plan import Plan, load_plan


@pytest.fixture
def corpus(finished_corpus: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(finished_corpus, tmp_path / "c"))


@pytest.fixture
def plan(corpus: Path) -> Plan:
    return load_plan(corpus)


def sha(corpus: Path) -> str:
    return store.sha256(corpus / "plan.json")


def test_rows_are_what_the_pictures_show(corpus, plan):
    """Hashes of the files, scalars from the pixels anew, parameters of the plan; one row per frame."""
    table = index.read(corpus, plan, sha(corpus))
    rows = table.to_pylist()
    assert [(row["sample"], row["level"]) for row in rows] == [(n, k) for n in range(4) for k in range(2)]
    for row in rows:
        image = exr.read_png(corpus / row["png"]).astype(float)
        reference = exr.read_exr(corpus / row["reference"])["counts"]
        for kind, picture in (("raw", image), ("tared", image - reference)):
            found = scalars(picture, plan.k.counts)
            for name in ("max_dn", "total_dn", "area_px"):
                assert row[f"tsis_{kind}_{name}"] == pytest.approx(found[name], rel=1e-12)
        for kind in ("exr", "png"):
            assert row[f"sha256_{kind}"] == store.sha256(corpus / row[kind])
        assert row["sha256_reference"] == store.sha256(corpus / row["reference"])
        assert row["size_mm"] == plan.columns["size_mm"][row["sample"]]
        assert row["indentation_mm"] == row["nominal_mm"] == plan.indentation_mm[row["level"]]
    assert np.all(table["seconds_light"].to_numpy() > 0)


def test_the_same_frames_give_the_same_bytes(corpus, plan):
    """Also when they were added one by one, in another order."""
    whole = (corpus / index.FILE).read_bytes()
    kept = corpus.parent / "kept"
    shutil.move(corpus / "samples", kept)
    table = index.Table(corpus, plan, sha(corpus))
    assert table.write() == 0
    assert index.read(corpus, plan, sha(corpus)).num_rows == 0
    (corpus / "samples" / "000").mkdir(parents=True)
    for count, name in enumerate(("000002", "000000", "000003", "000001"), 1):
        shutil.move(kept / "000" / name, corpus / "samples" / "000" / name)
        assert table.write() == 2 * count
    assert (corpus / index.FILE).read_bytes() == whole
    assert list(pq.read_schema(corpus / index.FILE).names)[-2:] == list(index.TIMINGS)


def change_note(corpus: Path, number: int, **fields: object) -> None:
    place = store.sample_folder(corpus, number) / store.SAMPLE
    note = json.loads(place.read_text())
    place.write_text(json.dumps({**note, **fields}))


def change_record(corpus: Path, number: int, change) -> None:
    place = store.sample_folder(corpus, number) / "0.exr"
    record = store.read_record(place)
    change(record)
    exr.write_exr(place, exr.read_exr(place), {"record": json.dumps(record)})


HOSTILE_NOTES = [
    {"sha256": {"../../../etc/passwd": "0" * 64}},
    {"sha256": {"0.exr": "0" * 63}},
    {"sha256": {"0.exr": 5}},
    {"sha256": []},
    {"sha256": {}},
    {"seconds": {"mechanics": math.nan, "light": 1.0, "write": 1.0}},
    {"seconds": {"mechanics": math.inf, "light": 1.0, "write": 1.0}},
    {"seconds": {"mechanics": "1e999", "light": 1.0, "write": 1.0}},
    {"seconds": None},
    {"versions": {}},
    {"sample": 2},
    {"sample": "x" * 100},
]


@pytest.mark.parametrize("fields", HOSTILE_NOTES)
def test_hostile_sample_json_is_one_line(corpus, plan, fields):
    change_note(corpus, 1, **fields)
    with pytest.raises(exr.ImageError, match=r"^\S*sample.json: received what cannot be read[^\n]*$"):
        index.rows_of(corpus, plan, 1)
    table = index.build(corpus, plan, sha(corpus))
    assert list(table.bad) == [1]
    assert index.read(corpus, plan, sha(corpus)).num_rows == 6  # the others are there


@pytest.mark.parametrize(
    "text", ["", "[]", "{", "[" * 100_000, "9" * 10_000, '{"sha256": {"0.exr":' + " " * 2**21]
)
def test_sample_json_that_is_none(corpus, plan, text):
    (store.sample_folder(corpus, 1) / store.SAMPLE).write_text(text)
    with pytest.raises(exr.ImageError, match=r"sample\.json: received what cannot be read"):
        index.rows_of(corpus, plan, 1)


def put(*keys):
    """A change of one value of a record."""
    *path, name, value = keys

    def change(record):
        for key in path:
            record = record[key]
        record[name] = value

    return change


@pytest.mark.parametrize(
    "change",
    [
        put("reference", "../../secret.exr"),
        put("reference", "/etc/passwd"),
        put("reference", "references/0123456789abcdef.exr"),
        put("reference", 7),
        put("sample", 3),
        put("sample", True),
        put("level", 1),
        put("level", 10**30),
        put("group", ["x"]),
        put("blank", 0),
        put("parameters", {}),
        put("parameters", None),
        put("parameters", "size_mm", "9"),
        put("parameters", "more", 1.0),
        put("parameters", "size_mm", 10**400),
        put("press", 5),
        put("fem", "raw", "max_mm", math.nan),
        put("tsis", "tared", {}),
    ],
)
def test_hostile_records_are_one_line(corpus, plan, change):
    change_record(corpus, 1, change)
    with pytest.raises(exr.ImageError, match=r"^\S*0.exr: record: received [^\n]*$"):
        index.rows_of(corpus, plan, 1)


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"v/1\x01",
        b"\x76\x2f\x31\x01\x02\0\0\0",
        b"\x76\x2f\x31\x01\x02\0\0\0a\0string\0\xff\xff\xff\x7f" + 99 * b"x",
        b"\x76\x2f\x31\x01\x02\0\0\0a\0string\0\xff\xff\xff\xffx",
    ],
)
def test_heads_that_are_none_are_one_line(tmp_path, data):
    (tmp_path / "0.exr").write_bytes(data)
    with pytest.raises(exr.ImageError, match=r"0\.exr: [^\n]*$"):
        exr.read_exr_text(tmp_path / "0.exr")


def test_the_head_alone_gives_the_text_of_the_whole_file(tmp_path):
    """Against OpenEXR's own reader; also with a text longer than what is read at first."""
    planes = {"led.0": np.ones((3, 4), np.float32)}
    for length in (0, 10, 2**14 - 200, 2**14, 200_000):
        text = {"record": "é" * length, "b": "second"}
        exr.write_exr(tmp_path / "0.exr", planes, text)
        assert exr.read_exr_text(tmp_path / "0.exr") == exr.read_exr_header(tmp_path / "0.exr")
    exr.write_exr(tmp_path / "0.exr", planes, {"record": "x" * 2**22})
    with pytest.raises(exr.ImageError, match="damaged in its head"):
        exr.read_exr_text(tmp_path / "0.exr")


def test_an_index_of_another_plan_is_refused(corpus, plan):
    with pytest.raises(ValueError, match="of another plan"):
        index.read(corpus, plan, "0" * 64)
    table = pq.read_table(corpus / index.FILE)
    for strange, why in (
        (table.drop_columns(["group"]), "other columns"),
        (pa.concat_tables([table, table]), "more rows"),
    ):
        pq.write_table(strange, corpus / index.FILE)
        with pytest.raises(ValueError, match=f"^index.parquet: cannot be read .{why}[^\n]*$"):
            index.read(corpus, plan, sha(corpus))
    (corpus / index.FILE).write_bytes(b"PAR1" + bytes(100) + b"PAR1")
    with pytest.raises(ValueError, match=r"^index.parquet: cannot be read [^\n]*$"):
        index.read(corpus, plan, sha(corpus))
