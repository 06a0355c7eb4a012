"""A recording served as a page: rerun's web viewer and the recording, from one port of this machine."""

from __future__ import annotations

import gzip
import os
from contextlib import AbstractContextManager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from types import TracebackType

from lw_torchrl.record.html import page_of, viewer_script, viewer_wasm
from lw_torchrl.record.opening import find_recording, opened
from lw_torchrl.record.opening_step import opening_step
from lw_torchrl.record.rerun_binary import LOCAL

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
        def do_GET(self) -> None:
            kind, content = files.get(self.path.partition("?")[0], ("", b""))
            if not kind:
                self.send_error(404)
                return
            self.send_response(200)
            self.send_header("Content-Type", kind)
            self.send_header("Content-Length", str(len(content)))
            self.send_header("Cache-Control", "no-store")
            self.end_headers()
            with suppress(ConnectionError):  # the page was closed
                self.wfile.write(content)

        def log_message(self, format: str, *args: object) -> None:
            pass

    return Handler
