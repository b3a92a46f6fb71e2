"""Pictures on disk: OpenEXR for floats, PNG for counts. The same arrays give the same bytes.

A file appears under its name only when all of it is on the disk (temporary name beside it, flush, fsync,
rename), so a run that is cut off leaves the old file or none. EXR has no checksum of its own: who needs to
know that nobody touched a pixel keeps the file's SHA-256.
"""

from __future__ import annotations

import contextlib
import io
import os
import secrets
import struct
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from . import png

StrPath = str | os.PathLike[str]

# Attributes that describe the pixels themselves (OpenEXR technical introduction, "required attributes").
_OWN = frozenset(
    {"channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name"}
    | {"pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version"}
)


class ImageError(ValueError):
    """A picture that cannot be written or read; one line naming the file and what is wrong."""


def write_exr(
    path: StrPath,
    channels: Mapping[str, NDArray[Any]],
    header: Mapping[str, str] | None = None,
    *,
    half: Collection[str] = (),
) -> None:
    """Write float32 planes, lossless (ZIP, blocks of 16 rows: readable everywhere).

    Parameters
    ----------
    channels : name -> (rows, columns) float32
        All of one shape; names such as ``led.0``, ``pressure``, ``displacement.z``.
    header : name -> text
        Kept beside the pixels; no dates are added.
    half
        Planes to write as half floats where `fits_half` says that this loses nothing that matters.
    """
    path = Path(path)
    if not channels:
        raise ImageError(f"{path}: channels: received none, allowed: at least one")
    planes: dict[str, NDArray[Any]] = {}
    shape: tuple[int, ...] | None = None
    for name, plane in channels.items():
        array = np.asarray(plane)
        shape = array.shape if shape is None else shape
        if array.dtype != np.float32 or array.ndim != 2 or array.size == 0 or array.shape != shape:
            raise ImageError(
                f"{path}: channel {name}: received {array.dtype} {array.shape}, allowed: float32 "
                "(rows, columns), one shape for all"
            )
        if not 1 <= len(name.encode()) <= 255 or "\0" in name:
            raise ImageError(f"{path}: channel name: received {name!r}, allowed: 1 to 255 bytes")
        array = array.astype(np.float16) if name in half and fits_half(array) else array
        planes[name] = np.ascontiguousarray(array)  # OpenEXR 3.5 ignores strides: pixels get scrambled
    text = dict(header or {})
    for key, value in text.items():
        if key in _OWN or not key or not isinstance(value, str):
            raise ImageError(f"{path}: header {key!r}: received {value!r}, allowed: text, under a free name")
    attributes = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **text}
    stream = io.BytesIO()
    OpenEXR.File(attributes, planes, num_threads=0).write(stream)
    write_bytes(path, stream.getvalue())


def flat_planes(layers: Mapping[str, NDArray[np.float32]]) -> dict[str, NDArray[np.float32]]:
    """Return layers of colour, (rows, columns, 3), as NAME.R, NAME.G and NAME.B; others as they are."""
    return {
        f"{name}.{channel}" if channel else name: np.ascontiguousarray(plane)
        for name, layer in layers.items()
        for channel, plane in (
            zip("RGB", np.moveaxis(layer, 2, 0), strict=True) if layer.ndim == 3 else [("", layer)]
        )
    }


def fits_half(plane: NDArray[np.float32]) -> bool:
    """Whether half floats keep a plane: each value within 2^-11 of itself, or of the plane's largest / 1000.

    Half floats have 11 significant bits down to 6.1e-5, so rounding is 0.014 % rms: a camera's pixel of
    45 000 electrons, the best that light can be known by, is uncertain by 0.5 %.
    """
    with np.errstate(over="ignore"):
        rounded = plane.astype(np.float16).astype(np.float32)
    size = np.abs(plane)
    return bool(np.all(np.abs(rounded - plane) <= 2.0**-11 * np.maximum(size, 1e-3 * size.max())))


def read_exr(path: StrPath) -> dict[str, NDArray[np.float32]]:
    """The planes of an EXR file, name -> (rows, columns) float32, in alphabetical order of name.

    Raises ImageError, in one line, for a file that is missing, not EXR, cut short or damaged.
    """
    path = Path(path)
    return {name: plane.astype(np.float32) for name, plane in decode_exr(_read(path), path).items()}


