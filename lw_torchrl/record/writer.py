"""Where a recording goes: to a file and to a viewer, by a thread each half second, that stops nobody who logs.

Rerun's own file sink is not used, for a flush never returns where its disk is full (tests/record/test_survival.py holds
that ours does), nor its connection, which waits for a viewer, seconds at each call.
"""

import os
import re
import shutil
import socket
import struct
import threading
from collections.abc import Callable
from itertools import count
from pathlib import Path
from queue import SimpleQueue

from lw_torchrl._files import AnyPath, replacing
from lw_torchrl.record.conventions import rr
from lw_torchrl.record.recording_file import copy_recording

PERIOD = 0.5  # seconds between two writes: with them done, a kill loses less than a second of what was logged
ENCODE_SECONDS = 60.0
MOST_COMPACTED = 256 * 2**20
"""Bytes up to which a recording is made compact when it is closed; it is read whole for that."""
HEADER_BYTES, MESSAGE = 12, struct.Struct("<QQ")
"""The form of a rerun stream: a header, messages that begin with their kind and the length of what follows, an end."""
END = MESSAGE.pack(0, 0)
DEFAULT_PORT = 9876
PROBE_SECONDS, SEND_SECONDS, CLOSE_SECONDS = 0.5, 5.0, 1.0
WAITING_BYTES = 256 * 2**20  # what may wait for a viewer that is slower than the recording grows

_URL = re.compile(r"(?:(?P<scheme>rerun(?:\+https?)?)://)?(?P<host>\[[^]]+\]|[^/:\s]+)(?::(?P<port>\d+))?(?P<end>/.*)?")


