"""The file of a recording: it has its name from the start, is whole after each write, and spares an older one."""

from __future__ import annotations

import io
import os
import shutil
from itertools import count
from pathlib import Path

from lw_torchrl._files import replacing
from lw_torchrl.record.copying import copy_recording
from lw_torchrl.record.rrd_stream import END, HEADER_BYTES, end_of_messages

MOST_INDEXED = 256 * 2**20
"""Bytes up to which a recording is made compact and gets an index when it is closed; it is read whole for that."""


class RecordingFile:
    """A file that grows by pieces of a rerun stream; between two of them, it is a recording that any viewer opens.

    Args:
        path: the file's; an older one of that name is set aside.

    Attributes:
        previous: the older file's new name, or None.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self.previous = set_aside(path)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError:
            self._put_back()
            raise
        self._length = 0

    def append(self, piece: bytes) -> None:
        """Add the messages of a piece, in the place of the end, and an end.

        Raises:
            OSError: there is no room; the file is as it was before.
        """
        if not self._length:
            self._write(piece[:HEADER_BYTES], 0)
            self._length = HEADER_BYTES
        try:
            messages = piece[HEADER_BYTES : end_of_messages(io.BytesIO(piece))]
            self._write(messages + END, self._length)
            self._length += len(messages)
        except OSError:
            os.ftruncate(self._file, self._length)
            self._write(END, self._length)
            raise

    def _write(self, content: bytes, place: int) -> None:
        view = memoryview(content)
        while view:
            written = os.pwrite(self._file, view, place)
            view, place = view[written:], place + written

    def close(self, indexed: bool = True) -> None:
        """End the file; where there is room for another of its size it is made compact, with an index."""
        if not self._close():
            return
        room = shutil.disk_usage(self.path.parent).free > 2 * self._length + 2**20
        if indexed and room and self._length <= MOST_INDEXED:
            with replacing(self.path) as copy:
                copy_recording(self.path, copy)

    def discard(self) -> None:
        """Remove the file; an older one gets the name back."""
        if self._close():
            self.path.unlink()
            self._put_back()

    def _close(self) -> bool:
        """Whether the file still has its name: another recording of that name sets it aside, in whatever process."""
        own = os.fstat(self._file)
        os.close(self._file)
        return self.path.exists() and os.path.samestat(own, self.path.stat())

    def _put_back(self) -> None:
        if self.previous is not None:
            os.replace(self.previous, self.path)
            self.previous = None


def check_path(path: str | os.PathLike[str]) -> Path:
    """Return the path that a recording is to have, else raise :class:`ValueError`."""
    if not isinstance(path, (str, os.PathLike)):
        raise TypeError(f"path must be a path, got {path!r} ({type(path).__name__})")
    target = Path(path)
    if target.suffix != ".rrd" or not target.stem:
        raise ValueError(f"path must end in '.rrd', got {str(target)!r}")
    if target.is_dir():
        raise ValueError(f"path must be a file, got the folder {str(target)!r}")
    # The nearest parent that exists decides whether the missing ones can be made.
    nearest = next((parent for parent in target.absolute().parents if parent.exists()), None)
    if nearest is not None and not nearest.is_dir():
        raise ValueError(f"path {str(target)!r} must lie in a folder, but {str(nearest)!r} is a file")
    return target


def set_aside(path: Path) -> Path | None:
    """Give a file that has the name ``path`` another, "run.previous.rrd" or "run.previous-2.rrd"; None: there is none.

    An empty file holds nothing to keep.
    """
    if not path.is_file() or not path.stat().st_size:
        return None
    for number in count(1):
        kept = path.with_name(f"{path.stem}.previous{'' if number == 1 else f'-{number}'}{path.suffix}")
        if not kept.exists():
            os.rename(path, kept)
            return kept
    raise AssertionError