def decode_exr(
    data: bytes, path: StrPath, *, shape: tuple[int, int] | None = None, names: Collection[str] | None = None
) -> dict[str, NDArray[Any]]:
    """The planes of an EXR file's bytes as they are stored, half or float, by alphabet; ``path`` names it.

    With ``shape`` and ``names`` the head is looked at first: pixels of another size, or a channel of another
    name, are refused before anything is unpacked. Raises ImageError in one line.
    """
    _check_blocks(data, path, shape, names)
    try:
        found = OpenEXR.File(io.BytesIO(data), separate_channels=True, num_threads=0).channels()
    except (RuntimeError, ValueError) as error:
        raise ImageError(f"{path}: damaged EXR file (pixels cannot be decoded)") from error
    planes = {name: np.asarray(channel.pixels) for name, channel in sorted(found.items())}
    for name, plane in planes.items():
        if shape is not None and (plane.shape != shape or plane.dtype not in (np.float16, np.float32)):
            what = f"{plane.dtype} {plane.shape}"
            raise ImageError(f"{path}: channel {name}: received {what}, allowed: half or float {shape}")
    return planes


def read_exr_header(path: StrPath) -> dict[str, str]:
    """The text that `write_exr` kept beside the pixels."""
    path = Path(path)
    return decode_exr_header(_read(path), path)


def decode_exr_header(data: bytes, path: StrPath) -> dict[str, str]:
    """The same of a file's bytes; ``path`` names it."""
    _check_blocks(data, path)
    try:
        found = OpenEXR.File(io.BytesIO(data), header_only=True, num_threads=0).header()
    except (RuntimeError, ValueError) as error:
        raise ImageError(f"{path}: damaged EXR file (head cannot be read)") from error
    return {key: value for key, value in sorted(found.items()) if key not in _OWN and isinstance(value, str)}


def read_exr_text(path: StrPath, most: int = 2**20) -> dict[str, str]:
    """The text that `write_exr` kept, read from the file's first bytes only: fast, and blind to the pixels.

    Raises ImageError, in one line, for a file that is missing, not EXR, or with a head of more than `most` bytes.
    """
    try:
        with open(path, "rb") as file:
            data = file.read(2**14)
            while True:
                try:
                    return _head_text(data)
                except (IndexError, struct.error) as error:
                    more = file.read(len(data)) if len(data) < most else b""
                    if not more:
                        raise ImageError(f"{path}: EXR file is cut short or damaged in its head") from error
                    data += more
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error
    except ValueError as error:
        raise error if isinstance(error, ImageError) else ImageError(f"{path}: {error}") from error


