"""The reader's cache: the same numbers, sooner; whole or not at all; never that of other frames."""

import json
import pickle
import shutil

import numpy as np
import pytest
import torch
from painted import SHAPE, paint, rehash, small_design

import scenes.exr
import twin
from twin import store
from twin.cache import cached, folder_of, steps

SMALL = (SHAPE[0] // 2, SHAPE[1] // 2)


@pytest.fixture
def place(tmp_path):
    return paint(tmp_path, count=3, shared=True)


@pytest.mark.parametrize("shape", [None, SMALL, (SHAPE[0] // 4, SHAPE[1] // 4)])
def test_eight_bits_lose_nothing(place, shape):
    corpus = twin.Corpus(place)
    straight, kept = corpus.dataset(shape=shape), corpus.dataset(shape=shape, cached=True)
    for index in range(3):
        for name, value in straight[index].items():
            assert torch.equal(value.nan_to_num(), kept[index][name].nan_to_num()), name
    note = json.loads(next(place.glob("cache/*/cache.json")).read_text())
    assert note["worst_error_dn"] == 0.0
    raw = corpus.dataset(shape=shape, cached=True, raw=True)[0]
    assert torch.equal(raw["image"], corpus.dataset(shape=shape, raw=True)[0]["image"])


def test_more_bits_are_rounded_to_half_a_step(tmp_path):
    gain = 45_000 / 4095
    corpus = twin.Corpus(paint(tmp_path, count=1, bits=12, gain_e_per_dn=gain, frames=3))
    note = corpus.cache(SMALL)
    step = 1 / steps(corpus, SMALL)[1]  # of the reference: pictures, sums of 12, keep all
    worst = json.loads((note.folder / "cache.json").read_text())["worst_error_dn"]
    difference = (
        corpus.dataset(shape=SMALL, cached=True)[0]["tared"] - corpus.dataset(shape=SMALL)[0]["tared"]
    )
    assert 0 < worst <= step / 2 * (1 + 1e-6) and step == 4095 / 65535
    assert difference.abs().max() <= 2 * worst + 1e-3
    # next to the noise of one block of 2 x 2 pixels and 3 frames
    assert worst < 0.1 * corpus.dataset(shape=SMALL)[0]["tared"][0, :, 0].std()


def test_light_from_the_cache_is_that_of_the_files(tmp_path):
    more = """
[randomise."camera.full_well_e"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
"""
    corpus = twin.Corpus(paint(tmp_path, count=2, more=more, ambient=0.01, vignetting=True))
    options = {"shape": SMALL, "raw": True, "led_weights": ("uniform", 0.5, 1.5)}
    for noise in (False, "fast"):
        straight = corpus.dataset(noise=noise, **options)
        kept = corpus.dataset(noise=noise, cached=True, **options)
        for index in range(2):
            for name in ("image", "reference"):
                one, other = straight[index][name], kept[index][name]
                # half floats: 2^-12 of up to 140 counts at most, and the noise hardly feels it
                assert (one - other).abs().max() < 0.05
                assert (one - other).std() < 0.01


def test_other_frames_have_another_cache(place):
    old = twin.Corpus(place).cache(SMALL)
    assert twin.Corpus(place).cache(SMALL).folder == old.folder
    assert folder_of(twin.Corpus(place), SHAPE, False) != old.folder
    file = store.sample_folder(place, 0) / "0.png"
    scenes.exr.write_png(file, scenes.exr.read_png(file) + np.uint8(1))
    rehash(place)
    corpus = twin.Corpus(place)
    fresh = corpus.cache(SMALL)
    assert fresh.folder != old.folder and not old.folder.exists()
    assert torch.equal(
        corpus.dataset(shape=SMALL, cached=True)[0]["tared"], corpus.dataset(shape=SMALL)[0]["tared"]
    )


def test_one_cache_serves_pictures_and_light(place):
    corpus = twin.Corpus(place)
    both = corpus.cache(SMALL, layers=True)
    assert corpus.cache(SMALL).folder == both.folder


def test_processes_build_the_same_bytes(place):
    corpus = twin.Corpus(place)
    one = {path.name: path.read_bytes() for path in cached(corpus, SMALL, layers=True).folder.iterdir()}
    shutil.rmtree(place / "cache")
    steps_told = []
    tell = lambda done, total: steps_told.append((done, total))  # noqa: E731
    two = cached(corpus, SMALL, layers=True, workers=2, progress=tell).folder
    assert one == {path.name: path.read_bytes() for path in two.iterdir()}
    assert steps_told == [(number + 1, 6) for number in range(6)]


def test_cut_off_it_leaves_nothing(place):
    corpus = twin.Corpus(place)

    def stop(done, total):
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cached(corpus, SMALL, progress=stop)
    assert not list(place.glob("cache/*")) and not list(place.glob("cache/.*"))
    assert cached(corpus, SMALL).folder.is_dir()


def test_a_picture_that_the_index_does_not_know_stops_it(place):
    file = store.sample_folder(place, 1) / "1.png"
    file.write_bytes(file.read_bytes() + b"x")
    with pytest.raises(ValueError, match="SHA-256"):
        twin.Corpus(place).cache(SMALL)
    assert not list(place.glob("cache/*"))


def test_a_strangers_cache_runs_nothing(place, tmp_path):
    corpus = twin.Corpus(place)
    folder = corpus.cache(SMALL, layers=True).folder
    kept = (folder / "picture.npy").read_bytes()

    class Trap:
        def __reduce__(self):
            return (tmp_path.joinpath("ran").touch, ())

    for name, spoiled in {
        "pickled": pickle.dumps(Trap()),
        "objects": object_array(Trap()),
        "cut": kept[: len(kept) // 2],
        "huge": kept.replace(b"(6, 24, 32)", b"(9999999, 24, 32)"),
        "empty": b"",
    }.items():
        (folder / "picture.npy").write_bytes(spoiled)
        with pytest.raises(ValueError, match=r"picture\.npy") as caught:
            twin.Corpus(place).dataset(shape=SMALL, cached=True)
        assert "\n" not in str(caught.value), name
    assert not (tmp_path / "ran").exists()
    (folder / "picture.npy").write_bytes(kept)
    charges = np.load(folder / "charge.npy")
    charges[0, 0, 3, 3] = np.nan
    np.save(folder / "charge.npy", charges)
    frames = corpus.dataset(shape=SMALL, cached=True, noise="fast")
    with pytest.raises(ValueError, match=r"charge\.npy, row 0: received nan"):
        frames[0]
    shutil.rmtree(place / "cache")
    (place / "cache").symlink_to(tmp_path)
    with pytest.raises(ValueError, match="a link leads out"):
        corpus.cache(SMALL)


def object_array(thing):
    import io

    stream = io.BytesIO()
    np.save(stream, np.array([thing], object), allow_pickle=True)
    return stream.getvalue()


def test_the_small_design_is_the_paper_sensors_field():
    assert "columns = 64" in small_design() and "rows = 48" in small_design()
