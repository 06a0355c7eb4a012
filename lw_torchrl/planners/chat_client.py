"""A client for the chat completions of OpenAI-compatible servers, with limits, fallbacks and explained errors."""

from __future__ import annotations

import os
import re
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._util.checks import counted, shown
from lw_torchrl._util.files import parse_json
from lw_torchrl.planners.answer_files import PlannerError, Reply, Tokens

OPENAI = "https://api.openai.com/v1"
REPLY_LIMIT = 4 * 2**20  # maximum size of a reply in bytes
_KEY = "OPENAI_API_KEY"
# Fallbacks for servers that reject a field, each with a pattern of the server's error message.
_FALLBACKS = {
    "max_completion_tokens": "max_completion_tokens",  # instead of max_tokens
    "json_object": "response_format|json_schema",  # as the type of response_format, instead of json_schema
    "no system message": "system role|role.{0,20}system",  # prepend the system message to the user's message
}


def server_address(base_url: str | None) -> str:
    """Check a server's address, and return the address without user name, password and query."""
    try:
        url = urlsplit(base_url or os.environ.get("OPENAI_BASE_URL") or OPENAI)
        valid = bool(url.hostname) and url.scheme in ("http", "https") and url.port != 0
    except ValueError:
        valid = False
    if not valid:
        raise ValueError(f"base_url must be an address like 'http://127.0.0.1:8000/v1', got {shown(base_url)}")
    return f"{url.scheme}://{url.netloc.rpartition('@')[2]}{url.path.rstrip('/')}"


class ChatClient:
    """A thread-safe client for one model; the arguments are as for :class:`OpenAIPlanner`."""

    def __init__(self, model: str, base_url: str | None, timeout: float, retries: int) -> None:
        try:
            import openai
        except ImportError as error:
            needs = "requests to a model need the extra [llm]: pip install 'lw_torchrl[llm]'"
            raise ImportError(f"{needs} ({error})") from error
        self._openai, self.model, self.address, self._timeout = openai, model, server_address(base_url), timeout
        self._key = key = os.environ.get(_KEY, "").strip()
        if self.address == OPENAI and not key:
            advice = f"set the environment variable {_KEY}, or pass the base_url of a server that needs no key"
            raise PlannerError(f"{model!r} at {self.address} needs a key: {advice}", fatal=True)
        if not (key.isascii() and key.isprintable()):
            raise PlannerError(f"the key in {_KEY} has invalid characters; set {_KEY} again", fatal=True)
        self._fallbacks = frozenset({"max_completion_tokens"} if self.address == OPENAI else ())
        options: Any = {"timeout": openai.Timeout(timeout, connect=min(timeout, 10.0))}
        try:
            options |= {"http_client": _limited(openai, timeout)(**options), "max_retries": retries}
            self._client = openai.OpenAI(api_key=key or "none", base_url=base_url, **options)
        except (ValueError, ImportError, OSError) as error:
            advice = "check the environment variables of proxies (ALL_PROXY) and certificates (SSL_CERT_FILE)"
            what = f"the HTTP client cannot be created ({_excerpt(str(error))})"
            raise PlannerError(f"{what}; {advice}", fatal=True) from None

    def close(self) -> None:
        self._client.close()

    def ask(self, request: Mapping[str, Any], question: str) -> Reply:
        """Send a request and return the reply, or raise a PlannerError that names the ``question``."""
        try:
            content, fallbacks = self._complete(request)
            reply, answering = _read_completion(self._without_key(content))
        except PlannerError as error:
            what, fatal = str(error), error.fatal
        except self._openai.APIError as error:
            what, fatal = self._explain(error)
        else:
            notes = list(reply.notes)
            if request["schema"] and "json_object" in fallbacks:
                notes.insert(0, "the schema was sent as json_object, since the server rejects json_schema")
            if not (answering.startswith(self.model) or self.model.startswith(answering)):  # some servers append a date
                notes.insert(0, f"the server reports that model {answering!r} answered instead of {self.model!r}")
            clean = {name: self._without_key(getattr(reply, name)) for name in ("text", "refusal")}
            return replace(reply, notes=tuple(notes), **clean)
        raise PlannerError(f"{self.model!r} at {self.address}, {question}: {self._without_key(what)}.", fatal=fatal)

    def _complete(self, request: Mapping[str, Any]) -> tuple[bytes, frozenset[str]]:
        """Send a request; return the reply's body and the fallbacks with which the server accepted the request."""
        while True:  # at most one iteration per fallback, since rejecting an active fallback raises
            fallbacks = self._fallbacks
            try:
                fields = _request_fields(self.model, request, fallbacks)
                return self._client.chat.completions.with_raw_response.create(**fields).content, fallbacks
            except self._openai.APIStatusError as error:
                message = _error_text(error) if error.status_code in (400, 415, 422) else ""
                refused = {name for name, words in _FALLBACKS.items() if re.search(words, message, re.IGNORECASE)}
                if refused <= fallbacks:
                    raise
                self._fallbacks |= refused

    def _explain(self, error: Any) -> tuple[str, bool]:
        """Return a description of a client's error (the cause and a remedy), and whether the error is fatal."""
        tried = f"tried {counted(int(error.request.headers.get('x-stainless-retry-count', 0)) + 1, 'time')}"
        status, message = getattr(error, "status_code", None), _excerpt(self._without_key(_error_text(error)))
        fatal = True
        if any(isinstance(cause, self._openai.APITimeoutError) for cause in (error, error.__cause__)):
            cause, fatal = f"no complete answer within {self._timeout:g} s, {tried}", False
            advice = "Use a longer timeout or a lower concurrency"
        elif status is None:
            reason = _excerpt(self._without_key(str(error.__cause__ or error))) or type(error.__cause__).__name__
            cause = f"the connection failed or was interrupted, {tried}: {reason}"
            advice = "Check that the server is running and that base_url is correct"
        elif status in (401, 403):
            cause = f"the server rejects the key in {_KEY}" if self._key else f"the server needs a key in {_KEY}"
            advice = "Set the key for this server"
        elif status == 404:
            cause, advice = "no such model or address", f"`GET {self.address}/models` lists the server's models"
        elif status == 429:
            cause, advice = f"too many requests, {tried}", "Retry later or with a lower concurrency"
        elif status >= 500:
            cause, advice, fatal = f"the server failed, {tried}", "Check the server's log, and retry", False
        elif re.search(r"context|too long|max_tokens|maximum.{0,20}length", message, re.IGNORECASE):
            cause, fatal = "the request exceeds the model's context", False
            advice = "Use fewer max_tokens, a shorter format (basic_py) or a longer context on the server"
        else:
            cause, fatal = "the server rejects the request", False
            advice = "Remove options that the server does not support"
        return f"{cause}{f' ({message})' if status else ''}. {advice}", fatal

    def _without_key(self, text: Any) -> Any:
        """Redact the API key in a text or in bytes. A key of under 8 characters may be an ordinary word, so is kept."""
        key, hidden = self._key, "(the key)"
        if len(key) < 8:
            return text
        return text.replace(key, hidden) if isinstance(text, str) else text.replace(key.encode(), hidden.encode())


