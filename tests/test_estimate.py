"""``twin estimate`` around its estimator: files in; words, JSON and a picture out, or one line."""

import json
import sys
from types import ModuleType

import numpy as np
import pytest
from other_camera import real_camera, write_seen_from_below
from painted_press import painted_light, pair, small, wanted, write_folders
from PIL import Image
from stand_in import RANGES, StandIn, as_module, card_of

from twin import cli
from twin.estimate import estimate, told
from twin.estimate_pictures import Sheet, overview
from twin.estimates import NAMES, decimals, probability


def size_of(place):
    with Image.open(place) as picture:
        return picture.size


LEVELS = (1.0, 2.0, 3.0)
SENSOR = small()


@pytest.fixture
def use(monkeypatch):
    """Put an estimator that answers as told in the place of a trained one."""

    def put(**options):
        estimator = StandIn(card_of(SENSOR, LEVELS), **options)
        monkeypatch.setitem(sys.modules, "twin.estimator_file", as_module(estimator))
        return estimator

    return put


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    root = tmp_path_factory.mktemp("frames")
    write_folders(pair(SENSOR), LEVELS, root)
    return root


def test_from_frames_to_files(use, frames, tmp_path, capsys):
    estimator = use()
    out = tmp_path / "answer"
    assert cli.main(["estimate", "model", str(frames), "--out", str(out), "--seed", "3"]) == 0
    said = capsys.readouterr().out
    assert "probability of an inclusion: 0.990" in said and "look at:" in said
    assert sorted(place.name for place in out.iterdir()) == ["estimate.json", "overview.png"]
    assert size_of(out / "overview.png") == (1800, 1200)
    record = json.loads((out / "estimate.json").read_text(encoding="utf-8"))
    answer = estimator.estimate(pair(SENSOR), seed=3)
    for index, name in enumerate(NAMES):
        part = record["inclusion"][name]
        assert part["mean"] == pytest.approx(answer.mean[index], rel=1e-12)
        assert part["sd"] == pytest.approx(answer.samples[:, index].std(ddof=1), rel=1e-9)
        assert part["interval_90"] == pytest.approx(list(answer.interval[index]), rel=1e-12)
        assert part["range"] == list(RANGES[name])
    assert [record["inclusion"][name]["told"] for name in NAMES] == [True, True, False]
    assert (record["presence"], record["likeness"], record["seed"]) == (0.99, 0.42, 3)
    assert record["pictures"]["reference_frames"] == 16
    # the same again, in place of the first; without --out nothing is written
    assert cli.main(["estimate", "model", str(frames), "--out", str(out)]) == 0
    assert cli.main(["estimate", "model", str(frames)]) == 0
    assert [place.name for place in tmp_path.iterdir()] == ["answer"]


def test_what_is_said_of_what_is_not_known(use, frames):
    use(presence=0.0001, sd=(3.0, 0.2, 40.0))
    lines = told(estimate("model", [frames])).splitlines()
    assert lines[0] == "probability of an inclusion: < 0.001; if there is one:"
    assert "these pictures hardly tell" in lines[3] and "40 to 120" in lines[3]
    assert "hardly" not in lines[2]
    assert (probability(0.9999), probability(0.5)) == ("> 0.999", "0.500")
    assert [decimals(sd) for sd in (18.0, 1.2, 0.2, 0.04, 0.0)] == [0, 1, 2, 3, 3]


def test_the_same_estimate_gives_the_same_picture(use, tmp_path):
    received = pair(SENSOR)
    answer = use().estimate(received)
    sheet = Sheet(answer, received, RANGES, (25.0, 18.7), LEVELS, 0.01, ["a note"])
    overview(sheet, tmp_path / "a.png")
    overview(sheet, tmp_path / "b.png")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    ("levels", "mean", "sd"),
    [((2.0,), (2.0, 12.0, 40.0), 1.0), ((1.0, 1.5, 2.0, 2.5, 3.0), (5.0, 5.0, 50.0), 1e-9)],
)
def test_sheets_of_other_numbers_of_levels(levels, mean, sd, tmp_path):
    """Of a posterior at the end of its range, and of one without spread."""
    received = pair(SENSOR, levels)
    answer = StandIn(card_of(SENSOR, levels), mean=mean, sd=(sd, sd, sd)).estimate(received)
    overview(Sheet(answer, received, RANGES, (25.0, 18.7), levels, 0.01, []), tmp_path / "sheet.png")
    assert size_of(tmp_path / "sheet.png") == (1800, 1200)


