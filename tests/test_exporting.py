"""Exports, read by the programs that they are for; the same bytes each time; whole or not at all."""

import csv
import hashlib
import io
import json
import os
import tarfile

import numpy as np
import pytest
import torch
from painted import SHAPE, paint
from PIL import Image

import twin
from twin import cli
from twin.exporting import export

SMALL = (SHAPE[0] // 2, SHAPE[1] // 2)
FLUX = '[randomise."leds.*.flux_W"]\ndistribution = "uniform"\nlow = 0.8\nhigh = 1.2\nrelative = true\n'


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return twin.Corpus(paint(tmp_path_factory.mktemp("corpus"), count=5, more=FLUX))


def hashes(folder):
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def unscaled(picture, note):
    return (np.asarray(picture, np.float64) - note["tared_png_zero"]) / note["tared_png_scale"]


def test_webdataset_reads_the_shards(corpus, tmp_path):
    import webdataset

    export(corpus, tmp_path / "out", "webdataset", shape=SMALL, shards=2)
    shards = sorted(str(path) for path in (tmp_path / "out").glob("*.tar"))
    assert len(shards) == 2
    samples = list(webdataset.WebDataset(shards, shardshuffle=False).decode("pill"))
    assert [int(sample["__key__"]) for sample in samples] == [0, 1, 2, 3, 4]
    for sample, item in zip(samples, corpus.dataset(shape=SMALL, raw=True), strict=True):
        tared = (item["image"] - item["reference"]).numpy()
        assert sample["tared.npy"].dtype == np.float16
        # 2^-11 of the value, and exact to a quarter of 16 frames' steps below 32 counts
        assert np.abs(sample["tared.npy"] - tared).max() <= np.abs(tared).max() * 2.0**-11
        assert np.array_equal(np.asarray(sample["mask.png"]) > 0, item["mask"].numpy())
        for level in range(2):
            assert (
                np.abs(np.asarray(sample[f"{level}.image.png"]) - item["image"][level].numpy()).max() <= 0.5
            )
        told = sample["json"]["levels"][1]
        assert told["nominal_mm"] == 2.0 and told["leds.0.flux_W"] > 0 and "exr" not in told
        assert told["blank"] == (told["size_mm"] is None)
    with tarfile.open(shards[0]) as tar:
        assert {(entry.mtime, entry.uid, entry.uname) for entry in tar} == {(0, 0, "")}


def test_datasets_reads_the_parquet_offline(corpus, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    monkeypatch.setenv("HF_HOME", str(tmp_path / "home"))
    from datasets import load_dataset

    export(corpus, tmp_path / "out", "hf", shape=SMALL, shards=3)
    note = json.loads((tmp_path / "out" / "export.json").read_text())
    rows = load_dataset(str(tmp_path / "out"), split="train", cache_dir=str(tmp_path / "cache"))
    assert len(rows) == 10 and len(list((tmp_path / "out" / "data").iterdir())) == 3
    assert {rows.features[name].dtype for name in ("image", "tared", "mask")} == {"PIL.Image.Image"}
    frames = corpus.dataset(shape=SMALL)
    for place, row in enumerate(rows):
        item, level = frames[place // 2], place % 2
        assert (row["sample"], row["level"]) == (place // 2, level)
        assert np.abs(unscaled(row["tared"], note) - item["tared"][level].numpy()).max() <= 0.5 / 128
        assert np.array_equal(np.asarray(row["mask"]) > 0, item["mask"].numpy())
        expected = corpus.table.iloc[place]
        assert row["leds.1.flux_W"] == expected["leds.1.flux_W"]
        assert row["force_N"] == expected["force_N"] and row["sha256_exr"] == expected["sha256_exr"]
        assert row["size_mm"] is None if expected["blank"] else row["size_mm"] == expected["size_mm"]


def test_folders_of_png(corpus, tmp_path):
    export(corpus, tmp_path / "out", "png")
    note = json.loads((tmp_path / "out" / "export.json").read_text())
    with open(tmp_path / "out" / "metadata.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    lines = [json.loads(line) for line in (tmp_path / "out" / "metadata.jsonl").read_text().splitlines()]
    assert len(rows) == len(lines) == 10
    for place, (row, line) in enumerate(zip(rows, lines, strict=True)):
        assert row["file_name"] == line["file_name"]
        image = np.asarray(Image.open(tmp_path / "out" / row["file_name"]))
        assert np.array_equal(image, corpus.image(place // 2, place % 2))
        tared = np.asarray(Image.open(tmp_path / "out" / row["tared"]))
        # 16 frames: sixteenths of a count, which 1/128 holds
        assert np.array_equal(unscaled(tared, note), corpus.tared(place // 2)[place % 2])
        assert float(row["nominal_mm"]) == line["nominal_mm"] == 1.0 + place % 2


@pytest.mark.parametrize("kind", ["webdataset", "hf", "png"])
def test_the_same_bytes_each_time(corpus, tmp_path, kind):
    for name in ("one", "two"):
        written = export(corpus, tmp_path / name, kind, shape=SMALL)
    assert hashes(tmp_path / "one") == hashes(tmp_path / "two")
    assert len(written) == len(hashes(tmp_path / "two"))
    export(corpus, tmp_path / "two", kind, shape=SMALL)  # an earlier one is replaced
    assert hashes(tmp_path / "one") == hashes(tmp_path / "two")


@pytest.mark.parametrize("kind", ["webdataset", "hf", "png"])
def test_cut_off_it_leaves_nothing(corpus, tmp_path, kind):
    def stop(done, total):
        assert total == 5
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        export(corpus, tmp_path / "out", kind, progress=stop)
    assert not os.listdir(tmp_path)


def test_colour_has_eight_bits(tmp_path):
    corpus = twin.Corpus(paint(tmp_path / "rgb", count=1, levels=(2.0,), blanks=0.0, design="rgb"))
    shape = (corpus.shape[0] // 4, corpus.shape[1] // 4)
    export(corpus, tmp_path / "out", "png", shape=shape)
    note = json.loads((tmp_path / "out" / "export.json").read_text())
    tared = np.asarray(Image.open(tmp_path / "out" / "tared" / "000000_0.png"))
    assert tared.shape == (*shape, 3) and note["tared_png_scale"] < 1
    expected = corpus.dataset(shape=shape)[0]["tared"][0].numpy()
    assert np.abs(unscaled(tared, note) - expected).max() <= 0.5 / note["tared_png_scale"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--format", "zip"], "--format: received 'zip'; allowed one of webdataset, hf, png"),
        ([], "--format: received nothing"),
        (["--format", "png", "--shards", "2"], "shards: received 2 with png"),
        (["--format", "hf", "--shards", "0"], "shards: received 0 with hf; allowed 1 to 5"),
        (
            ["--format", "hf", "--shape", "7", "7"],
            "shape: received (7, 7); allowed (rows, columns) that divide",
        ),
    ],
)
def test_mistakes_are_one_line(corpus, tmp_path, capsys, options, said):
    assert cli.main(["corpus", "export", str(corpus.path), "--out", str(tmp_path / "out"), *options]) == 2
    told = capsys.readouterr().err
    assert said in told and told.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_command_line(corpus, tmp_path, capsys):
    out = tmp_path / "out"
    arguments = ["corpus", "export", str(corpus.path), "--format", "webdataset", "--out", str(out)]
    assert cli.main([*arguments, "--shape", "24", "32"]) == 0
    assert "5 samples in 2 files" in capsys.readouterr().out
    with tarfile.open(out / "shard-000000.tar") as tar:
        array = np.load(io.BytesIO(tar.extractfile("000003.tared.npy").read()), allow_pickle=False)
    expected = corpus.dataset(shape=SMALL)[3]["tared"]
    assert torch.allclose(torch.from_numpy(array).float(), expected, rtol=2.0**-11)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.tex").write_text("x")
    assert cli.main([*arguments[:-1], str(tmp_path / "mine")]) == 2
    assert "which holds something else" in capsys.readouterr().err
