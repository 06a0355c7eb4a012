"""A server that means harm holds no client and fills no memory; whatever it sends is an answer or a PlannerError."""

import json
import socket
import time
from itertools import chain, repeat

import pytest
from fake_server import Failure, FakeServer, completion, planner, serving, talking
from hypothesis import given, settings
from hypothesis import strategies as st

import lw_torchrl as lw
from lw_torchrl.planners import chat_reply
from lw_torchrl.planners.answer_files import AnswerCache
from lw_torchrl.planners.chat_reply import NoCompletion, Redactor, read_completion

pytestmark = pytest.mark.usefixtures("no_account")


# ---- time

HEAD = b"HTTP/1.1 200 OK\r\nContent-Type: application/json\r\n"
BODY = json.dumps(completion("x")).encode()


def dripped(before, content=b"", pause=0.1):
    """A byte at a time, each within any timeout of a read, and then for ever."""
    yield before
    for byte in chain(content, repeat(ord(" "), 1000)):
        yield bytes([byte])
        yield pause


DRIPS = {
    "nothing": lambda: repeat(0.1, 1000),
    "status line": lambda: dripped(b"", HEAD),
    "headers": lambda: dripped(HEAD, b"X-Slow: "),
    "interim answers": lambda: chain.from_iterable(repeat((b"HTTP/1.1 100 Continue\r\n\r\n", 0.1), 1000)),
    "body": lambda: dripped(HEAD + b"Content-Length: 5000\r\n\r\n", BODY),
    "body without an end": lambda: dripped(HEAD + b"Connection: close\r\n\r\n", BODY),
    "chunks": lambda: chain(
        [HEAD + b"Transfer-Encoding: chunked\r\n\r\n"], chain.from_iterable(repeat((b"1\r\n \r\n", 0.1), 1000))
    ),
    "a stream of events": lambda: chain(
        [b"HTTP/1.1 200 OK\r\nContent-Type: text/event-stream\r\n\r\n"],
        chain.from_iterable(repeat((b"data: {}\n\n", 0.1), 1000)),
    ),
    "an error's body": lambda: dripped(b"HTTP/1.1 500 No\r\nContent-Length: 5000\r\n\r\n"),
}


@pytest.mark.parametrize("name", DRIPS)
@pytest.mark.slow
def test_an_answers_time_is_one_whatever_drips(tmp_path, name):
    with talking(DRIPS[name]) as address:
        began = time.monotonic()
        with pytest.raises(lw.planners.PlannerError, match=r"no answer within 0\.5 s, asked 1 time.*longer timeout"):
            planner(address, tmp_path, timeout=0.5).plans("push", progress=False)
        assert time.monotonic() - began < 5
    assert not (tmp_path / "kept").exists()


def test_each_retry_has_the_same_time(tmp_path):
    asked = []

    def talk():
        asked.append(time.monotonic())
        yield from DRIPS["body"]()

    with (
        talking(talk) as address,
        pytest.raises(lw.planners.PlannerError, match=r"no answer within 0\.3 s, asked 2 times"),
    ):
        planner(address, tmp_path, timeout=0.3, retries=1).plans("push", progress=False)
    assert len(asked) == 2
    assert asked[1] - asked[0] < 5


def test_a_connection_that_is_never_taken_ends(tmp_path):
    with socket.socket() as full:
        full.bind(("127.0.0.1", 0))
        full.listen(0)
        waiting = [socket.socket() for _ in range(4)]
        try:
            for one in waiting:
                one.setblocking(False)
                one.connect_ex(full.getsockname())
            began = time.monotonic()
            address = f"http://127.0.0.1:{full.getsockname()[1]}/v1"
            with pytest.raises(lw.planners.PlannerError, match=r"no answer within 0\.5 s"):
                planner(address, tmp_path, timeout=0.5).plans("push", progress=False)
            assert time.monotonic() - began < 5
        finally:
            for one in waiting:
                one.close()


def test_the_others_are_answered_beside_one_that_drips(tmp_path):
    """Two questions at once; the one that drips ends by itself."""
    first = []

    def talk():
        if not first:
            first.append(0)
            yield from DRIPS["body"]()
        yield HEAD + b"Content-Length: %d\r\n\r\n" % len(BODY) + BODY

    with talking(talk) as address, pytest.raises(lw.planners.PlannerError, match="4 of 5 answers are kept"):
        planner(address, tmp_path, timeout=1.0, concurrency=2).plans("push", attempts=5, progress=False)


# ---- size