class RecordingWriter:
    """A rerun stream and where it goes: to memory first, so that no file and no viewer holds up rerun.

    ``prepare`` is called before each write, in whatever thread it is; it sends what the writer's owner holds back.
    ``recording_id`` is of the recording in the file that is gone on with; None for a new one.
    """

    def __init__(
        self,
        path: Path | None,
        connect: str | None,
        application_id: str,
        name: str,
        prepare: Callable[[], None],
        recording_id: str | None = None,
    ) -> None:
        self._file = None if path is None else RecordingFile(path, resume=recording_id is not None)
        self.previous = None if self._file is None else self._file.previous
        self._prepare = prepare
        self.troubles: list[str] = []
        self._lock, self._stop = threading.RLock(), threading.Event()
        self._closed = self._file_lost = self._viewer_lost = False
        self.stream = rr.RecordingStream(application_id, recording_id=recording_id)
        self.stream.set_log_time_enabled(False)
        self.stream.set_log_tick_enabled(False)
        self._pieces = rr.binary_stream(self.stream)
        self.stream.send_recording_name(name)
        self._viewer = None if connect is None else LiveViewer(connect, application_id, self.stream.get_recording_id())
        self._thread = threading.Thread(target=self._run, name=f"writer of {name}", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(PERIOD):
            self.write()

    def write(self, timeout: float | None = None) -> None:
        """Write what waits to the file, and have it sent to the viewer; ``timeout`` is for rerun's part of it."""
        with self._lock:
            if self._closed:
                return
            try:
                self._prepare()
                self.stream.flush(timeout_sec=ENCODE_SECONDS if timeout is None else timeout)
            except Exception as error:
                self.troubles.append(f"something could not be recorded: {type(error).__name__}: {error}")
            piece = self._pieces.read(flush=False)
            if piece and self._file is not None and not self._file_lost:
                try:
                    self._file.append(piece)
                except OSError as error:
                    self._file_lost = True
                    self.troubles.append(
                        f"recording {str(self._file.path)!r} takes nothing more ({error.strerror}); what was written "
                        "before can be viewed, what comes is not recorded"
                    )
            if piece and self._viewer is not None:
                self._viewer.send(piece)

    def close(self, timeout: float | None = None, *, discard: bool = False) -> None:
        """Write the rest and end the file; or drop all, and an older file of that name gets it back."""
        with self._lock:
            if self._closed:
                return
            if not discard:
                self.write(timeout)
            self._closed = True
            self._stop.set()
            self.stream.disconnect()
            self._pieces.read(flush=False)  # else rerun complains of what is dropped
            if self._file is not None and discard:
                self._file.discard()
            elif self._file is not None:
                try:
                    self._file.close(compact=not self._file_lost)
                except (OSError, ValueError) as error:
                    self.troubles.append(f"recording {str(self._file.path)!r} got no index: {error}")
        if self._viewer is not None:
            self._viewer.close(timeout)

    def take_troubles(self) -> list[str]:
        """What went wrong since the last call."""
        viewer = self._viewer
        if viewer is not None and viewer.trouble is not None and not self._viewer_lost:
            self._viewer_lost = True
            rest = "nothing more is recorded"
            if self._file is not None and not self._file_lost:
                rest = f"the recording goes on in {str(self._file.path)!r}"
            self.troubles.append(f"the viewer at {viewer.url} {viewer.trouble}; {rest}")
        taken, self.troubles = self.troubles, []
        return taken


class RecordingFile:
    """A file that grows by pieces of a rerun stream; between two of them, it is a recording that any viewer opens.

    An older file of its name, unless it is empty, is set aside as ``previous``, "run.previous.rrd" say; or else, with
    ``resume``, pieces are added to its own, in the place of its index.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        self.path = path
        path.parent.mkdir(parents=True, exist_ok=True)
        self.previous: Path | None = None
        if resume:
            self._length = cut_to_messages(path)
            self._file = os.open(path, os.O_RDWR)
            return
        if path.is_file() and path.stat().st_size:
            names = (f"{path.stem}.previous{'' if i == 1 else f'-{i}'}{path.suffix}" for i in count(1))
            self.previous = next(free for name in names if not (free := path.with_name(name)).exists())
            os.rename(path, self.previous)
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC, 0o666)
        except OSError:
            self._put_back()
            raise
        self._length = 0

    def append(self, piece: bytes) -> None:
        """Add the messages of a piece, in the place of the end, and an end; after an OSError the file is as before."""
        if not self._length:
            self._write(piece[:HEADER_BYTES], 0)
            self._length = HEADER_BYTES
        end = HEADER_BYTES
        while MESSAGE.unpack_from(piece, end)[0] != 0:
            end += MESSAGE.size + MESSAGE.unpack_from(piece, end)[1]
        try:
            self._write(piece[HEADER_BYTES:end] + END, self._length)
            self._length += end - HEADER_BYTES
        except OSError:
            os.ftruncate(self._file, self._length)
            self._write(END, self._length)
            raise

    def _write(self, content: bytes, place: int) -> None:
        view = memoryview(content)
        while view:
            written = os.pwrite(self._file, view, place)
            view, place = view[written:], place + written

    def close(self, compact: bool) -> None:
        """End the file; where there is room for another of its size it is made compact, with an index."""
        if not self._close():
            return
        room = shutil.disk_usage(self.path.parent).free > 2 * self._length + 2**20
        if compact and room and self._length <= MOST_COMPACTED:
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


def cut_to_messages(path: Path) -> int:
    """Leave of a recording the messages that are there as a whole, and an end; returns where this is, in bytes."""
    size, place = path.stat().st_size, HEADER_BYTES
    with path.open("r+b") as file:
        while True:
            file.seek(place)
            head = file.read(MESSAGE.size)
            kind, length = MESSAGE.unpack(head) if len(head) == MESSAGE.size else (0, 0)
            if kind == 0 or place + MESSAGE.size + length > size:
                break
            place += MESSAGE.size + length
        file.seek(place)
        file.write(END)
        file.truncate()
    return place


class LiveViewer:
    """Sends pieces of a recording, joined by its ids, to a viewer. ``trouble`` says what went wrong."""

    def __init__(self, address: str, application_id: str, recording_id: str) -> None:
        self.url, self._host, self._port = check_address(address)
        self._ids = application_id, recording_id
        self._pieces: SimpleQueue[bytes | None] = SimpleQueue()
        self._waiting = 0
        self._lock = threading.Lock()
        self._tried = threading.Event()
        self.trouble: str | None = None
        self._thread = threading.Thread(target=self._run, name="viewer of a RerunLogger", daemon=True)
        self._thread.start()
        # Whether there is a viewer is known at once, or else said at a later call.
        self._tried.wait(PROBE_SECONDS)

    def send(self, piece: bytes) -> None:
        """Have a piece sent; one of a viewer that is lost is dropped."""
        if self.trouble is not None:
            return
        with self._lock:
            self._waiting += len(piece)
        if self._waiting > WAITING_BYTES:
            self.trouble = f"takes less than comes; {WAITING_BYTES // 2**20} MiB waited for it"
        else:
            self._pieces.put(piece)

    def close(self, timeout: float | None = None) -> None:
        """Wait for what is still to be sent, a second unless told otherwise."""
        self._pieces.put(None)
        self._thread.join(CLOSE_SECONDS if timeout is None else timeout)
        if self._thread.is_alive() and self.trouble is None:
            self.trouble = "was too slow for the end of the recording"

    def _run(self) -> None:
        try:
            # Rerun itself waits for a viewer, seconds at each call; so it is asked only where one listens.
            socket.create_connection((self._host, self._port), PROBE_SECONDS).close()
        except OSError as error:
            self.trouble = f"does not answer ({error.strerror or error})"
            return
        finally:
            self._tried.set()
        application_id, recording_id = self._ids
        stream = rr.RecordingStream(application_id, recording_id=recording_id, send_properties=False)
        try:
            stream.set_sinks(rr.GrpcSink(self.url))
            while self.trouble is None and (piece := self._pieces.get()) is not None:
                stream.log_file_from_contents("piece.rrd", piece)
                stream.flush(timeout_sec=SEND_SECONDS)
                with self._lock:
                    self._waiting -= len(piece)
        except Exception as error:
            self.trouble = self.trouble or f"is gone ({str(error).partition(',')[0]})"
        finally:
            stream.disconnect()


def check_address(address: str) -> tuple[str, str, int]:
    """The URL, host and port of a viewer from "127.0.0.1:9876", "host" or "rerun+http://host:9876/proxy"."""
    found = _URL.fullmatch(address)
    if found is None or found["end"] not in (None, "/", "/proxy") or not 0 < int(found["port"] or 1) < 65536:
        like = "'127.0.0.1:9876' or 'rerun+http://127.0.0.1:9876/proxy'"
        raise ValueError(f"connect must be an address like {like}, got {address!r}")
    port = int(found["port"] or DEFAULT_PORT)
    return f"{found['scheme'] or 'rerun+http'}://{found['host']}:{port}/proxy", found["host"].strip("[]"), port


def check_path(path: AnyPath) -> Path:
    """Return the path that a recording is to have, else raise :class:`ValueError`."""
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
