"""A small OpenAI-compatible server on this machine, which answers with shipped plans or fails on purpose."""

import json
import threading
import time
from collections import deque
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer

import lw_torchrl as lw
from lw_torchrl.language.formats import PLAN_FORMATS
from lw_torchrl.planners.prompts import write_structured

PLANS = lw.load_plans("MT50")


def completion(text, finish="stop", **message):
    """Return a chat completion."""
    choice = {"index": 0, "message": {"role": "assistant", "content": text, **message}, "finish_reason": finish}
    return {"choices": [choice], "usage": {"prompt_tokens": 100, "completion_tokens": 10}}


def asked_for(body):
    """Return the task that a request asks about."""
    return body["messages"][0]["content"].split("the plan for `")[1].split("`")[0]


def shipped(body):
    """Answer with the shipped plan of the task, as JSON if a schema is sent."""
    plan = PLANS[asked_for(body)]
    if "response_format" in body:
        return completion(write_structured(plan, PLAN_FORMATS["basic_py"].style))
    return completion(lw.encode_plan(plan, "chain_py"))


@dataclass
class Failure:
    """A reply that is not a chat completion, or that is cut in half, or sent byte by byte."""

    status: int = 200
    body: object = ""  # a text, or an object that is sent as JSON
    headers: dict = field(default_factory=dict)
    cut: bool = False
    drip: float = 0.0  # seconds after each byte


def error(status, message, **headers):
    """Fail as OpenAI-compatible servers do; the client may retry at once."""
    return Failure(status, {"error": {"message": message}}, {"retry-after-ms": "1", **headers})


def encode(text):
    return text.encode()


class FakeServer:
    """A server that sends ``failures``, then ``respond(body)``, after ``wait`` seconds; it keeps requests and keys."""

    def __init__(self, respond=shipped, failures=(), wait=0.0):
        self.respond, self.failures, self.wait = respond, deque(failures), wait
        self.requests, self.keys, self.served = [], [], 0

    def answer(self, body, key):
        self.requests.append(body)
        self.keys.append(key)
        time.sleep(self.wait)
        reply = self.failures.popleft() if self.failures else self.respond(body)
        self.served += not isinstance(reply, Failure)
        return reply if isinstance(reply, Failure) else Failure(200, {"model": body["model"], **reply})


@contextmanager
def serving(server):
    """Run a server and yield its address."""

    class Handler(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"
        disable_nagle_algorithm = True  # it would delay each body by 40 ms

        def do_POST(self):
            body = json.loads(self.rfile.read(int(self.headers["Content-Length"])))
            reply = server.answer(body, self.headers["Authorization"])
            content = encode(reply.body if isinstance(reply.body, str) else json.dumps(reply.body))
            self.close_connection = reply.cut
            self.send_response(reply.status)
            for name, value in {"Content-Length": len(content), **reply.headers}.items():
                self.send_header(name, str(value))
            self.end_headers()
            content = content[: len(content) // 2] if reply.cut else content
            for part in (content[k : k + 1] for k in range(len(content))) if reply.drip else [content]:
                self.wfile.write(part)
                time.sleep(reply.drip)

        def log_message(self, *_):
            pass

    http = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    http.daemon_threads, http.handle_error = True, lambda *_: None  # the client has gone
    thread = threading.Thread(target=http.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield f"http://127.0.0.1:{http.server_port}/v1"
    finally:
        http.shutdown()
        http.server_close()
        thread.join()