def test_a_real_cameras_pictures_arrive(use, tmp_path, capsys):
    """Another camera, misaligned by 1 %, its files mirrored and of several exposures each."""
    use()
    light = painted_light(SENSOR, LEVELS, x_mm=5.0)
    one = real_camera(SENSOR, *light, seed=1)
    images = write_seen_from_below(one.images, tmp_path, "image", 8)
    shots = [real_camera(SENSOR, *light, 1, shot, reference_frames=1).references for shot in range(3)]
    plain = np.stack(shots, axis=1).reshape(-1, *SENSOR.camera.shape)
    references = write_seen_from_below(plain, tmp_path, "reference", 8)
    arguments = [str(place) for place in [*images, "--reference", *references]]
    found = estimate("model", images, references=references, flip=True)
    np.testing.assert_array_equal(found.received.images, one.images)
    assert found.received.reference_frames == 3
    assert cli.main(["estimate", "model", *arguments, "--flip"]) == 0
    assert "modulus" in capsys.readouterr().out


KEPT = json.dumps({"presence": 0.5, "likeness": 0.5})
REFUSALS = {
    "unlike": ([], "pictures unlike the model's"),
    "no pictures": (["--frames", "2"], "3 frames"),
    "frames of none": (["--frames", "0"], "--frames: received 0"),
    "few samples": (["--samples", "3"], "--samples: received 3"),
    "references for folders": (["--reference", "a.png"], "--reference"),
    "a wrong flip": (["--flip"], "--flip"),
}


@pytest.mark.parametrize("case", REFUSALS)
def test_refusals_are_one_line_and_leave_nothing(case, use, frames, tmp_path, capsys):
    more, word = REFUSALS[case]
    use(refused="pictures unlike the model's (likeness 0 below 0.01)" if case == "unlike" else None)
    for out in (tmp_path / "new" / "answer", tmp_path / "earlier"):
        if out.name == "earlier":
            out.mkdir()
            (out / "estimate.json").write_text(KEPT)
        assert cli.main(["estimate", "model", str(frames), *more, "--out", str(out)]) == 2
        said = capsys.readouterr()
        assert said.out == "" and word in said.err
        assert [line for line in said.err.splitlines() if line.startswith("twin estimate: ")] == [
            said.err.splitlines()[-1]
        ]
    assert (tmp_path / "earlier" / "estimate.json").read_text() == KEPT
    assert [place.name for place in tmp_path.iterdir()] == ["earlier"]


def test_other_peoples_folders_stay(use, frames, tmp_path, capsys):
    use()
    (tmp_path / "thesis.txt").write_text("mine")
    assert cli.main(["estimate", "model", str(frames), "--out", str(tmp_path)]) == 2
    assert "holds something else" in capsys.readouterr().err
    assert [place.name for place in tmp_path.iterdir()] == ["thesis.txt"]


def test_train_takes_its_arguments(monkeypatch, capsys):
    """What the verb hands on; training has tests of its own."""
    called = {}
    module = ModuleType("twin.train")
    module.train = lambda corpus, out, **options: called.update(corpus=corpus, out=out, **options) or "done"
    monkeypatch.setitem(sys.modules, "twin.train", module)
    flags = ["--levels", "0", "2", "--minutes", "0.5", "--seed", "4", "--samples", "40", "--imagined", "500"]
    flags += ["--lean", "--device", "cpu"]
    assert cli.main(["train", "c", "--out", "m", *flags]) == 0
    del called["progress"]
    numbers = {"levels": [0, 2], "minutes": 0.5, "seed": 4, "samples": 40, "imagined": 500, "lean": True}
    assert called == {"corpus": "c", "out": "m", "device": "cpu", **numbers}
    assert capsys.readouterr().out == "done\n"
    for wrong, word in (
        (["train", "c"], "--out"),
        (["train", "c", "--out", "m", "--levels", "0", "0"], "--levels"),
    ):
        assert cli.main(wrong) == 2
        assert word in capsys.readouterr().err


@pytest.mark.parametrize("verb", ["train", "assess", "estimate"])
def test_help_has_examples(verb, capsys):
    assert cli.main([verb, "--help"]) == 0
    said = capsys.readouterr().out
    assert f"  twin {verb} " in said.split("examples:")[1]


def test_what_a_model_wants_is_what_a_frame_is():
    received = pair(SENSOR)
    assert received.images.shape == (len(LEVELS), *wanted(SENSOR).planes)
