"""A chat server's reply: received within bounds of time and size, read without trust, and without keys."""

from __future__ import annotations

import asyncio
import logging
import re
from base64 import b64encode
from collections.abc import Callable, Iterable, Iterator
from html import unescape
from importlib import import_module
from typing import Any
from unicodedata import combining, normalize

from lw_torchrl._files import parse_json
from lw_torchrl.planners.answers import Reply, Tokens, is_count, storable

HIDDEN = "(the key)"
_SHORTEST = 8  # letters and digits of a secret that is looked for in every form; a shorter one may be a word, "none"
_SHORTEST_WORD = 4
_LONGEST = 200_000  # characters of a text that is searched for the places of a secret; a longer one is hidden whole
_ESCAPE = re.compile(r"\\(?:u[0-9a-f]{4}|x[0-9a-f]{2}|.)|%[0-9a-f]{2}|&#?\w{1,30};|<[^<>]*>", re.IGNORECASE | re.DOTALL)
_LOGGERS = [f"httpcore{version}.{part}" for version in ("", "2") for part in ("connection", "http11", "http2", "proxy")]
_LOGGERS += ["httpx", "httpx2", "openai._base_client"]


class Redactor(logging.Filter):
    """Takes secrets out of texts, and out of the HTTP client's log while the block lasts.

    A secret is found whole or broken by white space, punctuation, invisible characters or tags, in either case, with
    its characters escaped (JSON, URL, HTML; up to twice), in base64 and as hex digits. One of fewer than eight letters
    and digits is found only as it is, as a word; one of fewer than four characters is no secret.
    """

    def __init__(self, secrets: Iterable[str]) -> None:
        super().__init__()
        self._forms: set[str] = set()
        words = []
        for secret in secrets:
            if len(_letters(secret)) >= _SHORTEST:
                self._forms.update(form for form in map(_letters, _written(secret)) if len(form) >= _SHORTEST)
            elif len(secret) >= _SHORTEST_WORD:
                words.append(re.escape(secret))
        self._words = re.compile(rf"(?<!\w)(?:{'|'.join(words)})(?!\w)") if words else None

    def __call__(self, text: str) -> str:
        """The text, with ``(the key)`` in the place of each secret."""
        text = self._words.sub(HIDDEN, text) if self._words else text
        if not any(form in _letters(view) for view in _views(text) for form in self._forms):
            return text
        places = sorted(self._places(text)) if len(text) <= _LONGEST else []
        found, end = [], 0
        for start, stop in places or [(0, len(text))]:
            if start >= end:
                found += [text[end:start], HIDDEN]
            end = max(end, stop)
        return "".join([*found, text[end:]])

    def _places(self, text: str) -> Iterator[tuple[int, int]]:
        view = [(sign, place, place + 1) for place, sign in enumerate(text)]
        for _ in _views(text):
            letters = [(letter, start, stop) for sign, start, stop in view for letter in _letters(sign)]
            joined = "".join(letter for letter, _, _ in letters)
            for form in self._forms:
                at = joined.find(form)
                while at >= 0:
                    yield letters[at][1], letters[at + len(form) - 1][2]
                    at = joined.find(form, at + 1)
            now, end = [], 0
            for escape in _ESCAPE.finditer("".join(sign for sign, _, _ in view)):
                first, last = view[escape.start()], view[escape.end() - 1]
                meant = [(sign, first[1], last[2]) for sign in _meant(escape)]
                now += [*view[end : escape.start()], *meant]
                end = escape.end()
            view = [*now, *view[end:]]

    def filter(self, record: logging.LogRecord) -> bool:
        record.msg, record.args = self(record.getMessage()), ()
        return True

    def __enter__(self) -> Redactor:
        for name in _LOGGERS:
            logging.getLogger(name).addFilter(self)
        return self

    def __exit__(self, *_: object) -> None:
        for name in _LOGGERS:
            logging.getLogger(name).removeFilter(self)


def _letters(text: str) -> str:
    """Letters and digits alone, in lower case, and plain ones for those of other widths or with accents."""
    if not text.isascii():  # without accents first: many on one letter take their square in time
        text = normalize("NFKD", "".join(sign for sign in text if not combining(sign)))
    return "".join(filter(str.isalnum, text.lower()))


def _written(secret: str) -> Iterator[str]:
    """The secret, in hex digits, and what base64 makes of it wherever it stands in what is encoded."""
    content = secret.encode("utf-8", "replace")
    yield secret
    yield content.hex()
    for before in range(3):
        encoded = b64encode(bytes(before) + content).decode().rstrip("=")
        last = len(encoded) - ((before + len(content)) % 3 > 0)  # it also says what comes behind
        yield encoded[(0, 2, 3)[before] : last]


def _views(text: str) -> Iterator[str]:
    """A text as it is, and with its escapes undone once and twice."""
    yield text
    for _ in range(2):
        if not _ESCAPE.search(text):
            return
        text = _ESCAPE.sub(_meant, text)
        yield text


def _meant(escape: re.Match[str]) -> str:
    """The characters that an escape stands for; none for white space and tags."""
    text = escape[0]
    if text[0] == "<":
        return ""
    if text[0] == "&":
        return unescape(text)
    digits = text[1:] if text[0] == "%" else text[2:]
    if digits:
        return chr(int(digits, 16))
    return "" if text[1] in "abfnrtv" else text[1]


REPLY_LIMIT = 4 * 2**20  # bytes of a reply; one byte more is kept, which tells a larger one from one that fits
KEY_SENT_BACK = "the server sent the key back; it is hidden"
_HEADERS = ("location", "retry-after", "retry-after-ms", "x-should-retry")
_MOST_SHOWN, _SEARCHED = 300, 20_000  # characters of a server's text: in an error, and searched for secrets


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
    return plain if len(plain) <= _MOST_SHOWN else f"{plain[:_MOST_SHOWN]} ..."


def _object(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}
