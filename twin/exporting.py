"""A corpus in the formats of other people's training code: WebDataset, Hugging Face, or plain PNG.

Tared pictures keep their fractions of counts: as float16 arrays, exact up to 32 counts and to 1/2048 beyond,
or as 16-bit PNG, counts = (value - 32768) / scale. Pictures of colour are 8-bit PNG about 128, scale 1 or
less. The same corpus and options give the same bytes.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
import tarfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray
from PIL import Image

from scenes import png
from scenes.camera import count_dtype
from twin.complaint import DesignError, shown
from twin.corpus import Corpus
from twin.stage import has_keys, staged

Kind = Literal["webdataset", "hf", "png"]
KINDS = ("webdataset", "hf", "png")
SHARD_BYTES = 512 * 2**20
"""Shards are about so large if no number is given; unpacked, so that they are smaller on disk."""

NOTE = "export.json"
_GROUP = 64  # rows of Parquet written, and read, together


@dataclass(frozen=True)
class _Pictures:
    """Files of one sample's pictures, each a list over press levels."""

    number: int
    image: list[bytes]
    """PNG, counts as the camera gave them; means are rounded."""
    tared: list[bytes]
    """PNG about the middle of the range, see `_scale`."""
    counts: NDArray[np.float16]
    """(levels, rows, columns[, 3]) tared."""
    mask: bytes
    """PNG, 255 where a pixel looks at the surface under the inclusion."""
    rows: list[dict[str, Any]]
    """The index's, without what names files of the corpus."""


def export(
    corpus: Corpus,
    out: str | Path,
    kind: Kind,
    *,
    shape: tuple[int, int] | None = None,
    shards: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Path]:
    """Write a corpus into a new folder, or over an earlier export; return its files. All or nothing.

    Parameters
    ----------
    kind
        "webdataset": tar shards with, for each sample, NNNNNN.json, .tared.npy (levels, rows, columns[, 3]),
        .mask.png and .LEVEL.image.png. "hf": Parquet shards of one row per frame with pictures inside, and a
        README.md that `datasets.load_dataset` goes by. "png": folders image, tared and mask, metadata.csv and
        metadata.jsonl.
    shape : smaller (rows, columns), means of whole numbers of pixels.
    shards : how many, of webdataset and hf; by size if none.
    progress : called with the samples that are done and all of them.

    Raises
    ------
    DesignError
        In one line.
    """
    if kind not in KINDS:
        raise DesignError("format", shown(kind), ", ".join(KINDS))
    if not len(corpus):
        raise DesignError("corpus", "no finished sample", "some to export (`twin corpus run` makes them)")
    if shards is not None and (kind == "png" or not 1 <= shards <= len(corpus)):
        allowed = f"1 to {len(corpus)}, one sample each, with webdataset or hf"
        raise DesignError("shards", f"{shards} with {kind}", allowed)
    frames = corpus.dataset(shape=shape, raw=True)
    scale = _scale(corpus)
    with staged(out, _is_export) as folder:
        parts = _split(len(corpus), shards or _by_size(corpus, frames.shape))
        done = 0

        def pictures(numbers: range) -> Iterator[_Pictures]:
            nonlocal done
            for number in numbers:
                yield _pictures(corpus, frames[number], scale)
                done += 1
                if progress is not None:
                    progress(done, len(corpus))

        if kind == "png":
            _write_png(folder, pictures(range(len(corpus))))
        else:
            for number, part in enumerate(parts):
                name = f"{number:05d}-of-{len(parts):05d}"
                if kind == "webdataset":
                    _write_tar(folder / f"shard-{number:06d}.tar", pictures(part))
                else:
                    (folder / "data").mkdir(exist_ok=True)
                    _write_parquet(folder / "data" / f"train-{name}.parquet", pictures(part))
        note = _note(corpus, kind, frames.shape, scale)
        if kind == "hf":
            size = sum(path.stat().st_size for path in folder.rglob("*.parquet"))
            (folder / "README.md").write_text(_hf_card(corpus, note, size), encoding="utf-8")
        (folder / NOTE).write_text(json.dumps(note, indent=1) + "\n", encoding="utf-8")
    return sorted(path for path in Path(out).rglob("*") if path.is_file())


