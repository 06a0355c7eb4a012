"""Show a recording as a web page with rerun's viewer: in one file that opens from disk, or served locally."""

from __future__ import annotations

import gzip
import html
import json
import lzma
import threading
import time
import urllib.request
import warnings
from contextlib import AbstractContextManager
from functools import cache, partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from string import Template
from tempfile import TemporaryDirectory
from typing import Any

from lw_torchrl._util.checks import typed
from lw_torchrl._util.files import AnyPath, replacing
from lw_torchrl._util.progress import Progress
from lw_torchrl.record.entities import EPISODE_TIMELINE
from lw_torchrl.record.tabs import OVERVIEW
from lw_torchrl.record.viewer import (
    LOCAL,
    START_SECONDS,
    failure,
    find_recordings,
    free_port,
    read_recording,
    readable,
    rerun_process,
)

LARGE = 30 * 10**6


@typed
def write_html(path: AnyPath, page: AnyPath, *, episode: str | None = None, step: int | None = None) -> Path:
    """Write a recording as one HTML file that opens from disk, without a network.

    The file holds rerun's viewer, some 10 MB, and the recording, compressed, which takes ten seconds; a browser takes a
    few to open it, and needs WebGL 2 or WebGPU. Above the viewer is a table of the episodes: filter it, or click on an
    episode. The address then ends in the episode and its step, ``#episode=push-7&t=33``, for a link.

    Args:
        path: a .rrd file, or a folder, which stands for its newest recording.
        page: the .html file, whose path is returned.
        episode, step: as for :func:`open_viewer`.

    Example:
        >>> write_html("runs/demo/rollout.rrd", "rollout.html")  # doctest: +SKIP
    """
    target = Path(page)
    if target.suffix not in (".html", ".htm"):
        raise ValueError(f"page must end in '.html', got {str(target)!r}")
    text, parts = _page(find_recordings(path)[-1], episode, step)
    script, wasm = _viewer_files()
    packed = {name: (len(part), _packed(part)) for name, part in {"script": script, **parts}.items()}
    elements = []
    for name, (size, content) in {**packed, "wasm": (len(wasm), _packed_viewer())}.items():
        start = f'<script type="text/plain" id="{name}" data-size="{size}">'
        elements.append(start.encode() + _escaped(content) + b"</script>")
    whole = text.replace(_DATA, b"\n".join(elements))
    with replacing(target) as file:
        file.write_bytes(whole)
    if len(whole) > LARGE:
        warnings.warn(f"{str(target)!r} has {len(whole) / 1e6:.0f} MB; record fewer episodes", stacklevel=2)
    return target


class WebPage(AbstractContextManager["WebPage"]):
    """A page of a recording, as it is when the page is made, served at ``address`` until :meth:`close`.

    In a notebook, a page that is the last value of a cell shows itself, while the kernel runs.

    Args:
        path, episode, step: as for :func:`write_html`.
        port: a port of this machine, 127.0.0.1; 0 takes a free one. Another machine reaches it through a tunnel,
            ``ssh -L 8000:127.0.0.1:PORT``.

    Example:
        >>> with WebPage("runs/demo/rollout.rrd") as page:  # doctest: +SKIP
        ...     print(page.address)
        ...     page.serve()
    """

    @typed
    def __init__(self, path: AnyPath, *, episode: str | None = None, step: int | None = None, port: int = 0) -> None:
        text, parts = _page(find_recordings(path)[-1], episode, step)
        script, wasm = _viewer_files()
        self._folder = TemporaryDirectory()
        folder = Path(self._folder.name)
        (folder / "index.html").write_bytes(text.replace(_DATA, b""))
        for name, content in {"script": script, "wasm": wasm, **parts}.items():
            (folder / f"{name}.gz").write_bytes(gzip.compress(content, 1))
        self._server = ThreadingHTTPServer((LOCAL, port), partial(_QuietHandler, directory=folder))
        self.address = f"http://{LOCAL}:{self._server.server_address[1]}/"
        self._thread: threading.Thread | None = None

    def serve(self) -> None:
        """Serve until Ctrl-C, or until another thread calls :meth:`close`."""
        self._server.serve_forever(poll_interval=0.2)

    def _repr_html_(self) -> str:
        if self._thread is None:
            self._thread = threading.Thread(target=self.serve, daemon=True)
            self._thread.start()
        return f'<iframe src="{self.address}" width="100%" height="700" style="border: 0"></iframe>'

    def close(self) -> None:
        """Stop serving."""
        self._server.shutdown()
        self.__exit__()

    def __exit__(self, *error: object) -> None:
        self._server.server_close()
        self._folder.cleanup()


