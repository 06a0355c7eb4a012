"""A recording as a page: in one file, and served; opened in a browser where there is one."""

from __future__ import annotations

import io
import threading
import urllib.request
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import numpy as np
import pytest
from chromium import Page, find
from PIL import Image
from recordings import PLAN, make_objects, make_rollout

from lw_torchrl.record import RerunLogger, WebPage, web_page, write_html
from lw_torchrl.record.web_page import _escaped, _packed

_TEMPLATE = Path(web_page.__file__).with_name("viewer_page.html")


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    path = tmp_path_factory.mktemp("pages") / "a <b> & c.rrd"
    rollout = make_rollout()
    with RerunLogger(path) as logger:
        logger.log_episode(rollout, task="push", objects=make_objects(rollout), plan=PLAN)
        for step in range(20):
            logger.log_scalar("loss/bc", step % 3, step=step)
    return path


def shows_the_viewer(page):
    """The page has loaded, and its canvas is no empty ground: it has many colours."""
    page.wait_for("document.documentElement.dataset.state", "ready")
    for _ in range(60):
        picture = np.asarray(Image.open(io.BytesIO(page.picture())).convert("RGB"))
        if len(np.unique(picture.reshape(-1, 3), axis=0)) > 200:
            return
        page.value("new Promise(done => setTimeout(done, 500))")
    raise AssertionError("nothing is drawn")


def test_one_file_opens_from_disk(tmp_path, recording):
    file = write_html(recording, tmp_path / "page.html", episode="Metrics")
    assert file.stat().st_size < 11e6
    text = file.read_text("latin-1")
    assert "<title>a &lt;b&gt; &amp; c</title>" in text
    assert "http://" not in text.split("<script>")[0]
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    find()
    with Page(file.as_uri(), tmp_path) as page:
        shows_the_viewer(page)


def stands_at(page, step):
    """The time cursor of the page's viewer, read from the state that it tells of."""
    return page.value(f"standsAt({step})")


@pytest.mark.parametrize(("step", "expected"), [(None, 11), (5, 5), (0, 0)])
def test_a_page_opens_at_the_step_that_tells_most_or_that_was_asked_for(tmp_path, recording, step, expected):
    file = write_html(recording, tmp_path / "page.html", step=step)
    find()
    with Page(file.as_uri(), tmp_path) as page:
        shows_the_viewer(page)
        assert stands_at(page, expected)
        assert not stands_at(page, expected + 1)
        assert b"Skill weights" in bytes(page.value("Array.from(window.viewer.viewer_state())")), (
            "our layout is in force"
        )


def test_a_table_of_episodes_filters_and_leads_to_them(tmp_path):
    find()
    with RerunLogger(tmp_path / "many.rrd") as logger:
        for number in range(4):
            rollout = make_rollout(seed=number)
            rollout["next", "success"] = rollout["next", "success"] & (number != 2)
            logger.log_episode(rollout, task=("push", "reach")[number % 2], objects=make_objects(rollout), plan=PLAN)
    file = write_html(tmp_path / "many.rrd", tmp_path / "page.html")
    shown = "[...document.querySelectorAll('tbody tr')].map((row) => row.dataset.name).join()"
    with Page(file.as_uri() + "#episode=reach&t=7", tmp_path) as page:
        shows_the_viewer(page)
        assert stands_at(page, 7)
        assert page.value(shown) == "push-2,push,reach,reach-2"  # the failed one first
        page.value("document.querySelector('tbody tr').onclick()")
        page.wait_for("location.hash", "#episode=push-2&t=20")
        page.wait_for("standsAt(20)", True)
        assert page.value("document.querySelector('tr.shown').dataset.name") == "push-2"
        page.value("const pick = document.querySelector('select'); pick.value = 'reach'; pick.onchange()")
        assert page.value(shown) == "reach,reach-2"
        # The messages to the viewer, in protobuf.
        assert page.value("text(request(300))") == bytes.fromhex("3207 1a03 08ac02 2801").decode("latin-1")
        assert page.value("text(sign(0))") == "\n\x06\n\x04step\x10\x01\x1a\x00"


def test_a_page_that_a_server_calls_utf_8_reads_its_bytes_once_more(tmp_path, recording):
    find()
    content = write_html(recording, tmp_path / "page.html").read_bytes()

    class Handler(BaseHTTPRequestHandler):
        def do_GET(self):
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.end_headers()
            self.wfile.write(content)

    with ThreadingHTTPServer(("127.0.0.1", 0), Handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        with Page(f"http://127.0.0.1:{server.server_address[1]}/", tmp_path) as page:
            shows_the_viewer(page)
            assert stands_at(page, 11)
        server.shutdown()


def test_bytes_and_packed_bytes_survive_the_page(tmp_path):
    find()
    generator = np.random.default_rng(0)
    noise = generator.integers(0, 256, 5000, dtype=np.uint8).tobytes()
    texts = [bytes(range(256)) * 3, noise, b"a" * 9000, noise[:700] * 4 + b"</script>" * 40, b"x"]
    page_text = _TEMPLATE.read_text("ascii").replace("$unlzma", _TEMPLATE.with_name("unlzma.js").read_text("ascii"))
    script = page_text[page_text.index("<script>") : page_text.index("// Only viewer_control")] + "</script>"
    parts = b"".join(b'<script type="text/plain" id="p%d">' % i + _escaped(_packed(one)) + b"</script>"
                     for i, one in enumerate(texts))  # fmt: skip
    head = b'<meta charset="windows-1252"><div id="note"></div>'
    (tmp_path / "page.html").write_bytes(head + parts + script.encode())
    with Page((tmp_path / "page.html").as_uri(), tmp_path) as page:
        for i, one in enumerate(texts):
            unpacked = f"unlzma(unescaped(document.getElementById('p{i}').textContent), {len(one)})"
            page.wait_for("typeof unescaped", "function")
            assert bytes(page.value(f"Array.from({unpacked})")) == one


def test_a_page_is_served_until_it_is_closed(tmp_path, recording):
    page = WebPage(recording)
    server = threading.Thread(target=page.serve)
    server.start()
    try:
        assert page.address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(page.address, timeout=20) as answer:
            assert b'<canvas id="viewer">' in answer.read()
        with pytest.raises(urllib.error.HTTPError, match="404"):
            urllib.request.urlopen(page.address + "../etc/passwd", timeout=20)
        find()
        with Page(page.address, tmp_path) as browser:
            shows_the_viewer(browser)
    finally:
        page.close()
        server.join(20)
    assert not server.is_alive()
    with pytest.raises(OSError, match="refused"):
        urllib.request.urlopen(page.address, timeout=5)


def test_a_page_shows_itself_in_a_notebook(recording):
    page = WebPage(recording)
    try:
        shown = page._repr_html_()
        assert f'<iframe src="{page.address}"' in shown
        assert page._repr_html_() == shown, "and is served once"
        with urllib.request.urlopen(page.address, timeout=20) as answer:
            assert answer.status == 200
    finally:
        page.close()


def test_wrong_pages_are_named(tmp_path, recording):
    with pytest.raises(ValueError, match=r"page must end in '\.html', got "):
        write_html(recording, tmp_path / "page.htmx")
    with pytest.raises(ValueError, match="episode must be one of 'push', 'Metrics', got 'pusch'; did you mean 'push'"):
        write_html(recording, tmp_path / "page.html", episode="pusch")
    with pytest.raises(FileNotFoundError, match="there is no recording"):
        WebPage(tmp_path / "none.rrd")
    assert not list(Path(tmp_path).iterdir())