def _limited(openai: Any, timeout: float) -> Any:
    """Return a subclass of the ``openai`` package's HTTP client that limits the time and the size of each reply.

    The client's own timeout limits only each read, so a server that sends a byte now and then would never time out.
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
                    if len(content) > REPLY_LIMIT:  # _read_completion raises the error
                        break
            headers = {name: value for name, value in response.headers.items() if name.lower() != "content-encoding"}
            status = _status(response.status_code, bytes(content))
            return type(response)(status, headers=headers, content=bytes(content), request=request)

    return LimitedClient


def _status(status: int, content: bytes) -> int:
    """Correct the HTTP status of a reply, from which the client decides whether to retry."""
    if status == 500 and b"response_format" in content:  # llama-cpp-python rejects a type of schema
        return 400
    with suppress(ValueError):  # some gateways send status 200 with an error code in the body
        if status == 200 and (error := parse_json(content).get("error")):
            code = error.get("code") if isinstance(error, dict) else None
            return code if type(code) is int and 400 <= code < 600 else 502
    return status


def _request_fields(model: str, request: Mapping[str, Any], fallbacks: frozenset[str]) -> dict[str, Any]:
    """Build the fields of a chat completion request, with the given fallbacks."""
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
    """Return an error's message, with the server's text if the message lacks it."""
    text = error.response.text.strip() if hasattr(error, "response") else ""
    return str(error) if text in str(error) or " - " in str(error) else f"{error} - {text}"


def _read_completion(content: bytes) -> tuple[Reply, str]:
    """Parse a chat completion; return the reply and the name of the model that answered.

    Raises:
        PlannerError: the content is too large, not JSON, or not a chat completion.
    """
    if len(content) > REPLY_LIMIT:
        size = f"the reply is larger than {REPLY_LIMIT // 2**20} MiB"
        raise PlannerError(f"{size}. Use fewer max_tokens, and remove options that lengthen replies")
    try:
        body = parse_json(content)
        choice = body["choices"][0]
        message = choice["message"]
        answer = message["content"]
    except (ValueError, KeyError, IndexError, TypeError) as error:
        if isinstance(error, ValueError) and content.strip()[:1] in (b"", b"{"):
            raise PlannerError(f"the reply was cut off or is not JSON: {_excerpt(str(error))}. Retry") from None
        advice = "Check that base_url is the address of an OpenAI-compatible server, usually ending in /v1"
        text = _excerpt(content.decode("utf-8", "replace"))
        raise PlannerError(f"the reply is not a chat completion: {text}. {advice}", fatal=True) from None
    notes: tuple[str, ...] = ()
    if isinstance(answer, list):  # the parts are thoughts and texts
        answer = "".join(_text(part.get("text")) for part in answer if isinstance(part, dict))
    elif not answer:
        others = [name for name in ("reasoning_content", "reasoning", "tool_calls") if message.get(name)]
        notes = tuple(f"the server sent {name} instead of an answer" for name in others)
    usage = body.get("usage")
    counts = [usage.get(name) if isinstance(usage, dict) else 0 for name in ("prompt_tokens", "completion_tokens")]
    tokens = Tokens(*(count if type(count) is int and count >= 0 else 0 for count in counts))
    finish, refusal = _text(choice.get("finish_reason")), _text(message.get("refusal"))
    return Reply(_text(answer), finish, refusal, tokens, notes), _excerpt(_text(body.get("model")))


def _text(value: Any) -> str:
    """Remove lone surrogates, which cannot be written to a file, from a text; return "" for any other type."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else ""


def _excerpt(text: str) -> str:
    """Shorten a server's text to one printable line (300 characters) without HTML tags."""
    text = " ".join(re.sub(r"<(style|script)\b.*?</\1>|<[^<>]*>", " ", text[:20_000], flags=re.DOTALL).split())
    text = "".join(character if character.isprintable() else "?" for character in text)
    return text if len(text) <= 300 else f"{text[:300]} ..."
