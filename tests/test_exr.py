"""Pictures survive the disk bit for bit, and a broken file says so in one line."""

import os
import zlib

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from scenes.exr import ImageError, read_exr, read_exr_header, read_png, write_exr, write_png

SHAPE = (49, 77)  # rows are no multiple of the 16 of a ZIP block


@pytest.fixture
def planes() -> dict[str, np.ndarray]:
    rng = np.random.Generator(np.random.Philox(1))
    names = ["led.0", "led.1", "led.10", "pressure", "displacement.z", "led.2.R", "led.2.G", "led.2.B"]
    found = {name: rng.standard_normal(SHAPE).astype(np.float32) for name in names}
    found["pressure"][:2, :4] = [[0.0, -0.0, np.inf, -np.inf], [1e-45, 3.4e38, 1 / 3, -1e-38]]
    return found


def test_exr_round_trip_is_bit_exact_with_names_and_text(tmp_path, planes):
    write_exr(tmp_path / "frame.exr", planes, {"design": "tsis", "unit": "W m-2 sr-1, µm"})
    back = read_exr(tmp_path / "frame.exr")
    assert set(back) == set(planes)
    for name, plane in planes.items():
        assert back[name].dtype == np.float32 and back[name].tobytes() == plane.tobytes()
    assert read_exr_header(tmp_path / "frame.exr") == {"design": "tsis", "unit": "W m-2 sr-1, µm"}


def test_exr_accepts_any_memory_order(tmp_path, planes):
    plane = planes["led.0"]
    write_exr(tmp_path / "a.exr", {"f": np.asfortranarray(plane), "t": plane[::-1, ::-1]})
    back = read_exr(tmp_path / "a.exr")
    np.testing.assert_array_equal(back["f"], plane)
    np.testing.assert_array_equal(back["t"], plane[::-1, ::-1])


def test_exr_leaves_the_callers_arrays_alone(tmp_path, planes):
    write_exr(tmp_path / "a.exr", planes)
    assert all(isinstance(plane, np.ndarray) for plane in planes.values())


def test_exr_is_readable_by_openexr_itself(tmp_path, planes):
    write_exr(tmp_path / "a.exr", planes)
    with OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True) as file:
        np.testing.assert_array_equal(file.channels()["led.10"].pixels, planes["led.10"])


def test_exr_bytes_do_not_depend_on_time_or_order(tmp_path, planes):
    write_exr(tmp_path / "a.exr", planes, {"a": "1", "b": "2"})
    write_exr(tmp_path / "b.exr", dict(reversed(planes.items())), {"b": "2", "a": "1"})
    assert (tmp_path / "a.exr").read_bytes() == (tmp_path / "b.exr").read_bytes()


@pytest.mark.parametrize("keep", [0, 3, 4, 60, 300, 700, 0.5, -1])
def test_exr_cut_short_is_one_line_and_silent(tmp_path, planes, capfd, keep):
    write_exr(tmp_path / "a.exr", planes)
    data = (tmp_path / "a.exr").read_bytes()
    (tmp_path / "a.exr").write_bytes(data[: int(keep * len(data)) if isinstance(keep, float) else keep])
    with pytest.raises(ImageError, match=r"a\.exr.*(cut short|not an EXR)") as caught:
        read_exr(tmp_path / "a.exr")
    assert "\n" not in str(caught.value)
    assert capfd.readouterr() == ("", "")


def test_exr_damaged_inside_is_an_error(tmp_path):
    write_exr(tmp_path / "a.exr", {"smooth": np.add.outer(*map(np.arange, SHAPE)).astype(np.float32)})
    data = bytearray((tmp_path / "a.exr").read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200] = bytes(200)  # inside a block that is compressed, so has a check sum
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(ImageError, match="damaged"):
        read_exr(tmp_path / "a.exr")


def test_random_damage_never_escapes_as_another_error(tmp_path, planes):
    write_exr(tmp_path / "a.exr", planes)
    data = (tmp_path / "a.exr").read_bytes()
    rng = np.random.Generator(np.random.Philox(2))
    for _ in range(200):
        broken = bytearray(data)
        broken[rng.integers(4, 900)] = rng.integers(256)
        (tmp_path / "b.exr").write_bytes(broken)
        try:
            read_exr(tmp_path / "b.exr")
        except ImageError as error:
            assert "\n" not in str(error)


@pytest.mark.parametrize("data", [b"", b"hello " * 100, b"\x89PNG\r\n\x1a\n" + bytes(100)])
def test_what_is_not_exr_is_said(tmp_path, data):
    (tmp_path / "a.exr").write_bytes(data)
    with pytest.raises(ImageError, match="not an EXR file"):
        read_exr(tmp_path / "a.exr")


