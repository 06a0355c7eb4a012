"""A recording as one page that needs nothing beside it: rerun's web viewer, and the recording, inside one file."""

from __future__ import annotations

import base64
import gzip
import html
import json
import os
import time
import urllib.request
import warnings
from functools import cache
from pathlib import Path
from string import Template
from urllib.error import URLError

from lw_torchrl._checks import checked
from lw_torchrl._files import replacing
from lw_torchrl.record.cursor import request, sign
from lw_torchrl.record.opening import find_recording, opened
from lw_torchrl.record.opening_step import opening_step
from lw_torchrl.record.rerun_binary import LOCAL, failure, free_port, running

LARGE = 30 * 10**6
START_SECONDS = 60.0

_INSIDE = """const load = (name) => {
  const text = atob(document.getElementById(name).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
  return unpack(new Blob([bytes]).stream());
};"""


@checked
def write_html(
    path: str | os.PathLike[str], page: str | os.PathLike[str], *, episode: str | None = None, step: int | None = None
) -> Path:
    """Write a recording as one page to send to somebody: it opens from disk, without a network.

    The page is some 20 MB of viewer and the recording, compressed. It wants WebGL 2 or WebGPU.

    Args:
        path: the .rrd file, or a folder that holds one.
        page: the .html file; it is replaced whole or not at all.
        episode: the tab to open at, by its title or its episode's name; None takes the layout's.
        step: where the time cursor stands; None takes the step that tells most of an episode.

    Returns:
        The page's path.

    Raises:
        FileNotFoundError: there is no such recording, or rerun is not installed.
        ValueError: the recording is damaged or has no such tab or step, or ``page`` does not end in ".html".

    Example:
        >>> write_html("runs/demo/rollout.rrd", "rollout.html")  # doctest: +SKIP
    """
    recording, target = find_recording(path), Path(page)
    if target.suffix not in (".html", ".htm"):
        raise ValueError(f"page must end in '.html', got {str(target)!r}")
    with opened(recording, episode) as file:
        at = opening_step(file, episode, step)
        data = {"wasm": viewer_wasm(), "recording": gzip.compress(file.read_bytes(), 6)}
    script = viewer_script().replace("</script", "<\\/script")
    inline = [f"<script>{script}</script>"]
    inline += [
        f'<script type="text/plain" id="{name}">{base64.b64encode(content).decode()}</script>'
        for name, content in data.items()
    ]
    text = page_of(recording.stem, "\n".join(inline), _INSIDE, at)
    with replacing(target) as file:
        file.write_text(text, encoding="utf-8")
    if len(text) > LARGE:
        warnings.warn(f"{str(target)!r} has {len(text) / 1e6:.0f} MB; fewer episodes make it lighter", stacklevel=2)
    return target


def page_of(title: str, data: str, load: str, step: int | None) -> str:
    """The page of the viewer, which gets its parts by the JavaScript function ``load`` and opens at ``step``."""
    template = Template((Path(__file__).with_name("viewer_page.html")).read_text(encoding="utf-8"))
    quoted = json.dumps(title).replace("<", "\\u003c")
    cursor = json.dumps(None if step is None else {"request": list(request(step)), "sign": list(sign(step))})
    return template.substitute(title=html.escape(title), title_json=quoted, data=data, load=load, cursor=cursor)


def viewer_script() -> str:
    """The web viewer's JavaScript."""
    return _viewer_files()[0].decode()


def viewer_wasm() -> bytes:
    """The web viewer's WebAssembly, gzipped."""
    return _viewer_files()[1]


@cache
def _viewer_files() -> tuple[bytes, bytes]:
    """The web viewer that the installed rerun carries: it serves it, to this machine alone, and it is asked for it."""
    port = free_port()
    arguments = ("--serve-web", "--web-viewer-port", str(port), "--port", str(free_port()))
    with running(*arguments) as (process, output):
        deadline = time.monotonic() + START_SECONDS
        while True:
            try:
                script = _get(port, "re_viewer.js")
                break
            except (URLError, OSError) as error:
                if process.poll() is not None:
                    raise failure(output) from error
                if time.monotonic() > deadline:
                    raise RuntimeError(f"rerun's web viewer did not answer within {START_SECONDS:.0f} s") from error
                time.sleep(0.1)
        return script, gzip.compress(_get(port, "re_viewer_bg.wasm"), 6)


def _get(port: int, name: str) -> bytes:
    # No proxy stands between this machine and itself.
    opener = urllib.request.build_opener(urllib.request.ProxyHandler({}))
    with opener.open(f"http://{LOCAL}:{port}/{name}", timeout=60) as answer:
        content: bytes = answer.read()
    return content
