"""What a model on this machine may be asked, and the guard before its server: few kinds of requests, one by one."""

import asyncio
import json
from collections.abc import Callable, Collection
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._checks import nearest, shown
from lw_torchrl._files import parse_json
from lw_torchrl.planners.prompts import PATTERNS

MESSAGES, STOPS = 100, 8
_SCHEMA_DEPTH, _CHOICES, _ITEMS = 12, 1000, 64
_Check = tuple[Callable[[Any], bool], str]


class Refused(ValueError):
    """A request that is not answered, with its HTTP status and the same in a word, as OpenAI's server says it."""

    def __init__(self, status: int, message: str, code: str = "invalid_request") -> None:
        super().__init__(message)
        self.status, self.code = status, code


def read_request(body: bytes, model: str, context: int) -> bytes:
    """The body of a request, checked and rewritten for llama-cpp-python's server: a schema is ``json_object`` there.

    A request without a model's name means ``model``, the only one; an answer may have ``context`` tokens. What is no
    JSON, or has an unknown field or a value that is not allowed, is :class:`Refused`.
    """
    try:
        request = parse_json(body)
    except ValueError as error:
        raise Refused(400, f"the body must be an object in JSON: {error}") from None
    if request.get("model") not in (None, model):
        said = f"the model {shown(request['model'])} does not exist here; {model!r} is served"
        raise Refused(404, said, "model_not_found")
    if request.get("messages") is None:
        raise Refused(400, "messages must be given")
    known = _FIELDS | {"model": _one_of(None, model), "max_tokens": _number(1, context, whole=True)}
    for name, value in request.items():
        if name not in known:
            near = "".join(f"; did you mean {other!r}?" for other in nearest(name[:100], known, n=1))
            raise Refused(400, f"{shown(name)} is no field that this server knows, {', '.join(sorted(known))}{near}")
        right, allowed = known[name]
        if value is not None and not right(value):
            raise Refused(400, f"{name} must be {allowed}, got {shown(value)}")
    asked = request.get("response_format") or {}
    if asked.get("type") == "json_schema":
        request["response_format"] = {"type": "json_object", "schema": asked["json_schema"]["schema"]}
    try:
        given = {name: value for name, value in request.items() if value is not None}
        return json.dumps(given, ensure_ascii=False).encode()
    except UnicodeEncodeError:
        raise Refused(400, "the body has half of a surrogate pair, which UTF-8 cannot hold") from None


def _number(least: float, most: float, whole: bool = False) -> _Check:
    kinds = (int,) if whole else (int, float)
    what = "an integer" if whole else "a number"
    return (lambda value: type(value) in kinds and least <= value <= most), f"{what} from {least} to {most}"


def _one_of(*allowed: Any) -> _Check:
    words = " or ".join(map(json.dumps, allowed))
    return (lambda value: any(type(value) is type(one) and value == one for one in allowed)), words


def _is_message(value: Any) -> bool:
    whole = isinstance(value, dict) and {*value} == {"role", "content"} and isinstance(value["content"], str)
    return whole and value["role"] in ("system", "user", "assistant")


def _are_stops(value: Any) -> bool:
    stops = value if isinstance(value, list) else [value]
    return len(stops) <= STOPS and all(isinstance(stop, str) and 1 <= len(stop) <= 100 for stop in stops)


def _is_format(value: Any) -> bool:
    if not isinstance(value, dict):
        return False
    kind, rest, holder = value.get("type"), {*value} - {"type"}, value
    if not rest:
        return kind in ("text", "json_object")
    if kind == "json_schema" and rest == {"json_schema"}:
        holder = value["json_schema"]
        if not isinstance(holder, dict) or not {"schema"} <= {*holder} <= {"name", "schema", "strict"}:
            return False
    elif kind != "json_object" or rest != {"schema"}:
        return False
    return _is_schema(holder["schema"], _SCHEMA_DEPTH)


def _is_schema(value: Any, depth: int) -> bool:
    """Whether it is a schema like those of :func:`plan_schema`: others make grammars that fill the memory."""
    if not isinstance(value, dict) or depth == 0:
        return False
    names, kind = {*value}, value.get("type")
    if names == {"anyOf"}:
        return _listed(value["anyOf"], lambda one: _is_schema(one, depth - 1))
    if kind == "object" and names == {"type", "properties", "required", "additionalProperties"}:
        inside = value["properties"]
        if not isinstance(inside, dict) or not 1 <= len(inside) <= _ITEMS or value["required"] != list(inside):
            return False
        closed = value["additionalProperties"] is False
        return closed and all(_is_schema(one, depth - 1) for one in inside.values())
    if kind == "array" and names == {"type", "items", "minItems", "maxItems"}:
        least, most = value["minItems"], value["maxItems"]
        counts = type(least) is int and type(most) is int and 0 <= least <= most <= _ITEMS
        return counts and _is_schema(value["items"], depth - 1)
    if kind == "string" and names == {"type", "enum"}:
        return _listed(value["enum"], lambda one: isinstance(one, str) and len(one) <= 200)
    return kind == "string" and names == {"type", "pattern"} and value["pattern"] in [*PATTERNS]


def _listed(value: Any, right: Callable[[Any], bool], most: int = _CHOICES) -> bool:
    return isinstance(value, list) and 1 <= len(value) <= most and all(map(right, value))


_FIELDS: dict[str, _Check] = {
    "messages": (
        lambda value: _listed(value, _is_message, MESSAGES),
        f"1 to {MESSAGES} objects with role (system, user or assistant) and content, a text",
    ),
    "response_format": (_is_format, "text, json_object, or json_schema with a schema as plan_schema makes it"),
    "stop": (_are_stops, f"up to {STOPS} texts of 1 to 100 characters"),
    "n": _one_of(1),
    "stream": _one_of(False),
    "seed": _number(-(2**63), 2**63, whole=True),
    "temperature": _number(0, 100),
    "top_p": _number(0, 1),
    "min_p": _number(0, 1),
    "top_k": _number(0, 10**6, whole=True),
    "presence_penalty": _number(-2, 2),
    "frequency_penalty": _number(-2, 2),
    "repeat_penalty": _number(0, 10),
}

BODY_LIMIT = 2**20  # bytes of a request; the longest prompt with its schema has some 25,000

HEAD_SECONDS, BODY_SECONDS = 10.0, 30.0
WAITING = 32  # questions that wait for their turn; more are told to come again


class Guard:
    """An ASGI application before that of llama-cpp-python.

    It takes only ``GET /v1/models`` and ``POST /v1/chat/completions``, reads a request whole, and passes it on in its
    turn if :func:`read_request` allows it. A request whose client has gone while it waited is dropped. ``names`` are
    what a request may call this machine, so that no web page can ask by another name; None for any.
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
        except Refused as refused:  # in the form of OpenAI's server
            error = {"message": str(refused), "type": "invalid_request_error", "param": None, "code": refused.code}
            start = {"type": "http.response.start", "status": refused.status}
            await answer(start | {"headers": [(b"content-type", b"application/json")]})
            await answer({"type": "http.response.body", "body": json.dumps({"error": error}).encode()})
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
    """The client has gone."""


async def _whole(headers: dict[bytes, str], receive: Any) -> bytes:
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
    left = [body]

    async def receive() -> Any:
        return {"type": "http.request", "body": left.pop(), "more_body": False} if left else await then()

    return receive


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

    options: Any = {"log_level": "warning", "proxy_headers": False, "timeout_graceful_shutdown": 5}
    uvicorn.Server(uvicorn.Config(app, http=Protocol, ws="none", **options)).run(sockets=[listener])
