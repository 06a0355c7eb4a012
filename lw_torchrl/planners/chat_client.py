"""A client for the chat completions of OpenAI-compatible servers, with limits, fallbacks and explained errors."""

from __future__ import annotations

import ipaddress
import json
import math
import os
import re
import ssl
from collections.abc import Mapping
from contextlib import closing, suppress
from dataclasses import replace
from time import monotonic
from typing import Any
from urllib.parse import urlsplit

from lw_torchrl._util.checks import shown
from lw_torchrl._util.text import counted
from lw_torchrl.planners.answer_files import PlannerError, Reply, Tokens

OPENAI = "https://api.openai.com/v1"
REPLY_LIMIT = 4 * 2**20  # maximum size of a reply in bytes
_KEY = "OPENAI_API_KEY"
_PROXIES = ("ALL_PROXY", "HTTP_PROXY", "HTTPS_PROXY")
_VARIABLES = (*_PROXIES, "NO_PROXY", "SSL_CERT_FILE", "SSL_CERT_DIR")  # these change how a server is reached
# Fallbacks for servers that reject a field, each with a pattern of the server's error message. "no system message"
# prepends the system message to the user's message; templates without a system role word their errors in many ways.
_FALLBACKS = {
    "max_completion_tokens": "max_completion_tokens",  # instead of max_tokens
    "json_object": "response_format|json_schema",  # as the type of response_format, instead of json_schema
    "no system message": r"system.{0,3} (role|message|prompt|instruction)|role.{0,40}\bsystem\b|developer instruction"
    r"|messages\W{1,3}0\W{1,3}role|user\W{1,3}(and|or|/)\W{0,3}assistant|roles must alternate",
}
_FALLBACK_NOTES = {
    "json_object": "the schema was sent as json_object, since the server rejects json_schema",
    "no system message": "the system message was sent as part of the user's message, since the server rejects it",
}
# Patterns of errors that servers report with status 200 and without a numeric code, with the status to use instead.
_STATUSES = {
    429: r"rate.?limit|too many requests|quota|overloaded|capacity",
    401: r"api.?key|unauthori[sz]ed|authentication",
    400: r"invalid.?request|context.{0,10}length|unsupported",
}


def server_address(base_url: str | None) -> str:
    """Check a server's address and return it without the user name, the password and the query."""
    name, given = "base_url", base_url
    if not base_url and os.environ.get("OPENAI_BASE_URL"):
        name, given = "the environment variable OPENAI_BASE_URL", os.environ["OPENAI_BASE_URL"]
    try:
        url = urlsplit(given or OPENAI)
        valid = bool(url.hostname) and url.scheme in ("http", "https") and url.port != 0
    except ValueError:
        valid = False
    if not valid:
        raise ValueError(f"{name} must be an address like 'http://127.0.0.1:8000/v1', got {shown(given)}")
    return f"{url.scheme}://{url.netloc.rpartition('@')[2]}{url.path.rstrip('/')}"


def _is_local(address: str) -> bool:
    """Return whether an address is on this machine, in which case no proxy is used."""
    host = urlsplit(address).hostname or ""
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost" or host.endswith(".localhost")


