"""Pictures from a user: read as they are, or refused in one line that says what is wrong."""

import json
import struct
import zlib
from dataclasses import replace

import numpy as np
import pytest
from other_camera import other_camera, real_camera, write_seen_from_below
from painted_press import painted_light, pair, small, wanted, write_folders
from PIL import Image

from scenes.exr import write_exr, write_png
from scenes.imager import Efficiency
from twin.complaint import DesignError
from twin.received import wanted_of
from twin.receiving import receive
from twin.sound import shared_pattern

LEVELS = (1.0, 2.0, 3.0)
SENSOR = small()


@pytest.fixture(scope="module")
def given():
    """One exposure of each level, references of 16."""
    return pair(SENSOR)


@pytest.fixture
def files(given, tmp_path):
    """The same as a real camera's files: five exposures of each reference."""
    images = write_seen_from_below(given.images, tmp_path, "image", 8)
    rounds = [pair(SENSOR, seed=seed, reference_frames=1).references for seed in range(5)]
    plain = np.stack(rounds, axis=1).reshape(-1, *given.images.shape[1:])
    return images, write_seen_from_below(plain, tmp_path, "reference", 8), plain


def refused(*arguments, **options):
    with pytest.raises(DesignError) as caught:
        receive(*arguments, **options)
    line = str(caught.value)
    assert "\n" not in line and "received" in line and "allowed" in line
    return line


def test_folders_come_back_as_they_were_written(given, tmp_path):
    folders = write_folders(given, LEVELS, tmp_path)
    for frames in ([tmp_path], folders, folders[::-1]):  # the levels are known: order does not matter
        found = receive(frames, wanted(SENSOR))
        np.testing.assert_array_equal(found.images, given.images)
        np.testing.assert_array_equal(found.references, given.references)
        assert (found.frames, found.reference_frames, found.bits) == (1, 16, 8)
        assert found.images.dtype == found.references.dtype == np.float32


@pytest.mark.parametrize(
    ("depths", "fits"),
    [
        ((1.02, 2.04, 3.06), True),
        ((1.0, 2.002, 3.0), True),
        ((1.0, 2.0, 3.03), False),
        ((1.01, 2.0, 3.0), False),
    ],
)
def test_levels_are_off_alike_or_not_at_all(given, depths, fits, tmp_path):
    """An estimator knows one factor of all depths; one level alone deeper passes for another inclusion."""
    folders = write_folders(given, depths, tmp_path)
    if fits:
        assert len(receive(folders, wanted(SENSOR)).images) == 3
    else:
        assert "within 0.15%" in refused(folders, wanted(SENSOR))


def test_averaged_folders_keep_fractions_and_are_averaged_again(tmp_path):
    halves = [pair(SENSOR, seed=seed, frames=4) for seed in (1, 2)]
    for number, half in enumerate(halves):
        write_folders(half, LEVELS, tmp_path / str(number))
    found = receive([tmp_path / "0"], wanted(SENSOR))
    np.testing.assert_array_equal(found.images, halves[0].images)
    assert found.frames == 4
    both = receive([tmp_path / "0", tmp_path / "1"], wanted(SENSOR), exposures=2)
    np.testing.assert_allclose(both.images, (halves[0].images + halves[1].images) / 2, atol=1e-5)
    assert (both.frames, both.reference_frames) == (8, 32)
    line = refused([tmp_path / "0"], wanted(SENSOR, most=3))
    assert "--frames" in line and "1 to 3" in line


def test_a_real_cameras_files_are_turned_and_averaged(files, given):
    images, references, plain = files
    found = receive(images, wanted(SENSOR), references=references, flip=True)
    np.testing.assert_array_equal(found.images, given.images)
    np.testing.assert_allclose(found.references, plain.reshape(3, 5, *SENSOR.camera.shape).mean(axis=1))
    assert (found.frames, found.reference_frames) == (1, 5)
    below = receive(images, wanted(SENSOR), references=references)
    np.testing.assert_array_equal(below.images, given.images[:, :, ::-1])
    many = receive(references[:15], wanted(SENSOR), references=images, exposures=5, flip=True)
    assert (many.frames, many.reference_frames) == (5, 1)


