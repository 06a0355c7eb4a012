"""What stands before a model's server: it takes few kinds of requests, of a greatest size and time, one by one."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Collection
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._checks import shown
from lw_torchrl.planners.chat_request import Refused, read_request

BODY_LIMIT = 2**20
"""Bytes of a request; the longest prompt with its schema has some 25,000."""
HEAD_SECONDS, BODY_SECONDS = 10.0, 30.0
WAITING = 32
"""Questions that wait for their turn; more are told to come again."""


class Guard:
    """An ASGI application before that of llama-cpp-python.

    It takes ``GET /v1/models`` and ``POST /v1/chat/completions`` and nothing else, reads a request whole, and lets it
    on in its turn if :func:`read_request` knows all of it. One whose client has gone while it waited is dropped.

    Args:
        app: the application behind it.
        model: the name of its model.
        context: tokens of a question and its answer.
        names: what the machine may be called in a request, so that no web page can ask by another name; None for any.
    """

    def __init__(self, app: Any, model: str, context: int, names: Collection[str] | None = None) -> None:
        self._app, self._model, self._context, self._names = app, model, context, names
        self._turn, self._waiting = asyncio.Lock(), 0

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        if scope["type"] == "lifespan":
            return await self._app(scope, receive, send)

        async def answer(message: Any) -> None:
            if message["type"] == "http.response.start":  # so that a slow next request holds no connection
                message = message | {"headers": [*message.get("headers", ()), (b"connection", b"close")]}
            await send(message)

        try:
            headers = [(name.lower(), value.decode("latin-1")) for name, value in scope["headers"]]
            self._check_names(headers)
            asked = scope["method"], scope["path"]
            if asked == ("GET", "/v1/models"):
                await self._app(scope, _given(b"", receive), answer)
            elif asked == ("POST", "/v1/chat/completions"):
                body = read_request(await _whole(dict(headers), receive), self._model, self._context)
                told = {b"content-type": b"application/json", b"content-length": str(len(body)).encode()}
                await self._in_turn({**scope, "headers": list(told.items())}, body, receive, answer)
            else:
                raise Refused(404, "this server has GET /v1/models and POST /v1/chat/completions alone", "not_found")
        except Refused as refused:
            await _refuse(answer, refused)
        except _Gone:
            pass

    def _check_names(self, headers: list[tuple[bytes, str]]) -> None:
        addresses = {b"host": "//{}", b"origin": "{}"}
        for header, given in headers:
            if self._names is None or header not in addresses:
                continue
            try:
                name = urlsplit(addresses[header].format(given)).hostname
            except ValueError:
                name = None
            if name not in self._names:
                said = f"{header.decode()} must be this machine, {', '.join(sorted(self._names))}"
                raise Refused(403, f"{said}, got {shown(given)}", "forbidden")

    async def _in_turn(self, scope: Any, body: bytes, receive: Any, send: Any) -> None:
        if self._waiting >= WAITING:
            raise Refused(503, f"{WAITING} questions wait already; ask again later", "overloaded")
        gone, turn = asyncio.ensure_future(receive()), asyncio.ensure_future(self._turn.acquire())
        try:
            self._waiting += 1
            try:
                await asyncio.wait((gone, turn), return_when=asyncio.FIRST_COMPLETED)
            finally:
                self._waiting -= 1
            if turn.done() and not gone.done():
                await self._app(scope, _given(body, lambda: asyncio.shield(gone)), send)
        finally:
            gone.cancel()
            if turn.done():
                self._turn.release()
            else:
                turn.cancel()


class _Gone(Exception):
    """Nobody waits for an answer any more."""


async def _whole(headers: dict[bytes, str], receive: Any) -> bytes:
    """The body of a request."""
    said, body = headers.get(b"content-length", "0"), bytearray()
    too_large = Refused(413, f"a request may have {BODY_LIMIT} bytes", "too_large")
    if len(said) > 9 or not said.isdecimal() or int(said) > BODY_LIMIT:
        raise too_large
    try:
        async with asyncio.timeout(BODY_SECONDS):
            while True:
                message = await receive()
                if message["type"] != "http.request":
                    raise _Gone
                body += message.get("body", b"")
                if len(body) > BODY_LIMIT:
                    raise too_large
                if not message.get("more_body"):
                    return bytes(body)
    except TimeoutError:
        raise Refused(408, f"the request did not come within {BODY_SECONDS:g} s", "too_slow") from None


def _given(body: bytes, then: Any) -> Any:
    """What an application receives of a request that was read."""
    left = [body]

    async def receive() -> Any:
        return {"type": "http.request", "body": left.pop(), "more_body": False} if left else await then()

    return receive


async def _refuse(send: Any, refused: Refused) -> None:
    """As OpenAI's server refuses."""
    error = {"message": str(refused), "type": "invalid_request_error", "param": None, "code": refused.code}
    headers = [(b"content-type", b"application/json")]
    await send({"type": "http.response.start", "status": refused.status, "headers": headers})
    await send({"type": "http.response.body", "body": json.dumps({"error": error}).encode()})


def run_server(app: Any, listener: Any) -> None:
    """Answer at a socket until Ctrl-C. A connection without a whole head after ``HEAD_SECONDS`` is closed."""
    import uvicorn
    from uvicorn.protocols.http.h11_impl import H11Protocol

    class Protocol(H11Protocol):
        def connection_made(self, transport: Any) -> None:
            super().connection_made(transport)
            self.loop.call_later(HEAD_SECONDS, self._close_unasked)

        def _close_unasked(self) -> None:
            if self.cycle is None:
                self.transport.close()

    config = uvicorn.Config(
        app, http=Protocol, ws="none", log_level="warning", proxy_headers=False, timeout_graceful_shutdown=5
    )
    uvicorn.Server(config).run(sockets=[listener])