class ChatClient:
    """A thread-safe client for one model; the arguments are as for :class:`OpenAIPlanner`."""

    def __init__(self, model: str, base_url: str | None, timeout: float, retries: int) -> None:
        try:
            import openai
        except ImportError as error:
            raise ImportError(f"requests to a model need an extra: pip install 'lw_torchrl[llm]' ({error})") from error
        self._openai, self.model, self.address, self._timeout = openai, model, server_address(base_url), timeout
        self._key = key = os.environ.get(_KEY, "").strip()
        if self.address == OPENAI and not key:
            advice = f"set the environment variable {_KEY}, or pass the base_url of a server that needs no key"
            raise PlannerError(f"{model!r} at {self.address} needs a key: {advice}", fatal=True)
        for name in (_KEY, "OPENAI_ORG_ID", "OPENAI_PROJECT_ID"):  # these become headers of each request
            value = os.environ.get(name, "").strip()
            if not (value.isascii() and value.isprintable()):
                raise PlannerError(f"the value of {name} has invalid characters; set {name} again", fatal=True)
        self._fallbacks = frozenset({"max_completion_tokens"} if self.address == OPENAI else ())
        options: Any = {"timeout": openai.Timeout(timeout, connect=min(timeout, 10.0))}
        self._is_local = _is_local(self.address)
        try:
            own = {"trust_env": False, "verify": ssl.create_default_context()} if self._is_local else {}
            limited = _limited(openai, timeout, refusals=0 if self._is_local else 1)
            options |= {"http_client": limited(**options, **own), "max_retries": retries}
            self._client = openai.OpenAI(api_key=key or "none", base_url=base_url, **options)
        except Exception as error:  # for invalid environment variables, httpx and ssl raise errors of many types
            advice = f"check the environment variables of proxies and certificates{self._environment()}"
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
            active = [name for name in fallbacks if name != "json_object" or request["schema"]]
            notes = [*(note for name, note in _FALLBACK_NOTES.items() if name in active), *reply.notes]
            if not (answering.startswith(self.model) or self.model.startswith(answering)):  # some servers append a date
                notes.insert(0, f"the server reports that model {answering!r} answered instead of {self.model!r}")
            clean = {name: self._without_key(getattr(reply, name)) for name in ("text", "refusal")}
            return replace(reply, notes=tuple(notes), **clean)
        raise PlannerError(f"{self.model!r} at {self.address}, {question}: {self._without_key(what)}.", fatal=fatal)

    def _complete(self, request: Mapping[str, Any]) -> tuple[bytes, frozenset[str]]:
        """Send a request; return the reply's body, and the fallbacks that the server needed to accept it."""
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
        tried = f"asked {counted(int(error.request.headers.get('x-stainless-retry-count', 0)) + 1, 'time')}"
        status, message = getattr(error, "status_code", None), _excerpt(self._without_key(_error_text(error)))
        fatal = True
        if any(isinstance(cause, self._openai.APITimeoutError) for cause in (error, error.__cause__)):
            cause, fatal = f"no complete answer within {self._timeout:g} s, {tried}", False
            advice = "Use a longer timeout or a lower concurrency"
        elif status is None:
            reason = _excerpt(self._without_key(str(error.__cause__ or error))) or type(error.__cause__).__name__
            cause = f"the connection failed or was interrupted, {tried}: {reason}"
            advice = f"Check that the server is running and that base_url is correct{self._environment()}"
        elif status in (401, 403):
            cause = f"the server rejects the key in {_KEY}" if self._key else f"the server needs a key in {_KEY}"
            advice = "Set the key for this server"
        elif status in (404, 405):
            cause, advice = "no such model or address", f"`GET {self.address}/models` lists the server's models"
        elif status == 407:
            cause, advice = "the proxy rejects the request", f"Check the proxy's user and password{self._environment()}"
        elif status == 429:
            cause = f"too many requests, {tried}{_wait_text(error.response.headers)}"
            advice = "Retry later or with a lower concurrency"
        elif status >= 500:
            cause, fatal = f"the server failed, {tried}{_wait_text(error.response.headers)}", False
            advice = f"Check the server's log, and retry{self._environment()}"
        elif re.search(r"context|too long|max_tokens|maximum.{0,20}length", message, re.IGNORECASE):
            cause, fatal = "the request exceeds the model's context", False
            advice = "Use fewer max_tokens, a shorter format (basic_py) or a longer context on the server"
        elif status == 422:
            cause, fatal = "the server rejects a field of the request as invalid", False
            advice = "Change or remove the field that the server names"
        else:
            cause, fatal = "the server rejects the request", False
            advice = "Remove options that the server does not support"
        return f"{cause}{f' ({message})' if status else ''}. {advice}", fatal

    def _environment(self) -> str:
        """Name the environment variables that change how the server is reached; "" if none is set."""
        names = [name for name in _VARIABLES if os.environ.get(name) or os.environ.get(name.lower())]
        if self._is_local:
            names = [name for name in names if name in _PROXIES or not self.address.startswith("https")]
        ignored = ", ignored for a server on this machine" if self._is_local else ""
        return f" (set in the environment: {', '.join(names)}{ignored})" if names else ""

    def _without_key(self, text: Any) -> Any:
        """Redact the API key in text or bytes. A key of under 8 characters is kept, since it may be a common word."""
        key, hidden = self._key, "(the key)"
        if len(key) < 8:
            return text
        return text.replace(key, hidden) if isinstance(text, str) else text.replace(key.encode(), hidden.encode())


def _limited(openai: Any, timeout: float, refusals: int) -> Any:
    """Return a subclass of the ``openai`` package's HTTP client that limits the time and the size of each reply.

    The timeout of ``openai`` applies to each read, so a server that sends a byte now and then would never time out.
    A refused connection is retried at most ``refusals`` times: a server that is not running seldom starts meanwhile.
    """

    class LimitedClient(openai.DefaultHttpxClient):
        def send(self, request: Any, **options: Any) -> Any:
            end = monotonic() + timeout
            try:
                response = super().send(request, **{**options, "stream": True})
            except Exception as error:
                is_last = int(request.headers.get("x-stainless-retry-count", 0)) >= refusals
                if is_last and "refused" in str(error).lower():
                    raise openai.APIConnectionError(request=request) from error  # openai does not retry this error
                raise
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
    """Return the corrected HTTP status of a reply; the client uses the status to decide whether to retry.

    Some gateways report an error with status 200, and some servers report a rejected field with status 500.
    """
    if status not in (200, 500):
        return status
    body: Any = None
    with suppress(ValueError, RecursionError):
        body = json.loads(content)
    if (error := _reported_error(body)) is None:
        error = content.decode("utf-8", "replace") if status == 500 else None
    if error is None:
        return status
    text = error if isinstance(error, str) else json.dumps(error)
    if any(re.search(words, text[:20_000], re.IGNORECASE) for words in _FALLBACKS.values()):
        return 400
    codes = [error.get(name) for name in ("code", "status", "status_code")] if isinstance(error, dict) else []
    for code in [*codes, body.get("code"), body.get("status")] if isinstance(body, dict) and status == 200 else ():
        if re.fullmatch("[45][0-9][0-9]", str(code)):
            return int(str(code))
    found = (code for code, words in _STATUSES.items() if re.search(words, text[:20_000], re.IGNORECASE))
    return next(found, 502) if status == 200 else status


