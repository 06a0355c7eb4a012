"""A recording as a page of rerun's web viewer: in one file that opens from disk, or served by this machine."""

from __future__ import annotations

import base64
import gzip
import html
import json
import socket
import threading
import time
import urllib.request
import warnings
from contextlib import AbstractContextManager, suppress
from functools import cache
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from string import Template
from urllib.error import URLError

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl.record.conventions import EPISODE_TIMELINE
from lw_torchrl.record.recording_file import LOCAL, failure, find_recording, free_port, opened, opening_step, running

LARGE = 30 * 10**6
START_SECONDS = 60.0

ASKING_SECONDS, STALLED_SECONDS = 30.0, 30.0
"""How long a request may take to come as a whole, and each piece of an answer to be taken."""
_PIECE = 65_536


@checked
def write_html(path: AnyPath, page: AnyPath, *, episode: str | None = None, step: int | None = None) -> Path:
    """Write a recording as one page to send to somebody: it opens from disk, without a network.

    Some 20 MB of viewer, and the recording, compressed. It wants WebGL 2 or WebGPU. The rest is as :func:`open_viewer`.

    Args:
        page: the .html file; it is replaced whole or not at all.

    Returns:
        The page's path.

    Example:
        >>> write_html("runs/demo/rollout.rrd", "rollout.html")  # doctest: +SKIP
    """
    recording, target = find_recording(path), Path(page)
    if target.suffix not in (".html", ".htm"):
        raise ValueError(f"page must end in '.html', got {str(target)!r}")
    with opened(recording, episode) as file:
        at = opening_step(file, episode, step)
        data = {"recording": gzip.compress(file.read_bytes(), 6)}
    script, data["wasm"] = _viewer_files()
    script = script.replace("</script", "<\\/script")
    texts = {name: base64.b64encode(content).decode() for name, content in data.items()}
    parts = [f'<script type="text/plain" id="{name}">{content}</script>' for name, content in texts.items()]
    text = _page(recording.stem, "\n".join([f"<script>{script}</script>", *parts]), at)
    with replacing(target) as file:
        file.write_text(text, encoding="utf-8")
    if len(text) > LARGE:
        warnings.warn(f"{str(target)!r} has {len(text) / 1e6:.0f} MB; fewer episodes make it lighter", stacklevel=2)
    return target


class WebPage(AbstractContextManager["WebPage"]):
    """A recording as a page at ``address``, served until :meth:`close`.

    The recording is read once; where it still grows, make another page. In a notebook, a page that is the last value of
    a cell shows itself, while the kernel runs. The rest is as for :func:`open_viewer`.

    Args:
        port: of this machine, 127.0.0.1; 0 takes a free one. Another machine reaches it through a tunnel,
            ``ssh -L 8000:127.0.0.1:PORT``.

    Raises:
        OSError: the port is taken.

    Example:
        >>> with WebPage("runs/demo/rollout.rrd") as page:  # doctest: +SKIP
        ...     print(page.address)
        ...     page.serve()
    """

    @checked
    def __init__(self, path: AnyPath, *, episode: str | None = None, step: int | None = None, port: int = 0) -> None:
        recording = find_recording(path)
        with opened(recording, episode) as file:
            at = opening_step(file, episode, step)
            data = gzip.compress(file.read_bytes(), 1)
        script, wasm = _viewer_files()
        page = _page(recording.stem, '<script src="viewer.js"></script>', at)
        files = {
            "/": ("text/html; charset=utf-8", page.encode()),
            "/viewer.js": ("text/javascript; charset=utf-8", script.encode()),
            "/wasm.gz": ("application/gzip", wasm),
            "/recording.gz": ("application/gzip", data),
        }
        self._server = ThreadingHTTPServer((LOCAL, port), _handler(files))
        self._server.daemon_threads = True
        self.address = f"http://{LOCAL}:{self._server.server_address[1]}/"
        self._shown = False

    def serve(self) -> None:
        """Answer until Ctrl-C, or until another thread calls :meth:`close`."""
        self._server.serve_forever(poll_interval=0.2)

    def _repr_html_(self) -> str:
        if not self._shown:
            self._shown = True
            threading.Thread(target=self.serve, daemon=True).start()
        return f'<iframe src="{self.address}" width="100%" height="700" style="border: 0"></iframe>'

    def close(self) -> None:
        """Answer no more."""
        self._server.shutdown()
        self._server.server_close()

    def __exit__(self, *error: object) -> None:
        self._server.server_close()


def _handler(files: dict[str, tuple[str, bytes]]) -> type[BaseHTTPRequestHandler]:
    class Handler(BaseHTTPRequestHandler):
        timeout = STALLED_SECONDS

        def setup(self) -> None:
            super().setup()
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


def _page(title: str, data: str, step: int | None) -> str:
    template = Template(Path(__file__).with_name("viewer_page.html").read_text(encoding="utf-8"))
    quoted = json.dumps(title).replace("<", "\\u003c")
    cursor = json.dumps(None if step is None else {"request": list(request(step)), "sign": list(sign(step))})
    return template.substitute(title=html.escape(title), title_json=quoted, data=data, cursor=cursor)


@cache
def _viewer_files() -> tuple[str, bytes]:
    """The installed rerun's web viewer, as rerun serves it: JavaScript, and WebAssembly, gzipped."""
    port = free_port()
    # No proxy stands between this machine and itself.
    get = urllib.request.build_opener(urllib.request.ProxyHandler({})).open
    arguments = ("--serve-web", "--web-viewer-port", str(port), "--port", str(free_port()))
    with running(*arguments) as (process, output):
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                script = get(f"http://{LOCAL}:{port}/re_viewer.js", timeout=60).read()
                break
            except (URLError, OSError) as error:
                if process.poll() is not None:
                    raise failure(output) from error
                if time.monotonic() > deadline:
                    raise RuntimeError(f"rerun's web viewer did not answer within {START_SECONDS:.0f} s") from error
                time.sleep(0.1)
        return script.decode(), gzip.compress(get(f"http://{LOCAL}:{port}/re_viewer_bg.wasm", timeout=60).read(), 6)


# Only ``viewer_control`` sets the cursor of a viewer in a page. It takes a protobuf message, which nothing that a page
# can load writes; so two of rerun 0.41 are spelled out. A viewer that does not know them shows the recording's start.


def request(step: int) -> bytes:
    """The message that asks a viewer for ``step`` of the timeline in force, paused (a ``ViewerControlRequest``)."""
    paused = b"\x28\x01"
    return b"\x32" + _sized(b"\x1a" + _sized(b"\x08" + _varint(step)) + paused)


def sign(step: int) -> bytes:
    """What a viewer's state (a ``GetStateResponse``) holds when its cursor stands at ``step``."""
    timeline = b"\n" + _sized(EPISODE_TIMELINE.encode())
    time = b"\x08" + _varint(step) if step else b""
    return b"\n" + _sized(timeline) + b"\x10\x01\x1a" + _sized(time)


def _sized(message: bytes) -> bytes:
    return _varint(len(message)) + message


def _varint(number: int) -> bytes:
    high, low = divmod(number, 128)
    return bytes([low | 128]) + _varint(high) if high else bytes([low])