def test_colour_and_deep_pictures(tmp_path):
    """Three channels and 12 bits, which Pillow alone would not read."""
    curves = Efficiency(wavelength_nm=(400.0, 700.0), R=(0.5, 0.5), G=(0.5, 0.5), B=(0.4, 0.4))
    deep = {"bits": 12, "gain_e_per_dn": 11.0}
    design = replace(SENSOR, camera=replace(SENSOR.camera, colour="rgb", quantum_efficiency=curves, **deep))
    taken = pair(design, (2.0,), reference_frames=1)
    images = write_seen_from_below(taken.images, tmp_path, "image", 12)
    plain = write_seen_from_below(taken.references, tmp_path, "plain", 12)
    found = receive(images, wanted(design, (2.0,)), references=plain, flip=True)
    np.testing.assert_array_equal(found.images, taken.images)
    assert found.images.shape == (1, 48, 64, 3)
    line = refused(images, replace(wanted(design, (2.0,)), bits=10), references=plain)
    assert "counts up to" in line and "0 to 1023" in line
    line = refused(images, replace(wanted(design, (2.0,)), colour="mono"), references=plain)
    assert "a picture in colour" in line and "a grey picture" in line


def _png(columns, rows, depth=8, kind=0, data=b"", more=b""):
    def chunk(name, body):
        return struct.pack(">I", len(body)) + name + body + struct.pack(">I", zlib.crc32(name + body))

    head = struct.pack(">IIBBBBB", columns, rows, depth, kind, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + more + chunk(b"IDAT", data) + chunk(b"IEND", b"")


FLAT = zlib.compress(bytes(48 * 65), 1)
# What stands in the place of a picture, and what the line must hold.
FILES = {
    "nothing": (b"", ["not a PNG"]),
    "a text": (b"hello", ["not a PNG"]),
    "a JPEG": (b"\xff\xd8\xff\xe0" + bytes(100), ["not a PNG"]),
    "half a head": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR\0\0", ["0 x 0", "64 x 48"]),
    "another size": (_png(48, 64, data=FLAT), ["48 x 64", "64 x 48"]),
    "a bomb of pixels": (_png(2**31 - 1, 2**31 - 1, data=FLAT), ["2147483647", "64 x 48"]),
    "sixteen bits": (_png(64, 48, 16, data=FLAT), ["16 bits", "8 bits"]),
    "four bits": (_png(64, 48, 4, data=FLAT), ["4 bits", "8 bits"]),
    "colour": (_png(64, 48, 8, 2, data=FLAT), ["in colour", "grey"]),
    "a palette": (_png(64, 48, 8, 3, data=FLAT), []),
    "alpha": (_png(64, 48, 8, 4, data=zlib.compress(bytes(48 * 129))), ["LA", "grey"]),
    "cut short": (_png(64, 48, data=FLAT)[:-30], ["damaged"]),
    "no pixels": (_png(64, 48, data=b""), ["damaged"]),
    "too many bytes": (_png(64, 48, data=FLAT, more=bytes(2**21)), ["more than", "bytes"]),
    "black": (_png(64, 48, data=FLAT), ["100 %", "at 0 counts", "0.5 %"]),
}


@pytest.mark.parametrize("case", FILES)
@pytest.mark.parametrize("place", ["frame", "reference"])
def test_files_that_are_no_picture_of_the_model(case, place, files):
    content, words = FILES[case]
    images, references, _ = files
    (images if place == "frame" else references)[1].write_bytes(content)
    line = refused(images, wanted(SENSOR), references=references)
    assert f"{place.replace('frame', 'image')}-1.png" in line
    assert not [word for word in words if word not in line], line


def test_files_that_are_not_there_or_no_files(files, tmp_path):
    images, references, _ = files
    assert "no such file" in refused(
        [*images[:2], tmp_path / "none.png"], wanted(SENSOR), references=references
    )
    assert "no such file" in refused([*images[:2], "a\0b"], wanted(SENSOR), references=references)
    assert "too long" in refused([*images[:2], "a" * 300], wanted(SENSOR), references=references)
    assert "no such file or folder; allowed a folder" in refused([tmp_path / "none"], wanted(SENSOR))
    assert "a file beside folders" in refused([*images[:2], tmp_path], wanted(SENSOR), references=references)
    import os

    os.mkfifo(tmp_path / "pipe")
    assert "no such file" in refused([*images[:2], tmp_path / "pipe"], wanted(SENSOR), references=references)


def test_wrong_numbers_of_pictures(files, given, tmp_path):
    images, references, _ = files
    model = wanted(SENSOR)
    assert "2 files" in refused(images[:2], model, references=references)
    assert "1, 2, 3 mm" in refused(images[:2], model, references=references)
    assert "no files" in refused(images, model)
    assert "4 files" in refused(images, model, references=references[:4])
    assert "2 for each" in refused(images, model, references=references, exposures=2)
    assert "--frames" in refused(images, model, references=references, exposures=0)
    assert "which is a FRAME too" in refused(images, model, references=images)
    folders = write_folders(given, LEVELS, tmp_path / "frames")
    assert "2 frames" in refused(folders[:2], model)
    assert "2 at 1 mm" in refused([folders[0], *folders[:2]], model)
    assert "--reference" in refused(folders, model, references=references)
    assert "--flip" in refused(folders, model, flip=True)
    assert "FRAME" in refused([], model)
    assert "without frame.json" in refused([tmp_path], model)


def test_exposures_of_other_presses_are_not_averaged(files):
    images, references, _ = files
    mixed = [references[0], references[5], references[10]] * 2  # level by level, not press by press
    line = refused(mixed, wanted(SENSOR), references=images, exposures=2)
    assert "counts (rms) from" in line and "one press" in line


def test_copies_of_an_exposure_are_no_exposures(given, tmp_path):
    """They would count as so many, and halve the noise that is believed."""
    one = write_folders(given, LEVELS, tmp_path / "a")
    two = write_folders(given, LEVELS, tmp_path / "b")
    assert "the same picture as" in refused([*one, *two], wanted(SENSOR), exposures=2)
    images = write_seen_from_below(given.images, tmp_path, "image", 8)
    plain = write_seen_from_below(given.references, tmp_path, "reference", 8)
    twice = [place for place in images for _ in range(2)]
    assert "the same picture as" in refused(twice, wanted(SENSOR), references=plain, exposures=2)


def test_saturated_pictures(given, tmp_path):
    bright = np.minimum(given.images * 4, 255)
    images = write_seen_from_below(bright, tmp_path, "image", 8)
    references = write_seen_from_below(given.references, tmp_path, "reference", 8)
    line = refused(images, wanted(SENSOR), references=references)
    assert "% of its pixels at the last count, 255" in line and "shorter exposure" in line


RECORDS = {
    "no JSON": ("{", "no JSON"),
    "deep": ("[" * 100_000, "no JSON"),
    "a list": ("[1, 2]", "a table"),
    "no press": ("{}", "press.indentation_mm"),
    "a press of nothing": ('{"press": {"indentation_mm": NaN}}', "press.indentation_mm"),
    "another press": ('{"press": {"indentation_mm": 1.4}}', "1, 2, 3 mm"),
    "exposures of nothing": ('{"press": {"indentation_mm": 1}, "tsis": {"frames": 0}}', "tsis.frames"),
    "other files": ('{"press": {"indentation_mm": 1}, "sha256": {}}', "image.png"),
    "huge": (" " * 2**20 + "{}", "more than"),
}


@pytest.mark.parametrize("case", RECORDS)
def test_records_that_are_none(case, given, tmp_path):
    text, word = RECORDS[case]
    folders = write_folders(given, LEVELS, tmp_path)
    (folders[0] / "frame.json").write_text(text)
    assert word in refused(folders, wanted(SENSOR))


def test_damaged_files_of_a_frame(given, tmp_path):
    folders = write_folders(given, LEVELS, tmp_path)
    place = folders[1] / "reference.exr"
    kept = place.read_bytes()
    place.write_bytes(kept[:-50] + bytes(50))
    assert "not the one written" in refused(folders, wanted(SENSOR))
    place.unlink()
    assert "no such file" in refused(folders, wanted(SENSOR))


@pytest.mark.parametrize(
    ("planes", "word"),
    [
        ({"counts": np.full((48, 64), np.nan, np.float32)}, "counts that no camera gives"),
        ({"counts": np.full((48, 64), 300, np.float32)}, "0 to 255"),
        ({"counts": np.ones((48, 65), np.float32)}, "65 x 48"),
        ({"counts.R": np.ones((48, 64), np.float32)}, "counts.R"),
    ],
)
def test_references_that_no_camera_gives(planes, word, given, tmp_path):
    import hashlib

    folders = write_folders(given, LEVELS, tmp_path)
    write_exr(folders[0] / "reference.exr", planes)
    record = json.loads((folders[0] / "frame.json").read_text())
    record["sha256"]["reference.exr"] = hashlib.sha256(
        (folders[0] / "reference.exr").read_bytes()
    ).hexdigest()
    (folders[0] / "frame.json").write_text(json.dumps(record))
    assert word in refused(folders, wanted(SENSOR))


def test_the_fixed_pattern_is_shared_by_a_pair_alone():
    """One camera's pictures share all of it, whatever its noise; turned ones and another camera's none.

    The spread of the share over 9000 pixels is some 1/sqrt(9000) times noise over pattern.
    """
    light = painted_light(SENSOR, LEVELS)
    own = real_camera(SENSOR, *light, percent=0.0, camera=SENSOR.camera)
    other = real_camera(SENSOR, *light, percent=1.0)
    foreign = real_camera(SENSOR, *light, percent=0.0, camera=other_camera(SENSOR.camera, seed=5))
    assert shared_pattern(own) == pytest.approx(1.0, abs=0.15)
    assert shared_pattern(other) == pytest.approx(1.0, abs=0.15)
    for turn in ((slice(None), slice(None), slice(None, None, -1)), (slice(None), slice(None, None, -1))):
        assert abs(shared_pattern(replace(own, images=own.images[turn]))) < 0.15
    assert abs(shared_pattern(replace(other, references=foreign.references))) < 0.15
    even = replace(SENSOR.camera, prnu_percent=0.0, dsnu_e=0.0)
    assert shared_pattern(real_camera(SENSOR, *light, percent=0.0, camera=even)) == 1.0


def test_pictures_that_are_no_pair_are_refused(given, tmp_path):
    mirrored = replace(given, images=given.images[:, :, ::-1])
    write_folders(mirrored, LEVELS, tmp_path / "mirrored")
    assert "pixel pattern" in refused([tmp_path / "mirrored"], wanted(SENSOR))
    same = replace(given, references=given.images)
    write_folders(same, LEVELS, tmp_path / "same")
    assert "equal to its reference" in refused([tmp_path / "same"], wanted(SENSOR))


def test_a_card_says_what_is_wanted():
    card = {"shape": [48, 64], "bits": 8, "colour": "mono", "indentation_mm": [1, 2, 3], "frames": [1, 100]}
    assert wanted_of(json.loads(json.dumps(card))) == wanted(SENSOR)
    assert wanted_of({**card, "colour": "rgb"}).planes == (48, 64, 3)
    wrong = {"shape": [48, 64.0], "bits": True, "colour": None, "indentation_mm": [1, "2"], "frames": [5, 1]}
    for name, value in wrong.items():
        with pytest.raises(DesignError, match=f"card of the model: {name}: received"):
            wanted_of({**card, name: value})


def test_grey_pictures_for_a_camera_of_colour(tmp_path):
    for number in range(2):
        Image.new("L", (64, 48), 100).save(tmp_path / f"{number}.png")
    model = replace(wanted(SENSOR, (2.0,)), colour="rgb")
    assert "a grey picture" in refused([tmp_path / "0.png"], model, references=[tmp_path / "1.png"])
    write_png(tmp_path / "0.png", np.full((48, 64, 3), 90, np.uint8))
    assert "a grey picture" in refused([tmp_path / "0.png"], model, references=[tmp_path / "1.png"])
