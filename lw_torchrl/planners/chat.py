"""Questions to an OpenAI-compatible server through the ``openai`` client, and its replies."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field, replace
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._util.checks import counted, shown
from lw_torchrl._util.files import parse_json

OPENAI = "https://api.openai.com/v1"
REPLY_LIMIT = 4 * 2**20  # bytes
_KEY = "OPENAI_API_KEY"
_PROXIES = ("HTTP_PROXY", "HTTPS_PROXY", "ALL_PROXY")
# What to send to a server that refuses a field, and how its error names the field.
_FALLBACKS = {
    "max_completion_tokens": "max_completion_tokens",  # instead of max_tokens
    "json_object": "response_format|json_schema",  # as the type of response_format, instead of json_schema
    "no system message": "system role|role.{0,20}system",  # its text begins the user's message
}


class PlannerError(RuntimeError):
    """A planner could not answer a question; the message names the model, the question, the cause and a remedy.

    After a ``fatal`` error, every other question to the same planner would fail in the same way.
    """

    def __init__(self, message: str, *, fatal: bool = False) -> None:
        super().__init__(message)
        self.fatal = fatal


@dataclass(frozen=True)
class Tokens:
    """The number of tokens of prompts and of answers, as the server counts them; 0 if it does not."""

    prompt: int = 0
    completion: int = 0

    @property
    def total(self) -> int:
        return self.prompt + self.completion

    def __add__(self, other: Tokens) -> Tokens:
        return Tokens(self.prompt + other.prompt, self.completion + other.completion)


@dataclass(frozen=True)
class Reply:
    """A server's reply to a question."""

    text: str  # the answer; "" if there is none
    finish: str = ""  # the server's finish_reason: "stop", "length", "content_filter", ""
    refusal: str = ""  # the model's refusal
    tokens: Tokens = field(default_factory=Tokens)
    notes: tuple[str, ...] = ()  # remarks about the server


def server_address(base_url: str | None) -> str:
    """Return the address of a server, without a user name, password or query."""
    try:
        url = urlsplit(base_url or os.environ.get("OPENAI_BASE_URL") or OPENAI)
        valid = bool(url.hostname) and url.scheme in ("http", "https") and url.port != 0
    except (ValueError, TypeError, AttributeError):
        valid = False
    if not valid:
        raise ValueError(f"base_url must be an address like 'http://127.0.0.1:8000/v1', got {shown(base_url)}")
    return f"{url.scheme}://{url.netloc.rpartition('@')[2]}{url.path.rstrip('/')}"


