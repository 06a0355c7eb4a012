"""RecordingWriter: a stream into a file, a viewer or both, written each half second, that stops nobody who logs."""

from __future__ import annotations

import threading
from collections.abc import Callable
from pathlib import Path

from lw_torchrl.record.live import LiveViewer
from lw_torchrl.record.recording_file import RecordingFile

PERIOD = 0.5
"""Seconds between two writes: with them done, a kill loses less than a second of what was logged."""
ENCODE_SECONDS = 60.0


class RecordingWriter:
    """A rerun stream and where it goes. It goes to memory first, so that no file and no viewer holds up rerun.

    Args:
        path: the file; None for none. An older one of that name is set aside.
        connect: the address of a viewer; None for none.
        application_id, name: of the recording.
        prepare: called before each write, in whatever thread it is; sends what its owner holds back.

    Attributes:
        stream: the rerun RecordingStream.
        previous: the older file's new name, or None.
        troubles: what went wrong and was not told yet, one line each; see :meth:`take_troubles`.

    Raises:
        OSError: the file cannot be made.
    """

    def __init__(
        self, path: Path | None, connect: str | None, application_id: str, name: str, prepare: Callable[[], None]
    ) -> None:
        import rerun as rr

        self._file = None if path is None else RecordingFile(path)
        self.previous = None if self._file is None else self._file.previous
        self._prepare = prepare
        self.troubles: list[str] = []
        self._lock, self._stop = threading.RLock(), threading.Event()
        self._closed = self._file_lost = self._viewer_lost = False
        self.stream = rr.RecordingStream(application_id)
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
            if piece:
                self._pass_on(piece)

    def _pass_on(self, piece: bytes) -> None:
        if self._file is not None and not self._file_lost:
            try:
                self._file.append(piece)
            except OSError as error:
                self._file_lost = True
                self.troubles.append(
                    f"recording {str(self._file.path)!r} takes nothing more ({error.strerror}); what was written "
                    "before can be viewed, what comes is not recorded"
                )
        if self._viewer is not None:
            self._viewer.send(piece)

    def close(self, timeout: float | None = None) -> None:
        """Write the rest and end the file."""
        with self._lock:
            if self._closed:
                return
            self.write(timeout)
            self._end()
            if self._file is not None:
                try:
                    self._file.close(indexed=not self._file_lost)
                except (OSError, ValueError) as error:
                    self.troubles.append(f"recording {str(self._file.path)!r} got no index: {error}")
        if self._viewer is not None:
            self._viewer.close(timeout)

    def discard(self) -> None:
        """End without a file; an older one of that name gets it back."""
        with self._lock:
            if self._closed:
                return
            self._end()
            if self._file is not None:
                self._file.discard()
        if self._viewer is not None:
            self._viewer.close()

    def _end(self) -> None:
        self._closed = True
        self._stop.set()
        self.stream.disconnect()
        self._pieces.read(flush=False)  # else rerun complains of what is dropped

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
