"""The form of a recording's file as far as it must be known: a header, messages with their lengths, an end."""

from __future__ import annotations

import os
import shutil
import struct
from pathlib import Path
from typing import BinaryIO

MAGIC, HEADER_BYTES = b"RRF", 12
MESSAGE = struct.Struct("<QQ")
"""What a message begins with: its kind, 0 for the end of the stream, and the length of what follows."""
END = MESSAGE.pack(0, 0)
FOOTER = b"RRF2FOOT"
"""In the last bytes of a recording that was closed and has an index; a writer that was killed leaves none."""


def end_of_messages(stream: BinaryIO) -> int:
    """Where the last whole message of a stream ends."""
    size = stream.seek(0, os.SEEK_END)
    place = HEADER_BYTES
    while place + MESSAGE.size <= size:
        stream.seek(place)
        kind, length = MESSAGE.unpack(stream.read(MESSAGE.size))
        if kind == 0 or place + MESSAGE.size + length > size:
            break
        place += MESSAGE.size + length
    return place


def is_whole(path: Path) -> bool:
    """Whether the recording was closed by its writer, and has an index."""
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - 32))
        return FOOTER in file.read()


def mend(source: Path, target: Path) -> None:
    """Write the whole messages of a recording that was cut, and an end."""
    with source.open("rb") as file, target.open("wb") as mended:
        end = end_of_messages(file)
        file.seek(0)
        shutil.copyfileobj(file, mended)
        mended.truncate(end)
        mended.seek(end)
        mended.write(END)
