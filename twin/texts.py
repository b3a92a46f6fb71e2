"""Reading a text file that may be anybody's, no larger than it can be."""

from __future__ import annotations

from pathlib import Path

from twin.complaint import DesignError


def read_text(place: Path, most: int, source: str, kind: str = "a TOML file") -> str:
    """Return the text of a file of at most so many bytes; of a pipe, too.

    Raises
    ------
    DesignError
        One line, for what is longer or not UTF-8.
    OSError
        What cannot be read.
    """
    with open(place, "rb") as file:
        data = file.read(most + 1)  # a device has no size, and no end
    if len(data) > most:
        raise DesignError("the file", f"more than {most} bytes", f"{kind}, at most {most}", source=source)
    try:
        text = data.decode("utf-8-sig")  # Windows editors put a mark first
    except UnicodeDecodeError:
        raise DesignError("the file", "bytes that are not UTF-8 text", kind, source=source) from None
    return text.replace("\r\n", "\n").replace("\r", "\n")