@pytest.mark.parametrize("status", [200, 302, 500])
@pytest.mark.parametrize("length", ["Content-Length: 99999999999", "Connection: close"])
def test_a_reply_without_an_end_is_not_read_to_it(tmp_path, monkeypatch, status, length):
    monkeypatch.setattr(chat_reply, "REPLY_LIMIT", 2**20)
    sent = []

    def talk():
        yield f"HTTP/1.1 {status} X\r\n{length}\r\n\r\n".encode()
        for _ in range(200):
            yield b'{"a": "' + b"x" * 2**20
            sent.append(1)

    says = {200: "larger than|no JSON", 302: "sends on to nowhere", 500: "the server failed"}[status]
    with talking(talk) as address, pytest.raises(lw.planners.PlannerError, match=says) as caught:
        planner(address, tmp_path).plans("push", progress=False)
    assert len(str(caught.value)) < 1000
    assert len(sent) < 50  # what the sockets' buffers hold


def test_a_reply_that_is_too_large_is_named(tmp_path):
    body = json.dumps(completion("x" * chat_reply.REPLY_LIMIT))
    with (
        serving(FakeServer(lambda _: Failure(200, body))) as address,
        pytest.raises(lw.planners.PlannerError, match="the reply is larger than 4 MiB"),
    ):
        planner(address, tmp_path).plans("push", progress=False)


def test_headers_without_an_end_are_a_fault(tmp_path):
    def talk():
        yield HEAD
        for number in range(20_000):
            yield b"X-%d: " % number + b"y" * 1000 + b"\r\n"

    with talking(talk) as address, pytest.raises(lw.planners.PlannerError, match="the connection failed"):
        planner(address, tmp_path, timeout=20.0).plans("push", progress=False)


def test_a_redirect_is_not_followed(tmp_path):
    asked = []

    def other():
        asked.append(1)
        yield HEAD + b"Content-Length: %d\r\n\r\n" % len(BODY) + BODY

    with talking(other) as there:
        for status in (301, 302, 303, 307, 308):
            server = FakeServer(lambda _, status=status: Failure(status, "", location=f"{there}?key=1"))
            with (
                serving(server) as address,
                pytest.raises(lw.planners.PlannerError, match=f"sends on to {there}") as caught,
            ):
                planner(address, tmp_path).plans("push", progress=False)
            assert caught.value.fatal
    assert not asked


# ---- what is no answer

DEEP = b"[" * 200_000
NONE = {
    "empty": b"",
    "white space": b"   \n",
    "nested deep": DEEP,
    "nested deep and whole": b"[" * 200_000 + b"]" * 200_000,
    "nested deep inside": b'{"choices": [{"message": {"content": "x"}}], "more": ' + DEEP,
    "objects nested deep": b'{"a":' * 200_000,
    "cut off": BODY[:-3],
    "NaN": BODY.replace(b"100", b"NaN"),
    "Infinity": BODY.replace(b"100", b"-Infinity"),
    "too large a number": BODY.replace(b"100", b"1e999"),
    "too long a number": BODY.replace(b"100", b"1" * 5000),
    "not UTF-8": BODY.replace(b'"x"', b'"\xff\xfe"'),
    "UTF-16": BODY.decode().encode("utf-16"),
    "a name twice": BODY.replace(b'"id"', b'"choices"'),
    "a list": b"[" + BODY + b"]",
    "a string": json.dumps(BODY.decode()).encode(),
    "events": b"data: " + BODY + b"\n\ndata: [DONE]\n\n",
    "two": BODY + BODY,
    "null": b"null",
    "text": b"I cannot.",
    "styles without an end": b"<style" * 100_000,
    "brackets": b"<" * 500_000,
}


@pytest.mark.parametrize("name", NONE)
@pytest.mark.parametrize("status", [200, 500])
def test_what_is_no_answer_is_an_error(tmp_path, name, status):
    def talk():
        head = b"HTTP/1.1 %d X\r\nContent-Type: application/json\r\nContent-Length: %d\r\n\r\n"
        yield head % (status, len(NONE[name])) + NONE[name]

    began = time.monotonic()
    with talking(talk) as address, pytest.raises(lw.planners.PlannerError) as caught:
        planner(address, tmp_path).plans("push", progress=False)
    assert caught.value.__cause__ is caught.value.__context__ is None
    assert len(str(caught.value)) < 1500
    assert str(caught.value).isprintable()
    assert time.monotonic() - began < 10
    assert not (tmp_path / "kept").exists()


