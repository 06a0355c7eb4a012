"""A server on this machine that speaks as OpenAI-compatible ones do, and fails as they do."""

from __future__ import annotations

import json
import threading
import time
from collections import deque
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from socketserver import StreamRequestHandler, ThreadingTCPServer

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.language.formats.structured import write_structured

KEY = "sk-a-secret-of-the-tests"
PLANS = lw.load_plans("MT50")


def planner(address, tmp_path, **options):
    """A planner of the server at an address, which asks once and keeps its answers below ``tmp_path``."""
    return lw.OpenAIPlanner("m", base_url=address, **{"cache": tmp_path / "kept", "retries": 0, **options})


def completion(text, finish="stop", **message):
    """The body of an answer."""
    return {
        "id": "1",
        "object": "chat.completion",
        "created": 0,
        "choices": [
            {"index": 0, "message": {"role": "assistant", "content": text, **message}, "finish_reason": finish}
        ],
        "usage": {"prompt_tokens": 100, "completion_tokens": 10, "total_tokens": 110},
    }


def asked_for(body):
    """The task that a request asks about."""
    return body["messages"][0]["content"].split("the plan for `")[1].split("`")[0]


def shipped(body):
    """The shipped plan of the task, as JSON where a schema is sent."""
    plan = PLANS[asked_for(body)]
    if "response_format" in body:
        return completion(write_structured(plan, PLAN_FORMATS["basic_py"].style))
    return completion(lw.encode_plan(plan, "chain_py"))


class Failure:
    """An answer that is none: a status with a body, headers, a body that breaks off, a wait."""

    def __init__(self, status=200, body="", *, kind="application/json", cut=False, wait=0.0, **headers):
        self.status, self.kind, self.cut, self.wait, self.headers = status, kind, cut, wait, headers
        self.body = body if isinstance(body, str) else json.dumps(body)


def error(status, message, **headers):
    """A failure in the words of an OpenAI-compatible server; asked again it is at once."""
    return Failure(status, {"error": {"message": message, "type": "x"}}, **{"retry-after-ms": "1", **headers})


class FakeServer:
    """What it answers is ``respond(body)``, unless ``failures`` has something first; what it was asked is kept.

    Attributes:
        requests: the bodies, in the order in which they came.
        keys: the Authorization headers.
        served: how many good answers were given.
        most_at_once: of the questions.
    """

    def __init__(self, respond=shipped, failures=(), wait=0.0):
        self.respond, self.failures, self.wait = respond, deque(failures), wait
        self.requests, self.keys, self.served = [], [], 0
        self.most_at_once = self.at_once = 0
        self.lock = threading.Lock()

    def answer(self, body, key):
        with self.lock:
            self.requests.append(body)
            self.keys.append(key)
            self.at_once += 1
            self.most_at_once = max(self.most_at_once, self.at_once)
            failure = self.failures.popleft() if self.failures else None
        try:
            time.sleep(self.wait)
            found = failure or self.respond(body)
            if isinstance(found, Failure):
                time.sleep(found.wait)
                return found
            with self.lock:
                self.served += 1
            if isinstance(found, dict) and "choices" in found:
                found = {"model": body["model"], **found}
            return Failure(200, found)
        finally:
            with self.lock:
                self.at_once -= 1


@contextmanager
def serving(server):
    """Its address, while the block lasts."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True  # it would hold each answer's body back for 40 ms

        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            found = server.answer(body, self.headers["Authorization"])
            content = found.body.encode()
            try:
                self.send_response(found.status)
                self.send_header("Content-Type", found.kind)
                self.send_header("Content-Length", str(len(content)))
                for name, value in found.headers.items():
                    self.send_header(name, value)
                self.end_headers()
                self.wfile.write(content[: len(content) // 2] if found.cut else content)
            except OSError:  # nobody waits for it any more
                self.close_connection = True
            if found.cut:
                self.close_connection = True

        def log_message(self, *_):
            pass

    class Listening(ThreadingHTTPServer):
        daemon_threads = True

        def handle_error(self, *_):
            pass

    http = Listening(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{http.server_port}/v1"
    finally:
        http.shutdown()
        http.server_close()
        thread.join()


@contextmanager
def talking(talk):
    """The address of a server that reads a question and answers with what ``talk()`` yields: bytes, or seconds to wait.

    It stops where nobody listens any more, and when the block ends.
    """
    ended = threading.Event()

    class Handler(StreamRequestHandler):
        def handle(self):
            self.rfile.readline()
            length = 0
            while line := self.rfile.readline().strip().lower():
                if line.startswith(b"content-length:"):
                    length = int(line.split(b":")[1])
            self.rfile.read(length)
            try:
                for part in talk():
                    if ended.is_set():
                        return
                    if isinstance(part, bytes):
                        self.wfile.write(part)
                    else:
                        ended.wait(part)
            except OSError:
                pass

    class Listening(ThreadingTCPServer):
        daemon_threads = True

        def handle_error(self, *_):
            pass

    with Listening(("127.0.0.1", 0), Handler) as tcp:
        thread = threading.Thread(target=tcp.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
        thread.start()
        try:
            yield f"http://127.0.0.1:{tcp.server_address[1]}/v1"
        finally:
            ended.set()
            tcp.shutdown()
            thread.join()
