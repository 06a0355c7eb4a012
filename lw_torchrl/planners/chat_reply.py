"""A chat server's reply, received within bounds of time and size, and read without trusting anything in it."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable
from importlib import import_module
from typing import Any

from lw_torchrl._files import parse_json
from lw_torchrl.planners.answers import Reply, Tokens, is_count, storable

REPLY_LIMIT = 4 * 2**20  # bytes of a reply; one byte more is kept, which tells a larger one from one that fits
KEY_SENT_BACK = "the server sent the key back; it is hidden"
_HEADERS = ("location", "retry-after", "retry-after-ms", "x-should-retry")
_LONGEST, _SEARCHED = 300, 20_000  # characters of a server's text: in an error, and searched for secrets


def bounded_client(openai: Any, timeout: float) -> Any:
    """An HTTP client for ``openai.AsyncOpenAI`` that reads each answer whole, within :data:`REPLY_LIMIT`.

    ``timeout`` bounds the seconds from the connection to the last byte of an answer, however slowly it comes. No
    redirect is followed, so that keys and questions reach only the server that was named.
    """
    known: Any = openai.DefaultAsyncHttpxClient
    httpx: Any = import_module(known.send.__module__.partition(".")[0])  # the one that this openai works with

    class Bounded(known):
        async def send(self, request: Any, **options: Any) -> Any:
            request.headers["accept-encoding"] = "identity"  # a compressed reply has no size before it is read
            content = bytearray()
            try:
                async with asyncio.timeout(timeout):
                    reply = await super().send(request, **{**options, "stream": True, "follow_redirects": False})
                    try:
                        async for part in reply.aiter_raw():
                            content += part
                            if len(content) > REPLY_LIMIT:
                                break
                    finally:
                        await reply.aclose()
            except TimeoutError:
                raise httpx.ReadTimeout(f"no whole answer within {timeout:g} s", request=request) from None
            headers = {name: reply.headers[name] for name in _HEADERS if name in reply.headers}
            kept = bytes(content[: REPLY_LIMIT + 1])
            return httpx.Response(reply.status_code, headers=headers, content=kept, request=request)

    return Bounded(timeout=openai.Timeout(timeout, connect=min(timeout, 10.0)))


class NoCompletion(ValueError):
    """What came is no chat completion; ``hint`` says what to try, and with ``fatal`` any other ends the same way."""

    def __init__(self, message: str, hint: str, fatal: bool = False) -> None:
        super().__init__(message)
        self.hint, self.fatal = hint, fatal


def read_completion(content: bytes, hide: Callable[[str], str]) -> tuple[Reply, str]:
    """The answer in a reply's body, and the model that the server says gave it; ``hide`` takes out secrets.

    A wrong ``finish_reason``, ``refusal`` or ``usage`` is noted, and takes nothing from the answer. One that is too
    large, no JSON, or has no message whose content is a text or null, is :class:`NoCompletion`.
    """
    if len(content) > REPLY_LIMIT:
        what = f"the reply is larger than {REPLY_LIMIT // 2**20} MiB"
        raise NoCompletion(what, "Leave out options that make it long, or give fewer max_tokens")
    found: dict[str, Any] = {}
    try:
        found = parse_json(content.removeprefix(b"\xef\xbb\xbf"))
    except ValueError as error:
        if content.strip()[:1] in (b"", b"{"):
            said = in_a_line(str(error), hide)
            raise NoCompletion(f"the answer was cut off or is no JSON: {said}", "Ask again") from None
    choices = found.get("choices")
    choice = _object(choices[0] if isinstance(choices, list) and choices else None)
    message = _object(choice.get("message"))
    text = message.get("content")
    if not message or not isinstance(text, str | None):
        raise NoCompletion(
            f"what came is no chat completion: {in_a_line(content.decode('utf-8', 'replace'), hide)}",
            "See that base_url is the address of an OpenAI-compatible server; it usually ends in /v1",
            fatal=True,
        )
    finish, refusal, usage = choice.get("finish_reason"), message.get("refusal"), found.get("usage")
    counts = [_object(usage).get(name) for name in ("prompt_tokens", "completion_tokens")]
    right = {
        "finish_reason": isinstance(finish, str | None),
        "refusal": isinstance(refusal, str | None),
        "usage": isinstance(usage, dict | None) and all(count is None or is_count(count) for count in counts),
    }
    notes = [f"the server's {name} could not be read" for name, known in right.items() if not known]
    given = [said if isinstance(said, str) else "" for said in (text, finish, refusal)]
    hidden = list(map(hide, given))
    if hidden != given:
        notes.append(KEY_SENT_BACK)
    prompt, written = (count if is_count(count) else 0 for count in counts)
    model = found.get("model")
    answered = in_a_line(model, hide) if isinstance(model, str) else ""
    said, ended, refused = map(storable, hidden)
    return Reply(said, ended, refused, Tokens(prompt, written), tuple(notes)), answered


def in_a_line(text: str, hide: Callable[[str], str]) -> str:
    """What a server said, for a message: short, without secrets, and without what moves a terminal's cursor."""
    plain = re.sub(r"<(style|script).*?</\1>|<[^>]*>", " ", hide(text)[:_SEARCHED], flags=re.DOTALL)
    plain = "".join(sign if sign.isprintable() else "?" for sign in hide(" ".join(plain.split())))
    return plain if len(plain) <= _LONGEST else f"{plain[:_LONGEST]} ..."


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
