"""A recording as a page of rerun's web viewer: in one file that opens from disk, or served by this machine."""

from __future__ import annotations

import gzip
import html
import json
import lzma
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
from typing import Any
from urllib.error import URLError

from lw_torchrl._checks import checked
from lw_torchrl._files import AnyPath, replacing
from lw_torchrl._progress import Progress
from lw_torchrl.record.conventions import EPISODE_TIMELINE
from lw_torchrl.record.recording_file import (
    LOCAL,
    failure,
    find_recording,
    free_port,
    layouts,
    opened,
    opening_step,
    running,
)

LARGE = 30 * 10**6
START_SECONDS = 60.0

ASKING_SECONDS, STALLED_SECONDS = 30.0, 30.0
"""How long a request may take to come as a whole, and each piece of an answer to be taken."""
_PIECE = 65_536


@checked
def write_html(path: AnyPath, page: AnyPath, *, episode: str | None = None, step: int | None = None) -> Path:
    """Write a recording as one page to send to somebody: it opens from disk, without a network.

    Some 10 MB of viewer, and the recording, compressed, which takes a computer ten seconds and a browser a few. It
    wants WebGL 2 or WebGPU. Above the viewer is a table of the episodes, to filter and to click at; the address then
    ends in the episode and its step, ``#episode=push-7&t=33``, for a link. The rest is as :func:`open_viewer`.

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
    script, wasm = _viewer_files()
    data = {"script": (len(script), _packed(script)), "wasm": (len(wasm), _packed_viewer())}
    page_text, parts = _page(recording, episode, step)
    data |= {name: (len(content), _packed(content)) for name, content in parts.items()}
    texts = []
    for name, (size, content) in data.items():
        start = f'<script type="text/plain" id="{name}" data-size="{size}">'
        texts.append(start.encode() + _escaped(content) + b"</script>")
    whole = page_text.replace(_DATA, b"\n".join(texts))
    with replacing(target) as file:
        file.write_bytes(whole)
    if len(whole) > LARGE:
        warnings.warn(f"{str(target)!r} has {len(whole) / 1e6:.0f} MB; fewer episodes make it lighter", stacklevel=2)
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
        page, parts = _page(recording, episode, step)
        script, wasm = _viewer_files()
        files = {"/": ("text/html; charset=windows-1252", page.replace(_DATA, b""))}
        for name, content in {"script": script, "wasm": wasm, **parts}.items():
            files[f"/{name}.gz"] = ("application/gzip", gzip.compress(content, 1))
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


_DATA = b"<!-- data -->"


def _page(recording: Path, episode: str | None, step: int | None) -> tuple[bytes, dict[str, bytes]]:
    """The page without its parts, in windows-1252, and of these the recording and the layouts of its tabs."""
    with opened(recording, episode, alone=True) as file:
        tabs, front, pieces = layouts(file)
        first = episode if episode is not None else front
        at = opening_step(file, episode, step)
        data = {"recording": file.read_bytes(), "layouts": pieces}
    here = Path(__file__)
    said = {"title_json": recording.stem, "timeline": EPISODE_TIMELINE, "tabs": tabs, "front": first, "step": at}
    texts = {name: json.dumps(value).replace("<", "\\u003c") for name, value in said.items()}
    texts |= {"title": html.escape(recording.stem), "unlzma": here.with_name("unlzma.js").read_text("ascii")}
    template = Template(here.with_name("viewer_page.html").read_text("ascii"))
    return template.substitute(texts, data=_DATA.decode()).encode("ascii", "xmlcharrefreplace"), data


# What compresses an executable of 43 MB by a factor of 4.5, in a time that one can wait for.
_LZMA: dict[str, Any] = {
    "id": lzma.FILTER_LZMA1,
    "mode": lzma.MODE_NORMAL,
    "mf": lzma.MF_HC4,
    "nice_len": 32,
    "depth": 4,
}
_LZMA |= {"dict_size": 1 << 23, "lc": 4, "lp": 0, "pb": 0}


def _packed(content: bytes, bar: Progress | None = None) -> bytes:
    packer = lzma.LZMACompressor(lzma.FORMAT_ALONE, filters=[_LZMA])
    found = []
    for start in range(0, len(content), 2**20):
        found.append(packer.compress(content[start : start + 2**20]))
        if bar is not None:
            bar.update()
    return b"".join([*found, packer.flush()])


@cache
def _packed_viewer() -> bytes:
    _, wasm = _viewer_files()
    with Progress("packing the viewer", -(-len(wasm) // 2**20), "MiB") as bar:
        return _packed(wasm, bar)


def _escaped(content: bytes) -> bytes:
    """Bytes of windows-1252 that come out of an HTML script as they went in; the page's ``unescaped`` reads them."""
    for byte in b"=<\0\r":
        content = content.replace(bytes([byte]), bytes([ord("="), byte + 64]))
    return content


@cache
def _viewer_files() -> tuple[bytes, bytes]:
    """The installed rerun's web viewer, as rerun serves it: JavaScript, and WebAssembly."""
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
        return script, get(f"http://{LOCAL}:{port}/re_viewer_bg.wasm", timeout=60).read()
