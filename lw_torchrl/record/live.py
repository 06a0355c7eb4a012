"""A recording shown in a viewer while it grows, by a thread of its own: no viewer holds up a training."""

from __future__ import annotations

import re
import socket
import threading
from queue import SimpleQueue

DEFAULT_PORT = 9876
PROBE_SECONDS, SEND_SECONDS, CLOSE_SECONDS = 0.5, 5.0, 1.0
WAITING_BYTES = 256 * 2**20
"""What may wait for a viewer that is slower than the recording grows."""

_URL = re.compile(
    r"(?:(?P<scheme>rerun(?:\+https?)?)://)?(?P<host>\[[^]]+\]|[^/:\s]+)(?::(?P<port>\d+))?(?P<rest>/.*)?"
)


def check_address(address: str) -> tuple[str, str, int]:
    """The URL, host and port of a viewer from "127.0.0.1:9876", "host" or "rerun+http://host:9876/proxy"."""
    if not isinstance(address, str):
        raise TypeError(f"connect must be an address like '127.0.0.1:9876', got {address!r}")
    found = _URL.fullmatch(address)
    if found is None or found["rest"] not in (None, "/", "/proxy") or not 0 < int(found["port"] or 1) < 65536:
        raise ValueError(
            f"connect must be an address like '127.0.0.1:9876' or 'rerun+http://127.0.0.1:9876/proxy', got {address!r}"
        )
    port = int(found["port"] or DEFAULT_PORT)
    return f"{found['scheme'] or 'rerun+http'}://{found['host']}:{port}/proxy", found["host"].strip("[]"), port


class LiveViewer:
    """Sends pieces of a recording to a viewer. What goes wrong is said in ``trouble``; nothing is raised.

    Args:
        address: of the viewer, see :func:`check_address`.
        application_id, recording_id: of the recording, by which the viewer joins the pieces.
    """

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
        import rerun as rr

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
