"""Secrets that a server may send back: they are taken out of its texts, in whatever form they come."""

from __future__ import annotations

import logging
import re
from base64 import b64encode
from collections.abc import Iterable, Iterator
from html import unescape
from unicodedata import combining, normalize

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
        if self._words:
            text = self._words.sub(HIDDEN, text)
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