def _pictures(corpus: Corpus, item: dict[str, Any], scale: float) -> _Pictures:
    number, place = int(item["sample"]), corpus.row(int(item["sample"]))
    image, reference = item["image"].numpy(), item["reference"].numpy()
    difference = image - reference
    whole = count_dtype(corpus.design.camera.bits)
    told = corpus.arrow.slice(place, corpus.levels).to_pylist()
    hidden = ("exr", "png", "reference", "seconds_mechanics", "seconds_light")
    rows = [{name: _finite(row[name]) for name in row if name not in hidden} for row in told]
    return _Pictures(
        number,
        [_png(np.rint(level).astype(whole)) for level in image],
        [_png(_about_middle(level, scale)) for level in difference],
        difference.astype(np.float16),
        _png(item["mask"].numpy().astype(np.uint8) * np.uint8(255)),
        rows,
    )


def _finite(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def _scale(corpus: Corpus) -> float:
    """Return steps of a tared PNG per count: the largest power of two at which all differences fit.

    16-bit PNG of three channels are read by few programs, so pictures of colour have 8 bits.
    """
    camera = corpus.design.camera
    room = 32767 if camera.colour == "mono" else 127
    return min(2.0 ** math.floor(math.log2(room / (2**camera.bits - 1))), 256.0)


def _about_middle(counts: NDArray[np.float32], scale: float) -> NDArray[Any]:
    middle, kind = (128, np.uint8) if counts.ndim == 3 else (32768, np.uint16)
    return (np.rint(counts * np.float32(scale)) + middle).astype(kind)


def _png(array: NDArray[Any]) -> bytes:
    if array.ndim == 3 and array.dtype == np.uint16:
        return png.encode(array)
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(stream, format="PNG", compress_level=6)
    return stream.getvalue()


def _split(count: int, parts: int) -> list[range]:
    """Return ranges of equal length, or one less, that cover all."""
    ends = [count * number // parts for number in range(parts + 1)]
    return [range(low, high) for low, high in pairwise(ends)]


def _by_size(corpus: Corpus, shape: tuple[int, int]) -> int:
    colours = len(corpus.design.camera.channels)
    sample = corpus.levels * math.prod(shape) * colours * 4
    return min(max(1, math.ceil(len(corpus) * sample / SHARD_BYTES)), len(corpus))


def _write_tar(path: Path, samples: Iterator[_Pictures]) -> None:
    with tarfile.open(path, "w", format=tarfile.USTAR_FORMAT) as tar:
        for sample in samples:
            array = io.BytesIO()
            np.save(array, sample.counts, allow_pickle=False)
            text = json.dumps({"sample": sample.number, "levels": sample.rows}, sort_keys=True)
            files = {"json": text.encode(), "mask.png": sample.mask, "tared.npy": array.getvalue()}
            files |= {f"{level}.image.png": data for level, data in enumerate(sample.image)}
            for name, data in files.items():
                entry = tarfile.TarInfo(f"{sample.number:06d}.{name}")  # no time, no owner: the same bytes
                entry.size, entry.mode = len(data), 0o644
                tar.addfile(entry, io.BytesIO(data))


_PICTURE_COLUMNS = ("image", "tared", "mask")


def _write_parquet(path: Path, samples: Iterator[_Pictures]) -> None:
    picture = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    schema, rows, writer = None, [], None
    try:
        for sample in samples:
            for level, row in enumerate(sample.rows):
                name = f"{sample.number:06d}_{level}"
                files = (sample.image[level], sample.tared[level], sample.mask)
                inside = zip(_PICTURE_COLUMNS, files, strict=True)
                rows.append(
                    {**{kind: {"bytes": data, "path": f"{name}.png"} for kind, data in inside}, **row}
                )
            if schema is None:
                fields = [(name, picture) for name in _PICTURE_COLUMNS]
                fields += [(name, _kind(name)) for name in sample.rows[0]]
                schema = pa.schema(
                    fields, {"huggingface": json.dumps({"info": {"features": _features(fields)}})}
                )
                writer = pq.ParquetWriter(path, schema, compression="zstd")
            if len(rows) >= _GROUP:
                _flush(writer, rows, schema)
        _flush(writer, rows, schema)
    finally:
        if writer is not None:
            writer.close()


def _flush(writer: Any, rows: list[dict[str, Any]], schema: pa.Schema) -> None:
    if rows:
        writer.write_table(pa.Table.from_pylist(rows, schema=schema))
        rows.clear()


def _kind(name: str) -> pa.DataType:
    if name in ("sample", "level"):
        return pa.int64()
    if name == "blank":
        return pa.bool_()
    return pa.string() if name in ("group", "version") or name.startswith("sha256_") else pa.float64()


def _features(fields: list[tuple[str, pa.DataType]]) -> dict[str, Any]:
    """Return the columns as the `datasets` package describes them."""
    names = {pa.int64(): "int64", pa.bool_(): "bool", pa.string(): "string", pa.float64(): "float64"}
    return {
        name: {"_type": "Image"} if kind not in names else {"dtype": names[kind], "_type": "Value"}
        for name, kind in fields
    }


def _write_png(folder: Path, samples: Iterator[_Pictures]) -> None:
    for name in _PICTURE_COLUMNS:
        (folder / name).mkdir()
    with (
        open(folder / "metadata.csv", "w", encoding="utf-8", newline="") as table,
        open(folder / "metadata.jsonl", "w", encoding="utf-8") as lines,
    ):
        writer = None
        for sample in samples:
            mask = f"mask/{sample.number:06d}.png"
            (folder / mask).write_bytes(sample.mask)
            for level, row in enumerate(sample.rows):
                files = {name: f"{name}/{sample.number:06d}_{level}.png" for name in ("image", "tared")}
                (folder / files["image"]).write_bytes(sample.image[level])
                (folder / files["tared"]).write_bytes(sample.tared[level])
                told = {"file_name": files["image"], "tared": files["tared"], "mask": mask, **row}
                if writer is None:
                    writer = csv.DictWriter(table, list(told), lineterminator="\n")
                    writer.writeheader()
                writer.writerow(told)
                lines.write(json.dumps(told) + "\n")


def _note(corpus: Corpus, kind: str, shape: tuple[int, int], scale: float) -> dict[str, Any]:
    middle = 32768 if corpus.design.camera.colour == "mono" else 128
    return {
        "format": kind,
        "corpus": corpus.name,
        "samples": len(corpus),
        "levels": corpus.levels,
        "indentation_mm": list(corpus.indentation_mm),
        "shape": list(shape),
        "tared_png": f"counts = (value - {middle}) / {scale:g}",
        "tared_png_scale": scale,
        "tared_png_zero": middle,
        "plan": corpus.plan.head.design_sha256,
    }


def _hf_card(corpus: Corpus, note: dict[str, Any], size: int) -> str:
    """Return the README that `datasets` and its hub go by: YAML, then words."""
    features = []
    names = [name for name in corpus.arrow.column_names if name not in ("exr", "png", "reference")]
    for name in (*_PICTURE_COLUMNS, *(name for name in names if not name.startswith("seconds_"))):
        kind = "image" if name in _PICTURE_COLUMNS else str(_kind(name)).replace("double", "float64")
        features.append(f"  - name: {json.dumps(name)}\n    dtype: {kind}")
    rows, columns = note["shape"]
    return f"""---
pretty_name: {json.dumps(corpus.name)}
license: other
size_categories:
- {_category(corpus.frames)}
tags:
- tactile-sensing
- simulation
configs:
- config_name: default
  data_files:
  - split: train
    path: data/train-*.parquet
dataset_info:
  features:
{chr(10).join(features)}
  splits:
  - name: train
    num_bytes: {size}
    num_examples: {corpus.frames}
---

# {corpus.name}

{corpus.description or "Simulated pictures of an optical tactile sensor pressed on tissue."}

One row per frame: {len(corpus)} samples at {corpus.levels} press levels, {columns} x {rows} pixels. `image`
is what the camera sees, in counts; `tared` is image minus the same press without inclusion,
{note["tared_png"]}; `mask` is where the inclusion lies. Sizes are in mm, moduli in kPa, forces in N; columns
that begin with `fem_` were measured on the contact surface, those with `tsis_` on the picture.

```python
from datasets import load_dataset

frames = load_dataset("THIS FOLDER", split="train")
```
"""


def _category(rows: int) -> str:
    for name, most in (("n<1K", 1e3), ("1K<n<10K", 1e4), ("10K<n<100K", 1e5), ("100K<n<1M", 1e6)):
        if rows < most:
            return name
    return "1M<n<10M"


def _is_export(folder: Path) -> bool:
    """Whether a folder holds an earlier export and nothing else."""
    names = {entry.name for entry in folder.iterdir()}
    known = {NOTE, "README.md", "data", "metadata.csv", "metadata.jsonl", *_PICTURE_COLUMNS}
    inside = (entry for name in ("data", *_PICTURE_COLUMNS) for entry in (folder / name).glob("*"))
    return (
        has_keys(folder / NOTE, "tared_png_scale", "plan")
        and all(name in known or _is_shard(name) for name in names)
        and all(_INSIDE.fullmatch(entry.name) for entry in inside)
    )


_INSIDE = re.compile(r"train-[0-9]{5}-of-[0-9]{5}\.parquet|[0-9]{6,}(_[0-9]+)?\.png")
"""What lies in an export's folders."""


def _is_shard(name: str) -> bool:
    return name.startswith("shard-") and name.endswith(".tar")
