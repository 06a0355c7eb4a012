"""A recording served as a page: rerun's web viewer and the recording, from one port of this machine."""

from __future__ import annotations

import gzip
import os
import socket
import threading
from contextlib import AbstractContextManager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

from lw_torchrl._checks import checked
from lw_torchrl.record.html import page_of, viewer_script, viewer_wasm
from lw_torchrl.record.opening import find_recording, opened
from lw_torchrl.record.opening_step import opening_step
from lw_torchrl.record.rerun_binary import LOCAL

ASKING_SECONDS, STALLED_SECONDS = 30.0, 30.0
"""How long a request may take to come as a whole, and each piece of an answer to be taken."""
_PIECE = 65_536

_FETCHED = """const load = async (name) => {
  const answer = await fetch(name + ".gz");
  if (!answer.ok) throw new Error(name + ": " + answer.status);
  return unpack(answer.body);
};"""


class WebPage(AbstractContextManager["WebPage"]):
    """A recording as a page at ``address``, served until :meth:`close`.

    The recording is read once, when the page is made; where it still grows, make another.

    Args:
        path: the .rrd file, or a folder that holds one.
        episode: the tab to open at, by its title or its episode's name; None takes the layout's.
        step: where the time cursor stands; None takes the step that tells most of an episode.
        port: of this machine, 127.0.0.1; 0 takes a free one. Another machine reaches it through a tunnel,
            ``ssh -L 8000:127.0.0.1:PORT``.

    Raises:
        FileNotFoundError: there is no such recording, or rerun is not installed.
        ValueError: the recording is damaged, or has no such tab or step.
        OSError: the port is taken.

    Example:
        >>> with WebPage("runs/demo/rollout.rrd") as page:  # doctest: +SKIP
        ...     print(page.address)
        ...     page.serve()
    """

    @checked
    def __init__(
        self, path: str | os.PathLike[str], *, episode: str | None = None, step: int | None = None, port: int = 0
    ) -> None:
        recording = find_recording(path)
        with opened(recording, episode) as file:
            at = opening_step(file, episode, step)
            data = gzip.compress(file.read_bytes(), 1)
        page = page_of(recording.stem, '<script src="viewer.js"></script>', _FETCHED, at)
        files = {
            "/": ("text/html; charset=utf-8", page.encode()),
            "/viewer.js": ("text/javascript; charset=utf-8", viewer_script().encode()),
            "/wasm.gz": ("application/gzip", viewer_wasm()),
            "/recording.gz": ("application/gzip", data),
        }
        self._server = ThreadingHTTPServer((LOCAL, port), _handler(files))
        self._server.daemon_threads = True
        self.address = f"http://{LOCAL}:{self._server.server_address[1]}/"

    def serve(self) -> None:
        """Answer until Ctrl-C, or until another thread calls :meth:`close`."""
        self._server.serve_forever(poll_interval=0.2)

    def close(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._server.server_close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.server_close()


def _handler(files: dict[str, tuple[str, bytes]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        def setup(self) -> None:
            super().setup()
            self.connection.settimeout(STALLED_SECONDS)
            self._asking = threading.Timer(ASKING_SECONDS, self._end)
            self._asking.daemon = True
            self._asking.start()

        def _end(self) -> None:
            with suppress(OSError):  # it has ended by itself
                self.connection.shutdown(socket.SHUT_RDWR)

        def finish(self) -> None:
            self._asking.cancel()
            with suppress(OSError):  # what is left goes to nobody
                super().finish()

        def do_GET(self) -> None:
            self._asking.cancel()
            kind, content = files.get(self.path.partition("?")[0], ("", b""))
            if not kind:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            with suppress(OSError):  # the page was closed, or takes nothing more
                for start in range(0, len(content), _PIECE):
                    self.wfile.write(content[start : start + _PIECE])

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler
