"""The guard before a served model: hostile requests leave it answering; called as an application, and over sockets."""

import asyncio
import json
import select
import signal
import socket
import subprocess
import sys
import time
from http.client import HTTPConnection
from pathlib import Path

import pytest
from chat_requests import ASKED, SCHEMA, WRONG, held_to
from standin_model import app

import lw_torchrl as lw
from lw_torchrl.planners import guard
from lw_torchrl.planners.model_server import local_names


def called(*requests, names=frozenset({"127.0.0.1"})):
    """The statuses of requests at once, each a scope's changes and what comes in, seconds to wait among it."""

    async def one(guarded, changes, coming):
        said, left = [], iter(coming)

        async def receive():
            for message in left:
                if isinstance(message, dict):
                    return message
                await asyncio.sleep(message)
            await asyncio.sleep(60)

        async def send(message):
            said.append(message)

        scope = {"type": "http", "method": "POST", "path": "/v1/chat/completions", "headers": []}
        await guarded(scope | changes, receive, send)
        return said[0]["status"] if said else None

    async def every():
        guarded = guard.Guard(app, "mine", 8192, names)
        return await asyncio.gather(*(one(guarded, *request) for request in requests))

    return asyncio.run(every())


def whole(**fields):
    return {"type": "http.request", "body": json.dumps({**ASKED, **fields}).encode()}


GONE = {"type": "http.disconnect"}


def test_what_is_asked_elsewhere_is_not_found():
    for method, path in (("POST", "/v1/completions"), ("GET", "/docs"), ("PUT", "/v1/models"), ("POST", "//evil/v1")):
        assert called(({"method": method, "path": path}, [whole()])) == [404]
    assert called(({"method": "GET", "path": "/v1/models"}, [])) == [200]


@pytest.mark.parametrize(
    ("header", "value", "status"),
    [
        (b"host", b"127.0.0.1:8000", 200), (b"host", b"evil.example:8000", 403), (b"host", b"[", 403),
        (b"origin", b"http://127.0.0.1:3000", 200), (b"origin", b"https://evil.example", 403),
        (b"origin", b"null", 403),
        (b"host", b"127.0.0.1.evil.example", 403), (b"host", b"evil@127.0.0.1", 200),
    ],
)  # fmt: skip
def test_a_web_page_cannot_ask_a_machine_of_its_own(header, value, status):
    request = {"headers": [(header, value)]}, [whole()]
    assert called(request) == [status]
    assert called(request, names=None) == [200]
    assert local_names("0.0.0.0") is None


def test_each_of_several_origins_counts():
    origins = [(b"origin", b"https://evil.example"), (b"origin", b"http://127.0.0.1:3000")]
    assert called(({"headers": origins}, [whole()]), ({"headers": origins[::-1]}, [whole()])) == [403, 403]


def test_a_body_has_a_size_and_a_time(monkeypatch):
    monkeypatch.setattr(guard, "BODY_SECONDS", 0.2)
    part = {"type": "http.request", "body": b" " * 2**19, "more_body": True}
    slow = {"type": "http.request", "body": b" ", "more_body": True}
    length = {"headers": [(b"content-length", b"9999999")]}
    requests = ({}, [part] * 5), ({}, [slow, 0.05] * 50), (length, [whole()]), ({}, [part, GONE])
    assert called(*requests) == [413, 408, 413, None]
    assert (
        called(*[({"headers": [(b"content-length", wrong)]}, []) for wrong in (b"-1", b"1e3", b"9" * 5000)])
        == [413] * 3
    )


def test_questions_wait_for_their_turn_and_are_dropped_where_nobody_waits(monkeypatch):
    monkeypatch.setattr(guard, "WAITING", 4)
    before = app.asked
    slow = ({}, [whole(max_tokens=200)])
    assert called(slow, slow, ({}, [whole(max_tokens=8000), GONE]), slow, slow) == [200, 200, None, 200, 503]
    assert app.asked == before + 3


# ---- over sockets


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """The port of a stand-in for a model, served as models are."""
    pytest.importorskip("uvicorn", reason="uvicorn is not installed: pip install uvicorn")
    program = Path(__file__).parents[1] / "standin_model.py"
    log = (tmp_path_factory.mktemp("served") / "log").open("w+")
    process = subprocess.Popen([sys.executable, str(program)], stdout=subprocess.PIPE, stderr=log, text=True)
    try:
        yield int(process.stdout.readline())
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        process.wait(30)
        log.seek(0)
        assert "Exception" not in log.read()
    finally:
        process.kill()
        process.wait()
        process.stdout.close()
        log.close()


def ordinary(port):
    """What the server says to an ordinary question."""
    connection = HTTPConnection("127.0.0.1", port, timeout=20)
    try:
        body = json.dumps({**ASKED, **held_to(SCHEMA)})
        connection.request("POST", "/v1/chat/completions", body, {"Content-Type": "application/json"})
        reply = connection.getresponse()
        assert reply.status == 200
        return json.loads(reply.read())["choices"][0]["message"]["content"]
    finally:
        connection.close()


def sent(port, *parts, pause=0.0, wait=5.0):
    """What comes back of bytes that are sent so; b"" where the server closes."""
    with socket.create_connection(("127.0.0.1", port), timeout=wait) as connection:
        came = b""
        try:
            for part in parts:
                if select.select([connection], [], [], pause)[0]:
                    break
                connection.sendall(part)
            while more := connection.recv(65_536):
                came += more
        except ConnectionError:
            pass
        return came


POST = b"POST /v1/chat/completions HTTP/1.1\r\nHost: 127.0.0.1\r\n"


def post(body, head=POST):
    body = body if isinstance(body, bytes) else json.dumps({**ASKED, **body}).encode()
    return [head + b"Content-Length: %d\r\n\r\n" % len(body) + body]


BODIES = {name: post(fields) for name, fields in WRONG.items()}
HOSTILE = BODIES | {
    "nothing": [],
    "no HTTP": [b"\x00\xff" * 1000],
    "another protocol": [b"SSH-2.0-OpenSSH\r\n\r\n"],
    "HTTP/2": [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"],
    "a web socket": [
        b"GET /v1/models HTTP/1.1\r\nHost: 127.0.0.1\r\nUpgrade: websocket\r\nConnection: upgrade\r\n\r\n"
    ],
    "a long address": [b"GET /" + b"x" * 200_000 + b" HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"],
    "a long header": [POST + b"X: " + b"y" * 200_000 + b"\r\n\r\n"],
    "many headers": [POST + b"X: y\r\n" * 50_000 + b"\r\n"],
    "two lengths": [POST + b"Content-Length: 5\r\nContent-Length: 6\r\n\r\n{}"],
    "a negative length": [POST + b"Content-Length: -5\r\n\r\n{}"],
    "a length beyond": [POST + b"Content-Length: 99999999999\r\n\r\n"],
    "a length that is not kept": [POST + b"Content-Length: 500\r\n\r\n{}"],
    "wrong chunks": [POST + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n"],
    "chunks without an end": [
        POST + b"Transfer-Encoding: chunked\r\n\r\n",
        *[b"10000\r\n" + b" " * 65_536 + b"\r\n"] * 50,
    ],
    "smuggled": [POST + b"Content-Length: 3\r\nTransfer-Encoding: chunked\r\n\r\n0\r\n\r\nGET /docs HTTP/1.1\r\n\r\n"],
    "many at once": post({}) * 100,
    "no method": [b" / HTTP/1.1\r\n\r\n"],
    "a file": [b"GET /../../etc/passwd HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"],
    "another host": post({}, POST.replace(b"127.0.0.1", b"evil.example")),
    "another origin": post({}, POST + b"Origin: https://evil.example\r\n"),
    "no JSON": post(b"{" * 1000),
    "nested deep": post(b"[" * 900_000),
    "a large body": post(b" " * 2**21),
    "a deep request": post(b'{"messages": ' + b'{"a":' * 150_000),
    "a number": post(b'{"max_tokens": ' + b"9" * 100_000 + b"}"),
    "not UTF-8": post(b'{"model": "\xff"}'),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_it_answers_after_a_hostile_request(served, name):
    before = json.loads(ordinary(served))[0]
    began = time.monotonic()
    came = sent(served, *HOSTILE[name])
    assert time.monotonic() - began < 4
    assert came[:12] in (b"", b"HTTP/1.1 400", b"HTTP/1.1 403", b"HTTP/1.1 404", b"HTTP/1.1 408", b"HTTP/1.1 413") or (
        name in ("many at once", "a web socket") and came.count(b"HTTP/1.1 200") == 1
    )
    assert json.loads(ordinary(served))[0] == before + 1 + (name == "many at once")


def test_slow_requests_are_ended_while_others_are_answered(served):
    """A head and a body a byte at a time, one that never comes, and one behind an ordinary request."""
    began = time.monotonic()
    drips = [bytes([byte]) for byte in POST * 3]
    assert sent(served, *drips, pause=0.05)[:12] in (b"", b"HTTP/1.1 408")
    body = [POST + b"Content-Length: 5000\r\n\r\n", *[b" "] * 500]
    assert sent(served, *body, pause=0.05)[:12] == b"HTTP/1.1 408"
    assert sent(served, *post({}), *drips, pause=0.05).count(b"HTTP/1.1 ") == 1
    assert time.monotonic() - began < 12


def test_many_connections_at_once_leave_it_answering(served):
    held = [socket.create_connection(("127.0.0.1", served)) for _ in range(200)]
    try:
        for number, connection in enumerate(held):
            connection.sendall(POST[: number % 40])
        ordinary(served)
        time.sleep(1.5)
        ordinary(served)
        ended = [connection for connection in held if select.select([connection], [], [], 0)[0]]
        assert len(ended) == len(held)
    finally:
        for connection in held:
            connection.close()


def test_a_question_that_nobody_waits_for_is_dropped(served):
    before = json.loads(ordinary(served))[0]
    for _ in range(20):
        with socket.create_connection(("127.0.0.1", served)) as connection:
            connection.sendall(post({"max_tokens": 500})[0])
            time.sleep(0.02)
    began = time.monotonic()
    after = json.loads(ordinary(served))[0]
    assert after <= before + 3
    assert time.monotonic() - began < 3


def test_a_planner_is_answered(served, tmp_path):
    asked = lw.OpenAIPlanner("mine", base_url=f"http://127.0.0.1:{served}/v1", constrain=True, cache=tmp_path)
    (answer,) = asked.plans("push", progress=False)
    assert json.loads(answer.raw)[1]["response_format"]["type"] == "json_object"
    with pytest.raises(lw.planners.PlannerError, match=r"no such model or address.*'mine' is served"):
        lw.OpenAIPlanner("other", base_url=f"http://127.0.0.1:{served}/v1", cache=tmp_path).plans(
            "push", progress=False
        )
