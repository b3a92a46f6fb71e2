"""A corpus from a stranger: what does not fit is refused in one line, unread, and runs nothing."""

import io
import os
import pickle
import shutil
import struct
import zlib
from pathlib import Path

import numpy as np
import OpenEXR
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from painted import SHAPE, edit_index, paint, rehash

import twin
from scenes import exr
from twin import store


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return paint(tmp_path_factory.mktemp("clean"), count=2, levels=(1.0, 2.0), blanks=0.0)


@pytest.fixture
def place(clean, tmp_path):
    return Path(shutil.copytree(clean, tmp_path / "corpus"))


def first(change):
    return lambda values: [change(values[0]), *values[1:]]


def swapped(values):
    return [values[1], values[0], *values[2:]]


def raw_table(place, change):
    table = pq.read_table(place / "index.parquet")
    pq.write_table(change(table), place / "index.parquet")


def cast(name, kind):
    def change(table):
        at = table.schema.get_field_index(name)
        return table.set_column(at, name, table[name].cast(kind))

    return change


INDEX = {
    "up and out": (lambda p: edit_index(p, png=first(lambda _: "../../etc/passwd")), "column png, row 0"),
    "absolute": (lambda p: edit_index(p, exr=first(lambda _: "/etc/passwd")), "column exr, row 0"),
    "another's": (lambda p: edit_index(p, png=swapped), "column png, row 0"),
    "reference out": (
        lambda p: edit_index(p, reference=first(lambda _: "references/../../x.exr")),
        "column reference, row 0",
    ),
    "reference of another": (lambda p: edit_index(p, reference=swapped), "column reference, row 0"),
    "reference with a line": (
        lambda p: edit_index(p, reference=first(lambda _: "references/0123456789abcdef.exr\n")),
        "column reference, row 0",
    ),
    "NaN": (lambda p: edit_index(p, force_N=first(lambda _: float("nan"))), "column force_N, row 0"),
    "null": (lambda p: edit_index(p, force_N=first(lambda _: None)), "column force_N, row 0"),
    "infinity": (
        lambda p: edit_index(p, error_percent=first(lambda _: float("inf"))),
        "column error_percent",
    ),
    "no size": (lambda p: edit_index(p, size_mm=first(lambda _: float("nan"))), "column size_mm, row 0"),
    "no hash": (lambda p: edit_index(p, sha256_png=first(lambda _: "x" * 64)), "column sha256_png, row 0"),
    "null text": (lambda p: edit_index(p, group=first(lambda _: None)), "column group, row 0"),
    "long text": (lambda p: edit_index(p, group=first(lambda _: "x" * 10_000)), "column group, row 0"),
    "sample beyond": (lambda p: edit_index(p, sample=lambda v: [n + 1 for n in v]), "column sample"),
    "sample below": (lambda p: edit_index(p, sample=lambda v: [n - 1 for n in v]), "column sample, row 0"),
    "level twice": (lambda p: edit_index(p, level=lambda v: [0 for _ in v]), "column level, row 1"),
    "level beyond": (lambda p: edit_index(p, level=lambda v: [n + 7 for n in v]), "column level, row 0"),
    "row missing": (lambda p: raw_table(p, lambda t: t.slice(1)), "column level, row 0"),
    "rows twice": (lambda p: raw_table(p, lambda t: pa.concat_tables([t, t])), "more rows"),
    "column missing": (lambda p: raw_table(p, lambda t: t.drop_columns(["png"])), "other columns"),
    "column more": (lambda p: raw_table(p, lambda t: t.append_column("x", t["level"])), "other columns"),
    "numbers as text": (lambda p: raw_table(p, cast("force_N", pa.string())), "other columns"),
    "floats as samples": (lambda p: raw_table(p, cast("sample", pa.float64())), "other columns"),
    "no Parquet": (lambda p: (p / "index.parquet").write_bytes(b"PAR1" + bytes(100)), "cannot be read"),
    "pickled": (lambda p: (p / "index.parquet").write_bytes(pickle.dumps({"a": 1})), "cannot be read"),
    "no index": (lambda p: (p / "index.parquet").unlink(), "index.parquet: received no such file"),
    "no plan": (lambda p: (p / "plan.json").unlink(), "plan.json"),
    "index is a link": (
        lambda p: (
            shutil.move(p / "index.parquet", p.parent / "i"),
            (p / "index.parquet").symlink_to("../i"),
        ),
        "a link leads out",
    ),
}


@pytest.mark.parametrize("name", INDEX)
def test_index_and_plan(place, name):
    spoil, said = INDEX[name]
    spoil(place)
    with pytest.raises(ValueError, match=said) as caught:
        twin.Corpus(place)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 2000


def frame(place):
    return store.sample_folder(place, 0) / "0.exr"


def picture(place):
    return store.sample_folder(place, 0) / "0.png"


def exr_bytes(planes):
    stream = io.BytesIO()
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(attributes, planes, num_threads=0).write(stream)
    return stream.getvalue()


def rewrite(path, change):
    """Write the frame anew with other planes, its record as before."""
    planes = exr.read_exr(path)
    text = exr.read_exr_header(path)
    change(planes)
    exr.write_exr(path, planes, text)


def with_value(name, value):
    def change(planes):
        planes[name] = np.where(
            np.arange(planes[name].size).reshape(planes[name].shape) == 5, value, planes[name]
        )
        planes[name] = planes[name].astype(np.float32)

    return lambda p: rewrite(frame(p), change)