@pytest.mark.parametrize("read", [read_exr, read_exr_header, read_png])
def test_missing_file_is_one_line(tmp_path, read):
    with pytest.raises(ImageError, match="cannot be read") as caught:
        read(tmp_path / "none")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("channels", "header"),
    [
        ({}, {}),
        ({"a": np.zeros(SHAPE)}, {}),
        ({"a": np.zeros((3, 4, 3), np.float32)}, {}),
        ({"a": np.zeros((0, 4), np.float32)}, {}),
        ({"": np.zeros(SHAPE, np.float32)}, {}),
        ({"a": np.zeros(SHAPE, np.float32), "b": np.zeros((3, 4), np.float32)}, {}),
        ({"a": np.zeros(SHAPE, np.float32)}, {"compression": "none"}),
        ({"a": np.zeros(SHAPE, np.float32)}, {"size": 3}),
    ],
)
def test_exr_refuses_what_it_cannot_keep(tmp_path, channels, header):
    with pytest.raises(ImageError) as caught:
        write_exr(tmp_path / "a.exr", channels, header)
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_round_trip_and_same_bytes(tmp_path, dtype):
    rng = np.random.Generator(np.random.Philox(3))
    image = rng.integers(0, np.iinfo(dtype).max, SHAPE, dtype=dtype, endpoint=True)
    write_png(tmp_path / "a.png", image)
    write_png(tmp_path / "b.png", image[:, ::-1][:, ::-1])
    back = read_png(tmp_path / "a.png")
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, image)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


@pytest.mark.parametrize(
    "image", [np.zeros((3, 4)), np.zeros((3, 4, 2), np.uint8), np.zeros((0, 4), np.uint8)]
)
def test_png_refuses_what_is_not_counts(tmp_path, image):
    with pytest.raises(ImageError, match="uint8 or uint16"):
        write_png(tmp_path / "a.png", image)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colour_png_round_trip_and_damage(tmp_path, dtype):
    rng = np.random.Generator(np.random.Philox(3))
    image = rng.integers(0, np.iinfo(dtype).max, (20, 30, 3), dtype=dtype, endpoint=True)
    write_png(tmp_path / "a.png", image)
    back = read_png(tmp_path / "a.png")
    assert back.dtype == dtype
    np.testing.assert_array_equal(back, image)
    with Image.open(tmp_path / "a.png") as seen:  # an independent reader: 16 bits are cut to 8 there
        np.testing.assert_allclose(np.array(seen), image / (257 if dtype == np.uint16 else 1), atol=1)
    data = (tmp_path / "a.png").read_bytes()
    for broken in (data[: len(data) // 2], data[:60], data[:-30], data[:70] + b"xx" + data[72:]):
        (tmp_path / "b.png").write_bytes(broken)
        with pytest.raises(ImageError) as caught:
            read_png(tmp_path / "b.png")
        assert "\n" not in str(caught.value)


def test_deep_colour_png_with_filtered_lines_is_read(tmp_path):
    """Lines written by Sub and Up of ISO/IEC 15948, section 9.2, as other programs filter them."""
    from scenes.png import _chunk, decode

    image = np.random.Generator(np.random.Philox(5)).integers(0, 65536, (3, 5, 3)).astype(">u2")
    raw = image.view(np.uint8).reshape(3, 5, 6)
    lines = [b"\0" + raw[0].tobytes()]
    lines.append(b"\2" + (raw[1] - raw[0]).tobytes())
    lines.append(b"\1" + np.diff(raw[2], axis=0, prepend=np.zeros((1, 6), np.uint8)).tobytes())
    header = (5).to_bytes(4, "big") + (3).to_bytes(4, "big") + b"\x10\x02\0\0\0"
    parts = ((b"IHDR", header), (b"IDAT", zlib.compress(b"".join(lines))), (b"IEND", b""))
    file = b"\x89PNG\r\n\x1a\n" + b"".join(_chunk(*part) for part in parts)
    np.testing.assert_array_equal(decode(file), image)


def test_bad_png_is_one_line(tmp_path):
    write_png(tmp_path / "a.png", np.arange(3000, dtype=np.uint16).reshape(50, 60))
    data = (tmp_path / "a.png").read_bytes()
    rng = np.random.Generator(np.random.Philox(4))
    noisy = bytearray(data)
    noisy[50:150] = rng.bytes(100)
    for broken in (data[: len(data) // 2], data[:20], data[:40], bytes(noisy)):
        (tmp_path / "b.png").write_bytes(broken)
        with pytest.raises(ImageError, match="damaged PNG") as caught:
            read_png(tmp_path / "b.png")
        assert "\n" not in str(caught.value)
    (tmp_path / "b.png").write_bytes(zlib.compress(b"no"))
    with pytest.raises(ImageError, match="not a PNG"):
        read_png(tmp_path / "b.png")
    Image.new("RGBA", (4, 4)).save(tmp_path / "c.png")
    with pytest.raises(ImageError, match="mode RGBA"):
        read_png(tmp_path / "c.png")


def test_writing_is_all_or_nothing(tmp_path, planes, monkeypatch):
    target = tmp_path / "a.exr"
    write_exr(target, planes)
    before = target.read_bytes()

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ImageError, match="No space left"):
        write_exr(target, {"x": np.zeros(SHAPE, np.float32)})
    assert target.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_writing_where_there_is_no_folder_is_one_line(tmp_path):
    with pytest.raises(ImageError, match="cannot be written"):
        write_png(tmp_path / "none" / "a.png", np.zeros((3, 4), np.uint8))


def test_files_get_ordinary_rights(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((3, 4), np.uint8))
    (tmp_path / "plain").write_bytes(b"")
    assert (tmp_path / "a.png").stat().st_mode == (tmp_path / "plain").stat().st_mode


def test_writing_below_a_file_is_one_line(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    with pytest.raises(ImageError, match="cannot be written"):
        write_png(tmp_path / "file" / "a.png", np.zeros((3, 4), np.uint8))