class _QuietHandler(SimpleHTTPRequestHandler):
    def log_message(self, format: str, *args: object) -> None:
        pass


_DATA = b"<!-- data -->"


def _page(recording: Path, episode: str | None, step: int | None) -> tuple[bytes, dict[str, bytes]]:
    """Return the page without its parts, in windows-1252, and two parts: the recording and the layouts of its tabs."""
    with readable(recording) as file, TemporaryDirectory() as folder:
        reader, known, layout = read_recording(file)
        ids = {"application_id": known.application_id, "recording_id": known.recording_id}
        rows: list[dict[str, Any]] = []
        layouts, data = b"", file
        front = episode
        if layout is not None:
            front = layout.front() if episode is None else layout.tab(episode).name
            step = layout.opening_step(episode) if step is None else step
            data = Path(folder) / "data.rrd"
            reader.stream().write_rrd(data, **ids)  # without its blueprint: the page shows one tab at a time
            for tab in layout.tabs():
                if tab.name != OVERVIEW:  # the page has a table instead
                    piece = Path(folder) / "layout.rbl"
                    layout.blueprint(tab.name).save(known.application_id, str(piece))
                    place = len(layouts), len(layouts) + piece.stat().st_size
                    layouts += piece.read_bytes()
                    row = layout.pages[tab.name].row if tab.name in layout.pages else None
                    about = {"name": tab.name, "title": tab.title, "step": layout.opening_step(tab.name)}
                    rows.append(about | {"row": row, "layout": place})
            rows.sort(key=lambda tab: (tab["row"] or {}).get("ended") != "failed")
        parts = {"recording": data.read_bytes(), "layouts": layouts}
    here = Path(__file__)
    values = {
        "title_json": recording.stem,
        "timeline": EPISODE_TIMELINE,
        "tabs": rows,
        "front": front,
        "step": step,
    }
    texts = {name: json.dumps(value).replace("<", "\\u003c") for name, value in values.items()}
    texts |= {"title": html.escape(recording.stem), "unlzma": here.with_name("unlzma.js").read_text("ascii")}
    template = Template(here.with_name("viewer_page.html").read_text("ascii"))
    return template.substitute(texts, data=_DATA.decode()).encode("ascii", "xmlcharrefreplace"), parts


# These compress an executable of 43 MB by a factor of 4.5 in ten seconds.
_LZMA: dict[str, Any] = {"id": lzma.FILTER_LZMA1, "mode": lzma.MODE_NORMAL, "mf": lzma.MF_HC4, "nice_len": 32}
_LZMA |= {"depth": 4, "dict_size": 1 << 23, "lc": 4, "lp": 0, "pb": 0}


def _packed(content: bytes, bar: Progress | None = None) -> bytes:
    packer, packed = lzma.LZMACompressor(lzma.FORMAT_ALONE, filters=[_LZMA]), b""
    for start in range(0, len(content), 2**20):
        packed += packer.compress(content[start : start + 2**20])
        if bar is not None:
            bar.update()
    return packed + packer.flush()


@cache
def _packed_viewer() -> bytes:
    _, wasm = _viewer_files()
    with Progress("packing the viewer", -(-len(wasm) // 2**20), "MiB") as bar:
        return _packed(wasm, bar)


def _escaped(content: bytes) -> bytes:
    """Escape bytes that an HTML script would change; the page's function ``unescaped`` restores them."""
    for byte in b"=<\0\r":
        content = content.replace(bytes([byte]), bytes([ord("="), byte + 64]))
    return content


@cache
def _viewer_files() -> tuple[bytes, bytes]:
    """Return the web viewer of the installed rerun, JavaScript and WebAssembly, as rerun's program serves it."""
    port = free_port()
    get = urllib.request.build_opener(urllib.request.ProxyHandler({})).open  # no proxy for this machine itself
    with rerun_process("--serve-web", "--web-viewer-port", str(port), "--port", str(free_port())) as (process, output):
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                script = get(f"http://{LOCAL}:{port}/re_viewer.js", timeout=60).read()
                return script, get(f"http://{LOCAL}:{port}/re_viewer_bg.wasm", timeout=60).read()
            except OSError as error:
                if process.poll() is not None or time.monotonic() > deadline:
                    raise failure(output) from error
                time.sleep(0.1)