@pytest.mark.parametrize(
    "head",
    [
        b"", b"\x00\xff" * 500, b"HTTP/9.9 200 OK\r\n\r\n", b"HTTP/1.1 99999 OK\r\n\r\n", b"SSH-2.0-OpenSSH\r\n",
        b"HTTP/1.1 204 No\r\n\r\n", b"HTTP/1.1 101 Other\r\nUpgrade: x\r\n\r\n",
        HEAD + b"Content-Length: -3\r\n\r\n", HEAD + b"Content-Length: 3\r\nContent-Length: 4\r\n\r\nabcd",
        HEAD + b"Transfer-Encoding: chunked\r\n\r\nzz\r\n{}\r\n",
        HEAD + b"Transfer-Encoding: chunked\r\n\r\nffffffffff\r\n",
        HEAD + b"Content-Encoding: gzip\r\nContent-Length: 2\r\n\r\n{}", HEAD + b"X\x00: y\r\n\r\n",
        b"HTTP/1.1 307 Go\r\nLocation: http://[\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 400 No\r\nContent-Type: text/plain; charset=punycode\r\nContent-Length: 3\r\n\r\n\xff\xff\xff",
        b"HTTP/1.1 400 No\r\nContent-Type: text/plain; charset=hex\r\nContent-Length: 3\r\n\r\nxyz",
        b"HTTP/1.1 429 No\r\nRetry-After: " + b"9" * 400 + b"\r\nContent-Length: 0\r\n\r\n",
        b"HTTP/1.1 503 No\r\nRetry-After: NaN\r\nretry-after-ms: -1e999\r\nContent-Length: 0\r\n\r\n",
    ],
)  # fmt: skip
def test_what_is_no_http_is_an_error(tmp_path, head):
    with talking(lambda: [head]) as address, pytest.raises(lw.planners.PlannerError):
        planner(address, tmp_path, timeout=5.0).plans("push", progress=False)
    assert not (tmp_path / "kept").exists()


WRONG = [None, True, -1, 3.5, 2**70, "", "text", "\ud800", [], [1], {}, {"a": [None]}, [[]], {"content": "x"}]
PLACES = [
    ("choices",), ("choices", 0), ("choices", 0, "message"), ("choices", 0, "message", "content"),
    ("choices", 0, "message", "refusal"), ("choices", 0, "finish_reason"), ("usage",), ("usage", "prompt_tokens"),
    ("usage", "completion_tokens"), ("model",), ("id",), ("created",), ("object",),
]  # fmt: skip
READ_ALL_THE_SAME = {
    "refusal",
    "finish_reason",
    "usage",
    "prompt_tokens",
    "completion_tokens",
    "model",
    "id",
    "created",
}
READ_ALL_THE_SAME.add("object")


def put(reply, place, value):
    *way, last = place
    for name in way:
        reply = reply[name]
    reply[last] = value


@pytest.mark.parametrize("place", PLACES, ids=lambda place: ".".join(map(str, place)))
def test_a_field_of_a_wrong_type_is_an_error_or_a_note(place):
    plain = read_completion(BODY, str)[0]
    for value in WRONG:
        reply = json.loads(BODY)
        put(reply, place, value)
        content = json.dumps(reply).encode()
        if place[-1] in READ_ALL_THE_SAME:
            found, answered = read_completion(content, str)
            assert found.text == plain.text
            if found.notes:
                name = place[0] if place[0] == "usage" else place[-1]
                assert found.notes == (f"the server's {name} could not be read",)
            answered.encode()
            f"{found.finish}{found.refusal}".encode()
        elif place[-1] == "content" and isinstance(value, str | None):
            assert read_completion(content, str)[0].text == (value or "").replace("\ud800", "?")
        elif place[-1] == "message" and isinstance(value, dict) and value:
            assert read_completion(content, str)[0].text == value.get("content", "")
        else:
            with pytest.raises(NoCompletion):
                read_completion(content, str)


NEW = st.binary(max_size=6) | st.sampled_from([DEEP, b"\\ud800", b"NaN", b"1e999", b'"', b"}", b","])


@settings(max_examples=160, deadline=None)
@given(st.lists(st.tuples(st.integers(0, len(BODY)), st.integers(0, 9), NEW), max_size=4))
def test_a_mutated_reply_is_an_answer_or_no_completion(tmp_path_factory, mutations):
    content = BODY
    for start, length, new in mutations:
        content = content[:start] + new + content[start + length :]
    try:
        reply, answered = read_completion(content, Redactor(["sk-proj-9fK2xQ7LmZ4tRw8B"]))
    except NoCompletion as error:
        str(error).encode()
        return
    cache = AnswerCache(tmp_path_factory.mktemp("kept"))
    cache.write({"a": 1}, reply)
    assert cache.read({"a": 1}) == reply
    answered.encode()