def huge_exr(path):
    """A head that promises 2^31 pixels a side; what would be unpacked first is its memory."""
    data = path.read_bytes()
    at = data.index(b"dataWindow\0box2i\0") + len(b"dataWindow\0box2i\0") + 4
    path.write_bytes(data[:at] + struct.pack("<4i", 0, 0, 2**31 - 2, 2**31 - 2) + data[at + 16 :])


def many_channels(path):
    planes = exr.read_exr(path)
    more = {f"x{number}": planes["led.0"] for number in range(50)}
    exr.write_exr(path, {**planes, **more}, exr.read_exr_header(path))


def chunk(kind, body):
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def png_bomb(columns, rows, second=None):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 0, 0, 0, 0))
    if second:
        head += chunk(b"IHDR", struct.pack(">IIBBBBB", *second, 8, 0, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(10**6))) + chunk(b"IEND", b"")


def linked_out(path):
    outside = path.parents[4] / "outside"
    shutil.move(path, outside)
    path.symlink_to(outside)


def folder_linked_out(place):
    folder = store.sample_folder(place, 0)
    outside = place.parent / "outside"
    shutil.move(folder, outside)
    folder.symlink_to(outside, target_is_directory=True)


FORGED = {
    "huge EXR": (lambda p: huge_exr(frame(p)), "received an EXR of 2147483647 x 2147483647 pixels"),
    "smaller EXR": (
        lambda p: rewrite(frame(p), lambda planes: planes.update({k: v[:-2] for k, v in planes.items()})),
        "received an EXR of 64 x 46 pixels, allowed: 64 x 48",
    ),
    "NaN": (with_value("led.1", np.nan), "led.1: received 0.0[0-9]* to nan|led.1: received nan to nan"),
    "infinity": (with_value("led.1", np.inf), "led.1: received .* to inf"),
    "negative": (with_value("led.1", -1.0), "led.1: received -1.0"),
    "no such LED": (
        lambda p: rewrite(frame(p), lambda planes: planes.pop("led.3")),
        "channel: received none",
    ),
    "many channels": (lambda p: many_channels(frame(p)), "channel: received 'x0'"),
    "huge file": (lambda p: os.truncate(frame(p), 2**23), "more than [0-9]+ bytes"),
    "no EXR": (lambda p: frame(p).write_bytes(pickle.dumps([1])), "not an EXR file"),
    "cut EXR": (lambda p: os.truncate(frame(p), frame(p).stat().st_size // 2), "cut short"),
    "no PNG": (lambda p: picture(p).write_bytes(pickle.dumps([1])), "not a PNG"),
    "huge PNG": (lambda p: picture(p).write_bytes(png_bomb(50_000, 50_000)), "PNG of 50000 x 50000 pixels"),
    "PNG of two heads": (
        lambda p: picture(p).write_bytes(png_bomb(SHAPE[1], SHAPE[0], (50_000, 50_000))),
        "damaged PNG|received uint8",
    ),
    "deep PNG": (lambda p: exr.write_png(picture(p), np.zeros(SHAPE, np.uint16)), "received uint16"),
    "colour PNG": (lambda p: exr.write_png(picture(p), np.zeros((*SHAPE, 3), np.uint8)), "received uint8"),
}


@pytest.mark.parametrize("name", FORGED)
def test_pictures_whose_hashes_were_forged_too(place, name):
    """Hash and index fit the file, as of one who made the whole corpus: only the file itself is wrong."""
    spoil, said = FORGED[name]
    spoil(place)
    light, counts = store.sha256(frame(place)), store.sha256(picture(place))
    edit_index(place, sha256_exr=first(lambda _: light), sha256_png=first(lambda _: counts))
    corpus = twin.Corpus(place)
    with pytest.raises(ValueError, match=said) as caught:
        corpus.dataset(per_led=True)[0]
    assert "\n" not in str(caught.value)
    corpus.dataset(per_led=True)[1]  # the others are whole


FOUND = {
    "flipped byte": (lambda p: flip(picture(p)), "SHA-256"),
    "flipped byte of an EXR": (lambda p: flip(frame(p)), "SHA-256"),
    "file gone": (lambda p: picture(p).unlink(), "no such file"),
    "file linked out": (lambda p: linked_out(picture(p)), "a link leads out"),
    "folder linked out": (folder_linked_out, "a link leads out"),
    "a pipe": (lambda p: (picture(p).unlink(), os.mkfifo(picture(p))), "no such file"),
}


def flip(path):
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)


@pytest.mark.parametrize("name", FOUND)
def test_files_that_the_index_does_not_know(place, name):
    spoil, said = FOUND[name]
    corpus = twin.Corpus(place)
    spoil(place)
    with pytest.raises(ValueError, match=said) as caught:
        corpus.dataset(per_led=True)[0]
    assert "\n" not in str(caught.value)


def test_counts_beyond_the_cameras(place):
    reference = store.sample_folder(place, 0) / "0.reference.exr"
    rewrite(reference, lambda planes: planes.update(counts=planes["counts"] + np.float32(1e6)))
    rehash(place)
    with pytest.raises(ValueError, match=r"counts: received .* allowed finite values >= 0 and <= 255"):
        twin.Corpus(place).reference(0, 0)


def test_notes_of_pandas_are_not_read(place):
    """Parquet's pandas notes may name extension types to be made: here they are thrown away."""
    raw_table(place, lambda t: t.replace_schema_metadata({**t.schema.metadata, b"pandas": b"{broken"}))
    assert len(twin.Corpus(place).table) == 4
