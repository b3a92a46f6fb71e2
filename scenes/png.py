"""PNG of three channels of 16 bits, which Pillow neither writes nor reads without loss (ISO/IEC 15948)."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

_SIGNATURE = b"\x89PNG\r\n\x1a\n"
_LARGEST = 2**28  # pixels of a picture, against files that promise more than a memory holds


def encode(image: NDArray[np.uint16]) -> bytes:
    """The file of a picture, (rows, columns, 3) uint16: every line unfiltered, as Pillow's are not."""
    rows, columns, _ = image.shape
    header = struct.pack(">IIBBBBB", columns, rows, 16, 2, 0, 0, 0)
    lines = np.zeros((rows, 1 + 6 * columns), np.uint8)  # each begins with its filter: none
    lines[:, 1:] = np.ascontiguousarray(image, ">u2").view(np.uint8).reshape(rows, 6 * columns)
    data = zlib.compress(lines.tobytes(), 6)
    return _SIGNATURE + b"".join(
        _chunk(*part) for part in ((b"IHDR", header), (b"IDAT", data), (b"IEND", b""))
    )


def is_deep_colour(data: bytes) -> bool:
    """Whether these bytes begin as a PNG of three channels of 16 bits."""
    return data[:8] == _SIGNATURE and data[12:16] == b"IHDR" and data[24:26] == b"\x10\x02"


def decode(data: bytes) -> NDArray[np.uint16]:
    """The picture of such a file, (rows, columns, 3) uint16; ValueError in one line where it is damaged.

    Lines filtered by Sub or Up are read too; those of Average or Paeth, and interlaced files, are refused.
    """
    packed, at, header = [], 8, b""
    while at + 12 <= len(data):
        (size,) = struct.unpack_from(">I", data, at)
        kind, body = data[at + 4 : at + 8], data[at + 8 : at + 8 + size]
        if len(data) < at + 12 + size or _chunk(kind, body)[-4:] != data[at + 8 + size : at + 12 + size]:
            raise ValueError("damaged PNG file (a part is cut short or its checksum is wrong)")
        if kind == b"IHDR" and not header:  # a second one could promise more pixels than the first
            header = body
        elif kind == b"IDAT":
            packed.append(body)
        at += 12 + size
        if kind == b"IEND":
            break
    if len(header) != 13 or header[12]:
        raise ValueError("received an interlaced or headless PNG, allowed: one that is neither")
    columns, rows = struct.unpack_from(">II", header)
    wanted = rows * (1 + 6 * columns)
    if not 0 < rows * columns <= _LARGEST:
        raise ValueError(f"received a PNG of {columns} x {rows} pixels, allowed: 1 to {_LARGEST}")
    try:
        raw = zlib.decompressobj().decompress(b"".join(packed), wanted)
    except zlib.error as error:
        raise ValueError("damaged PNG file (pixels cannot be unpacked)") from error
    if len(raw) != wanted:
        raise ValueError(f"PNG file is cut short ({len(raw)} of {wanted} bytes of pixels)")
    lines = np.frombuffer(raw, np.uint8).reshape(rows, 1 + 6 * columns)
    picture = lines[:, 1:].reshape(rows, columns, 6).copy()
    for row in np.flatnonzero(lines[:, 0]):
        match int(lines[row, 0]):
            case 1:
                picture[row] = np.cumsum(picture[row], axis=0, dtype=np.uint8)
            case 2:
                picture[row] += picture[row - 1] if row else 0
            case other:
                raise ValueError(f"received a PNG with lines of filter {other}, allowed: 0, 1 and 2")
    return picture.view(">u2").astype(np.uint16)


def _chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