class ChatClient:
    """A client of one model, for any number of threads; the arguments are those of :class:`OpenAIPlanner`."""

    def __init__(self, model: str, base_url: str | None, timeout: float, retries: int) -> None:
        try:
            import openai
        except ImportError as error:
            needs = "asking a model needs the extra [llm]: pip install 'lw_torchrl[llm]'"
            raise ImportError(f"{needs} ({error})") from error
        self._openai, self.model, self.address, self._timeout = openai, model, server_address(base_url), timeout
        self._key = key = os.environ.get(_KEY, "").strip()
        if self.address == OPENAI and not key:
            advice = f"set the environment variable {_KEY}, or give the base_url of a server that needs none"
            raise PlannerError(f"{model!r} at {self.address} needs a key: {advice}", fatal=True)
        if not (key.isascii() and key.isprintable()):
            raise PlannerError(f"the key in {_KEY} has characters that no key has; set it again", fatal=True)
        self._fallbacks = frozenset({"max_completion_tokens"} if self.address == OPENAI else ())
        options: Any = {"timeout": openai.Timeout(timeout, connect=min(timeout, 10.0))}
        try:
            options |= {"http_client": _limited(openai, timeout)(**options), "max_retries": retries}
            self._client = openai.OpenAI(api_key=key or "none", base_url=base_url, **options)
        except (ValueError, ImportError, OSError) as error:
            advice = f"check the environment variables {', '.join(_PROXIES)}, SSL_CERT_FILE, SSL_CERT_DIR"
            what = f"the HTTP client cannot be made ({excerpt(str(error))})"
            raise PlannerError(f"{what}; {advice}", fatal=True) from None

    def close(self) -> None:
        self._client.close()

    def ask(self, request: Mapping[str, Any], question: str) -> Reply:
        """Return the reply to a request, or raise a :class:`PlannerError` that names the ``question``.

        The request has "messages", "schema", "max_tokens", "temperature", "seed" and "options", most of them or None.
        """
        try:
            content, fallbacks = self._complete(request)
            reply, answering = read_completion(self._without_key(content))
        except PlannerError as error:
            what, fatal = str(error), error.fatal
        except self._openai.APIError as error:
            what, fatal = self._explain(error)
        else:
            notes = list(reply.notes)
            if request["schema"] and "json_object" in fallbacks:
                notes.insert(0, "the schema was sent as json_object, since the server takes no json_schema")
            if not (answering.startswith(self.model) or self.model.startswith(answering)):  # servers append a date
                notes.insert(0, f"the server says that the model {answering!r} answered, not {self.model!r}")
            clean = {name: self._without_key(getattr(reply, name)) for name in ("text", "refusal")}
            return replace(reply, notes=tuple(notes), **clean)
        raise PlannerError(f"{self.model!r} at {self.address}, {question}: {self._without_key(what)}.", fatal=fatal)

    def _complete(self, request: Mapping[str, Any]) -> tuple[bytes, frozenset[str]]:
        """Return the body of a reply, and the fallbacks with which the server accepted the request."""
        while True:
            fallbacks = self._fallbacks
            try:
                fields = _request_fields(self.model, request, fallbacks)
                return self._client.chat.completions.with_raw_response.create(**fields).content, fallbacks
            except self._openai.APIStatusError as error:
                said = _error_text(error) if error.status_code in (400, 415, 422) else ""
                refused = {name for name, words in _FALLBACKS.items() if re.search(words, said, re.IGNORECASE)}
                if refused <= fallbacks:
                    raise
                self._fallbacks |= refused

    def _explain(self, error: Any) -> tuple[str, bool]:
        """Return the cause of a client's error, with a remedy, and whether it is fatal."""
        tried = f"asked {counted(int(error.request.headers.get('x-stainless-retry-count', 0)) + 1, 'time')}"
        status, said = getattr(error, "status_code", None), excerpt(self._without_key(_error_text(error)))
        if any(isinstance(cause, self._openai.APITimeoutError) for cause in (error, error.__cause__)):
            limit = f"no whole answer within {self._timeout:g} s, {tried}"
            return f"{limit}. Give a longer timeout, or a lower concurrency", False
        if status is None:
            cause = excerpt(self._without_key(str(error.__cause__ or error))) or type(error.__cause__).__name__
            proxies = [name for name in _PROXIES if os.environ.get(name) or os.environ.get(name.lower())]
            advice = "Check that the server runs, and that base_url is its address"
            advice += f"; the client also uses {', '.join(proxies)}" if proxies else ""
            return f"the connection failed or broke off, {tried}: {cause}. {advice}", True
        if status in (401, 403):
            known = f"the key in {_KEY} is not accepted" if self._key else f"the server needs a key, in {_KEY}"
            return f"{known} ({said}). Give the key of this server", True
        if status == 404:
            return f"no such model or address ({said}). `GET {self.address}/models` lists its models", True
        if status == 429:
            return f"too many requests, {tried} ({said}). Continue later, or with a lower concurrency", True
        if status >= 500:
            return f"the server failed, {tried} ({said}). Its log may say why; ask again", False
        if re.search(r"context|too long|max_tokens|maximum.{0,20}length", said, re.IGNORECASE):
            advice = "Give fewer max_tokens, a shorter format (basic_py), or the server a longer context"
            return f"the question does not fit ({said}). {advice}", False
        return f"the request is refused ({said}). Leave out the options that the server does not know", False

    def _without_key(self, text: Any) -> Any:
        """Replace copies of the key in a text or in bytes; a shorter key, such as "none", may be an ordinary word."""
        key, hidden = self._key, "(the key)"
        if len(key) < 8:
            return text
        return text.replace(key, hidden) if isinstance(text, str) else text.replace(key.encode(), hidden.encode())


def _limited(openai: Any, timeout: float) -> Any:
    """Return a subclass of the ``openai`` package's HTTP client that bounds the time and the size of each reply.

    Its own timeout bounds each read, so that a server that sends a byte now and then would never time out.
    """

    class LimitedClient(openai.DefaultHttpxClient):
        def send(self, request: Any, **options: Any) -> Any:
            end = monotonic() + timeout
            response = super().send(request, **{**options, "stream": True})
            content = bytearray()
            with closing(response):
                for part in response.iter_bytes():
                    content += part
                    if monotonic() > end:
                        raise openai.APITimeoutError(request)
                    if len(content) > REPLY_LIMIT:  # read_completion says so
                        break
            headers = {name: value for name, value in response.headers.items() if name.lower() != "content-encoding"}
            status = _status(response.status_code, bytes(content))
            return type(response)(status, headers=headers, content=bytes(content), request=request)

    return LimitedClient


