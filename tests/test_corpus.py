"""Corpora, read: what was written comes back; noise and light from stored layers are the camera's own."""

import json
import multiprocessing
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from painted import SHAPE, light, paint
from torch.utils.data import DataLoader

import twin
from scenes.camera import fixed_pattern, mean_electrons
from twin import retake, store
from twin.footprint import footprint, sight

FLUX = """
[randomise."leds.*.flux_W"]
distribution = "uniform"
low = 0.8
high = 1.2
relative = true
[randomise."camera.gain_e_per_dn"]
distribution = "uniform"
low = 0.9
high = 1.1
relative = true
"""


@pytest.fixture(scope="module")
def corpus(tmp_path_factory):
    return twin.Corpus(paint(tmp_path_factory.mktemp("own"), count=4))


@pytest.fixture(scope="module")
def shared(tmp_path_factory):
    return twin.Corpus(paint(tmp_path_factory.mktemp("shared"), count=5, shared=True))


@pytest.fixture(scope="module")
def varied(tmp_path_factory):
    return twin.Corpus(paint(tmp_path_factory.mktemp("varied"), count=2, blanks=0.0, more=FLUX))


def test_what_was_written_comes_back(corpus):
    assert (len(corpus), corpus.frames, corpus.levels, corpus.shape) == (4, 8, 2, SHAPE)
    assert list(corpus.table["sample"]) == [0, 0, 1, 1, 2, 2, 3, 3]
    assert corpus.table["blank"].to_numpy()[::2].sum() == 1
    for sample in corpus.samples:
        for level in range(2):
            painted = light(corpus.plan, int(sample), level)
            assert np.array_equal(corpus.radiance(sample, level), painted)
            plain = light(corpus.plan, int(sample), level, plain=True)
            assert np.array_equal(corpus.reference_radiance(sample, level), plain)
            row = corpus.table.iloc[corpus.row(sample, level)]
            tared = corpus.image(sample, level).astype(np.float64) - corpus.reference(sample, level)
            assert tared.sum() == pytest.approx(row["tsis_tared_total_dn"], abs=1e-3)
            assert corpus.record(sample, level)["level"] == level
    assert corpus.field(0, 1, "pressure").min() == 1.0
    assert corpus.tared(0).shape == (2, *SHAPE)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (lambda c: c.image(99, 0), "sample: received 99; allowed one of the 4"),
        (lambda c: c.image(0, 2), "level: received 2; allowed 0 to 1"),
        (lambda c: c.image(True, 0), "sample: received True"),
        (lambda c: c.field(0, 0, "x"), "field: received 'x'"),
        (lambda c: c.dataset(shape=(10, 64)), r"shape: received \(10, 64\); allowed \(rows, columns\) that divide"),
        (lambda c: c.dataset(noise="x"), "noise: received 'x'"),
        (lambda c: c.dataset(frames=4), "frames: received 4 with noise = False"),
        (lambda c: c.dataset(led_weights=[1.0]), r"led_weights: received \[1.0\]; allowed 4 numbers"),
        (lambda c: c.dataset(led_weights=("uniform", 1.2, 0.8)), "led_weights: received"),
        (lambda c: c.dataset(levels=[2]), r"levels: received \[2\]"),
        (lambda c: c.dataset(parameters=["nope"]), "parameters: received 'nope'"),
        (lambda c: c.dataset(cached=True, noise=True), "cached: received True with noise"),
    ],
)
def test_mistakes_are_one_line(corpus, call, said):
    with pytest.raises(ValueError, match=said) as caught:
        call(corpus)
    assert "\n" not in str(caught.value)


def test_items(corpus):
    frames = corpus.dataset(shape=(24, 32), raw=True, per_led=True)
    item = frames[1]
    assert item["image"].shape == item["reference"].shape == (2, 24, 32)
    assert item["radiance"].shape == item["reference_radiance"].shape == (2, 4, 24, 32)
    assert item["image"].dtype == item["parameters"].dtype == torch.float32
    assert item["mask"].shape == (24, 32) and item["mask"].dtype == torch.bool
    assert frames.parameter_names == ("size_mm", "depth_mm", "modulus_kPa", "offset_x_mm", "offset_y_mm")
    assert len(list(frames)) == len(frames) == 4
    for index, item in enumerate(frames):
        row = corpus.table.iloc[2 * index]
        assert int(item["sample"]) == row["sample"] and bool(item["blank"]) == row["blank"]
        # an offset that is the same for all would stand in a blank, too: here all of them are drawn
        expected = row[list(frames.parameter_names)].to_numpy(np.float32)
        assert np.array_equal(item["parameters"].numpy(), expected, equal_nan=True)
        assert bool(item["blank"]) == bool(torch.isnan(item["parameters"][0]))
    only = corpus.dataset(levels=[1], mask=False, parameters=("force_N",))[0]
    assert only["tared"].shape == (1, *SHAPE) and "mask" not in only and only["parameters"].shape == (1,)