def _head_text(data: bytes) -> dict[str, str]:
    """Text attributes of an EXR head; IndexError or struct.error where the bytes end before it does.

    Layout: OpenEXR file layout, "header".
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise ValueError("not an EXR file")
    found, at = {}, 8
    while data[at] != 0:
        name, at = _text(data, at)
        kind, at = _text(data, at)
        (size,) = struct.unpack_from("<i", data, at)
        at += 4
        if size < 0:
            raise ValueError("damaged EXR file (attribute of negative size)")
        if at + size >= len(data):
            raise IndexError(at)
        if kind == b"string" and name.decode("utf-8", "replace") not in _OWN:
            found[name.decode()] = data[at : at + size].decode()
        at += size
    return found


def write_png(path: StrPath, image: NDArray[Any]) -> None:
    """Write counts, (rows, columns) or (rows, columns, 3), uint8 or uint16, as a PNG, grey or RGB."""
    array = np.asarray(image)
    fits = array.ndim == 2 or (array.ndim == 3 and array.shape[2] == 3)
    if array.dtype not in (np.uint8, np.uint16) or not fits or array.size == 0:
        raise ImageError(
            f"{path}: image: received {array.dtype} {array.shape}, allowed: uint8 or uint16, "
            "(rows, columns) or (rows, columns, 3)"
        )
    if array.ndim == 3 and array.dtype == np.uint16:
        write_bytes(path, png.encode(array))
        return
    stream = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(array)).save(stream, format="PNG", compress_level=6)
    write_bytes(path, stream.getvalue())


def read_png(path: StrPath) -> NDArray[Any]:
    """Counts of a PNG, (rows, columns) or (rows, columns, 3), uint8 or uint16.

    Raises ImageError, in one line, for a file that is missing, cut short, not PNG, or neither grey nor RGB.
    """
    path = Path(path)
    return decode_png(_read(path), path)


def decode_png(data: bytes, path: StrPath, *, shape: tuple[int, int] | None = None) -> NDArray[Any]:
    """The same of a PNG file's bytes, refused before it is unpacked where it is not of this (rows, columns).

    ``path`` names the file.
    """
    if not data.startswith(b"\x89PNG\r\n\x1a\n"):
        raise ImageError(f"{path}: not a PNG file")
    if shape is not None:
        # ISO/IEC 15948, 11.2.2: the first chunk is IHDR, and begins with width and height
        columns, rows = struct.unpack(">II", data[16:24]) if len(data) >= 33 else (0, 0)
        if data[12:16] != b"IHDR" or (rows, columns) != shape:
            raise ImageError(f"{path}: received a PNG of {columns} x {rows} pixels, allowed: {_size(shape)}")
    if png.is_deep_colour(data):
        try:
            return png.decode(data)
        except ValueError as error:
            raise ImageError(f"{path}: {error}") from error
    try:
        with Image.open(io.BytesIO(data), formats=["PNG"]) as picture:
            picture.load()
            mode, array = picture.mode, np.array(picture)
    # Pillow reports damage as SyntaxError, struct.error or OSError, depending on which chunk it hits.
    except (OSError, SyntaxError, ValueError, struct.error, Image.DecompressionBombError) as error:
        raise ImageError(f"{path}: damaged PNG file") from error
    if mode in ("L", "RGB"):
        return array.astype(np.uint8)
    if mode in ("I;16", "I;16B", "I"):
        return array.astype(np.uint16)
    raise ImageError(f"{path}: received a PNG of mode {mode}, allowed: grey or RGB of 8 or 16 bits")


def write_bytes(path: StrPath, data: bytes) -> None:
    """Put bytes under a name all at once: readers see the old file or the new one, never a part."""
    path = Path(path)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.{secrets.token_hex(4)}.part")
    try:
        # Not tempfile: it makes files that only their owner may read.
        with open(temporary, "xb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        if isinstance(error, OSError):
            raise ImageError(f"{path}: cannot be written ({error.strerror})") from error
        raise


def _read(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError as error:
        raise ImageError(f"{path}: cannot be read ({error.strerror})") from error


def _size(shape: tuple[int, int]) -> str:
    return f"{shape[1]} x {shape[0]}"


def _check_blocks(
    data: bytes,
    path: StrPath,
    shape: tuple[int, int] | None = None,
    names: Collection[str] | None = None,
) -> None:
    """Take a look at the head and the table of blocks of a single-part scan-line EXR file.

    OpenEXR itself prints to the terminal when a file is cut short; asking first keeps the message to
    one line.
    Layout: OpenEXR file layout, "offset tables" and "scan line blocks".
    """
    if not data.startswith(b"\x76\x2f\x31\x01"):
        raise ImageError(f"{path}: not an EXR file")
    try:
        (version,) = struct.unpack_from("<i", data, 4)
        if version & ~0xFF & ~0x400:  # any flag but "long names": tiles, deep pixels, several parts
            raise ImageError(f"{path}: received a tiled, deep or multi-part EXR, allowed: one scan-line part")
        at, rows, block = 8, 0, 0
        while data[at] != 0:
            name, at = _text(data, at)
            _, at = _text(data, at)
            (size,) = struct.unpack_from("<i", data, at)
            at += 4
            if size < 0:
                raise IndexError(at)
            if name == b"dataWindow":
                left, low, right, high = struct.unpack_from("<4i", data, at)
                rows = high - low + 1
                if shape is not None and (rows, right - left + 1) != shape:
                    received = f"an EXR of {right - left + 1} x {rows} pixels"
                    raise ImageError(f"{path}: received {received}, allowed: {_size(shape)}")
            elif name == b"channels" and names is not None:
                _check_names(data[at : at + size], path, names)
            elif name == b"compression":
                block = {0: 1, 1: 1, 2: 1, 3: 16, 4: 32, 5: 16, 6: 32, 7: 32, 8: 32, 9: 256}.get(data[at], 0)
            at += size
        at += 1
        if rows < 1 or block < 1:
            raise ImageError(f"{path}: damaged EXR file (header without size or known compression)")
        for offset in struct.unpack_from(f"<{-(-rows // block)}Q", data, at):
            _, size = struct.unpack_from("<ii", data, offset)
            if size < 0 or offset + 8 + size > len(data):
                raise ImageError(f"{path}: EXR file is cut short ({len(data)} bytes)")
    except (IndexError, struct.error, OverflowError) as error:
        raise ImageError(f"{path}: EXR file is cut short or damaged ({len(data)} bytes)") from error


def _check_names(channels: bytes, path: StrPath, allowed: Collection[str]) -> None:
    """Refuse a list of channels with names of others, or one twice; 16 bytes follow each name."""
    at, seen = 0, set()
    while channels[at] != 0:
        name, at = _text(channels, at)
        text = name.decode("utf-8", "replace")
        if text not in allowed or text in seen:
            raise ImageError(
                f"{path}: channel: received {text[:60]!r}, allowed: each of {sorted(allowed)} once"
            )
        seen.add(text)
        at += 16


def _text(data: bytes, at: int) -> tuple[bytes, int]:
    end = data.find(b"\0", at, at + 256)
    if end < 0:
        raise IndexError(at)
    return data[at:end], end + 1