def _status(status: int, content: bytes) -> int:
    """Return the status that a reply should have had, for the client to decide whether to ask again."""
    if status == 500 and b"response_format" in content:  # llama-cpp-python refuses a kind of schema
        return 400
    with suppress(ValueError):  # some gateways send an error with status 200, and its code in the body
        if status == 200 and (error := parse_json(content).get("error")):
            code = error.get("code") if isinstance(error, dict) else None
            return code if type(code) is int and 400 <= code < 600 else 502
    return status


def _request_fields(model: str, request: Mapping[str, Any], fallbacks: frozenset[str]) -> dict[str, Any]:
    messages, schema = request["messages"], request["schema"]
    if "no system message" in fallbacks:
        system, user, *others = messages
        messages = [{**user, "content": f"{system['content']}\n\n{user['content']}"}, *others]
    limit = "max_completion_tokens" if "max_completion_tokens" in fallbacks else "max_tokens"
    fields = {"model": model, "messages": messages, limit: request["max_tokens"], "extra_body": request["options"]}
    fields |= {name: request[name] for name in ("temperature", "seed") if request[name] is not None}
    if schema:
        strict = {"type": "json_schema", "json_schema": {"name": "plan", "schema": schema, "strict": True}}
        plain = {"type": "json_object", "schema": schema}
        fields["response_format"] = plain if "json_object" in fallbacks else strict
    return fields


def _error_text(error: Any) -> str:
    """Return the message of an error, and what the server sent if the client does not understand it."""
    text = error.response.text.strip() if hasattr(error, "response") else ""
    return str(error) if text in str(error) or " - " in str(error) else f"{error} - {text}"


def read_completion(content: bytes) -> tuple[Reply, str]:
    """Read a chat completion; return the reply, and the name of the model that answered.

    Raises:
        PlannerError: it is too large, not JSON, or not a chat completion.
    """
    if len(content) > REPLY_LIMIT:
        size = f"the reply is larger than {REPLY_LIMIT // 2**20} MiB"
        raise PlannerError(f"{size}. Give fewer max_tokens, and no options that make it long")
    try:
        body = parse_json(content)
        choice = body["choices"][0]
        message = choice["message"]
        answer = message["content"]
    except (ValueError, KeyError, IndexError, TypeError) as error:
        if isinstance(error, ValueError) and content.strip()[:1] in (b"", b"{"):
            raise PlannerError(f"the reply was cut off or is not JSON: {excerpt(str(error))}. Ask again") from None
        advice = "Check that base_url is the address of an OpenAI-compatible server; it usually ends in /v1"
        text = excerpt(content.decode("utf-8", "replace"))
        raise PlannerError(f"the reply is not a chat completion: {text}. {advice}", fatal=True) from None
    notes: tuple[str, ...] = ()
    if isinstance(answer, list):  # parts: thoughts, and texts
        answer = "".join(_text(part.get("text")) for part in answer if isinstance(part, dict))
    elif not answer:
        others = [name for name in ("reasoning_content", "reasoning", "tool_calls") if message.get(name)]
        notes = tuple(f"the server sent {name} instead of an answer" for name in others)
    usage = body.get("usage")
    counts = [usage.get(name) if isinstance(usage, dict) else 0 for name in ("prompt_tokens", "completion_tokens")]
    tokens = Tokens(*(count if type(count) is int and count >= 0 else 0 for count in counts))
    finish, refusal = _text(choice.get("finish_reason")), _text(message.get("refusal"))
    return Reply(_text(answer), finish, refusal, tokens, notes), excerpt(_text(body.get("model")))


def _text(value: Any) -> str:
    """Return a text without lone surrogates, which no file can hold; "" for other values."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else ""


def excerpt(text: str) -> str:
    """Shorten a server's text to one printable line without HTML tags."""
    text = " ".join(re.sub(r"<(style|script)\b.*?</\1>|<[^<>]*>", " ", text[:20_000], flags=re.DOTALL).split())
    text = "".join(character if character.isprintable() else "?" for character in text)
    return text if len(text) <= 300 else f"{text[:300]} ..."