@pytest.mark.parametrize("block", [(1, 1), (2, 2), (4, 2), (3, 8)])
def test_smaller_pictures_are_exact_means(corpus, block):
    shape = (SHAPE[0] // block[0], SHAPE[1] // block[1])
    means = corpus.tared(2).astype(np.float64)
    means = means.reshape(2, shape[0], block[0], shape[1], block[1]).mean(axis=(2, 4))
    found = corpus.dataset(shape=shape)[2]["tared"].numpy()
    if block == (3, 8):  # 24 is no power of two: the last bit of a float32 of up to 255
        assert np.abs(found - means).max() < 255 * 2.0**-23
    else:
        assert np.array_equal(found, means.astype(np.float32))


def test_mask_is_the_disc_under_the_inclusion(corpus):
    """Area of a disc, and its middle, in closed form; pixels are 0.39 mm, so the border is worth a per cent."""
    design = twin.load_design("tsis")
    sensor, camera = design.sensor(), design.camera
    pixel = camera.field_of_view_mm * camera.field_height_mm / np.prod(camera.shape)
    for size, offset in ((4.0, (0.0, 0.0)), (10.0, (3.0, -2.0)), (2.0, (-5.0, 4.0))):
        mask = footprint(sensor, size, offset)
        row, column = np.nonzero(mask)
        assert mask.sum() * pixel == pytest.approx(np.pi * size**2 / 4, rel=0.01)
        x = ((column + 0.5).mean() / camera.columns - 0.5) * camera.field_of_view_mm
        y = (0.5 - (row + 0.5).mean() / camera.rows) * camera.field_height_mm
        assert (x, y) == pytest.approx(offset, abs=0.05)
    oval = footprint(sensor, 6.0, (0.0, 0.0), (1.5, 0.5))
    assert oval.sum() * pixel == pytest.approx(np.pi * 9.0 * 0.75, rel=0.01)
    assert oval.any(axis=0).sum() > 2 * oval.any(axis=1).sum()
    blank = int(corpus.table.query("blank")["sample"].iloc[0])
    assert not corpus.mask(blank).any()


def test_lines_of_sight_reach_the_field_of_view():
    """The middle row is exactly as wide as the design says (Snell's law through glass and guide)."""
    sensor = twin.load_design("tsis").sensor()
    x, y = sight(sensor)
    step = x[246, 1] - x[246, 0]
    assert x[246, -1] - x[246, 0] + step == pytest.approx(sensor.camera.field_of_view_mm, rel=2e-4)
    assert np.all(np.diff(x, axis=1) > 0) and np.all(np.diff(y, axis=0) < 0)


def test_a_new_exposure_with_the_old_seed_is_the_old_picture(shared):
    for sample in shared.samples[:2]:
        seed = shared.plan.seeds(int(sample))[1]
        image = retake.taken(shared.design, shared.layers(sample, 1), None, seed, 2.0)
        assert np.array_equal(image, shared.image(sample, 1))


def test_fast_noise_has_the_cameras_mean_and_variance(corpus):
    """Blocks of 2 x 2 pixels, 150 exposures each: means within 5 standard errors, spread within 1 %."""
    layers, design, block, count = corpus.layers(0, 1), corpus.design, (2, 2), 150
    rng = np.random.default_rng(3)
    charge = retake.charge(design, layers, None, block)
    fast = np.array([retake.counts(design, charge, block, 1, rng) for _ in range(count)], np.float64)
    exact = np.array(
        [retake.average(retake.taken(design, layers, None, seed, 2.0), block) for seed in range(count)], np.float64
    )
    spread = exact.std(axis=0, ddof=1)
    error = spread.mean() * np.sqrt(2 / count)
    assert np.abs(fast.mean(axis=0) - exact.mean(axis=0)).max() < 5 * error
    assert abs((fast.mean(axis=0) - exact.mean(axis=0)).mean()) < 5 * error / np.sqrt(spread.size)
    ratio = np.sqrt(fast.var(axis=0, ddof=1).mean() / exact.var(axis=0, ddof=1).mean())
    assert ratio == pytest.approx(1.0, abs=0.01)


def test_many_frames_are_quieter(corpus):
    still = corpus.dataset(noise=False, led_weights=[1.0] * 4, raw=True)[0]["image"]
    for noise in ("exact", "fast"):
        one = (corpus.dataset(noise=noise, raw=True)[0]["image"] - still).std()
        many = (corpus.dataset(noise=noise, frames=16, raw=True)[0]["image"] - still).std()
        assert float(many / one) == pytest.approx(0.25, rel=0.05)


def test_light_is_linear_in_the_leds(varied):
    """Counts over the black level, without noise, add up LED by LED, and are the camera's equation."""
    design, layers = varied.design_of(0), varied.layers(0, 1)
    assert design.camera.gain_e_per_dn != varied.design.camera.gain_e_per_dn
    each = [
        varied.dataset(led_weights=np.eye(4)[led].tolist(), raw=True)[0]["image"][1].numpy() for led in range(4)
    ]
    none = varied.dataset(led_weights=[0.0] * 4, raw=True)[0]["image"][1].numpy()
    weights = [0.5, 1.0, 1.5, 0.0]
    together = varied.dataset(led_weights=weights, raw=True)[0]["image"][1].numpy()
    expected = none + sum(weight * (picture - none) for weight, picture in zip(weights, each, strict=True))
    assert together == pytest.approx(expected, abs=2e-4)
    camera = design.camera
    response, offset = fixed_pattern(camera)
    light = np.tensordot(weights, layers.astype(np.float64), 1)
    dark = camera.dark_current_e_s * camera.exposure_ms * 1e-3
    electrons = mean_electrons(camera, light, design.light.wavelength_nm) * response + dark + offset
    assert together == pytest.approx(electrons / camera.gain_e_per_dn + camera.offset_dn, abs=2e-4)


def test_drawn_weights_are_the_same_for_picture_and_reference(corpus):
    blank = int(corpus.table.query("blank")["sample"].iloc[0])
    place = list(corpus.samples).index(blank)
    frames = corpus.dataset(led_weights=("uniform", 0.5, 1.5))
    item = frames[place]
    assert item["weights"].shape == (4,) and item["weights"].min() >= 0.5 and item["weights"].max() <= 1.5
    assert len(set(item["weights"].tolist())) == 4
    assert item["tared"].abs().max() == 0.0  # without inclusion, under any light, nothing is left
    frames.epoch(1)
    assert not torch.equal(frames[place]["weights"], item["weights"])
    spread = corpus.dataset(led_weights=("lognormal", 0.2))
    drawn = []
    for epoch in range(200):
        spread.epoch(epoch)
        drawn.append(np.log(spread._weights(0)))
    assert np.std(drawn) == pytest.approx(0.2, rel=0.1) and abs(np.mean(drawn)) < 0.03


@pytest.mark.parametrize("options", [{}, {"noise": "exact"}, {"noise": "fast", "led_weights": ("lognormal", 0.1)}])
def test_workers_and_order_change_nothing(shared, options):
    def epochs(workers, shuffle):
        batches = shared.loader(2, workers, shuffle=shuffle, seed=11, shape=(24, 32), **options)
        found = []
        for epoch in range(2):
            batches.dataset.epoch(epoch)
            pictures = {}
            for batch in batches:
                pictures |= dict(zip(batch["sample"].tolist(), batch["tared"], strict=True))
            found.append(pictures)
        return found

    alone, crowd = epochs(0, False), epochs(2, True)
    for one, other in zip(alone, crowd, strict=True):
        assert sorted(one) == sorted(other) == list(range(5))
        assert all(torch.equal(one[sample], other[sample]) for sample in one)
    fresh = not torch.equal(alone[0][0], alone[1][0])
    assert fresh == bool(options)


def test_shuffling_is_by_seed(shared):
    def order(seed, workers):
        return [n for batch in shared.loader(1, workers, seed=seed, mask=False) for n in batch["sample"].tolist()]

    assert order(1, 0) == order(1, 2) and sorted(order(1, 0)) == list(range(5))
    assert len({tuple(order(seed, 0)) for seed in range(6)}) > 1


def test_datasets_travel_to_other_processes(shared):
    frames = shared.dataset(shape=(24, 32), noise="fast", seed=4)
    frames[0]
    copied = pickle.loads(pickle.dumps(frames))
    assert torch.equal(copied[3]["tared"], frames[3]["tared"])
    assert len(pickle.dumps(shared)) < 100_000  # no picture goes along


@pytest.mark.slow
def test_fresh_processes_read_the_same(shared):
    frames = shared.dataset(noise="fast")
    context = multiprocessing.get_context("spawn")
    batches = DataLoader(frames, batch_size=5, num_workers=1, multiprocessing_context=context)
    assert torch.equal(next(iter(batches))["tared"][2], frames[2]["tared"])


def test_colour_and_averaged_frames(tmp_path):
    colour = twin.Corpus(paint(tmp_path / "rgb", count=1, levels=(2.0,), design="rgb"))
    rows, columns = colour.shape
    item = colour.dataset(shape=(rows // 2, columns // 2), per_led=True, noise="fast")[0]
    assert item["tared"].shape == (1, rows // 2, columns // 2, 3)
    assert item["radiance"].shape == (1, len(colour.design.leds), rows // 2, columns // 2, 3)
    assert np.array_equal(colour.radiance(0, 0), light(colour.plan, 0, 0))
    mean = twin.Corpus(paint(tmp_path / "mean", count=1, levels=(2.0,), blanks=0.0, frames=3, bits=12))
    assert mean.image(0, 0).dtype == np.float32
    assert np.any(mean.image(0, 0) % 1 != 0)
    design = replace(mean.design.camera)
    assert design.frames == 3 and mean.dataset(noise=True)[0]["tared"].shape == (1, *SHAPE)


def test_only_finished_samples_are_read(tmp_path):
    place = paint(tmp_path, count=3)
    from shutil import rmtree

    from painted import reindex

    rmtree(store.sample_folder(place, 1))
    reindex(place)
    corpus = twin.Corpus(place)
    assert list(corpus.samples) == [0, 2] and len(corpus.plan) == 3
    assert [int(item["sample"]) for item in corpus.dataset()] == [0, 2]
    assert json.loads((store.sample_folder(place, 2) / store.SAMPLE).read_text())["sample"] == 2