def _reported_error(body: Any) -> Any:
    """Return the error that a reply's body reports (a string or a JSON value), or None if it reports no error."""
    if not isinstance(body, dict):
        return None
    choices = body.get("choices")
    first = choices[0] if isinstance(choices, list) and choices and isinstance(choices[0], dict) else {}
    for part in (body, first, first.get("message")):
        if isinstance(part, dict) and (error := part.get("error") or part.get("errors")):
            return error
    texts = () if first else ("message", "detail", "msg", "error_msg", "base_resp")  # the names that gateways use
    return next((body[name] for name in texts if body.get(name)), None)


def _wait_text(headers: Mapping[str, str]) -> str:
    """Return a clause with the waiting time from the reply's "retry-after" header; "" without such a header."""
    for name, scale in (("retry-after-ms", 0.001), ("retry-after", 1.0)):
        text = _excerpt(headers.get(name, ""))[:100]
        try:
            seconds = float(text) * scale
        except ValueError:
            if text:
                return f"; the server asks to wait until {text}"
        else:
            return f"; the server asks to wait {seconds:g} s" if 1.0 <= seconds < math.inf else ""
    return ""


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
        raise PlannerError(f"{size}. Lower max_tokens, and remove options that lengthen replies")
    body: Any = None
    try:
        body = json.loads(content.decode("utf-8-sig"))
        choices = [choice for choice in body["choices"] or () if choice is not None]
        if not choices:
            raise PlannerError(f"the reply has no choices: {_excerpt(json.dumps(body))}. Retry, or change the prompt")
        choice = choices[0]
        message = choice.get("message") or {}
        answer = message.get("content") or choice.get("text")
    except (ValueError, RecursionError, KeyError, TypeError, AttributeError) as error:
        if body is None and content.strip()[:1] in (b"", b"{"):
            raise PlannerError(f"the reply was cut off or is not JSON: {_excerpt(str(error))}. Retry") from None
        advice = "Check that base_url is the address of an OpenAI-compatible server, usually ending in /v1"
        text = _excerpt(content.decode("utf-8", "replace"))
        raise PlannerError(f"the reply is not a chat completion: {text}. {advice}", fatal=True) from None
    answer, refused = _join_parts(answer)
    refusal = _text(message.get("refusal")) or refused
    notes = []
    if not answer.strip():
        others = [name for name, value in message.items() if value and name not in ("role", "refusal")]
        notes = [f"the server sent {_excerpt(name)[:40]} instead of an answer" for name in others if name != "content"]
        if "content" in others:
            text = _excerpt(str(message["content"]))
            notes.append(f"the server sent no answer: its content has no text ({text})")
    usage = body.get("usage")
    counts = [usage.get(name) if isinstance(usage, dict) else 0 for name in ("prompt_tokens", "completion_tokens")]
    tokens = Tokens(*(count if type(count) is int and count >= 0 else 0 for count in counts))
    finish = _text(choice.get("finish_reason"))
    return Reply(answer, finish, refusal, tokens, tuple(notes)), _excerpt(_text(body.get("model")))


def _join_parts(content: Any) -> tuple[str, str]:
    """Return the answer and the refusal in a message's content (a text or a list of parts); drop the reasoning."""
    answer = refusal = ""
    for part in content if isinstance(content, list) else [content]:
        text = part
        if isinstance(part, dict) and part.get("type", "text") in ("text", "output_text", "refusal"):
            text = part.get("text")
            refusal += _text(part.get("refusal"))
        answer += _text(text.get("value") if isinstance(text, dict) and text is not part else text)
    return answer, refusal


def _text(value: Any) -> str:
    """Remove lone surrogates from a text, since files cannot store them; return "" for any other type."""
    return value.encode("utf-8", "replace").decode() if isinstance(value, str) else ""


def _excerpt(text: str) -> str:
    """Shorten a server's text to one printable line (300 characters) without HTML tags."""
    text = " ".join(re.sub(r"<(style|script)\b.*?</\1>|<[^<>]*>", " ", text[:20_000], flags=re.DOTALL).split())
    text = "".join(character if character.isprintable() else "?" for character in text)
    return text if len(text) <= 300 else f"{text[:300]} ..."
